"""`flexsheet tune`: name the fastest methods that meet the tolerances of a scene."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import JsonOption, SceneArgument, make_app, output_file
from flexsheet.launch.commands.output import (
    NOT_GOOD,
    examples,
    logs_on_stderr,
    print_json,
    progress_words,
    words,
)

app = make_app()


@app.command(
    epilog=examples(
        "flexsheet tune launch/scenes/light-touch.yaml",
        "flexsheet tune my-scene.yaml --family correction --family soft-body --json",
    )
)
def tune(
    scene_file: SceneArgument,
    *,
    family: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Method family to tune; repeat the option for several families; default: all "
            "families, and then a check of the whole system.",
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        output_file("Folder for the check of the system; default: a new folder.", "FOLDER"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Name the fastest methods that meet the tolerances of a scene.

    The command measures each method family on this computer over the working range of the scene.
    This takes minutes. Then the errors and latencies of the whole system with the chosen methods
    are measured once. The command prints the lines for the scene file. The exit code is 3 if a
    tolerance is not met.
    """
    logs_on_stderr()
    from flexsheet.launch.experiments.run import new_folder
    from flexsheet.launch.methods import tune
    from flexsheet.launch.methods.results import describe_load, machine_name, replace_non_finite
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.running.commit import read_commit

    scene = load_scene(scene_file)
    tunables = tune.find_tunables(family or [], scene)
    if busy := describe_load():
        words.print(busy, style="yellow")
    with progress_words() as progress:
        choices = tune.tune(scene, tunables, progress)
        system = None
        if not family:
            system = tune.check_system(
                scene_file, scene, choices, folder or new_folder("tune"), progress
            )
    failing = [] if system is None else system["failing"]
    met = not failing and all(choice.chosen.is_sufficient for choice in choices)
    lines = ["methods:", *(choice.line() for choice in choices)]
    if as_json:
        report = {
            "scene": scene.name,
            "machine": machine_name(),
            "commit": read_commit(),
            "met": met,
            "families": [asdict(choice) for choice in choices],
            "lines": lines,
            "system": system,
        }
        print_json(replace_non_finite(report))
    else:
        print("\n".join(lines))
    if failing:
        words.print(f"the whole system does not meet the tolerances of: {', '.join(failing)}")
    if not met:
        raise typer.Exit(NOT_GOOD)
