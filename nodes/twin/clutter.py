"""Describe clutter: objects in the camera images that interfere with fingertip tracking.

Positions are in m. The module `pixels` renders the objects. The path of an object is in the world
frame, or relative to the fingertip if the attribute `carried` is true. The attribute `views` names
the cameras that see the object. Levels are grey levels (0 to 255) at normal exposure. The marker on
the fingertip has a level of about 215.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from flexsheet.nodes.arrays import Floats

Point = tuple[float, float, float]
Views = Literal["both", "left", "right"]

MARKER_RADIUS_M = 0.003
FINGER_LENGTH_M = 0.06
FINGER_DIRECTION: Point = (0.0, -0.5, 0.866)
"""The world direction from the fingertip to the knuckle. A finger with this direction does not hide
its marker from the cameras."""


class Trajectory(Protocol):
    """The motion of a clutter object: its position as a function of the simulation time."""

    def at(self, time_s: float) -> Floats:
        """Return the position (3,), m, at a simulation time.

        For objects that are carried by the hand, the position is relative to the fingertip. For
        other objects, it is in the world frame.
        """
        ...


@dataclass(frozen=True, slots=True)
class FixedPoint:
    """The trajectory of an object that does not move."""

    point: Point

    def at(self, time_s: float) -> Floats:
        return np.array(self.point)


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A sinusoidal trajectory about the centre `middle` with the amplitude `reach` (3,), m."""

    middle: Point
    reach: Point
    period_s: float
    phase_rad: float = 0.0

    def at(self, time_s: float) -> Floats:
        angle = 2.0 * np.pi * time_s / self.period_s + self.phase_rad
        return np.asarray(np.array(self.middle) + np.sin(angle) * np.array(self.reach))


@dataclass(frozen=True, slots=True)
class Capsule:
    """A part of the hand, drawn behind the finger as a tapered capsule (rounded cone)."""

    start: Trajectory
    end: Trajectory
    start_radius_m: float
    end_radius_m: float
    level: float
    carried: bool = False


@dataclass(frozen=True, slots=True)
class SecondMarker:
    """A bead that looks like the marker on the fingertip."""

    path: Trajectory
    radius_m: float = MARKER_RADIUS_M
    level: float = 215.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Highlight:
    """A small reflection of a lamp. Its light is added to the background.

    The image saturates above the grey level 255. A reflection on a curved surface often appears in
    only one of the two images.
    """

    path: Trajectory
    radius_m: float
    level: float
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Occluder:
    """A capsule of constant grey level, such as a cable, in front of all other objects."""

    start: Trajectory
    end: Trajectory
    radius_m: float
    level: float = 60.0
    carried: bool = False
    views: Views = "both"


@dataclass(frozen=True, slots=True)
class Sheet:
    """An illuminated rubber sheet behind the finger, at rest in the plane z = 0, with a texture.

    contrast: standard deviation of the texture's grey levels.
    grain_m: size of the texture's features.
    """

    half_width_m: float = 0.12
    half_height_m: float = 0.12
    level: float = 72.0
    contrast: float = 6.0
    grain_m: float = 0.003


@dataclass(frozen=True, slots=True)
class Clutter:
    """The clutter objects of a scene, which are drawn in the order of this class's fields.

    The finger and its marker are drawn after `limbs`.
    """

    sheet: Sheet | None = None
    limbs: tuple[Capsule, ...] = ()
    markers: tuple[SecondMarker, ...] = ()
    highlights: tuple[Highlight, ...] = ()
    occluders: tuple[Occluder, ...] = ()


def second_marker(offset_m: Point) -> Clutter:
    """Return clutter that consists of a second marker at an offset (3,), m, from the fingertip."""
    return Clutter(markers=(SecondMarker(FixedPoint(offset_m), carried=True),))


def touching_highlight(overlap: float) -> Clutter:
    """Return clutter that consists of a highlight on the +x side of the marker.

    overlap: fraction of the marker's diameter that the highlight covers.
    """
    radius_m = 0.0015
    aside_m = MARKER_RADIUS_M + radius_m - overlap * 2.0 * MARKER_RADIUS_M
    spot = Highlight(FixedPoint((aside_m, 0.0, 0.0)), radius_m, 300.0, carried=True)
    return Clutter(highlights=(spot,))


def covered(share: float, *, views: Views = "both") -> Clutter:
    """Return clutter with one straight-edged obstacle that hides part of the marker.

    share: hidden fraction (0 to 1) of the marker's area, starting at the side +x. The value 1 also
        hides the blurred edge of the marker.
    views: cameras in which the marker is hidden.
    """
    radius_m = 0.05
    if share >= 1.0:
        edge = -3.0
    else:
        from scipy.optimize import brentq  # Imported here, because the import takes half a second.

        # Find the x = edge beyond which a segment of the unit disc has this area.
        edge = brentq(
            lambda x: (np.arccos(x) - x * np.sqrt(1.0 - x * x)) / np.pi - share, -1.0, 1.0
        )
    middle_m = edge * MARKER_RADIUS_M + radius_m
    ends = [FixedPoint((middle_m, y, 0.0)) for y in (-0.02, 0.02)]
    return Clutter(occluders=(Occluder(ends[0], ends[1], radius_m, carried=True, views=views),))


def together(*parts: Clutter) -> Clutter:
    """Combine several sets of clutter. Raises ValueError if more than one set contains a sheet."""
    sheets = [part.sheet for part in parts if part.sheet is not None]
    if len(sheets) > 1:
        raise ValueError(
            f"the clutter has {len(sheets)} sheets; use one, because a sheet fills the plane z = 0"
        )
    return Clutter(
        sheet=sheets[0] if sheets else None,
        limbs=tuple(limb for part in parts for limb in part.limbs),
        markers=tuple(marker for part in parts for marker in part.markers),
        highlights=tuple(spot for part in parts for spot in part.highlights),
        occluders=tuple(occluder for part in parts for occluder in part.occluders),
    )


def _from_knuckle(x: float, y: float, z: float) -> FixedPoint:
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
"""The palm, folded fingers and thumb of a right hand whose index finger points."""

NAIL = Clutter(
    highlights=(Highlight(FixedPoint((0.001, -0.006, 0.014)), 0.0006, 120.0, carried=True),)
)
"""A reflection on the fingernail, which is darker and smaller than the marker on the fingertip."""

CLAMPS = Clutter(
    highlights=(
        Highlight(FixedPoint((-0.135, 0.06, 0.01)), 0.0008, 150.0, views="left"),
        Highlight(FixedPoint((0.135, -0.04, 0.01)), 0.0008, 150.0),
    )
)
"""Reflections on the clamps that hold the sheet's edges."""

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
"""Moving clutter: a bead as bright as the marker, reflections of lamps, and cables in front of the
finger."""

CLUTTER = {
    "none": Clutter(),
    "lab": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS),
    "crowded": together(Clutter(sheet=Sheet()), HAND, NAIL, CLAMPS, PASSING),
}
"""The sets of clutter, by their names in launch files (for example "lab")."""
