"""Extrapolate the responses of the soft-body solver to the display time of a frame.

A response contains the displacement of the object's surface at one moment: the camera exposure plus
`prediction_horizon_s`. The frame is displayed tens of milliseconds after this moment. Each vertex
is extrapolated linearly from an older and the newest response.
"""

from __future__ import annotations

from collections import deque

from flexsheet.messages.base import Header
from flexsheet.messages.types import SoftBody

HISTORY = 8
MIN_BASE_S, MAX_BASE_S = 0.02, 0.06
"""The minimum and maximum time, in seconds, between the two responses that are extrapolated. A
shorter time amplifies noise, and a longer time causes lag."""

MAX_PERIOD_S = 0.12
"""The maximum time (s) between two successive responses that are extrapolated."""

MAX_EXTRAPOLATION_S = 0.06
"""The maximum time over which the displacement is extrapolated, in seconds."""


class SkinExtrapolator:
    """A linear extrapolator of the recent responses of the soft-body solver."""

    def __init__(self) -> None:
        self._history: deque[tuple[int, SoftBody]] = deque(maxlen=HISTORY)
        self._clock_id = ""

    def add(self, body: SoftBody, header: Header) -> None:
        """Store a response of the soft-body solver.

        Earlier responses are deleted if they belong to another mesh, method or clock. They are also
        deleted if the new response is not later than the last stored response.
        """
        last = self._history[-1][1] if self._history else None
        other = last is not None and (last.mesh_id, last.method) != (body.mesh_id, body.method)
        at_ns = header.source_ns + round(body.prediction_horizon_s * 1e9)
        if other or header.clock_id != self._clock_id or (last and at_ns <= self._history[-1][0]):
            self._history.clear()
        self._clock_id = header.clock_id
        self._history.append((at_ns, body))

    def extrapolate(self, at_ns: int, clock_id: str) -> tuple[SoftBody | None, int]:
        """Return the response extrapolated to `at_ns`, and the time (ns) for which it is valid.

        clock_id: clock of `at_ns`. The newest response is returned unchanged if it is from another
        clock, if it is later than `at_ns`, or if no earlier response is suitable. Before the first
        response, return None and 0.
        """
        if not self._history:
            return None, 0
        newest_ns, newest = self._history[-1]
        ahead_s = min((at_ns - newest_ns) * 1e-9, MAX_EXTRAPOLATION_S)
        if clock_id != self._clock_id or ahead_s <= 0.0:
            return newest, newest_ns
        found = self._before(newest_ns)
        if found is None:
            return newest, newest_ns
        before, base_s = found
        moved = newest.displacement_world_m - before.displacement_world_m
        predicted = newest.displacement_world_m + moved * moved.dtype.type(ahead_s / base_s)
        body = newest.model_copy(update={"displacement_world_m": predicted})
        return body, newest_ns + round(ahead_s * 1e9)

    def _before(self, newest_ns: int) -> tuple[SoftBody, float] | None:
        """Return an earlier response of the soft-body solver, and its age (s).

        The response is used for the extrapolation. Its age is the time until the newest response at
        `newest_ns`. Returns None if no response has a suitable age.
        """
        older = [((newest_ns - at_ns) * 1e-9, body) for at_ns, body in list(self._history)[:-1]]
        for base_s, body in older:
            if MIN_BASE_S <= base_s <= MAX_BASE_S:
                return body, base_s
        if older and MAX_BASE_S < older[-1][0] <= MAX_PERIOD_S:
            return older[-1][1], older[-1][0]
        return None
