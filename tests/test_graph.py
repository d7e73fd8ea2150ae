"""The whole graph on localhost, judged by its own bag: rates, ages, losses, exits, nothing left."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest

from launch.experiments import stroke
from launch.experiments.driver import Driver
from launch.experiments.run import DEMO_FILE
from launch.plan import load_plan
from launch.runs import RUN_VARIABLE
from launch.supervisor import RunningGraph
from messages.bag import BagReader
from messages.topics import TOPICS
from messages.types import ArmState, Frame, Status, TwinFinger

pytestmark = pytest.mark.timeout(300)

STROKE_S = 4.0
KILLED = "triangulator"


def processes_of_run(run_id: str) -> list[psutil.Process]:
    """Live processes that carry the run's tag."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(RUN_VARIABLE) == run_id:
                found.append(process)
        except psutil.Error:
            continue
    return found


def shorter(plan_ports: tuple[int, int]) -> list[str]:
    """Settings that put the twin's arms on ports of this test's own."""
    left, right = plan_ports
    return [
        f"twin_arms.left_port={left}",
        f"twin_arms.right_port={right}",
        f"arm_left_bridge.port={left}",
        f"arm_right_bridge.port={right}",
    ]


@dataclass
class Session:
    """What a run of the graph left behind."""

    bag: Path
    exit_codes: dict[str, int]
    run_id: str
    threads_before: set[str]
    threads_after: set[str]
    restarts: dict[str, int]


async def run_session(bag: Path, ports: tuple[int, int]) -> Session:
    """Stroke for a few seconds; then kill the triangulator in the middle of another stroke."""
    threads_before = {thread.name for thread in threading.enumerate()}
    plan = load_plan(DEMO_FILE, settings=shorter(ports), record=bag)
    scene = plan.scene_message()
    assert scene is not None
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(120)
        async with Driver(plan, graph.run) as driver:
            await driver.wait_until_up()
            await driver.follow(stroke.stroke_path(scene, STROKE_S))
            path = stroke.stroke_path(scene, STROKE_S + 1.0)
            driver.move_finger(path)
            await driver.wait_for(
                in_the_middle(driver, path.label), "the middle of the second stroke", 20.0
            )
            graph.kill(KILLED, signal.SIGKILL)
            await driver.wait_for(
                lambda: graph.restarts[KILLED] == 1 and graph.is_ready(KILLED),
                "the triangulator to come back",
                30.0,
            )
            await driver.wait_for(
                lambda: both_follow(driver), "both arms to follow the finger again", 20.0
            )
        restarts = dict(graph.restarts)
        run_id = graph.run.id
    return Session(
        bag,
        graph.exit_codes,
        run_id,
        threads_before,
        {thread.name for thread in threading.enumerate()},
        restarts,
    )


def in_the_middle(driver: Driver, label: str) -> Callable[[], bool]:
    def condition() -> bool:
        finger = driver.newest("twin/finger")
        begin, _ = stroke.stroke_window_s(STROKE_S)
        return (
            isinstance(finger, TwinFinger)
            and finger.path_label == label
            and finger.path_time_s > begin + STROKE_S / 2
        )

    return condition


def both_follow(driver: Driver) -> bool:
    arms = [driver.newest(name) for name in ("arm_left", "arm_right")]
    return all(
        isinstance(arm, ArmState) and arm.mode == "follow" and (arm.command_age_s or 1.0) < 0.1
        for arm in arms
    )


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    bag = tmp_path_factory.mktemp("graph") / "session.mcap"
    return asyncio.run(run_session(bag, (15120, 15121)))


@pytest.fixture(scope="module")
def recording(session: Session) -> stroke.Recording:
    return stroke.read_recording(session.bag)


def test_every_logged_topic_that_has_a_rate_arrives_at_it(session: Session) -> None:
    """Rates over the first stroke, before anything is killed, from the publishers' own stamps."""
    stamps: dict[str, list[int]] = {}
    windows = stroke.read_recording(session.bag).windows_ns
    begin_ns, end_ns = windows[stroke.stroke_label(STROKE_S)]
    for topic, _, header, _ in BagReader(session.bag):
        if begin_ns <= header.publish_ns <= end_ns:
            stamps.setdefault(topic, []).append(header.publish_ns)
    duration_s = (end_ns - begin_ns) * 1e-9
    # The recording holds several writers of status; each sends one a second.
    for name in ("fingertip", "sheet_target", "arm_left", "arm_right", "soft_body", "frame"):
        rate = TOPICS[name].rate_hz
        assert rate is not None
        # A busy machine may be late: half the least expected rate says that the path works.
        assert len(stamps.get(name, ())) / duration_s >= 0.5 * rate[0], name


