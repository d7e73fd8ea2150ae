"""The nonlinear table of a scene's body: its pushes spread over processes, kept on disk.

Pushes are independent of one another and take most of the time.  They are handed to an executor of
`concurrent.futures`: processes of this machine, or a lab's workers (`lab`).  Each is kept as soon
as it is there.
"""

from __future__ import annotations

import hashlib
import json
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
from dataclasses import dataclass, fields
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from nodes.background import enter_background
from nodes.cache import Parts, load_arrays, save_arrays, say_damaged
from nodes.fem_solver import precompute, pushes
from nodes.fem_solver.carried import Carrier, Hull, Solved
from nodes.fem_solver.contact import LinearSoftBody
from nodes.fem_solver.mesh import build_mesh
from nodes.fem_solver.mesh.from_scene import VERSION as mesh_version
from nodes.fem_solver.precompute import SoftBodyModel, SoftBodySpec
from nodes.fem_solver.table import Table, fill, table_bytes
from nodes.models.shapes import make_shape

VERSION = 3
"""Counts up whenever the same specification gives other numbers."""
PUSH_STEPS, PLACE_STEPS = 200, 1
"""How much of the progress a push, and a place that is filled in, are."""
PULSE_S = 0.2
"""How often progress is told, and may be stopped, while pushes run."""
PUSH_BYTES = 600_000_000
"""About what solving one push takes."""

Progress = Callable[[int, int, "TableBudget"], None]
"""Called with (done, total) steps and what is needed, first before anything starts; may raise
`precompute.Interrupted` to stop."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSpec:
    """All that a table depends on; equal where their keys are."""

    body: SoftBodySpec
    finger_radius_m: float

    def key(self) -> str:
        """Digest of the specification and of the code's version."""
        text = json.dumps([VERSION, self.body.key(), self.finger_radius_m])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class TableBudget:
    """What a table will need, known before it is begun."""

    pushes: int
    places: int
    bytes: int

    def text(self) -> str:
        return f"{self.pushes} deep pushes for {self.places} places, {self.bytes / 1e6:.0f} MB"


@contextmanager
def local_processes(count: int) -> Iterator[Executor]:
    """Provide so many processes of this machine; an exception ends them in mid-push."""
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


asked_to_stop: ContextVar[Callable[[], bool]] = ContextVar("asked_to_stop", default=lambda: False)
"""In a worker: whether what it is at shall end."""


def _begin(stop: Event) -> None:
    enter_background()
    threading.Thread(target=_exit_on, args=(stop,), name="stop", daemon=True).start()


def _exit_on(stop: Event) -> None:
    """Exit the worker as soon as it is asked to: one depth of a push takes up to a minute.

    Nothing is lost: whoever asked for the answers keeps them.
    """
    stop.wait()
    os._exit(0)


def _solve(job: pushes.PushJob) -> pushes.PushAnswer:
    return pushes.solve_push(job, asked_to_stop.get())


class WorkersError(RuntimeError):
    """Whoever was to solve pushes is of no use."""


class LostWorkersError(WorkersError):
    """They are gone; what they had solved is kept."""


def code_version() -> str:
    """Of all that decides what a push's answer is."""
    return f"{VERSION}.{precompute.VERSION}.{mesh_version}"


def table_path(spec: TableSpec, cache_dir: Path) -> Path:
    return cache_dir / f"soft-body-table-{spec.key()}.npz"


def parts_of(spec: TableSpec, cache_dir: Path) -> Parts:
    return Parts(cache_dir / f"soft-body-table-{spec.key()}.parts")


def load_table(spec: TableSpec, cache_dir: Path) -> Table | None:
    """The table kept for a specification; None if there is none, or (logged) it is damaged."""
    path = table_path(spec, cache_dir)
    content = load_arrays(path)
    if content is None:
        return None
    try:
        return Table(**content)
    except TypeError as error:
        say_damaged(path, error)
        return None


def save_table(table: Table, spec: TableSpec, cache_dir: Path) -> None:
    """Keep a table; a reader sees the whole file or none.  OSError if it cannot be written."""
    content = {one.name: getattr(table, one.name) for one in fields(table)}
    save_arrays(table_path(spec, cache_dir), content)


