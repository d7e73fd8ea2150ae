"""The soft body's methods for `flexsheet chart soft-body`: linear, table, Newton, by one reference.

The reference is a full Newton solution at the charted place, on a mesh that is finer there than any
method's.  It is kept in the cache, as is all that is precomputed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.cache import default_cache_dir, load_arrays, save_arrays
from nodes.fem_solver import pushes
from nodes.fem_solver.body import SceneBody, scene_body, spec_of, table_spec_of, with_table
from nodes.fem_solver.carried import Hull
from nodes.fem_solver.contact import Response
from nodes.fem_solver.mesh import boundary_faces, build_mesh
from nodes.fem_solver.place import Push
from nodes.fem_solver.precompute import Need, SoftBodyModel, load_or_compute
from nodes.fem_solver.precompute_table import compute_table, load_table, local_processes
from nodes.fem_solver.pushes import PushAnswer, PushJob, Site, job_of, solve_push
from nodes.methods import Family, Trial

Floats = NDArray[np.float64]

LINEAR_SPACINGS_M = {"linear, coarse": 0.006, "linear, medium": 0.0045, "linear, fine": 0.003}
TABLE_SPACINGS_M = {"nonlinear table, medium": 0.0045}
NEWTON = "neo-Hookean Newton, 0.1 mm further"
NEWTON_RATIO, REFERENCE_RATIO = 0.64, 0.32
"""Skin spacing at the finger, in finger radii."""
DEPTHS_M = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.010, 0.015, 0.020, 0.025, 0.030)
NEWTON_DEPTHS_M = (0.003, 0.010, 0.020)
FURTHER_M = 1e-4
PLACE_M = np.array([0.004, 0.003, 0.0])
"""Beside the place nearest to the user: no node of any mesh, so that no method is favoured."""
LINEAR_DEPTH_M, LARGEST_DEPTH_M = 0.006, 0.010
RIM_RATIO = 1.5
"""Errors count outside this many finger radii, where the picture shows the skin."""
VERSION = 1


@dataclass(frozen=True, slots=True)
class Reference:
    """A push solved by Newton's method, and the hull it was solved on."""

    site: Site
    answer: PushAnswer
    hull: Hull

    def at(self, depth_m: float, points: Floats) -> Floats | None:
        """How the skin moves at its points (q, 3), or None if it was not pushed so deep."""
        level = int(np.abs(self.answer.depths_m - depth_m).argmin())
        if level >= self.answer.reached:
            return None
        nodes, weights = self.hull.weights(points)
        moved: Floats = np.einsum("qa,qai->qi", weights, self.answer.moved[level][nodes])
        return moved


def soft_body_trials(
    scene: Scene,
    *,
    linear_m: Mapping[str, float],
    table_m: Mapping[str, float],
    newton_m: Sequence[float],
    depths_m: Sequence[float],
    cache_dir: Path,
) -> Iterator[Trial]:
    """Each method at each depth to which there is a reference, judged by the largest error (mm) of
    a skin node off the finger.

    linear_m, table_m: skin spacings by the methods' names; newton_m: depths of the full Newton.
    """
    first = _linear(scene, max([*linear_m.values(), *table_m.values()]), cache_dir)
    site = _site(first[0])
    reference = _reference(first[0], scene, site, depths_m, cache_dir)
    bodies = {name: _linear(scene, spacing, cache_dir)[0] for name, spacing in linear_m.items()}
    for name, spacing in table_m.items():
        linear, model = _linear(scene, spacing, cache_dir)
        bodies[name] = _tabulated(scene, linear, model, cache_dir)
    for name, body in bodies.items():
        rest = body.rest
        for depth in depths_m:
            wanted = reference.at(depth, rest)
            if wanted is None:
                continue
            push = Push(site.place, site.normal, depth)
            yield Trial(
                method=name,
                case={"depth_mm": 1e3 * depth},
                size={"skin_nodes": len(rest)},
                run=partial(body.method.respond, push),
                error=partial(_response_error_mm, wanted=wanted, away=_away(rest, site, scene)),
                in_range=body.method.respond(push).in_range,
            )
    yield from _newton_trials(scene, first[0], reference, newton_m)


def _response_error_mm(response: Response, *, wanted: Floats, away: NDArray[np.bool_]) -> float:
    return 1e3 * float(np.linalg.norm(response.displacement - wanted, axis=1)[away].max())


