"""Whether a frame would show what the last one did; while it would, few are enough."""

from __future__ import annotations

import numpy as np

from messages.types import ArmState, Fingertip, SoftBody

SEEN_M = 2e-5
"""A twentieth of a pixel that is half a millimetre wide: an edge that moves less is not seen."""


def is_touched(fingertip: Fingertip | None, soft_body: SoftBody | None) -> bool:
    """Whether there is a finger, or a dent that it has left."""
    if fingertip is not None and fingertip.valid:
        return True
    return soft_body is not None and bool(soft_body.displacement_world_m.any())


def has_moved(before: ArmState | None, now: ArmState | None) -> bool:
    """Whether an arm's flange is elsewhere than before; turned by a radian, it is by a metre."""
    if before is None or now is None:
        return before is not now
    return bool(np.abs(now.world_from_flange - before.world_from_flange).max() > SEEN_M)
