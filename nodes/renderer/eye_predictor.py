"""Predict the positions of the user's tracked eyes at the display time of a frame."""

from __future__ import annotations

from collections import deque

import numpy as np

from flexsheet.messages.base import Header
from flexsheet.messages.types import Eye
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.node import Input
from flexsheet.nodes.renderer.max_age import MaxAge

WINDOW_S = 0.15
"""The duration, in seconds, over which the velocity of the eyes is measured. In this time, a head
tracker sends a few positions."""

MIN_MESSAGES = 3
"""The minimum number of positions from which a velocity is computed. With fewer positions, the
newest position is used."""

MAX_SPEED_M_PER_S = 1.0
"""The maximum plausible speed of a head. Larger velocities are ignored."""

MAX_AHEAD_S = 0.1
"""The maximum time (s) over which a position is extrapolated."""

MAX_SHIFT_M = 0.03
"""The maximum distance (m) by which a position is extrapolated."""


class EyePredictor:
    """A predictor of the eyes' positions, which fits a line to the recent positions.

    max_age: maximum age of a message. If the last message is older, the predictor returns None.
    """

    def __init__(self, max_age: MaxAge) -> None:
        self._max_age = max_age
        self._positions: deque[tuple[int, Floats]] = deque()
        self._clock: tuple[str, int] | None = None

    def add(self, eye: Eye, header: Header) -> None:
        """Store the eyes' position from a valid message.

        Delete the earlier positions if the message is invalid, out of order or from another clock,
        or if it arrives after a long gap.
        """
        clock, at_ns = (header.clock_id, header.epoch), header.source_ns
        known = self._positions
        if not eye.valid:
            known.clear()
            return
        if known and (
            clock != self._clock or not 0 < at_ns - known[-1][0] < 1e9 * self._max_age.seconds
        ):
            known.clear()
        self._clock = clock
        known.append((at_ns, np.asarray(eye.centre_world_m, dtype=np.float64)))
        while at_ns - known[0][0] > 1e9 * WINDOW_S:
            known.popleft()

    def predict(self, tracked: Input[Eye], horizon_s: float) -> Eye | None:
        """Return the eyes as predicted for a time `horizon_s` after the current time.

        tracked: input port with the newest message about the eyes.

        Returns None if there is no message, or if the newest message is too old. An invalid message
        is returned unchanged.
        """
        eye, age_s = tracked.message, tracked.age_s()
        if eye is None or age_s > self._max_age.seconds:
            return None
        ahead_s = min(max(age_s + horizon_s, 0.0), MAX_AHEAD_S)
        shift = ahead_s * self._velocity()
        length = float(np.linalg.norm(shift))
        if not eye.valid or length == 0.0:
            return eye
        shift *= min(1.0, MAX_SHIFT_M / length)
        return eye.model_copy(update={"centre_world_m": eye.centre_world_m + shift})

    def _velocity(self) -> Floats:
        """Return the velocity (3,), in m/s, of the eyes; zero if it is unknown or implausible."""
        if len(self._positions) < MIN_MESSAGES:
            return np.zeros(3)
        newest_ns = self._positions[-1][0]
        times = np.array([(at_ns - newest_ns) * 1e-9 for at_ns, _ in self._positions])
        positions = np.array([position for _, position in self._positions])
        times -= times.mean()
        velocity = times @ (positions - positions.mean(axis=0)) / float(times @ times)
        plausible = float(np.linalg.norm(velocity)) <= MAX_SPEED_M_PER_S
        return np.asarray(velocity) if plausible else np.zeros(3)
