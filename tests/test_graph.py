"""Test the whole graph on localhost by its own bag: rates, ages, losses, exits, remains."""

from __future__ import annotations

import asyncio
import signal
import socket
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest

from flexsheet.launch.experiments import driver as driving
from flexsheet.launch.experiments import stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import RUN_VARIABLE
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import make_subscriber
from flexsheet.messages.bag import BagReader
from flexsheet.messages.topics import TOPICS, Delivery, find_topic
from flexsheet.messages.types import ArmState, Fingertip, Frame, SheetTarget, Status, TwinFinger
from tests.waiting import DEADLINE_S, until

pytestmark = [pytest.mark.alone, pytest.mark.timeout(600)]

STROKE_S = 4.0
KILLED = "triangulator"
MIN_FRAMES = 20
"""Number of frames that shows whether they are in order and drawn from the newest data."""


def processes_of_run(run_id: str) -> list[psutil.Process]:
    """Return the live processes with the run's tag."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(RUN_VARIABLE) == run_id:
                found.append(process)
        except psutil.Error:
            continue
    return found


def on_ports(plan_ports: tuple[int, int]) -> list[str]:
    """Return settings that put the simulated arms on this test's ports and compute no table."""
    left, right = plan_ports
    return [
        f"twin_arms.left_port={left}",
        f"twin_arms.right_port={right}",
        f"arm_left_bridge.port={left}",
        f"arm_right_bridge.port={right}",
        "fem_solver.method=linear",
    ]


def free_ports() -> tuple[int, int]:
    """Return two free TCP ports of loopback."""
    with socket.socket() as one, socket.socket() as other:
        one.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.1", 0))
        return one.getsockname()[1], other.getsockname()[1]


@dataclass
class GraphResults:
    """Results of a run of the graph."""

    bag: Path
    exit_codes: dict[str, int]
    run_id: str
    threads_before: set[str]
    threads_after: set[str]
    restarts: dict[str, int]
    ports: tuple[int, int]


