"""The twin's finger in the viewer's hand: it goes where the mouse means, at a finger's pace."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from messages.base import Message
from messages.types import FingerPath
from nodes.console.aim import Aim

Floats = NDArray[np.float64]

LABEL = "console"
NO_AIM = "the finger cannot be moved yet: the scene's object is still being read"


class Finger:
    """Leads the finger on a leash; each step is a path of one point that the twin reaches for."""

    def __init__(
        self, publish: Callable[[Message], None], *, speed_m_per_s: float, depth_m: float = 0.004
    ) -> None:
        self._publish, self._speed_m_per_s = publish, speed_m_per_s
        self._aim: Aim | None = None
        self._target: Floats | None = None
        self._led = np.array([0.0, 0.0, 0.08])
        self._meant: Callable[[Aim], Floats] | None = None
        self.depth_m = depth_m

    def use(self, aim: Aim | None) -> None:
        """Point at this object from now on; None while there is none."""
        self._aim, self._target, self._meant = aim, None, None

    @property
    def target(self) -> Floats | None:
        """Where (3,) it is to go; None: it is there."""
        return self._target

    def touch(self, origin: Floats, direction: Floats) -> None:
        """Go where a ray from the viewer's eye meets the object, and as deep as is set."""
        self._mean(lambda aim: aim.under_ray(origin, direction, self.depth_m))

    def place(self, x_m: float, y_m: float) -> None:
        """Go to what is seen straight from the front at (x, y), and as deep as is set."""
        self._mean(lambda aim: aim.place(x_m, y_m, self.depth_m))

    def push(self, depth_m: float) -> None:
        """Be so deep in the object from now on; the place stays.  ValueError for no depth."""
        if not (np.isfinite(depth_m) and depth_m >= 0.0):
            raise ValueError(f"depth: {depth_m} m is no depth of a push")
        self.depth_m = depth_m
        if self._meant is not None:
            self._mean(self._meant)

    def lift(self) -> None:
        """Leave the object by the nearest way."""
        led = self._led
        self._mean(lambda aim: aim.lifted(led))
        self._meant = None

    def _mean(self, meant: Callable[[Aim], Floats]) -> None:
        if self._aim is None:
            raise ValueError(NO_AIM)
        self._target, self._meant = meant(self._aim), meant

    def advance(self, duration_s: float, seen: Floats | None) -> None:
        """Take the next step, if there is one.  seen: where the finger is now, if that is known."""
        if self._target is None or self._aim is None:
            if seen is not None:
                self._led = seen
            return
        way_m = self._speed_m_per_s * duration_s
        self._led = self._aim.step(self._led, self._target, depth_m=self.depth_m, way_m=way_m)
        if self._led is self._target:
            self._target = None
        self._publish(
            FingerPath(
                label=LABEL,
                times_s=np.zeros(1),
                positions_world_m=self._led[None],
                wander_m=0.0,
                tremor_m=0.0,
            )
        )
