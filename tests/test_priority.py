"""Test the process priorities, and the report if they are not permitted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import child, priority
from flexsheet.launch.running.priority import (
    MIN_NICE,
    describe_priority_problem,
    find_real_time_priority,
    min_nice_step,
)
from flexsheet.nodes import background

ROOT = Path(__file__).resolve().parent.parent
DEMO = load_graph(ROOT / "launch" / "demo.yaml")


def allow(monkeypatch: pytest.MonkeyPatch, *, capable: bool, limit: int) -> None:
    """Set whether the user has the capability, and the soft limit of niceness.

    Real-time priorities are permitted.
    """
    monkeypatch.setattr(priority, "_has_cap_sys_nice", lambda: capable)
    monkeypatch.setattr(priority, "_may_set_real_time", lambda wanted: True)
    monkeypatch.setattr(priority.resource, "getrlimit", lambda which: (limit, limit))
    monkeypatch.setattr(os, "getpriority", lambda which, who: 0)


@pytest.mark.parametrize(
    ("capable", "limit", "least"), [(True, 0, MIN_NICE), (False, 0, 0), (False, 25, -5)]
)
def test_capability_and_limit_allow_precedence(
    monkeypatch: pytest.MonkeyPatch, capable: bool, limit: int, least: int
) -> None:
    allow(monkeypatch, capable=capable, limit=limit)
    assert min_nice_step() == least


def test_a_nice_launcher_allows_more(monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, capable=False, limit=20)
    monkeypatch.setattr(os, "getpriority", lambda which, who: 5)
    assert min_nice_step() == -5


def test_nodes_of_a_launcher_with_their_priority_lack_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    allow(monkeypatch, capable=False, limit=0)
    own = min(node.nice for node in DEMO.nodes.values())
    monkeypatch.setattr(os, "getpriority", lambda which, who: own)
    assert describe_priority_problem(list(DEMO.nodes.values())) is None


def test_a_missing_permission_for_priority_is_reported_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nodes = list(DEMO.nodes.values())
    allow(monkeypatch, capable=True, limit=0)
    assert describe_priority_problem(nodes) is None
    allow(monkeypatch, capable=False, limit=0)
    problem = describe_priority_problem(nodes)
    assert problem is not None
    assert "arm_left_bridge" in problem
    assert "renderer" not in problem
    assert "\n" not in problem


def test_a_missing_permission_for_real_time_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, capable=True, limit=0)
    monkeypatch.setattr(priority, "_may_set_real_time", lambda wanted: False)
    nodes = load_graph(ROOT / "launch" / "lab.yaml").nodes
    problem = describe_priority_problem(list(nodes.values()))
    assert problem is not None
    assert "arm_left_bridge" in problem
    assert "renderer" not in problem


def test_real_time_needs_permission_and_a_launcher_without_positive_niceness(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    allow(monkeypatch, capable=True, limit=0)
    assert find_real_time_priority(10) == 10
    assert find_real_time_priority(None) is None
    monkeypatch.setattr(os, "getpriority", lambda which, who: 5)
    assert find_real_time_priority(10) is None
    allow(monkeypatch, capable=True, limit=0)
    monkeypatch.setattr(priority, "_may_set_real_time", lambda wanted: False)
    assert find_real_time_priority(10) is None


def test_a_user_without_permission_may_not_set_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not priority._may_set_real_time(1)


@pytest.mark.parametrize(("user", "remedy"), [(0, "CAP_SYS_NICE"), (1000, "start as root")])
def test_root_is_not_advised_to_become_root(
    monkeypatch: pytest.MonkeyPatch, user: int, remedy: str
) -> None:
    allow(monkeypatch, capable=False, limit=0)
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


def test_in_the_demo_the_arms_come_first_and_the_image_before_other_programs() -> None:
    chain = {
        "twin_finger", "camera", "triangulator", "planner", "twin_arms", "arm_left_bridge",
        "arm_right_bridge",
    }  # fmt: skip
    priorities = {name: node.realtime_priority for name, node in DEMO.nodes.items()}
    assert {name for name, given in priorities.items() if given == 10} == chain
    assert {name for name, given in priorities.items() if given == 5} == {"fem_solver", "renderer"}
    assert set(priorities.values()) <= {None, 5, 10}
    first = max(DEMO.nodes[name].nice for name in chain)
    assert first < 0 <= min(node.nice for node in DEMO.nodes.values() if node.name not in chain)


def test_simulated_arms_may_answer_late_and_then_nothing_else_stops_them() -> None:
    arms = DEMO.nodes["twin_arms"].parameters
    for side in ("left", "right"):
        bridge = DEMO.nodes[f"arm_{side}_bridge"].parameters
        # Two answers may fail before an arm counts as lost; nothing may give up earlier.
        assert 2 * bridge["timeout_s"] < bridge["stop_after_s"] < arms["watchdog_s"]
    lab = load_graph(ROOT / "launch" / "lab.yaml").nodes["arm_left_bridge"].parameters
    assert (lab["timeout_s"], lab["stop_after_s"]) == (None, 0.1)
