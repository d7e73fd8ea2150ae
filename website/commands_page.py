"""Generate the reference of the command line: all commands with arguments, options and examples."""

from __future__ import annotations

import inspect
from typing import Any

from flexsheet.launch.commands.man import list_commands
from flexsheet.launch.commands.output import examples_in


def render() -> str:
    """Return a list of links, and a section for each command."""
    by_name = dict(list_commands())
    links = "\n".join(f"- [`flexsheet {name}`](#flexsheet-{anchor(name)})" for name in by_name)
    return "\n".join([links + "\n", *(_section(name, one) for name, one in by_name.items())])


def anchor(name: str) -> str:
    return name.replace(" ", "-")


def _section(name: str, command: Any) -> str:
    calls = "\n".join(examples_in(command.epilog))
    rows = [
        f"| {_name(parameter)} | {_description(parameter)} |"
        for parameter in command.params
        if "completion" not in parameter.name and not getattr(parameter, "hidden", False)
    ]
    table = "\n".join(["| argument or option | what |", "| --- | --- |", *rows])
    text = inspect.cleandoc(command.help or "")
    return f"## flexsheet {name}\n\n{text}\n\n```sh\n{calls}\n```\n\n{table}\n"


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
