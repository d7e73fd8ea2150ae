"""Compute the nonlinear table of a soft body from snapshots that are solved in parallel.

Snapshots (module `snapshots`) are solutions for pushes at single points. They are independent of
each other, and need most of the computing time. An executor of `concurrent.futures` computes them
with processes of this computer, or with the workers of a cluster (module `dask_executor`). Each
snapshot is stored when it is finished.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats
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

K = TypeVar("K")
T = TypeVar("T")
Task = Callable[[], snapshots.Snapshot]
"""A function without arguments that a worker process can run."""

VERSION = 7
"""The version of the computation. Increase it when results for the same specification change."""
SNAPSHOT_STEPS, NODE_STEPS = 200, 1
"""The numbers of progress steps for each finished snapshot and for each finished table node."""
POLL_S = 0.2
"""The period of progress reports while snapshots are solved, in seconds."""
SNAPSHOT_BYTES = 600_000_000
"""The approximate memory that the solution of one snapshot needs, in bytes."""
FINE_NAME = "fine"
"""The name under which the push on the fine mesh is stored."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSpec:
    """The inputs of the computation of a nonlinear table.

    coarse: whether the table is computed from only a few pushes, in about a minute.
    """

    body: SoftBodySpec
    finger_radius_m: float
    coarse: bool = False

    def depends_on(self) -> list[object]:
        """Return all inputs of the table as a JSON value."""
        return [VERSION, self.body.key(), self.finger_radius_m, self.coarse]


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
) -> Table:
    """Load the cached table, or compute and store it.

    model: linear response of the same body. workers: number of workers of the executor on this
    computer. Raises MemoryError if this computer has too little memory. Raises LostWorkersError if
    the executor loses its workers.
    """
    entry = make_table_cache(spec)

    def compute() -> Table:
        checkpoints = entry.checkpoints(cache_dir)
        for name, snapshot in load_shipped(shipped_path(entry)).items():
            checkpoints.get(name, partial(encode_fields, snapshot))
        return _compute_table(spec, model, checkpoints, executor, progress, workers=workers)

    return cached(entry, cache_dir, compute)


@dataclass(frozen=True, slots=True, eq=False)
class TablePushes:
    """The pushes from which a table is computed.

    samples: pushed surface points. names: names of their solutions. tasks: functions that compute
    all solutions, by name. They include the push on the fine mesh at the first point, if the shape
    permits such a mesh. mirrors: vectors (3,) of signs, one for each mirror symmetry of the body.
    """

    samples: list[snapshots.SamplePoint]
    names: list[str]
    tasks: dict[str, Task]
    mirrors: list[Floats]


def plan_pushes(spec: TableSpec) -> TablePushes:
    """Choose the pushes from which a table is computed."""
    mesh_spec, radius_m = spec.body.mesh, spec.finger_radius_m
    mesh = build_mesh(mesh_spec)
    mirrors = snapshots.find_mirror_planes(mesh)
    samples = snapshots.order_by_spread(
        snapshots.choose_sample_points(mesh_spec, mesh, mirrors, radius_m),
        mirrors,
        np.array(mesh_spec.towards_user),
    )
    depths_m = snapshots.COARSE_DEPTHS_M if spec.coarse else snapshots.DEPTHS_M
    if spec.coarse:
        samples = samples[: snapshots.COARSE_COUNT]
    given = {"poisson_ratio": spec.body.poisson_ratio, "finger_radius_m": radius_m}
    names = [f"push-{number:04d}" for number in range(len(samples))]
    tasks: dict[str, Task] = {}
    if snapshots.has_focused_meshes(mesh_spec):
        # The push on the fine mesh takes longest, so it starts first.
        tasks[FINE_NAME] = partial(snapshots.solve_fine_push, mesh_spec, samples[0], **given)
    for name, sample in zip(names, samples, strict=True):
        tasks[name] = partial(
            snapshots.solve_push, mesh_spec, mesh, sample, depths_m=depths_m, **given
        )
    return TablePushes(samples, names, tasks, mirrors)


