"""What the sheet does on every shape: it rolls as exactly as it must, and where it cannot go on the
outcome is decided and never a step."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from launch.meshes import read_mesh
from messages.scene import Mesh
from nodes.models.rigid import angle_between
from nodes.models.shapes import EllipsoidShape, Shape, make_shape
from nodes.planner.families import ellipsoid_mesh
from nodes.planner.motion import Planned
from tests.plans import STEP_S, Desk, scene_with

Floats = NDArray[np.float64]
LIVER = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "mesh" / "liver.obj"
RADIUS = 0.0353553
FRONT = np.array([0.0, 0.0, 1.0])

SOLIDS: dict[str, dict[str, Any]] = {
    "cylinder": {"shape": "cylinder", "radius_m": RADIUS, "length_m": 0.12},
    "sphere": {"shape": "sphere", "radius_m": 0.05},
    "ellipsoid": {"shape": "ellipsoid", "semi_axes_m": (0.06, 0.04, 0.05)},
    "plane": {"shape": "plane", "width_m": 0.16, "height_m": 0.12},
    "box": {"shape": "rounded_box", "size_m": (0.1, 0.08, 0.06), "edge_radius_m": 0.02},
}


def as_mesh(vertices: Floats, triangles: NDArray[np.int64], smoothing_m: float) -> dict[str, Any]:
    """The geometry of a scene with that mesh."""
    mesh = Mesh(
        vertices_m=vertices,
        triangles=triangles.astype(np.int32),
        smoothing_m=smoothing_m,
        origin="made by a test",
    )
    return dict(mesh)


@lru_cache
def meshed() -> dict[str, Any]:
    """An ellipsoid of 50 x 30 x 20 mm as 5120 triangles."""
    return as_mesh(*ellipsoid_mesh(4), 0.0035)


@lru_cache
def lobes() -> dict[str, Any]:
    """Two lobes of 30 mm radius, side by side along y, with a saddle between them."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    out = np.asarray(ball.vertices)
    reach = 0.03 * (1.0 + 0.8 * np.abs(out[:, 1]) ** 2 - 0.25 * out[:, 2] ** 4)
    return as_mesh(out * reach[:, None], np.asarray(ball.faces, dtype=np.int64), 0.006)


@lru_cache
def bowl() -> dict[str, Any]:
    """A block of 100 x 100 mm whose top is a hollow of 60 mm radius at its middle, z = r^2 / 2R."""
    import trimesh

    ticks = np.linspace(-0.05, 0.05, 41)
    x, y = (part.ravel() for part in np.meshgrid(ticks, ticks, indexing="ij"))
    top = np.column_stack([x, y, (x * x + y * y) / 0.12])
    bottom = np.column_stack([x, y, np.full(len(x), -0.03)])
    cells = np.arange(41 * 41).reshape(41, 41)
    a, b, c, d = (
        part.ravel() for part in (cells[:-1, :-1], cells[1:, :-1], cells[1:, 1:], cells[:-1, 1:])
    )
    up = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    rim = np.concatenate([cells[:, 0], cells[-1, 1:], cells[-2::-1, -1], cells[0, -2::-1]])
    low = rim + len(x)
    walls = np.concatenate(
        [
            np.column_stack([rim[:-1], low[:-1], rim[1:]]),
            np.column_stack([rim[1:], low[:-1], low[1:]]),
        ]
    )
    faces = np.concatenate([up, up[:, ::-1] + len(x), walls])
    mesh = trimesh.Trimesh(np.concatenate([top, bottom]), faces, process=False)
    assert mesh.is_watertight
    mesh.fix_normals()
    return as_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64), 0.008)


MESHES: dict[str, Callable[[], dict[str, Any]]] = {"meshed": meshed, "lobes": lobes, "bowl": bowl}


@lru_cache
def desk_about(name: str) -> tuple[Desk, Shape]:
    geometry = SOLIDS[name] if name in SOLIDS else MESHES[name]()
    return Desk(scene_with(geometry)), make_shape(geometry)


