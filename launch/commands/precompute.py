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
        "flexsheet precompute launch/scenes/cylinder.yaml --complete-table",
    )
)
def precompute(
    scene_file: SceneArgument,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Cache folder; default: the cache of this user."),
    ] = None,
    complete_table: Annotated[
        bool,
        typer.Option(
            "--complete-table",
            help="Also compute the complete nonlinear table of the soft body, which takes up to an "
            "hour. It is more accurate, and reaches deeper, than the coarse table that is computed "
            "otherwise.",
        ),
    ] = False,
    scheduler: SchedulerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the tables that a graph with a scene needs, so that its first start is faster.

    These are the deflection shapes of the sheet, with which the renderer draws a pushed sheet, and
    the table of the soft body. If the object has a material, the table of the sheet's force is also
    computed. Without this command, the graph computes all but the force table before it starts.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.running.precompute import (
        NoSoftBodyError,
        precompute_deflection_shapes,
        precompute_force_table,
        precompute_soft_body,
    )
    from flexsheet.nodes.fem_solver.soft_body_factory import choose_method
    from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds

    if scheduler is not None and not complete_table:
        raise typer.BadParameter(
            "this option distributes the complete table only; add --complete-table",
            param_hint="--scheduler",
        )
    scene = load_scene(scene_file)
    with progress_words() as progress:
        files = {"deflection_shapes": precompute_deflection_shapes(scene, cache, progress)}
        load_or_compute_bounds(scene.camera.rate_hz, cache, progress)
        if scene.object.material is not None:
            files["force_table"] = precompute_force_table(scene, cache, progress)
            try:
                files["soft_body"] = precompute_soft_body(
                    scene,
                    choose_method(scene),
                    cache,
                    progress,
                    complete_table=complete_table,
                    scheduler=scheduler,
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
