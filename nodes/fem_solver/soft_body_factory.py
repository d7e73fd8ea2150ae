"""Build the soft body of a scene, with the linear method or the nonlinear table.

Precomputed data is loaded from the cache. Missing data is computed and stored in the cache.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

from flexsheet.messages.methods import SoftBodyMethod, resolve_method
from flexsheet.messages.scene import Scene
from flexsheet.nodes.cache import advise_precompute, load_cached
from flexsheet.nodes.fem_solver import body, precompute, precompute_table
from flexsheet.nodes.fem_solver.table import Table
from flexsheet.nodes.worker_processes import local_processes

MethodChoice = SoftBodyMethod | Literal["auto"]
"""A soft-body method, or `auto`. The value `auto` selects the nonlinear table if the table is
cached, and the linear method otherwise."""

SKIN_SPACING_M = 0.003
"""The default distance between skin nodes, in metres. It is used if neither a parameter nor the
scene specifies a distance."""


def choose_method(
    scene: Scene,
    method: MethodChoice,
    skin_spacing_m: float | Literal["auto"],
    *,
    compute_table: bool = False,
) -> tuple[MethodChoice, float]:
    """Choose the solution method and the skin spacing (m) of a soft body.

    method: parameter of the node. If it is `auto` and the scene selects the linear method, the
        result is `linear`. Otherwise, `auto` remains `auto`, which means: use a table if one is
        cached.
    skin_spacing_m: parameter of the node; `auto` means the value in the scene.
    compute_table: whether the result is `nonlinear_table` instead of `auto`, so that a missing
        table is computed.
    """
    choice = scene.methods.soft_body
    by_scene_m = None if choice is None else choice.skin_spacing_m
    spacing_m = resolve_method(skin_spacing_m, by_scene_m, SKIN_SPACING_M)
    if method == "auto" and choice is not None and choice.method == "linear":
        return "linear", spacing_m
    return "nonlinear_table" if compute_table and method == "auto" else method, spacing_m


@dataclass(slots=True)
class SoftBodyFactory:
    """A builder of the soft body of a scene, from models and tables in the cache.

    The linear model is computed if the cache in `cache_dir` does not contain it, which takes
    seconds to minutes. The last model is also stored in memory.

    workers: number of processes that compute a nonlinear table; 0 means one per core. scheduler:
    address of a dask scheduler whose workers compute the table instead.
    """

    skin_spacing_m: float
    cache_dir: Path
    linear_depth_m: float = 0.006
    max_depth_m: float = 0.010
    friction_ratio: float = 0.0
    workers: int = 0
    scheduler: str | None = None
    _model: tuple[str, precompute.SoftBodyModel] | None = field(default=None, init=False)

    def bodies(
        self, scene: Scene, method: MethodChoice, progress: precompute.Progress
    ) -> list[body.SceneBody]:
        """Build the soft body of a scene for each available method, starting with the best method.

        Raises UnfitMeshError if the object cannot be meshed, and MemoryError if the free memory is
        insufficient. Raises ValueError if the material, a size or a depth is invalid.
        """
        spec = body.make_soft_body_spec(
            scene, self.skin_spacing_m, sticking=self.friction_ratio > 0.0
        )
        model = self._load_model(spec, progress)
        linear = body.build_scene_body(
            scene,
            spec,
            model,
            linear_depth_m=self.linear_depth_m,
            max_depth_m=self.max_depth_m,
            friction_ratio=self.friction_ratio,
        )
        # The table cannot represent a sticking finger: it contains no tangential response.
        if method == "linear" or spec.sticking:
            return [linear]
        table = load_cached(
            precompute_table.make_table_cache(body.make_table_spec(scene, spec)), self.cache_dir
        )
        if table is None:
            return [linear]
        return [body.attach_table(linear, scene, model, table), linear]

    def is_cached(self, scene: Scene) -> bool:
        """Return whether the cache contains the linear response for a scene."""
        spec = body.make_soft_body_spec(
            scene, self.skin_spacing_m, sticking=self.friction_ratio > 0.0
        )
        return precompute.response_cache(spec).path(self.cache_dir).exists()

    def _load_model(
        self, spec: precompute.SoftBodySpec, progress: precompute.Progress
    ) -> precompute.SoftBodyModel:
        # Read `_model` only once: another thread whose result is no longer needed may replace it.
        last, key = self._model, spec.key()
        if last is None or last[0] != key:
            last = self._model = key, precompute.load_or_compute(spec, self.cache_dir, progress)
        return last[1]

    def pending_note(
        self, scene: Scene, method: MethodChoice, made: Sequence[body.SceneBody]
    ) -> str:
        """Return a note for the user if the scene's nonlinear table is missing, or an empty text.

        made: soft bodies that were built for the scene, one for each available method.
        """
        choice = scene.methods.soft_body
        waits_for_table = (
            choice is not None and choice.method == "nonlinear_table" and method == "auto"
        )
        if not waits_for_table or self.friction_ratio > 0.0 or len(made) > 1:
            return ""
        advice = advise_precompute(scene, f" --skin-spacing {self.skin_spacing_m:g}")
        return f"; the scene's nonlinear table is not computed yet; {advice}"

    def build_table(
        self,
        scene: Scene,
        linear: body.SceneBody,
        progress: precompute.Progress,
        on_quick: Callable[[body.SceneBody], None] | None = None,
    ) -> body.SceneBody:
        """Compute and cache the nonlinear table, and return the body that uses it.

        linear: body with the linear method. on_quick: function that receives a body with a coarse
        table; if it is None, no coarse table is computed. Raises WorkersError if the workers cannot
        be used or are lost, and MemoryError if the free memory is insufficient.
        """
        model = self._load_model(linear.spec, progress)

        def adopt(table: Table) -> None:
            assert on_quick is not None
            on_quick(body.attach_table(linear, scene, model, table, quick=True))

        with self._executor() as (executor, workers):
            table = precompute_table.compute_table(
                body.make_table_spec(scene, linear.spec),
                model,
                self.cache_dir,
                executor,
                progress,
                workers=workers,
                on_quick=None if on_quick is None else adopt,
            )
        return body.attach_table(linear, scene, model, table)

    @contextmanager
    def _executor(self) -> Iterator[tuple[Executor, int]]:
        """Yield the executor that computes snapshots, and its number of local workers."""
        if self.scheduler is not None:
            from flexsheet.nodes.fem_solver.dask_executor import (
                connect_workers,  # imported late, because it is slow to import
            )

            with connect_workers(self.scheduler) as executor:
                yield executor, 0
            return
        workers = self.workers or os.cpu_count() or 1
        with local_processes(workers) as executor:
            yield executor, workers


FACTORY_PARAMETERS = {one.name for one in fields(SoftBodyFactory) if one.init} - {
    "cache_dir",
    "skin_spacing_m",
}
"""The names of the node parameters that the constructor of `SoftBodyFactory` receives unchanged."""
