"""Test three computers with keys on a failing network, by the true joints of the arms."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.types import ArmState
from tests.lab import HOSTS, Lab
from tests.lab_bags import Arm, Span, gaps, measure_hold, read_arm, wanted
from tests.waiting import DEADLINE_S

SIDES = ("left", "right")
MAX_LENGTH_M = 0.24 * 1.15
TURNED_RAD = 0.15
STANDS_RAD = 1e-3
STOPPED_NS = 200_000_000
"""Lag of the joints, and of the last message before a stop."""
OFF_M = 0.01
MARGIN_NS = 1_500_000_000
"""Margin for a message that is published once a second and lost at the start of a fault."""
PATIENT: dict[str, Any] = {"timeout_s": 0.25, "hold_after_s": 0.1, "stop_after_s": 0.6}
"""Time-outs for a test's computers, which are busier than a lab's."""

pytestmark = pytest.mark.timeout(600)


@dataclass
class FaultSpans:
    """Time spans of faults until the recovery, ns."""

    spans: dict[str, Span] = field(default_factory=dict)

    @contextmanager
    def problem(self, name: str) -> Iterator[None]:
        begin_ns = time.monotonic_ns()
        yield
        self.spans[name] = begin_ns, time.monotonic_ns()

    def about(self, at_ns: int) -> bool:
        return any(
            begin - MARGIN_NS <= at_ns <= end + MARGIN_NS for begin, end in self.spans.values()
        )


def check_messages(lab: Lab) -> None:
    """Assert that the bridges reported no violation of a limit."""
    states = [state for _, state in lab.seen]
    assert states
    assert isinstance(states[0], ArmState)
    longest = max(state.edge_distance_m or 0.0 for state in states)
    assert longest <= MAX_LENGTH_M
    printed = {fault for state in states if state.mode != "disconnected" for fault in state.faults}
    assert {fault for fault in printed if not fault.startswith("e-stop")} == set()


def check_arm(arm: Arm, stood_modes: tuple[str, ...]) -> None:
    """An arm's true joints: it turned the sheet with the finger while it followed, and stood
    whenever it said so."""
    assert np.isfinite(arm.joints_rad).all()
    assert arm.fastest() <= 1.0
    assert not arm.leaves_range()
    assert max(map(arm.turned_rad, arm.spans("follow"))) > TURNED_RAD
    for mode in stood_modes:
        stood = [(begin + STOPPED_NS, end) for begin, end in arm.spans(mode)]
        assert any(len(arm.between(span)) > 50 for span in stood)
        assert all(arm.turned_rad(span) < STANDS_RAD for span in stood)


def check_bags(lab: Lab, problems: FaultSpans) -> None:
    """Assert the same for the arms' true joints, and that the strokes were followed."""
    scene = lab.plan().scene_message()
    assert scene is not None
    arms = read_arm(lab.folder, "left", scene), read_arm(lab.folder, "right", scene)
    for arm in arms:
        check_arm(arm, ("idle", "estop"))
    lossy = problems.spans["loss and jitter"]
    sheet = measure_hold(arms, wanted(lab.folder), lossy)
    assert sheet.followed > 0.5
    assert all(arm.turned_rad(lossy) > TURNED_RAD for arm in arms)
    assert len(sheet.errors_m) > 50
    assert np.median(sheet.errors_m) < OFF_M
    lost = gaps(lab.folder)
    assert [gap for gap in lost if not problems.about(gap.from_ns)] == []
    longest_s = max(end - begin for begin, end in problems.spans.values()) * 1e-9
    assert all(gap.seconds < longest_s + 2e-9 * MARGIN_NS for gap in lost)


def stands(states: list[ArmState]) -> bool:
    return float(np.ptp([state.joints_rad for state in states], axis=0).max()) < 1e-3


def followed_rad(lab: Lab, side: str, begin: int) -> float:
    """Return the largest rotation of a joint while its arm followed, rad."""
    joints_rad = [
        state.joints_rad
        for topic, state in lab.seen[begin:]
        if topic == f"arm_{side}" and isinstance(state, ArmState) and state.mode == "follow"
    ]
    return float(np.ptp(joints_rad, axis=0).max()) if joints_rad else 0.0


async def next_states(lab: Lab, side: str, count: int) -> list[ArmState]:
    topic, begin = f"arm_{side}", len(lab.seen)

    def found() -> list[ArmState]:
        return [s for t, s in lab.seen[begin:] if t == topic and isinstance(s, ArmState)]

    await lab.until(lambda: len(found()) >= count, f"{count} states of {topic}")
    return found()


# With manual arming, one target that a busy computer delays would disarm the arms for good.
@pytest.mark.alone
async def test_arms_that_stroke_stop_at_a_cut_cable_and_move_when_told_so() -> None:
    """One failure; the next test adds a bad network, killed nodes, the doctor and killed hosts."""
    async with Lab(arming="manual", watchdog_s=0.8, **PATIENT) as lab:
        await lab.start_all()
        lab.stroke()
        await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stand")
        await told_to_move(lab)
        begin = len(lab.seen)
        await lab.until(
            lambda: all(followed_rad(lab, side, begin) > 1.5 * TURNED_RAD for side in SIDES),
            "both arms to turn the sheet",
        )
        await a_cable_is_cut(lab)
        check_messages(lab)
        scene = lab.plan().scene_message()
        assert scene is not None
        await end_launchers(lab)
        for side in SIDES:
            check_arm(read_arm(lab.folder, side, scene), ("idle",))


