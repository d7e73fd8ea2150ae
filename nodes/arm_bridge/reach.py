"""Whether the arms can hold the sheet there: for many places at once, and along a path.

Places of the sheet are poses (n, 4, 4) in the world with stretches (n,), joints (n, 6) rad.  Each
limit's margin is positive where it is kept; margins of speeds are shares of what is allowed.  The
sheet is the constraint: both edges follow from its pose and stretch, so that they always agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.kinematics import (
    BRANCHES,
    CENTRE_RAD,
    FARTHEST_WRIST_M,
    FLANGE_M,
    SHOULDER_HEIGHT_M,
    SHOULDER_NEAR_M,
    WRIST_NEAR_RAD,
    Branch,
    UnreachableError,
    branch_of,
    branches,
    joints_on_branch,
    next_joints,
    singularities,
)
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from flexsheet.nodes.models.sheet import edge_force_n

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RANGES = tuple(f"J{joint} range" for joint in range(1, 7))
SPEEDS = tuple(f"J{joint} speed" for joint in range(1, 7))
PLACE_LIMITS = (
    "reach",
    *RANGES,
    "shoulder singularity",
    "elbow singularity",
    "wrist singularity",
    "workspace",
    "flange distance",
    "edge force",
)
COMMAND_LIMITS = ("reach", *RANGES, "workspace", "flange distance", "edge force")
"""Those without which the limiter lets no command through."""
SPEED_LIMITS = (*SPEEDS, "tool speed")
LIMITS = (*PLACE_LIMITS, *SPEED_LIMITS)
"""In the order in which the first that is not kept is said to bind."""

ELBOW_NEAR_RAD = WRIST_NEAR_RAD

CHOOSE = 500
"""About so many of the places decide on the branch."""

SPEED_STEP_S = 1e-4
"""Over which joint speeds are taken as differences."""

LARGEST_STEP_RAD = 0.05
"""Between two places of a path no joint goes further: a leap shows however close they are."""

FINEST_SHARE = 1e-6

ROUNDING = 1e-9
"""What a margin may shrink by without the limit being broken further."""

DETOURS_M = (
    (0.0, 0.0, 0.05),
    (0.0, 0.0, 0.1),
    (0.0, 0.05, 0.05),
    (0.0, -0.05, 0.05),
    (0.0, 0.08, 0.0),
    (0.0, -0.08, 0.0),
)
"""Where a path may go instead of straight on, in the world: towards the user first."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where the sheet shall be held: poses (n, 4, 4), stretch ratios (n,) and twists (n, k, 6).

    twists: k motions (m/s, rad/s) of the sheet's middle that the arms must be able to follow from
    there, in the world; k may be 0.
    """

    world_from_sheet: Floats
    stretch_ratio: Floats
    twists_world: Floats

    def __len__(self) -> int:
        return len(self.stretch_ratio)

    def some(self, chosen: NDArray[np.intp] | Bools) -> Places:
        """Those of the places that an index array (or one of truth values) names."""
        return Places(
            self.world_from_sheet[chosen], self.stretch_ratio[chosen], self.twists_world[chosen]
        )

    def without_motion(self) -> Places:
        """The same places, to be held only."""
        return Places(self.world_from_sheet, self.stretch_ratio, np.empty((len(self), 0, 6)))


@dataclass(frozen=True, slots=True)
class ArmReach:
    """How one arm holds its edge at n places, on one branch.

    joints_rad: (n, 6), NaN out of reach.  margins: of each of `LIMITS`, (n,); where the arm does
    not reach, those that follow from its joints are NaN.
    """

    branch: Branch
    joints_rad: Floats
    margins: Mapping[str, Floats]

    @property
    def binding(self) -> NDArray[np.intp]:
        """Number in `LIMITS` of the first limit that is not kept, (n,); -1 where all are."""
        found = np.full(len(self.joints_rad), -1)
        for number in reversed(range(len(LIMITS))):
            found[self.margins[LIMITS[number]] < 0.0] = number
        return found

    @property
    def reached(self) -> Bools:
        """Whether the arm can hold its edge there, (n,); how fast it would have to move or not."""
        binding = self.binding
        return np.asarray((binding < 0) | (binding >= len(PLACE_LIMITS)))

    @property
    def followed(self) -> Bools:
        """Whether it can, and can go on from there as fast as the twists ask for, (n,)."""
        return np.asarray(self.binding < 0)


def flange_poses(geometry: ArmGeometry, places: Places) -> Floats:
    """world_from_flange (n, 4, 4) of an arm that holds its edge of the sheet at the places."""
    width = geometry.sheet_limits.width_m
    outwards = -0.5 if geometry.left else 0.5
    edges = places.world_from_sheet.copy()
    offset = outwards * width * places.stretch_ratio[:, None] * edges[:, :3, 0]
    edges[:, :3, 3] += offset
    return np.asarray(edges @ inverse(geometry.flange_from_edge))


def arm_reach(
    geometry: ArmGeometry, other: ArmGeometry, places: Places, branch: Branch
) -> ArmReach:
    """How an arm holds the sheet at the places, on that branch; other: the other arm."""
    flanges = flange_poses(geometry, places)
    joints = joints_on_branch(geometry.base_from_world @ flanges, branch, CENTRE_RAD)
    others = flange_poses(other, places)
    margins = _margins(
        geometry, branch, joints=joints, flanges=flanges, others=others, places=places
    )
    return ArmReach(branch, joints, margins)


def best_reach(geometry: ArmGeometry, other: ArmGeometry, places: Places) -> ArmReach:
    """On the branch that reaches the most places; of equal ones that with the largest margins.

    An arm cannot go from one branch to another without letting go of what it does, hence one branch
    for all places.
    """
    still = places.without_motion().some(np.arange(0, len(places), max(1, len(places) // CHOOSE)))

    def merit(branch: Branch) -> tuple[float, float]:
        reach = arm_reach(geometry, other, still, branch)
        ranges = np.stack([reach.margins[limit] for limit in RANGES])
        room = np.where(np.isfinite(ranges), ranges, -np.pi).min(axis=0)
        return float(reach.reached.sum()), float(np.minimum(room, 0.2).sum())

    return arm_reach(geometry, other, places, max(BRANCHES, key=merit))


def _margins(
    geometry: ArmGeometry,
    branch: Branch,
    *,
    joints: Floats,
    flanges: Floats,
    others: Floats,
    places: Places,
) -> dict[str, Floats]:
    """Every limit's margin (n,) for joints (n, 6) that hold flanges (n, 4, 4) in the world.

    branch: that the joints are on, for where the sheet moves on from there.
    """
    limits, joint_limits = geometry.sheet_limits, geometry.joint_limits
    away = singularities(joints)
    spot = flanges[:, :3, 3]
    inside = np.minimum(spot - limits.workspace_min_m, limits.workspace_max_m - spot)
    apart = np.linalg.norm(spot - others[:, :3, 3], axis=1)
    force = np.array(
        [
            edge_force_n(
                stretch,
                young_modulus_pa=limits.young_modulus_pa,
                width_m=limits.width_m,
                height_m=limits.height_m,
                thickness_m=limits.thickness_m,
            )
            for stretch in places.stretch_ratio.tolist()
        ]
    )
    room = np.minimum(joints - joint_limits.lowest_rad, joint_limits.highest_rad - joints)
    base_from_flange = geometry.base_from_world @ flanges
    wrist = base_from_flange[:, :3, 3] - FLANGE_M * base_from_flange[:, :3, 2]
    reach = FARTHEST_WRIST_M - np.linalg.norm(wrist - [0.0, 0.0, SHOULDER_HEIGHT_M], axis=1)
    # A little beyond the reach there still are joints, with J3 out of its range.
    reached = np.isfinite(joints).all(axis=1)
    speeds, tool_speed = _speeds(geometry, branch, joints, flanges, places)
    spare = 1.0 - speeds / joint_limits.speed_rad_per_s
    return {
        "reach": np.where(reached, np.maximum(reach, 0.0), np.minimum(-np.abs(reach), -1e-9)),
        **{name: room[:, joint] for joint, name in enumerate(RANGES)},
        "shoulder singularity": away.shoulder_m - SHOULDER_NEAR_M,
        "elbow singularity": away.elbow_rad - ELBOW_NEAR_RAD,
        "wrist singularity": away.wrist_rad - WRIST_NEAR_RAD,
        "workspace": inside.min(axis=1),
        "flange distance": apart - limits.min_flange_distance_m,
        "edge force": limits.max_edge_force_n - force,
        **{name: spare[:, joint] for joint, name in enumerate(SPEEDS)},
        "tool speed": 1.0 - tool_speed / geometry.max_tool_speed,
    }


def _speeds(
    geometry: ArmGeometry, branch: Branch, joints: Floats, flanges: Floats, places: Places
) -> tuple[Floats, Floats]:
    """Largest joint speeds (n, 6) and speeds of edge and flange (n,) over the places' twists."""
    fastest, tool = np.zeros_like(joints), np.zeros(len(joints))
    centre = places.world_from_sheet[:, :3, 3]
    points = _tool_points(geometry, flanges)
    fastest[~np.isfinite(joints)] = np.nan
    reached = np.isfinite(joints).all(axis=1)
    for motion in range(places.twists_world.shape[1]):
        linear, angular = np.split(places.twists_world[:, motion], 2, axis=1)
        arms = points - centre[:, None]
        velocity = linear[:, None] + np.cross(angular[:, None], arms)
        tool = np.maximum(tool, np.linalg.norm(velocity, axis=2).max(axis=1))
        rates = _joint_rates(
            geometry, branch, flanges=flanges, linear=linear, angular=angular, centre=centre
        )
        fastest[reached] = np.fmax(fastest[reached], np.abs(rates[reached]))
    return fastest, tool


