"""Compare methods for a mesh's normal and for rolling; a scene cannot choose among them.

Mesh normals: time of a query and error of the normal.  The reference is an ellipsoid of a liver's
size with known normals, meshed at several densities.  The tolerance is the tilt that moves the end
of the sheet's usable height by the scene's tolerance of the sheet's position.

Rolling: time of a step, and position error at the corners of the sheet's usable part after a stroke
over the object.  The reference is rolling in steps a fiftieth as long.

python -m benchmarks.planner_methods [--scene SCENE] [--output docs/charts]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from flexsheet.launch.methods.charts import make_chart_result, measure_family, write_chart
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.methods import Case, Family, Trial
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.models.shapes import (
    CylinderShape,
    EllipsoidShape,
    Shape,
    SmoothMeshShape,
    SphereShape,
    tightest_curvature,
)
from flexsheet.nodes.models.shapes.smooth_mesh import default_smoothing_m
from flexsheet.nodes.models.shapes.triangles import half_edges, triangle_normals, vertex_normals
from flexsheet.nodes.planner.rolling import (
    SheetContact,
    make_tangent_contact,
    roll_contact,
    transport_axes,
)
from tests.facets import Facets

NormalAt = Callable[[Floats], Floats]
"""The function from points (n, 3) to the unit normals (n, 3) of the nearest surface points."""

SEMI_AXES_M = (0.05, 0.03, 0.02)
SUBDIVISIONS = (2, 3, 4)
QUERIES, HEIGHT_RATIO = 400, 1.05
MAX_EDGE_RATIO = 0.35
"""The maximum ratio of median edge length to smallest radius of curvature for the jet methods."""


def ellipsoid_mesh(subdivisions: int) -> tuple[Floats, Ints]:
    """Return vertices (v, 3) on the ellipsoid, and triangles (t, 3), of a scaled icosphere."""
    # Imported late: only benchmarks need it.
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return np.asarray(ball.vertices) * SEMI_AXES_M, np.asarray(ball.faces, dtype=np.int64)


def facet_normals(vertices: Floats, triangles: Ints) -> NormalAt:
    """Return a function that computes the normal of the nearest triangle."""
    facets, normals = Facets(vertices, triangles), triangle_normals(vertices, triangles)
    return lambda points: np.asarray(normals[facets.nearest(points)[0]])


def blended_normals(vertices: Floats, triangles: Ints) -> NormalAt:
    """Return a function that interpolates the normals of vertices (Phong 1975)."""
    facets, normals = Facets(vertices, triangles), vertex_normals(vertices, triangles)

    def normal_at(points: Floats) -> Floats:
        triangle, weights = facets.nearest(points)
        blend = (weights[:, None] @ normals[triangles[triangle]])[:, 0]
        return np.asarray(blend / np.linalg.norm(blend, axis=1, keepdims=True))

    return normal_at


def jet_normals(vertices: Floats, triangles: Ints) -> NormalAt:
    """Return a function that computes normals by `SmoothMeshShape` without a previous point."""
    shape = SmoothMeshShape(vertices, triangles, default_smoothing_m(vertices, triangles))
    return lambda points: shape.closest(points).normal


def followed_jet_normals(vertices: Floats, triangles: Ints) -> NormalAt:
    """Return a function like `jet_normals` that starts from a previous point 0.3 mm away."""
    shape = SmoothMeshShape(vertices, triangles, default_smoothing_m(vertices, triangles))
    earlier: dict[bytes, Floats] = {}

    def normal_at(points: Floats) -> Floats:
        key = points.tobytes()
        if key not in earlier:
            earlier[key] = shape.closest(points + 2e-4).point
        return shape.closest(points, previous=earlier[key]).normal

    return normal_at


NORMAL_METHODS: dict[str, Callable[[Floats, Ints], NormalAt]] = {
    "facets": facet_normals,
    "blended": blended_normals,
    "jets": jet_normals,
    "jets_followed": followed_jet_normals,
}


def mesh_normal_trials(scene: Scene) -> Iterator[Trial]:
    """Yield every method at every density."""
    known = EllipsoidShape(SEMI_AXES_M)
    directions = np.random.default_rng(0).normal(size=(QUERIES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    queries = HEIGHT_RATIO * directions * SEMI_AXES_M
    wanted = known.closest(queries).normal
    tightest_m = min(SEMI_AXES_M) ** 2 / max(SEMI_AXES_M)
    for subdivisions in SUBDIVISIONS:
        vertices, triangles = ellipsoid_mesh(subdivisions)
        run = half_edges(triangles)
        edge_m = np.median(np.linalg.norm(vertices[run[:, 0]] - vertices[run[:, 1]], axis=1))
        fine = bool(edge_m < MAX_EDGE_RATIO * tightest_m)
        case: Case = {"triangles": len(triangles)}
        for name, method in NORMAL_METHODS.items():
            # Only the normal of jets has a continuous rate, whatever its error.
            in_range = fine and name.startswith("jets")
            yield _trial(
                name, method(vertices, triangles), queries, wanted, case=case, in_range=in_range
            )


def _trial(
    name: str,
    normal_at: NormalAt,
    queries: Floats,
    wanted: Floats,
    *,
    case: Case,
    in_range: bool,
) -> Trial:
    """Return a trial with the time of one query and the error of all queries."""

    def error_deg(_: Floats) -> float:
        apart = np.linalg.norm(normal_at(queries) - wanted, axis=1)
        return float(np.degrees(2.0 * np.arcsin(0.5 * apart.max())))

    return Trial(name, case, lambda: normal_at(queries[:1]), error_deg, in_range)


MESH_NORMAL = Family(
    name="mesh-normal",
    unit="deg",
    reference="an ellipsoid's known normals, the worst of 400",
    methods=tuple(NORMAL_METHODS),
    trials=mesh_normal_trials,
    tolerance=lambda scene: float(
        np.degrees(scene.tolerances.sheet_position_m / scene.sheet.usable_half_height_m)
    ),
)


RollStep = Callable[[Shape, SheetContact, Floats], SheetContact]
"""The function of a shape, the previous contact and a finger (3,) that returns the next contact."""

ROLLED_SHAPES: dict[str, Callable[[], Shape]] = {
    "cylinder": lambda: CylinderShape(0.0353553, 0.12),
    "sphere": lambda: SphereShape(0.05),
    "ellipsoid": lambda: EllipsoidShape((0.06, 0.04, 0.05)),
    "mesh": lambda: SmoothMeshShape(*ellipsoid_mesh(4), 0.0035),
}
STROKE_M, STROKE_DEPTH_M = 0.02, 0.001
ROLL_HZ, FINER = 60.0, 50
WIDE_M = 1.0
FRONT = np.array([0.0, 0.0, 1.0])
HEADING = np.array([0.6, 0.8, 0.0])


def roll_as_a_cylinder(shape: Shape, before: SheetContact, finger: Floats) -> SheetContact:
    """Roll by the angle about an axis along x, as the paper does (its Fig. 7b).

    The radius is the smallest radius of curvature at the contact.
    """
    radius = 1.0 / tightest_curvature(before.shape_operator)
    centre = before.point - radius * before.normal
    angle = np.arctan2(finger[1] - centre[1], finger[2] - centre[2])
    begun = np.arctan2(before.normal[1], before.normal[2])
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    axes = np.column_stack([[1.0, 0.0, 0.0], [0.0, normal[2], -normal[1]], normal])
    point = np.array([finger[0], *(centre + radius * normal)[1:]])
    displacement = np.array([point[0] - before.point[0], radius * (angle - begun)])
    return SheetContact(
        point, normal, before.shape_operator, axes, before.position_sheet_m + displacement
    )


def project_contact(shape: Shape, before: SheetContact, finger: Floats) -> SheetContact:
    """Return the tangent sheet at the nearest point, in contact at its centre line."""
    return make_tangent_contact(np.eye(3), shape.closest(finger, previous=before.point), WIDE_M)


def roll_by_chords(shape: Shape, before: SheetContact, finger: Floats) -> SheetContact:
    """Transport the axes, but displace the contact by the chord in the previous plane."""
    found = shape.closest(finger, previous=before.point)
    axes = transport_axes(before.axes, found.normal)
    displacement = (found.point - before.point) @ before.axes[:, :2]
    return SheetContact(
        found.point,
        found.normal,
        found.shape_operator,
        axes,
        before.position_sheet_m + displacement,
    )


def roll(shape: Shape, before: SheetContact, finger: Floats) -> SheetContact:
    """Roll the sheet by the method of the planner, `rolling.roll_contact`."""
    return roll_contact(before, shape.closest(finger, previous=before.point))


ROLLING_METHODS: dict[str, RollStep] = {
    "as_a_cylinder": roll_as_a_cylinder,
    "projection": project_contact,
    "chords": roll_by_chords,
    "transport": roll,
}


def sample_geodesic(
    shape: Shape, heading: Floats, step_m: float, steps: int
) -> tuple[Floats, Floats]:
    """Return points and normals (n, 3) along a geodesic from the front of a shape."""
    found = shape.closest(10.0 * FRONT)
    path = [(found.point, found.normal)]
    for _ in range(steps):
        heading = heading - found.normal * (found.normal @ heading)
        heading = heading / np.linalg.norm(heading)
        found = shape.closest(found.point + step_m * heading, previous=found.point)
        path.append((found.point, found.normal))
    points, normals = (np.array(part) for part in zip(*path, strict=True))
    return points, normals


def make_stroke(shape: Shape, step_m: float) -> Floats:
    """Return fingers (n, 3) along a geodesic from the front, oblique to the sheet's axes."""
    points, normals = sample_geodesic(shape, HEADING, step_m, round(STROKE_M / step_m))
    return np.asarray(points - STROKE_DEPTH_M * normals)


