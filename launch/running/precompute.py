"""Compute the tables that the nodes of a graph read from a cache, before the graph starts."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.methods import SoftBodyChoice
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole, node_class
from flexsheet.nodes.cache import EtaEstimator, default_cache_dir
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.precompute_table import WorkersError
from flexsheet.nodes.fem_solver.soft_body_factory import choose_method, prepare_body
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


def precompute_graph(
    plan: ResolvedGraph,
    progress: Progress,
    *,
    host: str | None = None,
) -> None:
    """Compute the tables that the nodes of a graph need and that are not cached.

    host: host whose nodes are considered. If it is None, the nodes of all hosts are considered.
    """
    scene = plan.scene_message()
    if scene is None:
        return
    for node in plan.nodes_on(host):
        kind = node_class(node.type)
        if issubclass(kind, node_class("planner")):
            load_or_compute_bounds(scene.camera.rate_hz, node.parameters["cache_dir"], progress)
        if node.role is NodeRole.RENDERER:
            shape = node.parameters["sheet_shape"] or scene.methods.sheet_shape
            if shape == "reduced_order":
                precompute_deflection_shapes(scene, node.parameters["cache_dir"], progress)
        if issubclass(kind, node_class("fem_solver")) and scene.object.material is not None:
            given = FemSolverParameters.model_validate(node.parameters)
            choice = choose_method(scene, given.method, given.skin_spacing_m)
            precompute_soft_body(scene, choice, given.cache_dir, progress)


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
    choice: SoftBodyChoice,
    cache_dir: Path | None,
    progress: Progress,
    *,
    complete_table: bool = False,
    scheduler: str | None = None,
) -> Path:
    """Return the file with the linear response or the nonlinear table of a soft body.

    The file is computed if it does not exist.

    choice: method and spacing of the nodes at the surface.
    complete_table: whether to compute the complete table, which takes up to an hour, instead of the
        coarse table.
    scheduler: address of a dask.distributed scheduler. If it is None, the table is computed on this
        computer.

    Raises NoSoftBodyError if the scheduler cannot be used, the body cannot be meshed, or memory is
    insufficient.
    """
    report = report_time_left("computing the soft body (only once)", progress)
    try:
        return prepare_body(
            scene,
            choice,
            cache_dir or default_cache_dir(),
            lambda done, total, need: report(done, total),
            complete_table=complete_table,
            scheduler=scheduler,
        )
    except (ValueError, MemoryError, WorkersError) as error:
        raise NoSoftBodyError(str(error)) from error