def _tool_points(geometry: ArmGeometry, flanges: Floats) -> Floats:
    """Middle and ends of the clamped edge, and the flange, (n, 4, 3) in the world."""
    half = 0.5 * geometry.sheet_limits.height_m
    edge = apply(
        geometry.flange_from_edge, np.array([[0.0, 0.0, 0.0], [0.0, -half, 0.0], [0.0, half, 0.0]])
    )
    points = np.einsum("nij,pj->npi", flanges[:, :3, :3], np.vstack([edge, np.zeros(3)]))
    return np.asarray(points + flanges[:, None, :3, 3])


def _joint_rates(
    geometry: ArmGeometry,
    branch: Branch,
    *,
    flanges: Floats,
    linear: Floats,
    angular: Floats,
    centre: Floats,
) -> Floats:
    """Joint speeds (n, 6) when the sheet's middle moves so; by central differences of the IK."""
    found = []
    for time_s in (-SPEED_STEP_S, SPEED_STEP_S):
        turn = _small_turns(angular * time_s)
        moved = flanges.copy()
        moved[:, :3, :3] = turn @ flanges[:, :3, :3]
        arm = flanges[:, :3, 3] - centre
        moved[:, :3, 3] = centre + linear * time_s + np.einsum("nij,nj->ni", turn, arm)
        found.append(joints_on_branch(geometry.base_from_world @ moved, branch, CENTRE_RAD))
    change = found[1] - found[0]
    return np.asarray((change - 2.0 * np.pi * np.rint(change / (2.0 * np.pi))) / (2 * SPEED_STEP_S))


