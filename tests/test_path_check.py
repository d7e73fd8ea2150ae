"""Test the check of the path for both arms before a motion, and its effect."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.types import SheetTarget, Side
from flexsheet.nodes.arm_bridge import path_check
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from flexsheet.nodes.arm_bridge.path_check import (
    PathChecker,
    PathCheckRequest,
    check_path,
    rehearse,
)
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import transform_from_rpy
from tests.examples import examples
from tests.note_text import note_text
from tests.test_arm_control import (
    HOME,
    SCENE,
    STEP_S,
    Arm,
    on_time,
    pair,
    run,
    sheet_at,
)
from tests.test_arm_loop import Rig, running_rig
from tests.waiting import DEADLINE_S, until

Floats = NDArray[np.float64]
LEFT, RIGHT = ArmGeometry(SCENE, "left"), ArmGeometry(SCENE, "right")
FAR = replace(HOME, world_from_sheet=transform_from_rpy([0.12, 0.0, 0.0], [0.0, 0.0, 0.0]))
"""Pose of the sheet so far to the right that the left arm's J3 is out of range."""


def make_request(start: SheetMotion, goal: SheetMotion) -> PathCheckRequest:
    """Return the request of the left bridge."""
    own, other = (Arm.holding(side, start).joints for side in ("left", "right"))
    return PathCheckRequest(start, goal, own, other)


def mirrored(way: PathCheckRequest) -> PathCheckRequest:
    """Return the same request from the right bridge."""
    return replace(way, own_rad=way.other_rad, other_rad=way.own_rad)


def find_violation(arm: ArmGeometry, other: ArmGeometry, request: PathCheckRequest) -> str | None:
    """Return why the path is blocked; None if it is clear, independent of its alignment."""
    result = check_path(arm, other, request)
    return result if isinstance(result, str) else None


def run_with_checks(arms: tuple[Arm, Arm], goal: SheetMotion, cycles: int) -> None:
    """Run both arms like `run`, and check each requested path immediately."""
    for _ in range(cycles):
        for arm, other in (arms, arms[::-1]):
            control = arm.control
            command = control.step(arm.geometry, on_time(goal), other.as_other(), STEP_S)
            if control.pending_check is not None:
                problem = find_violation(arm.geometry, other.geometry, control.pending_check)
                control.on_path_result(control.pending_check, problem)
            if command.mode == "move":
                arm.joints = command.joints_rad
            control.on_measurement(arm.joints, ())


def sheet_of(arms: tuple[Arm, Arm]) -> SheetMotion:
    return arms[0].geometry.sheet_between(arms[0].edge, arms[1].edge)


def test_a_blocked_path_is_named_and_nothing_moves() -> None:
    arms = pair()
    places = [arm.joints.copy() for arm in arms]
    run_with_checks(arms, FAR, 30)
    for arm, place in zip(arms, places, strict=True):
        assert (arm.control.mode, arm.control.faults) == ("hold", ())
        assert (arm.joints == place).all()
        reason = arm.control.reason
        assert reason.startswith("no path: left arm, at ")
        assert "% of the path, sheet at (" in reason
        assert "J3 at 5" in reason
    assert arms[0].control.reason == arms[1].control.reason


def test_a_target_within_reach_again_is_gone_to() -> None:
    arms = pair()
    run_with_checks(arms, FAR, 30)
    goal = sheet_at(0.02, tilt=0.3)
    run_with_checks(arms, goal, 30)
    assert {arm.control.mode for arm in arms} == {"hold"}, "it is looked at again every half second"
    run_with_checks(arms, goal, 400)
    assert {arm.control.mode for arm in arms} == {"follow"}
    assert sheet_of(arms).world_from_sheet == pytest.approx(goal.world_from_sheet, abs=1e-6)


@pytest.mark.parametrize("barred", [0, 1])
def test_if_only_one_bridge_finds_the_path_clear_neither_moves(barred: int) -> None:
    arms = pair()
    places = [arm.joints.copy() for arm in arms]
    for _ in range(100):
        for number, (arm, other) in enumerate((arms, arms[::-1])):
            control = arm.control
            command = control.step(arm.geometry, on_time(sheet_at(0.03)), other.as_other(), STEP_S)
            if control.pending_check is not None:
                control.on_path_result(
                    control.pending_check, "no path" if number == barred else None
                )
            if command.mode == "move":
                arm.joints = command.joints_rad
            control.on_measurement(arm.joints, ())
    assert arms[barred].control.mode == "hold"
    assert [arm.control.path_blocked for arm in arms] == [number == barred for number in (0, 1)]
    arms[barred].control.on_scene_changed()
    assert not arms[barred].control.path_blocked
    assert arms[1 - barred].control.reason == "waits for the other arm"
    for arm, place in zip(arms, places, strict=True):
        assert arm.joints == pytest.approx(place, abs=1e-12)


