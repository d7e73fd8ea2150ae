"""Describe what a camera sees beside the marked fingertip: the clutter that makes tracking hard.

All objects are plain values in world coordinates (m); `pixels.py` renders them.  An object has its
own path in the world, or is carried: then its path is relative to the fingertip.  Levels are
digital numbers at the sensor's normal exposure, where the marker has some 215 of 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Floats = NDArray[np.float64]
Point = tuple[float, float, float]
Views = Literal["both", "left", "right"]

MARKER_RADIUS_M = 0.003
FINGER_LENGTH_M = 0.06
FINGER_DIRECTION: Point = (0.0, -0.5, 0.866)
"""World direction from the tip to the knuckle: up from below, out of the marker's view."""


class Trajectory(Protocol):
    """Interface of a position over simulation time."""

    def at(self, time_s: float) -> Floats:
        """Return the position (3,), world; of a carried object relative to the fingertip."""
        ...


@dataclass(frozen=True, slots=True)
class FixedPoint:
    point: Point

    def at(self, time_s: float) -> Floats:
        return np.array(self.point)


@dataclass(frozen=True, slots=True)
class Moving:
    """Motion at constant velocity through `start` at time 0."""

    start: Point
    velocity_m_per_s: Point

    def at(self, time_s: float) -> Floats:
        return np.array(self.start) + time_s * np.array(self.velocity_m_per_s)


@dataclass(frozen=True, slots=True)
class Oscillation:
    """Oscillate through `middle` by +-`reach`."""

    middle: Point
    reach: Point
    period_s: float
    phase_rad: float = 0.0

    def at(self, time_s: float) -> Floats:
        angle = 2.0 * np.pi * time_s / self.period_s + self.phase_rad
        return np.asarray(np.array(self.middle) + np.sin(angle) * np.array(self.reach))


@dataclass(frozen=True, slots=True)
class Capsule:
    """Skin: a tapered capsule between two points, behind the finger and its marker."""

    start: Trajectory
    end: Trajectory
    start_radius_m: float
    end_radius_m: float
    level: float
    carried: bool = False


@dataclass(frozen=True, slots=True)
class SecondMarker:
    """Bead that resembles the marker."""

    path: Trajectory
    radius_m: float = MARKER_RADIUS_M
    level: float = 215.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Highlight:
    """Reflection of a lamp: a small spot whose light adds to the background.

    It saturates above some 255.  A curved mirror often shows it in one view only.
    """

    path: Trajectory
    radius_m: float
    level: float
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Occluder:
    """Dark or skin-coloured capsule of constant level in front of everything else."""

    start: Trajectory
    end: Trajectory
    radius_m: float
    level: float = 60.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Sheet:
    """Lit rubber sheet behind the finger, at rest in the plane z = 0, with its grain.

    contrast: standard deviation of the grain's levels.
    """

    half_width_m: float = 0.12
    half_height_m: float = 0.12
    level: float = 72.0
    contrast: float = 6.0
    grain_m: float = 0.003


@dataclass(frozen=True, slots=True)
class Clutter:
    """All clutter; rendered in this order, with the finger and its marker before `markers`."""

    sheet: Sheet | None = None
    limbs: tuple[Capsule, ...] = ()
    markers: tuple[SecondMarker, ...] = ()
    highlights: tuple[Highlight, ...] = ()
    occluders: tuple[Occluder, ...] = ()


def second_marker(offset_m: Point, *, level: float = 215.0, views: Views = "both") -> Clutter:
    """Make a second marker at a fixed offset from the first."""
    return Clutter(
        markers=(SecondMarker(FixedPoint(offset_m), level=level, carried=True, views=views),)
    )


def touching_highlight(
    overlap: float, *, radius_m: float = 0.0015, level: float = 300.0, views: Views = "both"
) -> Clutter:
    """Make a highlight beside the marker along x that covers `overlap` (0..1) of its diameter."""
    aside_m = MARKER_RADIUS_M + radius_m - overlap * 2.0 * MARKER_RADIUS_M
    spot = Highlight(FixedPoint((aside_m, 0.0, 0.0)), radius_m, level, carried=True, views=views)
    return Clutter(highlights=(spot,))


