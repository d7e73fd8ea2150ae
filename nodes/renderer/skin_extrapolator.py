"""The dented object when the light leaves: the solver's answers, carried on as they have moved.

The solver answers to where the finger was at the exposure (or its own `lead_s` later); the light
leaves some tens of milliseconds after that.  A straight line through an older and the newest answer
carries the skin on, vertex by vertex.
"""

from __future__ import annotations

from collections import deque

from messages.base import Header
from messages.types import SoftBody

HISTORY = 8
MIN_BASE_S, MAX_BASE_S = 0.02, 0.06
"""Between the two answers: with less, noise is carried on enlarged; with more, the past counts."""

MAX_EXTRAPOLATION_S = 0.06
"""The skin is carried on no farther: a finger may turn by then."""


class SkinExtrapolator:
    """Keeps the solver's last answers."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, SoftBody]] = deque(maxlen=HISTORY)
        self._clock_id = ""

    def add(self, body: SoftBody, header: Header) -> None:
        """A new answer; those of another skin, method or clock are forgotten."""
        last = self._kept[-1][1] if self._kept else None
        other = last is not None and (last.mesh_id, last.method) != (body.mesh_id, body.method)
        at_ns = header.source_ns + round(body.prediction_horizon_s * 1e9)
        if other or header.clock_id != self._clock_id or (last and at_ns <= self._kept[-1][0]):
            self._kept.clear()
        self._clock_id = header.clock_id
        self._kept.append((at_ns, body))

    def extrapolate(self, at_ns: int, clock_id: str) -> tuple[SoftBody | None, int]:
        """The skin at `at_ns` of that clock, and the instant (ns) that it was carried on to.

        The newest answer as it is where that is of another clock, later than `at_ns`, or alone;
        None and 0 before the first.
        """
        if not self._kept:
            return None, 0
        newest_ns, newest = self._kept[-1]
        ahead_s = min((at_ns - newest_ns) * 1e-9, MAX_EXTRAPOLATION_S)
        if clock_id != self._clock_id or ahead_s <= 0.0:
            return newest, newest_ns
        for before_ns, before in self._kept:
            base_s = (newest_ns - before_ns) * 1e-9
            if MIN_BASE_S <= base_s <= MAX_BASE_S:
                moved = newest.displacement_world_m - before.displacement_world_m
                carried = newest.displacement_world_m + moved * moved.dtype.type(ahead_s / base_s)
                body = newest.model_copy(update={"displacement_world_m": carried})
                return body, newest_ns + round(ahead_s * 1e9)
        return newest, newest_ns
