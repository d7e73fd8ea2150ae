"""Test the sheet on every shape: exact rolling, and defined outcomes without a step at its
limits."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.planner import ellipsoid_mesh
from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.messages.scene import Mesh
from flexsheet.nodes.models.rigid import angle_between
from flexsheet.nodes.models.shapes import (
    EllipsoidShape,
    MeshError,
    Shape,
    SmoothMeshShape,
    make_shape,
)
from flexsheet.nodes.planner import contact_state, trajectory
from flexsheet.nodes.planner.contact_state import (
    ContactCommand,
    ContactLimits,
    ContactStateMachine,
    UnpresentableError,
)
from flexsheet.nodes.planner.trajectory import PlannedStep
from tests.examples import examples, long_except
from tests.plans import STEP_S, STILL, PlannerHarness, scene_with
from tests.shared import compute_once

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
    """Return a geometry of a scene with that mesh."""
    mesh = Mesh(
        vertices_m=vertices,
        triangles=triangles.astype(np.int32),
        smoothing_m=smoothing_m,
        origin="made by a test",
    )
    return dict(mesh)


@lru_cache
def meshed() -> dict[str, Any]:
    """Return an ellipsoid of 50 x 30 x 20 mm as 5120 triangles."""
    return as_mesh(*ellipsoid_mesh(4), 0.0035)


@lru_cache
def lobes() -> dict[str, Any]:
    """Return two lobes of 30 mm radius along y, with a saddle between them."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    out = np.asarray(ball.vertices)
    reach = 0.03 * (1.0 + 0.8 * np.abs(out[:, 1]) ** 2 - 0.25 * out[:, 2] ** 4)
    return as_mesh(out * reach[:, None], np.asarray(ball.faces, dtype=np.int64), 0.006)


@lru_cache
def bowl() -> dict[str, Any]:
    """Return a block of 100 x 100 mm with a concave top of 60 mm radius, z = r^2 / 2R."""
    import trimesh

    ticks = np.linspace(-0.05, 0.05, 31)
    x, y = (part.ravel() for part in np.meshgrid(ticks, ticks, indexing="ij"))
    top = np.column_stack([x, y, (x * x + y * y) / 0.12])
    bottom = np.column_stack([x, y, np.full(len(x), -0.03)])
    cells = np.arange(len(x)).reshape(len(ticks), -1)
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


@lru_cache
def cube() -> dict[str, Any]:
    """Return a cube of 80 mm, as six sides of two triangles."""
    import trimesh

    box = trimesh.creation.box(extents=(0.08, 0.08, 0.08))
    return as_mesh(np.asarray(box.vertices), np.asarray(box.faces, dtype=np.int64), 0.01)


@lru_cache
def liver() -> dict[str, Any]:
    if not LIVER.is_file():
        pytest.skip(f"the real mesh is not there: {LIVER}")
    return dict(read_mesh(LIVER, 0.01, None))


MESHES: dict[str, Callable[[], dict[str, Any]]] = {
    "meshed": meshed,
    "lobes": lobes,
    "bowl": bowl,
    "cube": cube,
    "liver": liver,
}
DOME_UP = (0.5 * math.pi, 0.0, 0.0)
"""Rotation of the liver's dome, where its y is up, to the user."""


@lru_cache
def desk_about(name: str) -> tuple[PlannerHarness, Shape]:
    geometry = SOLIDS[name] if name in SOLIDS else MESHES[name]()
    rpy_rad = DOME_UP if name == "liver" else (0.0, 0.0, 0.0)
    shape = compute_once(f"shape-{name}", lambda: make_shape(geometry))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectory, "make_shape", lambda _: shape)
        return PlannerHarness(scene_with(geometry, rpy_rad=rpy_rad)), shape


def fresh(name: str) -> tuple[PlannerHarness, Shape]:
    """Return a new planner and the shape; a mesh's planner, which takes 1 s, is shared."""
    desk, shape = desk_about(name)
    new = copy.copy(desk)
    new.plan, new.seen = copy.copy(desk.plan), []
    # The plan alone knows its encounter, and that changes by assignment only.
    new.plan._contact_state = copy.copy(desk.plan._contact_state)
    return new, shape


