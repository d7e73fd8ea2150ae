"""Derive the maximum age of messages from the measured period of the camera."""

from __future__ import annotations

from collections import deque
from statistics import median

from flexsheet.messages.base import Header

HISTORY = 15
PERIODS = 4.0
"""The maximum age of a message, in camera periods. With this value, three successive messages can
be lost."""
MIN_AGE_S, MAX_AGE_S = 0.1, 0.5


class MaxAge:
    """The maximum age at which messages about poses, fingertips, eyes and soft bodies are used.

    seconds: current maximum age. It is either a fixed value, or `PERIODS` times the measured period
    of the camera. In the second case, it is limited to the range `MIN_AGE_S` to `MAX_AGE_S`.
    """

    def __init__(self, given_s: float | None = None) -> None:
        """Set a fixed maximum age (s). If `given_s` is None, derive it from the camera's period."""
        self.seconds = MIN_AGE_S if given_s is None else given_s
        self._is_given = given_s is not None
        self._last: Header | None = None
        self._periods_s: deque[float] = deque(maxlen=HISTORY)

    def add(self, header: Header) -> None:
        """Measure the camera's period from the header of a fingertip message.

        The header contains the exposure time, and a sequence number that reveals lost messages.
        """
        last, self._last = self._last, header
        if (
            self._is_given
            or last is None
            or (last.writer, last.epoch, last.clock_id)
            != (
                header.writer,
                header.epoch,
                header.clock_id,
            )
        ):
            return
        count, taken_s = header.sequence - last.sequence, (header.source_ns - last.source_ns) * 1e-9
        if count > 0 and taken_s > 0.0:
            self._periods_s.append(taken_s / count)
            self.seconds = min(max(PERIODS * median(self._periods_s), MIN_AGE_S), MAX_AGE_S)
