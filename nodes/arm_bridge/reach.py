"""Check whether the arms can reach many poses of the sheet, or follow a path.

Two arms hold the sheet by its left and right edges. An array of n poses of the sheet consists of
world poses (n, 4, 4) and stretch ratios (n,). Joint angles are (n, 6) rad. A margin is the distance
to a limit, negative if the limit is violated. Margins of speeds are fractions of the maximum speed.
A branch is one of the discrete solutions of the inverse kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.joint_chain import UnreachableError
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import (
    inverse,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from flexsheet.nodes.models.sheet.tension import edge_force_n

RANGES = tuple(f"J{joint} range" for joint in range(1, 7))
SPEEDS = tuple(f"J{joint} speed" for joint in range(1, 7))
POSE_LIMITS = (
    "reach",
    *RANGES,
    "shoulder singularity",
    "elbow singularity",
    "wrist singularity",
    "singularity",
    "workspace",
    "flange distance",
    "edge force",
)
COMMAND_LIMITS = ("reach", *RANGES, "workspace", "flange distance", "edge force")
"""The names of the limits that the limiter also enforces for every command."""
SPEED_LIMITS = (*SPEEDS, "tool speed")
LIMITS = (*POSE_LIMITS, *SPEED_LIMITS)
"""The names of all limits. The first violated limit in this order is reported."""

BRANCH_SAMPLES = 500
"""The approximate number of sampled poses from which `find_best_reach` selects the branch."""

SPEED_DAMPING = 1e-12
"""The damping term of the normal equations. It limits the computed speeds at a singularity."""

MAX_STEP_RAD = 0.05
"""The maximum change of a joint between two samples of a path."""

MIN_FRACTION = 1e-6
"""The minimum distance between two samples, as a fraction of the path. If a joint moves by more
than MAX_STEP_RAD over this distance, the joint's motion is discontinuous."""

ROUNDING = 1e-9
"""The tolerance of margins for rounding errors."""


@dataclass(frozen=True, slots=True)
class SheetPoses:
    """World poses (n, 4, 4) of the sheet at n samples, with their stretch ratios (n,).

    twists_world: k velocities (m/s, rad/s) of the sheet's centre at each sample, as an array (n, k,
        6). The arms must be able to follow them. The number k may be 0.
    """

    world_from_sheet: Floats
    stretch_ratio: Floats
    twists_world: Floats

    def __len__(self) -> int:
        return len(self.stretch_ratio)

    def some(self, chosen: NDArray[np.intp] | Bools) -> SheetPoses:
        """Return a subset of the poses.

        chosen: indices of the poses, or a boolean mask (n,).
        """
        return SheetPoses(
            self.world_from_sheet[chosen], self.stretch_ratio[chosen], self.twists_world[chosen]
        )

    def without_twists(self) -> SheetPoses:
        """Return the same poses without velocities."""
        return SheetPoses(self.world_from_sheet, self.stretch_ratio, np.empty((len(self), 0, 6)))


@dataclass(frozen=True, slots=True)
class ArmReach:
    """The joint angles of one arm for n poses of the sheet, and the margins to its limits.

    branch: discrete solution of the inverse kinematics that is used for all poses.
    joints_rad: encoder angles (n, 6); NaN for poses that are out of reach.
    margins: distances (n,) to each limit in `LIMITS`, negative if the limit is violated. If a pose
        is out of reach, margins that depend on joint angles are NaN. The margin to a singularity is
        infinite if the arm's kinematics has no such singularity.
    """

    branch: Any
    joints_rad: Floats
    margins: Mapping[str, Floats]

    @property
    def binding(self) -> NDArray[np.intp]:
        """Return the first violated (binding) limit of each pose, as indices (n,) into `LIMITS`.

        The index is -1 for a pose that violates no limit.
        """
        found = np.full(len(self.joints_rad), -1)
        for number in reversed(range(len(LIMITS))):
            found[self.margins[LIMITS[number]] < 0.0] = number
        return found

    @property
    def reachable(self) -> Bools:
        """Return whether the arm can reach each pose at rest, as booleans (n,)."""
        binding = self.binding
        return np.asarray((binding < 0) | (binding >= len(POSE_LIMITS)))

    @property
    def trackable(self) -> Bools:
        """Return whether the arm can follow the sheet's motion at each pose, as booleans (n,).

        The arm must reach the pose, and the joint speeds for the sheet's twist must be permitted.
        """
        return np.asarray(self.binding < 0)


