"""Estimate a marker's centre by maximum likelihood: fit a motion-blurred disc to its pixels.

The model of the image is a uniform disc on a background ("ground") with a constant gradient. The
lens, the pixel's area and the motion during the exposure blur the disc. At the distance d outside
the disc's edge, a pixel has the grey level

    level = ground (1 - S) + marker S,    S = mean over the motion of Phi(-d / blur).

Here ground and marker are grey levels, S is the fraction of the pixel that the disc covers, and Phi
is the normal cumulative distribution. A Gauss-Newton method fits all parameters at once, with each
pixel weighted by its noise. The covariance of the result is the inverse of the Fisher information
(Cramer-Rao bound). If the image deviates from the model, the odd (antisymmetric) part of the
residuals about the centre increases the covariance.

A flat marker that is seen at an angle is an ellipse. `fit_ellipses` fits the elongation instead of
the motion. The module `ellipse` computes the exact image of an ellipse.

The derivatives of the image with respect to the centre and the ground's gradient are odd about the
centre, and all other derivatives are even. Errors of radius, blur, level or motion therefore do not
change the centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from flexsheet.nodes.arrays import Bools, Floats, Image
from flexsheet.nodes.triangulator.ellipse import integrate_ellipse

X, Y, RADIUS, BLUR, MARKER, GROUND, SLOPE_X, SLOPE_Y, MOTION_X, MOTION_Y = range(10)
STILL_PARAMETERS = 8
ELONGATION = slice(8, 10)
ELLIPSE = [X, Y, RADIUS, BLUR, 8, 9]
"""The indices of an ellipse's shape parameters in the parameter vector of a fit. Entries 8 and 9
are the elongation of an ellipse, or the motion blur of a disc."""

ODD = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
"""The symmetry of each parameter: 1 if the derivative of the image is odd about the disc's centre,
otherwise 0."""

WHITE = 255
MARGIN_PX = 3.0
"""The width of the border that the fit uses around a disc at rest. The finger's edge, where the
background is not linear, is farther away."""

MIN_MARGIN_PX = 1.25
"""The minimum width of the border that the fit uses around a moving disc."""

MARGIN_PER_MOTION = 0.5
"""The reduction of the width of the border around a disc, as a fraction of the disc's motion during
the exposure."""

PRIOR_WEIGHTS = np.array(
    [1e-6, 1e-6, 1.0, 1.0, 200.0**-2, 60.0**-2, 30.0**-2, 30.0**-2, 0.25, 0.25]
)
"""The inverse variances of the parameters' starting values. The starting values only affect
parameters that the pixels do not determine, such as the level of a saturated marker."""

MIN_SHAPE = np.array([0.5, 0.3])
"""The lower bounds (px) on the radius and the blur of a fitted disc."""

MAX_SHAPE = np.array([40.0, 8.0])
"""The upper bounds (px) on the radius and the blur of a fitted disc."""

MAX_ELONGATION = 0.6
"""The maximum ratio of an ellipse's elongation to its radius. At this ratio, the minor axis is a
quarter of the major axis."""

START_ELONGATION = 0.45
"""The maximum ratio of an ellipse's elongation to its radius in the starting values of the fit."""

ELLIPSE_BLUR_PX = 0.8
"""The starting value for the blur of an ellipse. The spread of a blob does not determine it."""

MOTION_STEP_PX = 1.8
"""The maximum distance between the positions over which the image of a moving disc is averaged."""

MIN_MOTION_PX = 2.0
"""The minimum motion that is fitted. A shorter motion cannot be distinguished from blur."""

PEAK_OF_NORMAL = 1.0 / math.sqrt(2.0 * math.pi)

ITERATIONS = 8
CONVERGED_STEP_PX = np.array([0.02, 0.02, 0.05, 0.05])
"""The step sizes of centre (x, y), radius and blur below which a fit counts as converged. The
remaining error (squared step divided by blur) is less than 0.001 px."""

