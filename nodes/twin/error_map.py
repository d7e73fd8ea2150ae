"""Map the image error over the object, by position codes that are drawn on it.

In the patterns `coordinate_ramp_x` and `coordinate_ramp_y` every point of the drawn object has a
colour that encodes the x or y at which the eye should see it on the imaginary screen. Red and green
are cosine and sine of a phase; blue encodes the coarse position. The difference between decoded and
seen position is the image error at each point.
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
"""Period of the phase, and range of the coarse position, as in `object.frag.glsl`."""

PURE = 0.06
"""Red and green lie on a circle; a pixel that is farther off, relative to the radius, is blended.
"""

AGREES_M = 0.002
"""Maximum difference between the positions by blue and by the phase; beyond it a pixel is blended.
One step of blue is 1.2 mm."""

RIM_PX = 3
"""Pixels of the outline that are left out, because black in them would shift their position."""

COARSE_LIGHT = 0.1
"""Blue below this is black: the least that is drawn is twice that."""


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """Error map: the error of each visible point.

    errors_m: (rows, columns, 2), seen minus expected position, x right, y up; NaN where nothing is
    seen.
    """

    errors_m: Floats

    @property
    def sizes_m(self) -> Floats:
        """Return the lengths (n,) of the errors of all seen points."""
        sizes = np.linalg.norm(self.errors_m, axis=2)
        return np.asarray(sizes[np.isfinite(sizes)])


def error_map(coordinate_ramp_x: Image, coordinate_ramp_y: Image, metres_per_px: float) -> ErrorMap:
    """Compare the eye's images (rows, columns, 3) of both patterns with the expected positions."""
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
    """Return the decoded position (rows, columns), m, and whether the colour is a valid code."""
    red, green, blue = np.moveaxis(picture.astype(np.float64) / 127.5 - 1.0, -1, 0)
    phase = np.arctan2(green, red) / (2.0 * np.pi)
    coarse = ((0.5 * (blue + 1.0) - 0.2) / 0.8 - 0.5) * RANGE_M
    turns = np.rint(coarse / PERIOD_M - phase)
    places = (turns + phase) * PERIOD_M
    pure = (np.abs(np.hypot(red, green) - 1.0) < PURE) & (np.abs(places - coarse) < AGREES_M)
    # A lone pixel that is a whole period off its neighbours is blended too.
    about = cv2.medianBlur(places.astype(np.float32), 5)
    return places, pure & (np.abs(places - about) < 0.5 * PERIOD_M)
