"""The `flexsheet` command.  Subcommands live in `launch.commands`; this file only gathers them."""

from __future__ import annotations

import sys

import typer

from launch.commands import (
    arms,
    bag,
    calibrate,
    calibrate_arms,
    calibrate_projector,
    calibrate_sheet,
    chart,
    doctor,
    doctor_compliance,
    experiment,
    keys,
    launching,
    node,
    prepare,
    service,
    topic,
    trying,
)
from launch.commands.output import BAD_INPUT, FAILED, CommandError, words

app = typer.Typer(
    name="flexsheet",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="An encountered-type visual haptic display with a flexible sheet.",
)
app.command()(launching.launch)
app.command()(prepare.prepare)
app.add_typer(node.app, name="node")
app.add_typer(topic.app, name="topic")
app.add_typer(bag.app, name="bag")
app.add_typer(keys.app, name="keys")
app.add_typer(arms.app, name="arms")
app.add_typer(service.app, name="service")
calibrate_arms.register(calibrate.app)
calibrate_projector.register(calibrate.app)
calibrate_sheet.register(calibrate.app)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(experiment.app, name="experiment")
app.command()(experiment.demo)
app.command("try")(trying.try_it)
app.command()(chart.chart)
doctor_compliance.register(doctor.app)
app.add_typer(doctor.app, name="doctor")


def main() -> None:
    """Run the command line; what people can put right is said in a sentence, without a trace."""
    try:
        app()
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise
        words.print(f"flexsheet: {error}", markup=False)
        sys.exit(code)


def _exit_code(error: Exception) -> int | None:
    """The exit code of an error that is the user's to put right; None for an error of ours."""
    # Imported only now: a command that goes well should not wait for these.
    from launch.documents import BadInputError
    from launch.experiments import ExperimentError
    from launch.export import ExportError
    from launch.runs import RunDirectoryError
    from launch.supervisor import NodeFailedError
    from messages.bag import BagError
    from messages.bus import BusError
    from messages.security import SecurityError

    if isinstance(error, CommandError):
        return error.code
    if isinstance(error, BadInputError):
        return BAD_INPUT
    failures = (
        BusError
        | SecurityError
        | RunDirectoryError
        | BagError
        | ExperimentError
        | ExportError
        | NodeFailedError
    )
    if isinstance(error, failures):
        return FAILED
    return None
