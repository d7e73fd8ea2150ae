"""What in a picture could be the fingertip's mark, and its centre to a fraction of a pixel.

Pixels have their origin at the centre of the top left pixel, x to the right, y down.  A mark is a
small bright disc, drawn out by its motion during the exposure.  First all bright spots of about its
size are found (`find_spots`), then a method refines the centres of those that matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from nodes.triangulator.subpixel import DiscStart, PixelNoise, fit_discs

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Window = tuple[slice, slice]
"""Rows and columns of a part of a picture."""

NEIGHBOURHOOD_PX = 31
"""A spot stands out from the mean of a square of this side around it."""

SURROUND_PX = 3
"""Width of the border that is kept around a spot; its outermost pixels are surroundings."""

SURROUND_RANK = 0.75
"""Share of the surrounding pixels that are darker than their stated level: a mark on a finger has
finger on one side and darkness on the other, and the finger must not count as mark."""

SKIRT_SHARE = 0.1
"""Light below this share of the mark's height above its surroundings is left out as noise."""

MOST_REGIONS = 64
"""Of a picture with more bright regions only the largest are looked at."""

WHITE_LEVEL = 250
WHITE_SHARE = 0.2
"""A picture whose pixels are white to this share is overexposed."""


@dataclass(frozen=True, slots=True)
class MarkLooks:
    """What counts as a mark.

    min_contrast: levels that its brightest pixel stands above its surroundings.
    min_area_px, max_area_px: pixels brighter than half that contrast.
    window_half_px: half the side of the least window that is searched around an expected place.
    max_motion_px: a mark is not drawn out by more during an exposure.
    max_blur: of the edge, one standard deviation, as a share of the radius; a mark with more is
        out of focus.
    max_misfit: what of the mark's height a disc may leave unexplained, root mean square.
    """

    min_contrast: float = 60.0
    min_area_px: int = 4
    max_area_px: int = 1500
    window_half_px: int = 16
    max_motion_px: float = 9.0
    max_blur: float = 0.5
    max_misfit: float = 0.04


@dataclass(frozen=True, slots=True)
class Spot:
    """A bright spot that could be a mark, in pixels of the picture that was searched.

    centre: of its light.  radius: of a disc of its area at half height.  motion: (x, y) how far its
    light is drawn out, by its second moments.  spread: least second moment of its light over that
    of an even disc of its radius; 1 for a sharp disc.  window: its pixels and their surroundings.
    """

    centre: tuple[float, float]
    radius: float
    motion: tuple[float, float]
    spread: float
    peak: float
    surround: float
    window: Window

    @property
    def blur(self) -> float:
        """Standard deviation of its edge, px: what its light spreads beyond a sharp disc."""
        return min(max(0.5 * self.radius * math.sqrt(max(self.spread - 0.85, 0.0)), 0.6), 3.0)

    @property
    def height(self) -> float:
        """Levels above its surroundings."""
        return self.peak - self.surround


Flaw = Literal["merged", "blurred"]


@dataclass(frozen=True, slots=True)
class Mark:
    """A refined mark: centre (2,) px with covariance (2, 2) px^2; what speaks against it, if any.

    radius: of the disc, px, and how far off the method takes it to be, as a share of it.
    blur: standard deviation of its edge, px.  motion: (x, y) px in the exposure, or its reverse.
    """

    centre: Floats
    covariance: Floats
    radius: float
    radius_deviation: float
    blur: float
    motion: tuple[float, float]
    height: float
    flaw: Flaw | None


Refine = Callable[[Sequence[Image], Sequence[Spot], MarkLooks, PixelNoise], list[Mark]]
"""Marks of spots, the i-th spot found in the i-th picture."""


def window_around(pixel: Floats, shape: tuple[int, ...], half_px: int) -> Window | None:
    """The window around a pixel in a picture of `shape` (height, width); None if outside it."""
    x, y = pixel.tolist()
    if not abs(x) + abs(y) < 1e6:  # nor if it is no number
        return None
    column, row = round(x), round(y)
    rows = slice(max(row - half_px, 0), min(row + half_px + 1, shape[0]))
    columns = slice(max(column - half_px, 0), min(column + half_px + 1, shape[1]))
    outside = rows.start >= rows.stop or columns.start >= columns.stop
    return None if outside else (rows, columns)


def overexposed(image: Image, window: Window | None = None) -> bool:
    """Whether so much of a picture, or of a window of it, is white that nothing can be told."""
    part = image if window is None else image[window]
    white = cv2.threshold(part, WHITE_LEVEL - 1, 1, cv2.THRESH_BINARY)[1]
    return bool(cv2.countNonZero(white) > WHITE_SHARE * part.size)


