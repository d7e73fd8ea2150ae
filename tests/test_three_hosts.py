"""Three computers, with keys, on a network that fails: judged by what the arms' joints did."""

from __future__ import annotations

import asyncio
import json
import signal
from typing import Any

import numpy as np
import pytest

from messages.bag import BagReader
from messages.types import ArmState, TwinArms
from tests.lab import HOSTS, Lab

SIDES = ("left", "right")
LONGEST_M = 0.24 * 1.15
PATIENT: dict[str, Any] = {"timeout_s": 0.25, "hold_after_s": 0.1, "stop_after_s": 0.6}
"""A test's computers are busier than a lab's."""

pytestmark = pytest.mark.timeout(300)


def truth(lab: Lab, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and true joints (n, 6) of an arm, from its own computer's bag."""
    times, joints = [], []
    for _, message, header, _ in BagReader(lab.bag(side), [f"twin/arms_{side}"]):
        assert isinstance(message, TwinArms)
        times.append(header.source_ns * 1e-9)
        joints.append(message.joints_left_rad if side == "left" else message.joints_right_rad)
    return np.array(times), np.array(joints)


def judge(lab: Lab) -> None:
    """No limit was violated, whatever happened: by the bridges' words and the arms' own joints."""
    states = [state for _, state in lab.seen]
    assert states
    assert isinstance(states[0], ArmState)
    longest = max(state.edge_distance_m or 0.0 for state in states)
    assert longest <= LONGEST_M
    said = {fault for state in states if state.mode != "disconnected" for fault in state.faults}
    assert {fault for fault in said if not fault.startswith("e-stop")} == set()


def stands(states: list[ArmState]) -> bool:
    return float(np.ptp([state.joints_rad for state in states], axis=0).max()) < 1e-3


async def next_states(lab: Lab, side: str, count: int) -> list[ArmState]:
    topic, begin = f"arm_{side}", len(lab.seen)

    def found() -> list[ArmState]:
        return [s for t, s in lab.seen[begin:] if t == topic and isinstance(s, ArmState)]

    await lab.until(lambda: len(found()) >= count, f"{count} states of {topic}")
    return found()


async def test_a_cable_is_cut_and_no_arm_moves_again_until_it_is_told_so() -> None:
    async with Lab(arming="by_command", watchdog_s=0.8, **PATIENT) as lab:
        await lab.start_all()
        await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stand")
        for _ in range(10):
            code, words = await lab.run("main", "arms", "ready")
            if code == 0:
                break
        assert code == 0, words
        await lab.until(lambda: lab.modes() == {"follow"}, "both arms to follow")
        # Nobody else's machine can be half gone more thoroughly: frames vanish, nobody is told.
        await lab.cable("main", cut=True)
        await lab.until(lambda: lab.modes() == {"idle"}, "both arms to stop")
        begin = {side: len(lab.seen) for side in SIDES}
        await lab.cable("main")
        await lab.until(lambda: len(lab.seen) > begin["left"] + 280, "what they do then")
        for side in SIDES:
            assert stands((await next_states(lab, side, 100))[-80:])
        newest = lab.newest["arm_left"]
        assert isinstance(newest, ArmState)
        assert not newest.ready
        code, words = await lab.run("main", "arms", "ready", "--json")
        assert code == 0, words
        assert all(row["ready"] for row in json.loads(words[words.index("[") :]))
        await lab.until(lambda: lab.modes() == {"follow"}, "both arms to follow again")
        judge(lab)
        await the_doctor_asks_all(lab)
        await a_stop_outlives_all_launchers(lab)
        for host in HOSTS:
            lab.launchers[host].send_signal(signal.SIGINT)
        codes = [await asyncio.to_thread(lab.launchers[host].wait, 40) for host in HOSTS]
        assert codes == [0, 0, 0]
        for side in SIDES:
            times, joints = truth(lab, side)
            assert len(times) > 100
            assert np.isfinite(joints).all()


async def the_doctor_asks_all(lab: Lab) -> None:
    code, words = await lab.run("left", "doctor", "hosts", "--patience=20", "--json")
    findings = json.loads(words[words.index("{") :])["findings"]
    found = {(one["host"], one["check"]): one["state"] for one in findings}
    for host in HOSTS:
        for check in ("reachable", "launcher", "plan", "keys", "clocks", "nodes"):
            assert found[host, check] == "ok", words
    assert found["left", "arm left"] == found["right", "arm right"] == "ok"
    assert code == 0, words


async def a_stop_outlives_all_launchers(lab: Lab) -> None:
    """Said beside an arm, where nobody may reset it; then all is killed and started anew."""
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
