"""Simulate a force gauge between the finger and the simulated sheet.

The parameter `apparatus` contains the true parameters of the simulated hardware. The scene contains
the parameters that the other nodes assume.
"""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flexsheet.messages.apparatus import Apparatus, GaugeTruth
from flexsheet.messages.base import Header
from flexsheet.messages.notes import NodeNote
from flexsheet.messages.scene import Positive, Scene
from flexsheet.messages.types import Force, TwinArms, TwinFinger
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.node import Input, Node, Output, periodic
from flexsheet.nodes.twin.force_history import ForceHistory
from flexsheet.nodes.twin.membrane import make_edge_plane
from flexsheet.nodes.twin.sheet_pull import find_clamps, solve_sheet
from flexsheet.nodes.twin.truth import SimulatorParameters, apply_apparatus

CELLS = 12
"""The number of intervals between nodes along each side of the sheet. With 32 intervals, the force
differs by 1 %."""

STATED_STANDARD_DEVIATION_N = 0.02
"""The standard uncertainty of the force (N) according to the gauge's data sheet. The node publishes
this value with each force."""

GAUGE_STREAM = 3
"""The second element of the gauge's random seed. It makes the noise independent of other simulated
noise."""


class TwinGaugeParameters(SimulatorParameters):
    """The parameters of the simulated gauge."""

    seed: int = Field(default=2006, description="random seed of the gauge's noise")
    rate_hz: Positive = Field(
        default=4.0,
        description="rate of the readings, Hz; during a push, a reading takes about 0.1 s of "
        "processor time",
    )


class TrueSheetForce:
    """A model of the true normal force that the simulated sheet exerts on the finger."""

    def __init__(self, scene: Scene, apparatus: Apparatus | None) -> None:
        self._scene, self._apparatus = apply_apparatus(scene, apparatus), apparatus
        self._history = ForceHistory.of(apparatus)
        self._clamps = find_clamps(self._scene)

    def compute_n(self, time_s: float, tip: Floats, left: Floats, right: Floats) -> float:
        """Return the normal force (N) of the sheet on a fingertip.

        time_s: time, which must not decrease between calls.
        tip (3,): position of the fingertip, m.
        left, right (4, 4): poses of the arms' flanges.
        """
        edges = left @ self._clamps[0], right @ self._clamps[1]
        plane = make_edge_plane(*edges)
        normal, elastic_n = plane[:3, 2], 0.0
        if (tip - plane[:3, 3]) @ normal < 0.0:
            pressed = solve_sheet(self._scene, self._apparatus, edges, tip, cells=CELLS)
            elastic_n = max(float(pressed.finger_force_n @ normal), 0.0)
        return elastic_n if self._history is None else self._history.update(time_s, elastic_n)


class TwinGauge(Node):
    """A node that publishes the readings of a simulated force gauge at the fingertip."""

    parameters: TwinGaugeParameters
    scene: Input[Scene]
    twin__finger: Input[TwinFinger]
    twin__arms: Input[TwinArms]
    force: Output[Force]

    opens_devices: ClassVar[bool] = True

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it measures by its own clock; the bag has its readings as topic force"

    async def setup(self) -> None:
        truth = self.parameters.apparatus
        self._truth = GaugeTruth() if truth is None else truth.gauge
        self._random = np.random.default_rng((self.parameters.seed, GAUGE_STREAM))
        self._sheet: TrueSheetForce | None = None

    def on_scene(self, scene: Scene, header: Header) -> None:
        self._sheet = TrueSheetForce(scene, self.parameters.apparatus)

    @periodic("rate_hz")
    async def measure(self) -> None:
        finger, arms = self.twin__finger, self.twin__arms
        if self._sheet is None or finger.message is None or arms.message is None:
            self.note = f"{NodeNote.WAITING_FOR_SCENE.phrase}, the finger and the arms"
            return
        assert finger.header is not None
        taken_ns = finger.header.source_ns
        true_n = await asyncio.to_thread(
            self._sheet.compute_n,
            taken_ns * 1e-9,
            finger.message.position_world_m,
            arms.message.world_from_flange_left,
            arms.message.world_from_flange_right,
        )
        self.note = ""
        noise_n = self._truth.noise_n * float(self._random.standard_normal())
        # The reading lags behind the force, but its timestamp is the present time.
        self.force.publish(
            Force(
                source="gauge",
                axis="sheet_normal",
                valid=True,
                reason="ok",
                force_n=self._truth.gain_ratio * true_n + self._truth.offset_n + noise_n,
                standard_deviation_n=STATED_STANDARD_DEVIATION_N,
            ),
            source_ns=taken_ns + round(1e9 * self._truth.lag_s),
        )
