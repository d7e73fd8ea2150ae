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
) -> None:
    """Work out how a scene's sheet dents, once; experiments and the demo do so by themselves."""
    from launch.plan import load_scene
    from launch.prepare import prepare_dents

    scene = load_scene(scene_file)
    with progress_words() as progress:
        path = prepare_dents(scene, cache, progress)
    words.print(f"dent shapes: {path}")