def roll_along(step: RollStep, shape: Shape, fingers: Floats) -> SheetContact:
    """Return the contact at the end of a stroke."""
    contact = make_tangent_contact(np.eye(3), shape.closest(fingers[0]), WIDE_M)
    for finger in fingers[1:]:
        contact = step(shape, contact, finger)
    return contact


def rolling_trials(scene: Scene) -> Iterator[Trial]:
    """Yield every method on every shape, at the scene's speed and at half of it."""
    half = np.array([0.5 * scene.sheet.width_m, scene.sheet.usable_half_height_m])
    corners = np.array([[x * half[0], y * half[1], 0.0] for x in (-1, 1) for y in (-1, 1)])
    fine_step_m = scene.working_range.speed_m_per_s / ROLL_HZ / FINER
    for name, make in ROLLED_SHAPES.items():
        shape = make()
        fine_stroke = make_stroke(shape, fine_step_m)
        for speed_ratio in (0.5, 1.0):
            every = round(speed_ratio * FINER)
            fingers = fine_stroke[::every]
            true = roll_along(roll, shape, fine_stroke[: (len(fingers) - 1) * every + 1])
            speed = speed_ratio * scene.working_range.speed_m_per_s
            for method, step in ROLLING_METHODS.items():
                yield _roll_trial(
                    method,
                    shape,
                    fingers,
                    case={"shape": name, "speed_mm_per_s": 1e3 * speed},
                    true=true,
                    corners=corners,
                    # A projection has no memory of the contact's position on the sheet.
                    in_range=step in (roll, roll_by_chords)
                    or (step is roll_as_a_cylinder and name == "cylinder"),
                )


