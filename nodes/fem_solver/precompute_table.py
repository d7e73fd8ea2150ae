"""Compute the nonlinear table of a soft body from snapshots that are solved in parallel.

Snapshots (module `snapshots`) are solutions for pushes at single points. They are independent of
each other, and need most of the computing time. An executor of `concurrent.futures` computes them
with processes of this computer, or with the workers of a cluster (module `dask_executor`). Each
snapshot is stored when it is finished.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.cache import CheckpointStore, Specification, cached, encode_fields
from flexsheet.nodes.fem_solver import precompute, snapshots
from flexsheet.nodes.fem_solver.contact import unit_linear_body
from flexsheet.nodes.fem_solver.mesh.from_scene import VERSION as mesh_version
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute import Progress, SoftBodyModel, SoftBodySpec
from flexsheet.nodes.fem_solver.shipped_pushes import load_shipped, shipped_path
from flexsheet.nodes.fem_solver.snapshot_interpolator import SnapshotSet
from flexsheet.nodes.fem_solver.table import (
    FilledNodes,
    FillJob,
    Table,
    fill_table,
    interpolate_nodes,
    table_bytes,
)
from flexsheet.nodes.models.shapes import make_shape

T = TypeVar("T")

VERSION = 6
"""The version of the computation. Increase it when results for the same specification change."""
SNAPSHOT_STEPS, NODE_STEPS = 200, 1
"""The numbers of progress steps for each finished snapshot and for each finished table node."""
POLL_S = 0.2
"""The period of progress reports and stop checks while snapshots are solved, in seconds."""
SNAPSHOT_BYTES = 600_000_000
"""The approximate memory that the solution of one snapshot needs, in bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSpec:
    """The inputs of the computation of a nonlinear table."""

    body: SoftBodySpec
    finger_radius_m: float

    def depends_on(self) -> list[object]:
        """Return all inputs of the table as a JSON value."""
        return [VERSION, self.body.key(), self.finger_radius_m]


stop_requested: ContextVar[Callable[[], bool]] = ContextVar("stop_requested", default=lambda: False)
"""A function that returns whether a worker must stop its current job."""


def _solve(job: snapshots.SnapshotJob) -> snapshots.Snapshot:
    return snapshots.solve_snapshot(job, stop_requested.get())


class WorkersError(FlexsheetError, RuntimeError):
    """Raised if the workers that compute snapshots cannot be used."""


class LostWorkersError(WorkersError):
    """Raised if the workers that compute snapshots are lost. Finished snapshots are stored."""

    remedy = "Start the workers again and repeat the command. Finished results are stored."


def code_version() -> str:
    """Return the version of the code that computes snapshots."""
    return f"{VERSION}.{precompute.VERSION}.{mesh_version}"


def make_table_cache(spec: TableSpec) -> Specification[Table]:
    """Return the cache key of a nonlinear table, with functions that encode and decode tables."""
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
    on_quick: Callable[[Table], None] | None = None,
) -> Table:
    """Load the cached table, or compute and store it.

    model: linear response of the same body. workers: number of workers of the executor on this
    computer. on_quick: function that receives a coarse table long before the complete table is
    ready; if it is None, no coarse table is computed. Raises MemoryError if this computer has too
    little memory. Raises LostWorkersError if the executor loses its workers.
    """
    entry = make_table_cache(spec)
    checkpoints = entry.checkpoints(cache_dir)

    def compute() -> Table:
        for name, snapshot in load_shipped(shipped_path(entry)).items():
            if checkpoints.load(name) is None:
                checkpoints.save(name, encode_fields(snapshot))
        return _compute_table(
            spec, model, checkpoints, executor, progress, workers=workers, on_quick=on_quick
        )

    return cached(entry, cache_dir, compute)


