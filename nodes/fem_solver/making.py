"""Makes a scene's soft body, from the cache or anew: the linear method at once, the table later."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from messages.methods import SoftBodyMethod, chosen
from messages.scene import Scene
from nodes.fem_solver import body, precompute, precompute_table

MethodChoice = SoftBodyMethod | Literal["auto"]
"""`auto`: the nonlinear table if it is kept, else linear."""

SKIN_SPACING_M = 0.003
"""Where neither a parameter nor the scene says another."""


def asked(
    scene: Scene, method: MethodChoice, skin_spacing_m: float | Literal["auto"]
) -> tuple[MethodChoice, float]:
    """Method and skin spacing (m) for a scene, from a node's parameters.

    A scene that chose the linear method gets it, even where a table is kept; one that chose the
    table gets that where it is kept: minutes of work are begun by a parameter only.
    """
    choice = scene.methods.soft_body
    by_scene_m = None if choice is None else choice.skin_spacing_m
    spacing_m = chosen(skin_spacing_m, by_scene_m, SKIN_SPACING_M)
    if method == "auto" and choice is not None and choice.method == "linear":
        return "linear", spacing_m
    return method, spacing_m


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
        model = self._model_for(spec, progress)
        linear = body.scene_body(
            scene,
            spec,
            model,
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
        return [body.with_table(linear, scene, model, table), linear]

    def _model_for(
        self, spec: precompute.SoftBodySpec, progress: Callable[[int, int, Any], None]
    ) -> precompute.SoftBodyModel:
        """Return the last model if it is of this body, else load or compute it; an abandoned
        thread may do the same for another body at any moment."""
        last, key = self._model, spec.key()
        if last is None or last[0] != key:
            last = self._model = key, precompute.load_or_compute(spec, self.cache_dir, progress)
        return last[1]

    def lacking(self, scene: Scene, method: MethodChoice, made: Sequence[body.SceneBody]) -> str:
        """What a note goes on with where the scene chose a table that nobody made yet, else
        nothing; with friction there is no table to wait for."""
        choice = scene.methods.soft_body
        wanted = choice is not None and choice.method == "nonlinear_table" and method == "auto"
        if not wanted or self.friction_ratio > 0.0 or len(made) > 1:
            return ""
        return (
            "; the scene's nonlinear table is not made yet (flexsheet prepare SCENE "
            f"--skin-spacing {self.skin_spacing_m:g})"
        )

    def tabulated(
        self, scene: Scene, linear: body.SceneBody, progress: precompute_table.Progress
    ) -> body.SceneBody:
        """The body of `bodies` by its nonlinear table, which is computed and kept; errors as
        `compute_table` and `lab_workers`."""
        model = self._model_for(linear.spec, progress)
        with self._executor() as (executor, workers):
            table = precompute_table.compute_table(
                body.table_spec_of(scene, linear.spec),
                model,
                self.cache_dir,
                executor,
                progress,
                workers=workers,
            )
        return body.with_table(linear, scene, model, table)

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


GIVEN = {one.name for one in fields(Maker) if one.init} - {"cache_dir", "skin_spacing_m"}
"""What a maker takes of a node's parameters as it stands there."""
