"""Compute the tables that the nodes of a graph read from a cache, before the graph starts."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole, node_class
from flexsheet.nodes.cache import default_cache_dir
from flexsheet.nodes.models.sheet.membrane import NoEquilibriumError
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds
from flexsheet.nodes.renderer import deflection_cache

Progress = Callable[[str], None]

REPORT_STEP_RATIO = 0.1
"""The progress between two reports, as a fraction of the total work."""

REPORT_STEP_S = 20.0
"""The time (s) after which a report follows even if the progress is smaller."""


class NoSoftBodyError(FlexsheetError, RuntimeError):
    """Raised if the soft body (FEM model) of a scene cannot be computed."""


def precompute_graph(plan: ResolvedGraph, progress: Progress) -> None:
    """Compute the tables that the graph's planners and renderers need and that are not cached."""
    scene = plan.scene_message()
    if scene is None:
        return
    for node in plan.nodes.values():
        if issubclass(node_class(node.type), node_class("planner")):
            load_or_compute_bounds(scene.camera.rate_hz, node.parameters["cache_dir"], progress)
        if node.role is NodeRole.RENDERER:
            shape = node.parameters["sheet_shape"] or scene.methods.sheet_shape
            if shape == "reduced_order":
                precompute_deflection_shapes(scene, node.parameters["cache_dir"], progress)


def precompute_deflection_shapes(
    scene: Scene, cache_dir: Path | str | None, progress: Progress
) -> Path:
    """Return the file with the deflection shapes of a scene's sheet.

    The shapes are computed if the file does not exist.

    If the membrane model finds no equilibrium, the reason is reported and no file is written. The
    renderer then approximates the pushed sheet by four triangles.
    """
    folder = None if cache_dir is None else Path(cache_dir)
    try:
        on_progress = report_time_left(
            "computing the deflection shapes of the sheet (only once, then the command continues)",
            progress,
        )
        deflection_cache.load_or_compute(scene, folder, on_progress)
    except NoEquilibriumError as error:
        progress(f"the deflection shapes of this sheet cannot be computed: {error}")
    _, stored = deflection_cache.list_stored(scene)[0]
    return deflection_cache.shapes_cache(stored).path(folder)


def report_time_left(what: str, progress: Progress) -> Callable[[int, int], None]:
    """Return a function (done, total) that reports the progress and the remaining time.

    The function reports in steps of 10 % of the total work, or after 20 s. If `total` changes, or
    `done` decreases, the reports start again.

    what: name of the computation in the reports.
    """
    from flexsheet.nodes.cache import EtaEstimator

    eta, next_ratio, last, next_s = EtaEstimator(), 0.0, (0, 0), 0.0

    def on_progress(done: int, total: int) -> None:
        nonlocal next_ratio, last, next_s
        if done < last[0] or total != last[1]:
            next_ratio = 0.0
        last, now_s = (done, total), time.monotonic()
        progress_text = eta.text(done, total, now_s)
        if done >= next_ratio * total or now_s >= next_s:
            progress(f"{what}: {progress_text}")
            next_ratio, next_s = done / total + REPORT_STEP_RATIO, now_s + REPORT_STEP_S

    return on_progress


def precompute_force_table(scene: Scene, cache_dir: Path | None, progress: Progress) -> Path:
    """Return the file with the force table of a scene's sheet.

    The table is computed if the file does not exist.

    Raises NoEquilibriumError if the membrane model finds no equilibrium.
    """
    from flexsheet.nodes.planner import force_table

    on_progress = report_time_left("computing the force table of the sheet (only once)", progress)
    force_table.load_or_compute(scene, cache_dir, on_progress)
    return force_table.make_table_cache(scene).path(cache_dir)


def precompute_soft_body(
    scene: Scene,
    skin_spacing_m: float,
    cache_dir: Path | None,
    scheduler: str | None,
    progress: Progress,
) -> Path:
    """Return the file with the nonlinear table of a soft body.

    The table is computed if the file does not exist.

    skin_spacing_m: spacing of the nodes at the surface.
    scheduler: address of a dask.distributed scheduler. If it is None, the table is computed on this
        computer.

    Raises NoSoftBodyError if the scheduler cannot be used, the body cannot be meshed, or memory is
    insufficient.
    """
    from flexsheet.nodes.cache import EtaEstimator
    from flexsheet.nodes.fem_solver import body, precompute_table
    from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory

    folder = cache_dir or default_cache_dir()
    eta, reported_percent = EtaEstimator(), -1

    def on_progress(done: int, total: int, need: str) -> None:
        nonlocal reported_percent
        progress_text = eta.text(done, total, time.monotonic())
        if 100 * done // total != reported_percent:
            progress(f"computing the soft body: {progress_text} ({need})")
            reported_percent = 100 * done // total

    factory = SoftBodyFactory(skin_spacing_m=skin_spacing_m, cache_dir=folder, scheduler=scheduler)
    try:
        bodies = factory.bodies(scene, "auto", on_progress)
        if len(bodies) == 1:
            factory.build_table(scene, bodies[0], on_progress)
    except (ValueError, MemoryError, precompute_table.WorkersError) as error:
        raise NoSoftBodyError(str(error)) from error
    spec = body.make_table_spec(scene, bodies[0].spec)
    return precompute_table.make_table_cache(spec).path(folder)
