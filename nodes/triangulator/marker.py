"""Detect blobs that may be the fingertip's marker, and refine their centres to subpixel accuracy.

Pixel coordinates have their origin at the centre of the top left pixel, with x to the right and y
down. A marker is a small bright disc, blurred by its motion during the exposure. `detect_blobs`
finds all bright blobs that have about the size of a marker. `subpixel_fit` then computes the
centres of the likely blobs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.triangulator.subpixel import (
    DiscFit,
    DiscStart,
    PixelNoise,
    fit_discs,
    fit_ellipses,
)

Window = tuple[slice, slice]
"""The rows and columns of a rectangular part of an image."""

NEIGHBOURHOOD_PX = 31
"""The side of the square around a pixel whose mean grey level is the threshold for this pixel."""

SURROUND_PX = 3
"""The width of the border around a blob. The border's outermost pixels determine the grey level of
the blob's surroundings."""

SURROUND_RANK = 0.75
"""The quantile of the surrounding pixels that is used as the grey level of the surroundings. A high
quantile is necessary if the bright finger is on only one side of the marker."""

SKIRT_FRACTION = 0.1
"""The fraction of the marker's height (its grey levels above its surroundings) below which the
light of a pixel is ignored as noise."""

MAX_REGIONS = 64
"""The maximum number of bright regions that are searched in an image, largest first."""

WHITE_LEVEL = 250
"""The minimum grey level of a white pixel."""

WHITE_FRACTION = 0.2
"""The fraction of white pixels above which an image is overexposed."""


@dataclass(frozen=True, slots=True)
class BlobFilter:
    """The criteria for blobs that may be a marker.

    min_contrast: minimum difference of grey levels between a blob's brightest pixel and its
        surroundings.
    min_area_px, max_area_px: limits on the number of pixels above half the contrast.
    window_half_px: half the side of the smallest search window around an expected position.
    """

    min_contrast: float = 60.0
    min_area_px: int = 4
    max_area_px: int = 1500
    window_half_px: int = 16


