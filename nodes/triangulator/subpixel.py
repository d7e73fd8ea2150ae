"""The mark's centre by maximum likelihood: a smeared disc fitted to the pixels around it.

The picture of a mark is an even disc, spread by the lens and the pixel's own area, drawn out by its
motion during the exposure, on ground that may slope.  The level at a distance d outside its edge is

    level = ground (1 - S) + mark S,    S = mean over the motion of Phi(-d / blur),

with Phi the normal distribution's integral.  All of it is fitted at once by Gauss and Newton's
method, each pixel weighted by its noise, and the inverse of the Fisher information is the
covariance of the result: the Cramer-Rao bound, if pictures are as the model has it.  Where they are
not, the misfit shows, and its odd part widens the covariance.

Centre and slopes are odd in the picture and all else is even, so that a wrong radius, blur, level
or motion spoils the certainty of the centre, but does not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

X, Y, RADIUS, BLUR, MARK, GROUND, SLOPE_X, SLOPE_Y, MOTION_X, MOTION_Y = range(10)
STILL_PARAMETERS = 8
ODD = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
"""Parameters that change the picture oddly about the disc's centre."""

WHITE = 255
MARGIN_PX = 3.0
LEAST_MARGIN_PX = 1.25
MARGIN_PER_MOTION = 0.5
"""The fit looks so far beyond the disc: enough to know the ground, short of the finger's own edge;
that edge comes nearer by the motion, and is no ground that slopes evenly."""

PRIOR_WEIGHTS = np.array(
    [1e-6, 1e-6, 1.0, 1.0, 200.0**-2, 60.0**-2, 30.0**-2, 30.0**-2, 0.25, 0.25]
)
"""What is believed of the start: so little that it only counts where the pixels say nothing, as of
the level of a mark that is overexposed all over."""

LEAST = np.array([0.5, 0.3])
LARGEST = np.array([40.0, 8.0])
"""Bounds of radius and blur, px."""

MOTION_STEP_PX = 1.8
"""The motion is summed at steps no longer than this; the blur closes the gaps."""

LEAST_MOTION_PX = 2.0
"""A motion too short to be told from blur is not fitted."""

PEAK_OF_NORMAL = 1.0 / math.sqrt(2.0 * math.pi)

ITERATIONS = 8
SETTLED_PX = np.array([0.02, 0.02, 0.05, 0.05])
"""Of centre, radius and blur: a last step as short is the last that is taken.  It leaves its square
over the blur, less than a thousandth of a pixel."""

LARGEST_STEP_PX = 0.7
LARGEST_SHIFT_PX = 2.0
"""A centre that leaves its start by more is not of the disc that was seen."""

LEAST_VARIANCE_RATIO = 0.7
"""The noise that residuals show is believed down to this share of what the sensor's model says."""


@dataclass(frozen=True, slots=True)
class PixelNoise:
    """A sensor's noise: the variance of a level L is read_levels^2 + L / photons_per_level."""

    read_levels: float = 1.5
    photons_per_level: float = 40.0


@dataclass(frozen=True, slots=True)
class DiscStart:
    """Where a fit begins: centre (x, y), radius, blur, motion (x, y) in px; levels of both."""

    centre: tuple[float, float]
    radius: float
    blur: float
    mark: float
    ground: float
    motion: tuple[float, float]


@dataclass(frozen=True, slots=True)
class DiscFit:
    """A fitted disc.

    centre: (2,) px with covariance (2, 2) px^2; radius, blur and motion (x, y) in px.
    height: levels between ground and mark.
    misfit: root mean square of what noise does not explain, as a share of the height.
    settled: false where the fit did not come to rest at a disc.
    """

    centre: Floats
    covariance: Floats
    radius: float
    blur: float
    motion: tuple[float, float]
    height: float
    misfit: float
    settled: bool


def fit_discs(
    pictures: Sequence[Image], starts: Sequence[DiscStart], noise: PixelNoise
) -> list[DiscFit]:
    """Fit one disc in each picture (height, width); all at once, since small arrays cost by call.

    Pixels outside the picture and outside the disc's own surroundings are left out.  One that is
    white counts only while the model is darker than it.
    """
    if not starts:
        return []
    seen = _seen(pictures, starts, noise)
    start = np.array(
        [
            (x, y, one.radius, one.blur, one.mark, one.ground, 0.0, 0.0, *one.motion)
            for one, (x, y) in zip(starts, seen.offsets, strict=True)
        ]
    )
    if max(math.hypot(*one.motion) for one in starts) < LEAST_MOTION_PX:
        start = start[:, :STILL_PARAMETERS]
    solved = _solved(seen, start)
    covariances = np.linalg.inv(solved.information)[:, :RADIUS, :RADIUS]
    shifts = np.abs(solved.found - start)[:, :RADIUS].max(axis=1).tolist()
    return [
        _judged(
            parameters,
            corner,
            covariance,
            fitness,
            settled=solved.settled and shift < LARGEST_SHIFT_PX,
        )
        for parameters, corner, covariance, fitness, shift in zip(
            solved.found.tolist(), seen.corners, covariances, _fitness(solved), shifts, strict=True
        )
    ]


