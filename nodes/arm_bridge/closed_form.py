"""Compute the kinematics of 6-axis arms with a spherical wrist in closed form.

J1 to J6 are the joints, counted from the base. At joint angles of zero, they rotate about the axes
z, y, y, z, y, z. Joint angles are arrays (6,), in radians. Poses are 4x4 matrices
`base_from_flange`, in metres. A branch is one of up to eight solutions of the inverse kinematics
for one flange pose. The class `ClosedFormArm` of the scene defines the dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import acos, atan2, copysign, cos, degrees, hypot, inf, pi, remainder, sin
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from flexsheet.messages.scene import ClosedFormArm
from flexsheet.nodes.arm_bridge.joint_chain import SerialChain, UnreachableError
from flexsheet.nodes.arrays import Floats

WRIST_SINGULAR = 1e-7
"""The absolute value of sin(J5) below which the axes of J4 and J6 count as parallel. J4 then stays
fixed."""

SHOULDER_SINGULAR_M = 1e-7
"""The distance (m) between the wrist centre and the axis of J1 below which J1 stays fixed."""

WRIST_FIXED_RAD, WRIST_NEAR_RAD = float(np.radians(0.75)), float(np.radians(6.0))
"""The absolute values (rad) of the angle J5 that bound the region of the wrist singularity. Below
the first value, J4 may stay constant. Below the second value, J4 may deviate from the solution of
the inverse kinematics."""

SHOULDER_FIXED_M, SHOULDER_NEAR_M = 0.0007, 0.02
"""The distances (m) between the wrist centre and the J1 axis that bound the region of the shoulder
singularity. Below the first distance, J1 may stay constant. Below the second distance, J1 may
deviate from the solution of the inverse kinematics."""

MAX_FIXED_ERROR_RATIO = 1.4
"""The ratio of the maximum pose error near a singularity to WRIST_FIXED_RAD or SHOULDER_FIXED_M.
The resulting maximum errors are 1.05 degrees and 1 mm."""

MAX_FREE_ROTATION_RAD = 0.01
"""The maximum extra rotation (rad) of J4 or J1 per step that reduces the pose error near a
singularity. At 140 steps per second, this rotation corresponds to half the maximum speed of these
joints."""

Shoulder = Literal["front", "back"]
Elbow = Literal["up", "down"]
Wrist = Literal["plain", "flipped"]


class Branch(NamedTuple):
    """One of the eight joint solutions for a flange pose.

    shoulder: "front" if the wrist centre is in front of the plane through the axes of J1 and J2.
    elbow: "up" if J3 is above the angle at which shoulder, elbow and wrist centre are in line.
    wrist: "flipped" if J5 is negative.
    """

    shoulder: Shoulder
    elbow: Elbow
    wrist: Wrist


BRANCHES = tuple(
    Branch(shoulder, elbow, wrist)
    for shoulder in get_args(Shoulder)
    for elbow in get_args(Elbow)
    for wrist in get_args(Wrist)
)
"""All eight branches, in the order of the solutions of `ClosedFormKinematics.branches`."""


def _arm_rotation(joint_1: float, joints_23: float) -> Floats:
    """Return the rotation matrix (3, 3) of the forearm relative to the base.

    joint_1, joints_23: angle of J1, and sum of the angles of J2 and J3, rad.
    """
    c1, s1, c23, s23 = cos(joint_1), sin(joint_1), cos(joints_23), sin(joints_23)
    return np.array([[c1 * c23, -s1, c1 * s23], [s1 * c23, c1, s1 * s23], [-s23, 0.0, c23]])


def _limited_rotation(along: float, across: float, *, fixed: float, near: float) -> float:
    """Return the angle (rad) by which a joint rotates to make an axis parallel to a vector.

    Near a singularity, the vector is short. The axis may then deviate from the vector, so that the
    joint does not rotate fast. The joint rotates by at most MAX_FREE_ROTATION_RAD more than
    necessary.

    along, across: components of the vector parallel and perpendicular to the axis.
    fixed: length of the vector up to which the axis may even be perpendicular to the vector.
    near: length of the vector from which the axis must be parallel to the vector.
    """
    length = hypot(along, across)
    if length == 0.0:
        return 0.0
    turn = atan2(across, along) if along >= 0.0 else atan2(-across, -along)
    if length >= near:
        return turn
    slack = 0.5 * pi * min(1.0, fixed / length) * min(1.0, (near - length) / (near - fixed))
    full_angle = abs(turn)
    free = min(MAX_FREE_ROTATION_RAD * min(1.0, length / fixed), full_angle, slack)
    return copysign(max(full_angle - slack, 0.0) + free, turn)


def _solve_last_joint(wrist: list[list[float]], q4: float, q5: float) -> float:
    """Return the angle of J6 (rad) at which J4, J5 and J6 best approximate a desired rotation.

    wrist: desired rotation matrix (3, 3) from the forearm to the flange.
    q4, q5: angles of J4 and J5, rad.
    """
    s4, c4, s5, c5 = sin(q4), cos(q4), sin(q5), cos(q5)
    first = (c4 * c5, s4 * c5, -s5)
    second = (-s4, c4, 0.0)
    xx, xy = (sum(row[k] * first[i] for i, row in enumerate(wrist)) for k in (0, 1))
    yx, yy = (sum(row[k] * second[i] for i, row in enumerate(wrist)) for k in (0, 1))
    return atan2(yx - xy, xx + yy)


def _wrap(angle: float) -> float:
    return atan2(sin(angle), cos(angle))


def _nearest_revolution(angle: float, near: float, low: float, high: float) -> float:
    """Return the angle (rad) nearest to `near` that equals `angle` plus -1, 0 or 1 revolutions.

    The result is infinite if none of these angles is between `low` and `high`.
    """
    best = inf
    for rotated in (angle, angle - 2.0 * pi, angle + 2.0 * pi):
        if low <= rotated <= high and abs(rotated - near) < abs(best - near):
            best = rotated
    return best


class ClosedFormKinematics:
    """The closed-form kinematics of a 6-axis arm with a spherical wrist."""

    def __init__(self, model: ClosedFormArm) -> None:
        self.model = model
        self._chain = SerialChain(model.chain())
        self._shoulder_m, self._upper_m = model.shoulder_height_m, model.upper_arm_m
        self._shift_m, self._forearm_m = model.elbow_shift_m, model.forearm_m
        self._flange_m = model.flange_m
        self._lowest, self._highest = model.min_rad, model.max_rad
        self._elbow_to_wrist_m = hypot(self._shift_m, self._forearm_m)
        self.elbow_rad = atan2(self._shift_m, self._forearm_m)
        """The angle (rad) of J3 at which shoulder, elbow and wrist centre are in line."""
        bend = min(max(self.elbow_rad, self._lowest[2]), self._highest[2]) - self.elbow_rad
        self.max_wrist_m = hypot(
            self._upper_m + self._elbow_to_wrist_m * cos(bend), self._elbow_to_wrist_m * sin(bend)
        )
        """The maximum distance (m) of the wrist centre from the shoulder within the range of J3."""

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return the Jacobians (n, 6, 6) in the base frame for n sets of joint angles (n, 6), rad.

        A Jacobian maps joint speeds to the linear and then the angular velocity of the flange.
        """
        return self._chain.jacobian(joints_rad)

    def forward(self, joints_rad: ArrayLike) -> Floats:
        """Return the flange pose base_from_flange (4, 4) at joint angles (6,) rad."""
        q1, q2, q3, q4, q5, q6 = np.asarray(joints_rad, dtype=np.float64).tolist()
        s2, c2, s23, c23 = sin(q2), cos(q2), sin(q2 + q3), cos(q2 + q3)
        out = self._upper_m * s2 - self._shift_m * c23 + self._forearm_m * s23
        up = self._shoulder_m + self._upper_m * c2 + self._shift_m * s23 + self._forearm_m * c23
        s1, c1, s4, c4 = sin(q1), cos(q1), sin(q4), cos(q4)
        s5, c5, s6, c6 = sin(q5), cos(q5), sin(q6), cos(q6)
        rows = []
        # The flange's axes in the forearm's frame, rotated about y by J2 + J3, then about z by J1.
        for x, y, z in (
            (c4 * c5 * c6 - s4 * s6, s4 * c5 * c6 + c4 * s6, -s5 * c6),
            (-c4 * c5 * s6 - s4 * c6, -s4 * c5 * s6 + c4 * c6, s5 * s6),
            (c4 * s5, s4 * s5, c5),
        ):
            ahead = c23 * x + s23 * z
            rows.append((c1 * ahead - s1 * y, s1 * ahead + c1 * y, c23 * z - s23 * x, 0.0))
        x, y, z, _ = rows[2]
        rows.append(
            (
                out * c1 + self._flange_m * x,
                out * s1 + self._flange_m * y,
                up + self._flange_m * z,
                1.0,
            )
        )
        return np.array(rows).T

    def list_branches(self, base_from_flange: Floats) -> Sequence[Branch]:
        """Return the eight branches (discrete solutions) of the inverse kinematics.

        base_from_flange: not used, because all flange poses have the same branches.
        """
        return BRANCHES

    def reach_margins_m(self, base_from_flange: Floats) -> Floats:
        """Return the reach margins (n,), m, for n flange poses (n, 4, 4).

        A margin is the maximum minus the actual distance between shoulder and wrist centre. It is
        negative if the pose is out of reach.
        """
        wrist = base_from_flange[:, :3, 3] - self._flange_m * base_from_flange[:, :3, 2]
        away = np.linalg.norm(wrist - [0.0, 0.0, self._shoulder_m], axis=1)
        return np.asarray(self.max_wrist_m - away)

    def branches(self, base_from_flange: Floats, present_rad: ArrayLike) -> list[tuple[float, ...]]:
        """Return all solutions (rad) of the inverse kinematics for a flange pose (4, 4).

        present_rad: present joint angles (6,). At a singularity, they replace undefined angles.

        The solutions are in the order of `BRANCHES`, and may exceed the joint ranges. The list is
        empty if the wrist centre is out of reach.
        """
        present = np.asarray(present_rad, dtype=np.float64).tolist()
        rotation = base_from_flange[:3, :3]
        x, y, z = (base_from_flange[:3, 3] - self._flange_m * rotation[:, 2]).tolist()
        radius, height = hypot(x, y), z - self._shoulder_m
        bend = self._bend(radius, height)
        if bend is None:
            return []
        azimuth = atan2(y, x) if radius > SHOULDER_SINGULAR_M else present[0]
        found: list[tuple[float, ...]] = []
        for q1, out in (
            (azimuth, radius),
            (azimuth - pi if azimuth > 0 else azimuth + pi, -radius),
        ):
            for q3 in (self.elbow_rad + bend, self.elbow_rad - bend):
                q2 = self._solve_shoulder(out, height, q3)
                wrist = (_arm_rotation(q1, q2 + q3).T @ rotation).tolist()
                sine = hypot(wrist[0][2], wrist[1][2])
                q5 = atan2(sine, wrist[2][2])
                if sine > WRIST_SINGULAR:
                    q4 = atan2(wrist[1][2], wrist[0][2])
                    q6 = atan2(wrist[2][1], -wrist[2][0])
                elif wrist[2][2] > 0:
                    q4 = present[3]
                    q6 = _wrap(atan2(wrist[1][0], wrist[0][0]) - q4)
                else:
                    q4 = present[3]
                    q6 = _wrap(q4 - atan2(-wrist[1][0], -wrist[0][0]))
                found.append((q1, q2, q3, q4, q5, q6))
                found.append((q1, q2, q3, _wrap(q4 + pi), -q5, _wrap(q6 + pi)))
        return found

    def inverse_kinematics(self, base_from_flange: Floats, present_rad: ArrayLike) -> Floats:
        """Return the solution (6,) rad of the inverse kinematics nearest to the present angles.

        base_from_flange: flange pose (4, 4).
        present_rad: present joint angles (6,).

        The nearest solution has the smallest maximum joint change. Raises UnreachableError if no
        solution is within the joint ranges.
        """
        present = np.asarray(present_rad, dtype=np.float64).tolist()
        nearest, least = None, inf
        solutions = self.branches(base_from_flange, present)
        for solution in solutions:
            joints = [
                _nearest_revolution(angle, near, low, high)
                for angle, near, low, high in zip(
                    solution, present, self._lowest, self._highest, strict=True
                )
            ]
            change = max(abs(angle - near) for angle, near in zip(joints, present, strict=True))
            if change < least:
                nearest, least = joints, change
        if nearest is None or least == inf:
            raise self._unreachable(base_from_flange, solutions)
        return np.array(nearest)

    def solve_next_joints(self, base_from_flange: Floats, present_rad: ArrayLike) -> Floats:
        """Return the joint angles (6,) rad for the next step of a motion to a flange pose (4, 4).

        present_rad: present joint angles (6,).

        Near the wrist singularity (J5 = 0), a small motion of the flange would require a fast
        rotation of J4. There, the angle of J4 may deviate from the inverse kinematics. The
        resulting orientation error is at most 1.05 degrees. Near the shoulder singularity, the
        angle of J1 may deviate, and the position error is at most 1 mm. If the solution exceeds the
        joint ranges, another branch (discrete solution) is selected. Raises UnreachableError if no
        branch is within the joint ranges.
        """
        present = np.asarray(present_rad, dtype=np.float64).tolist()
        rotation = base_from_flange[:3, :3]
        x, y, z = (base_from_flange[:3, 3] - self._flange_m * rotation[:, 2]).tolist()
        q1 = present[0] + _limited_rotation(
            x * cos(present[0]) + y * sin(present[0]),
            y * cos(present[0]) - x * sin(present[0]),
            fixed=SHOULDER_FIXED_M,
            near=SHOULDER_NEAR_M,
        )
        out, height = x * cos(q1) + y * sin(q1), z - self._shoulder_m
        bend = self._bend(out, height)
        if bend is None:
            raise self._unreachable(base_from_flange, [])
        q3 = self.elbow_rad + copysign(bend, present[2] - self.elbow_rad)
        q2 = self._solve_shoulder(out, height, q3)
        wrist = (_arm_rotation(q1, q2 + q3).T @ rotation).tolist()
        c4, s4 = cos(present[3]), sin(present[3])
        q4 = present[3] + _limited_rotation(
            c4 * wrist[0][2] + s4 * wrist[1][2],
            c4 * wrist[1][2] - s4 * wrist[0][2],
            fixed=WRIST_FIXED_RAD,
            near=WRIST_NEAR_RAD,
        )
        c4, s4 = cos(q4), sin(q4)
        q5 = atan2(c4 * wrist[0][2] + s4 * wrist[1][2], wrist[2][2])
        q6 = _solve_last_joint(wrist, q4, q5)
        joints = [
            near + remainder(angle - near, 2.0 * pi)
            for angle, near in zip((q1, q2, q3, q4, q5, q6), present, strict=True)
        ]
        if all(
            low <= q <= high
            for q, low, high in zip(joints, self._lowest, self._highest, strict=True)
        ):
            return np.array(joints)
        return self.inverse_kinematics(base_from_flange, present)

    def _bend(self, out: float, height: float) -> float | None:
        """Return the angle (0 to pi rad) between the upper arm and the line from elbow to wrist.

        out, height: horizontal and vertical distance (m) of the wrist centre from the shoulder.

        Returns None if the wrist centre is out of reach.
        """
        cosine = (out * out + height * height - self._upper_m**2 - self._elbow_to_wrist_m**2) / (
            2.0 * self._upper_m * self._elbow_to_wrist_m
        )
        if not abs(cosine) <= 1.0 + 1e-12:
            return None
        return acos(min(1.0, max(-1.0, cosine)))

    def _solve_shoulder(self, out: float, height: float, q3: float) -> float:
        """Return the angle of J2 (rad) that moves the wrist centre to the given position.

        out, height: horizontal and vertical distance (m) of the wrist centre from the shoulder.
        q3: angle of J3, rad.
        """
        along = self._forearm_m * sin(q3) - self._shift_m * cos(q3)
        up = self._upper_m + self._shift_m * sin(q3) + self._forearm_m * cos(q3)
        return _wrap(atan2(out, height) - atan2(along, up))

    def _unreachable(
        self, base_from_flange: Floats, solutions: list[tuple[float, ...]]
    ) -> UnreachableError:
        # Adding zero turns a negative zero into zero.
        x, y, z = np.round(base_from_flange[:3, 3] * 1e3) + 0.0
        where = f"flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm from the base"
        if not solutions:
            wrist = base_from_flange[:3, 3] - self._flange_m * base_from_flange[:3, 2]
            away = float(np.linalg.norm(wrist - [0.0, 0.0, self._shoulder_m]))
            return UnreachableError(
                f"{where}: out of the arm's reach; the wrist would be {1e3 * away:.0f} mm from the "
                f"shoulder, maximum {1e3 * self.max_wrist_m:.1f} mm",
                "reach",
            )
        _, joint, angle = min(max(self._beyond(solution)) for solution in solutions)
        return UnreachableError(
            f"{where}: no solution is within the joint ranges; the nearest solution has "
            f"J{joint + 1} at {degrees(angle):.1f} degrees, but its range is "
            f"{degrees(self._lowest[joint]):.0f} to {degrees(self._highest[joint]):.0f}",
            f"J{joint + 1}",
        )

    def _beyond(self, solution: tuple[float, ...]) -> list[tuple[float, int, float]]:
        """Return the range violation (rad), the index and the angle (rad) of each joint.

        solution: six joint angles, rad.

        A range violation is negative if the angle is within the joint range.
        """
        found = []
        for joint, (angle, low, high) in enumerate(
            zip(solution, self._lowest, self._highest, strict=True)
        ):
            middle = 0.5 * (low + high)
            rotated = middle + remainder(angle - middle, 2.0 * pi)
            found.append((max(low - rotated, rotated - high), joint, rotated))
        return found

    def find_branch(self, joints_rad: ArrayLike) -> Branch:
        """Return the branch (discrete inverse-kinematics solution) of the joint angles (6,) rad.

        At a singularity, several branches match, and the first of them is returned.
        """
        joints = np.asarray(joints_rad, dtype=np.float64)
        return Branch(
            "front" if self._out(joints) >= 0.0 else "back",
            "up" if sin(joints[2] - self.elbow_rad) >= 0.0 else "down",
            "plain" if sin(joints[4]) >= 0.0 else "flipped",
        )

    def solve_joints_on_branch(
        self, base_from_flange: Floats, branch: Branch, near_rad: ArrayLike
    ) -> Floats:
        """Return joint angles (n, 6), rad, for n flange poses (n, 4, 4) on one branch.

        branch: one of the discrete solutions of the inverse kinematics.
        near_rad: joint angles (6,) that select among angles which differ by whole revolutions.

        The angles may exceed the joint ranges. They are NaN if a pose is out of reach.
        """
        poses = np.asarray(base_from_flange, dtype=np.float64)
        wrist = poses[:, :3, 3] - self._flange_m * poses[:, :3, 2]
        radius, height = np.hypot(wrist[:, 0], wrist[:, 1]), wrist[:, 2] - self._shoulder_m
        q1, out = np.arctan2(wrist[:, 1], wrist[:, 0]), radius
        if branch.shoulder == "back":
            q1, out = q1 + pi, -radius
        cosine = (radius**2 + height**2 - self._upper_m**2 - self._elbow_to_wrist_m**2) / (
            2.0 * self._upper_m * self._elbow_to_wrist_m
        )
        inside = np.abs(cosine) <= 1.0 + 1e-12
        bend = np.arccos(np.where(inside, np.clip(cosine, -1.0, 1.0), np.nan))
        q3 = self.elbow_rad + (bend if branch.elbow == "up" else -bend)
        along = self._forearm_m * np.sin(q3) - self._shift_m * np.cos(q3)
        up = self._upper_m + self._shift_m * np.sin(q3) + self._forearm_m * np.cos(q3)
        q2 = np.arctan2(out, height) - np.arctan2(along, up)
        c1, s1, c23, s23 = np.cos(q1), np.sin(q1), np.cos(q2 + q3), np.sin(q2 + q3)
        ahead = np.stack([c1 * c23, s1 * c23, -s23], axis=1)
        aside = np.stack([-s1, c1, np.zeros_like(c1)], axis=1)
        onward = np.stack([c1 * s23, s1 * s23, c23], axis=1)
        u, v, w = (
            np.einsum("ni,nij->nj", axis, poses[:, :3, :3]) for axis in (ahead, aside, onward)
        )
        flip = 1.0 if branch.wrist == "plain" else -1.0
        q4 = np.arctan2(flip * v[:, 2], flip * u[:, 2])
        q5 = np.arctan2(flip * np.hypot(u[:, 2], v[:, 2]), w[:, 2])
        c4, s4 = np.cos(q4), np.sin(q4)
        q6 = np.arctan2(c4 * v[:, 0] - s4 * u[:, 0], c4 * v[:, 1] - s4 * u[:, 1])
        near = np.asarray(near_rad, dtype=np.float64)
        joints = np.stack([q1, q2, q3, q4, q5, q6], axis=1)
        joints = near + np.remainder(joints - near + pi, 2.0 * pi) - pi
        for joint in (0, 3, 5):
            angle = joints[:, joint]
            for rotated in (angle - 2.0 * pi, angle + 2.0 * pi):
                better = (rotated >= self._lowest[joint]) & (rotated <= self._highest[joint])
                better &= (angle < self._lowest[joint]) | (angle > self._highest[joint])
                joints[:, joint] = np.where(better, rotated, joints[:, joint])
        return joints

    def singularity_margins(self, joints_rad: Floats) -> Mapping[str, Floats]:
        """Return the margins (n,) to each kind of singularity at joint angles (n, 6) rad.

        A margin is the distance from the singularity minus the permitted minimum. The unit is m for
        the shoulder, and rad for elbow and wrist.
        """
        joints = np.asarray(joints_rad, dtype=np.float64)
        elbow = np.remainder(joints[..., 2] - self.elbow_rad + 0.5 * pi, pi) - 0.5 * pi
        wrist = np.remainder(joints[..., 4] + 0.5 * pi, pi) - 0.5 * pi
        return {
            "shoulder singularity": np.abs(self._out(joints)) - SHOULDER_NEAR_M,
            "elbow singularity": np.abs(elbow) - WRIST_NEAR_RAD,
            "wrist singularity": np.abs(wrist) - WRIST_NEAR_RAD,
        }

    def _out(self, joints: Floats) -> Floats:
        """Return the horizontal distance (m) of the wrist centre in front of the J1 axis.

        joints: joint angles (..., 6), rad.

        The distance is negative if the wrist centre is behind the axis.
        """
        q2, q23 = joints[..., 1], joints[..., 1] + joints[..., 2]
        return np.asarray(
            self._upper_m * np.sin(q2) - self._shift_m * np.cos(q23) + self._forearm_m * np.sin(q23)
        )
