"""Test the selection of points on the object, and the path of the finger."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.base import Message
from flexsheet.messages.scene import Cylinder, Scene, require_cylinder
from flexsheet.messages.types import (
    FingerPath,
)
from flexsheet.nodes.console.controller import SceneController
from flexsheet.nodes.console.finger import SPEED_M_PER_S, FingerController, FingerIntent, Ray
from flexsheet.nodes.console.picking import HOVER_M, SurfacePicker
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.planner.contact_state import ContactLimits, ContactStateMachine
from tests.plans import scene_with
from tests.scenes import load_cylinder
from tests.waiting import DEADLINE_S

Floats = NDArray[np.float64]
STEP_M = 0.005


AIMS = [
    SurfacePicker(load_cylinder()),
    SurfacePicker(scene_with({"shape": "sphere", "radius_m": 0.04})),
]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


def test_the_mouse_means_a_point_below_the_surface_or_beside_it(scene: Scene) -> None:
    picker = SurfacePicker(scene)
    eye, forward = np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, -2.0])
    np.testing.assert_allclose(picker.pick(eye, forward, 0.0), [0.0, 0.0, 0.0], atol=2e-4)
    np.testing.assert_allclose(picker.pick(eye, forward, 0.01), [0.0, 0.0, -0.01], atol=2e-4)
    beside = picker.pick(eye, np.array([0.0, 0.3, -0.6]), 0.01)
    assert beside[1] > 0.02
    assert depth_m(scene, beside) == pytest.approx(0.01, abs=2e-4)
    grazing = np.array([0.0, 0.04, -0.6 - scene.object.geometry.radius_m])  # type: ignore[union-attr]  # a cylinder
    for towards in (forward, grazing):
        hover = picker.pick(eye, towards, -HOVER_M)
        assert depth_m(scene, hover) == pytest.approx(-HOVER_M, abs=2e-4)
    finger = FingerController(lambda message: None)
    for bad in (np.zeros(3), np.array([np.nan, 0, 1])):
        with pytest.raises(ValueError, match="direction"):
            finger.touch(eye, bad)


def test_the_finger_goes_round_the_object_and_not_through_it(scene: Scene) -> None:
    picker, sent = SurfacePicker(scene), []
    finger = FingerController(sent.append)
    finger.use(picker)
    finger.push(0.003)
    finger.move_to(0.0, -0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    begun = len(sent)
    finger.move_to(0.0, 0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    ways = np.array([path.positions_world_m[0] for path in sent[begun:]])
    radius = scene.object.geometry.radius_m  # type: ignore[union-attr]  # it is a cylinder
    centre = scene.object.world_from_object.position_m
    depths = radius - np.linalg.norm(ways[:, 1:] - centre[1:], axis=1)
    assert depths.max() < 0.003 + 2e-4
    highest_m = (radius - 0.003) * np.sin(scene.working_range.tilt_rad)
    assert ways[-1, 1] == pytest.approx(highest_m, abs=2e-3), "the limit of the tilt"
    assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 0.008
    rested = len(sent)
    finger.advance(0.05, None)
    assert len(sent) == rested, "a finger that is there is told nothing"
    assert all(isinstance(path, FingerPath) for path in sent)


def moved(finger: FingerController, sent: list[FingerPath]) -> Floats:
    """Advance the finger until it stops, and return its position (3,). Each step obeys the speed
    limit.
    """
    for _ in range(200):
        count = len(sent)
        finger.advance(STEP_M / SPEED_M_PER_S, None)
        if len(sent) == count:
            break
    points = np.array([path.positions_world_m[0] for path in sent])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max(initial=0.0) <= STEP_M + 1e-9
    return np.asarray(points[-1])


def depth_m(scene: Scene, point: Floats) -> float:
    """Return the depth (m) of a point below the side of the cylinder."""
    away = (point - scene.object.world_from_object.position_m)[1:]
    return float(require_cylinder(scene).radius_m - np.linalg.norm(away))


def test_a_drag_beside_the_object_stays_on_its_touchable_surface(scene: Scene) -> None:
    """Earlier, a drag beside the end of the cylinder moved the finger behind the sheet."""
    sent: list[FingerPath] = []
    finger = FingerController(sent.append)
    finger.use(SurfacePicker(scene))
    geometry, solid = scene.object.geometry, scene.object
    assert isinstance(geometry, Cylinder)
    towards_user = inverse(pose_matrix(solid.world_from_object))[:3, 2]
    max_depth_m = scene.working_range.push_depth_m
    contact = ContactStateMachine(
        make_shape(dict(geometry)),
        inverse(pose_matrix(solid.world_from_object))[:3, :3],
        ContactLimits(
            front=towards_user,
            max_tilt_rad=scene.working_range.tilt_rad + 0.02,
            max_spin_rad=0.3,
            half_width_m=geometry.length_m,
            half_height_m=geometry.length_m,
            contact_on_m=0.0005,
            contact_off_m=0.003,
            max_depth_m=1.4 * max_depth_m,
        ),
    )
    sheet = inverse(pose_matrix(solid.world_from_object))
    eye, side_eye = np.array([0.0, 0.0, 0.6]), np.array([0.5, 0.2, 0.4])
    for origin, x, y in (
        (eye, 0.06, 0.0),
        (eye, 0.094, 0.0),
        (eye, 0.15, 0.01),
        (eye, 0.0, 0.0),
        (eye, -0.2, 0.0),
        (side_eye, 0.1, 0.0),
        (side_eye, 0.02, -0.1),
        (eye, 0.0, 0.12),
    ):
        finger.touch(origin, np.array([x, y, 0.0]) - origin)
        begun = len(sent)
        moved(finger, sent)
        for path in sent[begun:]:
            point = path.positions_world_m[0]
            command = contact.step(apply(sheet, point), np.zeros(3), sheet)
            assert command.reason == "ok"
            assert command.push_depth_m < 0.004 + 1e-3
        assert abs(point[0]) < 0.5 * geometry.length_m
        assert depth_m(scene, point) == pytest.approx(0.004, abs=2e-4)


def test_a_drag_beyond_a_limit_of_one_direction_keeps_the_other_coordinate() -> None:
    picker, forward = SurfacePicker(load_cylinder()), np.array([0.0, 0.0, -1.0])
    above = picker.pick(np.array([0.03, 0.2, 0.6]), forward, 0.0)
    beside = picker.pick(np.array([0.12, 0.01, 0.6]), forward, 0.0)
    assert above[0] == pytest.approx(0.03, abs=2e-3)
    assert beside[1] == pytest.approx(0.01, abs=2e-3)
    assert beside[0] == pytest.approx(0.06 - 0.002, abs=1e-3), "the margin of the rim"


def test_a_push_deeper_than_the_working_range_is_refused(scene: Scene) -> None:
    picker = SurfacePicker(scene)
    eye, forward = np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(picker.pick(eye, forward, 0.2), [0.0, 0.0, -0.05], atol=2e-4)
    sent: list[Message] = []
    finger = FingerController(sent.append)
    finger.use(picker)
    with pytest.raises(ValueError, match="60 mm is deeper than the working range of the scene, 50"):
        finger.push(0.06)
    finger.advance(0.05, None)
    assert not sent


def test_the_requested_push_survives_scenes_and_lifting(scene: Scene) -> None:
    """Earlier, a new scene or lifting the finger reset the push depth."""
    sent: list[FingerPath] = []
    finger = FingerController(sent.append)
    finger.use(SurfacePicker(scene))
    finger.advance(0.05, None)
    assert not sent, "nobody has moved it yet"
    finger.push(0.018)
    assert depth_m(scene, moved(finger, sent)) == pytest.approx(0.018, abs=2e-4)
    thinner = scene_with({"shape": "cylinder", "radius_m": 0.03, "length_m": 0.1})
    finger.use(None)
    finger.push(0.008)
    finger.advance(0.05, None)
    finger.use(SurfacePicker(thinner))
    assert depth_m(thinner, moved(finger, sent)) == pytest.approx(0.008, abs=2e-4)
    finger.lift_or_lower()
    assert depth_m(thinner, moved(finger, sent)) == pytest.approx(-HOVER_M, abs=2e-4)
    finger.move_to(0.02, 0.01)
    lifted = moved(finger, sent)
    assert depth_m(thinner, lifted) == pytest.approx(-HOVER_M, abs=2e-4)
    assert lifted[0] == pytest.approx(0.02)
    finger.push(0.005)
    pushed = moved(finger, sent)
    assert depth_m(thinner, pushed) == pytest.approx(0.005, abs=2e-4)
    assert pushed[0] == pytest.approx(0.02)
    assert finger.intent == FingerIntent(Ray.from_front(0.02, 0.01), 0.005, lifted=False)
    finger.lift_or_lower()
    finger.lift_or_lower()
    np.testing.assert_allclose(moved(finger, sent), pushed, atol=1e-6)


commands = st.one_of(
    st.tuples(st.just("push"), st.floats(0.0, 0.03)),
    st.tuples(st.just("move_to"), st.floats(-0.05, 0.05), st.floats(-0.03, 0.03)),
    st.tuples(st.just("lift_or_lower")),
    st.tuples(st.just("scene"), st.booleans()),
)


@given(st.lists(commands, max_size=12))
def test_the_finger_depends_only_on_the_present_request(
    steps: list[tuple[Any, ...]],
) -> None:
    finger = FingerController(lambda message: None)
    finger.use(AIMS[0])
    picker, depth, position, lifted = AIMS[0], 0.004, (0.0, 0.0), True
    commanded = False
    for name, *values in steps:
        if name == "scene":
            picker = AIMS[int(values[0])]
            finger.use(None)
            finger.use(picker)
            continue
        getattr(finger, name)(*values)
        commanded = True
        if name == "push":
            depth, lifted = values[0], False
        elif name == "move_to":
            position = (values[0], values[1])
        else:
            lifted = not lifted
    led = np.array([0.0, 0.0, 0.08])
    if commanded:
        ray = np.array([*position, 1.5]), np.array([0.0, 0.0, -1.0])
        led = picker.pick(*ray, -HOVER_M if lifted else depth)
    finger.advance(1000.0, None)
    assert finger.position_m == position
    np.testing.assert_allclose(finger._last_point, led)


def test_a_finger_that_cannot_be_moved_has_a_reason(scene: Scene) -> None:
    finger = FingerController(lambda message: None)
    finger.use(SurfacePicker(scene))
    for depth in (-0.001, np.nan, np.inf):
        with pytest.raises(ValueError, match="finite number"):
            finger.push(depth)


async def test_an_object_is_made_ready_to_point_at_beside_the_loop(
    scene: Scene, tmp_path: Path
) -> None:
    sent: list[Message] = []
    controller = SceneController(sent.append, tmp_path, scene)
    finger, failures = FingerController(sent.append), []
    controller.make_picker(finger, failures.append)
    finger.push(0.002)
    finger.advance(1.0, None)
    assert not sent, "its shape is not known yet"
    async with asyncio.timeout(DEADLINE_S):
        while not sent:  # a task sends it
            await asyncio.sleep(0)
            finger.advance(1.0, None)
    await controller.close()
    assert not failures
