"""Generate Gray-code patterns for structured light, and decode camera images of the patterns.

A camera pixel is wider than a projector pixel, so the camera does not resolve the finest stripes.
For each camera pixel, decoding finds a cell of a few projector pixels that lights it. To find a
projector pixel in the camera image with subpixel accuracy, a quadratic map is fitted to the cells
around this pixel. Moreno and Taubin (2012) fit local homographies instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats, Image

MIN_CONTRAST = 24
"""The minimum difference in grey levels between white and black at a lit camera pixel."""

MIN_STRIPE_PX = 4
"""The width (projector pixels) of the finest stripes that are decoded."""

WINDOW_HALF_PX = 22.0
"""Half the side length (projector pixels) of the window in which a quadratic map is fitted.

The map converts positions in the projector image to camera pixels.
"""

MIN_CELLS = 60
MAX_FIT_RMS_PX = 0.6
"""The maximum rms residual of the fit of a quadratic map from projector pixels to camera pixels.

The limit in camera pixels is this value times `MIN_STRIPE_PX`. A larger residual indicates that the
window contains an edge or a fold of the sheet.
"""


class DecodeError(FlexsheetError, ValueError):
    """Raised if the patterns cannot be decoded from the camera images."""

    remedy = "Capture all patterns in order, without over- or underexposure."


def make_patterns(width_px: int, height_px: int) -> list[Image]:
    """Return the images (height, width) to project.

    Each pattern is followed by its inverse. The last two images are white and black.
    """
    coder = cv2.structured_light.GrayCodePattern.create(width_px, height_px)
    made, images = coder.generate()
    if not made:
        raise DecodeError(
            f"OpenCV cannot generate a Gray code of {width_px}x{height_px} pixels; correct the "
            "size of the projector's image"
        )
    white = np.full((height_px, width_px), 255, np.uint8)
    return [*(np.asarray(image, np.uint8) for image in images), white, np.zeros_like(white)]


@dataclass(frozen=True, slots=True)
class Decoded:
    """The correspondence between camera pixels and projector pixels, as decoded from images.

    pixels: positions (n, 2) of the n lit camera pixels.
    lit_by: projector pixels (n, 2) that light these camera pixels. Each value is the centre of a
        cell of several projector pixels.
    """

    pixels: Floats
    lit_by: Floats


def decode_patterns(images: Sequence[Image], width_px: int, height_px: int) -> Decoded:
    """Decode the images (height, width) that one camera took of the patterns.

    The images must be in the order in which `make_patterns` returns the patterns.

    width_px, height_px: size of the projected image.

    Raises DecodeError if the number of images is wrong, if their sizes differ, or if too few pixels
    are lit.
    """
    bits = [_bits(width_px), _bits(height_px)]
    expected = 2 * sum(bits) + 2
    if len(images) != expected:
        raise DecodeError(
            f"there are {len(images)} images, but {expected} patterns; give one image per pattern"
        )
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
    """Find the camera pixels that show n given projector pixels.

    Return camera pixels (n, 2), and a mask (n,) of the pixels that were found.

    projector_px: given projector pixels (n, 2).
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
    """Fit a quadratic map from offsets in the projector image to camera pixels.

    Return the camera pixel (2,) at offset 0. Return None if the residual is too large, or if one
    quadrant around offset 0 contains no cells.

    offsets: offsets (n, 2) of n decoded cells, divided by half the window's side (-1..1).
    pixels: camera pixels (n, 2) of these cells.
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