def test_it_is_asked_before_the_first_motion_and_after_each_stop_and_not_in_between() -> None:
    arms = pair()
    control = arms[0].control
    asked: list[PathCheckRequest] = []
    for goal in (sheet_at(0.03), None, sheet_at(0.05), None, sheet_at(0.01)):
        for _ in range(120):
            for arm, other in (arms, arms[::-1]):
                arm.command = arm.control.step(
                    arm.geometry, None if goal is None else on_time(goal), other.as_other(), STEP_S
                )
                if (question := arm.control.pending_check) is not None:
                    asked += [question] if arm.control is control else []
                    arm.control.on_path_result(question, None)
                if arm.command.mode == "move":
                    arm.joints = arm.command.joints_rad
                arm.control.on_measurement(arm.joints, ())
    assert [round(float(way.goal.world_from_sheet[1, 3]), 6) for way in asked] == [0.03, 0.05, 0.01]
    assert asked[1].start.world_from_sheet[1, 3] == pytest.approx(0.03, abs=1e-3)


def test_an_answer_to_a_question_no_longer_asked_is_thrown_away() -> None:
    arms = pair()
    control = arms[0].control

    def step(goal: SheetMotion) -> None:
        control.step(arms[0].geometry, on_time(goal), arms[1].as_other(), STEP_S)

    step(HOME)
    old = control.pending_check
    assert old is not None
    control.on_scene_changed()
    step(HOME)
    step(HOME)
    control.on_path_result(old, None)
    step(HOME)
    assert control.reason == "checks the path to the target"
    assert control.pending_check is not None
    control.on_path_result(control.pending_check, None)
    step(sheet_at(0.1))
    assert control.mode == "hold", "the target has gone elsewhere since"
    assert control.pending_check is not None
    control.on_path_result(control.pending_check, None)
    step(sheet_at(0.101))
    assert control.mode == "follow"


def test_an_answer_that_comes_when_nothing_is_to_be_begun_is_not_kept() -> None:
    arms = pair()
    control, geometry = arms[0].control, arms[0].geometry
    control.step(geometry, on_time(HOME), arms[1].as_other(), STEP_S)
    assert control.pending_check is not None
    control.on_path_result(control.pending_check, None)
    control.step(geometry, None, arms[1].as_other(), STEP_S)
    control.step(geometry, on_time(HOME), arms[1].as_other(), STEP_S)
    assert control.mode == "hold"
    assert control.pending_check is not None


def test_the_sheet_goes_as_it_was_rehearsed() -> None:
    arms, goal = pair(), sheet_at(0.05, z=0.04, tilt=0.9, stretch=1.07)
    corners = rehearse(HOME, goal, LEFT.edge_bound)
    numbers = np.linspace(0, len(corners) - 1, 40 * len(corners))
    columns = [
        np.array([corner.world_from_sheet[1, 3] for corner in corners]),
        np.array([corner.world_from_sheet[2, 3] for corner in corners]),
        np.array([np.arcsin(corner.world_from_sheet[2, 1]) for corner in corners]),
        np.array([corner.stretch_ratio for corner in corners]),
    ]
    line = np.stack(
        [np.interp(numbers, np.arange(len(corners)), column) for column in columns], axis=1
    )
    weights = np.array([1.0, 1.0, 0.1, 0.24])
    furthest = 0.0
    for _ in range(500):
        run(arms, on_time(goal), 1)
        sheet = sheet_of(arms)
        tilt = np.arcsin(sheet.world_from_sheet[2, 1])
        spot = np.array([*sheet.world_from_sheet[1:3, 3], tilt, sheet.stretch_ratio])
        furthest = max(furthest, float(np.linalg.norm((line - spot) * weights, axis=1).min()))
    assert sheet_of(arms).world_from_sheet == pytest.approx(goal.world_from_sheet, abs=1e-6)
    assert furthest < 0.002


shift = st.tuples(st.floats(-0.12, 0.12), st.floats(-0.15, 0.15), st.floats(-0.15, 0.2))
lean = st.tuples(st.floats(-1.2, 1.2), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))


@examples(3)
@example(shift=(0.0, 0.0, 0.125), lean=(0.0, 0.5, 0.0), stretch=1.0)
@given(shift=shift, lean=lean, stretch=st.floats(0.9, 1.1))
def test_a_clear_path_is_followed_without_a_fault_and_both_bridges_agree(
    shift: tuple[float, ...], lean: tuple[float, ...], stretch: float
) -> None:
    goal = SheetMotion(transform_from_rpy(shift, lean), np.zeros(6), stretch, 0.0)
    way = make_request(HOME, goal)
    problem = find_violation(LEFT, RIGHT, way)
    assert problem == find_violation(RIGHT, LEFT, mirrored(way))
    if problem is not None:
        assert problem.startswith(("no path: left arm", "no path: right arm"))
        return
    arms = pair()
    for _ in range(60):
        run(arms, on_time(goal), 15)
        assert {arm.control.mode for arm in arms} == {"follow"}
        if np.abs(sheet_of(arms).world_from_sheet - goal.world_from_sheet).max() < 1e-3:
            break
    assert sheet_of(arms).world_from_sheet == pytest.approx(goal.world_from_sheet, abs=2e-3)


