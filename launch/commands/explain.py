"""`flexsheet explain`: what an error message means, and what to do."""

from __future__ import annotations

from typing import Annotated

import typer

from flexsheet.launch.commands.graph import JsonOption
from flexsheet.launch.commands.output import CommandError, examples, print_fields, print_json

app = typer.Typer(add_completion=False)

SHOWN = 3


@app.command(
    epilog=examples(
        "flexsheet explain 'no graph is running; start one with: flexsheet launch FILE'",
        "flexsheet explain saturated --json",
    )
)
def explain(
    message: Annotated[
        str,
        typer.Argument(
            help="As it was said, or 8 letters of it; a kind, as BagError; a fingertip's reason."
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Say what an error message means and what to do; all of them are in docs/errors.md."""
    from flexsheet.launch.reference.errors import explained

    found = explained(message)[:SHOWN]
    if as_json:
        print_json(found)
    for number, one in enumerate(() if as_json else found):
        if number:
            print()
        print_fields(one.items())
    if not found:
        raise CommandError(
            f'"{message}" is no message that is known; give more of it, or look into docs/errors.md'
        )
