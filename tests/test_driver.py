"""Follow finger paths by an experiment's driver that receives given messages."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.stroke import stroke_path
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import Run
from flexsheet.messages.base import Header
from flexsheet.messages.types import TwinFinger
from tests.test_planner import SCENE

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
