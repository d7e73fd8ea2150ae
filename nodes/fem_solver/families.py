"""The soft body's methods for `flexsheet chart soft-body`: linear, table, Newton, and some peers.

They are judged at one place by full Newton solutions on meshes of their own.  At every depth the
finest mesh that the push can be followed on judges, and how far the next one is from it is told as
the judge's own doubt.  Deeper than any mesh can follow nothing judges: there the chart says only
how long the methods take, and how far they move the skin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import structlog
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.cache import default_cache_dir
from nodes.fem_solver import peers
from nodes.fem_solver.body import SceneBody, scene_body, spec_of
from nodes.fem_solver.carried import Hull
from nodes.fem_solver.charted import (
    Judge,
    LocalTable,
    even_job,
    focused_job,
    has_focused_meshes,
    judges_at,
    solved_jobs,
    whole_table,
)
from nodes.fem_solver.mesh import boundary_faces
from nodes.fem_solver.place import Push
from nodes.fem_solver.precompute import Need, SoftBodyModel, load_or_compute
from nodes.fem_solver.pushes import PushJob, Site
from nodes.methods import Family, Progress, Trial, up_to

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

LINEAR_SPACINGS_M = {"linear, coarse": 0.006, "linear, medium": 0.0045, "linear, fine": 0.003}
TABLE_SPACINGS_M = {"nonlinear table, medium": 0.0045}
NEWTON = "neo-Hookean Newton, 0.1 mm further"
NEWTON_RATIO = 0.64
FOCUSED_RATIOS, EVEN_SPACINGS_M = (0.32, 0.64), (0.003, 0.006)
"""Skin spacings of the judges: on meshes fine about the finger, in its radii, and on even ones, in
metres.  They judge in turn, the first of each before the second: they differ in all but the
push."""
SHALLOW_M = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.010, 0.0125, 0.015, 0.0175)
DEPTHS_M = (*SHALLOW_M, 0.020, 0.0225, 0.025, 0.0275, 0.030, 0.040, 0.050)
NEWTON_DEPTHS_M = (0.003, 0.010, 0.015)
PEER_DEPTHS_M = (0.003, 0.010)
FURTHER_M = 1e-4
PLACE_M = np.array([0.004, 0.003, 0.0])
"""Beside the place nearest to the user: no node of any mesh, so that no method is favoured."""
LINEAR_DEPTH_M, LARGEST_DEPTH_M = peers.LINEAR_RANGE_M
RIM_RATIO = 1.5
"""Errors count outside this many finger radii, where the picture shows the skin."""
FORCE = "force_error_percent"
LARGEST = "largest_move_mm"


class Answer(Protocol):
    """What a method says of a push."""

    @property
    def displacement(self) -> Floats | Floats32: ...

    @property
    def force_n(self) -> Floats: ...


@dataclass(frozen=True, slots=True)
class Charted:
    """What is charted: where, how deep, by which methods; linear_m, table_m: skin spacings by the
    methods' names; newton_m, peers_m: depths of the full Newton and of the peers; focused, even_m:
    the judges' skin spacings, in finger radii and in metres."""

    scene: Scene
    cache_dir: Path
    depths_m: Sequence[float]
    linear_m: Mapping[str, float]
    table_m: Mapping[str, float]
    newton_m: Sequence[float]
    peers_m: Sequence[float]
    focused: Sequence[float]
    even_m: Sequence[float]

    def linear(self, spacing_m: float) -> tuple[SceneBody, SoftBodyModel]:
        """The body by its linear method, precomputed if that is not kept."""
        spec = spec_of(self.scene, spacing_m)

        def say(done: int, total: int, need: Need) -> None:
            if done == 0:
                log = structlog.get_logger()
                log.info("precomputing: soft body", spacing_m=spacing_m, need=need.text())

        model = load_or_compute(spec, self.cache_dir, say)
        body = scene_body(
            self.scene,
            spec,
            model,
            linear_depth_m=LINEAR_DEPTH_M,
            largest_depth_m=LARGEST_DEPTH_M,
        )
        return body, model

    def first(self) -> SceneBody:
        return self.linear(max([*self.linear_m.values(), *self.table_m.values()]))[0]

    def site(self) -> Site:
        body = self.first()
        found = body.shape.closest(body.front + PLACE_M)
        return Site(found.point, found.normal)

    def judge_jobs(self) -> list[tuple[str, PushJob]]:
        """Names and pushes of the judges, the best first."""
        body, site = self.first(), self.site()
        jobs = []
        for focused, even in zip(self.focused, self.even_m, strict=True):
            if has_focused_meshes(body):
                job = focused_job(body, self.scene, site, focused, self.depths_m)
                spacing = 1e3 * focused * self.scene.finger.radius_m
                jobs.append((f"{spacing:.2g} mm about the finger", job))
            job = even_job(body, self.scene, site, even, self.depths_m)
            jobs.append((f"{1e3 * even:g} mm everywhere", job))
        return jobs

    def local_tables(self) -> dict[str, LocalTable]:
        """Tables around the place, for those of which the whole is not kept."""
        found = {}
        for name, spacing in self.table_m.items():
            body, model = self.linear(spacing)
            if whole_table(body, self.scene, model, self.cache_dir) is None:
                found[name] = LocalTable(body, self.scene, model, self.site())
        return found

    def prepare(self, told: Progress) -> None:
        """Solve and keep all pushes that judge or fill; minutes, the first time."""
        jobs = [job for _, job in self.judge_jobs()]
        for table in self.local_tables().values():
            jobs += table.jobs
        solved_jobs(jobs, self.cache_dir, told)

    def trials(self) -> Iterator[Trial]:
        """Each method at each depth, judged by the largest error (mm) of a skin node off the
        finger, and by the force."""
        site = self.site()
        named = self.judge_jobs()
        answers = solved_jobs([job for _, job in named], self.cache_dir, _silent)
        judges = [
            Judge(name, site, answer, Hull(answer.rest, answer.faces))
            for (name, _), answer in zip(named, answers, strict=True)
        ]
        court = Court(judges, site, self.scene)
        bodies = {name: self.linear(spacing)[0] for name, spacing in self.linear_m.items()}
        local = self.local_tables()
        for name, spacing in self.table_m.items():
            body, model = self.linear(spacing)
            kept = whole_table(body, self.scene, model, self.cache_dir)
            if kept is None:
                table = local[name]
                kept = table.body(solved_jobs(table.jobs, self.cache_dir, _silent))
            bodies[name] = kept
        for name, body in bodies.items():
            for depth in self.depths_m:
                run = partial(body.method.respond, Push(site.place, site.normal, depth))
                yield court.trial(name, depth, body.rest, run, in_range=run().in_range)
        yield from self._peers(court)
        yield from self._newton(court)

    def _peers(self, court: Court) -> Iterator[Trial]:
        if not self.peers_m:
            return
        body = self.linear(sorted(self.linear_m.values())[len(self.linear_m) // 2])[0]
        site = court.site
        solvers: dict[str, peers.Answer | None] = {
            peers.SPARSE_FACTOR: peers.sparse_factor(body, self.scene),
            peers.SCIKIT_FEM: peers.scikit_fem(body, self.scene),
        }
        for name, solver in solvers.items():
            for depth in self.peers_m:
                if solver is not None:
                    run = partial(solver, Push(site.place, site.normal, depth))
                    sure = depth <= LINEAR_DEPTH_M
                    yield court.trial(name, depth, body.rest, run, in_range=sure)
        for depth in self.peers_m:
            flex = peers.mujoco_flex(body, self.scene, Push(site.place, site.normal, depth))
            if flex is not None:
                step, nodes = flex
                yield Trial(
                    method=peers.MUJOCO,
                    case={"depth_mm": 1e3 * depth},
                    size={"mesh_nodes": nodes},
                    run=step,
                    error=lambda _: float("nan"),
                    in_range=False,
                )

    def _newton(self, court: Court) -> Iterator[Trial]:
        """What a step of the full Newton takes, from the solution a little less deep."""
        from nodes.fem_solver import pushes
        from nodes.fem_solver.newton import NeoHookeanBody, Solved

        if not self.newton_m:
            return
        job = focused_job(self.first(), self.scene, court.site, NEWTON_RATIO, self.newton_m)
        modulus = self.scene.object.material.young_modulus_pa
        solver = NeoHookeanBody(
            job.nodes,
            job.elements,
            job.fixed,
            job.faces,
            young_modulus_pa=modulus,
            poisson_ratio=job.poisson_ratio,
            finger_radius_m=job.finger_radius_m,
            tolerance=pushes.TOLERANCE,
        )
        skin = np.unique(boundary_faces(job.elements))

        def centre(depth_m: float) -> Floats:
            return job.site.place + (job.finger_radius_m - depth_m) * job.site.normal

        short = [depth - FURTHER_M for depth in self.newton_m]
        states = list(solver.follow([centre(depth) for depth in (0.0, *short)]))[1:]

        def run(state: Solved, depth: float) -> Solved:
            further = next(solver.follow([centre(depth)], start=(state.displacement, state.centre)))
            return replace(further, displacement=further.displacement[skin])

        for depth, state in zip(self.newton_m, states, strict=True):
            if state.reached:
                again = partial(run, state, depth)
                yield court.trial(NEWTON, depth, job.nodes[skin], again, in_range=True)


class Court:
    """Judges of one push, and whom they judge."""

    def __init__(self, judges: Sequence[Judge], site: Site, scene: Scene) -> None:
        self._judges, self.site = judges, site
        self._modulus = scene.object.material.young_modulus_pa
        self._rim_m = RIM_RATIO * scene.finger.radius_m

    def trial(
        self,
        method: str,
        depth_m: float,
        rest: Floats,
        run: Callable[[], Answer],
        *,
        in_range: bool,
    ) -> Trial:
        """A method's answer to the push at a depth, for skin nodes at rest (s, 3); the error is
        NaN where nothing judges."""
        away = np.linalg.norm(rest - self.site.place, axis=1) > self._rim_m
        present = judges_at(self._judges, depth_m)
        wanted = [judge.at(depth_m, rest) for judge in present[:2]]
        doubts: dict[str, float] = {}
        if len(wanted) > 1:
            (moved, force), (other, pushed) = wanted
            apart = np.linalg.norm(moved - other, axis=1)[away].max()
            doubts = {"error": 1e3 * float(apart), FORCE: 100.0 * abs(pushed / force - 1.0)}

        def error(answer: Answer) -> float:
            if not wanted:
                return float("nan")
            apart = np.linalg.norm(answer.displacement - wanted[0][0], axis=1)
            return 1e3 * float(apart[away].max())

        def also(answer: Answer) -> dict[str, float]:
            figures = {
                LARGEST: 1e3 * float(np.linalg.norm(answer.displacement, axis=1).max()),
            }
            if wanted:
                force = float(answer.force_n @ self.site.normal) / self._modulus
                figures[FORCE] = 100.0 * (force / wanted[0][1] - 1.0)
            return figures

        return Trial(
            method=method,
            case={"depth_mm": 1e3 * depth_m},
            size={"skin_nodes": len(rest), "judge": present[0].name if present else "none"},
            run=run,
            error=error,
            in_range=in_range,
            also=also,
            doubts=doubts,
        )


def _silent(done: int, total: int) -> None:
    """Progress of what is kept already."""


def charted(scene: Scene) -> Charted:
    """The chart of a scene's working range, all of it, with the user's cache."""
    deepest_m = scene.working_range.push_depth_m
    return Charted(
        scene,
        default_cache_dir(),
        depths_m=up_to(deepest_m, DEPTHS_M),
        linear_m=LINEAR_SPACINGS_M,
        table_m=TABLE_SPACINGS_M,
        newton_m=[depth for depth in NEWTON_DEPTHS_M if depth <= deepest_m],
        peers_m=[depth for depth in PEER_DEPTHS_M if depth <= deepest_m],
        focused=FOCUSED_RATIOS,
        even_m=EVEN_SPACINGS_M,
    )


def linear_only(scene: Scene) -> Charted:
    """Of the chart, what a node can answer by at once."""
    return replace(charted(scene), table_m={}, newton_m=(), peers_m=())


def tables_only(scene: Scene) -> Charted:
    """Of the chart, what a node can answer by that takes minutes to make."""
    return replace(charted(scene), linear_m={}, newton_m=(), peers_m=())


SOFT_BODY = Family(
    name="soft-body",
    unit="mm",
    reference=(
        "a neo-Hookean body of 10-node tetrahedra by Newton's method, at each depth on the finest "
        "mesh that can follow; off the finger by 1.5 of its radii"
    ),
    methods=(
        *LINEAR_SPACINGS_M,
        *TABLE_SPACINGS_M,
        peers.SPARSE_FACTOR,
        peers.SCIKIT_FEM,
        peers.MUJOCO,
        NEWTON,
    ),
    trials=lambda scene: charted(scene).trials(),
    tolerance=lambda scene: 1e3 * scene.tolerances.skin_m,
    along="depth_mm",
    prepare=lambda scene, told: charted(scene).prepare(told),
)
SOFT_BODY_LINEAR = replace(
    SOFT_BODY,
    methods=tuple(LINEAR_SPACINGS_M),
    trials=lambda scene: linear_only(scene).trials(),
    prepare=lambda scene, told: linear_only(scene).prepare(told),
)
SOFT_BODY_TABLES = replace(
    SOFT_BODY,
    methods=tuple(TABLE_SPACINGS_M),
    trials=lambda scene: tables_only(scene).trials(),
    prepare=lambda scene, told: tables_only(scene).prepare(told),
)