def fresh(name: str) -> tuple[Desk, Shape]:
    """A desk as new, and the shape: a mesh's is made once, which takes a second."""
    desk, shape = desk_about(name)
    new = copy.copy(desk)
    new.plan, new.seen = copy.copy(desk.plan), []
    # The plan alone knows its encounter, and that changes by assignment only.
    new.plan._encounter = copy.copy(desk.plan._encounter)
    return new, shape


def walk(
    shape: Shape, start: Floats, heading: Floats, step_m: float, steps: int
) -> tuple[Floats, Floats, Floats]:
    """Points, normals (n, 3) and curvatures along the way (n,) of a straightest way."""
    found = shape.closest(start)
    point, normal, way = found.point, found.normal, []
    for _ in range(steps):
        way.append((point, normal, np.linalg.norm(found.shape_operator)))
        heading = heading - normal * (normal @ heading)
        heading = heading / np.linalg.norm(heading)
        found = shape.closest(point + step_m * heading, previous=point)
        point, normal = found.point, found.normal
    points, normals, bends = (np.array(part) for part in zip(*way, strict=True))
    return points, normals, bends


def touch(desk: Desk, point: Floats, normal: Floats, depth_m: float = 0.001) -> Planned:
    """Come from above, touch, and rest there."""
    desk.rest(point + 0.03 * normal)
    desk.follow(point + np.linspace(0.03, -depth_m, 60)[:, None] * normal)
    return desk.rest(point - depth_m * normal, 40)


def phases(planned: list[Planned]) -> list[str]:
    return [one.presentation.phase for one in planned]


def reasons(planned: list[Planned]) -> set[str]:
    return {one.presentation.reason for one in planned}


