"""Fit the pose of the sheet's edge on each arm to marks on the clamps, which the camera measures.

A mark with the position m in the frame of the clamped edge is measured at the world position

world_from_base exp(b) forward(q + d) flange_from_edge exp(e) m + c f

where forward is the arm's forward kinematics, q are the reported joint angles, and f is the force
of the stretched sheet on the edge. The unknowns are the pose errors b of the base and e of the
edge, the joint offsets d, and the compliance c of the flange. A pose error consists of a rotation
vector and a translation, and exp converts it to a matrix.

The marks determine the total effect of the unknowns, but not each unknown. This is sufficient for
positions in the measured working range. To make the solution unique, each unknown has a normal
prior distribution, and the fit maximizes the posterior probability. The same camera measures the
finger, so errors of the camera's pose and lenses cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from flexsheet.launch.calibration.csv_rows import SIDES
from flexsheet.launch.calibration.hand_eye import apply_motion
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import ArmSpec, Pose, Scene, SheetSpec
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import make_kinematics
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import (
    apply,
    pose_matrix,
    rpy_from_rotation,
)
from flexsheet.nodes.models.sheet.tension import edge_force_n

BASE, JOINTS, EDGE, COMPLIANCE = slice(0, 6), slice(6, 12), slice(12, 18), 18
"""The indices of four groups of unknowns in the vector (19,) that is fitted.

The groups are the pose error of the base, the joint offsets, the pose error of the edge, and the
compliance of the flange.
"""

PRIOR_SIGMA = np.array([*[0.02] * 3, *[0.005] * 3, *[5e-4] * 6, *[0.005] * 3, *[1e-3] * 3, 5e-5])
"""The standard deviations (19,) of the prior distributions of the unknowns, in rad, m and m/N."""

PRIOR_COMPLIANCE_M_PER_N = 7.5e-5
MAX_COMPLIANCE_M_PER_N = 1e-2

INITIAL_SIGMA_M, MIN_SIGMA_M = 2e-4, 1e-6
"""The initial and the minimum standard deviation (m) of the error of a measured mark, per axis."""

OUTLIER_SIGMAS = 3.0
"""The residual, in standard deviations, above which the Huber loss of the fit is linear.

Source: Huber, Robust estimation of a location parameter (1964).
"""

MIN_POSES = 8
MAX_RESIDUAL_M = 1e-3
"""The maximum root mean square (m) of the residuals of a valid fit.

A larger value indicates that the measurements were assigned to the wrong mark on the clamp, to the
wrong arm, or to the wrong joint angles.
"""


class EdgeFitError(FlexsheetError, ValueError):
    """Raised if the marks do not determine the pose of the sheet's edge on an arm."""

    remedy = (
        "Measure three marks on each clamp in at least eight poses that differ in position, "
        "rotation and stretch of the sheet."
    )


@dataclass(frozen=True, slots=True)
class EdgeMark:
    """A measured mark on the clamp of an arm.

    mark_edge_m: known position (3,) of the mark in the frame of the clamped edge.
    position_world_m: measured position (3,) of the mark in the world.
    """

    side: Side
    mark_edge_m: Floats
    position_world_m: Floats


@dataclass(frozen=True, slots=True)
class HeldPose:
    """A pose of the sheet at rest, with the measured marks on both clamps.

    left_rad, right_rad: reported joint angles (6,) of both arms.
    """

    left_rad: Floats
    right_rad: Floats
    marks: tuple[EdgeMark, ...]

    def joints_rad(self, side: Side) -> Floats:
        return self.left_rad if side == "left" else self.right_rad


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """The fitted parameters of an arm, with the errors of the fit.

    residual_rms_m: rms distance between measured and fitted positions of the marks.
    edge_std_m: standard deviation of a mark's fitted position, with all three axes combined.
    compliance_std_m_per_n: standard deviation of the flange's compliance.
    covariance: covariance (19, 19) of the unknowns of the fit.
    """

    arm: ArmSpec
    residual_rms_m: float
    edge_std_m: float
    compliance_std_m_per_n: float
    covariance: Floats
    marks: int
    poses: int


@dataclass(frozen=True, slots=True)
class _Row:
    """A measured mark, with the joint angles of the arm and the force of the sheet on the edge.

    force_n: force (3,) in the world frame.
    """

    joints_rad: Floats
    mark_edge_m: Floats
    position_world_m: Floats
    force_n: Floats


def fit_edges(poses: Sequence[HeldPose], scene: Scene) -> dict[Side, EdgeFit]:
    """Fit the edge pose, base pose, joint offsets and compliance of both arms to measured marks.

    Raises EdgeFitError if there are too few poses, or if the marks contradict each other.
    """
    return {
        side: _fit_arm(_make_rows(poses, side, scene.sheet), getattr(scene.arms, side))
        for side in SIDES
    }