def compute_flange_poses(geometry: ArmGeometry, places: SheetPoses) -> Floats:
    """Return the world poses (n, 4, 4) of a rigid arm's flange for n poses of the sheet."""
    edges = places.world_from_sheet.copy()
    offset = np.array([geometry.edge_offset_m(ratio) for ratio in places.stretch_ratio])
    edges[:, :3, 3] += offset[:, None] * edges[:, :3, 0]
    return np.asarray(edges @ inverse(geometry.flange_from_edge))


def compute_reach(
    geometry: ArmGeometry, other: ArmGeometry, places: SheetPoses, branch: Any
) -> ArmReach:
    """Compute an arm's joint angles for n poses of the sheet, and the margins to the arm's limits.

    other: geometry of the arm that holds the other edge.
    branch: discrete solution of the inverse kinematics that is used for all poses.
    """
    flanges = compute_flange_poses(geometry, places)
    offsets_rad = geometry.joint_offsets_rad
    joints = (
        geometry.kinematics.solve_joints_on_branch(
            geometry.base_from_world @ flanges, branch, geometry.start_rad + offsets_rad
        )
        - offsets_rad
    )
    others = compute_flange_poses(other, places)
    margins = _margins(geometry, joints=joints, flanges=flanges, others=others, places=places)
    return ArmReach(branch, joints, margins)


