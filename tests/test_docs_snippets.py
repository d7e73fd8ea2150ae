"""Test that the code of the documentation runs.

The Python blocks of a page run in one namespace. YAML blocks are validated as launch files, nodes,
parameters or parts of a scene. Each call of `flexsheet` in shell blocks and in the text is parsed,
and fast calls run. A block after the comment `<!-- not run: why -->` is only parsed.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch import cli
from flexsheet.launch.plans.apparatus import load_apparatus
from flexsheet.launch.plans.documents import validate
from flexsheet.launch.plans.launch_file import LaunchFile, read_launch_file
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes import node_class
from flexsheet.nodes.node import find_parameters_type
from tests.doc_pages import DOCS, ROOT, Block, as_built, blocks, code_spans, name, pages, site_pages
from tests.scenes import load_values
from tests.test_cli_help import parse

LANGUAGES = {"python", "yaml", "bash", "sh", "console", "text"}
SHELLS = ("bash", "sh", "console")
BLOCKS = {page: blocks(page) for page in pages()}
SCENE = ROOT / "launch" / "scenes" / "cylinder.yaml"

TUTORIALS = ("tutorial.md", "tutorial-record.md", "write-your-own-node.md")
"""The pages whose files the reader saves in the folder `runs` of the clone."""

OURS = {"flexsheet", "make", "python", "pytest"}
OTHERS = {
    ".", "cd", "chmod", "chown", "cp", "dask", "docker", "docker/keys.sh", "export", "git",
    "install", "ip", "journalctl", "mkdir", "nano", "pip", "pip-compile", "python", "scp", "sleep",
    "ssh", "sysctl", "systemctl", "systemd-analyze", "useradd", "^C",
}  # fmt: skip
"""Other programs that pages may call."""

AT_ONCE = ("--help", "--version", "--install-completion", "--show-completion")
"""Options that act during parsing, also in the reader's home."""

LACKS_SOMETHING = ("MissingParameter", "NoArgsIsHelpError")
"""The errors of the command line for a command without arguments."""

CHEAP = (
    "flexsheet node ",
    "flexsheet topic list",
    "flexsheet topic info",
    "flexsheet keys",
)
"""The beginnings of commands to run in a separate folder.

Examples of generated pages (`sh`) do not run, because the files in the examples do not exist.
"""


