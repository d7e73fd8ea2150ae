"""Kinematics of the Mitsubishi RV-1A.

Joints are (6,) in radians, poses 4x4 `base_from_flange` in metres.  The chain, from the axis and
offset lists of two independent public models (Adolphus `mitsubishirv1a.yaml`, ICube `mrv1a.urdf`):
at zero both arms stand upright and every frame is parallel to the base; J1, J4, J6 turn about z,
J2, J3, J5 about y; shoulder 300 mm up, upper arm 250 mm, elbow shift 90 mm backwards, forearm
160 mm, flange 72 mm beyond the wrist centre.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from math import acos, atan2, cos, hypot, inf, pi, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from messages.scene import Scene
from nodes.methods import Family, Trial
from nodes.models.rigid import inverse, transform_from_rpy, vector_from_rotation
from nodes.models.sheet import edge_poses, flange_pose

Floats = NDArray[np.float64]

SHOULDER_HEIGHT_M = 0.3
UPPER_ARM_M = 0.25
ELBOW_SHIFT_M = 0.09
FOREARM_M = 0.16
FLANGE_M = 0.072

JOINT_MIN_RAD = np.radians([-150.0, -60.0, 60.0, -160.0, -90.0, -200.0])
JOINT_MAX_RAD = np.radians([150.0, 120.0, 155.0, 160.0, 90.0, 200.0])
JOINT_SPEED_RAD_PER_S = np.radians([180.0, 90.0, 135.0, 180.0, 180.0, 210.0])

WRIST_SINGULAR = 1e-7
"""Below this |sin J5| the axes of J4 and J6 are one; J4 then stays where it is."""

SHOULDER_SINGULAR_M = 1e-7
"""A wrist centre nearer than this to the axis of J1 leaves J1 free; it stays where it is."""

_ELBOW_TO_WRIST_M = hypot(ELBOW_SHIFT_M, FOREARM_M)
_ELBOW_ANGLE = atan2(ELBOW_SHIFT_M, FOREARM_M)
_LOWEST = tuple(float(angle) for angle in JOINT_MIN_RAD)
_HIGHEST = tuple(float(angle) for angle in JOINT_MAX_RAD)


class UnreachableError(ValueError):
    """No joint angles within the ranges give the wanted flange pose."""


def _arm_rotation(joint_1: float, joints_23: float) -> Floats:
    """Rotation of the forearm: about z by J1, then about y by J2 + J3."""
    c1, s1, c23, s23 = cos(joint_1), sin(joint_1), cos(joints_23), sin(joints_23)
    return np.array([[c1 * c23, -s1, c1 * s23], [s1 * c23, c1, s1 * s23], [-s23, 0.0, c23]])


def forward(joints_rad: ArrayLike) -> Floats:
    """base_from_flange (4, 4) of joints (6,)."""
    q1, q2, q3, q4, q5, q6 = (float(angle) for angle in np.asarray(joints_rad))
    s2, c2, s23, c23 = sin(q2), cos(q2), sin(q2 + q3), cos(q2 + q3)
    out = UPPER_ARM_M * s2 - ELBOW_SHIFT_M * c23 + FOREARM_M * s23
    up = SHOULDER_HEIGHT_M + UPPER_ARM_M * c2 + ELBOW_SHIFT_M * s23 + FOREARM_M * c23
    s4, c4, s5, c5, s6, c6 = sin(q4), cos(q4), sin(q5), cos(q5), sin(q6), cos(q6)
    wrist = np.array(
        [
            [c4 * c5 * c6 - s4 * s6, -c4 * c5 * s6 - s4 * c6, c4 * s5],
            [s4 * c5 * c6 + c4 * s6, -s4 * c5 * s6 + c4 * c6, s4 * s5],
            [-s5 * c6, s5 * s6, c5],
        ]
    )
    rotation = _arm_rotation(q1, q2 + q3) @ wrist
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = FLANGE_M * rotation[:, 2] + np.array([out * cos(q1), out * sin(q1), up])
    return pose


def branches(base_from_flange: Floats, present_rad: ArrayLike) -> list[tuple[float, ...]]:
    """Every joint solution of a flange pose, up to 8, whatever the joint ranges say.

    Shoulder forward or turned back, elbow either way, wrist either way.  Where a singularity leaves
    a joint free it is taken from `present_rad` (6,).  Angles are within a turn of zero.  Empty when
    the wrist centre is too far or too near.
    """
    present = [float(angle) for angle in np.asarray(present_rad)]
    rotation = base_from_flange[:3, :3]
    x, y, z = (base_from_flange[:3, 3] - FLANGE_M * rotation[:, 2]).tolist()
    radius, height = hypot(x, y), z - SHOULDER_HEIGHT_M
    cosine = (radius**2 + height**2 - UPPER_ARM_M**2 - _ELBOW_TO_WRIST_M**2) / (
        2.0 * UPPER_ARM_M * _ELBOW_TO_WRIST_M
    )
    if not abs(cosine) <= 1.0 + 1e-12:
        return []
    bend = acos(min(1.0, max(-1.0, cosine)))
    azimuth = atan2(y, x) if radius > SHOULDER_SINGULAR_M else present[0]
    found: list[tuple[float, ...]] = []
    for q1, out in ((azimuth, radius), (azimuth - pi if azimuth > 0 else azimuth + pi, -radius)):
        for q3 in (_ELBOW_ANGLE + bend, _ELBOW_ANGLE - bend):
            along = FOREARM_M * sin(q3) - ELBOW_SHIFT_M * cos(q3)
            up = UPPER_ARM_M + ELBOW_SHIFT_M * sin(q3) + FOREARM_M * cos(q3)
            q2 = _wrapped(atan2(out, height) - atan2(along, up))
            wrist = (_arm_rotation(q1, q2 + q3).T @ rotation).tolist()
            sine = hypot(wrist[0][2], wrist[1][2])
            q5 = atan2(sine, wrist[2][2])
            if sine > WRIST_SINGULAR:
                q4 = atan2(wrist[1][2], wrist[0][2])
                q6 = atan2(wrist[2][1], -wrist[2][0])
            elif wrist[2][2] > 0:
                q4 = present[3]
                q6 = _wrapped(atan2(wrist[1][0], wrist[0][0]) - q4)
            else:
                q4 = present[3]
                q6 = _wrapped(q4 - atan2(-wrist[1][0], -wrist[0][0]))
            found.append((q1, q2, q3, q4, q5, q6))
            found.append((q1, q2, q3, _wrapped(q4 + pi), -q5, _wrapped(q6 + pi)))
    return found


def inverse_kinematics(base_from_flange: Floats, present_rad: ArrayLike) -> Floats:
    """Joints (6,) within the ranges that give the flange pose, nearest to the present joints.

    Nearest is by the largest change of any joint; J6 may lie up to 200 degrees either way, so that
    a whole turn more or less is tried too.  UnreachableError when no branch is in range.
    """
    present = [float(angle) for angle in np.asarray(present_rad)]
    nearest, least = None, inf
    solutions = branches(base_from_flange, present)
    for solution in solutions:
        joints = [
            _nearest_turn(angle, near, low, high)
            for angle, near, low, high in zip(solution, present, _LOWEST, _HIGHEST, strict=True)
        ]
        change = max(abs(angle - near) for angle, near in zip(joints, present, strict=True))
        if change < least:
            nearest, least = joints, change
    if nearest is None or least == inf:
        x, y, z = base_from_flange[:3, 3] * 1e3
        why = "no branch is within the joint ranges" if solutions else "out of the arm's reach"
        raise UnreachableError(f"flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm from the base: {why}")
    return np.array(nearest)


def _wrapped(angle: float) -> float:
    """The same direction within -pi..pi."""
    return atan2(sin(angle), cos(angle))


def _nearest_turn(angle: float, near: float, low: float, high: float) -> float:
    """`angle` plus whole turns, in [low, high], nearest to `near`; infinite when none is."""
    best = inf
    for turned in (angle, angle - 2.0 * pi, angle + 2.0 * pi):
        if low <= turned <= high and abs(turned - near) < abs(best - near):
            best = turned
    return best


def jacobian(joints_rad: ArrayLike) -> Floats:
    """(6, 6): joint speeds to the flange's velocity, then its angular velocity, in the base."""
    q1, q2, q3, q4 = (float(angle) for angle in np.asarray(joints_rad)[:4])
    arm = _arm_rotation(q1, q2 + q3)
    flange = forward(joints_rad)
    shoulder = np.array([0.0, 0.0, SHOULDER_HEIGHT_M])
    elbow = shoulder + UPPER_ARM_M * np.array([cos(q1) * sin(q2), sin(q1) * sin(q2), cos(q2)])
    wrist = flange[:3, 3] - FLANGE_M * flange[:3, 2]
    axes = np.column_stack(
        [
            [0.0, 0.0, 1.0],
            arm[:, 1],
            arm[:, 1],
            arm[:, 2],
            arm @ np.array([-sin(q4), cos(q4), 0.0]),
            flange[:3, 2],
        ]
    )
    centres = np.column_stack([shoulder, shoulder, elbow, wrist, wrist, wrist])
    return np.vstack([np.cross(axes, flange[:3, 3:] - centres, axis=0), axes])


