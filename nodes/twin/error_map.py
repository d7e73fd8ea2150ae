"""Where each seen point of the object ought to be: reads the places that it is painted with.

In the patterns `coordinate_ramp_x` and `coordinate_ramp_y` every point of the drawn object has the
colour of the x or y at which the eye ought to see it on the imaginary screen: red and green the
cosine and sine of a phase, blue the same over the whole screen, coarsely. What the eye's picture
shows elsewhere is the error of the image, at each point and not on its outline only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Image = NDArray[np.uint8]

PERIOD_M, RANGE_M = 0.02, 0.24
"""Of the phase, and of the coarse place; as `object.frag.glsl` paints them."""

PURE = 0.06
"""Red and green lie on a circle; farther off it than this share of its radius they are blended."""

AGREES_M = 0.002
"""Blue and the phase tell the same place; farther apart than this they are blended.  One step of
blue is 1.2 mm."""

RIM_PX = 3
"""Pixels of the outline that are left out: a bit of black in them would shift their place."""

COARSE_LIGHT = 0.1
"""Blue of less is black: the least that is painted is twice that."""


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """errors_m: (rows, columns, 2), where a point is seen less where it ought to be, x right, y up;
    not a number where nothing is seen.
    """

    errors_m: Floats

    @property
    def sizes_m(self) -> Floats:
        """Lengths (n,) of the errors of all points that are seen."""
        sizes = np.linalg.norm(self.errors_m, axis=2)
        return np.asarray(sizes[np.isfinite(sizes)])


def error_map(coordinate_ramp_x: Image, coordinate_ramp_y: Image, metres_per_px: float) -> ErrorMap:
    """Compare the eye's pictures (rows, columns, 3) of both patterns with where things are."""
    seen = _lit(coordinate_ramp_x) & _lit(coordinate_ramp_y)
    kernel = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
    seen = cv2.erode(seen.astype(np.uint8), kernel, borderValue=0) > 0
    rows, columns = seen.shape
    here_x = (np.arange(columns) + 0.5 * (1 - columns)) * metres_per_px
    here_y = (0.5 * (rows - 1) - np.arange(rows)) * metres_per_px
    wanted_x, pure_x = _places(coordinate_ramp_x)
    wanted_y, pure_y = _places(coordinate_ramp_y)
    errors = np.stack([here_x[None, :] - wanted_x, here_y[:, None] - wanted_y], axis=-1)
    errors[~(seen & pure_x & pure_y)] = np.nan
    return ErrorMap(errors)


def _lit(picture: Image) -> Bools:
    lit: Bools = picture[..., 2] > 255.0 * COARSE_LIGHT
    return lit


def _places(picture: Image) -> tuple[Floats, Bools]:
    """The painted place (rows, columns), m, and whether the colour is one that is painted."""
    red, green, blue = np.moveaxis(picture.astype(np.float64) / 127.5 - 1.0, -1, 0)
    phase = np.arctan2(green, red) / (2.0 * np.pi)
    coarse = ((0.5 * (blue + 1.0) - 0.2) / 0.8 - 0.5) * RANGE_M
    turns = np.rint(coarse / PERIOD_M - phase)
    places = (turns + phase) * PERIOD_M
    pure = (np.abs(np.hypot(red, green) - 1.0) < PURE) & (np.abs(places - coarse) < AGREES_M)
    # A lone pixel that is a whole period off its neighbours is blended too.
    about = cv2.medianBlur(places.astype(np.float32), 5)
    return places, pure & (np.abs(places - about) < 0.5 * PERIOD_M)
