"""Measure the error and the time of the soft-body methods for `flexsheet chart soft-body`.

The methods are the linear method, the nonlinear table, and Newton's method. The references are full
Newton solutions of one push on separate, finer meshes. At each push depth, the reference is the
converged solution on the finest mesh. Its difference from the solution on the second finest mesh is
the uncertainty of the reference. If no solution converged at a depth, the chart shows only the time
and the maximum displacement of the skin (the surface of the body).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from flexsheet.messages.methods import SoftBodyChoice
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.arrays import Floats, Singles
from flexsheet.nodes.cache import default_cache_dir
from flexsheet.nodes.fem_solver import snapshots
from flexsheet.nodes.fem_solver.body import SceneBody
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.mesh.solid import boundary_faces
from flexsheet.nodes.fem_solver.newton import EquilibriumState, NeoHookeanBody
from flexsheet.nodes.fem_solver.reference import (
    ReferenceSolution,
    make_focused_job,
    solve_cached_jobs,
)
from flexsheet.nodes.fem_solver.snapshot_interpolator import SurfaceLocator
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, SnapshotJob
from flexsheet.nodes.fem_solver.soft_body_factory import load_body, prepare_body
from flexsheet.nodes.methods import Family, Progress, Trial, clip_range

LINEAR = {
    f"linear, {name}": SoftBodyChoice(method="linear", skin_spacing_m=spacing_m)
    for name, spacing_m in (("coarse", 0.006), ("medium", 0.0045), ("fine", 0.003))
}
TABLES = {
    "nonlinear table, medium": SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.0045)
}
NEWTON = "neo-Hookean Newton, 0.1 mm further"
NEWTON_RATIO = 0.64
REFERENCE_RATIOS = (0.32, 0.45)
"""The distances between the skin nodes of the reference meshes near the finger, in finger radii.
The finest mesh comes first."""
SHALLOW_M = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.010, 0.0125, 0.015, 0.0175)
DEPTHS_M = (*SHALLOW_M, 0.020, 0.0225, 0.025, 0.0275, 0.030, 0.040, 0.050)
NEWTON_DEPTHS_M = (0.003, 0.010, 0.015)
NEWTON_STEP_M = 1e-4
SAMPLE_OFFSET_M = np.array([0.004, 0.003, 0.0])
"""The offset (m) of the pushed point from the surface point nearest to the user. With this offset,
the pushed point is not a node of any mesh. A push at a node would favour the methods that use this
mesh."""
RIM_RATIO = 1.5
"""The distance from the push, in finger radii, within which displacement errors are ignored,
because the finger hides the skin."""
FORCE = "force_error_percent"
MAX_DISPLACEMENT = "largest_move_mm"


class SkinSolution(Protocol):
    """A soft-body solution for one push, as any of the methods returns it.

    displacement (s, 3): displacement of the s skin nodes, m. force_n (3,): force, N.
    """

    @property
    def displacement(self) -> Floats | Singles: ...

    @property
    def force_n(self) -> Floats: ...


@dataclass(frozen=True, slots=True)
class SoftBodyBenchmark:
    """A benchmark of the soft-body methods for pushes at one surface point of a scene's object.

    depths_m: push depths.
    choices: methods with the distances between skin nodes, by the names in the chart. A table that
        is not cached is replaced by the coarse table.
    newton_m: depths at which the time of full Newton solutions is measured.
    ratios: distances between skin nodes of the reference meshes near the finger, in finger radii.
    """

    scene: Scene
    cache_dir: Path
    depths_m: Sequence[float]
    choices: Mapping[str, SoftBodyChoice]
    newton_m: Sequence[float]
    ratios: Sequence[float]

    def body(self, choice: SoftBodyChoice) -> SceneBody:
        """Return the soft body with a method, from the cache."""
        return load_body(self.scene, choice, self.cache_dir, lambda *_: None)

    def coarsest(self) -> SceneBody:
        """Return the soft body with the coarsest skin mesh."""
        return self.body(max(self.choices.values(), key=lambda choice: choice.skin_spacing_m))

    def sample(self) -> SamplePoint:
        """Return the surface point that is pushed in all trials."""
        body = self.coarsest()
        found = body.shape.closest(body.front + SAMPLE_OFFSET_M)
        return SamplePoint(found.point, found.normal)

    def reference_jobs(self) -> list[tuple[str, SnapshotJob]]:
        """Return the name and the inputs of each reference solution, most accurate first."""
        body, sample = self.coarsest(), self.sample()
        jobs = []
        for ratio in self.ratios:
            job = make_focused_job(body, self.scene, sample, ratio, self.depths_m)
            jobs.append((f"{1e3 * ratio * self.scene.finger.radius_m:.2g} mm", job))
        return jobs

    def prepare(self, on_progress: Progress) -> None:
        """Compute and cache the soft bodies and all reference solutions."""
        for choice in self.choices.values():
            prepare_body(
                self.scene,
                choice,
                self.cache_dir,
                lambda done, total, need: on_progress(done, total),
            )
        solve_cached_jobs([job for _, job in self.reference_jobs()], self.cache_dir, on_progress)

    def reference_set(self) -> ReferenceSet:
        """Load the reference solutions from the cache, or compute them."""
        sample, named = self.sample(), self.reference_jobs()
        solved = solve_cached_jobs([job for _, job in named], self.cache_dir, _ignore_progress)
        references = [
            ReferenceSolution(name, sample, one, SurfaceLocator(one.rest, one.faces))
            for (name, _), one in zip(named, solved, strict=True)
        ]
        return ReferenceSet(references, sample, self.scene)

    def trials(self) -> Iterator[Trial]:
        """Yield one trial (a measurement of one method) for each method and push depth.

        The error of a trial is the maximum displacement error of the skin nodes that the finger
        does not hide, in mm. The force error is an additional metric.
        """
        sample, references = self.sample(), self.reference_set()
        for name, choice in self.choices.items():
            body = self.body(choice)
            for depth in self.depths_m:
                query = ContactQuery(sample.point, sample.normal, depth)
                run = partial(body.method.respond, query)
                yield references.trial(name, depth, body.rest, run, in_range=run().in_range)
        yield from self._newton_trials(references)

    def _newton_trials(self, references: ReferenceSet) -> Iterator[Trial]:
        """Yield one trial of the full Newton method for each depth in `newton_m`.

        Each trial is one load step that increases the depth by `NEWTON_STEP_M` to the given depth.
        """
        if not self.newton_m:
            return
        job = make_focused_job(
            self.coarsest(), self.scene, references.sample, NEWTON_RATIO, self.newton_m
        )
        modulus = require_material(self.scene).young_modulus_pa
        solver = NeoHookeanBody(
            job.nodes,
            job.elements,
            job.fixed,
            job.faces,
            young_modulus_pa=modulus,
            poisson_ratio=job.poisson_ratio,
            finger_radius_m=job.finger_radius_m,
            tolerance=snapshots.TOLERANCE,
            finger_axis=job.sample.normal,
        )
        skin = np.unique(boundary_faces(job.elements))

        def centre(depth_m: float) -> Floats:
            return job.sample.point + (job.finger_radius_m - depth_m) * job.sample.normal

        start_depths = [depth - NEWTON_STEP_M for depth in self.newton_m]
        path = [centre(depth) for depth in (0.0, *start_depths)]
        states = list(solver.solve_load_steps(path))[1:]

        def run(state: EquilibriumState, depth: float) -> EquilibriumState:
            start = (state.displacement, state.centre)
            end = next(solver.solve_load_steps([centre(depth)], start=start))
            return replace(end, displacement=end.displacement[skin])

        for depth, state in zip(self.newton_m, states, strict=True):
            if state.reached:
                step = partial(run, state, depth)
                yield references.trial(NEWTON, depth, job.nodes[skin], step, in_range=True)


class ReferenceSet:
    """Reference solutions for pushes at one surface point, sorted from most to least accurate.

    The error of a method is its difference from the most accurate solution. The uncertainty is the
    difference between the two most accurate solutions.
    """

    def __init__(
        self, references: Sequence[ReferenceSolution], sample: SamplePoint, scene: Scene
    ) -> None:
        self._references, self.sample = references, sample
        self._modulus = require_material(scene).young_modulus_pa
        self._rim_m = RIM_RATIO * scene.finger.radius_m

    def trial(
        self,
        method: str,
        depth_m: float,
        rest: Floats,
        run: Callable[[], SkinSolution],
        *,
        in_range: bool,
    ) -> Trial:
        """Return the trial (measurement) of a method at one push depth.

        rest (s, 3): undeformed positions of the s skin nodes, m.
        run: function that computes the solution.
        in_range: whether the method is valid at this depth.

        The error is NaN if no reference converged at the depth.
        """
        off_finger = np.linalg.norm(rest - self.sample.point, axis=1) > self._rim_m
        present = [one for one in self._references if one.reaches(depth_m)]
        expected = [reference.evaluate(depth_m, rest) for reference in present[:2]]
        uncertainty: dict[str, float] = {}
        if len(expected) > 1:
            (best_m, best_n), (second_m, second_n) = expected
            difference = np.linalg.norm(best_m - second_m, axis=1)[off_finger].max()
            uncertainty = {
                "error": 1e3 * float(difference),
                FORCE: 100.0 * abs(second_n / best_n - 1.0),
            }

        def error(solution: SkinSolution) -> float:
            if not expected:
                return float("nan")
            difference = np.linalg.norm(solution.displacement - expected[0][0], axis=1)
            return 1e3 * float(difference[off_finger].max())

        def extra_metrics(solution: SkinSolution) -> dict[str, float]:
            largest = float(np.linalg.norm(solution.displacement, axis=1).max())
            metrics = {MAX_DISPLACEMENT: 1e3 * largest}
            if expected:
                force = float(solution.force_n @ self.sample.normal) / self._modulus
                metrics[FORCE] = 100.0 * (force / expected[0][1] - 1.0)
            return metrics

        return Trial(
            method=method,
            case={"depth_mm": 1e3 * depth_m},
            size={"skin_nodes": len(rest), "reference": present[0].name if present else "none"},
            run=run,
            error=error,
            in_range=in_range,
            extra_metrics=extra_metrics,
            reference_uncertainty=uncertainty,
        )


def _ignore_progress(done: int, total: int) -> None:
    """Ignore progress reports, because the solutions are usually in the cache."""


def make_benchmark(scene: Scene) -> SoftBodyBenchmark:
    """Return the benchmark of all soft-body methods up to the maximum push depth of a scene."""
    max_depth_m = scene.working_range.push_depth_m
    return SoftBodyBenchmark(
        scene,
        default_cache_dir(),
        depths_m=clip_range(max_depth_m, DEPTHS_M),
        choices=LINEAR | TABLES,
        newton_m=[depth for depth in NEWTON_DEPTHS_M if depth <= max_depth_m],
        ratios=REFERENCE_RATIOS,
    )


def _family(methods: Sequence[str], **changes: Any) -> Family:
    """Define a benchmark of soft-body methods for the benchmark charts.

    methods: names of the methods that are measured.
    changes: values that replace fields of the default `SoftBodyBenchmark`.
    """

    def benchmark(scene: Scene) -> SoftBodyBenchmark:
        return replace(make_benchmark(scene), **changes)

    return Family(
        name="soft-body",
        unit="mm",
        reference=(
            "a neo-Hookean body of 10-node tetrahedra by Newton's method, at each depth on the "
            "finest mesh that reaches it; beyond 1.5 finger radii from the push"
        ),
        methods=tuple(methods),
        trials=lambda scene: benchmark(scene).trials(),
        tolerance=lambda scene: 1e3 * scene.tolerances.skin_m,
        sweep_key="depth_mm",
        prepare=lambda scene, on_progress: benchmark(scene).prepare(on_progress),
    )


SOFT_BODY = _family([*LINEAR, *TABLES, NEWTON])
SOFT_BODY_LINEAR = _family([*LINEAR], choices=LINEAR, newton_m=())
SOFT_BODY_TABLES = _family([*TABLES], choices=TABLES, newton_m=())
"""The benchmarks of all methods (`SOFT_BODY`), of the linear methods only (`SOFT_BODY_LINEAR`), and
of the nonlinear tables only (`SOFT_BODY_TABLES`)."""
