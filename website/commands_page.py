"""Generate the reference of all commands, and the tables of notes of nodes."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from typer.main import get_command

from flexsheet.launch.cli import app
from flexsheet.launch.commands.output import examples_in
from flexsheet.messages.notes import (
    FINGERTIP_REMEDIES,
    NOTE_REMEDIES,
    SELF_CHECK_FINDINGS,
    SELF_CHECK_REMEDIES,
)
from website.messages_page import format_table


def render() -> str:
    """Return a list of links, and a section for each command."""
    by_name = dict(list_commands())
    links = "\n".join(
        f"- [`flexsheet {name}`](#flexsheet-{name.replace(' ', '-')})" for name in by_name
    )
    return "\n".join([links + "\n", *(_section(name, one) for name, one in by_name.items())])


def list_commands(group: Any = None, prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the full name and the object of all commands."""
    commands: Any = get_command(app) if group is None else group
    for name, command in commands.commands.items():
        path = (*prefix, name)
        if not hasattr(command, "commands") or command.invoke_without_command:
            yield " ".join(path), command
        if hasattr(command, "commands"):
            yield from list_commands(command, path)


def _section(name: str, command: Any) -> str:
    calls = "\n".join(examples_in(command.epilog))
    rows = [
        (_name(parameter), _description(parameter))
        for parameter in command.params
        if "completion" not in parameter.name and not getattr(parameter, "hidden", False)
    ]
    table = format_table(("argument or option", "what"), rows)
    text = inspect.cleandoc(command.help or "")
    return f"## flexsheet {name}\n\n{text}\n\n```sh\n{calls}\n```\n\n{table}"


def _name(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{(parameter.metavar or parameter.name).upper()}`"
    options = ", ".join([*parameter.opts, *parameter.secondary_opts])
    metavar = f" {parameter.metavar}" if parameter.metavar else ""
    return f"`{options}{metavar}`"


def _description(parameter: Any) -> str:
    text = (parameter.help or "").replace("|", r"\|")
    if parameter.required:
        return f"{text} Required."
    if parameter.default in (None, False, "") or callable(parameter.default):
        return text
    # The path of a file of the package differs between computers.
    default = str(parameter.default)
    if "/launch/" in default:
        default = "launch/" + default.rpartition("/launch/")[2]
    return f"{text} Default: `{default}`."


def render_errors() -> str:
    """Return the tables of notes, reasons and causes."""
    short = "what to do"
    notes = [(f"`{code}`", remedy) for code, remedy in NOTE_REMEDIES.items()]
    reasons = [(f"`{reason}`", remedy) for reason, remedy in FINGERTIP_REMEDIES.items()]
    causes = [
        (f"`{cause}`", finding, SELF_CHECK_REMEDIES[cause])
        for cause, finding in SELF_CHECK_FINDINGS.items()
    ]
    return "\n".join(
        [
            "## Notes of nodes\n",
            format_table(("code", short), notes),
            "## Reasons of an invalid fingertip\n",
            format_table(("`reason`", short), reasons),
            "## Causes that self-checks suspect\n",
            format_table(("`cause`", "meaning", short), causes),
        ]
    )
