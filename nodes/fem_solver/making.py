"""Makes a scene's soft body, from the cache or anew: the linear method at once, the table later."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from messages.scene import Scene
from nodes.fem_solver import body, precompute, precompute_table

MethodChoice = Literal["auto", "linear", "nonlinear_table"]


@dataclass(slots=True)
class Maker:
    """How soft bodies are made; keeps the last model, which scenes may have in common.

    workers: processes that make a table, 0: one for every core.  Everything here takes seconds to
    minutes when the cache does not hold it.
    """

    skin_spacing_m: float
    linear_depth_m: float
    largest_depth_m: float
    friction_ratio: float
    cache_dir: Path
    workers: int
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
        `compute_table`."""
        assert self._model is not None
        workers = self.workers or os.cpu_count() or 1
        with precompute_table.local_processes(workers) as executor:
            table = precompute_table.compute_table(
                body.table_spec_of(scene, linear.spec),
                self._model[1],
                self.cache_dir,
                executor,
                progress,
                workers=workers,
            )
        return body.with_table(linear, scene, self._model[1], table)
