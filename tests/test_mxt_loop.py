"""Test planner, both bridges and the simulated arms with the real-time external control."""

from __future__ import annotations

import numpy as np
import pytest

from tests.test_arm_loop import (
    AT_FRONT,
    both_follow,
    play_finger,
    pointing,
    presented_errors,
    running_rig,
    stroke_path,
)
from tests.waiting import until

pytestmark = pytest.mark.alone


async def test_a_stroke_is_presented_over_the_real_time_control() -> None:
    async with running_rig({"protocol": "mxt"}, driver="mxt") as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        path = stroke_path(rig.scene.object.geometry.radius_m, 0.001, 2.0)
        begin_ns = rig.clock.now_ns()
        rig.samples.clear()
        await play_finger(rig, planner, path, 2.0)
        for server in nodes["twin"].servers.values():
            assert server.controller.error == ""
            assert server.controller.refused == 0
        distances, angles = presented_errors(rig, path, begin_ns)
        # Half of the time at least the machine did not pause; only the arms are checked.
        assert np.median(distances) < 0.001
        assert np.degrees(np.median(angles)) < 0.75
        stretches = np.array([sample.edge_distance_m for sample in rig.samples])
        assert np.ptp(stretches) < 0.002


async def test_an_error_of_one_controller_stops_both_arms_until_its_operator_came() -> None:
    twin = {"protocol": "mxt", "restart_after_s": 0.5}
    async with running_rig(twin, driver="mxt") as (rig, nodes):
        planner = nodes["planner"]
        await both_follow(rig, planner, AT_FRONT)
        async with pointing(rig, planner, AT_FRONT):
            nodes["twin"].servers["left"].controller._fail("drill")
            await until(lambda: rig.newest("left").mode == "disconnected")
            assert "no answer" in rig.newest("left").faults[0]
            await until(lambda: rig.newest("right").mode in ("stopping", "relax", "idle"))
            await until(lambda: {rig.newest(side).mode for side in ("left", "right")} == {"follow"})
            assert nodes["twin"].servers["left"].controller.error == ""