@dataclass(frozen=True, slots=True)
class Solved:
    """Where Gauss and Newton's method ended, and what its last picture was like.

    found: (n, parameters), after the last step, which took `gains` (n, parameters) off the weighted
    squares of the residuals (n, s s), to first order.  weights: (n, s s), of the pixels that
    counted.  information: (n, parameters, parameters).
    """

    found: Floats
    residuals: Floats
    weights: Floats
    information: Floats
    gains: Floats
    settled: bool


def _solved(seen: Seen, start: Floats) -> Solved:
    """The most likely parameters (n, parameters) of the discs, from where they start."""
    believed = PRIOR_WEIGHTS[: start.shape[1]]
    prior = np.diag(believed)
    found, settled, used = start.copy(), False, seen.weights
    for _ in range(ITERATIONS):
        model, slopes = _disc(found, seen.x, seen.y)
        residuals = seen.levels - model
        if seen.white is not None:
            used = np.where(seen.white & (residuals < 0), 0.0, seen.weights)
        weighted = slopes * used[:, None]
        information = weighted @ slopes.transpose(0, 2, 1) + prior
        gradient = (weighted @ residuals[:, :, None])[:, :, 0] - believed * (found - start)
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        shape = step[:, : BLUR + 1]
        np.maximum(np.minimum(shape, LARGEST_STEP_PX), -LARGEST_STEP_PX, out=shape)
        found += step
        bounded = found[:, RADIUS : BLUR + 1]
        np.maximum(np.minimum(bounded, LARGEST), LEAST, out=bounded)
        if (np.abs(shape) < SETTLED_PX).all():
            settled = True
            break
    return Solved(found, residuals, used, information, gradient * step, settled)


def _fitness(solved: Solved) -> list[tuple[float, int, float, float]]:
    """Of each fit: weighted squares of what it leaves, its pixels, the sum of their weights, and
    the noise that the odd part of what it leaves shows, as a ratio of variances.

    That part alone, the difference of pixels that mirror one another in the centre, can have moved
    the centre.
    """
    residuals, weights, gains = solved.residuals, solved.weights, solved.gains
    squares = np.einsum("ni,ni,ni->n", residuals, residuals, weights) - gains.sum(axis=1)
    mirrored = weights[:, ::-1]
    common = weights * mirrored / (weights + mirrored + 1e-300)
    odd = residuals - residuals[:, ::-1]
    is_odd = ODD[: gains.shape[1]]
    odd_squares = np.einsum("ni,ni,ni->n", odd, odd, common) - 2.0 * (gains @ is_odd)
    free = np.maximum(np.count_nonzero(common, axis=1) - 2.0 * is_odd.sum(), 1.0)
    return list(
        zip(
            squares.tolist(),
            np.count_nonzero(weights, axis=1).tolist(),
            weights.sum(axis=1).tolist(),
            (odd_squares / free).tolist(),
            strict=True,
        )
    )


@dataclass(frozen=True, slots=True)
class Seen:
    """Square cut-outs of n pictures, s pixels a side, each around the start of a disc.

    corners: column and row of each cut-out's first pixel, from which its coordinates count.
    offsets: the starting centres in them.  levels, weights: (n, s s).  x: (n, 1, s), y: (n, s, 1).
    white: (n, s s) where a pixel is overexposed; None where none is.
    """

    corners: list[tuple[int, int]]
    offsets: list[tuple[float, float]]
    levels: Floats
    weights: Floats
    x: Floats
    y: Floats
    white: NDArray[np.bool_] | None


