"""Finds the bright mark on the fingertip in a picture, and its centre to a fraction of a pixel.

Pixels have their origin at the centre of the top left pixel, x to the right, y down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Window = tuple[slice, slice]
"""Rows and columns of a part of a picture."""

Centroid = Callable[[Image, NDArray[np.bool_], float], tuple[float, float]]
"""(x, y) in a cut-out, from its levels (h, w), which pixels belong to the mark (h, w), and the
level that divides mark from surroundings."""


@dataclass(frozen=True, slots=True)
class MarkLooks:
    """What counts as a mark.

    min_contrast: levels that its brightest pixel stands above the picture's mean.
    min_area_px, max_area_px: pixels brighter than half that contrast.
    window_half_px: half the side of the window that is searched around an expected place.
    """

    min_contrast: float = 60.0
    min_area_px: int = 6
    max_area_px: int = 1500
    window_half_px: int = 28


def moments(levels: Image, member: NDArray[np.bool_], threshold: float) -> tuple[float, float]:
    """Centre of the mark's area: every pixel of the mark counts alike."""
    found = cv2.moments(member.view(np.uint8), binaryImage=True)
    return found["m10"] / found["m00"], found["m01"] / found["m00"]


def weighted_centroid(
    levels: Image, member: NDArray[np.bool_], threshold: float
) -> tuple[float, float]:
    """Centre of the mark's light above the threshold.

    A pixel that the mark's edge crosses counts by how much of it is lit, which removes most of the
    pixel grid's error, and the weight falls to zero at the edge, so that no pixel jumps in or out.
    """
    weights = np.where(member, levels.astype(np.float32) - np.float32(threshold), np.float32(0.0))
    found = cv2.moments(weights)
    return found["m10"] / found["m00"], found["m01"] / found["m00"]


MARK_METHODS: dict[str, Centroid] = {"moments": moments, "weighted_centroid": weighted_centroid}


def window_around(pixel: Floats, shape: tuple[int, int], half_px: int) -> Window | None:
    """The window of a picture of `shape` (height, width) around a pixel; None if it lies outside."""
    if not np.isfinite(pixel).all():
        return None
    x, y = round(float(pixel[0])), round(float(pixel[1]))
    rows = slice(max(y - half_px, 0), min(y + half_px + 1, shape[0]))
    columns = slice(max(x - half_px, 0), min(x + half_px + 1, shape[1]))
    outside = rows.start >= rows.stop or columns.start >= columns.stop
    return None if outside else (rows, columns)


def find_marks(
    image: Image, looks: MarkLooks, centroid: Centroid, window: Window | None = None
) -> list[Floats]:
    """Centres (2,) px of all marks in a picture, or in a window of it.

    A blob that is cut by the border is no mark, since its centre would be wrong; nor is one that is
    too small or too large.  A picture without contrast (black, saturated, fogged) has none.
    """
    rows, columns = window or (slice(0, image.shape[0]), slice(0, image.shape[1]))
    part = image[rows, columns]
    mean, (_, peak, _, _) = cv2.mean(part)[0], cv2.minMaxLoc(part)
    if peak - mean < looks.min_contrast:
        return []
    threshold = 0.5 * (peak + mean)
    bright = cv2.threshold(part, threshold, 255, cv2.THRESH_BINARY)[1]
    left, top, width, height = cv2.boundingRect(bright)
    blobs = bright[top : top + height, left : left + width]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(blobs, connectivity=8)
    centres = []
    for label in range(1, len(stats)):
        x, y, blob_width, blob_height, area = (int(number) for number in stats[label])
        x, y = x + left, y + top
        if not looks.min_area_px <= area <= looks.max_area_px:
            continue
        if x == 0 or y == 0 or x + blob_width == part.shape[1] or y + blob_height == part.shape[0]:
            continue
        cut = (slice(y, y + blob_height), slice(x, x + blob_width))
        member = labels[y - top : y - top + blob_height, x - left : x - left + blob_width] == label
        centre_x, centre_y = centroid(part[cut], member, threshold)
        centres.append(np.array([columns.start + x + centre_x, rows.start + y + centre_y]))
    return centres


def find_mark_near(
    image: Image, looks: MarkLooks, centroid: Centroid, expected: Floats | None
) -> list[Floats]:
    """As `find_marks`, first around the expected pixel; the whole picture only if none is there."""
    if expected is not None:
        window = window_around(expected, image.shape, looks.window_half_px)
        if window is not None:
            near = find_marks(image, looks, centroid, window)
            if near:
                return near
    return find_marks(image, looks, centroid)
