"""Which fingertips come in the order of time, and when the clock behind them has stepped."""

from __future__ import annotations

STEPPED_AFTER = 3
"""Fingertips in a row that rise in time, but all lie before what was planned for already."""

LEAST_STEP_NS = 1_000_000
"""No camera is so fast that a shorter step is one."""


class Order:
    """Lets fingertips through in the order of their exposures.

    One that comes late is left out: the sheet has been planned past it.  Several in a row mean that
    the clock has stepped back, and time begins anew with them.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._late_ns: list[int] = []

    def step_s(self, source_ns: int, first_step_s: float) -> float | None:
        """Time since the last fingertip that was let through; None: this one is left out."""
        last_ns = self._last_ns
        if last_ns is not None and source_ns < last_ns + LEAST_STEP_NS:
            rising = not self._late_ns or source_ns > self._late_ns[-1]
            self._late_ns = [*self._late_ns, source_ns] if rising else [source_ns]
            if len(self._late_ns) < STEPPED_AFTER:
                return None
            last_ns = None
        self._last_ns, self._late_ns = source_ns, []
        return first_step_s if last_ns is None else (source_ns - last_ns) * 1e-9