def test_nothing_was_lost_or_refused_on_the_way(session: Session) -> None:
    problems = Counter()
    writers = set()
    for _, message, _, _ in BagReader(session.bag, topics=["status"]):
        if isinstance(message, Status):
            writers.add(message.node)
            for port in message.inputs:
                problems[message.node, port.topic] = port.gaps + port.rejected
    assert {"planner", "renderer", "fem_solver", "arm_left_bridge", "recorder"} <= writers
    assert not +problems


def test_sequences_in_the_bag_have_no_gaps(session: Session) -> None:
    newest: dict[tuple[str, str, int], int] = {}
    for topic, _, header, _ in BagReader(session.bag):
        key = (topic, header.writer, header.epoch)
        if key in newest:
            assert header.sequence == newest[key] + 1, key
        newest[key] = header.sequence


def test_data_is_fresh_where_it_is_used(recording: stroke.Recording) -> None:
    """Medians, generous: this asserts the wiring (no queue builds up), not the machine's speed."""
    assert np.median(recording.delays_s["fingertip"]) < 0.1
    assert np.median(recording.arm_delays_s()) < 0.15
    assert np.median(recording.delays_s["frame drawn"]) < 0.5


def test_the_sheet_follows_the_finger(recording: stroke.Recording) -> None:
    errors = stroke.stroke_errors(recording, STROKE_S)
    assert errors.true_delta_d_m.mean() < 1.5e-3
    assert errors.true_delta_theta_rad.mean() < np.radians(2.0)


def test_the_arms_stand_safely_while_the_triangulator_is_gone_and_follow_again(
    session: Session,
) -> None:
    modes: dict[str, list[str]] = {"left": [], "right": []}
    faults: set[str] = set()
    for _, message, _, _ in BagReader(session.bag, topics=["arm_left", "arm_right"]):
        if isinstance(message, ArmState):
            modes[message.side].append(message.mode)
            faults.update(message.faults)
    assert session.restarts[KILLED] == 1
    for side, seen in modes.items():
        halted = [i for i, mode in enumerate(seen) if mode in ("hold", "stopping", "idle")]
        first, last = seen.index("follow"), len(seen) - 1 - seen[::-1].index("follow")
        assert any(first < i < last for i in halted), side


def test_frames_show_what_the_finger_did(session: Session) -> None:
    numbers = [
        message.number
        for _, message, _, _ in BagReader(session.bag, topics=["frame"])
        if isinstance(message, Frame)
    ]
    assert len(numbers) > 20
    assert numbers == sorted(set(numbers))


def test_every_node_ended_well_and_nothing_is_left(session: Session) -> None:
    assert {name: code for name, code in session.exit_codes.items() if code != 0} == {}
    assert processes_of_run(session.run_id) == []
    assert session.threads_after <= session.threads_before
    listening = {
        connection.laddr.port
        for connection in psutil.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }
    assert not {15120, 15121} & listening


@pytest.mark.parametrize("after_s", [0.0, 0.7, 4.0])
def test_ctrl_c_at_any_moment_leaves_nothing(tmp_path: Path, after_s: float) -> None:
    """SIGINT before, during and after start-up: exit code 0, no process, no socket."""
    root = Path(__file__).resolve().parent.parent
    arguments = [str(DEMO_FILE)]
    for setting in shorter((15122, 15123)):
        arguments += ["--set", setting]
    launcher = subprocess.Popen(
        [sys.executable, str(root / "flexsheet.py"), "launch", *arguments],
        env={**os.environ, "FLEXSHEET_RUNS": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert launcher.stderr is not None
    first_line = launcher.stderr.readline()
    assert first_line
    try:
        launcher.wait(timeout=after_s)
    except subprocess.TimeoutExpired:
        launcher.send_signal(signal.SIGINT)
    rest = launcher.stderr.read()
    code = launcher.wait(timeout=30)
    launcher.stderr.close()
    assert code == 0, first_line + rest
    runs = [entry for entry in tmp_path.iterdir() if entry.is_dir()]
    assert runs
    for run in runs:
        assert processes_of_run(run.name) == []
        assert not [entry for entry in run.iterdir() if entry.is_socket()]
