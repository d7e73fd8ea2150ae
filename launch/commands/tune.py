"""`flexsheet tune`: choose the fastest methods that meet the tolerances of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands.options import JsonOption, SceneArgument, make_app, output_file
from flexsheet.launch.commands.output import (
    NOT_GOOD,
    CommandError,
    examples,
    logs_on_stderr,
    print_json,
    print_table,
    progress_words,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.methods.tune import Choice

app = make_app()


@app.command(
    epilog=examples(
        "flexsheet tune launch/scenes/light-touch.yaml --dry-run",
        "flexsheet tune my-scene.yaml --family correction --family soft-body",
        "flexsheet tune my-scene.yaml --output tuned.yaml --json",
    )
)
def tune(
    scene_file: SceneArgument,
    *,
    family: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Method family to tune; repeat the option for several families; default: all.",
        ),
    ] = None,
    output: Annotated[
        Path | None, output_file("Scene file to write; default: change SCENE itself.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the choices without writing a file.")
    ] = False,
    margin: Annotated[
        float,
        typer.Option(
            min=0.0, max=0.9, help="Fraction of each tolerance that is reserved as a margin."
        ),
    ] = 0.2,
    runs: Annotated[
        int,
        typer.Option(
            min=0,
            max=100,
            help="Number of simulated strokes with which each configuration is tested in the "
            "graph; 0: choose the method of each family separately, without a graph.",
        ),
    ] = 3,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--runs-folder",
            metavar="FOLDER",
            help="Folder for the test runs; an interrupted command continues with the same folder.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Choose the fastest methods that meet the tolerances of a scene, and write them to the scene.

    The command measures each method family on this computer over the working range of the scene.
    This takes seconds to minutes. Then the command predicts the errors of combined methods, and
    tests the fastest promising configuration in a graph. A configuration is accepted if it meets
    all tolerances, including the tolerances of latency and force. If --family is given, the command
    chooses methods only for these families, and treats each family separately. Nodes use the chosen
    method if their parameter is `auto`. The exit code is 3 if a tolerance is not met.
    """
    logs_on_stderr()
    from flexsheet.launch.methods import charts, tune
    from flexsheet.launch.methods.results import describe_load, machine_name, replace_non_finite
    from flexsheet.launch.plans.plan import load_scene

    scene = load_scene(scene_file)
    try:
        tunables = tune.find_tunables(family or [], scene)
    except tune.UnknownTunableError as error:
        raise CommandError(f"--family: {error}") from None
    target = None if dry_run else output or scene_file
    if target is not None:
        tune.check_target(scene_file, target)  # fail before the long measurement
    if busy := describe_load():
        words.print(busy, style="yellow")
    then = ", and then combined methods in a graph" if runs and not family else ""
    words.print(
        f"measuring {len(tunables)} method families{then}, which takes several minutes; the result "
        "is written at the end"
    )
    with progress_words() as progress:
        choices = tune.tune(scene, tunables, margin=margin, progress=progress)
        composition = None
        if runs and not family:
            from flexsheet.launch.experiments.run import new_folder
            from flexsheet.launch.methods.tune_system import tune_system

            composition, choices = tune_system(
                scene_file,
                choices,
                folder or new_folder("tune"),
                progress,
                margin=margin,
                runs=runs,
            )
    for choice in choices:
        words.print(choice.explain())
    for line in composition.explain() if composition is not None else ():
        words.print(line)
    met = all(choice.met for choice in choices) if composition is None else composition.accepted
    if as_json:
        report = {
            "scene": scene.name,
            "file": None if target is None else str(target),
            "machine": machine_name(),
            "commit": charts.git_commit(),
            "margin": margin,
            "met": met,
            "families": [choice.report() for choice in choices],
            "system": None if composition is None else composition.report(),
        }
        print_json(replace_non_finite(report))
    else:
        _print_choices(choices)
    if target is not None:
        unmet = "" if composition is None else composition.unmet
        tune.write_choices(scene_file, target, choices, unmet)
    words.print("no file written (--dry-run)" if target is None else f"written: {target}")
    if not met:
        raise typer.Exit(NOT_GOOD)


def _print_choices(choices: Sequence[Choice]) -> None:
    from flexsheet.launch.methods.charts import format_duration

    rows = [
        (
            choice.family,
            choice.chosen.method,
            format_duration(choice.chosen.median_s),
            format_duration(choice.chosen.slowest_s),
            f"{choice.chosen.error:.3g}",
            f"{choice.tolerance:.3g} {choice.unit}",
            f"{100 * choice.spare_ratio:.0f} %" if choice.chosen.meets else "-",
            ""
            if choice.met
            else f"outside in {choice.chosen.missed} of {choice.chosen.cases} cases",
        )
        for choice in choices
    ]
    columns = ("family", "method", "median", "maximum", "error", "tolerance", "margin", "")
    print_table(columns, rows)
