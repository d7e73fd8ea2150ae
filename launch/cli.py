"""Define the entry point of the `flexsheet` command.

The table `COMMANDS` lists all subcommands. A subcommand is imported when it is called, because
importing all of them takes long.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from flexsheet.launch.commands.options import name_values
from flexsheet.launch.commands.output import FAILED, examples, words
from flexsheet.messages.errors import FlexsheetError, describe_error, find_missing_extra
from flexsheet.messages.files import DISK_ERRORS, make_write_error

COMMANDS: dict[str, tuple[str, ...]] = {
    "launch": ("launching",),
    "stop": ("session:stop_app",),
    "status": ("session:status_app",),
    "logs": ("session:logs_app",),
    "view": ("view",),
    "node": ("node",),
    "param": ("param",),
    "topic": ("topic",),
    "bag": ("bag",),
    "ros2-bridge": ("ros2_bridge",),
    "arms": ("arms",),
    "experiment": ("experiment",),
    "apparatus": ("apparatus",),
    "scene": ("scene",),
    "demo": ("demo",),
    "chart": ("chart",),
    "tune": ("tune",),
    "calibrate": (
        "calibrate",
        "calibrate_arms",
        "calibrate_projector",
        "calibrate_rows",
    ),
    "commission": ("commission",),
    "precompute": ("precompute",),
    "keys": ("keys",),
    "doctor": ("doctor",),
}
"""The modules of each command in `flexsheet.launch.commands`, in the order of `--help`.

The first module defines the typer app. The app is the variable `app` of this module, or the
variable that is named after the colon. The other modules add commands to the app when they are
imported.
"""


@cache
def load_command(name: str) -> Any:
    """Import the modules of a command in `COMMANDS`, and return the click command."""
    first, *further = COMMANDS[name]
    module, _, attribute = first.partition(":")
    app: typer.Typer = getattr(_import(module), attribute or "app")
    for other in further:
        _import(other)
    command = get_command(app)
    command.name = name
    name_values(command)
    return command


def _import(module: str) -> Any:
    return import_module(f"flexsheet.launch.commands.{module}")


INTERRUPTED_AT_ONCE = frozenset({"launch", "topic", "arms", "view"})
"""The commands that SIGINT ends without cleanup until their event loop handles SIGINT.

In all other commands, Python's signal handler raises KeyboardInterrupt, and the command cleans up.
"""


class CommandTable(Mapping[str, Any]):
    """A read-only table of commands by name; a command is imported when it is first used."""

    def __getitem__(self, name: str) -> Any:
        return load_command(name)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


class CommandGroup(TyperGroup):
    """A command group whose commands are imported when they are first used."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        name_values(self)
        self.commands = CommandTable()  # type: ignore[assignment]  # a read-only mapping

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name.

        Python's SIGINT handler is restored for commands that need it.
        """
        found = super().resolve_command(ctx, args)
        if found[0] not in INTERRUPTED_AT_ONCE:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return found


app = typer.Typer(
    name="flexsheet",
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    # Subcommands inherit these settings.
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples("flexsheet launch demo --browser", "flexsheet status", "flexsheet topic list"),
)


def _print_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"flexsheet {version('flexsheet')}")
        raise typer.Exit


@app.callback()
def flexsheet(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Control an encountered-type visual-haptic display with a flexible sheet."""


def main() -> None:
    """Run the command line; errors that the user can correct are printed without a traceback."""
    try:
        app(prog_name="flexsheet")
    except Exception as error:
        code = exit_code(error)
        if code is None:
            raise
        words.print(f"flexsheet: {error_text(error)}")
        sys.exit(code)


def error_text(error: Exception) -> str:
    """Return the text of an error with a remedy.

    If it is an error of the operating system, the path is added.
    """
    if isinstance(error, OSError) and not isinstance(error, FlexsheetError):
        error = make_write_error(Path(error.filename or "standard output"), error)
    return describe_error(error)


def exit_code(error: Exception) -> int | None:
    """Return the exit code for an error that the user can correct.

    Return None for any other error, because such an error is a bug in the program.
    """
    if isinstance(error, FlexsheetError):
        return error.exit_code
    is_disk_error = isinstance(error, OSError) and error.errno in DISK_ERRORS
    return FAILED if is_disk_error or find_missing_extra(error) else None