CONVERGED_ELONGATION_PX = 0.05
"""The step size of the elongation below which the fit of an ellipse counts as converged."""

MAX_STEP_PX = 0.7
"""The maximum change of a shape parameter in one step of the fit."""

MAX_SHIFT_PX = 2.0
"""The maximum distance of a fitted centre from its starting value."""

MIN_VARIANCE_RATIO = 0.7
"""The minimum ratio of the noise variance that is estimated from the residuals to the noise
variance of the sensor model."""


@dataclass(frozen=True, slots=True)
class PixelNoise:
    """The noise of an image sensor.

    The variance of a grey level L is read_levels^2 + L / photons_per_level.

    read_levels: standard deviation of the read noise, grey levels.
    photons_per_level: number of photons that one grey level represents.
    """

    read_levels: float = 1.5
    photons_per_level: float = 40.0


@dataclass(frozen=True, slots=True)
class DiscStart:
    """The starting values of a fit: centre (x, y), radius, blur and motion (x, y), px.

    marker, ground: grey levels of the disc and of the background.
    """

    centre: tuple[float, float]
    radius: float
    blur: float
    marker: float
    ground: float
    motion: tuple[float, float]


@dataclass(frozen=True, slots=True)
class DiscFit:
    """The result of fitting a disc or an ellipse to an image.

    centre: centre (2,), px, with its covariance (2, 2), px^2.
    radius: radius of a disc, or mean semi-axis of an ellipse, px.
    blur, motion: standard deviation of the edge blur, and motion (x, y) during the exposure, px.
    elongation: elongation (e, f), px, of an ellipse; see the module `ellipse`.
    height: difference of the grey levels of marker and ground.
    misfit: root mean square residual in excess of the noise, as a fraction of the height.
    odd_misfit: misfit of the part of the residuals that is odd (antisymmetric) about the centre.
    converged: whether the fit has converged to a disc that is brighter than the ground.
    """

    centre: Floats
    covariance: Floats
    radius: float
    blur: float
    motion: tuple[float, float]
    elongation: tuple[float, float]
    height: float
    misfit: float
    odd_misfit: float
    converged: bool


RenderDiscs = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]
"""A function of parameters (n, parameters) and of pixel coordinates x and y. It returns the grey
levels of n discs or ellipses, and the derivatives with respect to the parameters."""


def fit_discs(
    images: Sequence[Image], starts: Sequence[DiscStart], noise: PixelNoise
) -> list[DiscFit]:
    """Fit one disc in each image (height, width).

    starts: starting values, one per image.
    noise: noise of the image sensor.

    Pixels outside the image and outside the disc's surroundings are excluded. A saturated (white)
    pixel is used only in iterations in which the model is darker than the pixel.
    """
    if not starts:
        return []
    cutouts = _cut_out_discs(images, starts, noise)
    start = np.array(
        [
            (x, y, one.radius, one.blur, one.marker, one.ground, 0.0, 0.0, *one.motion)
            for one, (x, y) in zip(starts, cutouts.offsets, strict=True)
        ]
    )
    if max(math.hypot(*one.motion) for one in starts) < MIN_MOTION_PX:
        start = start[:, :STILL_PARAMETERS]
    return _fit(cutouts, start, _render_disc)


def fit_ellipses(
    images: Sequence[Image], starts: Sequence[DiscStart], noise: PixelNoise
) -> list[DiscFit]:
    """Fit one ellipse without motion blur in each image (height, width).

    starts: starting values of discs with motion blur. Each ellipse starts with the same second
        moments as the corresponding disc.

    A joint fit would use the window size of the largest ellipse for all ellipses. Therefore each
    ellipse is fitted separately.
    """
    found = []
    for image, one in zip(images, starts, strict=True):
        cutouts = _cut_out_discs([image], [one], noise)
        shape = (*cutouts.offsets[0], one.radius, ELLIPSE_BLUR_PX)
        start = np.array([(*shape, one.marker, one.ground, 0.0, 0.0, *_elongation(one))])
        found += _fit(cutouts, start, _render_ellipse)
    return found


