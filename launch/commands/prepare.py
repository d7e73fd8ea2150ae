"""`flexsheet prepare`: works out beforehand what a scene's nodes keep in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from launch.commands.output import progress_words, words


def prepare(
    scene_file: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file.")],
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
) -> None:
    """Work out how a scene's sheet dents, once; experiments and the demo do so by themselves."""
    from launch.plan import load_scene
    from launch.prepare import prepare_dents, prepare_soft_body

    if scheduler is not None and skin_spacing_m is None:
        raise typer.BadParameter("is for the table of --skin-spacing", param_hint="--scheduler")
    scene = load_scene(scene_file)
    with progress_words() as progress:
        path = prepare_dents(scene, cache, progress)
        words.print(f"dent shapes: {path}")
        if skin_spacing_m is not None:
            path = prepare_soft_body(scene, skin_spacing_m, cache, scheduler, progress)
            words.print(f"soft body: {path}")