@dataclass(frozen=True, slots=True)
class Blob:
    """A bright blob that may be a marker. Lengths are in pixels of the searched image.

    centre: centroid of the blob's light.
    radius: radius of the disc with the same area as the pixels that are brighter than the mean of
        `peak` and `surround`.
    motion: displacement (x, y) during the exposure, estimated from the second moments of the light.
    spread: second moment of the light in its narrowest direction, relative to a uniform disc of
        this radius.
    peak, surround: grey levels of the brightest pixel and of the surroundings.
    window: part of the image that contains the blob and its surroundings.
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
        """Return the standard deviation (px) of the edge blur, estimated from the spread."""
        return min(max(0.5 * self.radius * math.sqrt(max(self.spread - 0.85, 0.0)), 0.6), 3.0)

    @property
    def height(self) -> float:
        """Return the difference of grey levels between the peak and the surroundings."""
        return self.peak - self.surround


MarkerRejection = Literal["merged", "blurred"]


@dataclass(frozen=True, slots=True)
class Marker:
    """A marker in an image, refined to subpixel accuracy.

    centre, covariance: centre (2,), px, and its covariance (2, 2), px^2.
    radius: radius of the disc, or mean semi-axis of the ellipse, px.
    radius_deviation: standard deviation of the estimated radius, as a fraction of the radius.
    blur: standard deviation of the edge blur, px.
    motion: displacement (x, y) during the exposure, px. Its sign cannot be determined.
    elongation: vector (e, f), px, for a flat marker that is seen at an angle; see the module
        `ellipse`.
    height: difference of grey levels between the marker and its surroundings.
    rejection_reason: reason why the blob is not a marker; None if the marker is valid.
    """

    centre: Floats
    covariance: Floats
    radius: float
    radius_deviation: float
    blur: float
    motion: tuple[float, float]
    height: float
    rejection_reason: MarkerRejection | None
    elongation: tuple[float, float] = (0.0, 0.0)


def window_around(pixel: Floats, shape: tuple[int, ...], half_px: int) -> Window | None:
    """Return the square window around a pixel (x, y), clipped to the image.

    shape: size (height, width) of the image.
    half_px: number of pixels by which the window extends on each side.

    Returns None if the window is outside the image.
    """
    x, y = pixel.tolist()
    if not abs(x) + abs(y) < 1e6:  # also rejects NaN
        return None
    column, row = round(x), round(y)
    rows = slice(max(row - half_px, 0), min(row + half_px + 1, shape[0]))
    columns = slice(max(column - half_px, 0), min(column + half_px + 1, shape[1]))
    outside = rows.start >= rows.stop or columns.start >= columns.stop
    return None if outside else (rows, columns)


def is_overexposed(image: Image, window: Window | None = None) -> bool:
    """Return whether an image, or a window of it, contains too many white pixels."""
    part = image if window is None else image[window]
    white = cv2.threshold(part, WHITE_LEVEL - 1, 1, cv2.THRESH_BINARY)[1]
    return bool(cv2.countNonZero(white) > WHITE_FRACTION * part.size)


def detect_blobs(image: Image, blob_filter: BlobFilter, window: Window | None = None) -> list[Blob]:
    """Detect all blobs in an image, or in a window of it, that may be a marker.

    Regions that are brighter than the mean of their neighbourhood are searched. In each region, the
    pixels above half the contrast form blobs. The two thresholds find a marker on a bright finger
    or next to a brighter spot. Blobs at the image border are dropped.
    """
    top, left = (0, 0) if window is None else (window[0].start, window[1].start)
    part = image if window is None else image[window]
    bright = cv2.adaptiveThreshold(
        part,
        255,
        cv2.ADAPTIVE_THRESH_MEAN_C,
        cv2.THRESH_BINARY,
        NEIGHBOURHOOD_PX,
        -0.5 * blob_filter.min_contrast,
    )
    regions = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if len(regions) > MAX_REGIONS:
        regions = sorted(regions, key=len)[-MAX_REGIONS:]
    blobs = []
    for region in regions:
        if _count_pixels(region) >= blob_filter.min_area_px:
            blobs += _detect_in_box(part, cv2.boundingRect(region), blob_filter, (top, left))
    return blobs


def _count_pixels(outline: cv2.typing.MatLike) -> float:
    """Return the number of pixels that an outline encloses, including the outline itself.

    outline: pixel centres of the outline. The number follows from Pick's theorem.
    """
    return cv2.contourArea(outline) + 0.5 * len(outline) + 1.0


def _detect_in_box(
    part: Image, box: Sequence[int], blob_filter: BlobFilter, origin: tuple[int, int]
) -> list[Blob]:
    """Detect the blobs in a box (x, y, width, height), px, of a crop of the image.

    part, origin: the crop, and row and column of its first pixel in the image. Blobs are returned
        in coordinates of the image.
    """
    rows, columns = _add_border(box)
    cut = part[rows, columns]
    surround, peak = _surround_level(cut), cv2.minMaxLoc(cut)[1]
    if peak - surround < blob_filter.min_contrast:
        return []
    half = cv2.threshold(cut, 0.5 * (surround + peak), 255, cv2.THRESH_BINARY)[1]
    blobs = []
    for outline in cv2.findContours(half, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        area = _count_pixels(outline)
        if not blob_filter.min_area_px <= area <= blob_filter.max_area_px:
            continue
        x, y, width, height = cv2.boundingRect(outline)
        x, y = x + columns.start, y + rows.start
        if x == 0 or y == 0 or x + width == part.shape[1] or y + height == part.shape[0]:
            continue
        window = _add_border((x, y, width, height))
        cut = part[window]
        surround, peak = _surround_level(cut), cv2.minMaxLoc(cut)[1]
        if peak - surround >= blob_filter.min_contrast:
            blobs.append(
                _make_blob(cut, window, area=area, surround=surround, peak=peak, origin=origin)
            )
    return blobs


def _add_border(box: Sequence[int]) -> Window:
    x, y, width, height = box
    return (
        slice(max(y - SURROUND_PX, 0), y + height + SURROUND_PX),
        slice(max(x - SURROUND_PX, 0), x + width + SURROUND_PX),
    )


def _surround_level(cut: Image) -> float:
    border = np.concatenate((cut[0], cut[-1], cut[:, 0], cut[:, -1]))
    border.sort()
    return float(border[int(SURROUND_RANK * border.size)])


def _make_blob(
    cut: Image,
    window: Window,
    *,
    area: float,
    surround: float,
    peak: float,
    origin: tuple[int, int],
) -> Blob:
    """Return the position, size and motion blur of the blob in a window of an image.

    cut: pixels of the window.
    window: rows and columns of the window in the searched part of the image.
    area: number of pixels above half the blob's height (its grey levels above its surroundings).
    surround, peak: grey levels of the surroundings and of the brightest pixel.
    origin: row and column of the first pixel of the searched part in the image.
    """
    rows, columns = window
    skirt = np.float32(surround + SKIRT_FRACTION * (peak - surround))
    found = cv2.moments(np.maximum(cut - skirt, np.float32(0.0)))
    light = found["m00"]
    a, b, c = found["mu20"] / light, found["mu11"] / light, found["mu02"] / light
    # A motion of length l at constant speed adds l^2 / 12 to the second moment along it.
    uneven = math.hypot(0.5 * (a - c), b)
    angle, length = 0.5 * math.atan2(2.0 * b, a - c), math.sqrt(24.0 * uneven)
    return Blob(
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


MAX_MOTION_PX = 9.0
"""The maximum motion of a marker during an exposure."""

MAX_BLUR = 0.5
"""The maximum standard deviation of the blur of a marker's edge, as a fraction of the radius."""

