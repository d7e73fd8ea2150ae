"""Build a scene's soft body, with the linear method or the nonlinear table, cached or computed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from flexsheet.messages.methods import SoftBodyMethod, resolve_method
from flexsheet.messages.scene import Scene
from flexsheet.nodes.cache import load_cached
from flexsheet.nodes.fem_solver import body, precompute, precompute_table

MethodChoice = SoftBodyMethod | Literal["auto"]
"""Method, or `auto`: the nonlinear table if it is cached, else linear."""

SKIN_SPACING_M = 0.003
"""Default skin spacing without a parameter and a scene setting."""


def choose_method(
    scene: Scene, method: MethodChoice, skin_spacing_m: float | Literal["auto"]
) -> tuple[MethodChoice, float]:
    """Return method and skin spacing (m) for a scene and a node's parameters.

    With `auto`, the scene's choice of the linear method applies even if a table is cached. The
    scene's choice of the table never starts its computation, which takes minutes; only the
    parameter does.
    """
    choice = scene.methods.soft_body
    by_scene_m = None if choice is None else choice.skin_spacing_m
    spacing_m = resolve_method(skin_spacing_m, by_scene_m, SKIN_SPACING_M)
    if method == "auto" and choice is not None and choice.method == "linear":
        return "linear", spacing_m
    return method, spacing_m


@dataclass(slots=True)
class SoftBodyFactory:
    """Factory of soft bodies that caches the last model in memory.

    workers: number of processes for a table, 0: one per core. scheduler: address of a dask
    scheduler whose workers compute the table instead. All methods take seconds to minutes when the
    cache is empty.
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
        """Return the soft body with each available method, the best first.

        Raises the errors of `load_or_compute` and `build_scene_body`.
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
        # The table has no tangential response.
        if method == "linear" or spec.sticking:
            return [linear]
        table = load_cached(
            precompute_table.make_table_cache(body.make_table_spec(scene, spec)), self.cache_dir
        )
        if table is None:
            return [linear]
        return [body.attach_table(linear, scene, model, table), linear]

    def _load_model(
        self, spec: precompute.SoftBodySpec, progress: Callable[[int, int, Any], None]
    ) -> precompute.SoftBodyModel:
        """Return the last model if it is of this body, else load or compute it.

        An abandoned thread may concurrently replace the last model, so it is read only once.
        """
        last, key = self._model, spec.key()
        if last is None or last[0] != key:
            last = self._model = key, precompute.load_or_compute(spec, self.cache_dir, progress)
        return last[1]

    def pending_note(
        self, scene: Scene, method: MethodChoice, made: Sequence[body.SceneBody]
    ) -> str:
        """Return a note that the scene's nonlinear table is not computed yet, or an empty text."""
        choice = scene.methods.soft_body
        waits_for_table = (
            choice is not None and choice.method == "nonlinear_table" and method == "auto"
        )
        if not waits_for_table or self.friction_ratio > 0.0 or len(made) > 1:
            return ""
        return (
            "; the scene's nonlinear table is not computed yet (flexsheet precompute SCENE "
            f"--skin-spacing {self.skin_spacing_m:g})"
        )

    def build_table(
        self, scene: Scene, linear: body.SceneBody, progress: precompute_table.Progress
    ) -> body.SceneBody:
        """Compute and cache the nonlinear table and return the body with it.

        Errors as `compute_table` and `connect_workers`.
        """
        model = self._load_model(linear.spec, progress)
        with self._executor() as (executor, workers):
            table = precompute_table.compute_table(
                body.make_table_spec(scene, linear.spec),
                model,
                self.cache_dir,
                executor,
                progress,
                workers=workers,
            )
        return body.attach_table(linear, scene, model, table)

    @contextmanager
    def _executor(self) -> Iterator[tuple[Executor, int]]:
        """Yield the executor for snapshots and the number of its workers on this machine."""
        if self.scheduler is not None:
            from flexsheet.nodes.fem_solver.dask_executor import (
                connect_workers,  # late: it is slow to import
            )

            with connect_workers(self.scheduler) as executor:
                yield executor, 0
            return
        workers = self.workers or os.cpu_count() or 1
        with precompute_table.local_processes(workers) as executor:
            yield executor, workers


FACTORY_PARAMETERS = {one.name for one in fields(SoftBodyFactory) if one.init} - {
    "cache_dir",
    "skin_spacing_m",
}
"""Node parameters that are passed to the factory unchanged."""
