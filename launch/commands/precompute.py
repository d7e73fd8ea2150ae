"""`flexsheet precompute`: compute the tables of a scene, so that a graph starts faster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import JsonOption, SceneArgument, SchedulerOption, make_app
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    progress_words,
    words,
)

app = make_app()


@app.command(
    epilog=examples(
        "flexsheet precompute launch/scenes/cylinder.yaml",
        "flexsheet precompute launch/scenes/cylinder.yaml --skin-spacing 0.005",
    )
)
def precompute(
    scene_file: SceneArgument,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Cache folder; default: the cache of this user."),
    ] = None,
    skin_spacing_m: Annotated[
        float | None,
        typer.Option(
            "--skin-spacing",
            metavar="METRES",
            help="Also compute the nonlinear table of the soft body, with this spacing of surface "
            "nodes, m; the computation takes minutes.",
        ),
    ] = None,
    scheduler: SchedulerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the deflection shapes of a scene's sheet if the cache does not contain them.

    The renderer draws a pushed sheet with these shapes. If the object has a material, the table of
    the sheet's force is also computed, which takes about two minutes. The package contains the
    table for the sheet of the shipped scenes. Experiments and the demo compute missing shapes
    automatically.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.running.precompute import (
        NoSoftBodyError,
        precompute_deflection_shapes,
        precompute_force_table,
        precompute_soft_body,
    )
    from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds

    if scheduler is not None and skin_spacing_m is None:
        raise typer.BadParameter(
            "this option distributes the nonlinear table only; add --skin-spacing to select it",
            param_hint="--scheduler",
        )
    scene = load_scene(scene_file)
    with progress_words() as progress:
        files = {"deflection_shapes": precompute_deflection_shapes(scene, cache, progress)}
        load_or_compute_bounds(scene.camera.rate_hz, cache, progress)
        if scene.object.material is not None:
            files["force_table"] = precompute_force_table(scene, cache, progress)
        if skin_spacing_m is not None:
            try:
                files["soft_body"] = precompute_soft_body(
                    scene, skin_spacing_m, cache, scheduler, progress
                )
            except NoSoftBodyError as error:
                raise CommandError(
                    f"{scene_file}: the soft body cannot be computed: {error}"
                ) from error
    if as_json:
        print_json({name: str(file) for name, file in files.items()})
        return
    for name, file in files.items():
        words.print(f"{name.replace('_', ' ')}: {file}")
