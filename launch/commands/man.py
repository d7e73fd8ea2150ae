"""`flexsheet man`: print the manual page, generated from the help of all commands."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

from flexsheet.launch.commands.options import JsonOption, make_app
from flexsheet.launch.commands.output import examples, examples_in, print_json

app = make_app()

ENVIRONMENT = {
    "FLEXSHEET_KEYS": "folder of the secret keys of this computer",
    "FLEXSHEET_RUNS": "folder of the run directories; default: /tmp/flexsheet-UID",
    "FLEXSHEET_STATE": "folder in which engaged e-stops are stored",
    "NO_COLOR": "if set, output has no colours",
}
EXIT_CODES = {
    "0": "success",
    "1": "failure; `flexsheet explain CODE` prints meaning and remedy",
    "2": "invalid input",
    "3": "a replay that differs from the recording, or `tune` without a sufficient method",
}


@app.command(epilog=examples("flexsheet man", "flexsheet man --json"))
def man(as_json: JsonOption = False) -> None:
    """Print the manual page in roff format; to read it, run `flexsheet man | man -l -`."""
    text = render()
    if as_json:
        print_json({"name": "flexsheet.1", "text": text})
    else:
        print(text, end="")


def list_commands(group: Any = None, prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the full name and the object of all commands, except hidden aliases."""
    from typer.main import get_command

    from flexsheet.launch.cli import app as all_commands

    group = group or get_command(all_commands)
    for name, command in group.commands.items():
        path = (*prefix, name)
        if command.hidden:
            continue
        if not hasattr(command, "commands"):
            yield " ".join(path), command
            continue
        if command.invoke_without_command:
            yield " ".join(path), command
        yield from list_commands(command, path)


def render() -> str:
    """Return the manual page of all commands in roff format, with the macros of man(7)."""
    from importlib.metadata import version

    lines = [
        f'.TH FLEXSHEET 1 "" "flexsheet {version("flexsheet")}" "User Commands"',
        ".SH NAME",
        r"flexsheet \- control an encountered-type visual-haptic display with a flexible sheet",
        ".SH SYNOPSIS",
        r".B flexsheet",
        r"\fICOMMAND\fR [\fIOPTION\fR]...",
        ".SH COMMANDS",
    ]
    for name, command in list_commands():
        lines += _format_command(name, command)
    for title, rows in (("EXIT STATUS", EXIT_CODES), ("ENVIRONMENT", ENVIRONMENT)):
        lines.append(f".SH {title}")
        for key, text in rows.items():
            lines += [".TP", rf"\fB{_escape(key)}\fR", _escape(text)]
    return "\n".join(lines) + "\n"


def _format_command(name: str, command: Any) -> Iterator[str]:
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    shown = " ".join(
        rf"\fI{_escape(one.metavar)}\fR" for one in arguments if not getattr(one, "hidden", False)
    )
    title = f"flexsheet {_escape(name)} {shown}".rstrip()
    yield f'.SS "{title}"'
    for number, paragraph in enumerate(inspect.cleandoc(command.help or "").split("\n\n")):
        if number:
            yield ".PP"
        yield _escape(" ".join(paragraph.split()))
    for parameter in command.params:
        if getattr(parameter, "hidden", False):
            continue
        names = ", ".join(
            rf"\fB{_escape(one)}\fR" for one in (*parameter.opts, *parameter.secondary_opts)
        )
        value = rf"\fI{_escape(parameter.metavar)}\fR" if parameter.metavar else ""
        is_argument = parameter.param_type_name == "argument"
        yield from (".TP", value if is_argument else f"{names} {value}".rstrip())
        yield _escape(" ".join((parameter.help or "").split()))
    yield from (".PP", "Examples:", ".nf")
    yield from (rf"\&    {_escape(line)}" for line in examples_in(command.epilog))
    yield ".fi"


def _escape(text: str) -> str:
    """Remove markup from a text, and escape the characters that have a special meaning in roff.

    These are backslashes, hyphens, and dots or apostrophes at the start of a line.
    """
    plain = re.sub(r"\[/?(?:bold|dim|italic)?\]", "", text)
    escaped = plain.replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{escaped}" if escaped[:1] in (".", "'") else escaped