def find_best_reach(geometry: ArmGeometry, other: ArmGeometry, places: SheetPoses) -> ArmReach:
    """Return the joint angles and margins on the branch that reaches the most poses.

    A branch is one of the discrete solutions of the inverse kinematics. Among branches that reach
    equally many poses, the branch with the larger margins is selected. An arm cannot change its
    branch while it holds the sheet.
    """
    still = places.without_twists().some(
        np.arange(0, len(places), max(1, len(places) // BRANCH_SAMPLES))
    )

    def merit(branch: Any) -> tuple[float, float]:
        reach = compute_reach(geometry, other, still, branch)
        ranges = np.stack([reach.margins[limit] for limit in RANGES])
        margin = np.where(np.isfinite(ranges), ranges, -np.pi).min(axis=0)
        return float(reach.reachable.sum()), float(np.minimum(margin, 0.2).sum())

    flanges = geometry.base_from_world @ compute_flange_poses(geometry, still)
    branches = geometry.kinematics.list_branches(flanges)
    return compute_reach(geometry, other, places, max(branches, key=merit))


def _margins(
    geometry: ArmGeometry,
    *,
    joints: Floats,
    flanges: Floats,
    others: Floats,
    places: SheetPoses,
) -> dict[str, Floats]:
    """Return the margins (n,) of each limit as a dict, with the names of the limits as keys.

    joints: encoder angles (n, 6) rad.
    flanges, others: world poses (n, 4, 4) of this arm's flange and of the other arm's flange.
    places: n poses of the sheet.

    A margin is the distance to the limit, and is positive if the limit is met. Margins of speeds
    are fractions of the maximum speed.
    """
    limits, joint_limits = geometry.sheet_limits, geometry.joint_limits
    without = np.full(len(joints), np.inf)
    singular = dict.fromkeys((limit for limit in POSE_LIMITS if "singularity" in limit), without)
    position = flanges[:, :3, 3]
    inside = np.minimum(position - limits.workspace_min_m, limits.workspace_max_m - position)
    apart = np.linalg.norm(position - others[:, :3, 3], axis=1)
    force = np.array([edge_force_n(stretch, limits) for stretch in places.stretch_ratio.tolist()])
    margin = np.minimum(joints - joint_limits.min_rad, joint_limits.max_rad - joints)
    reach = geometry.kinematics.reach_margins_m(geometry.base_from_world @ flanges)
    # Slightly beyond the reach there are still joint solutions, with J3 out of its range.
    reachable = np.isfinite(joints).all(axis=1)
    speeds, tool_speed = _speeds(geometry, joints, flanges, places)
    spare = 1.0 - speeds / joint_limits.speed_rad_per_s
    return {
        "reach": np.where(reachable, np.maximum(reach, 0.0), np.minimum(-np.abs(reach), -1e-9)),
        **{name: margin[:, joint] for joint, name in enumerate(RANGES)},
        **singular,
        **geometry.kinematics.singularity_margins(joints + geometry.joint_offsets_rad),
        "workspace": inside.min(axis=1),
        "flange distance": apart - limits.min_flange_distance_m,
        "edge force": limits.max_edge_force_n - force,
        **{name: spare[:, joint] for joint, name in enumerate(SPEEDS)},
        "tool speed": 1.0 - tool_speed / geometry.max_tool_speed,
    }


def _speeds(
    geometry: ArmGeometry, joints: Floats, flanges: Floats, places: SheetPoses
) -> tuple[Floats, Floats]:
    """Return the maximum joint speeds (n, 6), rad/s, and tool speeds (n,), m/s, at n sheet poses.

    joints: encoder angles (n, 6), rad.
    flanges: world poses (n, 4, 4) of the flange.
    places: n poses of the sheet, each with several twists (velocities) of the sheet. The maximum is
        taken over these twists.
    """
    fastest, tool = np.zeros_like(joints), np.zeros(len(joints))
    centre = places.world_from_sheet[:, :3, 3]
    points = _tool_points(geometry, flanges)
    fastest[~np.isfinite(joints)] = np.nan
    reachable = np.isfinite(joints).all(axis=1)
    slopes = geometry.kinematics.jacobian(joints[reachable] + geometry.joint_offsets_rad)
    transposed = np.swapaxes(slopes, 1, 2)
    normal = transposed @ slopes + SPEED_DAMPING * np.eye(6)
    to_base = geometry.base_from_world[:3, :3].T
    for motion in range(places.twists_world.shape[1]):
        linear, angular = np.split(places.twists_world[:, motion], 2, axis=1)
        arms = points - centre[:, None]
        velocity = linear[:, None] + np.cross(angular[:, None], arms)
        tool = np.maximum(tool, np.linalg.norm(velocity, axis=2).max(axis=1))
        at_flange = np.concatenate([velocity[:, -1] @ to_base, angular @ to_base], axis=1)
        wanted = transposed @ at_flange[reachable, :, None]
        rates = np.linalg.solve(normal, wanted)[..., 0]
        fastest[reachable] = np.fmax(fastest[reachable], np.abs(rates))
    return fastest, tool


def _tool_points(geometry: ArmGeometry, flanges: Floats) -> Floats:
    """Return four points of the tool in the world frame, (n, 4, 3) m, for n flange poses (n, 4, 4).

    The points are the centre and both ends of the clamped edge, and the flange's origin.
    """
    points = np.einsum("nij,pj->npi", flanges[:, :3, :3], geometry.tool_points_flange)
    return np.asarray(points + flanges[:, None, :3, 3])


@dataclass(frozen=True, slots=True)
class PathStep:
    """A pose of the sheet on a path, with the joint angles (6,) rad of both arms."""

    sheet: SheetMotion
    left_rad: Floats
    right_rad: Floats


class PathError(FlexsheetError, ValueError):
    """The error raised if the arms cannot follow a path.

    limit: violated limit: a member of `LIMITS`, "jump" if joint angles would be discontinuous, or
        "alignment" if the arms cannot move to the path.
    fraction: position of the violation on the path, from 0 (start) to 1 (end).
    """

    remedy = "Move the arms nearer to the sheet by hand, then enable them again."

    def __init__(
        self, side: Side, why: str, limit: str, fraction: float, world_from_sheet: Floats
    ) -> None:
        x, y, z = np.round(1e3 * world_from_sheet[:3, 3]) + 0.0
        super().__init__(
            f"{side} arm, at {100 * fraction:.0f} % of the path, "
            f"sheet at ({x:.0f}, {y:.0f}, {z:.0f}) mm: {why}"
        )
        self.side: Side = side
        self.limit = limit
        self.fraction = fraction


def plan_path(
    left: ArmGeometry,
    right: ArmGeometry,
    corners: Sequence[SheetMotion],
    *,
    left_rad: Floats,
    right_rad: Floats,
) -> list[PathStep]:
    """Plan a path for both arms that is straight between the given corners.

    left_rad, right_rad: joint angles (6,) near the solution for the first corner.

    Between two corners, the sheet rotates about one axis and its stretch changes linearly. Raises
    PathError if the path violates a limit.
    """
    near = PathStep(corners[0], left_rad, right_rad)
    begin = _solve_both(left, right, corners[0], near, fraction=0.0)
    steps = _sample_path(left, right, corners, begin)
    _check_limits(left, right, steps)
    return steps


def _sample_path(
    left: ArmGeometry, right: ArmGeometry, corners: Sequence[SheetMotion], begin: PathStep
) -> list[PathStep]:
    """Sample a path so densely that joint angles change by at most MAX_STEP_RAD per sample.

    Raises PathError if an arm cannot reach a sample, or if a joint motion is discontinuous.
    """
    track = [begin]
    for number, (near, far) in enumerate(pairwise(corners)):
        fraction, step = 0.0, 0.25
        while fraction < 1.0:
            ahead = min(fraction + step, 1.0)
            place, before = interpolate_sheet(near, far, ahead), track[-1]
            whole = (number + ahead) / (len(corners) - 1)
            there = _solve_both(left, right, place, before, fraction=whole)
            jumps_rad = [
                float(np.abs(there.left_rad - before.left_rad).max()),
                float(np.abs(there.right_rad - before.right_rad).max()),
            ]
            if max(jumps_rad) <= MAX_STEP_RAD:
                track.append(there)
                fraction, step = ahead, min(2.0 * step, 0.25)
            elif step > MIN_FRACTION:
                step *= 0.5
            else:
                at_left = jumps_rad[0] > jumps_rad[1]
                arm, other = (left, right) if at_left else (right, left)
                joints = before.left_rad if at_left else before.right_rad
                raise _explain_jump(arm, other, place, joints, fraction=whole)
    return track


def _explain_jump(
    arm: ArmGeometry,
    other: ArmGeometry,
    there: SheetMotion,
    before_rad: Floats,
    *,
    fraction: float,
) -> PathError:
    branch = arm.kinematics.find_branch(before_rad + arm.joint_offsets_rad)
    reach = compute_reach(arm, other, _make_poses([there]), branch)
    binding = int(reach.binding[0])
    limit = "jump" if binding < 0 else LIMITS[binding]
    why = (
        "its joint angles would jump"
        if binding < 0
        else f"its joint solution violates the limit {limit} beyond this position"
    )
    return PathError(arm.side, why, limit, fraction, there.world_from_sheet)


def _solve_joints(
    arm: ArmGeometry, place: SheetMotion, near_rad: Floats, *, fraction: float
) -> Floats:
    try:
        pose = compute_flange_poses(arm, _make_poses([place]))[0]
        return arm.solve_joints(pose, near_rad)
    except UnreachableError as error:
        limit = f"{error.limit} range" if f"{error.limit} range" in RANGES else error.limit
        raise PathError(arm.side, str(error), limit, fraction, place.world_from_sheet) from error


def _solve_both(
    left: ArmGeometry, right: ArmGeometry, sheet: SheetMotion, near: PathStep, *, fraction: float
) -> PathStep:
    return PathStep(
        sheet,
        _solve_joints(left, sheet, near.left_rad, fraction=fraction),
        _solve_joints(right, sheet, near.right_rad, fraction=fraction),
    )


def solve_step(
    left: ArmGeometry, right: ArmGeometry, sheet: SheetMotion, near: PathStep, *, fraction: float
) -> PathStep:
    """Solve the joint angles of both arms for a pose of the sheet.

    near: neighbouring step on the path, with joint angles near the solution.
    fraction: position on the path (0 to 1) for the error text.

    Raises PathError if a limit of COMMAND_LIMITS is violated.
    """
    step = _solve_both(left, right, sheet, near, fraction=fraction)
    places = _make_poses([sheet])
    flanges = [compute_flange_poses(arm, places) for arm in (left, right)]
    for number, (arm, joints) in enumerate(((left, step.left_rad), (right, step.right_rad))):
        margins = _margins(
            arm,
            joints=joints[None],
            flanges=flanges[number],
            others=flanges[1 - number],
            places=places,
        )
        for limit in COMMAND_LIMITS:
            if not margins[limit][0] >= 0.0:
                why = f"the limit {limit} is violated"
                raise PathError(arm.side, why, limit, fraction, sheet.world_from_sheet)
    return step


def interpolate_sheet(start: SheetMotion, goal: SheetMotion, fraction: float) -> SheetMotion:
    """Interpolate position, rotation and stretch of the sheet linearly between two poses.

    fraction: position between the poses, 0 at the start and 1 at the goal.

    The velocities of the result are zero.
    """
    begin, end = start.world_from_sheet, goal.world_from_sheet
    rotation_vector = vector_from_rotation(end[:3, :3] @ begin[:3, :3].T)
    rotation = rotation_from_vector(fraction * rotation_vector) @ begin[:3, :3]
    position = begin[:3, 3] + fraction * (end[:3, 3] - begin[:3, 3])
    stretch = start.stretch_ratio + fraction * (goal.stretch_ratio - start.stretch_ratio)
    return SheetMotion(transform(rotation, position), np.zeros(6), stretch, 0.0)


def _make_poses(motions: Sequence[SheetMotion]) -> SheetPoses:
    return SheetPoses(
        np.array([motion.world_from_sheet for motion in motions]),
        np.array([motion.stretch_ratio for motion in motions]),
        np.empty((len(motions), 0, 6)),
    )


def _check_limits(left: ArmGeometry, right: ArmGeometry, track: Sequence[PathStep]) -> None:
    """Raise PathError if one of the poses of a path violates a limit.

    A limit that is violated at the start may remain violated by the same amount, except at the end.
    """
    places = _make_poses([step.sheet for step in track])
    joints = (
        np.array([step.left_rad for step in track]),
        np.array([step.right_rad for step in track]),
    )
    flanges = [compute_flange_poses(arm, places) for arm in (left, right)]
    for index, arm in enumerate((left, right)):
        branch = arm.kinematics.find_branch(joints[index][0] + arm.joint_offsets_rad)
        own, other = flanges[index], flanges[1 - index]
        margins = _margins(arm, joints=joints[index], flanges=own, others=other, places=places)
        for margin in margins.values():
            if margin[0] < 0.0:
                margin[:-1] -= margin[0] - ROUNDING
        reach = ArmReach(branch, joints[index], margins)
        broken = np.flatnonzero(~reach.reachable)
        if len(broken):
            limit = LIMITS[int(reach.binding[broken[0]])]
            fraction = float(broken[0]) / max(len(track) - 1, 1)
            why = f"the limit {limit} is violated"
            raise PathError(arm.side, why, limit, fraction, places.world_from_sheet[broken[0]])