def _fit(cutouts: DiscCutouts, start: Floats, render: RenderDiscs) -> list[DiscFit]:
    solved = _solve(cutouts, start, render)
    covariances = np.linalg.inv(solved.information)[:, :RADIUS, :RADIUS]
    shifts = np.abs(solved.found - start)[:, :RADIUS].max(axis=1).tolist()
    return [
        _make_fit(
            parameters,
            corner,
            covariance,
            fitness,
            is_ellipse=render is _render_ellipse,
            converged=converged and shift < MAX_SHIFT_PX,
        )
        for parameters, corner, covariance, fitness, shift, converged in zip(
            solved.found.tolist(),
            cutouts.corners,
            covariances,
            _fit_residuals(solved),
            shifts,
            solved.converged.tolist(),
            strict=True,
        )
    ]


@dataclass(frozen=True, slots=True)
class DiscSolution:
    """The result of the Gauss-Newton iteration for n discs in cut-outs of s x s pixels.

    found: parameters (n, parameters) after the last step.
    residuals: differences (n, s * s) between image and model before the last step.
    weights: inverse noise variances (n, s * s) of the pixels; zero for excluded pixels.
    information: Fisher information plus prior (n, parameters, parameters).
    gains: decrease (n, parameters) of the weighted squared residuals in the last step, to first
        order. It is the contribution of each parameter.
    converged: whether each disc (n,) has converged.
    """

    found: Floats
    residuals: Floats
    weights: Floats
    information: Floats
    gains: Floats
    converged: Bools


def _solve(cutouts: DiscCutouts, start: Floats, render: RenderDiscs) -> DiscSolution:
    """Find the most likely parameters of n discs or ellipses by the Gauss-Newton method.

    start: starting values (n, parameters).
    """
    prior_weights = PRIOR_WEIGHTS[: start.shape[1]]
    prior = np.diag(prior_weights)
    found, used = start.copy(), cutouts.weights
    for _ in range(ITERATIONS):
        model, slopes = render(found, cutouts.x, cutouts.y)
        residuals = cutouts.levels - model
        if cutouts.white is not None:
            used = np.where(cutouts.white & (residuals < 0), 0.0, cutouts.weights)
        weighted = slopes * used[:, None]
        information = weighted @ slopes.transpose(0, 2, 1) + prior
        gradient = (weighted @ residuals[:, :, None])[:, :, 0] - prior_weights * (found - start)
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        shape = step[:, : BLUR + 1]
        np.maximum(np.minimum(shape, MAX_STEP_PX), -MAX_STEP_PX, out=shape)
        found += step
        bounded = found[:, RADIUS : BLUR + 1]
        np.maximum(np.minimum(bounded, MAX_SHAPE), MIN_SHAPE, out=bounded)
        converged = (np.abs(shape) < CONVERGED_STEP_PX).all(axis=1)
        if render is _render_ellipse:
            _bound_elongation(found)
            converged &= (np.abs(step[:, ELONGATION]) < CONVERGED_ELONGATION_PX).all(axis=1)
        if converged.all():
            break
    return DiscSolution(found, residuals, used, information, gradient * step, converged)


