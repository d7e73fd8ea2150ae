"""Fit the marker's position on the finger to touches of known points in several orientations.

The measured centre of the marker is p + e + R o + b + noise. Here, p is the assumed position of the
touched point, and e is its error, which is the same in all touches of this point. R is the finger's
orientation, and o is the unknown offset of the marker in the finger's frame. The error b is the
same in all touches in one orientation. It occurs because the detected centre of a tilted marker is
biased. A touched plane, such as the sheet, only determines the component along its normal.

This is a linear model with random effects e and b. The variances of e and b and the offset o are
estimated by restricted maximum likelihood with prior distributions. The covariance of the offset
therefore follows from the residuals (Searle, Casella and McCulloch 1992, chapter 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats

TOUCH_NOISE_M, ORIENTATION_ERROR_M, POINT_ERROR_M = 2e-4, 1e-4, 1e-4
"""The expected standard deviations (m) per axis of three kinds of errors.

The first is the error of a single touch. The second is the error that is the same in all touches in
one orientation. The third is the error of the position of a touched point.
"""

COMMON_ERROR_M = 6.5e-5
"""The standard deviation (m) per axis of the error that is the same in all touches.

The residuals do not show this error. Its causes are the mean bias of the detected centre of a
tilted marker and the stereo calibration. With this value, the error that the fit states is equal to
the true error in simulated laboratories with seeds 0 to 11.
"""

PRIOR_STD_LN = np.array([0.5, 0.7, 0.4])
"""The prior uncertainties (3,) of three standard deviations, on a logarithmic scale.

The three standard deviations are of the errors of touches, orientations and points.
"""

POINT_GRID_M = 1e-6
"""Touched points are the same if their positions are equal after rounding to this grid (m)."""

MIN_TOUCHES, MIN_ORIENTATIONS = 4, 3
MIN_ANGLE_RAD = np.radians(8.0)
"""Two orientations are different if the angle (rad) between them is at least this value."""

MAX_DEVIATION_M = 5e-4
"""A fit is valid if the standard deviation (m) of each marker coordinate is at most this value."""

MAX_RESIDUAL_M = 1e-3
"""A fit is valid if the root mean square (m) of its residuals is at most this value."""

MAX_CONDITION = 1e6
"""The maximum condition number of the matrix of the linear fit.

If the condition number is larger, the touches do not determine all components of the marker's
offset.
"""

MAX_OFFSET_M = 0.05
"""The maximum plausible distance (m) between the marker and the finger's pad."""


class MarkerFitError(FlexsheetError, ValueError):
    """Raised if the touches do not determine the marker's position on the finger."""

    remedy = "Touch known points in at least three orientations that differ by 15 degrees or more."


