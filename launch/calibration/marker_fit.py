"""Fit the marker's position on the finger to touches of known points in several orientations.

The marker's centre is at p + e + R o. Here p is the touched point, e an error that all touched
points have in common, R the finger's orientation and o the wanted offset in the finger's frame. A
touched plane, such as the sheet, only determines the component along its normal. Several
orientations are needed to separate o from e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError

Floats = NDArray[np.float64]

TOUCH_NOISE_M = 2e-4
"""Expected standard deviation of a touch along one axis, from camera, hand and orientation."""

POINT_ERROR_M = 1e-4
"""Expected standard deviation per axis of the error that all touched points share, for a point
whose position the stereo camera measures; it limits accuracy."""

MIN_TOUCHES, MIN_ORIENTATIONS = 4, 3
MIN_ANGLE_RAD = np.radians(8.0)
"""Minimum angle between orientations that count as different."""

MAX_DEVIATION_M = 5e-4
"""Maximum standard deviation of a component of the offset that counts as determined."""

MAX_RESIDUAL_M = 1e-3
"""Maximum root mean square residual of touches that count as consistent."""

MAX_OFFSET_M = 0.05
"""Maximum plausible distance between the marker and the finger's pad."""


class MarkerFitError(FlexsheetError, ValueError):
    """Raised for touches that do not determine the marker's position on the finger."""

    code = "marker-fit"
    remedy = "Touch a known point in at least three orientations that differ by 15 degrees or more."


@dataclass(frozen=True, slots=True)
class Touch:
    """One touch of a known point or plane, during which the finger was at rest.

    marker_m, point_m: measured marker and touched point (3,), world. normal: (3,) of a touched
    plane; None: the pad was at the point. world_from_finger: rotation (3, 3).
    """

    marker_m: Floats
    point_m: Floats
    world_from_finger: Floats
    normal: Floats | None = None


@dataclass(frozen=True, slots=True)
class MarkerFit:
    """Fitted offset of the marker (3,) in the finger's frame, m, and its uncertainty.

    point_offset_m: common error of the touched points. residuals_m: residual distances (touches,).
    orientations: number of different orientations.
    """

    marker_from_pad_m: Floats
    standard_deviations_m: Floats
    point_offset_m: Floats
    residuals_m: Floats
    orientations: int

    @property
    def residual_rms_m(self) -> float:
        """Return the root mean square of the residuals, m."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))


def fit_marker(touches: Sequence[Touch]) -> MarkerFit:
    """Fit the marker's offset by linear least squares.

    Raises MarkerFitError for too few touches or orientations, for touches that contradict each
    other, and for an implausible or undetermined offset.
    """
    orientations = count_orientations([touch.world_from_finger for touch in touches])
    if not is_sufficient(touches):
        missing = max(MIN_ORIENTATIONS - orientations, MIN_TOUCHES - len(touches))
        raise MarkerFitError(
            f"{len(touches)} touches in {orientations} orientations; at least {MIN_TOUCHES} "
            f"touches in {MIN_ORIENTATIONS} orientations are needed: touch in at least {missing} "
            "more orientations"
        )
    rows, values = [], []
    for touch in touches:
        seen = np.eye(3) if touch.normal is None else touch.normal[None]
        rows.append(np.hstack([seen @ touch.world_from_finger, seen]))
        values.append(seen @ (touch.marker_m - touch.point_m))
    prior = np.hstack([np.zeros((3, 3)), np.eye(3)]) / POINT_ERROR_M
    measured = np.vstack(rows)
    matrix = np.vstack([measured / TOUCH_NOISE_M, prior])
    wanted = np.concatenate([np.concatenate(values) / TOUCH_NOISE_M, np.zeros(3)])
    information = matrix.T @ matrix
    if np.linalg.cond(information) > 1e12:
        raise MarkerFitError("the touches do not determine the offset: all are along one direction")
    solution = np.linalg.solve(information, matrix.T @ wanted)
    errors = np.concatenate(values) - measured @ solution
    ends = np.cumsum([len(value) for value in values])[:-1]
    residuals = np.array([float(np.linalg.norm(one)) for one in np.split(errors, ends)])
    freedom = max(len(errors) - 3, 1)
    spread = max(1.0, float(errors @ errors) / (TOUCH_NOISE_M**2 * freedom))
    deviations = np.sqrt(np.diag(np.linalg.inv(information))[:3] * spread)
    fit = MarkerFit(solution[:3], deviations, solution[3:], residuals, orientations)
    _check_fit(fit)
    return fit


def _check_fit(fit: MarkerFit) -> None:
    worst = int(np.argmax(fit.residuals_m))
    if fit.residual_rms_m > MAX_RESIDUAL_M:
        raise MarkerFitError(
            f"the touches contradict each other: rms residual {1e3 * fit.residual_rms_m:.2f} mm, "
            f"maximum {1e3 * fit.residuals_m[worst]:.2f} mm in touch {worst + 1}; limit of the rms "
            f"{1e3 * MAX_RESIDUAL_M:g} mm; check units, signs and orientations"
        )
    for axis, deviation_m in zip("xyz", fit.standard_deviations_m, strict=True):
        if deviation_m > MAX_DEVIATION_M:
            raise MarkerFitError(
                f"{axis} of the offset has an uncertainty of {1e3 * deviation_m:.2f} mm, maximum "
                f"{1e3 * MAX_DEVIATION_M:g} mm; add orientations that differ more"
            )
    length_m = float(np.linalg.norm(fit.marker_from_pad_m))
    if length_m > MAX_OFFSET_M:
        raise MarkerFitError(
            f"the marker would be {1e3 * length_m:.0f} mm from the pad, at most "
            f"{1e3 * MAX_OFFSET_M:g} mm; check units and touched points"
        )


def is_sufficient(touches: Sequence[Touch]) -> bool:
    """Return whether there are enough touches and different orientations for a fit."""
    orientations = count_orientations([touch.world_from_finger for touch in touches])
    return len(touches) >= MIN_TOUCHES and orientations >= MIN_ORIENTATIONS


def count_orientations(rotations: Sequence[Floats]) -> int:
    """Count the rotations (3, 3) that differ from all counted before."""
    counted: list[Floats] = []
    for rotation in rotations:
        angles = [
            np.arccos(np.clip(0.5 * (np.trace(other.T @ rotation) - 1.0), -1.0, 1.0))
            for other in counted
        ]
        if all(angle >= MIN_ANGLE_RAD for angle in angles):
            counted.append(rotation)
    return len(counted)
