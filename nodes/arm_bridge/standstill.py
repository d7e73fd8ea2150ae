"""Whether an arm stands still, by measurements that are fresh and change as an arm can move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arm_bridge.link import Freshness

Floats = NDArray[np.float64]

STANDSTILL_COUNT = 5
"""So many fresh measurements in a row that do not change are a standstill."""

SETTLED_COUNT = 100
"""So many are needed for an arm that does not stand where it was sent to: a measurement that lags
by 0.7 s has arrived there by then."""

STANDSTILL_RAD = 1e-3
"""Measurements that differ by less do not change: encoder noise is 200 times smaller."""

JOINT_LEVER_M = np.array([0.6, 0.6, 0.4, 0.2, 0.2, 0.15])
"""Upper bound of the distance from each joint's axis to the edge that the arm holds."""

MAX_RESTART_SHIFT_M = 0.005
"""How far the edge may stand off its command when the command starts again from the measurement.
Joint servos with a lag of 15 ms or more cover 5 mm with less than 0.25 m/s."""

JUMP_MARGIN_RAD = 0.002
JUMP_SPEED_RAD_PER_S = 0.5
"""Measurements may change by the margin, and by this speed also while no command moves the arm: it
may be moved with its teach pendant."""

OVERSPEED = 1.5
"""An arm may move faster than its commands by this factor while it catches up."""

MEMORY_S = 0.1
"""Time constant with which recent commanded speeds and joints are forgotten."""

ON_PATH_RAD = 0.005
"""A measurement within so much of the recently commanded joints is where the arm may well be, even
if it was not measured for some time."""


def edge_shift_m(joints_rad: Floats, other_rad: Floats) -> float:
    """Upper bound of the distance between an edge held with these joints (6,) and with others."""
    return float(JOINT_LEVER_M @ np.abs(joints_rad - other_rad))


class StandstillMonitor:
    """Counts fresh, unchanged measurements since the last command that moved the arm.

    is_alive: some of them differ in the last digits, as encoders do.  A reading that is frozen
    repeats itself exactly.  has_jumped: the reading has changed faster than the arm can have moved.
    """

    def __init__(self) -> None:
        self.has_jumped = False
        self._alive = False
        self._count = 0
        self._anchor_rad = self._last_rad = np.full(6, np.nan)
        self._elapsed_s, self._speeds_rad_per_s = 0.0, np.zeros(6)
        self._lowest_rad, self._highest_rad = np.full(6, np.inf), np.full(6, -np.inf)

    def is_standing(self, *, where_sent: bool) -> bool:
        """Whether the arm stands still; where_sent: where its last command has sent it to."""
        return self._count >= (STANDSTILL_COUNT if where_sent else SETTLED_COUNT)

    @property
    def is_alive(self) -> bool:
        return self._alive

    def restart(self) -> None:
        """Count again from zero."""
        self._count, self._alive = 0, False

    def forget(self) -> None:
        """Count again, and expect the arm anywhere: it was not measured for some time."""
        self.restart()
        self._last_rad = np.full(6, np.nan)

    def on_command(self, joints_rad: Floats, velocity_rad_per_s: Floats, step_s: float) -> None:
        """Take note of a command to joints (6,) that moves them so fast for `step_s`."""
        self._elapsed_s += step_s
        speeds = np.abs(velocity_rad_per_s)
        kept = max(0.0, 1.0 - step_s / MEMORY_S)
        self._speeds_rad_per_s = np.maximum(speeds, self._speeds_rad_per_s * kept)
        if np.isfinite(self._lowest_rad[0]):
            lower = joints_rad + kept * (self._lowest_rad - joints_rad)
            upper = joints_rad + kept * (self._highest_rad - joints_rad)
            self._lowest_rad = np.minimum(lower, joints_rad)
            self._highest_rad = np.maximum(upper, joints_rad)
        else:
            self._lowest_rad = self._highest_rad = joints_rad
        if speeds.any():
            self.restart()

    def on_measurement(self, joints_rad: Floats, freshness: Freshness) -> None:
        """Take note of measured joints (6,)."""
        if freshness == Freshness.REPEATED:
            return
        if not freshness.is_believed:
            self.restart()
            return
        if freshness == Freshness.FIRST:
            self.forget()
        # Comparisons with NaN are false: after `forget` nothing has jumped and nothing stands.
        change = np.abs(joints_rad - self._last_rad)
        speeds = JUMP_SPEED_RAD_PER_S + OVERSPEED * self._speeds_rad_per_s
        off_path = (joints_rad < self._lowest_rad - ON_PATH_RAD) | (
            joints_rad > self._highest_rad + ON_PATH_RAD
        )
        if (off_path & (change > JUMP_MARGIN_RAD + speeds * self._elapsed_s)).any():
            self.has_jumped = True
        if self._count and float(np.abs(joints_rad - self._anchor_rad).max()) <= STANDSTILL_RAD:
            self._count += 1
            self._alive = self._alive or bool(change.any())
        else:
            self._anchor_rad, self._count, self._alive = joints_rad, 1, False
        self._last_rad, self._elapsed_s = joints_rad, 0.0