def _small_turns(vectors: Floats) -> Floats:
    """Rotations (n, 3, 3) by vectors (n, 3) of less than a milliradian, to second order."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + cross + 0.5 * cross @ cross)


@dataclass(frozen=True, slots=True)
class SheetPath:
    """A way of the sheet that both arms can go: m places, from `start` to `goal`.

    left_rad, right_rad: joints (m, 6) of both arms, on one branch each.
    times_s: (m,) from 0, the least in which neither joints nor edges go too fast.
    via: whether it goes straight or round by somewhere: the detour's offset in the world, m.
    """

    places: Places
    left_rad: Floats
    right_rad: Floats
    times_s: Floats
    via_m: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class Step:
    """A place on the way, and the joints (6,) of both arms there."""

    sheet: SheetMotion
    left_rad: Floats
    right_rad: Floats


class PathError(ValueError):
    """The arms cannot carry the sheet that way; side, limit (of `LIMITS`, or "leap") and where.

    share: of the straight way, 0..1.
    """

    def __init__(
        self, why: str, *, side: Side, limit: str, share: float, world_from_sheet: Floats
    ) -> None:
        x, y, z = np.round(1e3 * world_from_sheet[:3, 3]) + 0.0
        super().__init__(
            f"{side} arm, at {100 * share:.0f} % of the way, "
            f"sheet at ({x:.0f}, {y:.0f}, {z:.0f}) mm: {why}"
        )
        self.side: Side = side
        self.limit = limit
        self.share = share


def coordinated_path(
    left: ArmGeometry,
    right: ArmGeometry,
    start: SheetMotion,
    goal: SheetMotion,
    *,
    left_rad: Floats | None = None,
    right_rad: Floats | None = None,
    detours_m: Sequence[tuple[float, float, float]] = DETOURS_M,
) -> SheetPath:
    """A way for both arms from one pose and stretch of the sheet to another; else PathError.

    left_rad, right_rad: joints (6,) at the start; without them every branch is tried.  The sheet
    goes straight and turns about one axis, its stretch changes evenly.  Where that does not work,
    it leaves the start, and comes to the goal, by one of the detours: both shifted by that offset.
    The error says what keeps it from the straight way.
    """
    starts = list(product(_starts(left, start, left_rad), _starts(right, start, right_rad)))
    first: PathError | None = None
    for via in (None, *detours_m):
        corners = [start, goal] if via is None else [start, *_shifted((start, goal), via), goal]
        for at_left, at_right in starts:
            try:
                track = _track(left, right, corners, Step(start, at_left, at_right))
                return _checked(left, right, track, via)
            except PathError as error:
                first = first or error
    assert first is not None
    raise first


def path_through(
    left: ArmGeometry,
    right: ArmGeometry,
    corners: Sequence[SheetMotion],
    *,
    left_rad: Floats,
    right_rad: Floats,
) -> SheetPath:
    """The way for both arms through all corners, straight between each two; else PathError.

    left_rad, right_rad: joints (6,) at the first of them.
    """
    begin = Step(
        corners[0],
        _joints_there(left, corners[0], left_rad, share=0.0),
        _joints_there(right, corners[0], right_rad, share=0.0),
    )
    return _checked(left, right, _track(left, right, corners, begin), None)


def _shifted(
    places: Sequence[SheetMotion], offset_m: tuple[float, float, float]
) -> list[SheetMotion]:
    return [
        SheetMotion(
            transform(
                place.world_from_sheet[:3, :3], place.world_from_sheet[:3, 3] + np.array(offset_m)
            ),
            place.twist_world,
            place.stretch_ratio,
            place.stretch_rate_per_s,
        )
        for place in places
    ]


def _track(
    left: ArmGeometry, right: ArmGeometry, corners: Sequence[SheetMotion], begin: Step
) -> list[Step]:
    """Places through all corners, each part straight, so near that no joint leaps; PathError."""
    track = [begin]
    for number, (near, far) in enumerate(pairwise(corners)):
        share, step = 0.0, 0.25
        while share < 1.0:
            ahead = min(share + step, 1.0)
            place, before = sheet_between(near, far, ahead), track[-1]
            whole = (number + ahead) / (len(corners) - 1)
            there = Step(
                place,
                _joints_there(left, place, before.left_rad, share=whole),
                _joints_there(right, place, before.right_rad, share=whole),
            )
            leaps = [
                float(np.abs(there.left_rad - before.left_rad).max()),
                float(np.abs(there.right_rad - before.right_rad).max()),
            ]
            if max(leaps) <= LARGEST_STEP_RAD:
                track.append(there)
                share, step = ahead, min(2.0 * step, 0.25)
            elif step > FINEST_SHARE:
                step *= 0.5
            else:
                at_left = leaps[0] > leaps[1]
                arm, other = (left, right) if at_left else (right, left)
                joints = before.left_rad if at_left else before.right_rad
                raise _leap(arm, other, place, joints, share=whole)
    return track


def _leap(
    arm: ArmGeometry,
    other: ArmGeometry,
    there: SheetMotion,
    before_rad: Floats,
    *,
    share: float,
) -> PathError:
    """Why an arm's branch does not go on to a place next to where its joints were `before_rad`."""
    reach = arm_reach(arm, other, _places([there]), branch_of(before_rad))
    binding = int(reach.binding[0])
    limit = "leap" if binding < 0 else LIMITS[binding]
    why = "its joints would leap" if binding < 0 else f"its branch ends: {limit}"
    return PathError(
        why, side=arm.side, limit=limit, share=share, world_from_sheet=there.world_from_sheet
    )


