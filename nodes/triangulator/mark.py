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

Centroid = Callable[[Image, float, float], tuple[float, float]]
"""(x, y) in a cut-out (h, w) around one mark, from its levels, the level of what surrounds the
mark, and the mark's own peak."""

SURROUND_PX = 3
"""Width of the border that is kept around a mark's blob; its outermost pixels are surroundings."""

SURROUND_RANK = 0.9
"""Share of the surrounding pixels that are darker than their stated level: a mark on a finger has
finger on one side and darkness on the other, and the finger must not count as mark."""

SKIRT_SHARE = 0.1
"""Light below this share of the mark's height above its surroundings is left out as noise."""


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


def moments(cut: Image, surround: float, peak: float) -> tuple[float, float]:
    """Centre of the area brighter than half the mark's height: every such pixel counts alike."""
    bright = cv2.threshold(cut, 0.5 * (surround + peak), 1, cv2.THRESH_BINARY)[1]
    return _centre(cv2.moments(bright, binaryImage=True))


def weighted_centroid(cut: Image, surround: float, peak: float) -> tuple[float, float]:
    """Centre of the mark's light.

    A pixel that the mark's edge crosses counts by how much of it is lit, which removes most of the
    pixel grid's error, and the weight falls to zero at the skirt, so that no pixel jumps in or out.
    """
    skirt = np.float32(surround + SKIRT_SHARE * (peak - surround))
    return _centre(cv2.moments(np.maximum(cut.astype(np.float32) - skirt, np.float32(0.0))))


def _centre(found: dict[str, float]) -> tuple[float, float]:
    return found["m10"] / found["m00"], found["m01"] / found["m00"]


@dataclass(frozen=True, slots=True)
class MarkMethod:
    """A way to find a mark's centre, and the standard deviation (px) that it leaves."""

    centroid: Centroid
    noise_px: float


MARK_METHODS = {
    "moments": MarkMethod(moments, noise_px=0.1),
    "weighted_centroid": MarkMethod(weighted_centroid, noise_px=0.025),
}
"""The noise is what makes the tracked covariance agree with the twin's true error
for a mark of 3 mm radius half a metre away."""


def window_around(pixel: Floats, shape: tuple[int, int], half_px: int) -> Window | None:
    """The window around a pixel in a picture of `shape` (height, width); None if outside it."""
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
    bright = cv2.threshold(part, 0.5 * (peak + mean), 255, cv2.THRESH_BINARY)[1]
    left, top, width, height = cv2.boundingRect(bright)
    blobs = bright[top : top + height, left : left + width]
    stats = cv2.connectedComponentsWithStats(blobs, connectivity=8)[2][1:]
    sizes = stats[:, cv2.CC_STAT_AREA]
    centres = []
    for x, y, blob_width, blob_height, _ in stats[
        (sizes >= looks.min_area_px) & (sizes <= looks.max_area_px)
    ].tolist():
        box = (x + left, y + top, blob_width, blob_height)
        centre = _mark_in(part, box, looks, centroid)
        if centre is not None:
            centres.append(np.array([columns.start + centre[0], rows.start + centre[1]]))
    return centres


def _mark_in(
    part: Image, box: tuple[int, int, int, int], looks: MarkLooks, centroid: Centroid
) -> tuple[float, float] | None:
    """The centre of the blob in a box (x, y, width, height) of a picture; None if it is no mark."""
    x, y, width, height = box
    if x == 0 or y == 0 or x + width == part.shape[1] or y + height == part.shape[0]:
        return None
    left, top = max(x - SURROUND_PX, 0), max(y - SURROUND_PX, 0)
    cut = part[top : y + height + SURROUND_PX, left : x + width + SURROUND_PX]
    border = np.sort(np.concatenate([cut[0], cut[-1], cut[:, 0], cut[:, -1]]))
    surround, peak = float(border[int(SURROUND_RANK * len(border))]), float(cut.max())
    if peak - surround < 0.5 * looks.min_contrast:
        return None
    centre_x, centre_y = centroid(cut, surround, peak)
    return left + centre_x, top + centre_y


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
