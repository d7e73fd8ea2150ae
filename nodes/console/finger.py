"""The simulated finger in the viewer's hand: what the viewer wants, and the steps towards it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.base import Message
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.console.aim import HOVER_M, Aim

Floats = NDArray[np.float64]

LABEL = "console"
FRONT_M = 1.5
"""How far before the screen a ray begins that meets the object straight from the front."""


@dataclass(frozen=True, slots=True)
class Ray:
    """A ray of the world frame; its first point on the object is a position on the surface.

    origin_m (3,), direction (3,), not necessarily of unit length.  ValueError for numbers that are
    not finite, and for a ray without direction.
    """

    origin_m: tuple[float, float, float]
    direction: tuple[float, float, float]

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.direction))
        if not (np.isfinite(self.origin_m).all() and np.isfinite(length) and length > 0.0):
            raise ValueError(f"a ray needs a direction, not {self.direction} from {self.origin_m}")

    @property
    def is_from_front(self) -> bool:
        """Whether it goes straight away from the user."""
        return self.direction[:2] == (0.0, 0.0) and self.direction[2] < 0.0

    @classmethod
    def from_front(cls, x_m: float, y_m: float) -> Ray:
        """Return the ray that meets what is seen straight from the front at (x, y)."""
        return cls((x_m, y_m, FRONT_M), (0.0, 0.0, -1.0))


@dataclass(frozen=True, slots=True)
class FingerIntent:
    """What the viewer wants of the finger.

    position: on the surface of whatever object there is.  depth_m: below it, while not lifted.
    lifted: the finger waits above the position.  ValueError for a depth that is none.
    """

    position: Ray = field(default_factory=lambda: Ray.from_front(0.0, 0.0))
    depth_m: float = 0.004
    lifted: bool = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.depth_m) and self.depth_m >= 0.0):
            raise ValueError(f"depth: {self.depth_m} m is no depth of a push")

    def target_m(self, aim: Aim) -> Floats:
        """Return where the fingertip (3,) has to be on an object."""
        origin, direction = np.array(self.position.origin_m), np.array(self.position.direction)
        return aim.under_ray(origin, direction, -HOVER_M if self.lifted else self.depth_m)


class Finger:
    """Follows the viewer's intent at a limited speed.

    Each step is a path of one point that the simulated finger moves to.  Nothing is sent before the
    first command: until then the finger belongs to whoever else moves it.
    """

    def __init__(self, publish: Callable[[Message], None], *, speed_m_per_s: float) -> None:
        self._publish, self._speed_m_per_s = publish, speed_m_per_s
        self._aim: Aim | None = None
        self._target: Floats | None = None
        self._arrived = False
        self._led = np.array([0.0, 0.0, 0.08])
        self._position_m = (0.0, 0.0)
        self._commanded = False
        self.intent = FingerIntent()

    def use(self, aim: Aim | None) -> None:
        """Apply the intent to another object; None: its shape is not known yet."""
        self._aim = aim
        self._update_target()

    def restore(self, intent: FingerIntent) -> None:
        """Go on with what was wanted before the console was started again."""
        self.intent, self._commanded = intent, True
        self._update_target()

    @property
    def commanded(self) -> bool:
        """Whether a viewer has moved the finger."""
        return self._commanded

    @property
    def position_m(self) -> tuple[float, float]:
        """Where on the screen (x, y) the finger is wanted, as seen straight from the front."""
        return self._position_m

    def touch(self, origin: Floats, direction: Floats) -> None:
        """Push where a ray from the viewer's eye meets the object."""
        position = Ray(tuple(map(float, origin)), tuple(map(float, direction)))  # type: ignore[arg-type]  # three each
        self._want(position=position, lifted=False)

    def place(self, x_m: float, y_m: float) -> None:
        """Move to what is seen straight from the front at (x, y), lifted or pushing as before."""
        self._want(position=Ray.from_front(x_m, y_m))

    def push(self, depth_m: float) -> None:
        """Push as deep as this from now on, where the finger is wanted."""
        self._want(depth_m=depth_m, lifted=False)

    def lift(self) -> None:
        """Wait above the position."""
        self._want(lifted=True)

    def lift_or_lower(self) -> None:
        """Lift the finger, or put a lifted one down again."""
        self._want(lifted=not self.intent.lifted)

    def _want(self, **changes: object) -> None:
        self.intent = replace(self.intent, **changes)  # type: ignore[arg-type]  # fields of it
        self._commanded = True
        self._update_target()

    def _update_target(self) -> None:
        """Derive the target from the intent and the object, as far as both are known."""
        self._target, self._arrived = None, False
        position = self.intent.position
        if position.is_from_front:
            self._position_m = position.origin_m[:2]
        if self._aim is not None and self._commanded:
            self._target = target = self.intent.target_m(self._aim)
            if not position.is_from_front:
                self._position_m = float(target[0]), float(target[1])

    def advance(self, duration_s: float, seen: Floats | None) -> bool:
        """Take the next step, if there is one; return whether it was the last.

        seen: where the finger is now, if that is known.
        """
        if self._target is None or self._aim is None or self._arrived:
            if seen is not None:
                self._led = seen
            return False
        way_m = self._speed_m_per_s * duration_s
        depth_m = 0.0 if self.intent.lifted else self.intent.depth_m
        self._led = self._aim.step(self._led, self._target, depth_m=depth_m, way_m=way_m)
        self._arrived = self._led is self._target
        self._publish(
            FingerPath(
                label=LABEL,
                times_s=np.zeros(1),
                positions_world_m=self._led[None],
                wander_m=0.0,
                tremor_m=0.0,
            )
        )
        return self._arrived