def _compute_table(
    spec: TableSpec,
    model: SoftBodyModel,
    checkpoints: CheckpointStore,
    executor: Executor,
    progress: Progress,
    *,
    workers: int,
) -> Table:
    response, mesh_spec, radius_m = model.response, spec.body.mesh, spec.finger_radius_m
    pushes = plan_pushes(spec)
    loads, solving = len(response.contact_nodes), SNAPSHOT_STEPS * len(pushes.tasks)
    depths = len(snapshots.DEPTHS_M)
    required_bytes = workers * SNAPSHOT_BYTES + 2 * table_bytes(loads, len(response.rest), depths)
    stage = "coarse" if spec.coarse else "complete"
    need = (
        f"{stage} table, {len(pushes.tasks)} snapshots for {loads} nodes, "
        f"{required_bytes / 1e6:.0f} MB"
    )

    def report(steps: int) -> None:
        progress(steps, solving + NODE_STEPS * loads, need)

    report(0)
    precompute.require_memory(
        required_bytes,
        f"the computation of the nonlinear table of the soft body ({need})",
        f'increase skin_spacing_m above {mesh_spec.skin_spacing_m:g}, or set method to "linear"',
    )
    solved = solve_all(
        pushes.tasks, executor, checkpoints, lambda count: report(SNAPSHOT_STEPS * count)
    )
    return fill_table(
        response,
        model.triangles,
        unit_linear_body(
            response,
            make_shape(dict(mesh_spec.geometry)),
            response.rest[model.bounds],
            radius_m,
        ),
        SnapshotSet(
            pushes.samples,
            [solved[name] for name in pushes.names],
            pushes.mirrors,
            np.array(mesh_spec.towards_user),
            radius_m,
        ),
        fine=(pushes.samples[0], solved[FINE_NAME]) if FINE_NAME in solved else None,
        interpolate=partial(
            _interpolate_by,
            executor,
            lambda done, total: report(solving + NODE_STEPS * loads * done // total),
        ),
    )


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
    waiting: dict[Future[T], K],
    on_result: Callable[[K, T], None],
    on_progress: Callable[[], None],
) -> None:
    """Wait for all futures, and cancel the pending futures after an exception.

    waiting: futures, each with a key. on_result: function that receives the key and the result of
    each future. on_progress: function that is called periodically. Raises LostWorkersError if the
    executor loses its workers. Also raises the errors of the futures.
    """
    try:
        while waiting:
            done, _ = wait(waiting, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                key = waiting.pop(future)
                try:
                    result = future.result()
                except CancelledError as error:
                    raise LostWorkersError(
                        "the worker processes that solve snapshots for the soft body's table were "
                        "lost; restart them and repeat the command, which loads the finished "
                        "snapshots and solves the missing ones"
                    ) from error
                on_result(key, result)
            on_progress()
    finally:
        for future in waiting:
            future.cancel()


def solve_all(
    tasks: Mapping[str, Task],
    executor: Executor,
    checkpoints: CheckpointStore,
    on_progress: Callable[[int], None],
) -> dict[str, snapshots.Snapshot]:
    """Load solutions (snapshots) from a store; compute and store missing ones.

    tasks: functions that compute the solutions, with the names of the stored solutions as keys.
    on_progress: function that receives the number of finished snapshots. It may raise an exception
    to cancel the pending tasks. Raises LostWorkersError if the executor loses its workers. Also
    raises the errors of the tasks.
    """
    solved: dict[str, snapshots.Snapshot] = {}
    for name in tasks:
        part = checkpoints.load(name)
        if part is not None:
            solved[name] = snapshots.decode_snapshot(part)
    on_progress(len(solved))
    waiting = {executor.submit(task): name for name, task in tasks.items() if name not in solved}

    def store(name: str, snapshot: snapshots.Snapshot) -> None:
        checkpoints.save(name, encode_fields(snapshot))
        solved[name] = snapshot

    _collect(waiting, store, lambda: on_progress(len(solved)))
    return solved
