"""Describe one arm of the scene: its base, the sheet edge that it holds, and its limits."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import sqrt

import numpy as np

from flexsheet.messages.scene import ArmModel, ClosedFormArm, JointChain, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.closed_form import ClosedFormKinematics
from flexsheet.nodes.arm_bridge.joint_chain import NumericKinematics, SerialChain
from flexsheet.nodes.arm_bridge.limiter import (
    TOOL_SPEED_FRACTION,
    JointLimits,
    SheetLimits,
    check_flange,
    check_sheet,
    measure_twist_rad,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import EdgeBound, SheetMotion
from flexsheet.nodes.models.rigid import angle_between, apply, inverse, pose_matrix
from flexsheet.nodes.models.sheet import flange_pose, sheet_from_edges

RANGE_MARGIN_RAD = np.radians(2.0)

RELAXED_M, RELAXED_RAD = 0.002, 0.01
"""The margins (m and rad) by which a limit of the sheet or the flanges is widened if it is exceeded
at the start of a motion. The margins are necessary because servos vibrate slightly and measurements
are noisy."""

EDGE_SPEED_FRACTION = 0.95
"""The fraction of the maximum tool speed that the sheet's edges may use."""


def make_kinematics(
    model: ClosedFormArm | JointChain,
) -> ClosedFormKinematics | NumericKinematics:
    """Create the closed-form or numerical kinematics of an arm model."""
    return (
        ClosedFormKinematics(model)
        if isinstance(model, ClosedFormArm)
        else NumericKinematics(model)
    )


