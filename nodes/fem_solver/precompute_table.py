"""Compute the nonlinear table of a scene's body from snapshots that many processes solve.

Snapshots are independent of one another and take most of the time. An executor of
`concurrent.futures` solves them: processes of this machine, or a laboratory's workers
(`dask_executor`). Each is stored as soon as it is solved.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.background import enter_background
from flexsheet.nodes.cache import CheckpointStore, Specification, cached, encode_fields
from flexsheet.nodes.fem_solver import precompute, snapshots
from flexsheet.nodes.fem_solver.contact import unit_linear_body
from flexsheet.nodes.fem_solver.mesh import build_mesh
from flexsheet.nodes.fem_solver.mesh.from_scene import VERSION as mesh_version
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, SoftBodySpec
from flexsheet.nodes.fem_solver.snapshot_interpolator import SnapshotInterpolator, place_snapshots
from flexsheet.nodes.fem_solver.table import Table, fill_table, table_bytes
from flexsheet.nodes.models.shapes import make_shape

VERSION = 3
"""Increase whenever the same specification gives other numbers."""
SNAPSHOT_STEPS, NODE_STEPS = 200, 1
"""Progress steps of a snapshot, and of a node of the table."""
POLL_S = 0.2
"""Period at which progress is reported, and may be stopped, while snapshots are solved."""
SNAPSHOT_BYTES = 600_000_000
"""Approximate memory that solving one snapshot takes."""

Progress = Callable[[int, int, "TableBudget"], None]
"""Called with (done, total) steps and the resources needed, first before the work starts. It may
raise `precompute.Interrupted` to stop the work."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSpec:
    """All inputs that determine the content of a precomputed table."""

    body: SoftBodySpec
    finger_radius_m: float

    def depends_on(self) -> list[object]:
        """Return the JSON value that determines the table."""
        return [VERSION, self.body.key(), self.finger_radius_m]


@dataclass(frozen=True, slots=True)
class TableBudget:
    """The resources that a table needs, known before it is computed."""

    snapshots: int
    nodes: int
    bytes: int

    def text(self) -> str:
        return f"{self.snapshots} snapshots for {self.nodes} nodes, {self.bytes / 1e6:.0f} MB"


