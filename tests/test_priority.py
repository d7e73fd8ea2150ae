"""Test the process priorities, and the report if they are not permitted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import child
from flexsheet.launch.running.priority import (
    MIN_NICE,
    describe_priority_problem,
    permitted_nice,
    permitted_real_time,
)
from flexsheet.nodes import background

ROOT = Path(__file__).resolve().parent.parent
DEMO = load_graph(ROOT / "launch" / "demo.yaml")


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Replace the niceness of this process by the only element of the list."""
    own = [0]
    monkeypatch.setattr(os, "getpriority", lambda which, who: own[0])
    return own


def permit(monkeypatch: pytest.MonkeyPatch, *, nice: int = MIN_NICE, real_time: int = 99) -> None:
    """Set the lowest niceness and the highest real-time priority that the user may set."""

    def setpriority(which: int, who: int, niceness: int) -> None:
        if niceness < nice:
            raise PermissionError

    def sched_setscheduler(thread: int, policy: int, given: os.sched_param) -> None:
        if given.sched_priority > real_time:
            raise PermissionError

    monkeypatch.setattr(os, "setpriority", setpriority)
    monkeypatch.setattr(os, "sched_setscheduler", sched_setscheduler)


@pytest.mark.parametrize(
    ("launcher", "least", "step", "given"),
    [
        (0, MIN_NICE, -10, -10),
        (0, 0, -10, 0),
        (0, -5, -5, -5),
        (5, 0, -5, -5),
        (0, 0, 7, 7),
        (-15, MIN_NICE, -10, -10),
    ],
)
def test_a_niceness_that_is_not_permitted_is_not_set(
    *,
    monkeypatch: pytest.MonkeyPatch,
    own: list[int],
    launcher: int,
    least: int,
    step: int,
    given: int,
) -> None:
    permit(monkeypatch, nice=least)
    own[0] = launcher
    assert permitted_nice(step) == given


def test_nodes_of_a_launcher_with_their_priority_lack_nothing(
    monkeypatch: pytest.MonkeyPatch, own: list[int]
) -> None:
    permit(monkeypatch, nice=0)
    own[0] = min(node.nice for node in DEMO.nodes.values())
    assert describe_priority_problem(list(DEMO.nodes.values())) is None


def test_a_missing_permission_for_priority_is_reported_once(
    monkeypatch: pytest.MonkeyPatch, own: list[int]
) -> None:
    nodes = list(DEMO.nodes.values())
    permit(monkeypatch)
    assert describe_priority_problem(nodes) is None
    permit(monkeypatch, nice=0)
    problem = describe_priority_problem(nodes)
    assert problem is not None
    assert "arm_left_bridge" in problem
    assert "renderer" not in problem
    assert "\n" not in problem


def test_a_missing_permission_for_real_time_is_reported(
    monkeypatch: pytest.MonkeyPatch, own: list[int]
) -> None:
    permit(monkeypatch, real_time=0)
    nodes = load_graph(ROOT / "launch" / "lab.yaml").nodes
    problem = describe_priority_problem(list(nodes.values()))
    assert problem is not None
    assert "arm_left_bridge" in problem
    assert "renderer" not in problem


def test_real_time_needs_permission_and_a_launcher_without_positive_niceness(
    monkeypatch: pytest.MonkeyPatch, own: list[int]
) -> None:
    permit(monkeypatch)
    assert permitted_real_time(10) == 10
    assert permitted_real_time(None) is None
    permit(monkeypatch, real_time=9)
    assert permitted_real_time(10) is None
    permit(monkeypatch)
    own[0] = 5
    assert permitted_real_time(10) is None


@pytest.mark.parametrize(("user", "remedy"), [(0, "CAP_SYS_NICE"), (1000, "start as root")])
def test_root_is_not_advised_to_become_root(
    monkeypatch: pytest.MonkeyPatch, own: list[int], user: int, remedy: str
) -> None:
    permit(monkeypatch, nice=0)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    problem = describe_priority_problem(list(DEMO.nodes.values()))
    assert problem is not None
    assert [one for one in ("CAP_SYS_NICE", "start as root") if one in problem] == [remedy]


@pytest.mark.parametrize(
    ("nice", "launcher", "written"),
    [(3, 10, "13"), (0, 10, "10"), (-10, 10, ""), (-10, 0, "-10"), (3, -5, "3"), (0, 0, "")],
)
def test_a_session_of_a_nice_launcher_is_nice(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, nice: int, launcher: int, written: str
) -> None:
    autogroup = tmp_path / "autogroup"
    autogroup.touch()
    monkeypatch.setattr(background, "AUTOGROUP", autogroup)
    monkeypatch.setattr(os, "nice", lambda step: launcher + step)
    monkeypatch.setenv(child.NICE_VARIABLE, str(nice))
    child.apply_niceness()
    assert autogroup.read_text() == written


def test_in_the_demo_the_arms_come_first() -> None:
    chain = {
        "twin_finger", "camera", "triangulator", "planner", "twin_arms", "arm_left_bridge",
        "arm_right_bridge",
    }  # fmt: skip
    for name, node in DEMO.nodes.items():
        first = (-10, 10) if name in chain else (0, None)
        assert (node.nice, node.realtime_priority) == first


def test_simulated_arms_may_answer_late_and_then_nothing_else_stops_them() -> None:
    arms = DEMO.nodes["twin_arms"].parameters
    for side in ("left", "right"):
        bridge = DEMO.nodes[f"arm_{side}_bridge"].parameters
        # Two answers may fail before an arm counts as lost; nothing may give up earlier.
        assert 2 * bridge["timeout_s"] < bridge["stop_after_s"] < arms["watchdog_s"]
    lab = load_graph(ROOT / "launch" / "lab.yaml").nodes["arm_left_bridge"].parameters
    assert (lab["timeout_s"], lab["stop_after_s"]) == (None, 0.1)
