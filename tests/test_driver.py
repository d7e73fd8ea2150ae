"""Follow finger paths by an experiment's driver that receives given messages."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.experiments import ExperimentError, OverloadedError
from flexsheet.launch.experiments import driver as driving
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.stroke import stroke_path
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import Run
from flexsheet.messages.base import Header, Message
from flexsheet.messages.types import FingerPath, HostStatus, TwinFinger
from flexsheet.nodes.twin.finger import FingerPathError
from tests.test_planner import SCENE
from tests.test_visible_lag import frame
from tests.waiting import DEADLINE_S

DEMO_FILE = Path(__file__).parents[1] / "launch" / "demo.yaml"


async def test_a_path_with_the_label_of_the_previous_path_is_awaited(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(load_graph(DEMO_FILE), Run("unused", Path("unused")))
    monkeypatch.setattr(driver, "move_finger", lambda path: None)
    path = stroke_path(SCENE, 10.0)

    async def receive(*, done: bool) -> None:
        finger = TwinFinger(
            path_label=path.label,
            path_done=done,
            path_time_s=0.0,
            position_world_m=np.zeros(3),
            velocity_world_m_per_s=np.zeros(3),
        )
        driver._make_handler("twin/finger")(finger, Header(1, 1, 1, "clock", "n", 1))
        for _ in range(3):
            await asyncio.sleep(0)

    await receive(done=True)
    follow = asyncio.create_task(driver.follow(path))
    await receive(done=True)
    assert not follow.done()
    await receive(done=False)
    assert not follow.done()
    await receive(done=True)
    assert follow.done()


async def test_a_driver_reads_given_topics_and_names_the_others(tmp_path: Path) -> None:
    plan = load_graph(DEMO_FILE)
    async with Driver(plan, Run("run", tmp_path), topics=["fingertip"]) as driver:
        assert driver.newest("fingertip") is None
        with pytest.raises(KeyError, match=r'topics=\["stereo"\]'):
            driver.newest("stereo")


@pytest.mark.parametrize(
    ("seconds", "to_m", "problem"),
    [(2.0, 20.0, "give positions in metres"), (0.01, 0.1, "increase the times")],
)
async def test_a_path_that_the_finger_cannot_follow_is_refused_at_once(
    seconds: float, to_m: float, problem: str
) -> None:
    driver = Driver(load_graph(DEMO_FILE), Run("unused", Path("unused")))
    path = FingerPath(
        label="wrong",
        times_s=np.array([0.0, seconds]),
        positions_world_m=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, to_m]]),
    )
    with pytest.raises(FingerPathError, match=problem):
        await driver.follow(path)


def make_driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    """Make a driver that receives only the messages that the test passes."""
    driver = Driver(load_graph(DEMO_FILE), Run("unused", Path("unused")))
    monkeypatch.setattr(driver, "show", lambda display: None)
    monkeypatch.setattr(driver, "_subscribe", lambda name: None)
    return driver


def receive(driver: Driver, topic: str, message: Message) -> None:
    driver._make_handler(topic)(message, Header(1, 1, 1, "clock", "n", 1))


async def test_the_wait_for_an_image_continues_while_frames_arrive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = make_driver(monkeypatch)
    capture = asyncio.create_task(driver.capture_image("pushed", "none"))
    await asyncio.sleep(0)
    (waiter,) = driver._waiters
    deadlines = [waiter.deadline.when()]
    for _ in range(1000):
        receive(driver, "frame", frame(0.0, 0.0, 0.0, 0.0))
        deadlines.append(waiter.deadline.when())
    receive(driver, "host", host())
    deadlines.append(waiter.deadline.when())
    capture.cancel()
    *postponed, last = deadlines
    assert all(before < after for before, after in pairwise(postponed))
    assert last == postponed[-1]


async def test_frames_without_an_image_end_the_wait_at_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(driving, "MAX_WAIT_S", 0.0)
    driver = make_driver(monkeypatch)
    capture = asyncio.create_task(driver.capture_image("pushed", "none"))
    await asyncio.sleep(0)
    receive(driver, "frame", frame(0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ExperimentError, match=r'image of "pushed"'):
        await asyncio.wait_for(capture, DEADLINE_S)


def host(load_ratio: float = 0.5) -> HostStatus:
    return HostStatus(
        host="main", run="1", plan_hash="", code="", python="3.11", uptime_s=1.0,
        disk_free_bytes=0, memory_free_bytes=0, nodes=(), missing_devices=(),
        load_ratio=load_ratio,
    )  # fmt: skip


@pytest.mark.parametrize(("busy", "kind"), [(True, OverloadedError), (False, ExperimentError)])
async def test_a_timeout_on_an_overloaded_computer_names_the_overload(
    monkeypatch: pytest.MonkeyPatch, busy: bool, kind: type[ExperimentError]
) -> None:
    driver = make_driver(monkeypatch)
    receive(driver, "host", host(load_ratio=1.6 if busy else 1.4))
    with pytest.raises(ExperimentError, match="for the image") as failed:
        await driver.wait_for(lambda: False, "the image", 0.0)
    assert type(failed.value) is kind
    assert ("1.6 runnable processes per core" in str(failed.value)) == busy
    assert ("end other programs" in str(failed.value)) == busy