@dataclass(frozen=True, slots=True)
class Touch:
    """A touch of a known point or plane by the resting finger.

    marker_m: measured position (3,) of the marker in the world.
    point_m: position (3,) of the touched point in the world.
    normal: unit normal (3,) of a touched plane; None if the finger touched a known point of an
        object.
    world_from_finger: orientation of the finger as a rotation matrix (3, 3).
    """

    marker_m: Floats
    point_m: Floats
    world_from_finger: Floats
    normal: Floats | None = None


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """The fitted position of the marker on the finger, with its uncertainty.

    marker_from_pad_m: position (3,) of the marker in the finger's frame.
    covariance_m2: covariance (3, 3) of this position.
    point_offset_m: mean (3,) of the estimated errors of the touched points, in the world frame.
    residuals_m: for each touch, distance between the measured and the fitted marker position.
    points, orientations: numbers of different points and orientations.
    """

    marker_from_pad_m: Floats
    covariance_m2: Floats
    point_offset_m: Floats
    residuals_m: Floats
    points: int
    orientations: int

    @property
    def standard_deviations_m(self) -> Floats:
        """Return the standard deviations (3,), in m, of the components of the marker's position."""
        return np.sqrt(np.diag(self.covariance_m2))

    @property
    def residual_rms_m(self) -> float:
        """Return the root mean square (m) of the residuals of all touches."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))


def fit_marker(touches: Sequence[Touch]) -> MarkerFit:
    """Fit the marker's position on the finger by restricted maximum likelihood.

    Raises MarkerFitError if there are too few touches or orientations, or if the touches contradict
    each other. Also raises MarkerFitError if the touches do not determine a plausible position.
    """
    orientation = np.array(group_orientations([touch.world_from_finger for touch in touches]))
    orientations = len(set(orientation))
    if len(touches) < MIN_TOUCHES or orientations < MIN_ORIENTATIONS:
        missing = max(MIN_ORIENTATIONS - orientations, MIN_TOUCHES - len(touches))
        raise MarkerFitError(
            f"there are {len(touches)} touches in {orientations} orientations, but at least "
            f"{MIN_TOUCHES} touches in {MIN_ORIENTATIONS} orientations are needed: touch in at "
            f"least {missing} more orientations"
        )
    rounded = np.rint(np.array([touch.point_m for touch in touches]) / POINT_GRID_M)
    places, point = np.unique(rounded, axis=0, return_inverse=True)
    seen = [np.eye(3) if touch.normal is None else touch.normal[None] for touch in touches]
    rows = np.repeat(np.arange(len(touches)), [len(one) for one in seen])
    directions = np.vstack(seen)
    parallel = directions @ directions.T
    same_orientation, same_point = (
        parallel * (group[rows][:, None] == group[rows]) for group in (orientation, point.ravel())
    )
    pairs = list(zip(seen, touches, strict=True))
    matrix = np.vstack([one @ touch.world_from_finger for one, touch in pairs])
    values = np.concatenate([one @ (touch.marker_m - touch.point_m) for one, touch in pairs])
    if np.linalg.cond(matrix) > MAX_CONDITION:
        raise MarkerFitError(
            "the touches do not determine the offset, because the finger had similar orientations "
            "in all of them; repeat with different orientations"
        )
    fixed = COMMON_ERROR_M**2 * parallel
    expected_m = np.array([TOUCH_NOISE_M, ORIENTATION_ERROR_M, POINT_ERROR_M])

    def solve(logarithms: Floats) -> tuple[float, Floats, Floats, Floats]:
        """Estimate the marker's offset for given standard deviations of the measurement errors.

        Return the cost, the offset (3,), its covariance (3, 3), and the weighted residuals.

        logarithms: logarithms (3,) of three standard deviations, each divided by its expected
            value. They describe the measurement noise, the common error in each orientation, and
            the error of each touched point.
        """
        noise, turned, placed = (expected_m * np.exp(logarithms)) ** 2
        covariance = fixed + turned * same_orientation + placed * same_point
        covariance[np.diag_indices_from(covariance)] += noise
        weighted = np.linalg.solve(covariance, np.column_stack([matrix, values]))
        information = matrix.T @ weighted[:, :3]
        offset = np.asarray(np.linalg.solve(information, matrix.T @ weighted[:, 3]), np.float64)
        errors = weighted[:, 3] - weighted[:, :3] @ offset
        cost = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
        cost += (values - matrix @ offset) @ errors + np.sum((logarithms / PRIOR_STD_LN) ** 2)
        return float(cost), offset, np.asarray(np.linalg.inv(information)), errors

    simplex = 0.5 * np.vstack([np.zeros(3), np.eye(3)])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.01}
    best = minimize(lambda x: solve(x)[0], np.zeros(3), method="Nelder-Mead", options=options)
    _, offset, covariance, weighted = solve(best.x)
    placed = (POINT_ERROR_M * np.exp(best.x[2])) ** 2
    shifts = np.array(
        [
            placed * directions[at].T @ weighted[at]
            for at in (point.ravel()[rows] == number for number in range(len(places)))
        ]
    )
    point_errors = np.einsum("ni,ni->n", directions, shifts[point.ravel()[rows]])
    errors = values - matrix @ offset - point_errors
    residuals = np.sqrt(np.bincount(rows, errors**2))
    fit = MarkerFit(offset, covariance, shifts.mean(axis=0), residuals, len(places), orientations)
    _check_fit(fit)
    return fit


def _check_fit(fit: MarkerFit) -> None:
    worst = int(np.argmax(fit.residuals_m))
    if fit.residual_rms_m > MAX_RESIDUAL_M:
        raise MarkerFitError(
            f"the touches contradict each other: the rms residual is "
            f"{1e3 * fit.residual_rms_m:.2f} mm, but at most {1e3 * MAX_RESIDUAL_M:g} mm are "
            f"allowed; the residual of touch {worst + 1} is {1e3 * fit.residuals_m[worst]:.2f} mm; "
            "check units, signs and orientations"
        )
    for axis, deviation_m in zip("xyz", fit.standard_deviations_m, strict=True):
        if deviation_m > MAX_DEVIATION_M:
            raise MarkerFitError(
                f"{axis} of the offset has an uncertainty of {1e3 * deviation_m:.2f} mm, but at "
                f"most {1e3 * MAX_DEVIATION_M:g} mm are allowed; add orientations that differ more"
            )
    length_m = float(np.linalg.norm(fit.marker_from_pad_m))
    if length_m > MAX_OFFSET_M:
        raise MarkerFitError(
            f"the marker would be {1e3 * length_m:.0f} mm from the pad, but at most "
            f"{1e3 * MAX_OFFSET_M:g} mm are plausible; check units and touched points"
        )


def group_orientations(rotations: Sequence[Floats]) -> list[int]:
    """Group similar orientations, and return a group index for each orientation.

    rotations: rotation matrices (3, 3).
    """
    different: list[Floats] = []
    groups = []
    for rotation in rotations:
        angles = [
            np.arccos(np.clip(0.5 * (np.trace(other.T @ rotation) - 1.0), -1.0, 1.0))
            for other in different
        ]
        if all(angle >= MIN_ANGLE_RAD for angle in angles):
            angles.append(0.0)
            different.append(rotation)
        groups.append(int(np.argmin(angles)))
    return groups
