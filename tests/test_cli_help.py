"""Every command: its help has examples that parse, it can print JSON, it completes."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command

from launch import cli
from launch.commands.output import examples_in


def commands(group: Any = None, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """All commands that do something, by what is typed."""
    group = group or get_command(cli.app)
    for name, command in group.commands.items():
        path = (*words, name)
        if hasattr(command, "commands"):
            if command.invoke_without_command:
                yield " ".join(path), command
            yield from commands(command, path)
        else:
            yield " ".join(path), command


COMMANDS = dict(commands())


def parse(line: str) -> str:
    """Parse a line as the command line would, run nothing; the command that it calls."""
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
        "launch", "node list", "node describe", "topic list", "topic info", "topic echo",
        "topic hz", "topic pub", "bag record", "bag play", "bag info", "bag recover", "bag export",
        "bag verify", "experiment stroke", "experiment tilt", "experiment push", "chart",
        "calibrate stereo", "calibrate check", "calibrate projector", "calibrate arms",
        "calibrate sheet", "keys new", "doctor",
    }  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_explains_itself_with_examples_that_parse(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    lines = examples_in(command.epilog)
    assert lines, f"flexsheet {name}: no example"
    for line in lines:
        assert parse(line) == name, f"an example of {name} calls another command: {line}"
    for parameter in command.params:
        assert parameter.help, f"flexsheet {name}: {parameter.name} is not explained"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_can_print_json_and_only_the_first_one_installs_completion(name: str) -> None:
    options = {option for parameter in COMMANDS[name].params for option in parameter.opts}
    assert "--json" in options
    assert "--install-completion" not in options