def eased_path(corners: list[Floats], steps: int) -> Floats:
    """Through corners, at rest at each, by the smooth step."""
    share = np.linspace(0.0, 1.0, steps)[1:, None]
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    legs = [a + smooth * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([corners[0][None], *legs])


# What the rolling must reach


@pytest.mark.parametrize(("frames", "depth_m"), [(600, 0.001), (180, 0.001), (300, 0.004)])
def test_after_60_degrees_on_the_cylinder_arc_and_way_on_the_sheet_are_equal(
    frames: int, depth_m: float
) -> None:
    """|arc AB - length A'B| <= 0.01 mm, of the sheet as it is sent to the arms."""
    desk, _ = fresh("cylinder")
    first = touch(desk, RADIUS * FRONT, FRONT, depth_m)
    angle = np.radians(60.0) * eased_path([np.zeros(1), np.ones(1)], frames)[:, 0]
    reach = RADIUS - depth_m
    path = np.column_stack([0.0 * angle, reach * np.sin(angle), reach * np.cos(angle)])
    sent = desk.follow(path)
    last = desk.rest(path[-1], 30)
    assert set(phases(sent)) == {"contact"}
    way_m = np.linalg.norm(last.contact_sheet_m - first.contact_sheet_m)
    assert abs(way_m - RADIUS * np.radians(60.0)) <= 1e-5
    desk.assert_bounded()


@pytest.mark.parametrize(
    "corners_deg", [(20.0, 20.0), (25.0, -15.0), (12.0, 28.0)], ids=["even", "other way", "thin"]
)
def test_a_closed_triangle_on_a_sphere_turns_the_sheet_by_its_solid_angle(
    corners_deg: tuple[float, float],
) -> None:
    """To 0.01 degrees, of the sheet as it is sent to the arms."""
    radius = 0.05
    desk, _ = fresh("sphere")
    first = touch(desk, radius * FRONT, FRONT)
    a = FRONT
    b = np.array(
        [math.sin(math.radians(corners_deg[0])), 0.0, math.cos(math.radians(corners_deg[0]))]
    )
    lean = math.radians(corners_deg[1])
    c = np.array([0.0, math.sin(lean), math.cos(lean)])
    sides = []
    for begin, end in ((a, b), (b, c), (c, a)):
        angle = angle_between(begin, end)
        share = eased_path([np.zeros(1), np.ones(1)], 150)
        sides.append(np.sin((1 - share) * angle) * begin + np.sin(share * angle) * end)
        sides[-1] /= np.sin(angle)
    sent = desk.follow((radius - 0.001) * np.concatenate(sides))
    last = desk.rest((radius - 0.001) * a, 60)
    assert set(phases(sent)) == {"contact"}
    before, after = (desk.object_from_sheet(one)[:3, :3] for one in (first, last))
    turn = math.atan2(*(after[:, 0] @ before[:, axis] for axis in (1, 0)))
    solid = 2.0 * math.atan2(float(np.cross(a, b) @ c), float(1.0 + a @ b + b @ c + c @ a))
    assert abs(solid) > math.radians(1.0)
    assert abs(turn - solid) <= math.radians(0.01)
    assert after[:, 2] == pytest.approx(a, abs=1e-6)
    desk.assert_bounded()


TURNED_PER_S = 0.8
"""A stroke so fast that the sheet turns by this, rad/s: half of what the edges' speed allows."""


def normal_errors_deg(
    desk: Desk, judge: Shape, start: Floats, heading: Floats, length_m: float
) -> Floats:
    """How far off the sheet's normal is, along a stroke whose speed suits its tightest bend."""
    _, _, bends = walk(judge, start, heading, 5e-4, int(length_m / 5e-4))
    step_m = min(0.03, TURNED_PER_S / bends.max()) * STEP_S
    points, normals, _ = walk(judge, start, heading, step_m, int(length_m / step_m))
    touch(desk, points[0], normals[0])
    # A hand starts and stops gently.
    share = eased_path([np.zeros(1), np.full(1, len(points) - 1.0)], 2 * len(points))[:, 0]
    fingers = np.column_stack(
        [np.interp(share, np.arange(len(points)), axis) for axis in (points - 0.001 * normals).T]
    )
    sent = desk.follow(fingers)
    assert set(phases(sent)) == {"contact"}, reasons(sent)
    wanted = judge.closest(
        fingers, previous=fingers + 0.001 * np.repeat(normals[:1], len(fingers), 0)
    )
    return np.degrees(
        [
            angle_between(desk.object_from_sheet(planned)[:3, 2], normal)
            for planned, normal in zip(sent, wanted.normal, strict=True)
        ]
    )


@pytest.mark.parametrize("heading", [(1.0, 0.2, 0.0), (0.3, 1.0, 0.0), (-0.6, 0.8, 0.0)])
def test_on_a_mesh_the_sheets_normal_is_the_smooth_surfaces(heading: tuple[float, ...]) -> None:
    """Within 0.5 degrees of the ellipsoid that was meshed, with bounded acceleration and jerk."""
    desk, _ = fresh("meshed")
    known = EllipsoidShape((0.05, 0.03, 0.02))
    errors = normal_errors_deg(desk, known, np.array([0.0, 0.0, 0.05]), np.array(heading), 0.012)
    assert errors.max() < 0.5
    desk.assert_bounded()


@lru_cache
def liver() -> dict[str, Any]:
    if not LIVER.is_file():
        pytest.skip(f"the real mesh is not there: {LIVER}")
    return dict(read_mesh(LIVER, 0.01, None))


@lru_cache
def desk_on_liver() -> tuple[Desk, Shape]:
    """Its dome, where y is up, turned to the user."""
    return Desk(scene_with(liver(), rpy_rad=(0.5 * math.pi, 0.0, 0.0))), make_shape(liver())


LIVER_STARTS = ((-0.012, 0.1, 0.006), (0.0, 0.1, 0.0), (-0.02, 0.1, -0.004))


@pytest.mark.parametrize("start", LIVER_STARTS)
@pytest.mark.parametrize("heading", [(1.0, 0.0, 0.2), (-0.4, 0.0, 1.0)])
def test_on_the_real_mesh_the_sheets_normal_is_the_smooth_surfaces(
    start: tuple[float, ...], heading: tuple[float, ...]
) -> None:
    """Within 0.5 degrees along a stroke of 12 mm, with bounded acceleration and jerk."""
    desk, shape = desk_on_liver()
    desk.seen = []
    errors = normal_errors_deg(desk, shape, np.array(start), np.array(heading), 0.012)
    assert errors.max() < 0.5
    desk.assert_bounded()