def _seen(pictures: Sequence[Image], starts: Sequence[DiscStart], noise: PixelNoise) -> Seen:
    """Cut out what the fit looks at; outside the picture the weight is zero."""
    lengths = [math.hypot(*one.motion) for one in starts]
    reaches = [
        one.radius + max(MARGIN_PX - MARGIN_PER_MOTION * length, LEAST_MARGIN_PX)
        for one, length in zip(starts, lengths, strict=True)
    ]
    half = 1 + int(
        max(reach + 0.5 * length for reach, length in zip(reaches, lengths, strict=True))
    )
    side = 2 * half + 1
    count = len(starts)
    levels, weights = np.zeros((count, side, side)), np.zeros((count, side, side))
    x, y = (
        np.arange(side, dtype=float).reshape(1, side),
        np.arange(side, dtype=float).reshape(side, 1),
    )
    corners, offsets, white = [], [], False
    for i, (picture, one, length) in enumerate(zip(pictures, starts, lengths, strict=True)):
        left, top = round(one.centre[0]) - half, round(one.centre[1]) - half
        centre = (one.centre[0] - left, one.centre[1] - top)
        corners.append((left, top))
        offsets.append(centre)
        rows = slice(max(top, 0), max(top + side, 0))
        columns = slice(max(left, 0), max(left + side, 0))
        part = picture[rows, columns]
        place = (
            slice(rows.start - top, rows.start - top + part.shape[0]),
            slice(columns.start - left, columns.start - left + part.shape[1]),
        )
        levels[i][place] = part
        dx, dy = x - centre[0], y - centre[1]
        if length > LEAST_MOTION_PX:
            along = (dx * one.motion[0] + dy * one.motion[1]) / length**2
            along = np.minimum(np.maximum(along, -0.5), 0.5)
            dx, dy = dx - along * one.motion[0], dy - along * one.motion[1]
        near = dx * dx + dy * dy < reaches[i] ** 2
        weights[i][place] = (near / (noise.read_levels**2 + levels[i] / noise.photons_per_level))[
            place
        ]
        white = white or int(part.max(initial=0)) >= WHITE
    flat = levels.reshape(count, side * side)
    return Seen(
        corners,
        offsets,
        flat,
        weights.reshape(count, side * side),
        x[None],
        y[None],
        flat >= WHITE if white else None,
    )


def _disc(found: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Levels (n, s s) of discs and their slopes (n, parameters, s s).

    x: (1, 1, s), y: (1, s, 1).  Along a motion the disc stands at k places: (n, k, s, s) inside.
    """
    count, parameters = found.shape
    moving = parameters > STILL_PARAMETERS
    side = x.shape[2]
    columns = found.T[:, :, None, None]
    dx, dy = x - columns[X], y - columns[Y]
    radius, inverse = columns[RADIUS][:, None], 1.0 / columns[BLUR][:, None]
    slopes = np.empty((count, parameters, side, side))
    ax, ay, steps = dx[:, None], dy[:, None], 1
    if moving:
        longest = math.sqrt(np.square(found[:, MOTION_X:]).sum(axis=1).max())
        steps = int(longest / MOTION_STEP_PX) + 1
        along = ((np.arange(steps) + 0.5) / steps - 0.5).reshape(1, steps, 1, 1)
        ax = ax - along * columns[MOTION_X][:, None]
        ay = ay - along * columns[MOTION_Y][:, None]
    away = np.sqrt(ax * ax + (ay * ay + 1e-12))
    inward = (radius - away) * inverse
    edge = np.exp(inward * inward * -0.5)
    edge *= (PEAK_OF_NORMAL / steps) * inverse
    share = np.add.reduce(ndtr(inward), axis=1)
    share /= steps
    np.add.reduce(edge, axis=1, out=slopes[:, RADIUS])
    np.add.reduce(edge * -inward, axis=1, out=slopes[:, BLUR])
    edge /= away
    ax, ay = edge * ax, edge * ay
    np.add.reduce(ax, axis=1, out=slopes[:, X])
    np.add.reduce(ay, axis=1, out=slopes[:, Y])
    ground = columns[GROUND] + (columns[SLOPE_X] * dx + columns[SLOPE_Y] * dy)
    height = columns[MARK] - ground
    if moving:
        np.add.reduce(along * ax, axis=1, out=slopes[:, MOTION_X])
        np.add.reduce(along * ay, axis=1, out=slopes[:, MOTION_Y])
        slopes[:, MOTION_X:] *= height[:, None]
    slopes[:, :MARK] *= height[:, None]
    slopes[:, MARK] = share
    left = np.subtract(1.0, share, out=slopes[:, GROUND])
    np.multiply(left, dx, out=slopes[:, SLOPE_X])
    np.multiply(left, dy, out=slopes[:, SLOPE_Y])
    levels = ground + share * height
    return levels.reshape(count, side * side), slopes.reshape(count, parameters, side * side)


def _judged(
    found: list[float],
    corner: tuple[int, int],
    covariance: Floats,
    fitness: tuple[float, int, float, float],
    *,
    settled: bool,
) -> DiscFit:
    """What a fit came to: its covariance widened by what the noise does not explain.

    fitness: as `_fitness` gives it.
    """
    squares, pixels, weight, ratio = fitness
    x, y, radius, blur, mark, ground, _, _, *motion = found
    height = mark - ground
    excess = max(squares - pixels, 0.0) / max(weight, 1e-12)
    return DiscFit(
        centre=np.array([corner[0] + x, corner[1] + y]),
        covariance=covariance * max(ratio, LEAST_VARIANCE_RATIO),
        # A round edge that is blurred looks as if it lay blur^2 / 2 radius further in.
        radius=radius + 0.5 * blur * blur / radius,
        blur=blur,
        motion=(motion[0], motion[1]) if motion else (0.0, 0.0),
        height=height,
        misfit=math.sqrt(excess) / max(abs(height), 1e-6),
        settled=settled and height > 0.0,
    )