def _fit_residuals(solved: DiscSolution) -> list[tuple[float, int, float, float]]:
    """Return four numbers that describe the residuals of each fit.

    The numbers are the weighted sum of squared residuals, the number of pixels, the sum of the
    weights, and a variance ratio. For the ratio, the differences between pixels that are mirrored
    about the centre are used. Their variance is divided by the variance that the sensor noise would
    cause.
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
class DiscCutouts:
    """Cut-outs (s x s pixels) of n images around the starting centres of discs.

    corners: column and row of the first pixel of each cut-out in its image.
    offsets: starting centres of the discs, relative to the first pixels of their cut-outs.
    levels, weights: grey levels (n, s * s) of the pixels, and inverses of their noise variances.
    x, y: coordinates of the pixels in a cut-out, as arrays (1, 1, s) and (1, s, 1).
    white: array (n, s * s), True if a pixel is saturated; None if no pixel is saturated.
    """

    corners: list[tuple[int, int]]
    offsets: list[tuple[float, float]]
    levels: Floats
    weights: Floats
    x: Floats
    y: Floats
    white: Bools | None


def _cut_out_discs(
    images: Sequence[Image], starts: Sequence[DiscStart], noise: PixelNoise
) -> DiscCutouts:
    """Cut a window around each disc out of the images.

    The weight of a pixel in the fit is 0 if the pixel is outside the image. It is also 0 if its
    distance from the disc exceeds the border width, which is `MARGIN_PX` for a disc at rest.
    """
    lengths = [math.hypot(*one.motion) for one in starts]
    reaches = [
        one.radius + max(MARGIN_PX - MARGIN_PER_MOTION * length, MIN_MARGIN_PX)
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
    for i, (image, one, length) in enumerate(zip(images, starts, lengths, strict=True)):
        left, top = round(one.centre[0]) - half, round(one.centre[1]) - half
        centre = (one.centre[0] - left, one.centre[1] - top)
        corners.append((left, top))
        offsets.append(centre)
        rows = slice(max(top, 0), max(top + side, 0))
        columns = slice(max(left, 0), max(left + side, 0))
        part = image[rows, columns]
        inside = (
            slice(rows.start - top, rows.start - top + part.shape[0]),
            slice(columns.start - left, columns.start - left + part.shape[1]),
        )
        levels[i][inside] = part
        dx, dy = x - centre[0], y - centre[1]
        if length > MIN_MOTION_PX:
            along = (dx * one.motion[0] + dy * one.motion[1]) / length**2
            along = np.minimum(np.maximum(along, -0.5), 0.5)
            dx, dy = dx - along * one.motion[0], dy - along * one.motion[1]
        near = dx * dx + dy * dy < reaches[i] ** 2
        weights[i][inside] = (near / (noise.read_levels**2 + levels[i] / noise.photons_per_level))[
            inside
        ]
        white = white or int(part.max(initial=0)) >= WHITE
    flat = levels.reshape(count, side * side)
    return DiscCutouts(
        corners,
        offsets,
        flat,
        weights.reshape(count, side * side),
        x[None],
        y[None],
        flat >= WHITE if white else None,
    )


def _render_disc(found: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the grey levels (n, s * s) of n discs in s x s pixels, and their derivatives.

    The derivatives have the shape (n, parameters, s * s).

    found: parameters (n, parameters) of the discs.
    x, y: coordinates of the pixels, as arrays (1, 1, s) and (1, s, 1).

    A moving (motion-blurred) disc is averaged over k positions, in arrays (n, k, s, s).
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
    coverage = np.add.reduce(scipy.special.ndtr(inward), axis=1)
    coverage /= steps
    np.add.reduce(edge, axis=1, out=slopes[:, RADIUS])
    np.add.reduce(edge * -inward, axis=1, out=slopes[:, BLUR])
    edge /= away
    ax, ay = edge * ax, edge * ay
    np.add.reduce(ax, axis=1, out=slopes[:, X])
    np.add.reduce(ay, axis=1, out=slopes[:, Y])
    ground = columns[GROUND] + (columns[SLOPE_X] * dx + columns[SLOPE_Y] * dy)
    height = columns[MARKER] - ground
    if moving:
        np.add.reduce(along * ax, axis=1, out=slopes[:, MOTION_X])
        np.add.reduce(along * ay, axis=1, out=slopes[:, MOTION_Y])
        slopes[:, MOTION_X:] *= height[:, None]
    slopes[:, :MARKER] *= height[:, None]
    slopes[:, MARKER] = coverage
    uncovered = np.subtract(1.0, coverage, out=slopes[:, GROUND])
    np.multiply(uncovered, dx, out=slopes[:, SLOPE_X])
    np.multiply(uncovered, dy, out=slopes[:, SLOPE_Y])
    levels = ground + coverage * height
    return levels.reshape(count, side * side), slopes.reshape(count, parameters, side * side)


def _render_ellipse(found: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the grey levels (n, s * s) of n ellipses in s x s pixels, and their derivatives.

    The derivatives have the shape (n, parameters, s * s).

    found: parameters (n, parameters) of the ellipses.
    x, y: coordinates of the pixels, as arrays (1, 1, s) and (1, s, 1).
    """
    x, y = (each.ravel() for each in np.broadcast_arrays(x[0], y[0]))
    coverage, by_shape = integrate_ellipse(found[:, ELLIPSE], x, y)
    columns = found.T[:, :, None]
    dx, dy = x - columns[X], y - columns[Y]
    ground = columns[GROUND] + (columns[SLOPE_X] * dx + columns[SLOPE_Y] * dy)
    height = columns[MARKER] - ground
    slopes = np.empty((*found.shape, x.size))
    slopes[:, ELLIPSE] = by_shape * height[:, None]
    slopes[:, MARKER] = coverage
    slopes[:, GROUND] = 1.0 - coverage
    slopes[:, SLOPE_X] = slopes[:, GROUND] * dx
    slopes[:, SLOPE_Y] = slopes[:, GROUND] * dy
    return ground + coverage * height, slopes