def _starts(arm: ArmGeometry, start: SheetMotion, given: Floats | None) -> list[Floats]:
    """Joints (6,) with which an arm may begin: those given, or of each branch in range.

    The branch with the most room to the ranges comes first.
    """
    if given is not None:
        return [_joints_there(arm, start, given, share=0.0)]
    pose = arm.base_from_world @ flange_poses(arm, _places([start]))[0]
    turns = np.array([0.0, 2.0 * np.pi, -2.0 * np.pi])
    lowest, highest = arm.joint_limits.lowest_rad, arm.joint_limits.highest_rad
    found: list[tuple[float, Floats]] = []
    for solution in branches(pose, CENTRE_RAD):
        turned = np.array(solution)[:, None] + turns
        room = np.minimum(turned - lowest[:, None], highest[:, None] - turned)
        joints = turned[np.arange(6), room.argmax(axis=1)]
        found.append((float(room.max(axis=1).min()), joints))
    found.sort(key=lambda one: -one[0])
    in_range = [joints for room, joints in found if room >= 0.0]
    return in_range or [_joints_there(arm, start, CENTRE_RAD, share=0.0)]


def _joints_there(
    arm: ArmGeometry, place: SheetMotion, near_rad: Floats, *, share: float
) -> Floats:
    try:
        pose = flange_poses(arm, _places([place]))[0]
        return next_joints(arm.base_from_world @ pose, near_rad)
    except UnreachableError as error:
        limit = error.limit if error.limit == "reach" else f"{error.limit} range"
        raise PathError(
            str(error),
            side=arm.side,
            limit=limit,
            share=share,
            world_from_sheet=place.world_from_sheet,
        ) from error


