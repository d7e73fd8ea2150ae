"""Test that no folder has more lines of code than its budget in pyproject.toml.

`python -m tests.test_budgets` lowers the budgets to the present counts.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = ROOT / "pyproject.toml"
BUDGETS: dict[str, int] = tomllib.loads(PROJECT.read_text())["tool"]["flexsheet"]["budgets"]
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def count_code_lines(source: str) -> int:
    """Return the number of lines that hold a token and belong to no docstring."""
    lines = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                lines.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return len(lines)


def count_folders() -> Counter[str]:
    """Return the code lines of each folder with a budget; a file counts in the deepest one."""
    listed = subprocess.check_output(["git", "ls-files", "*.py"], cwd=ROOT, text=True).split()
    sums = Counter[str]()
    for name in filter(lambda name: (ROOT / name).is_file(), listed):
        folders = [folder for folder in BUDGETS if name.startswith(f"{folder}/")]
        sums[max(folders, key=len, default=name)] += count_code_lines((ROOT / name).read_text())
    return sums


def test_no_folder_exceeds_its_budget() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("the counted files are those of the git repository")
    sums = count_folders()
    above = {folder: n for folder, n in sums.items() if n > BUDGETS.get(folder, 0)}
    assert not above, "remove code, or raise the budget in a commit that states the reason"


if __name__ == "__main__":
    text = PROJECT.read_text()
    for folder, count in count_folders().items():
        pattern = rf'(?m)^("{re.escape(folder)}" = )(\d+)'
        text = re.sub(pattern, lambda m, n=count: f"{m[1]}{min(n, int(m[2]))}", text)
    PROJECT.write_text(text)