class ArmGeometry:
    """The geometry and the limits of one arm, and of the sheet's edge that the arm holds.

    tool_points_flange: points (4, 3) m in the flange frame: the centre and both ends of the clamped
        edge, and the origin of the flange.
    joint_offsets_rad: angles (6,) that are added to encoder angles before the kinematics.
    """

    def __init__(self, scene: Scene, side: Side) -> None:
        self.side: Side = side
        self.left = side == "left"
        arm, other = scene.arms.left, scene.arms.right
        if not self.left:
            arm, other = other, arm
        self.model: ArmModel = arm.model
        self.kinematics = make_kinematics(arm.model)
        self._cached_flange = lru_cache(maxsize=16)(self._solve_flange)
        self.world_from_base = pose_matrix(arm.world_from_base)
        self.base_from_world = inverse(self.world_from_base)
        self.flange_from_edge = pose_matrix(arm.flange_from_edge)
        self.other_flange_from_edge = pose_matrix(other.flange_from_edge)
        self.joint_offsets_rad = np.array(arm.joint_offsets_rad)
        self._compliance_m_per_n = arm.flange_compliance_m_per_n
        self._other_compliance_m_per_n = other.flange_compliance_m_per_n
        self.max_tool_speed = TOOL_SPEED_FRACTION * scene.arms.max_tool_speed_m_per_s
        sheet = scene.sheet
        half = 0.5 * sheet.height_m
        self.edge_bound = EdgeBound(EDGE_SPEED_FRACTION * self.max_tool_speed, half)
        edge_points_flange = apply(
            self.flange_from_edge,
            np.array([[0.0, 0.0, 0.0], [0.0, -half, 0.0], [0.0, half, 0.0]]),
        )
        self.tool_points_flange = np.vstack([edge_points_flange, np.zeros(3)])
        chain = arm.model.chain() if isinstance(arm.model, ClosedFormArm) else arm.model
        edge_end_m = float(np.linalg.norm(edge_points_flange, axis=1).max())
        self._levers_m = SerialChain(chain).levers_m(edge_end_m)
        self.start_rad = np.array(arm.model.start_rad)
        self.range_rad = np.array([arm.model.min_rad, arm.model.max_rad])
        speeds = np.array(arm.model.speed_rad_per_s)
        self.joint_limits = JointLimits(
            self.range_rad[0] + RANGE_MARGIN_RAD,
            self.range_rad[1] - RANGE_MARGIN_RAD,
            0.95 * speeds,
            6.0 * speeds,
            self.tool_points,
            self.max_tool_speed,
        )
        self.sheet_limits = SheetLimits(
            width_m=sheet.width_m,
            height_m=sheet.height_m,
            thickness_m=sheet.thickness_m,
            young_modulus_pa=sheet.young_modulus_pa,
            max_length_m=sheet.width_m * (sheet.max_stretch_ratio + 0.005),
            max_edge_force_n=sheet.max_edge_force_n,
            max_twist_rad=0.2,
            min_flange_distance_m=scene.arms.min_distance_m,
            workspace_min_m=scene.arms.workspace_min_m,
            workspace_max_m=scene.arms.workspace_max_m,
            compliance_m_per_n=self._compliance_m_per_n + self._other_compliance_m_per_n,
        )

    def base_from_flange(self, joints_rad: Floats) -> Floats:
        """Return the flange pose (4, 4) in the base frame at encoder angles (6,) rad."""
        return self._cached_flange(tuple((joints_rad + self.joint_offsets_rad).tolist()))

    def _solve_flange(self, joints_rad: tuple[float, ...]) -> Floats:
        """Return the flange pose base_from_flange (4, 4), read-only because it is cached.

        joints_rad: joint angles (6,) after correction of the encoder offsets.
        """
        pose = self.kinematics.forward(np.array(joints_rad))
        pose.flags.writeable = False
        return pose

    def bound_edge_shift_m(self, joints_rad: Floats, other_rad: Floats) -> float:
        """Return an upper bound (m) of the edge's motion between two sets of joint angles (6,)."""
        return float(self._levers_m @ np.abs(joints_rad - other_rad))

    def world_from_flange(self, joints_rad: Floats) -> Floats:
        """Return the world pose (4, 4) that the flange of a rigid arm would have.

        joints_rad: joint angles (6,) that the encoders report.
        """
        return self.world_from_base @ self.base_from_flange(joints_rad)

    def world_from_edge(self, joints_rad: Floats) -> Floats:
        """Return the world pose (4, 4) of the clamped edge at joint angles (6,) rad."""
        return self.world_from_flange(joints_rad) @ self.flange_from_edge

    def tool_points(self, joints_rad: Floats) -> Floats:
        """Transform `tool_points_flange` (4, 3) m to the base frame at joint angles (6,) rad."""
        return apply(self.base_from_flange(joints_rad), self.tool_points_flange)

    def joints_for_sheet(self, motion: SheetMotion, present_rad: Floats) -> Floats:
        """Return the joint angles (6,) rad that move this arm's edge to a pose of the sheet.

        present_rad: present joint angles (6,), which must be near the result.

        The deflection of the arm by the sheet's tension is compensated. Raises UnreachableError if
        the arm cannot reach the pose.
        """
        edge = motion.world_from_sheet.copy()
        edge[:3, 3] += self.edge_offset_m(motion.stretch_ratio) * edge[:3, 0]
        return self.solve_joints(flange_pose(edge, self.flange_from_edge), present_rad)

    def edge_offset_m(self, stretch_ratio: float) -> float:
        """Return the commanded x coordinate (m) of the edge in the sheet's frame.

        The left edge has a negative coordinate. The deflection of the arm by the sheet's tension is
        compensated.
        """
        length_m = stretch_ratio * self.sheet_limits.width_m
        moved_m = self._compliance_m_per_n * self.sheet_limits.force_n(length_m)
        return (-1.0 if self.left else 1.0) * (0.5 * length_m + moved_m)

    def solve_joints(self, world_from_flange: Floats, near_rad: Floats) -> Floats:
        """Return the encoder angles (6,) rad that move the flange to a world pose (4, 4).

        near_rad: joint angles (6,) near the result.

        The arm is assumed to be rigid. Raises UnreachableError if the arm cannot reach the pose.
        """
        offsets_rad = self.joint_offsets_rad
        base_from_flange = self.base_from_world @ world_from_flange
        joints_rad = self.kinematics.solve_next_joints(base_from_flange, near_rad + offsets_rad)
        return np.asarray(joints_rad - offsets_rad)

    def sheet_between(self, own_edge: Floats, other_edge: Floats) -> SheetMotion:
        """Return the pose and stretch of a sheet at rest between the edges of both arms.

        own_edge, other_edge: world poses (4, 4) that the edges would have if the arms were rigid.
        """
        limits = self.sheet_limits
        left, right = (own_edge, other_edge) if self.left else (other_edge, own_edge)
        distance_m = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
        length_m = limits.sheet_length_m(distance_m)
        sheet = sheet_from_edges(left, right)
        # The more compliant arm moves more, so the sheet is not midway between the rigid edges.
        own_m, other_m = (
            compliance * limits.force_n(length_m)
            for compliance in (self._compliance_m_per_n, self._other_compliance_m_per_n)
        )
        shift_m = 0.5 * (own_m - other_m if self.left else other_m - own_m)
        sheet[:3, 3] += shift_m * sheet[:3, 0]
        return SheetMotion(sheet, np.zeros(6), length_m / limits.width_m, 0.0)

    def measure_sheet(self, joints_rad: Floats, world_from_other_flange: Floats) -> SheetMotion:
        """Return the pose and stretch of a sheet at rest between both arms.

        joints_rad: measured joint angles (6,) of this arm.
        world_from_other_flange: measured pose (4, 4) of the other arm's flange.
        """
        other_edge = world_from_other_flange @ self.other_flange_from_edge
        return self.sheet_between(self.world_from_edge(joints_rad), other_edge)

    def check_limits(
        self, flange: Floats, other_flange: Floats, limits: SheetLimits, *, slack_m: float = 0.0
    ) -> str | None:
        """Describe the limit that the flanges or the sheet violate.

        flange, other_flange: world poses (4, 4) of this arm's flange and of the other flange.
        slack_m: tolerance on the limits of the flange.

        Returns None if no limit is violated.
        """
        return check_flange(flange, other_flange, limits, slack_m=slack_m) or check_sheet(
            flange @ self.flange_from_edge,
            other_flange @ self.other_flange_from_edge,
            left=self.left,
            limits=limits,
        )

    def relax_limits(self, flange: Floats, other_flange: Floats) -> SheetLimits:
        """Return the limits of the sheet and the flanges for one motion.

        flange, other_flange: world poses (4, 4) of both flanges at the start of the motion.

        A limit that is exceeded, or nearly exceeded, at the start is widened.
        """
        limits = self.sheet_limits
        edge = flange @ self.flange_from_edge
        other_edge = other_flange @ self.other_flange_from_edge
        across = other_edge[:3, 3] - edge[:3, 3]
        max_length_m = float(np.linalg.norm(across)) + RELAXED_M
        skew_rad = angle_between(across if self.left else -across, edge[:3, 0])
        twist_rad = max(skew_rad, measure_twist_rad(edge, other_edge)) + RELAXED_RAD
        distance_m = float(np.linalg.norm(other_flange[:3, 3] - flange[:3, 3])) - RELAXED_M
        return replace(
            limits,
            max_length_m=max(limits.max_length_m, max_length_m),
            max_edge_force_n=max(limits.max_edge_force_n, limits.force_n(max_length_m)),
            max_twist_rad=max(limits.max_twist_rad, twist_rad),
            min_flange_distance_m=min(limits.min_flange_distance_m, distance_m),
            workspace_min_m=np.minimum(limits.workspace_min_m, flange[:3, 3] - RELAXED_M),
            workspace_max_m=np.maximum(limits.workspace_max_m, flange[:3, 3] + RELAXED_M),
        )

    def sheet_state(
        self, joints_rad: Floats, world_from_other_flange: Floats | None
    ) -> tuple[float | None, float | None]:
        """Return the distance between the edges (m) and the force on each edge (N).

        joints_rad: joint angles (6,) of this arm.
        world_from_other_flange: pose (4, 4) of the other arm's flange. If the pose is None, both
            results are None.
        """
        if world_from_other_flange is None:
            return None, None
        other_edge = world_from_other_flange @ self.other_flange_from_edge
        across = other_edge[:3, 3] - self.world_from_edge(joints_rad)[:3, 3]
        length_m = self.sheet_limits.sheet_length_m(sqrt(float(across @ across)))
        return length_m, self.sheet_limits.force_n(length_m)
