"""Estimate the pull of the sheet on an arm from the arm's motor currents.

The difference between the motor currents with and without the sheet is proportional to the joint
torques. Static friction of the gears adds an unknown torque of about a tenth of the rated torque.
The estimate detects errors of several newtons in the sheet's tension, but cannot calibrate the
sheet.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydantic import ConfigDict, Field

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, Positive
from flexsheet.messages.types import Force, Side
from flexsheet.nodes.arrays import Floats

SixPositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]

STEP_RAD = 1e-5
MAX_SPEED_RAD_PER_S = 0.02
"""The maximum joint speed at which the estimate is valid. At higher speeds, sliding friction and
acceleration change the motor currents."""

PERIOD_NS = 50_000_000


class MotorForceCalibration(LimitedModel):
    """The constants that convert motor currents to a force (docs/force.md)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    torque_per_percent_nm: SixPositive = Field(
        description="torque of each joint per percent of its motor's rated current, N m"
    )
    unloaded_percent: Six = Field(
        description="motor currents at the working pose without the sheet, percent of the rated "
        "currents"
    )
    friction_percent: Positive = Field(
        default=10.0,
        description="standard deviation of a motor current that static friction causes, percent",
    )


def estimate_pull_n(
    calibration: MotorForceCalibration,
    joints_rad: Floats,
    currents_percent: Floats,
    edge_flange_m: Floats,
    towards_base: Floats,
    *,
    forward: Callable[[Floats], Floats],
) -> tuple[float, float]:
    """Estimate the sheet's pull (N) on the edge, and the standard deviation (N) of the estimate.

    joints_rad, currents_percent: joint angles (6,) rad and motor currents (6,), percent.
    edge_flange_m: centre (3,) of the edge in the flange frame.
    towards_base: direction of the pull, a unit vector (3,) in the base frame.
    forward: function from joint angles (6,) rad to the flange pose (4, 4) in the base frame.

    The pull is estimated by weighted least squares.
    """
    at_edge = np.append(edge_flange_m, 1.0)
    edge_m = (forward(joints_rad) @ at_edge)[:3]
    moved = [(forward(joints_rad + step) @ at_edge)[:3] for step in STEP_RAD * np.eye(6)]
    # The motors balance the pull: their torques are minus the transposed Jacobian times the force.
    per_newton_nm = -(np.array(moved) - edge_m) @ towards_base / STEP_RAD
    scale_nm = np.array(calibration.torque_per_percent_nm)
    torques_nm = scale_nm * (currents_percent - np.array(calibration.unloaded_percent))
    sigmas_nm = scale_nm * calibration.friction_percent
    weight = float(np.sum((per_newton_nm / sigmas_nm) ** 2))
    force_n = float(np.sum(per_newton_nm * torques_nm / sigmas_nm**2)) / weight
    return force_n, weight**-0.5


class MotorForceEstimator:
    """An estimator of the sheet's pull on an arm, limited to 20 estimates per second."""

    def __init__(self, calibration: MotorForceCalibration, side: Side) -> None:
        self._calibration, self._side = calibration, side
        self._last_ns: int | None = None
        self._last_rad = np.zeros(6)

    def update(
        self,
        at_ns: int,
        joints_rad: Floats,
        currents_percent: Floats,
        edge_flange_m: Floats,
        towards_base: Floats,
        *,
        forward: Callable[[Floats], Floats],
    ) -> Force | None:
        """Return the sheet's pull on this arm, estimated from the motor currents at `at_ns`.

        The result is None at the first call, and if the last estimate is too recent. The estimate
        is invalid while the arm moves. The arguments have the same meaning as in `estimate_pull_n`.
        """
        before_ns, before_rad = self._last_ns, self._last_rad
        if before_ns is not None and at_ns - before_ns < PERIOD_NS:
            return None
        self._last_ns, self._last_rad = at_ns, joints_rad.copy()
        if before_ns is None:
            return None
        speed = np.abs(joints_rad - before_rad).max() / (1e-9 * (at_ns - before_ns))
        resting = bool(speed <= MAX_SPEED_RAD_PER_S)
        force_n, deviation_n = estimate_pull_n(
            self._calibration,
            joints_rad,
            currents_percent,
            edge_flange_m,
            towards_base,
            forward=forward,
        )
        return Force(
            source="motor_currents",
            axis="left_edge" if self._side == "left" else "right_edge",
            valid=resting,
            reason="ok" if resting else "in_motion",
            force_n=force_n,
            standard_deviation_n=deviation_n,
        )
