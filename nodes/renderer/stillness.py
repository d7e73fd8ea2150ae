"""Whether a frame would show what the last one did; while it would, few are enough."""

from __future__ import annotations

import numpy as np

from messages.types import ArmState, Fingertip, SoftBody

SEEN_M = 1e-4
"""A fifth of a pixel that is half a millimetre wide; it is shown a second late."""

REACH_M = 0.15
"""How far the sheet's points lie from the flange that holds its edge."""


def is_touched(fingertip: Fingertip | None, soft_body: SoftBody | None) -> bool:
    """Whether there is a finger, or a dent that it has left."""
    if fingertip is not None and fingertip.valid:
        return True
    return soft_body is not None and bool(soft_body.displacement_world_m.any())


def has_moved(before: ArmState | None, now: ArmState | None) -> bool:
    """Whether an arm holds its edge of the sheet elsewhere than before, servos' ripple apart."""
    if before is None or now is None:
        return before is not now
    change = np.abs(now.world_from_flange - before.world_from_flange)
    return bool(change[:3, 3].max() + REACH_M * change[:3, :3].max() > SEEN_M)
