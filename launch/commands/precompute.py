"""`flexsheet precompute`: works out beforehand what a scene's nodes keep in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import JsonOption
from flexsheet.launch.commands.output import (
    BAD_INPUT,
    CommandError,
    examples,
    print_json,
    progress_words,
    words,
)

app = typer.Typer(add_completion=False)


@app.command(
    epilog=examples(
        "flexsheet precompute launch/scenes/cylinder.yaml",
        "flexsheet precompute launch/scenes/cylinder.yaml --skin-spacing 0.005",
    )
)
def precompute(
    scene_file: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help="Scene file.", autocompletion=complete.yaml_files),
    ],
    cache: Annotated[
        Path | None,
        typer.Option("--cache", metavar="FOLDER", help="Where to keep it; default: the user's."),
    ] = None,
    skin_spacing_m: Annotated[
        float | None,
        typer.Option(
            "--skin-spacing",
            metavar="METRES",
            help="Make the nonlinear table, too, of a soft body of this skin_spacing_m: minutes.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A dask.distributed scheduler, such as tcp://host:8786, whose workers make the "
            "table; default: this machine's processors.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Work out how a scene's sheet dents, once; experiments and the demo do so by themselves.

    Of a scene whose methods say sheet_force: table, that table as well: a minute or two.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.running.precompute import (
        NoSoftBodyError,
        precompute_deflection_shapes,
        precompute_force_table,
        precompute_soft_body,
    )

    if scheduler is not None and skin_spacing_m is None:
        raise typer.BadParameter("is for the table of --skin-spacing", param_hint="--scheduler")
    scene = load_scene(scene_file)
    with progress_words() as progress:
        files = {"deflection_shapes": precompute_deflection_shapes(scene, cache, progress)}
        if scene.methods.sheet_force == "table":
            files["force_table"] = precompute_force_table(scene, cache, progress)
        if skin_spacing_m is not None:
            try:
                files["soft_body"] = precompute_soft_body(
                    scene, skin_spacing_m, cache, scheduler, progress
                )
            except NoSoftBodyError as error:
                raise CommandError(f"no soft body of {scene_file}: {error}", BAD_INPUT) from error
    if as_json:
        print_json({name: str(file) for name, file in files.items()})
        return
    for name, file in files.items():
        words.print(f"{name.replace('_', ' ')}: {file}", markup=False)
