"""Test that a path back exists from any position where a fault has stopped the arms.

A path is tested by its rehearsal and by arms that follow it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.arm_bridge.control import ArmControl
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.joint_chain import (
    UnreachableError,
)
from flexsheet.nodes.arm_bridge.path_check import Alignment, PathCheckRequest, check_path, rehearse
from flexsheet.nodes.arm_bridge.reach import PathError, plan_path
from flexsheet.nodes.arm_bridge.standstill import SETTLED_COUNT
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import transform_from_rpy
from tests.arm_states import connect_control
from tests.examples import examples
from tests.test_arm_control import (
    GUESS,
    HOME,
    SCENE,
    STEP_S,
    TIMEOUTS,
    Arm,
    Command,
    on_time,
    sheet_at,
)

Floats = NDArray[np.float64]
LEFT, RIGHT = ArmGeometry(SCENE, "left"), ArmGeometry(SCENE, "right")
LOWEST, HIGHEST = LEFT.joint_limits.min_rad, LEFT.joint_limits.max_rad
Joints = tuple[Floats, Floats]


def in_range(joints: Floats) -> bool:
    return bool((joints >= LOWEST).all() and (joints <= HIGHEST).all())


def stopped_joints(target: SheetMotion, behind: int, deviation: Floats) -> Joints | None:
    """Return joints of both arms where the path to a target ends for one of them; None if it does
    not.

    behind: delay of one arm in tenths of a second; even: the left one. deviation (2, 6): distance
        of each resting joint from its command.
    """
    reachable: list[Joints] = [
        (LEFT.joints_for_sheet(HOME, GUESS), RIGHT.joints_for_sheet(HOME, GUESS))
    ]
    for sheet in rehearse(HOME, target, LEFT.edge_bound)[1:]:
        before = reachable[-1]
        try:
            after = (
                LEFT.joints_for_sheet(sheet, before[0]),
                RIGHT.joints_for_sheet(sheet, before[1]),
            )
        except UnreachableError:
            break
        changes = [float(np.abs(a - b).max()) for a, b in zip(after, before, strict=True)]
        if max(changes) > 0.35 or not all(in_range(joints) for joints in after):
            break
        reachable.append(after)
    else:
        return None
    late = max(0, len(reachable) - 1 - behind // 2)
    left, right = reachable[-1]
    if behind % 2:
        right = reachable[late][1]
    else:
        left = reachable[late][0]
    return (
        np.clip(left + deviation[0], LOWEST, HIGHEST),
        np.clip(right + deviation[1], LOWEST, HIGHEST),
    )


def way_from(joints: Joints, goal: SheetMotion) -> PathCheckRequest:
    """Return the request of the left bridge."""
    edges = LEFT.world_from_edge(joints[0]), RIGHT.world_from_edge(joints[1])
    return PathCheckRequest(LEFT.sheet_between(*edges), goal, *joints)


def keeps_length(joints: Joints) -> bool:
    """Return whether a fault can leave the sheet in this state, by the limits of commands."""
    way = way_from(joints, HOME)
    return way.start.stretch_ratio * 0.24 <= LEFT.sheet_limits.max_length_m


shift = st.tuples(st.floats(-0.15, 0.15), st.floats(-0.25, 0.25), st.floats(-0.2, 0.25))
lean = st.tuples(st.floats(-1.3, 1.3), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
deviations = st.lists(st.floats(-0.015, 0.015), min_size=12, max_size=12).map(
    lambda values: np.array(values).reshape(2, 6)
)


@examples(8)
@given(
    shift=shift,
    lean=lean,
    stretch=st.floats(0.98, 1.08),
    behind=st.integers(0, 2),
    deviation=deviations,
)
def test_from_wherever_a_path_ends_there_is_one_back(
    shift: tuple[float, ...],
    lean: tuple[float, ...],
    stretch: float,
    behind: int,
    deviation: Floats,
) -> None:
    target = SheetMotion(transform_from_rpy(shift, lean), np.zeros(6), stretch, 0.0)
    joints = stopped_joints(target, behind, deviation)
    if joints is None or not keeps_length(joints):
        return
    way = way_from(joints, HOME)
    found = check_path(LEFT, RIGHT, way)
    assert isinstance(found, Alignment), found
    other = check_path(RIGHT, LEFT, replace(way, own_rad=joints[1], other_rad=joints[0]))
    assert isinstance(other, Alignment)
    assert other.duration_s == pytest.approx(found.duration_s, abs=1e-9)
    assert other.sheet.world_from_sheet == pytest.approx(found.sheet.world_from_sheet, abs=1e-12)
    for arm, one in ((LEFT, found), (RIGHT, other)):
        assert in_range(one.to_rad)
        assert one.joints_at(0.0) == pytest.approx(one.from_rad)
        assert one.joints_at(one.duration_s) == pytest.approx(one.to_rad)
        times_s = np.linspace(0.0, one.duration_s, 60)
        joints_rad = np.array([one.joints_at(time_s) for time_s in times_s])
        points = np.array([arm.tool_points(joints) for joints in joints_rad])
        if one.duration_s > 1e-3:
            speeds = np.linalg.norm(np.diff(points, axis=0), axis=2) / np.diff(times_s)[:, None]
            assert speeds.max() <= 0.0601
        assert all(in_range(joints) or i == 0 for i, joints in enumerate(joints_rad))


def standing(side: str, joints: Floats) -> Arm:
    """Return an arm at rest at these joints, with a new bridge."""
    geometry = LEFT if side == "left" else RIGHT
    control = ArmControl(TIMEOUTS, max_tracking_error_rad=0.12, auto_arming=True)
    for _ in range(SETTLED_COUNT):
        control.on_measurement(joints, ())
    connect_control(control)
    return Arm(geometry, control, joints, Command("idle", joints))


def run_checked(arms: tuple[Arm, Arm], goal: SheetMotion, cycles: int) -> None:
    """Run both arms like bridges, and check each requested path."""
    for _ in range(cycles):
        for arm, other in (arms, arms[::-1]):
            control = arm.control
            command = control.step(arm.geometry, on_time(goal), other.as_other(), STEP_S)
            if control.pending_check is not None:
                found = check_path(arm.geometry, other.geometry, control.pending_check)
                control.on_path_result(control.pending_check, found)
            if command.mode == "move":
                shift = arm.geometry.tool_points(command.joints_rad)
                shift -= arm.geometry.tool_points(arm.joints)
                assert np.linalg.norm(shift, axis=1).max() <= 0.25 * STEP_S
                arm.joints = command.joints_rad
            control.on_measurement(arm.joints, ())


def assert_goes_home(arms: tuple[Arm, Arm]) -> None:
    for _ in range(40):
        run_checked(arms, HOME, 50)
        reasons = [(arm.control.mode, arm.control.reason) for arm in arms]
        assert not any(arm.control.faults for arm in arms), reasons
        sheet = LEFT.sheet_between(arms[0].edge, arms[1].edge)
        if np.abs(sheet.world_from_sheet - np.eye(4)).max() < 1e-4:
            break
    assert {arm.control.mode for arm in arms} == {"follow"}, reasons
    assert sheet.world_from_sheet == pytest.approx(np.eye(4), abs=1e-4)


@pytest.mark.parametrize(
    ("target", "behind"),
    [
        (sheet_at(-0.25, tilt=-0.4), 2),
        pytest.param(sheet_at(0.25, tilt=0.4), 1, marks=pytest.mark.long),
        (replace(HOME, world_from_sheet=transform_from_rpy([0.15, 0.0, 0.0], np.zeros(3))), 1),
        pytest.param(
            replace(HOME, world_from_sheet=transform_from_rpy([0.0, 0.25, 0.1], np.zeros(3))),
            2,
            marks=pytest.mark.long,
        ),
    ],
)
def test_stopped_where_no_even_sheet_can_be_held_both_go_home(
    target: SheetMotion, behind: int
) -> None:
    """One arm is at the end of its range, so that the mean sheet is not reachable."""
    deviation = np.array([[0.0, 0.03, -0.03, 0.01, 0.0, 0.0], [0.0, 0.0, 0.02, 0.0, 0.01, 0.0]])
    joints = stopped_joints(target, behind, deviation)
    assert joints is not None
    assert_goes_home((standing("left", joints[0]), standing("right", joints[1])))


@pytest.mark.parametrize(
    ("y_m", "fifth_deg"), [(-0.135, -87.9), (0.152, -0.5)], ids=["below", "above"]
)
def test_where_the_mean_sheet_is_out_of_reach_the_path_begins_at_the_measured_joints(
    y_m: float, fifth_deg: float
) -> None:
    """The mean sheet has no inverse kinematics; found with real bridges."""
    pose = transform_from_rpy([-0.005, y_m, 0.0], [0.0, 0.0, 0.0])
    joints = stopped_joints(replace(HOME, world_from_sheet=pose), 0, np.zeros((2, 6)))
    sheet = replace(HOME, world_from_sheet=pose)
    if joints is None:
        joints = LEFT.joints_for_sheet(sheet, GUESS), RIGHT.joints_for_sheet(sheet, GUESS)
    joints[0][4] = np.radians(fifth_deg)
    assert_goes_home((standing("left", joints[0]), standing("right", joints[1])))


def test_some_of_these_starts_cannot_be_held_evenly() -> None:
    """Paths that begin at the mean sheet fail for some starts of the tests above."""
    random, failed, found = np.random.default_rng(1), 0, 0
    while found < 12:
        target = SheetMotion(
            transform_from_rpy(
                random.uniform([-0.1, -0.25, -0.1], [0.1, -0.15, 0.1]), [-0.4, 0, 0]
            ),
            np.zeros(6),
            1.02,
            0.0,
        )
        joints = stopped_joints(target, 1, random.uniform(-0.02, 0.02, (2, 6)))
        if joints is None:
            continue
        found += 1
        way = way_from(joints, HOME)
        try:
            corners = rehearse(way.start, HOME, LEFT.edge_bound)
            plan_path(LEFT, RIGHT, corners, left_rad=joints[0], right_rad=joints[1])
        except PathError:
            failed += 1
    assert failed > 0