def hold_step(
    left: ArmGeometry, right: ArmGeometry, sheet: SheetMotion, near: Step, *, share: float
) -> Step:
    """Both arms' joints that hold the sheet there, near those of another step; else PathError.

    All limits of commands are kept: ranges, workspace, distance of the flanges and edge force, but
    not the distances to singularities.  share: of the path, for the error.
    """
    step = Step(
        sheet,
        _joints_there(left, sheet, near.left_rad, share=share),
        _joints_there(right, sheet, near.right_rad, share=share),
    )
    places = _places([sheet])
    flanges = [flange_poses(arm, places) for arm in (left, right)]
    for number, (arm, joints) in enumerate(((left, step.left_rad), (right, step.right_rad))):
        margins = _margins(
            arm,
            branch_of(joints),
            joints=joints[None],
            flanges=flanges[number],
            others=flanges[1 - number],
            places=places,
        )
        for limit in COMMAND_LIMITS:
            if not margins[limit][0] >= 0.0:
                raise PathError(
                    f"{limit} is not kept",
                    side=arm.side,
                    limit=limit,
                    share=share,
                    world_from_sheet=sheet.world_from_sheet,
                )
    return step


def sheet_between(start: SheetMotion, goal: SheetMotion, share: float) -> SheetMotion:
    """The sheet at rest on the straight way between two places."""
    begin, end = start.world_from_sheet, goal.world_from_sheet
    turn = vector_from_rotation(end[:3, :3] @ begin[:3, :3].T)
    rotation = rotation_from_vector(share * turn) @ begin[:3, :3]
    position = begin[:3, 3] + share * (end[:3, 3] - begin[:3, 3])
    stretch = start.stretch_ratio + share * (goal.stretch_ratio - start.stretch_ratio)
    return SheetMotion(transform(rotation, position), np.zeros(6), stretch, 0.0)


def _places(motions: Sequence[SheetMotion]) -> Places:
    return Places(
        np.array([motion.world_from_sheet for motion in motions]),
        np.array([motion.stretch_ratio for motion in motions]),
        np.empty((len(motions), 0, 6)),
    )


def _checked(
    left: ArmGeometry,
    right: ArmGeometry,
    track: Sequence[Step],
    via: tuple[float, float, float] | None,
) -> SheetPath:
    """The path if every place on it keeps all limits of both arms; PathError names the first.

    A limit that is not kept at the start need only not be broken further until the goal.
    """
    places = _places([step.sheet for step in track])
    joints = (
        np.array([step.left_rad for step in track]),
        np.array([step.right_rad for step in track]),
    )
    flanges = [flange_poses(arm, places) for arm in (left, right)]
    times = np.zeros(len(track))
    for index, arm in enumerate((left, right)):
        branch = branch_of(joints[index][0])
        own, other = flanges[index], flanges[1 - index]
        margins = _margins(
            arm, branch, joints=joints[index], flanges=own, others=other, places=places
        )
        for margin in margins.values():
            if margin[0] < 0.0:
                margin[:-1] -= margin[0] - ROUNDING
        reach = ArmReach(branch, joints[index], margins)
        broken = np.flatnonzero(~reach.reached)
        if len(broken):
            limit = LIMITS[int(reach.binding[broken[0]])]
            raise PathError(
                f"{limit} is not kept",
                side=arm.side,
                limit=limit,
                share=float(broken[0]) / max(len(track) - 1, 1),
                world_from_sheet=places.world_from_sheet[broken[0]],
            )
        steps = np.abs(np.diff(joints[index], axis=0)) / arm.joint_limits.speed_rad_per_s
        points = _tool_points(arm, own)
        travel = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1) / arm.max_tool_speed
        slowest = np.maximum(steps.max(axis=1), travel)
        times[1:] = np.maximum(times[1:], slowest)
    return SheetPath(places, joints[0], joints[1], np.cumsum(times), via)