MAX_MISFIT = 0.04
"""The maximum root mean square residual of a fitted disc, as a fraction of the marker's height (its
grey levels above its surroundings)."""

SHARP_PX = 1.2
"""The maximum standard deviation of the edge blur at which a marker is in focus."""


STILL_ERROR_PX, MOVING_ERROR = 0.004, 0.005
"""The standard deviations of the errors of a fitted centre that do not come from image noise, in
each image direction: for a marker at rest (px), and as a fraction of the motion during the exposure
(`tests/test_marker.py` measures them in simulations)."""


def subpixel_fit(images: Sequence[Image], blobs: Sequence[Blob], noise: PixelNoise) -> list[Marker]:
    """Refine blobs by a maximum-likelihood fit of a motion-blurred disc (module `subpixel`)."""
    return [
        _make_marker(
            blob,
            fit,
            fit.motion,
            is_blurred=fit.blur > max(MAX_BLUR * fit.radius, SHARP_PX),
            is_merged=fit.misfit > MAX_MISFIT or math.hypot(*fit.motion) > MAX_MOTION_PX,
        )
        for blob, fit in zip(blobs, fit_discs(images, _fit_starts(blobs), noise), strict=True)
    ]


def _make_marker(
    blob: Blob, fit: DiscFit, motion: tuple[float, float], *, is_blurred: bool, is_merged: bool
) -> Marker:
    """Make a marker from the result of a fit.

    motion: motion (x, y) during the exposure, px, which increases the systematic error.
    is_blurred: whether to reject the marker because it is out of focus.
    is_merged: whether to reject the marker because it is merged with another spot.
    """
    rejection_reason: MarkerRejection | None = "blurred" if is_blurred else None
    variance = STILL_ERROR_PX**2 + (MOVING_ERROR * math.hypot(*motion)) ** 2
    return Marker(
        centre=fit.centre,
        covariance=fit.covariance + np.array([[variance, 0.0], [0.0, variance]]),
        radius=fit.radius,
        radius_deviation=0.02,
        blur=fit.blur,
        motion=fit.motion,
        height=blob.height,
        rejection_reason="merged" if is_merged or not fit.converged else rejection_reason,
        elongation=fit.elongation,
    )


MAX_ELLIPSE_MISFIT = 0.035
"""The maximum root mean square residual of a fitted ellipse, as a fraction of the marker's contrast
to its surroundings. The limit is stricter than the limit of the disc fit, because an ellipse can
also fit a partly covered disc well."""

MAX_ODD_MISFIT = 0.03
"""The maximum odd (antisymmetric about the centre) part of the residual of an ellipse fit, as a
fraction of the marker's height. A partly covered disc has larger odd residuals."""


def fit_flat_markers(
    images: Sequence[Image], blobs: Sequence[Blob], noise: PixelNoise
) -> list[Marker]:
    """Refine blobs as flat round markers, whose images are ellipses.

    An ellipse without motion blur is fitted to each blob by maximum likelihood.
    """
    return [
        _make_marker(
            blob,
            fit,
            blob.motion,
            is_blurred=fit.blur
            > max(MAX_BLUR * (fit.radius - math.hypot(*fit.elongation)), SHARP_PX),
            is_merged=fit.misfit > MAX_ELLIPSE_MISFIT or fit.odd_misfit > MAX_ODD_MISFIT,
        )
        for blob, fit in zip(blobs, fit_ellipses(images, _fit_starts(blobs), noise), strict=True)
    ]


def _fit_starts(blobs: Sequence[Blob]) -> list[DiscStart]:
    return [
        DiscStart(blob.centre, blob.radius, blob.blur, blob.peak, blob.surround, blob.motion)
        for blob in blobs
    ]
