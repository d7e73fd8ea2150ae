"""Test that an arm moves only after the user enables it, and again after each stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.types import Arming, EStop
from flexsheet.nodes.arm_bridge.control import MAX_ARMING_AGE_S, MAX_WAIT_FOR_OTHER_S, RELAX_DELAY_S
from flexsheet.nodes.arm_bridge.goal import Goal
from flexsheet.nodes.arm_bridge.link import ArmFault, ArmSilentError, ArmStatus, Floats
from flexsheet.nodes.arm_bridge.node import ArmBridge, ArmBridgeParameters
from tests.arm_states import arm_state
from tests.examples import examples, long_except
from tests.note_text import note_text
from tests.test_arm_control import HOME, STEP_S, Arm, distance, on_time, pair, run, sheet_at
from tests.test_arm_loop import SCENE_FILE

GO, STAND_DOWN = Arming(ready=True), Arming(ready=False, reason="lunch")
GOAL = on_time(sheet_at(stretch=1.06))
NO_TARGET = replace(GOAL, overdue_s=0.2)
SLACK_M = 0.24
Arms = tuple[Arm, Arm]


def unready() -> Arms:
    return pair(sheet_at(stretch=1.06), auto_arming=False)


def say_go(arms: Arms) -> list[str | None]:
    return [arm.control.on_arming(GO, 0.01) for arm in arms]


def following() -> Arms:
    arms = unready()
    run(arms, GOAL, 3)
    assert say_go(arms) == [None, None]
    run(arms, GOAL, 60)
    assert {arm.control.mode for arm in arms} == {"follow"}
    return arms


def assert_stands(arms: Arms, goal: Goal | None = GOAL, cycles: int = 250) -> None:
    places = [arm.joints.copy() for arm in arms]
    run(arms, goal, cycles)
    assert not any(arm.control.ready for arm in arms)
    for arm, place in zip(arms, places, strict=True):
        assert (arm.joints == place).all()


def test_nothing_moves_before_arming() -> None:
    arms = unready()
    assert_stands(arms, on_time(sheet_at(0.03)))
    assert {arm.control.reason for arm in arms} == {"not ready"}
    assert say_go(arms) == [None, None]
    run(arms, on_time(sheet_at(0.03)), 500)
    assert {arm.control.mode for arm in arms} == {"follow"}
    assert arms[0].edge[1, 3] == pytest.approx(0.03, abs=1e-4)


def test_without_targets_both_stop_let_go_and_stay_when_they_come_again() -> None:
    arms = following()
    run(arms, NO_TARGET, 20)
    assert {arm.control.mode for arm in arms} == {"idle"}
    assert distance(arms) == pytest.approx(SLACK_M * 1.06, abs=1e-6)
    run(arms, NO_TARGET, round(3.0 / STEP_S))
    assert distance(arms) == pytest.approx(SLACK_M, abs=5e-4)
    assert_stands(arms)
    assert arms[0].control.reason == "not ready since: no sheet target"
    assert say_go(arms) == [None, None]
    run(arms, GOAL, 600)
    assert distance(arms) == pytest.approx(SLACK_M * 1.06, abs=1e-6)


def test_a_short_gap_of_targets_keeps_tension_but_disarms() -> None:
    arms = following()
    run(arms, NO_TARGET, round(0.5 * RELAX_DELAY_S / STEP_S))
    run(arms, GOAL, 2)
    assert distance(arms) == pytest.approx(SLACK_M * 1.06, abs=1e-6)
    assert {arm.control.mode for arm in arms} == {"idle"}


def test_when_the_other_arm_falls_silent_the_sheet_stays_as_it_is_for_good() -> None:
    arms = following()
    for _ in range(300):
        for arm, other in (arms, arms[::-1]):
            arm.cycle(GOAL, other.as_other(age_s=0.3))
    assert {arm.control.reason for arm in arms} == {"the other arm is silent"}
    # To let go now would be a motion on return.
    assert_stands(arms)
    assert distance(arms) == pytest.approx(SLACK_M * 1.06, abs=1e-6)
    assert say_go(arms) == [None, None]
    run(arms, GOAL, 100)
    assert {arm.control.mode for arm in arms} == {"follow"}


def lose_arm(arm: Arm) -> None:
    arm.control.on_connection_lost("no answer")


def trip_watchdog(arm: Arm) -> None:
    arm.control.on_measurement(arm.joints, (ArmFault.WATCHDOG,))


@pytest.mark.parametrize("problem", long_except([lose_arm, trip_watchdog], trip_watchdog))
def test_an_arm_that_was_away_comes_back_standing(problem: Callable[[Arm], None]) -> None:
    arms = following()
    problem(arms[0])
    arms[1].cycle(GOAL, arms[0].as_other())
    run(arms, GOAL, 700)
    assert_stands(arms)
    # Both say why, to whoever stands before them.
    assert all(arm.control.reason.startswith("not ready since: ") for arm in arms)
    assert say_go(arms) == [None, None]
    run(arms, GOAL, 400)
    assert {arm.control.mode for arm in arms} == {"follow"}


def test_uncertain_clocks_disarm_too() -> None:
    arms = following()
    for arm, other in (arms, arms[::-1]):
        arm.control.step(arm.geometry, GOAL, other.as_other(), STEP_S, "clocks: 9 ms apart")
    assert arms[0].control.on_arming(GO, 0.0) == "clocks: 9 ms apart"
    assert_stands(arms)
    assert arms[1].control.reason == "not ready since: clocks: 9 ms apart"


def test_a_reset_alone_moves_nothing() -> None:
    for stop in ("fault", "estop"):
        arms = following()
        if stop == "fault":
            arms[0].control.faults = ("drill",)
        else:
            for arm in arms:
                arm.control.engage_estop("button")
        run(arms, GOAL, 400)
        assert say_go(arms) != [None, None]
        assert all(arm.control.reset() for arm in arms)
        assert_stands(arms)
        assert say_go(arms) == [None, None]
        run(arms, GOAL, 400)
        assert {arm.control.mode for arm in arms} == {"follow"}


def test_arming_is_rejected_in_an_unsuitable_state() -> None:
    arms = unready()
    assert say_go(arms) == ["waiting for the arm to answer", "waiting for the arm to answer"]
    run(arms, None, 3)
    assert say_go(arms) == ["waiting for a sheet target", "waiting for a sheet target"]
    run(arms, GOAL, 3)
    assert (
        arms[0].control.on_arming(GO, MAX_ARMING_AGE_S + 0.5) == "the arming command is 1.5 s old"
    )
    assert "nan" in str(arms[0].control.on_arming(GO, float("nan")))
    assert_stands(arms)
    arms, up = following(), np.array([0.0, 0.15, 0.0, 0.0, 0.0, 0.0])
    for number in range(60):
        shifted = sheet_at(0.15 * number * STEP_S, stretch=1.06)
        run(arms, on_time(replace(shifted, twist_world=up)), 1)
    run(arms, NO_TARGET, 1)
    run(arms, GOAL, 1)
    assert arms[0].control.on_arming(GO, 0.0) == "the arm still moves"


def test_one_arm_alone_is_not_ready_for_long() -> None:
    arms = unready()
    run(arms, GOAL, 3)
    assert arms[0].control.on_arming(GO, 0.0) is None
    run(arms, GOAL, round(0.5 * MAX_WAIT_FOR_OTHER_S / STEP_S))
    assert arms[0].control.ready
    run(arms, GOAL, round(0.6 * MAX_WAIT_FOR_OTHER_S / STEP_S))
    assert not arms[0].control.ready
    # Told so now, the second must not find the first still waiting.
    assert arms[1].control.on_arming(GO, 0.0) is None
    run(arms, GOAL, 3)
    assert {arm.control.mode for arm in arms} == {"idle"}


def test_disabled_arms_stop_and_relax_the_sheet() -> None:
    for arms in (following(), pair(sheet_at(stretch=1.06))):
        run(arms, GOAL, 60)
        for arm in arms:
            assert arm.control.on_arming(STAND_DOWN, 99.0) is None
        run(arms, GOAL, 600)
        assert distance(arms) == pytest.approx(SLACK_M, abs=5e-4)
        assert_stands(arms)
        assert arms[0].control.reason == "disabled: lunch"
        assert say_go(arms) == [None, None]
        run(arms, GOAL, 600)
        assert {arm.control.mode for arm in arms} == {"follow"}


EVENTS = ("no target", "silent", "lost", "watchdog", "estop", "reset", "fault", "go", "well")


@examples(8)
@given(st.lists(st.sampled_from(EVENTS), min_size=1, max_size=12))
def test_an_arm_that_is_not_ready_starts_no_motion_after_any_events(events: list[str]) -> None:
    """At rest with a slack sheet or isolated, an arm rests until it is armed."""
    arms = following()
    goal = on_time(HOME)
    for event in events:
        if event == "lost":
            lose_arm(arms[0])
        elif event == "watchdog":
            trip_watchdog(arms[1])
        elif event == "estop":
            arms[0].control.engage_estop("button")
        elif event == "reset":
            arms[0].control.reset()
        elif event == "fault":
            arms[1].control.faults = ("drill",)
        elif event == "go":
            say_go(arms)
        for _ in range(40):
            for arm, other in (arms, arms[::-1]):
                was_ready, resting, before = arm.control.ready, arm.control.at_rest, arm.joints
                age_s = 0.3 if event == "silent" else 0.005
                arm.cycle(NO_TARGET if event == "no target" else goal, other.as_other(age_s))
                begins = resting and not (arm.joints == before).all()
                if begins and not was_ready:
                    assert arm.control.mode == "relax", (event, arm.control.mode)


class CountingLink:
    """Simulate an arm that does not move, and record its commands."""

    def __init__(self) -> None:
        self.modes: list[str] = []
        self.fails = False

    def due(self, now_ns: int) -> bool:
        return True

    async def exchange(self, *, mode: str, joints_rad: Floats, now_ns: int) -> ArmStatus:
        self.modes.append(mode)
        if self.fails:
            raise ArmSilentError("no answer")
        return ArmStatus(np.zeros(6), ())

    def close(self) -> None:
        self.modes.append("closed")


async def make_bridge(clock: VirtualClock, link: CountingLink) -> ArmBridge:
    """Make the bridge of the left arm with a simulated connection to the arm."""
    node = ArmBridge(
        ArmBridgeParameters(side="left"),
        name="bridge",
        clock=clock,
        send=lambda topic, message, header: None,
        topics={"arm": "arm_left", "other_arm": "arm_right"},
    )
    await node.setup()
    node._link = link
    return node


async def test_an_arm_that_is_not_enabled_gets_fewer_commands_until_an_event() -> None:
    clock, link = VirtualClock(10**9, clock_id="here"), CountingLink()
    node = await make_bridge(clock, link)

    def header() -> Header:
        return Header(1, clock.now_ns(), clock.now_ns(), "here", "tools", 1)

    async def asked_within_a_second() -> int:
        before = len(link.modes)
        for _ in range(140):
            clock.move_to(clock.now_ns() + round(1e9 / 140))
            await node.step("other_arm", arm_state("right"), header())
            await node.cycle()
        return len(link.modes) - before

    await node.step("scene", load_scene(SCENE_FILE), header())
    await asked_within_a_second()
    assert node._control.mode == "idle"
    assert 34 <= await asked_within_a_second() <= 41
    await node.step("estop", EStop(engaged=True, reason="button"), header())
    assert await asked_within_a_second() >= 138
    assert set(link.modes) <= {"idle", "stop"}
    await node.close()


async def test_failed_exchanges_are_counted_from_the_first_answer_on() -> None:
    """Earlier, the connection attempts before the start of the arm counted as failed exchanges."""
    clock, link = VirtualClock(10**9, clock_id="here"), CountingLink()
    node = await make_bridge(clock, link)

    async def cycle(*, fails: bool) -> str:
        link.fails = fails
        asked = len(link.modes)
        while len(link.modes) == asked:
            clock.move_to(clock.now_ns() + round(1e9 / 140))
            await node.cycle()
        return note_text(node)

    stamp = clock.now_ns()
    await node.step("scene", load_scene(SCENE_FILE), Header(1, stamp, stamp, "here", "tools", 1))
    assert "exchange" not in await cycle(fails=True)
    assert "exchange" not in await cycle(fails=False)
    assert "commands-unanswered: 1 " in await cycle(fails=True)
    await node.close()


async def test_the_node_receives_arming_and_reports_its_state() -> None:
    clock, printed = VirtualClock(10**9, clock_id="here"), []
    node = ArmBridge(
        ArmBridgeParameters(side="left"),
        name="bridge",
        clock=clock,
        send=lambda topic, message, header: printed.append(message),
        topics={"arm": "arm_left", "other_arm": "arm_right"},
    )
    await node.setup()
    await node.step("arming", GO, Header(1, 10**9, 10**9, "here", "tools", 1))
    assert not node._control.ready
    await node.close()


def test_the_laboratory_uses_the_interface_of_the_arms_of_its_scene() -> None:
    plan = load_graph(SCENE_FILE.parent.parent / "lab.yaml")
    scene = plan.scene_message()
    assert scene is not None
    assert {scene.arms.left.model.name, scene.arms.right.model.name} == {"rv-1a"}
    bridges = plan.nodes_of_type("arm_bridge")
    found = {(one.parameters["driver"], one.parameters["port"]) for one in bridges}
    assert found == {("mxt", 10000)}


def test_real_arms_need_arming_and_the_demos_do_not() -> None:
    folder = SCENE_FILE.parent.parent
    for name, expected in (("lab.yaml", "manual"), ("demo.yaml", "auto")):
        nodes = load_graph(folder / name).nodes.values()
        found = {node.parameters["arming"] for node in nodes if node.type == "arm_bridge"}
        assert found == {expected}
    values = YAML(typ="safe").load(folder / "lab.yaml")
    assert "arming" not in values["nodes"]["arm_left_bridge"]["parameters"]
