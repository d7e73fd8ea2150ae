"""What is worked out before a graph starts, so that no node has to do without it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from launch.plan import Plan
from messages.scene import Scene
from nodes.models.sheet.membrane import NoEquilibriumError
from nodes.renderer import dent_cache

Progress = Callable[[str], None]

TOLD_SHARE = 0.25
"""Progress is told in such steps."""


def prepare_plan(plan: Plan, progress: Progress) -> None:
    """The dent shapes of the plan's scene, for each of its renderers."""
    scene = plan.scene_message()
    if scene is None:
        return
    for node in plan.nodes.values():
        if node.type == "renderer":
            prepare_dents(scene, node.parameters["cache_dir"], progress)


def prepare_dents(scene: Scene, cache_dir: Path | str | None, progress: Progress) -> Path:
    """The file with the dent shapes of a scene's sheet, worked out if it is not there.

    Where the membrane finds no equilibrium that is said, and the renderer does with four triangles.
    """
    folder = None if cache_dir is None else Path(cache_dir)
    told = 0.0

    def solved(done: int, total: int) -> None:
        nonlocal told
        if done / total >= told:
            progress(f"working out how the sheet dents: {100 * done // total} %")
            told += TOLD_SHARE

    try:
        dent_cache.load_or_solve(scene, folder, solved)
    except NoEquilibriumError as error:
        progress(f"no dent shapes for this sheet: {error}")
    return dent_cache.file_of(scene, folder)