def find_spots(image: Image, looks: MarkLooks, window: Window | None = None) -> list[Spot]:
    """All spots in a picture, or in a window of it, that could be a mark.

    Bright regions stand out from their neighbourhood's mean; in each, what is brighter than half
    its height over its surroundings is a spot, so that a mark is found on a finger that is bright
    itself, and beside a brighter light.  A spot that the border cuts is none, since its centre
    would be wrong; nor is one too small or too large.
    """
    top, left = (0, 0) if window is None else (window[0].start, window[1].start)
    part = image if window is None else image[window]
    bright = cv2.adaptiveThreshold(
        part,
        255,
        cv2.ADAPTIVE_THRESH_MEAN_C,
        cv2.THRESH_BINARY,
        NEIGHBOURHOOD_PX,
        -0.5 * looks.min_contrast,
    )
    regions = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if len(regions) > MOST_REGIONS:
        regions = sorted(regions, key=len)[-MOST_REGIONS:]
    spots = []
    for region in regions:
        if _pixels_in(region) >= looks.min_area_px:
            spots += _spots_in(part, cv2.boundingRect(region), looks, (top, left))
    return spots


def _pixels_in(outline: cv2.typing.MatLike) -> float:
    """Pixels within an outline of pixel centres, itself included (Pick's theorem)."""
    return cv2.contourArea(outline) + 0.5 * len(outline) + 1.0