def _make_rows(poses: Sequence[HeldPose], side: Side, sheet: SheetSpec) -> list[_Row]:
    rows = []
    for pose in poses:
        centres = {
            one: [m.position_world_m for m in pose.marks if m.side == one]
            for one in ("left", "right")
        }
        if not all(centres.values()):
            continue
        across = np.mean(centres["right"], axis=0) - np.mean(centres["left"], axis=0)
        length_m = float(np.linalg.norm(across))
        tension_n = edge_force_n(length_m / sheet.width_m, sheet)
        force_n = (1.0 if side == "left" else -1.0) * tension_n * across / length_m
        rows += [
            _Row(pose.joints_rad(side), mark.mark_edge_m, mark.position_world_m, force_n)
            for mark in pose.marks
            if mark.side == side
        ]
    count = len({tuple(row.joints_rad.tolist()) for row in rows})
    if count < MIN_POSES:
        raise EdgeFitError(
            f"{side} arm: the marks of both clamps were measured in {count} poses, but at least "
            f"{MIN_POSES} are needed; record more poses"
        )
    return rows


class _ArmModel:
    """A model that computes the positions of the marks on an arm's clamp.

    The positions follow from the 19 unknowns of the fit, which the module docstring defines.
    """

    def __init__(self, arm: ArmSpec, rows: Sequence[_Row]) -> None:
        self._rows = rows
        self._kinematics = make_kinematics(arm.model)
        self._base, self._clamp = (
            pose_matrix(arm.world_from_base),
            pose_matrix(arm.flange_from_edge),
        )
        self.prior = np.zeros(19)
        self.prior[JOINTS] = arm.joint_offsets_rad
        self.prior[COMPLIANCE] = arm.flange_compliance_m_per_n or PRIOR_COMPLIANCE_M_PER_N
        self.measured = np.array([row.position_world_m for row in rows])

    def transforms(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """Return world_from_base and flange_from_edge (4, 4) for values (19,) of the unknowns."""
        return apply_motion(self._base, unknowns[BASE]), apply_motion(self._clamp, unknowns[EDGE])

    def positions(self, unknowns: Floats) -> Floats:
        """Return the world positions (n, 3), m, of the n marks for values (19,) of the unknowns."""
        base, clamp = self.transforms(unknowns)
        found = [
            apply(
                base @ self._kinematics.forward(row.joints_rad + unknowns[JOINTS]) @ clamp,
                row.mark_edge_m,
            )
            + unknowns[COMPLIANCE] * row.force_n
            for row in self._rows
        ]
        return np.array(found)


def _fit_arm(rows: Sequence[_Row], arm: ArmSpec) -> EdgeFit:
    model = _ArmModel(arm, rows)
    unknowns, sigma_m = model.prior, INITIAL_SIGMA_M
    bound = np.full(19, np.inf)
    lower, upper = -bound, bound.copy()
    lower[COMPLIANCE], upper[COMPLIANCE] = 0.0, MAX_COMPLIANCE_M_PER_N
    for _ in range(2):

        def residuals(values: Floats, sigma_m: float = sigma_m) -> Floats:
            off = (model.positions(values) - model.measured).ravel() / sigma_m
            return np.concatenate([off, (values - model.prior) / PRIOR_SIGMA])

        found = least_squares(
            residuals,
            unknowns,
            x_scale=PRIOR_SIGMA,
            bounds=(lower, upper),
            loss="huber",
            f_scale=OUTLIER_SIGMAS,
        )
        unknowns = found.x
        off = model.positions(unknowns) - model.measured
        # The median is not affected by single wrong marks; 0.6745 is the median of |x| for standard
        # normal x.
        sigma_m = max(float(np.median(np.abs(off))) / 0.6745, MIN_SIGMA_M)
    residual_rms_m = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    if not residual_rms_m <= MAX_RESIDUAL_M:
        raise EdgeFitError(
            f"the marks are {1e3 * residual_rms_m:.2f} mm (rms) from the fitted edge, but at most "
            f"{1e3 * MAX_RESIDUAL_M:g} mm are allowed; check which mark, arm and joint angles "
            "belong together"
        )
    marks = off.size
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    # The marks of one pose share the error of the joints, so each pose counts once.
    poses = len({tuple(row.joints_rad.tolist()) for row in rows})
    covariance *= len(rows) / poses
    spread = found.jac[:marks] @ covariance @ found.jac[:marks].T
    base, clamp = model.transforms(unknowns)
    return EdgeFit(
        arm=arm.model_copy(
            update={
                "world_from_base": _pose(base),
                "flange_from_edge": _pose(clamp),
                "joint_offsets_rad": tuple(unknowns[JOINTS].tolist()),
                "flange_compliance_m_per_n": float(unknowns[COMPLIANCE]),
            }
        ),
        residual_rms_m=residual_rms_m,
        edge_std_m=float(sigma_m * np.sqrt(np.trace(spread) / len(rows))),
        compliance_std_m_per_n=float(np.sqrt(covariance[COMPLIANCE, COMPLIANCE])),
        covariance=covariance,
        marks=len(rows),
        poses=poses,
    )


def _pose(matrix: Floats) -> Pose:
    return Pose(
        position_m=np.ascontiguousarray(matrix[:3, 3]), rpy_rad=rpy_from_rotation(matrix[:3, :3])
    )
