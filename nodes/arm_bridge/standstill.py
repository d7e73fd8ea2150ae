"""Detect from measured joint angles whether an arm is at rest."""

from __future__ import annotations

import numpy as np

from flexsheet.nodes.arm_bridge.link import Freshness
from flexsheet.nodes.arrays import Floats

STANDSTILL_COUNT = 5
"""The number of consecutive unchanged measurements after which an arm counts as being at rest if it
has reached its last command."""

SETTLED_COUNT = 100
"""The number of consecutive unchanged measurements after which an arm counts as being at rest if it
has not reached its last command. The number is sufficient for measurements that lag by 0.7 s."""

STANDSTILL_RAD = 1e-3
"""The maximum difference (rad) between measurements that count as unchanged. It is 200 times the
encoder noise."""

MAX_RESTART_SHIFT_M = 0.005
"""The maximum distance (m) between the commanded and the measured edge at which a motion may
restart. An edge that moves at 0.25 m/s with a servo lag of 20 ms lags by this distance."""

JUMP_MARGIN_RAD = 0.002
"""The tolerance (rad) of the plausible joint motion between two measurements."""

JUMP_SPEED_RAD_PER_S = 0.5
"""The maximum plausible joint speed of an arm that is not commanded to move. The operator may move
the arm with the teach pendant."""

OVERSPEED = 1.5
"""The maximum ratio of an arm's speed to its commanded speed while the arm catches up with its
commands."""

MEMORY_S = 0.1
"""The time constant with which the influence of earlier commanded speeds and joint angles
decays."""

ON_PATH_RAD = 0.005
"""The distance from recently commanded joint angles within which any measurement is plausible."""


class StandstillMonitor:
    """A monitor that counts unchanged measurements since the last motion.

    has_jumped: whether measurements have changed faster than the arm can move.
    is_alive: whether the measurements contain encoder noise. Measurements without any noise
        indicate that the controller repeats old joint angles.
    """

    def __init__(self) -> None:
        self.has_jumped = False
        self.is_alive = False
        self._count = 0
        self._anchor_rad = self._last_rad = np.full(6, np.nan)
        self._elapsed_s, self._speeds_rad_per_s = 0.0, np.zeros(6)
        self._lowest_rad, self._highest_rad = np.full(6, np.inf), np.full(6, -np.inf)

    def is_standing(self, *, at_command: bool) -> bool:
        """Return whether the arm is at rest.

        at_command: whether the measured joint angles are near the last command. If they are not,
            more unchanged measurements are required, because the measurements can lag.
        """
        return self._count >= (STANDSTILL_COUNT if at_command else SETTLED_COUNT)

    def restart(self) -> None:
        """Restart the count of unchanged measurements."""
        self._count, self.is_alive = 0, False

    def forget(self) -> None:
        """Discard the count of unchanged measurements and the last measured joint angles."""
        self.restart()
        self._last_rad = np.full(6, np.nan)

    def on_command(self, joints_rad: Floats, velocity_rad_per_s: Floats, step_s: float) -> None:
        """Record the joint angles (6,) and velocities (6,) that were sent as the latest command.

        step_s: time during which the arm executes the command.
        """
        self._elapsed_s += step_s
        speeds = np.abs(velocity_rad_per_s)
        decay = max(0.0, 1.0 - step_s / MEMORY_S)
        self._speeds_rad_per_s = np.maximum(speeds, self._speeds_rad_per_s * decay)
        if np.isfinite(self._lowest_rad[0]):
            lower = joints_rad + decay * (self._lowest_rad - joints_rad)
            upper = joints_rad + decay * (self._highest_rad - joints_rad)
            self._lowest_rad = np.minimum(lower, joints_rad)
            self._highest_rad = np.maximum(upper, joints_rad)
        else:
            self._lowest_rad = self._highest_rad = joints_rad
        if speeds.any():
            self.restart()

    def on_measurement(self, joints_rad: Floats, freshness: Freshness) -> None:
        """Compare measured joint angles (6,) rad with earlier ones to detect rest and jumps."""
        if freshness == Freshness.REPEATED:
            return
        if not freshness.is_usable:
            self.restart()
            return
        if freshness == Freshness.FIRST:
            self.forget()
        # After `forget`, comparisons with NaN are false: there is neither a jump nor a standstill.
        change = np.abs(joints_rad - self._last_rad)
        speeds = JUMP_SPEED_RAD_PER_S + OVERSPEED * self._speeds_rad_per_s
        off_path = (joints_rad < self._lowest_rad - ON_PATH_RAD) | (
            joints_rad > self._highest_rad + ON_PATH_RAD
        )
        if (off_path & (change > JUMP_MARGIN_RAD + speeds * self._elapsed_s)).any():
            self.has_jumped = True
        if self._count and float(np.abs(joints_rad - self._anchor_rad).max()) <= STANDSTILL_RAD:
            self._count += 1
            self.is_alive = self.is_alive or bool(change.any())
        else:
            self._anchor_rad, self._count, self.is_alive = joints_rad, 1, False
        self._last_rad, self._elapsed_s = joints_rad, 0.0