def _newton_trials(
    scene: Scene, body: SceneBody, reference: Reference, depths_m: Sequence[float]
) -> Iterator[Trial]:
    """What a step of the full Newton takes, from the solution a little less deep."""
    from nodes.fem_solver.newton import NeoHookeanBody

    if not depths_m:
        return
    job = _job(body, scene, reference.site, NEWTON_RATIO, depths_m)
    solver = NeoHookeanBody(
        job.nodes,
        job.elements,
        job.fixed,
        job.faces,
        young_modulus_pa=1.0,
        poisson_ratio=job.poisson_ratio,
        finger_radius_m=job.finger_radius_m,
        tolerance=pushes.TOLERANCE,
    )

    def centre(depth_m: float) -> Floats:
        return job.site.place + (job.finger_radius_m - depth_m) * job.site.normal

    skin = np.unique(boundary_faces(job.elements))
    away = _away(job.nodes[skin], job.site, scene)
    short = [depth - FURTHER_M for depth in depths_m]
    states = list(solver.follow([centre(depth) for depth in (0.0, *short)]))[1:]
    for depth, state in zip(depths_m, states, strict=True):
        wanted = reference.at(depth, job.nodes[skin])
        if wanted is None or not state.reached:
            continue

        def run(
            state: tuple[Floats, Floats] = (state.displacement, state.centre), depth: float = depth
        ) -> Floats:
            return next(solver.follow([centre(depth)], start=state)).displacement[skin]

        def error(moved: Floats, wanted: Floats = wanted) -> float:
            return 1e3 * float(np.linalg.norm(moved - wanted, axis=1)[away].max())

        yield Trial(
            method=NEWTON,
            case={"depth_mm": 1e3 * depth},
            size={"skin_nodes": len(skin)},
            run=run,
            error=error,
            in_range=True,
        )


def _linear(scene: Scene, spacing_m: float, cache_dir: Path) -> tuple[SceneBody, SoftBodyModel]:
    spec = spec_of(scene, spacing_m)
    model = load_or_compute(spec, cache_dir, _told("soft body", spacing_m))
    body = scene_body(
        scene, spec, model, linear_depth_m=LINEAR_DEPTH_M, largest_depth_m=LARGEST_DEPTH_M
    )
    return body, model


def _tabulated(scene: Scene, linear: SceneBody, model: SoftBodyModel, cache_dir: Path) -> SceneBody:
    spec = table_spec_of(scene, linear.spec)
    table = load_table(spec, cache_dir)
    if table is None:
        workers = os.cpu_count() or 1
        told = _told("nonlinear table, in minutes", linear.spec.mesh.skin_spacing_m)
        with local_processes(workers) as executor:
            table = compute_table(spec, model, cache_dir, executor, told, workers=workers)
    return with_table(linear, scene, model, table)


def _told(what: str, spacing_m: float) -> Callable[[int, int, Need], None]:
    def say(done: int, total: int, need: Need) -> None:
        if done == 0:
            structlog.get_logger().info(
                f"precomputing: {what}", spacing_m=spacing_m, need=need.text()
            )

    return say


def _site(body: SceneBody) -> Site:
    found = body.shape.closest(body.front + PLACE_M)
    return Site(found.point, found.normal)


def _away(rest: Floats, site: Site, scene: Scene) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(rest - site.place, axis=1) > RIM_RATIO * scene.finger.radius_m)


def _job(
    body: SceneBody, scene: Scene, site: Site, ratio: float, depths_m: Sequence[float]
) -> PushJob:
    spacing = ratio * scene.finger.radius_m
    spec = replace(body.spec.mesh, skin_spacing_m=spacing)
    job = job_of(
        spec,
        build_mesh(spec),
        site,
        poisson_ratio=body.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        spacing_m=spacing,
    )
    return replace(job, depths_m=tuple(depths_m))


def _reference(
    body: SceneBody, scene: Scene, site: Site, depths_m: Sequence[float], cache_dir: Path
) -> Reference:
    """Kept by the arrays that it is computed from."""
    job = _job(body, scene, site, REFERENCE_RATIO, depths_m)
    digest = hashlib.sha256(f"{VERSION} {job.poisson_ratio} {job.finger_radius_m}".encode())
    for array in (job.nodes, job.elements, job.fixed, job.faces, site.place, site.normal):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr(job.depths_m).encode())
    path = cache_dir / f"soft-body-reference-{digest.hexdigest()[:24]}.npz"
    content = load_arrays(path)
    if content is None:
        structlog.get_logger().info("solving the reference, in minutes", nodes=len(job.nodes))
        answer = solve_push(job)
        save_arrays(
            path, {one.name: np.asarray(getattr(answer, one.name)) for one in fields(answer)}
        )
    else:
        reached = int(content.pop("reached"))
        answer = PushAnswer(reached=reached, **content)
    return Reference(site, answer, Hull(answer.rest, answer.faces))


SOFT_BODY = Family(
    name="soft-body",
    unit="mm",
    reference=(
        "a neo-Hookean body of 10-node tetrahedra, solved by Newton's method, with "
        f"{REFERENCE_RATIO:g} finger radii between skin nodes about the finger"
    ),
    methods=(*LINEAR_SPACINGS_M, *TABLE_SPACINGS_M, NEWTON),
    trials=lambda scene: soft_body_trials(
        scene,
        linear_m=LINEAR_SPACINGS_M,
        table_m=TABLE_SPACINGS_M,
        newton_m=NEWTON_DEPTHS_M,
        depths_m=DEPTHS_M,
        cache_dir=default_cache_dir(),
    ),
    tolerance=lambda scene: 1e3 * scene.tolerances.skin_m,
)