def damped_least_squares(
    base_from_flange: Floats,
    present_rad: ArrayLike,
    *,
    iterations: int = 20,
    damping: float = 1e-3,
    tolerance: float = 1e-9,
) -> Floats:
    """Joints (6,) near `present_rad` for a flange pose, by Levenberg's damped steps.

    Needs a start from which the pose can be reached without a change of branch; knows no joint
    ranges; stops at `tolerance` (m and rad) or after `iterations`, whatever is left then
    (Wampler 1986).
    """
    joints = np.array(present_rad, dtype=np.float64)
    for _ in range(iterations):
        pose = forward(joints)
        error = np.concatenate(
            [
                base_from_flange[:3, 3] - pose[:3, 3],
                vector_from_rotation(base_from_flange[:3, :3] @ pose[:3, :3].T),
            ]
        )
        if float(np.abs(error).max()) < tolerance:
            break
        slope = jacobian(joints)
        joints += slope.T @ np.linalg.solve(slope @ slope.T + damping**2 * np.eye(6), error)
    return joints


def _trials(scene: Scene) -> Iterable[Trial]:
    """Left flange poses with the sheet tilted over the working range, started 0.03 rad away."""
    arm = scene.arms.left
    base_from_world = inverse(
        transform_from_rpy(arm.world_from_base.position_m, arm.world_from_base.rpy_rad)
    )
    flange_from_edge = transform_from_rpy(
        arm.flange_from_edge.position_m, arm.flange_from_edge.rpy_rad
    )

    def flange(tilt_rad: float) -> Floats:
        world_from_sheet = transform_from_rpy(np.zeros(3), [tilt_rad, 0.0, 0.0])
        left, _ = edge_poses(world_from_sheet, scene.sheet.width_m)
        return base_from_world @ flange_pose(left, flange_from_edge)

    start = np.radians([0.0, 25.0, 119.0, 0.0, -54.0, 0.0])
    for share in (0.0, 0.5, 1.0):
        tilt_rad = share * scene.working_range.tilt_rad
        wanted = flange(tilt_rad)
        start = inverse_kinematics(flange(tilt_rad - 0.03), start)
        for method, solve in _METHODS.items():
            yield Trial(
                method=method,
                case={"tilt_deg": round(float(np.degrees(tilt_rad)), 1)},
                run=partial(solve, wanted, start),
                error=partial(_position_error_mm, wanted),
                in_range=True,
            )


def _position_error_mm(wanted: Floats, joints_rad: Floats) -> float:
    return 1e3 * float(np.linalg.norm(forward(joints_rad)[:3, 3] - wanted[:3, 3]))


_METHODS: dict[str, Callable[[Floats, Floats], Floats]] = {
    "closed-form": inverse_kinematics,
    "damped-least-squares-2": partial(damped_least_squares, iterations=2),
    "damped-least-squares-20": partial(damped_least_squares, iterations=20),
}

KINEMATICS = Family(
    name="kinematics",
    unit="mm",
    reference="forward kinematics",
    methods=tuple(_METHODS),
    trials=_trials,
    tolerance=lambda scene: 1e3 * scene.tolerances.sheet_position_m,
)
