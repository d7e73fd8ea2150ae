"""Neo-Hookean pushes that a table is made of: where, how deep, on which mesh, and their solution.

Young's modulus only scales the forces, so all is solved for 1 Pa.  A push is one job, arrays in and
arrays out, so that it can be done in another process or on another machine.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messages.scene import Cylinder, StripSupport
from nodes.fem_solver.mesh import Focus, MeshSpec, SolidMesh, boundary_faces, cylinder_mesh

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

DEPTHS_M = (0.0015, 0.003, 0.005, 0.0075, 0.010, 0.0125, 0.015, 0.0175, 0.020, 0.0225)
SPACING_RATIO = 0.35
"""Of the mesh at the push, in finger radii: 2.5 mm for the usual finger."""
NEAR_RATIO = 1.5
"""It is so fine within this many finger radii."""
STATIONS = (0.0, 0.4, 0.7, 0.9)
"""Pushes on a cylinder, over half its length from the middle."""
ANGLE_STEP_RAD, RIM_RAD = 0.42, 0.25
"""Pushes on a cylinder, around it, and how far the last stays from the touchable part's edge."""
APART_RATIO, RIM_RATIO = 2.2, 0.9
"""Pushes on other shapes: their distance, and that from what cannot be touched, in finger radii."""
TOLERANCE, SMALLEST_SHARE = 1e-5, 0.25
"""Of the solver: a table needs no more, and gives up sooner."""
SAME_RATIO = 1e-6


class StoppedError(Exception):
    """Whoever solves a push was asked to end."""


@dataclass(frozen=True, slots=True)
class Site:
    """A place (3,) and its outward normal (3,), mesh frame."""

    place: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class PushJob:
    """What is to be solved: a finger pushed down at one place, depth by depth.

    nodes (n, 3), elements (e, 10), fixed (n,); faces (f, 6) that the finger can touch.
    """

    nodes: Floats
    elements: Ints
    fixed: Bools
    faces: Ints
    site: Site
    poisson_ratio: float
    finger_radius_m: float
    depths_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PushAnswer:
    """How the skin moved: rest (s, 3), six-node faces (f, 6), moved (k, s, 3) at depths (k,), force
    (k, 3) on the finger for 1 Pa, and how many depths were reached; at others, the last holds."""

    rest: Floats
    faces: Ints
    depths_m: Floats
    moved: Floats32
    force_n: Floats
    reached: int


def solve_push(job: PushJob, stopped: Callable[[], bool] = lambda: False) -> PushAnswer:
    """Solve a job; StoppedError once `stopped` says so, else errors as `NeoHookeanBody`."""
    from nodes.fem_solver.newton import NeoHookeanBody  # late, as all that needs scipy

    body = NeoHookeanBody(
        job.nodes,
        job.elements,
        job.fixed,
        job.faces,
        young_modulus_pa=1.0,
        poisson_ratio=job.poisson_ratio,
        finger_radius_m=job.finger_radius_m,
        tolerance=TOLERANCE,
        smallest_share=SMALLEST_SHARE,
        factored_in=np.float32,
    )
    hull = boundary_faces(job.elements)
    skin = np.unique(hull)
    way = [job.site.place + (job.finger_radius_m - d) * job.site.normal for d in (0, *job.depths_m)]
    states = []
    for state in body.follow(way):
        if stopped():
            raise StoppedError
        states.append(state)
    states = states[1:]
    return PushAnswer(
        rest=job.nodes[skin],
        faces=np.searchsorted(skin, hull),
        depths_m=np.array(job.depths_m),
        moved=np.array([state.displacement[skin] for state in states], dtype=np.float32),
        force_n=np.array([state.force_n for state in states]),
        reached=sum(state.reached for state in states),
    )


def mirrors_of(mesh: SolidMesh) -> list[Floats]:
    """Reflections (3,) of signs, the identity first, that take the body and its support into
    themselves; among those across x and y."""
    from scipy.spatial import cKDTree

    # other nodes may lie as they like: they are not what makes a body symmetric
    some = np.union1d(mesh.touch, np.flatnonzero(mesh.fixed))
    points, held = mesh.nodes[some], mesh.fixed[some]
    tree, same = cKDTree(points), SAME_RATIO * float(np.ptp(points, axis=0).max())
    free = [np.ones(3)]
    for axis in (0, 1):
        signs = np.ones(3)
        signs[axis] = -1.0
        away, partner = tree.query(points * signs)
        if away.max() < same and np.array_equal(held[partner], held):
            free += [one * signs for one in free]
    return free