def compute_table(
    spec: TableSpec,
    model: SoftBodyModel,
    cache_dir: Path,
    executor: Executor,
    progress: Progress,
    *,
    workers: int = 1,
) -> Table:
    """Solve the pushes, fill the table, keep it.  model: of the same body; workers: how many of the
    executor's are on this machine.

    MemoryError, before anything is solved, if this machine, with so many workers on it, has too
    little; OSError as `save_table`; others as `solve_all`.
    """
    mesh_spec, response = spec.body.mesh, model.response
    mesh = build_mesh(mesh_spec)
    mirrors = pushes.mirrors_of(mesh)
    sites = pushes.sites_of(mesh_spec, mesh, mirrors, spec.finger_radius_m)
    table = table_bytes(len(response.touch), len(response.rest), len(pushes.DEPTHS_M))
    need = TableBudget(len(sites), len(response.touch), 2 * table + workers * PUSH_BYTES)
    total = PUSH_STEPS * len(sites) + PLACE_STEPS * len(response.touch)
    progress(0, total, need)
    _require_memory(need, spec)
    jobs = [
        pushes.job_of(
            mesh_spec,
            mesh,
            site,
            poisson_ratio=spec.body.poisson_ratio,
            finger_radius_m=spec.finger_radius_m,
        )
        for site in sites
    ]
    parts = parts_of(spec, cache_dir)
    answers = solve_all(
        jobs, executor, parts, lambda count: progress(PUSH_STEPS * count, total, need)
    )
    solved, seen = [], set()
    for site, answer in zip(sites, answers, strict=True):
        for signs in mirrors:
            image, place = pushes.reflected(answer, site, signs)
            name = tuple(np.round(1e7 * place.place).astype(int))
            if name not in seen:
                seen.add(name)
                solved.append(Solved(place, image, Hull(image.rest, image.faces)))
    carrier = Carrier(solved, np.array(mesh_spec.towards_user), spec.finger_radius_m)
    linear = LinearSoftBody(
        response,
        make_shape(dict(mesh_spec.geometry)),
        response.rest[model.bounds],
        young_modulus_pa=1.0,
        finger_radius_m=spec.finger_radius_m,
        linear_depth_m=spec.finger_radius_m,
        largest_depth_m=2.0 * spec.finger_radius_m,
    )
    filled = fill(
        response,
        model.triangles,
        linear,
        carrier,
        lambda done, _: progress(PUSH_STEPS * len(sites) + done, total, need),
    )
    save_table(filled, spec, cache_dir)
    parts.remove()
    return filled


def solve_all(
    jobs: list[pushes.PushJob], executor: Executor, parts: Parts, told: Callable[[int], None]
) -> list[pushes.PushAnswer]:
    """The jobs' answers, those kept before taken from parts; told is called with how many are
    there, and may raise to stop: jobs that have not begun are then given up.

    LostWorkersError if the executor gives jobs up; errors of the jobs.
    """
    answers: dict[int, pushes.PushAnswer] = {}
    for number in range(len(jobs)):
        kept = parts.load(f"push-{number:04d}")
        if kept is not None:
            reached = int(kept.pop("reached"))
            answers[number] = pushes.PushAnswer(reached=reached, **kept)
    told(len(answers))
    waiting: dict[Future[pushes.PushAnswer], int] = {
        executor.submit(_solve, job): number
        for number, job in enumerate(jobs)
        if number not in answers
    }
    try:
        while waiting:
            done, _ = wait(waiting, timeout=PULSE_S, return_when=FIRST_COMPLETED)
            for future in done:
                number = waiting.pop(future)
                try:
                    answer = future.result()
                except CancelledError as error:
                    raise LostWorkersError(
                        "the workers that solve the pushes are gone; what they solved is kept, "
                        "start them again and the table goes on from there"
                    ) from error
                content = {
                    one.name: np.asarray(getattr(answer, one.name)) for one in fields(answer)
                }
                parts.save(f"push-{number:04d}", content)
                answers[number] = answer
            told(len(answers))
    finally:
        for future in waiting:
            future.cancel()
    return [answers[number] for number in range(len(jobs))]


def _require_memory(need: TableBudget, spec: TableSpec) -> None:
    """MemoryError if the machine has less memory free than the table takes while it is made."""
    import psutil

    free = psutil.virtual_memory().available
    if need.bytes > free:
        raise MemoryError(
            f"the soft body's table takes {need.bytes / 2**30:.1f} GiB ({need.text()}), "
            f"{free / 2**30:.1f} GiB are free; raise skin_spacing_m above "
            f'{spec.body.mesh.skin_spacing_m:g}, or take method "linear"'
        )