def _elongation(start: DiscStart) -> tuple[float, float]:
    """Return the elongation of an ellipse with the same second moments as a disc in motion.

    The elongation (e, f), px, has the direction of twice the angle of the long axis. Its length is
    half the difference of the semi-axes.
    """
    length = math.hypot(*start.motion)
    if length == 0.0:
        return 0.0, 0.0
    # Motion adds length^2 / 12 to the variance along it; an ellipse's semi-axis a gives a^2 / 4.
    excess_px = min(length**2 / (12.0 * start.radius), START_ELONGATION * start.radius)
    cosine, sine = start.motion[0] / length, start.motion[1] / length
    return excess_px * (cosine**2 - sine**2), 2.0 * excess_px * cosine * sine


def _bound_elongation(found: Floats) -> None:
    """Limit the elongations of ellipses to MAX_ELONGATION, in place.

    found: parameters (n, parameters) of the ellipses.
    """
    elongation = found[:, ELONGATION]
    length = np.maximum(np.hypot(*elongation.T), 1e-12)
    elongation *= np.minimum(MAX_ELONGATION * found[:, RADIUS] / length, 1.0)[:, None]


def _make_fit(
    found: list[float],
    corner: tuple[int, int],
    covariance: Floats,
    fitness: tuple[float, int, float, float],
    *,
    is_ellipse: bool,
    converged: bool,
) -> DiscFit:
    """Return the result of one fit, with the covariance scaled to the residuals.

    found: fitted parameters.
    corner: column and row of the window's first pixel in the image.
    fitness: four numbers that describe the residuals, as computed by `_fit_residuals`.
    """
    squares, pixels, weight, ratio = fitness
    x, y, radius, blur, marker, ground, _, _, *others = found
    motion, elongation = (0.0, 0.0), (0.0, 0.0)
    if is_ellipse:
        elongation = (others[0], others[1])
    elif others:
        motion = (others[0], others[1])
    height = marker - ground
    excess = max(squares - pixels, 0.0) / max(weight, 1e-12)
    return DiscFit(
        centre=np.array([corner[0] + x, corner[1] + y]),
        covariance=covariance * max(ratio, MIN_VARIANCE_RATIO),
        # In the disc model, blur makes the radius too small by blur^2 / (2 radius).  The model of
        # an ellipse is exact.
        radius=radius if is_ellipse else radius + 0.5 * blur * blur / radius,
        blur=blur,
        motion=motion,
        elongation=elongation,
        height=height,
        misfit=math.sqrt(excess) / max(abs(height), 1e-6),
        odd_misfit=math.sqrt(max(ratio - 1.0, 0.0) * pixels / max(weight, 1e-12))
        / max(abs(height), 1e-6),
        converged=converged and height > 0.0,
    )