async def run_session(bag: Path, ports: tuple[int, int]) -> GraphResults:
    """Stroke for a few seconds; then kill the triangulator in the middle of another stroke."""
    threads_before = {thread.name for thread in threading.enumerate()}
    plan = load_graph(DEMO_FILE, settings=on_ports(ports), record=bag)
    scene = plan.scene_message()
    assert scene is not None
    async with RunningGraph(plan) as graph:
        # Ten processes start at once, those that draw at the lowest priority.
        await graph.wait_ready(2 * DEADLINE_S)
        numbers: list[int] = []
        frames = make_subscriber(
            "frame", plan, graph.run, lambda frame, _: numbers.append(frame.number),
            on_problem=print,
        )  # fmt: skip
        frames.start()
        async with Driver(plan, graph.run) as driver:
            await driver.wait_ready()
            await driver.follow(stroke.stroke_path(scene, STROKE_S))
            path = stroke.stroke_path(scene, STROKE_S + 1.0)
            driver.move_finger(path)
            await driver.wait_for(
                in_the_middle(driver, path.label), "the middle of the second stroke", DEADLINE_S
            )
            graph.kill(KILLED, signal.SIGKILL)
            await driver.wait_for(
                lambda: graph.restarts[KILLED] == 1 and graph.is_ready(KILLED),
                "the triangulator to come back",
                DEADLINE_S,
            )
            await driver.wait_for(
                lambda: both_follow(driver), "both arms to follow the finger again", DEADLINE_S
            )
            # A busy machine draws few a second; the last ones may not reach the bag.
            await until(lambda: len(numbers) > MIN_FRAMES + 5, numbers)
        frames.close()
        restarts = dict(graph.restarts)
        run_id = graph.run.id
    return GraphResults(
        bag,
        graph.exit_codes,
        run_id,
        threads_before,
        {thread.name for thread in threading.enumerate()},
        restarts,
        ports,
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
def session(tmp_path_factory: pytest.TempPathFactory) -> GraphResults:
    bag = tmp_path_factory.mktemp("graph") / "session.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "WAIT_S", DEADLINE_S)
        return asyncio.run(run_session(bag, free_ports()))


@pytest.fixture(scope="module")
def recording(session: GraphResults) -> stroke.StrokeRecording:
    return stroke.read_recording(session.bag)


def test_every_logged_topic_that_has_a_rate_arrives_at_it(session: GraphResults) -> None:
    """Rates are computed over the first stroke, before the kill, from the publishers' stamps."""
    stamps: dict[str, list[int]] = {}
    windows = stroke.read_recording(session.bag).windows_ns
    begin_ns, end_ns = windows[stroke.stroke_label(STROKE_S)]
    for topic, _, header, _ in BagReader(session.bag):
        if begin_ns <= header.publish_ns <= end_ns:
            stamps.setdefault(topic, []).append(header.publish_ns)
    duration_s = (end_ns - begin_ns) * 1e-9
    written = load_graph(DEMO_FILE).writers
    expected = {
        name: one.rate_hz
        for name, one in TOPICS.items()
        if one.logged and one.rate_hz and name in written
    }
    assert {"fingertip", "sheet_target", "arm_left", "twin/arms", "status"} <= set(expected)
    for name, rate in expected.items():
        # A busy machine may be late: half the least expected rate says that the path works.
        assert len(stamps.get(name, ())) / duration_s >= 0.5 * rate[0], name


def test_nothing_was_lost_or_rejected(session: GraphResults) -> None:
    problems = Counter()
    writers = set()
    for _, message, _, _ in BagReader(session.bag, topics=["status"]):
        if isinstance(message, Status):
            writers.add(message.node)
            for port in message.inputs:
                # Only a reader of a `latest` topic may skip messages, and only older ones.
                skipped = 0 if find_topic(port.topic).delivery is Delivery.LATEST else port.gaps
                problems[message.node, port.topic] = skipped + port.rejected
    assert {"planner", "renderer", "fem_solver", "arm_left_bridge", "recorder"} <= writers
    assert not +problems


def test_sequences_in_the_bag_have_no_gaps(session: GraphResults) -> None:
    newest: dict[tuple[str, str, int], int] = {}
    for topic, _, header, _ in BagReader(session.bag):
        key = (topic, header.writer, header.epoch)
        if key in newest:
            assert header.sequence == newest[key] + 1, key
        newest[key] = header.sequence


def test_no_queue_builds_up_where_data_is_used(session: GraphResults) -> None:
    """Used data are nearly the newest that had been published, on any machine."""
    published: dict[str, list[tuple[int, int]]] = {"fingertip": [], "sheet_target": []}
    used: dict[str, list[tuple[int, int]]] = {"planner": [], "arms": [], "renderer": []}
    for topic, message, header, _ in BagReader(session.bag):
        match message:
            case Fingertip() | SheetTarget():
                published[topic].append((header.source_ns, header.publish_ns))
            case ArmState() if message.target_source_ns and message.command_sent_ns:
                used["arms"].append((message.target_source_ns, message.command_sent_ns))
            case Frame():
                begun_ns = message.drawn_ns - round(message.draw_s * 1e9)
                used["renderer"].append((header.source_ns, begun_ns))
            case _:
                pass
    used["planner"] = published["sheet_target"]
    for reader, topic in (
        ("planner", "fingertip"), ("arms", "sheet_target"), ("renderer", "sheet_target")
    ):  # fmt: skip
        sources_ns, publish_ns = np.array(sorted(published[topic])).T
        source_ns, at_ns = np.array(used[reader]).T
        newer = np.searchsorted(publish_ns, at_ns, "right") - np.searchsorted(
            sources_ns, source_ns, "right"
        )
        assert len(newer) > MIN_FRAMES, reader
        assert np.median(newer) <= 2, reader


def test_the_sheet_follows_the_finger(recording: stroke.StrokeRecording) -> None:
    errors = stroke.stroke_errors(recording, STROKE_S)
    assert errors.true_delta_d_m.mean() < 1.5e-3
    assert errors.true_delta_theta_rad.mean() < np.radians(2.0)


def test_the_arms_rest_safely_without_the_triangulator_and_follow_again(
    session: GraphResults,
) -> None:
    modes: dict[str, list[str]] = {"left": [], "right": []}
    for _, message, _, _ in BagReader(session.bag, topics=["arm_left", "arm_right"]):
        if isinstance(message, ArmState):
            modes[message.side].append(message.mode)
    assert session.restarts[KILLED] == 1
    for side, seen in modes.items():
        halted = [i for i, mode in enumerate(seen) if mode in ("hold", "stopping", "idle")]
        first, last = seen.index("follow"), len(seen) - 1 - seen[::-1].index("follow")
        assert any(first < i < last for i in halted), side


def test_frames_show_what_the_finger_did(session: GraphResults) -> None:
    numbers = [
        message.number
        for _, message, _, _ in BagReader(session.bag, topics=["frame"])
        if isinstance(message, Frame)
    ]
    assert len(numbers) > MIN_FRAMES
    assert numbers == sorted(set(numbers))


def test_every_node_ended_well_and_nothing_is_left(session: GraphResults) -> None:
    assert {name: code for name, code in session.exit_codes.items() if code != 0} == {}
    assert processes_of_run(session.run_id) == []
    assert session.threads_after <= session.threads_before
    listening = {
        connection.laddr.port
        for connection in psutil.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }
    assert not set(session.ports) & listening
