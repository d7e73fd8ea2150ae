"""Makes a scene's soft body, from the cache or anew: the linear method at once, the table later."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from messages.scene import Scene
from nodes.fem_solver import body, precompute, precompute_table

MethodChoice = Literal["auto", "linear", "nonlinear_table"]


@dataclass(slots=True)
class Maker:
    """How soft bodies are made; keeps the last model, which scenes may have in common.

    workers: processes that make a table, 0: one for every core; scheduler: address of a lab's,
    whose workers make it instead.  Everything here takes seconds to minutes when the cache does
    not hold it.
    """

    skin_spacing_m: float
    cache_dir: Path
    linear_depth_m: float = 0.006
    largest_depth_m: float = 0.010
    friction_ratio: float = 0.0
    workers: int = 0
    scheduler: str | None = None
    _model: tuple[str, precompute.SoftBodyModel] | None = field(default=None, init=False)

    def bodies(
        self, scene: Scene, method: MethodChoice, progress: precompute.Progress
    ) -> list[body.SceneBody]:
        """The soft body by each method that is at hand, the best first; errors as
        `load_or_compute` and `scene_body`."""
        spec = body.spec_of(scene, self.skin_spacing_m, sticking=self.friction_ratio > 0.0)
        if self._model is None or self._model[0] != spec.key():
            model = precompute.load_or_compute(spec, self.cache_dir, progress)
            self._model = spec.key(), model
        linear = body.scene_body(
            scene,
            spec,
            self._model[1],
            linear_depth_m=self.linear_depth_m,
            largest_depth_m=self.largest_depth_m,
            friction_ratio=self.friction_ratio,
        )
        # the table knows no drag
        if method == "linear" or spec.sticking:
            return [linear]
        table = precompute_table.load_table(body.table_spec_of(scene, spec), self.cache_dir)
        if table is None:
            return [linear]
        return [body.with_table(linear, scene, self._model[1], table), linear]

    def tabulated(
        self, scene: Scene, linear: body.SceneBody, progress: precompute_table.Progress
    ) -> body.SceneBody:
        """The body of `bodies` by its nonlinear table, which is computed and kept; errors as
        `compute_table` and `lab_workers`."""
        assert self._model is not None
        with self._executor() as (executor, workers):
            table = precompute_table.compute_table(
                body.table_spec_of(scene, linear.spec),
                self._model[1],
                self.cache_dir,
                executor,
                progress,
                workers=workers,
            )
        return body.with_table(linear, scene, self._model[1], table)

    @contextmanager
    def _executor(self) -> Iterator[tuple[Executor, int]]:
        """Who solves the pushes, and how many of them do so on this machine."""
        if self.scheduler is not None:
            from nodes.fem_solver.lab import lab_workers  # late: it is slow to import

            with lab_workers(self.scheduler) as executor:
                yield executor, 0
            return
        workers = self.workers or os.cpu_count() or 1
        with precompute_table.local_processes(workers) as executor:
            yield executor, workers
