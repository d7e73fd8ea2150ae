"""What else a camera sees beside the marked fingertip: the things that make tracking hard.

Everything stands in world coordinates (m), as plain values; `pixels.py` draws them.  A thing either
has its own path in the world or is carried: then its path is counted from the fingertip.  Levels
are digital numbers at the sensor's normal exposure, where the mark has some 215 of 255.
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
"""World direction from the tip to the knuckle: up from below, out of the mark's sight."""


class Path(Protocol):
    """Where something is at a time of the twin's."""

    def at(self, time_s: float) -> Floats:
        """World position (3,), or that from the fingertip for what is carried."""
        ...


@dataclass(frozen=True, slots=True)
class Still:
    point: Point

    def at(self, time_s: float) -> Floats:
        return np.array(self.point)


@dataclass(frozen=True, slots=True)
class Moving:
    """Evenly, through `start` at time 0."""

    start: Point
    velocity_m_per_s: Point

    def at(self, time_s: float) -> Floats:
        return np.array(self.start) + time_s * np.array(self.velocity_m_per_s)


@dataclass(frozen=True, slots=True)
class Swinging:
    """To and fro through `middle` by +-`reach`, for ever."""

    middle: Point
    reach: Point
    period_s: float
    phase_rad: float = 0.0

    def at(self, time_s: float) -> Floats:
        angle = 2.0 * np.pi * time_s / self.period_s + self.phase_rad
        return np.asarray(np.array(self.middle) + np.sin(angle) * np.array(self.reach))


@dataclass(frozen=True, slots=True)
class Limb:
    """Skin: a tapered capsule between two places; behind the finger and its mark."""

    start: Path
    end: Path
    start_radius_m: float
    end_radius_m: float
    level: float
    carried: bool = False


@dataclass(frozen=True, slots=True)
class SecondMarker:
    """A bead like the mark."""

    path: Path
    radius_m: float = MARKER_RADIUS_M
    level: float = 215.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Highlight:
    """A mirror image of a lamp: a small spot whose light adds to what is there.

    Above some 255 it saturates.  A curved mirror often shows it to one view only.
    """

    path: Path
    radius_m: float
    level: float
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Occluder:
    """Something dark or skin-coloured that passes before all else: an even capsule."""

    start: Path
    end: Path
    radius_m: float
    level: float = 60.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Sheet:
    """The lit rubber sheet behind the finger, at rest in the plane z = 0, with its grain.

    contrast: standard deviation of the grain's levels.
    """

    half_width_m: float = 0.12
    half_height_m: float = 0.12
    level: float = 72.0
    contrast: float = 6.0
    grain_m: float = 0.003


@dataclass(frozen=True, slots=True)
class Clutter:
    """All of it; drawn in this order over the room, the finger and its mark before the marks."""

    sheet: Sheet | None = None
    limbs: tuple[Limb, ...] = ()
    markers: tuple[SecondMarker, ...] = ()
    highlights: tuple[Highlight, ...] = ()
    occluders: tuple[Occluder, ...] = ()


def second_marker(offset_m: Point, *, level: float = 215.0, views: Views = "both") -> Clutter:
    """A second mark at a fixed offset from the first."""
    return Clutter(markers=(SecondMarker(Still(offset_m), level=level, carried=True, views=views),))


def touching_highlight(
    overlap: float, *, radius_m: float = 0.0015, level: float = 300.0, views: Views = "both"
) -> Clutter:
    """A highlight beside the mark along x that covers `overlap` (0..1) of its diameter."""
    aside_m = MARKER_RADIUS_M + radius_m - overlap * 2.0 * MARKER_RADIUS_M
    spot = Highlight(Still((aside_m, 0.0, 0.0)), radius_m, level, carried=True, views=views)
    return Clutter(highlights=(spot,))


def covered(share: float, *, level: float = 60.0, views: Views = "both") -> Clutter:
    """Something with a straight edge that hides this share (0..1) of the mark's area from +x.

    At 1 the mark is hidden with its blur: with `views`, a mark that one camera does not see.
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
    ends = [Still((middle_m, y, 0.0)) for y in (-0.02, 0.02)]
    return Clutter(
        occluders=(Occluder(ends[0], ends[1], radius_m, level, carried=True, views=views),)
    )


def together(*parts: Clutter) -> Clutter:
    """All their things in one; at most one of them may bring a sheet."""
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


def _from_knuckle(x: float, y: float, z: float) -> Still:
    """A place on the hand, counted from the pointing finger's knuckle."""
    knuckle = [FINGER_LENGTH_M * part for part in FINGER_DIRECTION]
    return Still((knuckle[0] + x, knuckle[1] + y, knuckle[2] + z))


HAND = Clutter(
    limbs=(
        Limb(
            _from_knuckle(0.008, -0.022, 0.022), _from_knuckle(0.024, -0.036, 0.038),
            0.018, 0.020, 74.0, carried=True,
        ),
        Limb(
            _from_knuckle(0.02, -0.014, -0.012), _from_knuckle(0.05, -0.024, -0.002),
            0.009, 0.008, 80.0, carried=True,
        ),
        Limb(
            _from_knuckle(-0.02, -0.012, -0.016), _from_knuckle(-0.002, -0.034, 0.016),
            0.008, 0.01, 82.0, carried=True,
        ),
    )
)  # fmt: skip
"""The rest of a pointing right hand: palm, folded fingers, thumb."""

NAIL = Clutter(highlights=(Highlight(Still((0.001, -0.006, 0.014)), 0.0006, 120.0, carried=True),))
"""A glint on the nail: dimmer and smaller than the mark."""

CLAMPS = Clutter(
    highlights=(
        Highlight(Still((-0.135, 0.06, 0.01)), 0.0008, 150.0, views="left"),
        Highlight(Still((0.135, -0.04, 0.01)), 0.0008, 150.0),
    )
)
"""Glints on what clamps the sheet's edges."""

PASSING = Clutter(
    markers=(SecondMarker(Swinging((0.0, 0.05, 0.02), (0.14, 0.02, 0.0), 7.3)),),
    highlights=(
        Highlight(Swinging((0.03, 0.0, 0.005), (0.05, 0.06, 0.0), 3.1), 0.0015, 300.0),
        Highlight(
            Swinging((-0.04, 0.0, 0.005), (0.0, 0.09, 0.0), 4.7), 0.0015, 300.0, views="left"
        ),
    ),
    occluders=(
        Occluder(
            Swinging((0.0, 0.35, -0.05), (0.35, 0.0, 0.0), 5.9),
            Swinging((0.05, -0.35, 0.35), (0.35, 0.0, 0.0), 5.9), 0.012,
        ),
        Occluder(
            Swinging((0.0, 0.35, 0.0), (0.35, 0.0, 0.0), 8.7, phase_rad=1.0),
            Swinging((0.02, -0.35, 0.4), (0.35, 0.0, 0.0), 8.7, phase_rad=1.0), 0.006,
            views="right",
        ),
    ),
)  # fmt: skip
"""A bead as bright as the mark, lamps' images that wander, and cables that swing before it all."""

CLUTTER = {
    "none": Clutter(),
    "lab": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS),
    "crowded": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS, PASSING),
}
"""What a launch file may ask for by name; what moves here swings, so that any time will do."""