def with_language(*languages: str) -> dict[Path, list[Block]]:
    found = {page: [b for b in all_ if b.language in languages] for page, all_ in BLOCKS.items()}
    return {page: those for page, those in found.items() if those}


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a working folder with the project's launch files and without the user's files."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "launch").symlink_to(ROOT / "launch")
    for linked in ("scenes", "calibrations"):
        (tmp_path / linked).symlink_to(ROOT / "launch" / linked)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEXSHEET_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("FLEXSHEET_KEYS", str(tmp_path / "keys"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def test_each_block_names_its_language() -> None:
    for block in (block for those in BLOCKS.values() for block in those):
        assert block.language in LANGUAGES, (
            f"{block.place}: ```{block.language}; one of {', '.join(sorted(LANGUAGES))}"
        )


# Python


@pytest.mark.parametrize("page", with_language("python"), ids=name)
def test_python_runs(page: Path, clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType(f"page_{page.stem.replace('-', '_')}")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with patch.dict("flexsheet.nodes.models.shapes.GEOMETRIES"):
        for block in with_language("python")[page]:
            # Its lines count as the page's, for the trace of what fails.
            source = "\n" * block.line + block.text
            code = compile(source, str(page), "exec")
            if block.not_run is None:
                exec(code, module.__dict__)


# YAML


@pytest.mark.parametrize(
    "block", [b for those in with_language("yaml").values() for b in those], ids=lambda b: b.place
)
def test_yaml_blocks_are_valid(block: Block, clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = YAML(typ="safe").load(block.text)
    if block.not_run is None:
        write_modules(block.page, clone, monkeypatch)
        folder = clone / "runs" if block.page.name in TUTORIALS else clone
        check_yaml(block.text, values, folder, block.place)


def write_modules(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the first Python block of a page to the module files that the page names."""
    first = next(iter(with_language("python").get(page, [])), None)
    if first is not None and first.text.startswith('"""'):
        for named in re.findall(r"(\w+):\w+", page.read_text()):
            (folder / f"{named}.py").write_text(first.text)
        monkeypatch.syspath_prepend(folder)


def check_yaml(text: str, values: Mapping[str, Any], folder: Path, place: str) -> None:
    keys = set(values)
    file = folder / "block.yaml"
    if keys <= set(LaunchFile.model_fields):
        file.write_text(text if "nodes" in keys else f"{text}\nnodes: {{}}\n")
        spec = validate(LaunchFile, read_launch_file(file))
        check_nodes({name: one.model_dump() for name, one in spec.nodes.items()})
        if {"scene", "nodes"} <= keys:
            load_graph(file)
    elif "scene" in keys and keys <= set(Apparatus.model_fields):
        file.write_text(text)
        load_apparatus(str(file), load_scene(SCENE))
    elif keys <= set(Scene.model_fields):
        whole = load_values() | dict(values)
        YAML(typ="safe").dump(whole, file)
        load_scene(file)
    elif all(isinstance(one, dict) and "type" in one for one in values.values()):
        check_nodes(values)
    elif keys == {"source"}:
        find_parameters_type(node_class("camera")).model_validate(values)
    else:
        pytest.fail(f"{place}: neither a launch file, nor nodes, nor parts of a scene: {keys}")


def check_nodes(nodes: Mapping[str, Mapping[str, Any]]) -> None:
    for node in nodes.values():
        find_parameters_type(node_class(node["type"])).model_validate(node.get("parameters") or {})


# Shell


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each call in a block, without comments, sudo and variables."""
    for line in text.replace("\\\n", " ").splitlines():
        line = re.sub(r"^\w+\$ ", "", line)  # noqa: PLW2901  # a prompt of a console
        call: list[str] = []
        for word in [*shlex.split(line, comments=True), "&&"]:
            if word in ("&&", "|", ";"):
                if call:
                    yield call
                call = []
            elif call or not (word == "sudo" or re.fullmatch(r"[A-Z_]+=.*", word)):
                call.append(word)


def program(call: Sequence[str]) -> list[str]:
    """Return the call without sudo's `-u USER`."""
    while call[0] == "-u" or re.fullmatch(r"[A-Z_]+=.*", call[0]):
        call = call[2:] if call[0] == "-u" else call[1:]
    return list(call)


def check_call(
    call: Sequence[str], written: set[str], place: str, *, may_name_only: bool = False
) -> None:
    """Check that a call can be parsed.

    written: files that calls of the page have written.
    may_name_only: whether the call may be the name of a command without arguments.
    """
    match program(call):
        case ["flexsheet" | "/opt/flexsheet/.venv/bin/flexsheet", *rest]:
            try:
                parse(shlex.join(["flexsheet", *(word for word in rest if word not in AT_ONCE)]))
            except Exception as error:
                if not (may_name_only and type(error).__name__ in LACKS_SOMETHING):
                    pytest.fail(f"{place}: {shlex.join(call)}: {error}")
            for word in rest:
                if re.fullmatch(r"launch/.*\.yaml", word) and word not in written:
                    assert (ROOT / word).exists(), f"{place}: there is no {word}"
        case ["make", *rest]:
            goals = [word for word in rest if "=" not in word]
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert set(goals) <= set(targets), f"{place}: there is no `make {' '.join(goals)}`"
        case ["python", "-m", module, *_]:
            assert importlib.util.find_spec(module), f"{place}: there is no module {module}"
        case ["pytest", *rest]:
            for word in rest:
                assert word.startswith("-") or (ROOT / word).exists(), f"{place}: no {word}"
        case ["cp", _, to]:
            written.add(to)
        case [other, *_]:
            assert other in OTHERS, f"{place}: {other} is no program that pages call"


@pytest.mark.parametrize("page", with_language(*SHELLS), ids=name)
def test_each_call_in_a_block_can_be_made(page: Path) -> None:
    (ROOT / "runs").mkdir(exist_ok=True)  # The first commands of the tutorials create it.
    written: set[str] = set()
    for block in with_language(*SHELLS)[page]:
        for call in commands(block.text):
            check_call(call, written, block.place)


@pytest.mark.parametrize("page", TUTORIALS)
def test_tutorials_write_only_into_the_folder_that_git_ignores(page: str) -> None:
    assert "runs/" in (ROOT / ".gitignore").read_text().splitlines()
    calls = [" ".join(call) for block in blocks(DOCS / page) for call in calls_of(block)]
    texts = [*calls, *(span for _, span in code_spans(DOCS / page))]
    for file in re.findall(r"[\w./-]+\.(?:csv|html|mcap|png|py|svg|yaml)\b", " ".join(texts)):
        assert file.startswith("runs/") or (ROOT / file).is_file(), f"{page}: save runs/{file}"


@pytest.mark.parametrize("page", pages(), ids=name)
def test_each_call_within_the_text_can_be_made(page: Path) -> None:
    """Only complete calls are tested: without dots, bars and brackets."""
    written = {word for those in BLOCKS[page] for call in calls_of(those) for word in call}
    check_calls_within_text(page, written)


def check_calls_within_text(page: Path, written: set[str]) -> None:
    for line, span in code_spans(page):
        first = span.split(maxsplit=1)[0] if span.split() else ""
        if first in OURS and " " in span and not re.search(r"\.\.\.|…| \| |\[", span):
            for call in commands(span):
                check_call(call, written, f"{name(page)}:{line}", may_name_only=True)


def test_each_call_of_the_generated_tables_can_be_made() -> None:
    for page in site_pages():
        built = as_built(page)
        if built.read_text() != page.read_text():
            check_calls_within_text(built, set())


def calls_of(block: Block) -> Iterator[list[str]]:
    return commands(block.text) if block.language in SHELLS else iter(())


def cheap_calls() -> list[str]:
    calls = {
        shlex.join(program(call))
        for those in with_language("bash").values()
        for block in those
        if block.not_run is None
        for call in commands(block.text)
    }
    dry = {call for call in calls if call.startswith("flexsheet launch ") and "--dry-run" in call}
    return sorted({call for call in calls if call.startswith(CHEAP)} | dry)


@pytest.mark.parametrize("call", cheap_calls())
def test_what_is_cheap_runs(call: str, clone: Path) -> None:
    result = CliRunner().invoke(cli.app, shlex.split(call)[1:])
    assert result.exit_code == 0, f"{call}: {result.output} {result.exception}"