def _roll_trial(
    method: str,
    shape: Shape,
    fingers: Floats,
    *,
    case: Case,
    true: SheetContact,
    corners: Floats,
    in_range: bool,
) -> Trial:
    """Return a trial with the time of one step and the error of the whole stroke."""
    step = ROLLING_METHODS[method]
    begun = make_tangent_contact(np.eye(3), shape.closest(fingers[0]), WIDE_M)
    wanted = apply(true.object_from_sheet, corners)

    def error_mm(_: SheetContact) -> float:
        reached = roll_along(step, shape, fingers).object_from_sheet
        return float(1e3 * np.linalg.norm(apply(reached, corners) - wanted, axis=1).max())

    return Trial(method, case, partial(step, shape, begun, fingers[1]), error_mm, in_range)


ROLLING = Family(
    name="rolling",
    unit="mm",
    reference="rolling in steps a fiftieth as long, at the usable sheet's corners after 20 mm",
    methods=tuple(ROLLING_METHODS),
    trials=rolling_trials,
    tolerance=lambda scene: 1e3 * scene.tolerances.sheet_position_m,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scene", type=Path, default=Path("launch/scenes/cylinder.yaml"))
    parser.add_argument("--output", type=Path, default=Path("docs/charts"))
    given = parser.parse_args()
    scene = load_scene(given.scene)
    for family in (MESH_NORMAL, ROLLING):
        result = make_chart_result(family, scene, measure_family(family, scene, progress=print))
        print(*write_chart(result, given.output))


if __name__ == "__main__":
    main()
