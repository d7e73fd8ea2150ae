"""Generate and decode structured light: Gray code patterns, and camera images of them.

A camera's pixel is wider than a projector's, so that the finest stripes are not resolved: each
image is decoded to cells of a few projector pixels. A smooth map fitted to the cells around a
projector pixel gives its position in the image to a fraction of a camera pixel (after Moreno and
Taubin 2012, who fit local homographies).
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
"""Minimum difference between white and black, in levels, of a camera pixel that the projector
lights."""

MIN_STRIPE_PX = 4
"""Width of the finest stripes that are used, projector pixels."""

WINDOW_HALF_PX = 22.0
"""Half the side of the window for the fit at a projector pixel, projector pixels."""

MIN_CELLS = 60
MAX_FIT_RMS_PX = 0.6
"""A fit that leaves more than this (rms, camera pixels) spans an edge or a fold of the sheet."""


class DecodeError(FlexsheetError, ValueError):
    """Raised for images that do not show the patterns; the text gives the reason."""

    code = "gray-code"
    remedy = "Take all images in order, exposed neither too dark nor too bright."


def patterns(width_px: int, height_px: int) -> list[Image]:
    """Return the projector's images in their order: each stripe and its inverse, then white, then
    black."""
    coder = cv2.structured_light.GrayCodePattern.create(width_px, height_px)
    made, images = coder.generate()
    if not made:
        raise DecodeError(f"no Gray code of {width_px}x{height_px}")
    white = np.full((height_px, width_px), 255, np.uint8)
    return [*(np.asarray(image, np.uint8) for image in images), white, np.zeros_like(white)]


@dataclass(frozen=True, slots=True)
class Decoded:
    """Hold the lit pixels (n, 2) of one camera and the projector pixels (n, 2) that light them.

    The latter are the middles of their cells.
    """

    pixels: Floats
    lit_by: Floats


def decode_patterns(images: Sequence[Image], width_px: int, height_px: int) -> Decoded:
    """Decode one camera's images (height, width) of `patterns(width_px, height_px)`, in their
    order.

    Raises DecodeError for another number of images, sizes that differ, or nothing lit.
    """
    bits = [_bits(width_px), _bits(height_px)]
    wanted = 2 * sum(bits) + 2
    if len(images) != wanted:
        raise DecodeError(f"{len(images)} images; the patterns are {wanted}")
    if len({image.shape for image in images}) != 1:
        raise DecodeError("the images have different sizes")
    white, black = (image.astype(np.int16) for image in images[-2:])
    row, column = np.nonzero(white - black >= MIN_CONTRAST)
    if len(row) < MIN_CELLS:
        raise DecodeError(
            f"{len(row)} of the camera's pixels are lit by the projector: make the room darker, "
            "the exposure longer, or aim both at the sheet"
        )
    axes, begin = [], 0
    for count in bits:
        value = np.zeros(len(row), np.int64)
        before = np.zeros(len(row), np.int64)
        unused = min(int(np.log2(MIN_STRIPE_PX)), count - 1)
        for number in range(count - unused):
            shown, inverse = images[begin + 2 * number], images[begin + 2 * number + 1]
            before ^= shown[row, column] > inverse[row, column]
            value = 2 * value + before
        axes.append(value * 2.0**unused + 0.5 * (2.0**unused - 1.0))
        begin += 2 * count
    return Decoded(np.column_stack([column, row]).astype(np.float64), np.column_stack(axes))


def _bits(size_px: int) -> int:
    return int(np.ceil(np.log2(size_px)))


def find_pixels(view: Decoded, wanted: Floats) -> tuple[Floats, Bools]:
    """Return the camera's pixels (n, 2) of the projector's pixels (n, 2), and which are found."""
    found, seen = np.zeros((len(wanted), 2)), np.zeros(len(wanted), np.bool_)
    order = np.argsort(view.lit_by[:, 0], kind="stable")
    lit_by, pixels = view.lit_by[order], view.pixels[order]
    for index, pixel in enumerate(wanted):
        first, last = np.searchsorted(
            lit_by[:, 0], [pixel[0] - WINDOW_HALF_PX, pixel[0] + WINDOW_HALF_PX]
        )
        near = np.abs(lit_by[first:last, 1] - pixel[1]) <= WINDOW_HALF_PX
        pixel_found = _fit_pixel(
            (lit_by[first:last][near] - pixel) / WINDOW_HALF_PX, pixels[first:last][near]
        )
        if pixel_found is not None:
            found[index], seen[index] = pixel_found, True
    return found, seen


def _fit_pixel(offsets: Floats, pixels: Floats) -> Floats | None:
    """Return the camera's pixel (2,) at offset 0 of a quadratic map fitted to offsets (n, 2) in
    -1..1."""
    for _ in range(2):
        # Cells on all sides are required: beyond the sheet's edge the fit would extrapolate.
        quadrants = (offsets > 0.0) @ np.array([1, 2])
        if len(pixels) < MIN_CELLS or len(np.unique(quadrants)) < 4:
            return None
        x, y = offsets.T
        terms = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
        solution, *_ = np.linalg.lstsq(terms, pixels, rcond=None)
        off = np.linalg.norm(pixels - terms @ solution, axis=1)
        keep = off <= 3.0 * np.median(off)
        if keep.all():
            break
        offsets, pixels = offsets[keep], pixels[keep]
    if float(np.sqrt(np.mean(off[keep] ** 2))) > MAX_FIT_RMS_PX * MIN_STRIPE_PX:
        return None
    return np.asarray(solution[0], dtype=np.float64)