def _compute_table(
    spec: TableSpec,
    model: SoftBodyModel,
    checkpoints: CheckpointStore,
    executor: Executor,
    progress: Progress,
    *,
    workers: int,
    on_quick: Callable[[Table], None] | None,
) -> Table:
    mesh_spec, response = spec.body.mesh, model.response
    mesh = build_mesh(mesh_spec)
    mirrors = snapshots.find_mirror_planes(mesh)
    user = np.array(mesh_spec.towards_user)
    samples = snapshots.order_by_spread(
        snapshots.choose_sample_points(mesh_spec, mesh, mirrors, spec.finger_radius_m),
        mirrors,
        user,
    )
    given = {"poisson_ratio": spec.body.poisson_ratio, "finger_radius_m": spec.finger_radius_m}
    fine_job = snapshots.make_fine_job(mesh_spec, samples[0], **given)
    linear = unit_linear_body(
        response,
        make_shape(dict(mesh_spec.geometry)),
        response.rest[model.bounds],
        spec.finger_radius_m,
    )
    loads = len(response.contact_nodes)
    table = table_bytes(loads, len(response.rest), len(snapshots.DEPTHS_M))

    def compute_stage(
        name: str, stage: str, some: list[snapshots.SamplePoint], depths_m: tuple[float, ...]
    ) -> Table:
        jobs = [
            snapshots.make_snapshot_job(mesh_spec, mesh, sample, depths_m=depths_m, **given)
            for sample in some
        ]
        names = [f"{name}-{number:04d}" for number in range(len(jobs))]
        if fine_job is not None:
            # Both stages need the fine push. The second stage loads it from the checkpoints.
            jobs, names = [fine_job, *jobs], ["fine", *names]
        solving = SNAPSHOT_STEPS * len(jobs)
        required_bytes = 2 * table + workers * SNAPSHOT_BYTES
        need = (
            f"{stage} table, {len(jobs)} snapshots for {loads} nodes, {required_bytes / 1e6:.0f} MB"
        )

        def report(steps: int) -> None:
            progress(steps, solving + NODE_STEPS * loads, need)

        report(0)
        precompute.require_memory(
            required_bytes,
            f"the computation of the nonlinear table of the soft body ({need})",
            f"increase skin_spacing_m above {mesh_spec.skin_spacing_m:g}, or set method to "
            '"linear"',
        )
        solved = solve_all(
            jobs, executor, checkpoints, lambda count: report(SNAPSHOT_STEPS * count), names=names
        )
        return fill_table(
            response,
            model.triangles,
            linear,
            SnapshotSet(some, solved[-len(some) :], mirrors, user, spec.finger_radius_m),
            fine=None if fine_job is None else (samples[0], solved[0]),
            interpolate=partial(
                _interpolate_by,
                executor,
                lambda done, total: report(solving + NODE_STEPS * loads * done // total),
            ),
        )

    if on_quick is not None:
        some = samples[: snapshots.QUICK_COUNT]
        on_quick(compute_stage("quick", "coarse", some, snapshots.QUICK_DEPTHS_M))
    return compute_stage("push", "complete", samples, snapshots.DEPTHS_M)


def _interpolate_by(
    executor: Executor, on_progress: Callable[[int, int], None], jobs: Sequence[FillJob]
) -> list[FilledNodes]:
    """Fill the nodes of a nonlinear table by interpolation between precomputed pushes, in parallel.

    on_progress: function that receives the number of finished nodes and the total number. Nodes
        that are mirror images of other nodes are not counted.
    jobs: groups of nodes, each of which is one task of the executor.

    Returns the results in the order of the jobs.
    """
    filled: dict[int, FilledNodes] = {}
    total = sum(len(job.samples) for job in jobs)
    _collect(
        {executor.submit(interpolate_nodes, job): number for number, job in enumerate(jobs)},
        filled.__setitem__,
        lambda: on_progress(sum(len(one.reached) for one in filled.values()), total),
    )
    return [filled[number] for number in range(len(jobs))]


def _collect(
    waiting: dict[Future[T], int],
    on_result: Callable[[int, T], None],
    on_progress: Callable[[], None],
) -> None:
    """Wait for all futures, and cancel the pending futures after an exception.

    waiting: futures, each with an index. on_result: function that receives the index and the result
    of each future. on_progress: function that is called periodically. Raises LostWorkersError if
    the executor loses its workers. Also raises the errors of the futures.
    """
    try:
        while waiting:
            done, _ = wait(waiting, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                number = waiting.pop(future)
                try:
                    result = future.result()
                except CancelledError as error:
                    raise LostWorkersError(
                        "the worker processes that solve snapshots for the soft body's table were "
                        "lost; restart them and repeat the command, which loads the finished "
                        "snapshots and solves the missing ones"
                    ) from error
                on_result(number, result)
            on_progress()
    finally:
        for future in waiting:
            future.cancel()


def solve_all(
    jobs: list[snapshots.SnapshotJob],
    executor: Executor,
    checkpoints: CheckpointStore,
    on_progress: Callable[[int], None],
    *,
    names: Sequence[str] = (),
) -> list[snapshots.Snapshot]:
    """Load the solutions (snapshots) of jobs from a store; compute and store missing ones.

    on_progress: function that receives the number of finished snapshots. It may raise an exception
    to cancel the pending jobs. names: names of the stored snapshots. If `names` is empty, the names
    are "push-0000", "push-0001" and so on. Raises LostWorkersError if the executor loses its
    workers. Also raises the errors of the jobs.
    """
    names = names or [f"push-{number:04d}" for number in range(len(jobs))]
    solved: dict[int, snapshots.Snapshot] = {}
    for number in range(len(jobs)):
        part = checkpoints.load(names[number])
        if part is not None:
            solved[number] = snapshots.decode_snapshot(part)
    on_progress(len(solved))
    waiting: dict[Future[snapshots.Snapshot], int] = {
        executor.submit(_solve, job): number
        for number, job in enumerate(jobs)
        if number not in solved
    }

    def store(number: int, snapshot: snapshots.Snapshot) -> None:
        checkpoints.save(names[number], encode_fields(snapshot))
        solved[number] = snapshot

    _collect(waiting, store, lambda: on_progress(len(solved)))
    return [solved[number] for number in range(len(jobs))]
