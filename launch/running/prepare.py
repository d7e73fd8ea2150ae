"""What is worked out before a graph starts, so that no node has to do without it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from launch.plans.planned import Plan
from messages.methods import SheetShapeMethod, chosen
from messages.scene import Scene
from nodes.cache import default_cache_dir
from nodes.models.sheet.membrane import NoEquilibriumError
from nodes.renderer import deflection_cache

Progress = Callable[[str], None]

TOLD_SHARE = 0.1
"""Progress is told in such steps."""


class NoSoftBodyError(RuntimeError):
    """A scene whose soft body cannot be made; the text says why, and a remedy."""


def prepare_plan(plan: Plan, progress: Progress) -> None:
    """The dent shapes of the plan's scene, for each of its renderers."""
    scene = plan.scene_message()
    if scene is None:
        return
    for node in plan.nodes.values():
        if node.type == "renderer" and _takes_dents(scene, node.parameters["sheet_shape"]):
            prepare_dents(scene, node.parameters["cache_dir"], progress)


def _takes_dents(scene: Scene, requested: SheetShapeMethod | Literal["auto"]) -> bool:
    """Whether a renderer takes a pushed sheet for what the membrane makes of it."""
    shape: SheetShapeMethod = chosen(requested, scene.methods.sheet_shape, "reduced_order")
    return shape == "reduced_order"


def prepare_dents(scene: Scene, cache_dir: Path | str | None, progress: Progress) -> Path:
    """The file with the dent shapes of a scene's sheet, worked out if it is not there.

    Where the membrane finds no equilibrium that is said, and the renderer does with four triangles.
    """
    folder = None if cache_dir is None else Path(cache_dir)
    try:
        on_progress = _with_time_left("working out how the sheet dents, once", progress)
        deflection_cache.load_or_compute(scene, folder, on_progress)
    except NoEquilibriumError as error:
        progress(f"no dent shapes for this sheet: {error}")
    return deflection_cache.shapes_cache(scene).path(folder)


def _with_time_left(what: str, progress: Progress) -> Callable[[int, int], None]:
    """Says how far (done, total) is and what is left, in steps."""
    from nodes.cache import EtaEstimator

    remaining, next_share = EtaEstimator(), 0.0

    def on_progress(done: int, total: int) -> None:
        nonlocal next_share
        far = remaining.text(done, total, time.monotonic())
        if done >= next_share * total:
            progress(f"{what}: {far}")
            next_share = done / total + TOLD_SHARE

    return on_progress


def prepare_force_table(scene: Scene, cache_dir: Path | None, progress: Progress) -> Path:
    """The file with the table of a scene's sheet's force, made if it is not there.

    NoEquilibriumError for a sheet of which the membrane finds none.
    """
    from nodes.planner import force_table

    on_progress = _with_time_left("working out how the sheet pushes back, once", progress)
    force_table.load_or_compute(scene, cache_dir, on_progress)
    return force_table.table_cache(scene).path(cache_dir)


def prepare_soft_body(
    scene: Scene,
    skin_spacing_m: float,
    cache_dir: Path | None,
    scheduler: str | None,
    progress: Progress,
) -> Path:
    """The file with the nonlinear table of a scene's soft body, made if it is not there.

    scheduler: as the fem_solver node's parameter.  NoSoftBodyError where that is of no use, the
    body cannot be meshed, or memory is too little for it.
    """
    from nodes.cache import EtaEstimator
    from nodes.fem_solver import body, precompute_table
    from nodes.fem_solver.precompute import WorkBudget
    from nodes.fem_solver.soft_body_factory import SoftBodyFactory

    folder = cache_dir or default_cache_dir()
    remaining, reported_percent = EtaEstimator(), -1

    def made(done: int, total: int, need: WorkBudget) -> None:
        nonlocal reported_percent
        far = remaining.text(done, total, time.monotonic())
        if 100 * done // total != reported_percent:
            progress(f"making the soft body: {far} ({need.text()})")
            reported_percent = 100 * done // total

    maker = SoftBodyFactory(skin_spacing_m=skin_spacing_m, cache_dir=folder, scheduler=scheduler)
    try:
        bodies = maker.bodies(scene, "auto", made)
        if len(bodies) == 1:
            maker.build_table(scene, bodies[0], made)
    except (ValueError, MemoryError, precompute_table.WorkersError) as error:
        raise NoSoftBodyError(str(error)) from error
    spec = body.make_table_spec(scene, bodies[0].spec)
    return precompute_table.table_cache(spec).path(folder)