@contextmanager
def local_processes(count: int) -> Iterator[Executor]:
    """Yield an executor with `count` processes of this machine; an exception ends them at once."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    executor = ProcessPoolExecutor(count, context, initializer=_begin, initargs=(stop,))
    try:
        yield executor
    except BaseException:
        stop.set()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


stop_requested: ContextVar[Callable[[], bool]] = ContextVar("stop_requested", default=lambda: False)
"""In a worker: whether the present job must end."""


def _begin(stop: Event) -> None:
    enter_background()
    threading.Thread(target=_exit_on, args=(stop,), name="stop", daemon=True).start()


def _exit_on(stop: Event) -> None:
    """Exit the worker as soon as it is asked to: one depth of a snapshot takes up to a minute.

    The process that asked for the results stores them, so none is lost.
    """
    stop.wait()
    os._exit(0)


def _solve(job: snapshots.SnapshotJob) -> snapshots.Snapshot:
    return snapshots.solve_snapshot(job, stop_requested.get())


class WorkersError(FlexsheetError, RuntimeError):
    """The workers that were to solve snapshots cannot be used."""

    code = "workers"
    remedy = "Follow the remedy in the text."


class LostWorkersError(WorkersError):
    """The workers are gone; finished snapshots are stored."""

    code = "lost-workers"
    remedy = "Start the workers again and repeat the command. Finished results are stored."


def code_version() -> str:
    """Return the version of all code that determines a snapshot."""
    return f"{VERSION}.{precompute.VERSION}.{mesh_version}"


def make_table_cache(spec: TableSpec) -> Specification[Table]:
    """Describe the cache file of a nonlinear table."""
    return Specification(
        "soft-body-table", spec.depends_on(), encode_fields, lambda content: Table(**content)
    )


def compute_table(
    spec: TableSpec,
    model: SoftBodyModel,
    cache_dir: Path,
    executor: Executor,
    progress: Progress,
    *,
    workers: int = 1,
) -> Table:
    """Return the cached table, or solve its snapshots, fill it and store it.

    model: of the same body. workers: how many of the executor's are on this machine. Raises
    MemoryError, before anything is solved, if the machine has too little memory for so many
    workers. Other errors as `cached` and `solve_all`.
    """
    entry = make_table_cache(spec)
    checkpoints = entry.checkpoints(cache_dir)
    return cached(
        entry,
        cache_dir,
        lambda: _compute_table(spec, model, checkpoints, executor, progress, workers=workers),
    )


def _compute_table(
    spec: TableSpec,
    model: SoftBodyModel,
    checkpoints: CheckpointStore,
    executor: Executor,
    progress: Progress,
    *,
    workers: int,
) -> Table:
    mesh_spec, response = spec.body.mesh, model.response
    mesh = build_mesh(mesh_spec)
    mirrors = snapshots.find_mirror_planes(mesh)
    samples = snapshots.choose_sample_points(mesh_spec, mesh, mirrors, spec.finger_radius_m)
    table = table_bytes(len(response.contact_nodes), len(response.rest), len(snapshots.DEPTHS_M))
    need = TableBudget(
        len(samples), len(response.contact_nodes), 2 * table + workers * SNAPSHOT_BYTES
    )
    total = SNAPSHOT_STEPS * len(samples) + NODE_STEPS * len(response.contact_nodes)
    progress(0, total, need)
    _require_memory(need, spec)
    jobs = [
        snapshots.make_snapshot_job(
            mesh_spec,
            mesh,
            sample,
            poisson_ratio=spec.body.poisson_ratio,
            finger_radius_m=spec.finger_radius_m,
        )
        for sample in samples
    ]
    solved = solve_all(
        jobs, executor, checkpoints, lambda count: progress(SNAPSHOT_STEPS * count, total, need)
    )
    interpolator = SnapshotInterpolator(
        place_snapshots(samples, solved, mirrors),
        np.array(mesh_spec.towards_user),
        spec.finger_radius_m,
    )
    return fill_table(
        response,
        model.triangles,
        unit_linear_body(
            response,
            make_shape(dict(mesh_spec.geometry)),
            response.rest[model.bounds],
            spec.finger_radius_m,
        ),
        interpolator,
        lambda done, _: progress(SNAPSHOT_STEPS * len(samples) + done, total, need),
    )


def solve_all(
    jobs: list[snapshots.SnapshotJob],
    executor: Executor,
    checkpoints: CheckpointStore,
    on_progress: Callable[[int], None],
) -> list[snapshots.Snapshot]:
    """Return the jobs' snapshots; those of earlier checkpoints are not solved again.

    on_progress: called with the number of finished snapshots. It may raise to stop: jobs that have
    not begun are then cancelled. Raises LostWorkersError if the executor loses its workers, and the
    errors of the jobs.
    """
    solved: dict[int, snapshots.Snapshot] = {}
    for number in range(len(jobs)):
        part = checkpoints.load(f"push-{number:04d}")
        if part is not None:
            solved[number] = snapshots.decode_snapshot(part)
    on_progress(len(solved))
    waiting: dict[Future[snapshots.Snapshot], int] = {
        executor.submit(_solve, job): number
        for number, job in enumerate(jobs)
        if number not in solved
    }
    try:
        while waiting:
            done, _ = wait(waiting, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                number = waiting.pop(future)
                try:
                    snapshot = future.result()
                except CancelledError as error:
                    raise LostWorkersError(
                        "the workers that solve the snapshots are gone; restart them, and the "
                        "table continues from the snapshots that they finished"
                    ) from error
                checkpoints.save(f"push-{number:04d}", encode_fields(snapshot))
                solved[number] = snapshot
            on_progress(len(solved))
    finally:
        for future in waiting:
            future.cancel()
    return [solved[number] for number in range(len(jobs))]


def _require_memory(need: TableBudget, spec: TableSpec) -> None:
    """Raise MemoryError if the machine has less free memory than computing the table takes."""
    import psutil

    free = psutil.virtual_memory().available
    if need.bytes > free:
        raise MemoryError(
            f"the soft body's table takes {need.bytes / 2**30:.1f} GiB ({need.text()}), "
            f"{free / 2**30:.1f} GiB are free; raise skin_spacing_m above "
            f'{spec.body.mesh.skin_spacing_m:g}, or choose method "linear"'
        )