def test_from_beyond_a_limit_there_is_a_path_back_but_none_further() -> None:
    beyond = sheet_at(stretch=1.0872)
    assert find_violation(LEFT, RIGHT, make_request(beyond, sheet_at(stretch=1.05))) is None
    further = find_violation(LEFT, RIGHT, make_request(beyond, sheet_at(stretch=1.0875)))
    assert further is not None
    assert "edge force is violated" in further


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_nan_blocks_the_path(broken: float) -> None:
    pose = np.eye(4)
    pose[1, 3] = broken
    way = make_request(HOME, HOME)
    for start, goal in ((pose, np.eye(4)), (np.eye(4), pose)):
        asked = replace(
            way,
            start=replace(HOME, world_from_sheet=start),
            goal=replace(HOME, world_from_sheet=goal),
        )
        assert find_violation(LEFT, RIGHT, asked) is not None


async def test_paths_are_checked_outside_the_loop_one_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    threads: list[int] = []
    go_on = threading.Event()

    def slow(arm: ArmGeometry, other: ArmGeometry, way: PathCheckRequest) -> str | None:
        threads.append(threading.get_ident())
        assert go_on.wait(DEADLINE_S)
        return "barred"

    monkeypatch.setattr(path_check, "check_path", slow)
    checker, way = PathChecker(LEFT, RIGHT), make_request(HOME, HOME)
    assert checker.poll(None) is None
    for _ in range(5):
        assert checker.poll(way) is None
        await asyncio.sleep(0)
    go_on.set()
    await asyncio.get_running_loop().shutdown_default_executor()
    await asyncio.sleep(0)
    assert checker.poll(way) == (way, "barred")
    assert len(threads) == 1
    assert threads[0] != threading.get_ident()
    assert checker.poll(None) is None


@pytest.mark.parametrize(
    ("given_s", "rate_hz", "due_s"), [(None, 120.0, 1 / 120), (0.02, 60, 0.02)]
)
async def test_targets_are_due_at_the_cameras_rate_by_default(
    given_s: float | None, rate_hz: float, due_s: float
) -> None:
    node = ArmBridge(
        ArmBridgeParameters(side="left", target_period_s=given_s),
        name="bridge",
        clock=VirtualClock(),
        send=lambda topic, message, header: None,
        topics={"arm": "arm_left", "other_arm": "arm_right"},
    )
    await node.setup()
    camera = SCENE.camera.model_copy(update={"rate_hz": rate_hz})
    scene = SCENE.model_copy(update={"camera": camera})
    await node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
    assert node.errors == 0, node.last_error
    assert (node._timing.target_period_s, node._scheduler.target_period_s) == (due_s, due_s)
    await node.close()


async def aim(rig: Rig, nodes: dict[str, ArmBridge], sheet: SheetMotion) -> None:
    """Send this target to both bridges repeatedly."""
    while True:
        target = SheetTarget(
            phase="wait",
            reason="ok",
            valid_at_ns=rig.clock.now_ns(),
            world_from_sheet=sheet.world_from_sheet,
            twist_world=sheet.twist_world,
            stretch_ratio=sheet.stretch_ratio,
            contact_world_m=np.zeros(3),
            normal_world=np.array([0.0, 0.0, 1.0]),
            contact_sheet_m=np.zeros(2),
            push_depth_m=0.0,
        )
        for side in ("left", "right"):
            nodes[side].deliver("sheet_target", target, rig.header(rig.clock.now_ns()))
        await asyncio.sleep(1 / 60)


async def test_the_simulated_arms_rest_at_a_blocked_path_and_follow_a_clear_one() -> None:
    sides: tuple[Side, Side] = ("left", "right")
    patient = {"timeout_s": 0.25, "hold_after_s": 0.1, "stop_after_s": 0.6}
    async with running_rig({"watchdog_s": 0.8}, **patient) as (rig, nodes):
        servos = [nodes["twin"].servers[side].controller.servo for side in sides]
        places = [servo.joints_rad.copy() for servo in servos]
        task = asyncio.create_task(aim(rig, nodes, FAR))
        await until(lambda: all("no path" in note_text(nodes[side]) for side in sides))
        assert {rig.newest(side).mode for side in sides} == {"hold"}
        assert note_text(nodes["left"]).split(";")[0] == note_text(nodes["right"]).split(";")[0]
        assert "left arm, at " in note_text(nodes["left"])
        for servo, place in zip(servos, places, strict=True):
            assert (servo.joints_rad == place).all()
        task.cancel()
        task = asyncio.create_task(aim(rig, nodes, sheet_at(0.01)))
        await until(lambda: {rig.newest(side).mode for side in sides} == {"follow"})
        await until(lambda: abs(servos[0].joints_rad - places[0]).max() > 0.01)
        task.cancel()
