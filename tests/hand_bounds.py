"""Compute the bounds of the sheet's offset for a camera rate of 60 Hz once per test run."""

from __future__ import annotations

from flexsheet.nodes.models.hand_loop import OffsetBoundsTable, compute_offset_bounds
from tests.shared import compute_once


def make_bounds_60_hz() -> OffsetBoundsTable:
    """Return the table of bounds with the maximum advance of the planner."""
    return compute_once(
        "hand-bounds-60-hz", lambda: compute_offset_bounds(1.0 / 60.0, advance_limit=0.5)
    )
