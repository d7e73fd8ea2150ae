"""Measure the servo lags of the arms while they follow a stroke of the finger.

Each arm bridge measures the lag of its arm behind the commands, from commanded and measured joints.
It starts with the lag in the launch file, and its self-check reports a deviation from that value.
So the measured lag is written into the launch file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flexsheet.launch.experiments.simulated_time import follow_in_simulated_time
from flexsheet.launch.experiments.stroke import stroke_path
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, Side

SIDES: tuple[Side, Side] = ("left", "right")
STROKE_S = 5.0
"""Duration of the simulated stroke."""


class DelaysError(FlexsheetError, ValueError):
    """Raised for a recording from which the lag of an arm cannot be read."""

    code = "delays-calibration"
    remedy = "Record a stroke in which both arms follow the finger for several seconds."


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """Servo lag of an arm, including the latency of its commands, with standard deviation, s."""

    lag_s: float
    uncertainty_s: float


def read_measured_lags(bag: Path) -> dict[Side, MeasuredLag]:
    """Return the newest lags that the bridges measured in a bag.

    Raises DelaysError if there are none.
    """
    found: dict[Side, MeasuredLag] = {}
    for _, message, _, _ in BagReader(bag, topics=["arm_left", "arm_right"]):
        if not isinstance(message, ArmState) or message.servo_lag_s is None:
            continue
        if message.servo_lag_uncertainty_s is not None:
            found[message.side] = MeasuredLag(message.servo_lag_s, message.servo_lag_uncertainty_s)
    for side in SIDES:
        if side not in found:
            raise DelaysError(f"{bag}: the {side} arm's bridge measured no servo lag")
    return found


def measure_lags_in_simulation(scene: Scene, apparatus: Apparatus) -> dict[Side, MeasuredLag]:
    """Return the lags that the bridges of simulated arms measure in a stroke."""
    found = follow_in_simulated_time(scene, stroke_path(scene, STROKE_S), apparatus)
    lags_ms, uncertainties_ms = found["servo_lag_ms"], found["servo_lag_uncertainty_ms"]
    lags = {}
    for side, lag_ms, uncertainty_ms in zip(SIDES, lags_ms, uncertainties_ms, strict=True):
        if uncertainty_ms is None:
            raise DelaysError(f"simulated stroke: the {side} arm's lag could not be measured")
        lags[side] = MeasuredLag(1e-3 * lag_ms, 1e-3 * uncertainty_ms)
    return lags