def _spots_in(
    part: Image, box: Sequence[int], looks: MarkLooks, origin: tuple[int, int]
) -> list[Spot]:
    """The spots in a box (x, y, width, height) of a picture; `origin`: its first row, column."""
    rows, columns = _around(box)
    cut = part[rows, columns]
    surround, peak = _surround(cut), cv2.minMaxLoc(cut)[1]
    if peak - surround < looks.min_contrast:
        return []
    half = cv2.threshold(cut, 0.5 * (surround + peak), 255, cv2.THRESH_BINARY)[1]
    spots = []
    for outline in cv2.findContours(half, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        area = _pixels_in(outline)
        if not looks.min_area_px <= area <= looks.max_area_px:
            continue
        x, y, width, height = cv2.boundingRect(outline)
        x, y = x + columns.start, y + rows.start
        if x == 0 or y == 0 or x + width == part.shape[1] or y + height == part.shape[0]:
            continue
        window = _around((x, y, width, height))
        cut = part[window]
        surround, peak = _surround(cut), cv2.minMaxLoc(cut)[1]
        if peak - surround >= looks.min_contrast:
            spots.append(_spot(cut, window, area=area, surround=surround, peak=peak, origin=origin))
    return spots


def _around(box: Sequence[int]) -> Window:
    """Rows and columns of a box (x, y, width, height) with its surroundings."""
    x, y, width, height = box
    return (
        slice(max(y - SURROUND_PX, 0), y + height + SURROUND_PX),
        slice(max(x - SURROUND_PX, 0), x + width + SURROUND_PX),
    )


def _surround(cut: Image) -> float:
    """The level of what surrounds the spot in a cut-out: of its outermost pixels."""
    border = np.concatenate((cut[0], cut[-1], cut[:, 0], cut[:, -1]))
    border.sort()
    return float(border[int(SURROUND_RANK * border.size)])


def _spot(
    cut: Image,
    window: Window,
    *,
    area: float,
    surround: float,
    peak: float,
    origin: tuple[int, int],
) -> Spot:
    """The spot of so many pixels in a window of a picture's part; `origin`: of the part."""
    rows, columns = window
    found = _light_moments(cut, surround, peak)
    light = found["m00"]
    a, b, c = found["mu20"] / light, found["mu11"] / light, found["mu02"] / light
    # Motion at an even speed adds its square over 12 to the second moment along it.
    uneven = math.hypot(0.5 * (a - c), b)
    angle, length = 0.5 * math.atan2(2.0 * b, a - c), math.sqrt(24.0 * uneven)
    return Spot(
        centre=(
            origin[1] + columns.start + found["m10"] / light,
            origin[0] + rows.start + found["m01"] / light,
        ),
        radius=math.sqrt(area / math.pi),
        motion=(length * math.cos(angle), length * math.sin(angle)),
        spread=(0.5 * (a + c) - uneven) * 4.0 * math.pi / area,
        peak=peak,
        surround=surround,
        window=(
            slice(origin[0] + rows.start, origin[0] + rows.stop),
            slice(origin[1] + columns.start, origin[1] + columns.stop),
        ),
    )


def _light_moments(cut: Image, surround: float, peak: float) -> dict[str, float]:
    """Moments of the light above the skirt: no pixel jumps in or out, its weight falls to zero."""
    skirt = surround + SKIRT_SHARE * (peak - surround)
    return cv2.moments(np.maximum(cut - np.float32(skirt), np.float32(0.0)))


SHARP_PX = 1.2
"""Blur of an edge, one standard deviation, that any lens in focus may have."""

LARGEST_SPREAD = 1.7
"""A spot whose light spreads wider than this against its area is no disc, but for its blur."""


@dataclass(frozen=True, slots=True)
class Systematic:
    """What a method leaves beyond the pixels' noise, one standard deviation per axis.

    still_px: grid, uneven ground.  moving: more of it, as a share of the motion in the exposure.
    """

    still_px: float
    moving: float

    def covariance(self, motion: tuple[float, float]) -> Floats:
        """(2, 2) px^2 for a mark that moved so far during the exposure."""
        variance = self.still_px**2 + (self.moving * math.hypot(*motion)) ** 2
        return np.array([[variance, 0.0], [0.0, variance]])


BY_MOMENTS = Systematic(still_px=0.1, moving=0.03)
BY_WEIGHTED_CENTROID = Systematic(still_px=0.03, moving=0.012)
BY_SUBPIXEL_FIT = Systematic(still_px=0.004, moving=0.005)
"""Taken so that the errors in the twin, normalised by what is stated, have the variance of one
(`tests/test_mark.py`)."""


def moments(
    images: Sequence[Image], spots: Sequence[Spot], looks: MarkLooks, noise: PixelNoise
) -> list[Mark]:
    """Centre of the area brighter than half the mark's height: every such pixel counts alike."""
    marks = []
    for image, spot in zip(images, spots, strict=True):
        level = 0.5 * (spot.surround + spot.peak)
        bright = cv2.threshold(image[spot.window], level, 1, cv2.THRESH_BINARY)[1]
        found = cv2.moments(bright, binaryImage=True)
        marks.append(_simple_mark(spot, found, np.zeros((2, 2)), looks, BY_MOMENTS))
    return marks


def weighted_centroid(
    images: Sequence[Image], spots: Sequence[Spot], looks: MarkLooks, noise: PixelNoise
) -> list[Mark]:
    """Centre of the mark's light.

    A pixel that the mark's edge crosses counts by how much of it is lit, which removes most of the
    pixel grid's error, and the weight falls to zero at the skirt, so that no pixel jumps in or out.
    The noise of each pixel moves the centre by its distance from it over all the light.
    """
    marks = []
    for image, spot in zip(images, spots, strict=True):
        cut = image[spot.window]
        found = _light_moments(cut, spot.surround, spot.peak)
        skirt = spot.surround + SKIRT_SHARE * (spot.peak - spot.surround)
        variance = np.where(
            cut > skirt, noise.read_levels**2 + cut / noise.photons_per_level, 0.0
        ) / (found["m00"] ** 2)
        x = np.arange(cut.shape[1]) - found["m10"] / found["m00"]
        y = np.arange(cut.shape[0]) - found["m01"] / found["m00"]
        across = float(y @ variance @ x)
        covariance = np.array(
            [
                [variance.sum(axis=0) @ (x * x), across],
                [across, variance.sum(axis=1) @ (y * y)],
            ]
        )
        marks.append(_simple_mark(spot, found, covariance, looks, BY_WEIGHTED_CENTROID))
    return marks


def _simple_mark(
    spot: Spot,
    found: dict[str, float],
    covariance: Floats,
    looks: MarkLooks,
    systematic: Systematic,
) -> Mark:
    """A mark by moments of its window; its flaw is told by the spread of its light alone."""
    rows, columns = spot.window
    flaw: Flaw | None = None
    if spot.spread > LARGEST_SPREAD:
        flaw = "blurred"
    if math.hypot(*spot.motion) > looks.max_motion_px:
        flaw = "merged"
    return Mark(
        centre=np.array(
            [columns.start + found["m10"] / found["m00"], rows.start + found["m01"] / found["m00"]]
        ),
        covariance=covariance + systematic.covariance(spot.motion),
        radius=spot.radius,
        radius_deviation=0.1,
        blur=spot.blur,
        motion=spot.motion,
        height=spot.height,
        flaw=flaw,
    )


def subpixel_fit(
    images: Sequence[Image], spots: Sequence[Spot], looks: MarkLooks, noise: PixelNoise
) -> list[Mark]:
    """Maximum likelihood of a smeared disc, see `nodes.triangulator.subpixel`."""
    starts = [
        DiscStart(spot.centre, spot.radius, spot.blur, spot.peak, spot.surround, spot.motion)
        for spot in spots
    ]
    marks = []
    for spot, fit in zip(spots, fit_discs(images, starts, noise), strict=True):
        flaw: Flaw | None = None
        if fit.blur > max(looks.max_blur * fit.radius, SHARP_PX):
            flaw = "blurred"
        if (
            not fit.settled
            or fit.misfit > looks.max_misfit
            or math.hypot(*fit.motion) > looks.max_motion_px
        ):
            flaw = "merged"
        marks.append(
            Mark(
                centre=fit.centre,
                covariance=fit.covariance + BY_SUBPIXEL_FIT.covariance(fit.motion),
                radius=fit.radius,
                radius_deviation=0.02,
                blur=fit.blur,
                motion=fit.motion,
                height=spot.height,
                flaw=flaw,
            )
        )
    return marks


MARK_METHODS: dict[str, Refine] = {
    "moments": moments,
    "weighted_centroid": weighted_centroid,
    "subpixel_fit": subpixel_fit,
}