def sites_of(spec: MeshSpec, mesh: SolidMesh, mirrors: list[Floats], radius_m: float) -> list[Site]:
    """Where the body has to be pushed so that all that can be touched is near a push, but for
    reflections; radius_m: the finger's."""
    if isinstance(spec.geometry, Cylinder):
        return _cylinder_sites(spec.geometry, spec.touch_angle_rad, mirrors)
    points, normals = mesh.nodes[mesh.touch], mesh.touch_normals
    chosen = np.ones(len(points), dtype=bool)
    for axis in (0, 1):
        if any(signs[axis] < 0.0 for signs in mirrors):
            chosen &= points[:, axis] >= -1e-9
    others = np.setdiff1d(mesh.skin, mesh.touch)
    if len(others):
        from scipy.spatial import cKDTree

        rim, _ = cKDTree(mesh.nodes[others]).query(points)
        inner = chosen & (rim > RIM_RATIO * radius_m)
        chosen = inner if inner.any() else chosen
    points, normals = points[chosen], normals[chosen]
    # farthest first: each next place is the one farthest from all before
    numbers = [int((points @ np.array(spec.towards_user)).argmax())]
    away = np.linalg.norm(points - points[numbers[0]], axis=1)
    while away.max() > APART_RATIO * radius_m:
        numbers.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[numbers[-1]], axis=1))
    return [Site(points[number], normals[number]) for number in numbers]


def _cylinder_sites(cylinder: Cylinder, touch_rad: float, mirrors: list[Floats]) -> list[Site]:
    last = max(touch_rad - RIM_RAD, 0.5 * touch_rad)
    angles = np.linspace(0.0, last, int(np.ceil(last / ANGLE_STEP_RAD)) + 1)
    x = 0.5 * cylinder.length_m * np.array(STATIONS)
    if not any(signs[0] < 0.0 for signs in mirrors):
        x = np.append(-x[:0:-1], x)
    if not any(signs[1] < 0.0 for signs in mirrors):
        angles = np.append(-angles[:0:-1], angles)
    sites = []
    for station, angle in itertools.product(x, angles):
        normal = np.array([0.0, np.sin(angle), np.cos(angle)])
        sites.append(Site(cylinder.radius_m * normal + [station, 0.0, 0.0], normal))
    return sites


def job_of(
    spec: MeshSpec,
    mesh: SolidMesh,
    site: Site,
    *,
    poisson_ratio: float,
    finger_radius_m: float,
    spacing_m: float | None = None,
) -> PushJob:
    """The job of a push: on a mesh that is fine just there where the shape has one, else on its
    own.  spacing_m: of skin nodes there; None: as a table wants it."""
    geometry, support = spec.geometry, spec.support
    if isinstance(geometry, Cylinder) and isinstance(support, StripSupport):
        focus = Focus(
            x_m=float(site.place[0]),
            angle_rad=float(np.arctan2(site.normal[1], site.normal[2])),
            near_m=NEAR_RATIO * finger_radius_m,
        )
        mesh = cylinder_mesh(
            radius_m=geometry.radius_m,
            length_m=geometry.length_m,
            support_angle_rad=support.angle_rad,
            touch_angle_rad=np.pi - 0.5 * support.angle_rad,
            skin_spacing_m=spacing_m or min(SPACING_RATIO * finger_radius_m, spec.skin_spacing_m),
            focus=focus,
        )
    return PushJob(
        nodes=mesh.nodes,
        elements=mesh.elements,
        fixed=mesh.fixed,
        faces=mesh.touch[mesh.touch_faces],
        site=site,
        poisson_ratio=poisson_ratio,
        finger_radius_m=finger_radius_m,
        depths_m=DEPTHS_M,
    )


def reflected(answer: PushAnswer, site: Site, signs: Floats) -> tuple[PushAnswer, Site]:
    """The same push on the body's mirror image."""
    faces = answer.faces
    if signs.prod() < 0.0:
        faces = faces[:, [0, 2, 1, 5, 4, 3]]
    image = replace(
        answer,
        rest=answer.rest * signs,
        faces=faces,
        moved=answer.moved * signs.astype(np.float32),
        force_n=answer.force_n * signs,
    )
    return image, Site(site.place * signs, site.normal * signs)
