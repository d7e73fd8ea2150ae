"""Measure the image error at each point of the object from position codes that are drawn on it.

The eye should see each point of the object at certain coordinates on the imaginary screen (z = 0).
The colours of the patterns `coordinate_ramp_x` and `coordinate_ramp_y` encode x and y. Red and
green are the cosine and the sine of a phase. Blue encodes the coarse position. The image error is
the position at which the eye sees a point minus the encoded position.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flexsheet.nodes.arrays import Bools, Floats, Image

PERIOD_M, RANGE_M = 0.02, 0.24
"""The period of the phase and the range of the coarse position (m), as in the shader
`object.frag.glsl`."""

PURE = 0.06
"""The maximum deviation of (red, green) from the circle of valid codes, relative to the circle's
radius. A pixel with a larger deviation contains a mixture of colours and is ignored."""

AGREES_M = 0.002
"""The maximum difference (m) between the positions that blue and the phase encode. A pixel with a
larger difference is ignored. One step of the blue level corresponds to 1.2 mm."""

RIM_PX = 3
"""The width of the ignored outline of the object, px. In the outline, a mixture with black would
change the decoded position."""

COARSE_LIGHT = 0.1
"""The fraction of the maximum blue level below which a pixel does not belong to the object."""


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """The image error at each visible point of the object.

    errors_m (rows, columns, 2): actual minus expected position as seen by the eye, m, with x to the
        right and y up. The error is NaN if no point can be decoded at a pixel.
    """

    errors_m: Floats

    @property
    def sizes_m(self) -> Floats:
        """Return the magnitudes (n,), m, of the errors at all n decoded points."""
        sizes = np.linalg.norm(self.errors_m, axis=2)
        return np.asarray(sizes[np.isfinite(sizes)])


def error_map(coordinate_ramp_x: Image, coordinate_ramp_y: Image, metres_per_px: float) -> ErrorMap:
    """Measure the image errors from two images in which colours encode object coordinates.

    coordinate_ramp_x, coordinate_ramp_y: images (rows, columns, 3) at the eye, whose colours encode
        x and y.
    metres_per_px: pixel size on the imaginary screen.
    """
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
    """Decode the object coordinate (m) from the colour of each pixel.

    Returns the coordinates and a mask of valid pixels, both with the shape (rows, columns).
    """
    red, green, blue = np.moveaxis(picture.astype(np.float64) / 127.5 - 1.0, -1, 0)
    phase = np.arctan2(green, red) / (2.0 * np.pi)
    coarse = ((0.5 * (blue + 1.0) - 0.2) / 0.8 - 0.5) * RANGE_M
    turns = np.rint(coarse / PERIOD_M - phase)
    places = (turns + phase) * PERIOD_M
    pure = (np.abs(np.hypot(red, green) - 1.0) < PURE) & (np.abs(places - coarse) < AGREES_M)
    # A single pixel that differs by a whole period from its neighbours is not valid either.
    about = cv2.medianBlur(places.astype(np.float32), 5)
    return places, pure & (np.abs(places - about) < 0.5 * PERIOD_M)
