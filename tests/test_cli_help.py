"""Test every command: its help has valid examples, it can print JSON, it completes."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import pytest
import structlog
from typer.main import get_command
from typer.testing import CliRunner

from flexsheet.launch import cli
from flexsheet.launch.commands.output import (
    examples_in,
    logs_on_stderr,
    print_json,
    print_json_line,
)
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.bag import BagError
from tests.commands import Command
from website.commands_page import list_commands

ROOT = Path(__file__).resolve().parent.parent


COMMANDS = dict(list_commands())


def parse(line: str) -> str:
    """Parse a line as the command line does without running it; return its command."""
    program, *arguments = shlex.split(line.removeprefix("sudo "))
    assert program == "flexsheet"
    command, words = get_command(cli.app), [program]
    context = command.make_context(program, arguments)
    while getattr(command, "commands", None) and context._protected_args:
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        words.append(name)
        context = command.make_context(name, rest, parent=context)
    return " ".join(words[1:])


def test_the_command_line_is_this() -> None:
    assert set(COMMANDS) >= {
        "launch", "node list", "node info", "topic list", "topic info", "topic echo",
        "topic hz", "topic pub", "bag record", "bag play", "bag info", "bag export",
        "bag verify", "experiment stroke", "experiment tilt", "experiment push", "chart",
        "calibrate stereo", "calibrate check", "calibrate projector", "calibrate arms",
        "calibrate sheet", "keys", "doctor",
    }  # fmt: skip


def test_there_are_at_most_fifty_commands() -> None:
    assert len(COMMANDS) <= 50, sorted(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_explains_itself_with_examples_that_parse(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    lines = examples_in(command.epilog)
    assert lines, f"flexsheet {name}: no example"
    for line in lines:
        assert parse(line) == name, f"an example of {name} calls another command: {line}"
        words = shlex.split(line)
        settings = [value for key, value in pairwise(words) if key == "--set"]
        if settings:
            given = [Path(word) for word in words if word.endswith(".yaml")]
            load_graph(ROOT / given[0] if given else DEMO_FILE, settings=settings)
    for parameter in command.params:
        assert parameter.help, f"flexsheet {name}: {parameter.name} is not explained"


VALUE_NAME = re.compile(
    r"[A-Z][A-Z0-9_.=-]*([x|,: ][A-Z0-9_.]+|\|seed:N)*|[a-z]+(\|[a-z0-9]+)+|'X.*'"
)
"""Names in capitals; a choice is written as it is."""


@pytest.mark.parametrize("name", COMMANDS)
def test_the_options_of_a_command_are_shown_in_one_way(name: str) -> None:
    for parameter in COMMANDS[name].params:
        given = parameter.metavar
        if getattr(parameter, "is_flag", False):
            assert given == "", f"{name} {parameter.opts}: a flag has no value"
        else:
            assert VALUE_NAME.fullmatch(given), f"{name} {parameter.opts}: {given}"
        assert not str(parameter.default).startswith(str(ROOT)), f"{name} {parameter.opts}"
        assert ("--output" in parameter.opts) == ("-o" in parameter.opts), f"{name}: -o, --output"
        assert parameter.help.endswith((".", ")")), f"{name} {parameter.opts}: no sentence"
    assert COMMANDS[name].help.split("\n")[0].endswith("."), f"{name}: no sentence"


@pytest.mark.parametrize("words", [(), ("launch",), ("node", "list")])
def test_every_command_has_a_short_help_option(words: tuple[str, ...]) -> None:
    texts = [CliRunner().invoke(cli.app, [*words, option]).output for option in ("-h", "--help")]
    assert texts[0] == texts[1]
    assert "Usage" in texts[0]


def test_the_version_is_that_of_the_distribution() -> None:
    result = CliRunner().invoke(cli.app, ["--version"])
    assert result.exit_code == 0
    assert result.output == f"flexsheet {version('flexsheet')}\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_can_print_json_and_only_the_first_one_installs_completion(name: str) -> None:
    options = {option for parameter in COMMANDS[name].params for option in parameter.opts}
    assert "--json" in options
    assert "--install-completion" not in options


def test_json_has_no_nan_and_no_infinity(capsys: pytest.CaptureFixture[str]) -> None:
    data = {"a": [1.5, float("nan"), (float("-inf"),)], "b": "NaN"}
    for write in (print_json, print_json_line):
        write(data)
        assert json.loads(capsys.readouterr().out) == {"a": [1.5, None, [None]], "b": "NaN"}


def test_looking_into_a_graph_loads_little() -> None:
    """`topic echo` loads no YAML, linear algebra or supervisor before it subscribes."""
    code = (
        "import json, sys\n"
        "from flexsheet.launch import cli\n"
        "from flexsheet.launch.commands import topic\n"
        "from flexsheet.launch.running import tools\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True)
    heavy = {
        "cv2", "scipy", "matplotlib", "mcap", "moderngl", "pymodbus", "rich", "ruamel.yaml",
        "psutil", "flexsheet.launch.plans.plan", "flexsheet.launch.running.supervisor",
        "flexsheet.nodes.node", "structlog", "uvloop",
    }  # fmt: skip
    assert heavy & set(json.loads(done.stdout)) == set()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("flexsheet bag ver", "verify"),
        ("flexsheet topic echo --on", "--once"),
    ],
)
def test_the_shell_completes(
    words: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_FLEXSHEET_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit):
        cli.main()
    assert offered in capsys.readouterr().out.split()


BASH_COMPLETION = """
source <(flexsheet --show-completion bash)
read -r -a COMP_WORDS <<< "$1"
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
$(complete -p flexsheet | sed -E 's/.* -F ([^ ]+) .*/\\1/') flexsheet
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "offered"),
    [("flexsheet to", ["topic"]), ("flexsheet bag ver", ["verify"])],
)
def test_bash_runs_the_generated_completion_script(
    words: str, offered: list[str], tmp_path: Path
) -> None:
    """Bash reads the script and calls its function, as it does when the user presses Tab."""
    command = tmp_path / "flexsheet"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m flexsheet "$@"\n')
    command.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "--norc", "-c", BASH_COMPLETION, "bash", words], cwd=ROOT,
        env={**os.environ, "PATH": path}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == offered
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (["topc"], "topic"),
        (["bag", "verfy"], "verify"),
        (["topic", "echo", "x", "--onc"], "--once"),
    ],
)
def test_a_slip_is_answered_with_what_was_meant(
    arguments: list[str], printed: str, flexsheet: Command
) -> None:
    code, out, err = flexsheet(*arguments)
    assert (code, out) == (2, "")
    assert printed in err