@pytest.mark.long
async def test_stroking_arms_stop_at_failures_and_move_when_enabled() -> None:
    problems = FaultSpans()
    async with Lab(arming="manual", watchdog_s=0.8, **PATIENT) as lab:
        await last_weeks_plan_is_refused(lab)
        lab.stroke()
        await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stand")
        await told_to_move(lab)
        with problems.problem("loss and jitter"):
            for side in SIDES:
                await lab.cable(side, loss=0.01, delay_s=0.02, jitter_s=0.01)
            await next_states(lab, "left", 280)
            for side in SIDES:
                await lab.cable(side)
            await lab.until(lambda: lab.modes() == {"follow"}, "both arms to follow on")
        with problems.problem("cut"):
            await a_cable_is_cut(lab)
        with problems.problem("killed"):
            await one_of_each_host_is_killed(lab)
        check_messages(lab)
        await the_doctor_asks_all(lab)
        with problems.problem("all launchers killed"):
            await a_stop_outlives_all_launchers(lab)
        await end_launchers(lab)
        check_bags(lab, problems)


async def end_launchers(lab: Lab) -> None:
    for host in HOSTS:
        lab.launchers[host].send_signal(signal.SIGINT)
    codes = [await asyncio.to_thread(lab.launchers[host].wait, DEADLINE_S) for host in HOSTS]
    assert codes == [0, 0, 0]


async def last_weeks_plan_is_refused(lab: Lab) -> None:
    """Start one computer with an old launch file; both sides report it, and it is fixed."""
    old = lab.launch_file.with_name("last-week.yaml")
    old.write_text(lab.launch_file.read_text().replace("watchdog_s: 0.8", "watchdog_s: 0.7"))
    theirs, ours = load_graph(old).hash, lab.plan().hash
    assert theirs != ours
    lab.start("main", "left")
    lab.start("right", launch_file=old)
    for host, word in (("right", f"{ours}', this node runs {theirs}"),
                       ("left", f"{theirs}', this node runs {ours}")):  # fmt: skip
        log = lab.folder / f"{host}.log"
        await lab.until(lambda log=log, word=word: word in log.read_text(), f"{word} by {host}")
    lab.launchers["right"].kill()
    await asyncio.to_thread(lab.launchers["right"].wait)
    lab.start("right")
    for host in HOSTS:
        await lab.watch_usual(host)


async def told_to_move(lab: Lab) -> None:
    """Enable the arms by the command, which fails until both are present."""
    for _ in range(10):
        code, words = await lab.run("main", "arms", "enable", "--json")
        if code == 0:
            break
    assert code == 0, words
    assert all(row["ready"] for row in json.loads(words[words.index("[") :]))
    await lab.until(lambda: lab.modes() == {"follow"}, "both arms to follow")
    await lab.until(lab.strokes, "the finger to stroke")


async def stand_until_told(lab: Lab) -> None:
    """Assert that arms rest after a recovery, except for relaxing the sheet, until they are
    enabled."""

    def rest() -> bool:
        newest = [[s for t, s in lab.seen[-800:] if t == f"arm_{side}"] for side in SIDES]
        return all(
            len(states) > 80
            and {state.mode for state in states[-80:] if isinstance(state, ArmState)} == {"idle"}
            for states in newest
        )

    await lab.until(rest, "both arms to rest")
    for side in SIDES:
        assert stands(await next_states(lab, side, 80))
        newest = lab.newest[f"arm_{side}"]
        assert isinstance(newest, ArmState)
        assert not newest.ready
    await told_to_move(lab)


async def a_cable_is_cut(lab: Lab) -> None:
    # Nobody else's machine can be half gone more thoroughly: frames vanish, nobody is told.
    await lab.cable("main", cut=True)
    await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stop")
    await lab.cable("main")
    await stand_until_told(lab)


async def one_of_each_host_is_killed(lab: Lab) -> None:
    killed = (("main", "planner"), ("left", "arm_left_bridge"), ("right", "arm_right_bridge"))
    before = [lab.restarts(*one) for one in killed]
    for pid in [lab.pid_of(*one) for one in killed]:
        os.kill(pid, signal.SIGKILL)
    for one, times in zip(killed, before, strict=True):
        await lab.until(lambda one=one, times=times: lab.restarts(*one) > times, f"{one} again")
    await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stop")
    await stand_until_told(lab)


async def the_doctor_asks_all(lab: Lab) -> None:
    code, words = await lab.run("left", "doctor", "--json")
    findings = json.loads(words[words.index("[") :])
    found = {(one["host"], one["check"]): one["state"] for one in findings}
    for host in HOSTS:
        for check in ("launcher", "plan", "keys", "clocks"):
            assert found[host, check] == "ok", words
        # One of each was killed.
        assert found[host, "nodes"] == "warning", words
    assert found["left", "arm left"] == found["right", "arm right"] == "ok"
    assert code == 0, words


async def a_stop_outlives_all_launchers(lab: Lab) -> None:
    """Stop beside an arm, where the reset is not allowed; then kill and restart everything."""
    code, words = await lab.run("left", "arms", "stop", "--reason=a hand in the sheet")
    assert code == 0, words
    for process in lab.launchers.values():
        process.kill()
    for process in lab.launchers.values():
        await asyncio.to_thread(process.wait)
    lab.newest.clear()
    await lab.start_all()
    await lab.until(lambda: lab.modes() == {"estop"}, "the stop to be remembered")
    for side in SIDES:
        states = await next_states(lab, side, 50)
        assert stands(states)
        assert any("a hand in the sheet" in fault for fault in states[-1].faults)