def covered(share: float, *, level: float = 60.0, views: Views = "both") -> Clutter:
    """Make a straight-edged occluder that hides this fraction (0..1) of the marker's area from +x.

    At 1 it hides the marker with its blur.  With `views`, only one camera misses the marker.
    """
    radius_m = 0.05
    if share >= 1.0:
        edge = -3.0
    else:
        # The segment of a unit disc beyond x = edge.
        edge = brentq(
            lambda x: (np.arccos(x) - x * np.sqrt(1.0 - x * x)) / np.pi - share, -1.0, 1.0
        )
    middle_m = edge * MARKER_RADIUS_M + radius_m
    ends = [FixedPoint((middle_m, y, 0.0)) for y in (-0.02, 0.02)]
    return Clutter(
        occluders=(Occluder(ends[0], ends[1], radius_m, level, carried=True, views=views),)
    )


def together(*parts: Clutter) -> Clutter:
    """Combine clutter; at most one part may contain a sheet."""
    sheets = [part.sheet for part in parts if part.sheet is not None]
    if len(sheets) > 1:
        raise ValueError(f"{len(sheets)} sheets: there is one plane z = 0 to lay them in")
    return Clutter(
        sheet=sheets[0] if sheets else None,
        limbs=tuple(limb for part in parts for limb in part.limbs),
        markers=tuple(marker for part in parts for marker in part.markers),
        highlights=tuple(spot for part in parts for spot in part.highlights),
        occluders=tuple(occluder for part in parts for occluder in part.occluders),
    )


def _from_knuckle(x: float, y: float, z: float) -> FixedPoint:
    """Return a point of the hand, relative to the pointing finger's knuckle."""
    knuckle = [FINGER_LENGTH_M * part for part in FINGER_DIRECTION]
    return FixedPoint((knuckle[0] + x, knuckle[1] + y, knuckle[2] + z))


HAND = Clutter(
    limbs=(
        Capsule(
            _from_knuckle(0.008, -0.022, 0.022), _from_knuckle(0.024, -0.036, 0.038),
            0.018, 0.020, 74.0, carried=True,
        ),
        Capsule(
            _from_knuckle(0.02, -0.014, -0.012), _from_knuckle(0.05, -0.024, -0.002),
            0.009, 0.008, 80.0, carried=True,
        ),
        Capsule(
            _from_knuckle(-0.02, -0.012, -0.016), _from_knuckle(-0.002, -0.034, 0.016),
            0.008, 0.01, 82.0, carried=True,
        ),
    )
)  # fmt: skip
"""The rest of a pointing right hand: palm, folded fingers, thumb."""

NAIL = Clutter(
    highlights=(Highlight(FixedPoint((0.001, -0.006, 0.014)), 0.0006, 120.0, carried=True),)
)
"""A reflection on the nail: dimmer and smaller than the marker."""

CLAMPS = Clutter(
    highlights=(
        Highlight(FixedPoint((-0.135, 0.06, 0.01)), 0.0008, 150.0, views="left"),
        Highlight(FixedPoint((0.135, -0.04, 0.01)), 0.0008, 150.0),
    )
)
"""Reflections on the clamps of the sheet's edges."""

PASSING = Clutter(
    markers=(SecondMarker(Oscillation((0.0, 0.05, 0.02), (0.14, 0.02, 0.0), 7.3)),),
    highlights=(
        Highlight(Oscillation((0.03, 0.0, 0.005), (0.05, 0.06, 0.0), 3.1), 0.0015, 300.0),
        Highlight(
            Oscillation((-0.04, 0.0, 0.005), (0.0, 0.09, 0.0), 4.7), 0.0015, 300.0, views="left"
        ),
    ),
    occluders=(
        Occluder(
            Oscillation((0.0, 0.35, -0.05), (0.35, 0.0, 0.0), 5.9),
            Oscillation((0.05, -0.35, 0.35), (0.35, 0.0, 0.0), 5.9), 0.012,
        ),
        Occluder(
            Oscillation((0.0, 0.35, 0.0), (0.35, 0.0, 0.0), 8.7, phase_rad=1.0),
            Oscillation((0.02, -0.35, 0.4), (0.35, 0.0, 0.0), 8.7, phase_rad=1.0), 0.006,
            views="right",
        ),
    ),
)  # fmt: skip
"""A bead as bright as the marker, moving reflections, and cables that swing before everything."""

CLUTTER = {
    "none": Clutter(),
    "lab": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS),
    "crowded": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS, PASSING),
}
"""Clutter by its name in launch files; moving objects oscillate, so that every time is valid."""