def test_colours_are_for_terminals_and_no_color_disables_them() -> None:
    """The text is the same in a pseudo-terminal with NO_COLOR, without it, and in a pipe."""
    code = (
        "from flexsheet.launch.commands.output import words; words.print('[red]so[/]', markup=True)"
    )

    def printed(terminal: bool, **more: str) -> bytes:
        ours, theirs = os.openpty() if terminal else os.pipe()
        environment = {**os.environ, "TERM": "xterm", **more}
        environment.pop("NO_COLOR", None) if "NO_COLOR" not in more else None
        subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, stderr=theirs, env=environment, check=True
        )
        os.close(theirs)
        text = os.read(ours, 1000)
        os.close(ours)
        return text

    assert b"\x1b[31m" in printed(True)
    assert b"\x1b" not in printed(True, NO_COLOR="1")
    assert b"\x1b" not in printed(False)


def test_an_error_is_printed_with_its_remedy(tmp_path: Path, flexsheet: Command) -> None:
    bag = tmp_path / "no.mcap"
    bag.write_bytes(b"no bag")
    printed = flexsheet("bag", "info", bag)
    assert BagError.remedy in " ".join(printed.err.split())
    missing = flexsheet("bag", "info", tmp_path / "none.mcap")
    assert missing.err.rstrip().endswith("check the path")


def test_logs_go_to_the_stderr_of_their_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    before = structlog.get_config()
    first, second = io.StringIO(), io.StringIO()
    try:
        monkeypatch.setattr("sys.stderr", first)
        logs_on_stderr()
        first.close()
        monkeypatch.setattr("sys.stderr", second)
        structlog.get_logger().warning("kept")
    finally:
        structlog.configure(**before)
    assert "kept" in second.getvalue()