def walk(
    shape: Shape, start: Floats, heading: Floats, step_m: float, steps: int
) -> tuple[Floats, Floats, Floats]:
    """Return points, normals (n, 3) and curvatures (n,) along a geodesic."""
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


def touch(
    desk: PlannerHarness, point: Floats, normal: Floats, depth_m: float = 0.001
) -> PlannedStep:
    """Approach from above, touch, and rest."""
    desk.rest(point + 0.03 * normal)
    desk.follow(point + np.linspace(0.03, -depth_m, 60)[:, None] * normal)
    return desk.rest(point - depth_m * normal, 40)


def phases(planned: list[PlannedStep]) -> list[str]:
    return [one.command.phase for one in planned]


def reasons(planned: list[PlannedStep]) -> set[str]:
    return {one.command.reason for one in planned}


def eased_path(corners: list[Floats], steps: int) -> Floats:
    """Return a path through corners, at rest at each, by the smoothstep function."""
    share = np.linspace(0.0, 1.0, steps)[1:, None]
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    legs = [a + smooth * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([corners[0][None], *legs])


# What the rolling must reach


@pytest.mark.parametrize(("frames", "depth_m"), [(600, 0.001), (180, 0.001), (300, 0.004)])
def test_after_60_degrees_on_the_cylinder_arc_and_path_on_the_sheet_are_equal(
    frames: int, depth_m: float
) -> None:
    """|arc AB - length A'B| <= 0.01 mm for the sheet that is sent to the arms."""
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
    """The error is at most 0.01 degrees for the sheet that is sent to the arms."""
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
"""Rotation of the sheet by a fast stroke, rad/s: half of the edges' limit."""


def normal_errors_deg(
    desk: PlannerHarness, reference: Shape, start: Floats, heading: Floats, length_m: float
) -> Floats:
    """Return the errors of the sheet's normal along a stroke at a speed for its tightest bend,
    degrees."""
    _, _, bends = walk(reference, start, heading, 5e-4, int(length_m / 5e-4))
    step_m = min(0.03, TURNED_PER_S / bends.max()) * STEP_S
    points, normals, _ = walk(reference, start, heading, step_m, int(length_m / step_m))
    touch(desk, points[0], normals[0])
    # A hand starts and stops gently.
    share = eased_path([np.zeros(1), np.full(1, len(points) - 1.0)], 2 * len(points))[:, 0]
    fingers = np.column_stack(
        [np.interp(share, np.arange(len(points)), axis) for axis in (points - 0.001 * normals).T]
    )
    sent = desk.follow(fingers)
    assert set(phases(sent)) == {"contact"}, reasons(sent)
    wanted = reference.closest(
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
    """The error is at most 0.5 degrees from the meshed ellipsoid, with bounded acceleration and
    jerk."""
    desk, _ = fresh("meshed")
    known = EllipsoidShape((0.05, 0.03, 0.02))
    errors = normal_errors_deg(desk, known, np.array([0.0, 0.0, 0.05]), np.array(heading), 0.012)
    assert errors.max() < 0.5
    desk.assert_bounded()


RIGHT, UP = (1.0, 0.0, 0.2), (-0.4, 0.0, 1.0)
LIVER_STROKES = [
    ((-0.012, 0.1, 0.006), RIGHT),
    ((0.0, 0.1, 0.0), UP),
    *(
        pytest.param(start, heading, marks=pytest.mark.long)
        for start, heading in (
            ((-0.012, 0.1, 0.006), UP),
            ((0.0, 0.1, 0.0), RIGHT),
            ((-0.02, 0.1, -0.004), RIGHT),
            ((-0.02, 0.1, -0.004), UP),
        )
    ),
]


@pytest.mark.parametrize(("start", "heading"), LIVER_STROKES)
def test_on_the_real_mesh_the_sheets_normal_is_the_smooth_surfaces(
    start: tuple[float, ...], heading: tuple[float, ...]
) -> None:
    """The error is at most 0.5 degrees along a stroke of 12 mm, with bounded acceleration and
    jerk."""
    desk, shape = fresh("liver")
    errors = normal_errors_deg(desk, shape, np.array(start), np.array(heading), 0.012)
    assert errors.max() < 0.5
    desk.assert_bounded()


# Where it cannot go on


def limits(**changes: float) -> ContactLimits:
    given: dict[str, Any] = {
        "front": FRONT,
        "max_tilt_rad": 1.2,
        "max_spin_rad": 0.3,
        "half_width_m": 0.09,
        "half_height_m": 0.09,
        "contact_on_m": 0.0005,
        "contact_off_m": 0.003,
        "max_depth_m": 0.07,
    }
    return ContactLimits(**given | changes)


def shown_to(shape: Shape, finger: Floats, **changes: float) -> ContactCommand:
    """Return the step for a finger that starts at a position."""
    met = ContactStateMachine(shape, np.eye(3), limits(**changes))
    return met.step(finger, STILL, met.contact.object_from_sheet)


ANYWHERE = ("cylinder", "sphere", "ellipsoid", "plane", "box", "meshed", "lobes", "bowl")
places = st.tuples(*[st.floats(-0.12, 0.12)] * 3)
moves = st.lists(
    st.tuples(places, st.integers(1, 15), st.sampled_from(["leap", "glide", "lost", "wild"])),
    min_size=1,
    max_size=5,
)


@pytest.mark.parametrize("name", ANYWHERE)
@given(moves=moves)
@examples(5)
def test_no_transition_is_a_step_wherever_the_finger_goes(
    name: str, moves: list[tuple[tuple[float, float, float], int, str]]
) -> None:
    """For any jump, loss or penetration the sheet's speed, acceleration and jerk are bounded."""
    desk, _ = fresh(name)
    here = np.array([0.0, 0.0, 0.1])
    for place, steps, way in moves:
        there = np.array(place)
        for step in range(1, steps + 1):
            finger = there if way == "leap" else here + (there - here) * step / steps
            rate = (there - here) / (steps * STEP_S)
            if way == "lost":
                desk.lose()
            else:
                desk.see(finger, 8.0 * np.sign(rate) if way == "wild" else 0.1 * rate)
        here = there
    desk.assert_bounded()
    for planned in desk.seen:
        shown = planned.command
        assert np.isfinite(shown.twist).all()
        assert shown.push_depth_m >= 0.0
        assert angle_between(shown.contact.normal, FRONT) <= desk.tilt_rad + 1e-6
        if shown.phase == "hold":
            assert shown.reason != "ok"
            assert (shown.twist == 0.0).all()


@pytest.mark.parametrize(
    ("name", "finger"),
    [
        ("cylinder", (0.01, 0.0, 0.0)),
        ("sphere", (0.0, 0.0, 0.0)),
        ("ellipsoid", (0.0, 0.0, 0.0)),
        ("ellipsoid", (0.002, 0.0, 0.001)),
        ("box", (0.02, 0.0, 0.0)),
    ],
)
def test_a_finger_inside_on_no_side_is_held_and_not_met(
    name: str, finger: tuple[float, float, float]
) -> None:
    """On an axis, a centre or a medial plane there is no contact until the finger comes out."""
    desk, shape = fresh(name)
    home = desk.plan.motion.world_from_sheet
    held = desk.rest(np.array(finger), 20)
    assert held.command.phase == "hold"
    assert held.command.reason == "ambiguous_side"
    assert held.motion.world_from_sheet == pytest.approx(home, abs=1e-12)
    front = shape.closest(np.array([0.0, 0.0, 0.2]))
    out = touch(desk, front.point, front.normal)
    assert out.command.phase == "contact"
    desk.assert_bounded()


def test_pushed_to_the_middle_the_side_is_kept_for_every_shape() -> None:
    """Where all sides are equally near, the sheet stays at the present side, also with tremor."""
    noise = np.random.default_rng(2)
    for name in ("cylinder", "sphere", "ellipsoid", "plane", "box", "meshed", "lobes"):
        desk, shape = fresh(name)
        front = shape.closest(np.array([0.0, 0.0, 0.2]))
        before = touch(desk, front.point, front.normal)
        assert before.command.phase == "contact"
        deepest = min(0.05, front.point[2])
        for depth in np.linspace(0.001, deepest, 150):
            trembling = noise.normal(0.0, 1e-4, 3)
            after = desk.see(front.point - depth * front.normal + trembling)
            if after.command.phase != "contact":
                # A mesh's saddle is an edge deep below it; the sheet then waits where it is.
                assert after.command.phase == "hold"
        assert angle_between(after.motion.world_from_sheet[:3, 2], front.normal) < 0.06
        desk.assert_bounded()


def test_between_two_lobes_the_nearer_is_presented_and_the_other_only_once_it_must_be() -> None:
    desk, _ = fresh("lobes")
    over = np.array([0.0, 0.0, 0.06])
    ways = np.concatenate([np.linspace(0.03, -0.03, 240), np.linspace(-0.03, 0.03, 240)])
    sides = []
    for y in ways:
        planned = desk.see(over + np.array([0.0, y, 0.0]), np.array([0.0, -0.25, 0.0]))
        assert planned.command.phase == "approach"
        sides.append(planned.command.contact.point[1] > 0.0)
    changes = np.flatnonzero(np.diff(sides))
    # Once each way, and late rather than early: no to and fro at the middle.
    assert len(changes) == 2
    assert ways[changes[0]] <= 0.001
    assert ways[changes[1] + 1] >= -0.001
    still = [desk.see(over + 1e-5 * np.array([0.0, (-1.0) ** i, 0.0])) for i in range(60)]
    assert len({one.command.contact.point[1] > 0.0 for one in still}) == 1
    desk.assert_bounded()


def test_at_a_meshs_sharp_edge_the_sheet_holds_until_the_finger_is_back() -> None:
    desk, _ = fresh("cube")
    start, depth = np.array([0.0, 0.02, 0.04]), np.array([0.0, 0.0, -0.001])
    touch(desk, start, FRONT)
    way = eased_path([start + depth, np.array([0.0, 0.044, 0.038])], 90)
    for finger in way:
        out = desk.see(finger)
        if out.command.phase == "hold":
            break
    assert out.command.reason == "past_object_edge"
    held = desk.rest(finger, 60)
    assert held.command.reason == "past_object_edge"
    assert held.motion.twist_world == pytest.approx(np.zeros(6), abs=1e-9)
    back = desk.rest(start + depth, 120)
    assert back.command.phase == "contact"
    assert back.motion.world_from_sheet[:3, 2] == pytest.approx(FRONT, abs=1e-6)
    desk.assert_bounded()


def test_over_an_edge_the_sheet_is_presented_but_no_touch_begins() -> None:
    met = shown_to(make_shape(SOLIDS["cylinder"]), np.array([0.07, 0.0, RADIUS - 0.0005]))
    assert met.phase == "approach"
    assert met.reason == "past_object_edge"


def test_a_concavity_is_reported_and_the_sheet_rests_on_its_rim() -> None:
    """The rim of z = r^2 / 2R is r^2 / 2R above the bottom, up to 24 mm."""
    desk, shape = fresh("bowl")
    bottom = shape.closest(np.array([0.0, 0.0, 0.02]))
    waiting = desk.rest(np.array([0.0, 0.0, 0.04]), 200)
    assert waiting.command.reason == "concave_contact"
    stands = desk.object_from_sheet(waiting)[2, 3] - bottom.point[2]
    assert stands == pytest.approx(0.024**2 / 0.12, abs=3e-4)
    # Over the rim, where the block falls away to the sides, it is tangent to what is touched.
    touched = desk.rest(np.array([0.0, 0.0, stands - 0.001]), 60)
    assert touched.command.phase == "contact"
    assert touched.command.push_depth_m == pytest.approx(0.001, abs=3e-4)
    desk.follow(eased_path([np.array([0, 0, stands - 0.001]), np.array([0, 0.03, 0.0065])], 120))
    lifts = [planned.command.contact.lift_m for planned in desk.seen]
    assert np.abs(np.diff(lifts)).max() < 4e-4
    desk.assert_bounded()


@pytest.mark.parametrize(
    ("name", "axis", "side"), [("plane", 0, "width"), ("plane", 1, "height"), ("box", 0, "width")]
)
def test_out_of_sheet_it_holds_and_is_met_at_its_middle_again_after_a_lift(
    name: str, axis: int, side: str
) -> None:
    """The finger moves to the end of the sheet, lifts, and touches elsewhere."""
    desk, shape = fresh(name)
    most = (0.09, 0.09)[axis]
    begin, along = np.zeros(3), np.zeros(3)
    # A sheet held ready stays over the object's middle along x: met off it, its end is near.
    along[axis], begin[1 - axis] = 1.0, 0.0
    start = shape.closest(begin + 0.2 * FRONT)
    first = touch(desk, start.point, start.normal)
    pose = desk.object_from_sheet(first)
    # Shifted by hand, as if it had been rolled so far: most of it is used up.
    met = desk.plan._contact_state
    shifted = met.contact.position_sheet_m.copy()
    shifted[axis] = most - 0.01
    met.contact = replace(met.contact, position_sheet_m=shifted)
    desk.rest(start.point - 0.001 * start.normal, 200)
    end = start.point + 0.03 * along - 0.001 * start.normal
    out = desk.follow(eased_path([start.point - 0.001 * start.normal, end], 120))
    assert phases(out)[-1] == "hold"
    assert out[-1].command.reason == f"past_sheet_{side}"
    assert abs(out[-1].command.contact.position_sheet_m[axis]) <= most
    lifted = desk.rest(end + 0.03 * start.normal, 200)
    assert lifted.command.phase == "approach"
    again = touch(desk, start.point, start.normal)
    assert again.command.phase == "contact"
    assert desk.object_from_sheet(again) == pytest.approx(pose, abs=1e-5)
    desk.assert_bounded()


def test_released_and_met_elsewhere_the_sheet_goes_there_at_once_and_smoothly() -> None:
    for name in ("sphere", "ellipsoid", "box", "meshed"):
        desk, shape = fresh(name)
        one, other = (
            shape.closest(np.array([x, y, 0.2])) for x, y in ((-0.01, 0.06), (0.015, -0.06))
        )
        assert touch(desk, one.point, one.normal).command.phase == "contact"
        away = eased_path([one.point, one.point + 0.03 * one.normal, other.point], 40)
        flown = desk.follow(away + 0.01 * FRONT)
        assert "approach" in phases(flown)
        again = touch(desk, other.point, other.normal)
        assert again.command.phase == "contact"
        assert desk.object_from_sheet(again)[:3, 2] == pytest.approx(other.normal, abs=1e-3)
        assert again.contact_sheet_m[1] == pytest.approx(0.0, abs=1e-3)
        desk.assert_bounded()


@pytest.mark.parametrize(
    ("finger", "velocity"),
    [
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, math.inf, 0.0), (0.0, 0.0, 0.0)),
        ((1e9, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.05), (math.nan, 0.0, 0.0)),
        ((0.0, 0.0, 0.05), (0.0, -math.inf, 0.0)),
        ((0.0, 0.0, 0.05), (1e300, 0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("touching", [False, True])
def test_a_finger_that_is_none_is_held(
    finger: tuple[float, ...], velocity: tuple[float, ...], touching: bool
) -> None:
    desk, _ = fresh("sphere")
    if touching:
        desk.rest(np.array([0.0, 0.0, 0.049]), 60)
    before = desk.plan.motion.world_from_sheet
    with np.errstate(all="ignore"):
        held = desk.see(np.array(finger), np.array(velocity))
    assert held.command.phase == "hold"
    assert held.command.reason == "implausible_input"
    assert held.motion.world_from_sheet == pytest.approx(before, abs=1e-3)
    after = desk.rest(np.array([0.0, 0.0, 0.049]), 60)
    assert after.command.phase == "contact"
    desk.assert_bounded()


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        ({"shape": "cylinder", "radius_m": 0.0, "length_m": 0.1}, "radius_m"),
        ({"shape": "sphere", "radius_m": -0.01}, "radius_m"),
        ({"shape": "sphere", "radius_m": math.nan}, "radius_m"),
        ({"shape": "plane", "width_m": math.inf, "height_m": 0.1}, "width_m"),
        ({"shape": "ellipsoid", "semi_axes_m": (0.03, 0.0, 0.02)}, "semi_axes_m"),
        ({"shape": "rounded_box", "size_m": (0.1, 0.1, 0.1), "edge_radius_m": 0.06}, "edge_radius"),
        (
            {
                "shape": "mesh",
                "vertices_m": np.zeros((0, 3)),
                "triangles": np.zeros((0, 3), dtype=np.int64),
                "smoothing_m": 0.003,
            },
            "a closed surface needs at least 4",
        ),
    ],
)
def test_a_shape_that_is_none_is_rejected_with_the_measure(
    geometry: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        make_shape(geometry)


def test_an_inverted_mesh_is_rejected() -> None:
    vertices, triangles = ellipsoid_mesh(2)
    with pytest.raises(MeshError, match="inside out"):
        SmoothMeshShape(vertices, triangles[:, ::-1], 0.01)


@pytest.mark.parametrize("rotation_rad", [math.pi, 1.5])
def test_an_object_that_turns_no_side_to_the_user_is_rejected(rotation_rad: float) -> None:
    with pytest.raises(UnpresentableError, match=r"change object.world_from_object in the scene"):
        PlannerHarness(scene_with(SOLIDS["plane"], rpy_rad=(rotation_rad, 0.0, 0.0)))


def test_a_tilt_beyond_a_right_angle_is_cut() -> None:
    """Two normals that may both be rendered are never opposite."""
    shape = make_shape(SOLIDS["sphere"])
    for lean in (1.3, -1.3):
        met = shown_to(shape, 0.08 * np.array([0.0, math.sin(2 * lean), -0.9]), max_tilt_rad=3.0)
        assert angle_between(met.contact.normal, FRONT) <= contact_state.MAX_TILT_RAD + 1e-9
        assert np.isfinite(met.contact.object_from_sheet).all()


# Stroking and pushing together


def sheet_way_m(planned: list[PlannedStep]) -> float:
    """Return the path length of the contact on the sheet, step by step."""
    places = np.array([one.command.contact.position_sheet_m for one in planned])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def object_way_m(planned: list[PlannedStep]) -> float:
    """Return the path length of the contact on the object."""
    points = np.array([one.command.contact.point for one in planned])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


@pytest.mark.parametrize(
    "name", long_except(["cylinder", "sphere", "ellipsoid", "box", "meshed"], "cylinder", "meshed")
)
@pytest.mark.parametrize("deepest_share", long_except((0.1, 0.4, 0.8), 0.8))
def test_stroking_while_pushing_neither_steps_nor_slips(name: str, deepest_share: float) -> None:
    """A finger strokes back and forth and pushes in and out simultaneously, to a fraction of the
    radius."""
    desk, shape = fresh(name)
    front = shape.closest(np.array([0.0, 0.0, 0.2]))
    thick = front.point[2]
    touch(desk, front.point, front.normal)
    times = STEP_S * np.arange(600)
    across = 0.008 * np.sin(2.0 * np.pi * 0.2 * times)
    depth = 0.001 + (deepest_share * thick - 0.001) * np.sin(np.pi * 0.3 * times) ** 2
    fingers = np.column_stack([0.3 * across, across, thick - depth])
    # Over a round object the surface falls away from the front: depth counts from there.
    sag = thick - shape.closest(fingers * [1, 1, 0] + [0.0, 0.0, thick]).point[:, 2]
    fingers[:, 2] -= sag
    sent = desk.follow(fingers)
    assert set(phases(sent)) == {"contact"}, reasons(sent)
    # No slip: what the contact goes on the object it goes on the sheet.
    assert sheet_way_m(sent) == pytest.approx(object_way_m(sent), rel=2e-3, abs=2e-5)
    # No step: the contact moves by no more than a small multiple of what the finger moves.
    points = np.array([one.command.contact.point for one in sent])
    moved_m = np.linalg.norm(np.diff(fingers, axis=0), axis=1)
    assert (np.linalg.norm(np.diff(points, axis=0), axis=1) <= 8.0 * moved_m + 1e-5).all()
    desk.assert_bounded()
    # Back where it began, the sheet is where it was: pushing has not shifted it.
    back = desk.rest(front.point - 0.001 * front.normal, 120)
    assert desk.object_from_sheet(back)[:3, 2] == pytest.approx(front.normal, abs=2e-3)
