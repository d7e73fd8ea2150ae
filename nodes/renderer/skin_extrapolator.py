"""Extrapolate the solver's responses to the instant when the light leaves.

The solver responds to the finger at the exposure, or `prediction_horizon_s` later. The light leaves
some tens of milliseconds after that. A straight line through an older and the newest response
extrapolates the skin, vertex by vertex.
"""

from __future__ import annotations

from collections import deque

from flexsheet.messages.base import Header
from flexsheet.messages.types import SoftBody

HISTORY = 8
MIN_BASE_S, MAX_BASE_S = 0.02, 0.06
"""Time between the two responses. A shorter one amplifies noise, a longer one lags."""

MAX_EXTRAPOLATION_S = 0.06
"""Maximum extrapolation of the skin: a finger may reverse by then."""


class SkinExtrapolator:
    """Store the solver's last responses, and extrapolate them."""

    def __init__(self) -> None:
        self._history: deque[tuple[int, SoftBody]] = deque(maxlen=HISTORY)
        self._clock_id = ""

    def add(self, body: SoftBody, header: Header) -> None:
        """Add a response; another skin, method or clock clears the earlier ones."""
        last = self._history[-1][1] if self._history else None
        other = last is not None and (last.mesh_id, last.method) != (body.mesh_id, body.method)
        at_ns = header.source_ns + round(body.prediction_horizon_s * 1e9)
        if other or header.clock_id != self._clock_id or (last and at_ns <= self._history[-1][0]):
            self._history.clear()
        self._clock_id = header.clock_id
        self._history.append((at_ns, body))

    def extrapolate(self, at_ns: int, clock_id: str) -> tuple[SoftBody | None, int]:
        """Return the skin at `at_ns` of that clock, and the instant (ns) that it was extrapolated
        to.

        Returns the newest response unchanged where that has another clock, is later than `at_ns`,
        or is alone. Returns None and 0 before the first.
        """
        if not self._history:
            return None, 0
        newest_ns, newest = self._history[-1]
        ahead_s = min((at_ns - newest_ns) * 1e-9, MAX_EXTRAPOLATION_S)
        if clock_id != self._clock_id or ahead_s <= 0.0:
            return newest, newest_ns
        for before_ns, before in self._history:
            base_s = (newest_ns - before_ns) * 1e-9
            if MIN_BASE_S <= base_s <= MAX_BASE_S:
                moved = newest.displacement_world_m - before.displacement_world_m
                carried = newest.displacement_world_m + moved * moved.dtype.type(ahead_s / base_s)
                body = newest.model_copy(update={"displacement_world_m": carried})
                return body, newest_ns + round(ahead_s * 1e9)
        return newest, newest_ns
