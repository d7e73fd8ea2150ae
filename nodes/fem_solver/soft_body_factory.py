"""Build the soft body of a scene, with the linear method or a nonlinear table.

Precomputed data is loaded from the cache.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

from flexsheet.messages.methods import SoftBodyChoice, SoftBodyMethod
from flexsheet.messages.scene import Scene
from flexsheet.nodes.cache import load_cached
from flexsheet.nodes.fem_solver import body, precompute, precompute_table
from flexsheet.nodes.worker_processes import local_processes


def choose_method(
    scene: Scene, method: SoftBodyMethod | None = None, skin_spacing_m: float | None = None
) -> SoftBodyChoice:
    """Return the solution method and the skin spacing of a soft body.

    method, skin_spacing_m: parameters of the node; None means the value in the scene.
    """
    choice = scene.methods.soft_body
    return SoftBodyChoice(
        method=method or choice.method, skin_spacing_m=skin_spacing_m or choice.skin_spacing_m
    )


def load_body(
    scene: Scene, choice: SoftBodyChoice, cache_dir: Path, progress: precompute.Progress
) -> body.SceneBody:
    """Build the soft body of a scene with the most accurate cached table.

    If the linear response is not cached, it is computed and stored, which takes seconds. The result
    uses the linear method if the choice is `linear`, or if no table is cached. Raises
    UnfitMeshError if the object cannot be meshed, and MemoryError if the free memory is
    insufficient. Raises ValueError if the material or a size is invalid.
    """
    spec = body.make_soft_body_spec(scene, choice.skin_spacing_m)
    model = precompute.load_or_compute(spec, cache_dir, progress)
    linear = body.build_scene_body(scene, spec, model)
    if choice.method == "nonlinear_table":
        for coarse in (False, True):
            table_spec = body.make_table_spec(scene, spec, coarse=coarse)
            table = load_cached(precompute_table.make_table_cache(table_spec), cache_dir)
            if table is not None:
                return body.attach_table(linear, scene, model, table, coarse=coarse)
    return linear


def prepare_body(
    scene: Scene,
    choice: SoftBodyChoice,
    cache_dir: Path,
    progress: precompute.Progress,
    *,
    complete_table: bool = False,
    scheduler: str | None = None,
) -> Path:
    """Compute what `load_body` needs if it is not cached, and return its file.

    complete_table: whether the complete table is required, which takes up to an hour. Otherwise, a
        missing table is replaced by the coarse table, which takes about a minute.
    scheduler: address of a dask scheduler whose workers compute the table; None means processes of
        this computer.

    Raises WorkersError if the workers cannot be used or are lost, and the errors of `load_body`.
    """
    spec = body.make_soft_body_spec(scene, choice.skin_spacing_m)
    model = precompute.load_or_compute(spec, cache_dir, progress)
    if choice.method == "linear":
        return precompute.response_cache(spec).path(cache_dir)
    wanted = [body.make_table_spec(scene, spec)]
    if not complete_table:
        wanted.append(body.make_table_spec(scene, spec, coarse=True))
    paths = [precompute_table.make_table_cache(one).path(cache_dir) for one in wanted]
    for path in paths:
        if path.exists():
            return path
    with _executor(scheduler) as (executor, workers):
        precompute_table.compute_table(
            wanted[-1], model, cache_dir, executor, progress, workers=workers
        )
    return paths[-1]


@contextmanager
def _executor(scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Yield the executor that computes snapshots, and its number of local workers."""
    if scheduler is None:
        workers = os.cpu_count() or 1
        with local_processes(workers) as executor:
            yield executor, workers
        return
    # Imported late, because it needs an optional dependency.
    from flexsheet.nodes.fem_solver.dask_executor import connect_workers

    with connect_workers(scheduler) as executor:
        yield executor, 0
