"""Check code and documentation for words that the glossary replaces (`make lint`).

python -m tests.check_words [FILE ...]

The program prints file, line, word and remedy of each violation. The exit code is 1 if there are
violations. Without arguments, all files that git tracks are checked.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXEMPT = {"CHANGELOG.md"}
"""Files that list old names."""

BANNED = {
    r"\b_?(LEAST|MOST|LARGEST|SMALLEST|FURTHEST|FARTHEST|LONGEST|SHORTEST|FEWEST|FINEST)_":
        "name a limit MIN_ or MAX_",
    r'"""(Of|As|So|What|How) ': "begin a docstring with an imperative sentence",
    r"\b(whereabouts|unlikeness|foremost|foretold|mended|anew|thereby|hitherto|heed|whilst)\b":
        "see docs/glossary.md",
}  # fmt: skip
PATTERNS = {re.compile(pattern): remedy for pattern, remedy in BANNED.items()}


def violations(path: Path) -> Iterator[str]:
    """Yield a line of text for each banned word in a file."""
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        for pattern, remedy in PATTERNS.items():
            if found := pattern.search(line):
                yield f"{path.relative_to(ROOT)}:{number}: {found.group()!r}: {remedy}"


def tracked_files() -> list[Path]:
    """List the tracked Python and Markdown files, except this file and exempt files."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "*.py", "*.md"], cwd=ROOT, check=True, capture_output=True
    )
    names = set(listing.stdout.decode().split("\0")) - {""} - EXEMPT
    return [ROOT / name for name in sorted(names) if ROOT / name != Path(__file__).resolve()]


def main(arguments: list[str]) -> int:
    found = [
        line
        for path in ([Path(one).resolve() for one in arguments] or tracked_files())
        for line in violations(path)
    ]
    print("\n".join(found) or "no banned words")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
