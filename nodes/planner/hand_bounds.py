"""Compute and cache bounds on the slope d(sheet offset) / d(finger depth).

Within these bounds, the closed control loop of sheet and hand is stable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from flexsheet.nodes.cache import Specification, cached, encode_fields
from flexsheet.nodes.models import hand_loop
from flexsheet.nodes.models.hand_loop import OffsetBoundsTable, compute_offset_bounds
from flexsheet.nodes.planner.compliance import MAX_ADVANCE_PER_DEPTH

VERSION = 2
"""The version of the computation. Cached bounds of another version are computed again."""


def bounds_cache(rate_hz: float) -> Specification[OffsetBoundsTable]:
    """Define the cache file that contains the stability bounds of the sheet's offset.

    The bounds ensure that the control loop of the sheet and the user's hand is stable. They depend
    on the camera's frame rate.
    """
    depends_on = {
        "version": VERSION,
        "rate_hz": rate_hz,
        "advance_limit": MAX_ADVANCE_PER_DEPTH,
        "delays_s": hand_loop.DELAYS_S,
        "bandwidths_rad_per_s": hand_loop.BANDWIDTHS_RAD_PER_S,
        "filter_damping_ratio": hand_loop.FILTER_DAMPING_RATIO,
        "stiffnesses_n_per_m": hand_loop.SHEET_STIFFNESSES_N_PER_M,
        "margins": [hand_loop.GAIN_MARGIN, hand_loop.DELAY_MARGIN_S, hand_loop.MIN_DECAY_PER_S],
        "hands": [asdict(hand) for hand in hand_loop.LIMITING_HANDS],
    }
    return Specification(
        "hand-bounds", depends_on, encode_fields, lambda content: OffsetBoundsTable(**content)
    )


def load_or_compute_bounds(
    rate_hz: float, cache_dir: Path | None, progress: Callable[[str], None] = lambda text: None
) -> OffsetBoundsTable:
    """Return the stability bounds of the sheet's offset for a camera's frame rate.

    The bounds ensure that the control loop of the sheet and the user's hand is stable. They are
    loaded from the cache if possible.

    progress: function that receives a text before the computation.
    """

    def compute() -> OffsetBoundsTable:
        progress(
            "computing the stability bounds of the control loop with the user's hand (only once)"
        )
        return compute_offset_bounds(1.0 / rate_hz, advance_limit=MAX_ADVANCE_PER_DEPTH)

    return cached(bounds_cache(rate_hz), cache_dir, compute)
