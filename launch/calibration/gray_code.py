"""Generate Gray-code patterns for structured light, and decode camera images of the patterns.

A camera pixel is wider than a projector pixel, so the finest stripes are not resolved. Each image
is decoded to cells of a few projector pixels. A smooth map is fitted to the cells around a
projector pixel, and gives its position in the image with subpixel accuracy. Moreno and Taubin
(2012) fit local homographies instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Image = NDArray[np.uint8]

MIN_CONTRAST = 24
"""The minimum difference (grey levels) between the white and the black image at a lit camera pixel.
"""

MIN_STRIPE_PX = 4
"""The width of the finest stripes that are decoded, projector pixels."""

WINDOW_HALF_PX = 22.0
"""The half side length, in projector pixels, of the window that is fitted around a projector pixel.
"""

MIN_CELLS = 60
MAX_FIT_RMS_PX = 0.6
"""The maximum rms residual of a fit, camera pixels. A larger residual indicates an edge or a fold
of the sheet in the window."""


class DecodeError(FlexsheetError, ValueError):
    """Raised for images from which the patterns cannot be decoded."""

    code = "gray-code"
    remedy = "Capture all patterns in order, without over- or underexposure."


def make_patterns(width_px: int, height_px: int) -> list[Image]:
    """Return the images to project: each pattern and its inverse, then white, then black."""
    coder = cv2.structured_light.GrayCodePattern.create(width_px, height_px)
    made, images = coder.generate()
    if not made:
        raise DecodeError(f"OpenCV cannot generate a Gray code of {width_px}x{height_px} pixels")
    white = np.full((height_px, width_px), 255, np.uint8)
    return [*(np.asarray(image, np.uint8) for image in images), white, np.zeros_like(white)]


@dataclass(frozen=True, slots=True)
class Decoded:
    """The lit camera pixels (n, 2) and the projector pixels (n, 2) that light them.

    The images identify a cell of several projector pixels, whose centre is stored.
    """

    pixels: Floats
    lit_by: Floats


def decode_patterns(images: Sequence[Image], width_px: int, height_px: int) -> Decoded:
    """Decode one camera's images (height, width) of the patterns, in the order of `make_patterns`.

    Raises DecodeError for a wrong number of images, different sizes, or too few lit pixels.
    """
    bits = [_bits(width_px), _bits(height_px)]
    expected = 2 * sum(bits) + 2
    if len(images) != expected:
        raise DecodeError(f"expected {expected} images, one per pattern, found {len(images)}")
    if len({image.shape for image in images}) != 1:
        raise DecodeError(
            "the images have different sizes; capture all images with the same camera"
        )
    white, black = (image.astype(np.int16) for image in images[-2:])
    row, column = np.nonzero(white - black >= MIN_CONTRAST)
    if len(row) < MIN_CELLS:
        raise DecodeError(
            f"the projector lights only {len(row)} camera pixels: darken the room, increase the "
            "exposure time, or aim both devices at the sheet"
        )
    axes, first = [], 0
    for count in bits:
        value = np.zeros(len(row), np.int64)
        before = np.zeros(len(row), np.int64)
        unused = min(int(np.log2(MIN_STRIPE_PX)), count - 1)
        for number in range(count - unused):
            shown, inverse = images[first + 2 * number], images[first + 2 * number + 1]
            before ^= shown[row, column] > inverse[row, column]
            value = 2 * value + before
        axes.append(value * 2.0**unused + 0.5 * (2.0**unused - 1.0))
        first += 2 * count
    return Decoded(np.column_stack([column, row]).astype(np.float64), np.column_stack(axes))


def _bits(size_px: int) -> int:
    return int(np.ceil(np.log2(size_px)))


def find_pixels(view: Decoded, projector_px: Floats) -> tuple[Floats, Bools]:
    """Find the camera pixels (n, 2) of projector pixels (n, 2).

    Return the camera pixels, and a mask (n,) that is true for valid pixels.
    """
    found, valid = np.zeros((len(projector_px), 2)), np.zeros(len(projector_px), np.bool_)
    order = np.argsort(view.lit_by[:, 0], kind="stable")
    lit_by, pixels = view.lit_by[order], view.pixels[order]
    for index, pixel in enumerate(projector_px):
        first, last = np.searchsorted(
            lit_by[:, 0], [pixel[0] - WINDOW_HALF_PX, pixel[0] + WINDOW_HALF_PX]
        )
        near = np.abs(lit_by[first:last, 1] - pixel[1]) <= WINDOW_HALF_PX
        pixel_found = _fit_pixel(
            (lit_by[first:last][near] - pixel) / WINDOW_HALF_PX, pixels[first:last][near]
        )
        if pixel_found is not None:
            found[index], valid[index] = pixel_found, True
    return found, valid


def _fit_pixel(offsets: Floats, pixels: Floats) -> Floats | None:
    """Fit a quadratic map from offsets to camera pixels (n, 2); return the pixel (2,) at offset 0.

    offsets (n, 2): offsets of decoded cells of the projector image, relative to half the window's
    side (-1..1). Returns None if the residual is too large, or cells are missing on one side.
    """
    for _ in range(2):
        # Require cells on all sides, because the fit would extrapolate beyond the sheet's edge.
        quadrants = (offsets > 0.0) @ np.array([1, 2])
        if len(pixels) < MIN_CELLS or len(np.unique(quadrants)) < 4:
            return None
        x, y = offsets.T
        terms = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
        solution, *_ = np.linalg.lstsq(terms, pixels, rcond=None)
        error = np.linalg.norm(pixels - terms @ solution, axis=1)
        keep = error <= 3.0 * np.median(error)
        if keep.all():
            break
        offsets, pixels = offsets[keep], pixels[keep]
    if float(np.sqrt(np.mean(error[keep] ** 2))) > MAX_FIT_RMS_PX * MIN_STRIPE_PX:
        return None
    return np.asarray(solution[0], dtype=np.float64)
