"""Check before a motion whether both arms can move the sheet to its target.

The bridge of each arm knows the joint angles of both arms. The bridge simulates the sheet's motion,
and checks whether both arms stay within their limits. A check takes some milliseconds and therefore
runs outside the control cycle. If necessary, the arms are first aligned: they move to joint angles
at which the sheet is flat and on the path.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

import numpy as np

from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.limiter import SheetLimits
from flexsheet.nodes.arm_bridge.reach import (
    PathError,
    PathStep,
    interpolate_sheet,
    plan_path,
    solve_step,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.interpolation import smoothstep
from flexsheet.nodes.models.motion import EdgeBound, SheetBounds, SheetMotion, follow_sheet
from flexsheet.nodes.models.rigid import is_rigid, vector_from_rotation

# Slow bounds (a quarter of the tool speed) for the motion from rest to the target, because the user
# may touch the sheet.
START_BOUNDS = SheetBounds(
    speed_m_per_s=0.06,
    acceleration_m_per_s2=0.3,
    turn_rad_per_s=0.5,
    turn_acceleration_rad_per_s2=2.5,
    stretch_rate_per_s=0.03,
    stretch_acceleration_per_s2=0.2,
)

REHEARSAL_STEP_S = 0.05
MAX_REHEARSAL_S = 60.0
"""The maximum duration of a simulated motion. Motions across the whole workspace are shorter."""

CORNER_EVERY = 4
"""The number of simulated steps between two corners of the checked path. The straight lines between
the corners deviate from the simulated motion by less than 1 mm."""

NEAR_M, NEAR_RAD, NEAR_STRETCH = 0.03, 0.2, 0.02
"""The maximum changes of a target in position (m), rotation (rad) and stretch ratio. If the target
has changed by more since a path check, the check is no longer valid."""

MAX_START_MOTION_RAD = 0.002
"""The maximum joint motion (rad) since a path check. If a joint has moved farther, the check is no
longer valid."""

ALIGN_FRACTIONS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""The positions on a path, as fractions of its length, to which the arms may align. The first
feasible position is used."""

MAX_ALIGN_STEP_RAD = 0.02
"""The maximum change of a joint between two checked points of an alignment."""

MAX_ALIGN_RAD = 1.0
"""The maximum joint motion of an alignment. A larger motion could switch to another solution of the
inverse kinematics."""

ALIGN_SPEED_M_PER_S, ALIGN_SPEED_RAD_PER_S = 0.06, 0.5
"""The maximum speeds of the sheet's edge and of the joints during an alignment."""

PEAK_TO_MEAN_SPEED = 1.5
"""The ratio of the maximum speed to the mean speed of the smoothstep function 3 x^2 - 2 x^3."""


@dataclass(frozen=True, slots=True)
class PathCheckRequest:
    """The start and the goal of a path of the sheet, and both arms' joint angles (6,) rad."""

    start: SheetMotion
    goal: SheetMotion
    own_rad: Floats
    other_rad: Floats

    def begins_at(self, own_rad: Floats, other_rad: Floats) -> bool:
        """Return whether both arms are still at the start of the path.

        own_rad, other_rad: present joint angles (6,).
        """
        moved_rad = max(
            float(np.abs(own_rad - self.own_rad).max()),
            float(np.abs(other_rad - self.other_rad).max()),
        )
        return moved_rad <= MAX_START_MOTION_RAD

    def leads_to(self, target: SheetMotion) -> bool:
        """Return whether a newer target is close to the target of the checked path."""
        distance_m, angle_rad = measure_distance(self.goal, target)
        stretch = abs(target.stretch_ratio - self.goal.stretch_ratio)
        return distance_m <= NEAR_M and angle_rad <= NEAR_RAD and stretch <= NEAR_STRETCH


def measure_distance(sheet: SheetMotion, target: SheetMotion) -> tuple[float, float]:
    """Return the distance (m) and the rotation angle (rad) between two poses of the sheet."""
    rotation = target.world_from_sheet[:3, :3] @ sheet.world_from_sheet[:3, :3].T
    offset = target.world_from_sheet[:3, 3] - sheet.world_from_sheet[:3, 3]
    return float(np.linalg.norm(offset)), float(np.linalg.norm(vector_from_rotation(rotation)))


def rehearse(start: SheetMotion, goal: SheetMotion, edges: EdgeBound) -> list[SheetMotion]:
    """Simulate the motion of the sheet until it rests at a goal, and return points of its path."""
    resting = replace(goal, twist_world=np.zeros(6), stretch_rate_per_s=0.0)
    sheet, corners = start, [start]
    for step in range(1, round(MAX_REHEARSAL_S / REHEARSAL_STEP_S)):
        sheet = follow_sheet(
            sheet, resting, bounds=START_BOUNDS, edges=edges, step_s=REHEARSAL_STEP_S
        )
        distance_m, angle_rad = measure_distance(sheet, resting)
        stretch = abs(resting.stretch_ratio - sheet.stretch_ratio)
        if not max(distance_m, angle_rad, stretch) > 1e-6:
            break
        if step % CORNER_EVERY == 0:
            corners.append(sheet)
    return [*corners, resting]


@dataclass(frozen=True, slots=True)
class Alignment:
    """A straight joint motion that moves one arm to a point on the path of the sheet.

    sheet: first pose on the path that both arms can reach.
    from_rad, to_rad: this arm's joint angles (6,) at the start and at the end.
    duration_s: duration, which is equal for both arms; 0 if no motion is necessary.

    An alignment is necessary if the arms have stopped with a twisted sheet, or with a joint at the
    end of its range.
    """

    sheet: SheetMotion
    from_rad: Floats
    to_rad: Floats
    duration_s: float

    def joints_at(self, time_s: float) -> Floats:
        """Return the joint angles (6,) rad of the alignment at `time_s` after its start."""
        part = min(1.0, time_s / self.duration_s) if self.duration_s > 0.0 else 1.0
        joints: Floats = self.from_rad + smoothstep(np.array(part)) * (self.to_rad - self.from_rad)
        return joints


def check_path(arm: ArmGeometry, other: ArmGeometry, request: PathCheckRequest) -> Alignment | str:
    """Check whether both arms can move the sheet to its target.

    Returns the joint motion that aligns this arm before the sheet moves, or a text that describes
    why there is no path. After the alignment, the sheet is flat and on the path.
    """
    left, right = (arm, other) if arm.left else (other, arm)
    if not (is_rigid(request.start.world_from_sheet) and is_rigid(request.goal.world_from_sheet)):
        return "no path: the sheet's pose is not rigid at the start or at the target"
    own_rad, other_rad = request.own_rad, request.other_rad
    left_rad, right_rad = (own_rad, other_rad) if arm.left else (other_rad, own_rad)
    begin = PathStep(request.start, left_rad, right_rad)
    first: PathError | None = None
    blocked = -1.0
    for fraction in ALIGN_FRACTIONS:
        if fraction <= blocked:
            continue
        sheet = interpolate_sheet(request.start, request.goal, fraction)
        try:
            there = solve_step(left, right, sheet, begin, fraction=fraction)
            _check_alignment(left, right, begin, there)
        except PathError as error:
            first = first or error
            continue
        try:
            corners = rehearse(sheet, request.goal, arm.edge_bound)
            plan_path(left, right, corners, left_rad=there.left_rad, right_rad=there.right_rad)
        except PathError as error:
            first = first or error
            # A start at a smaller fraction would lead to the blocked position again.
            blocked = fraction + error.fraction * (1.0 - fraction)
            continue
        to_rad = there.left_rad if arm.left else there.right_rad
        return Alignment(sheet, own_rad, to_rad, _find_duration_s(left, right, begin, there))
    assert first is not None
    return f"no path: {first}"


def _check_alignment(
    left: ArmGeometry, right: ArmGeometry, begin: PathStep, there: PathStep
) -> None:
    """Check the straight joint motion of both arms to a point on the sheet's path.

    begin, there: joint angles of both arms at the start and at the end.

    Raises PathError if a joint moves by more than MAX_ALIGN_RAD. Also raises PathError if the
    motion violates a limit of the sheet, of the distance between the flanges, or of the workspace.
    If a limit is already violated at the start, the motion may violate it slightly more.
    """
    changes = there.left_rad - begin.left_rad, there.right_rad - begin.right_rad
    max_change_rad = max(float(np.abs(change).max()) for change in changes)
    count = max(1, int(np.ceil(min(max_change_rad, MAX_ALIGN_RAD) / MAX_ALIGN_STEP_RAD)))
    arms = (left, right)
    limits: list[SheetLimits] = []
    for part in np.linspace(0.0, 1.0, count + 1):
        joints = begin.left_rad + part * changes[0], begin.right_rad + part * changes[1]
        flanges = [arm.world_from_flange(rad) for arm, rad in zip(arms, joints, strict=True)]
        for number, arm in enumerate(arms):
            own, other = flanges[number], flanges[1 - number]
            if part == 0.0:
                limits.append(arm.relax_limits(own, other))
            violation = arm.check_limits(own, other, limits[number])
            if violation is None and max_change_rad > MAX_ALIGN_RAD:
                violation = "its joint angles are too far from the path of the sheet"
            if violation is not None:
                pose = there.sheet.world_from_sheet
                raise PathError(arm.side, violation, "alignment", 0.0, pose)


def _find_duration_s(
    left: ArmGeometry, right: ArmGeometry, begin: PathStep, there: PathStep
) -> float:
    duration_s = 0.0
    for arm, start, end in (
        (left, begin.left_rad, there.left_rad),
        (right, begin.right_rad, there.right_rad),
    ):
        travel_m = arm.bound_edge_shift_m(start, end)
        change_rad = float(np.abs(end - start).max())
        duration_s = max(
            duration_s, travel_m / ALIGN_SPEED_M_PER_S, change_rad / ALIGN_SPEED_RAD_PER_S
        )
    return PEAK_TO_MEAN_SPEED * duration_s


class PathChecker:
    """A checker of paths that runs one check at a time in a separate thread."""

    def __init__(self, arm: ArmGeometry, other: ArmGeometry) -> None:
        self._arm, self._other = arm, other
        self._running: tuple[PathCheckRequest, asyncio.Future[Alignment | str]] | None = None

    def poll(
        self, request: PathCheckRequest | None
    ) -> tuple[PathCheckRequest, Alignment | str] | None:
        """Return a finished request and its result, or None if no check has finished.

        request: path whose check is started if no check is running; None if no check is necessary.

        The caller must call this method in every cycle.
        """
        if self._running is None:
            if request is not None:
                result = asyncio.get_running_loop().run_in_executor(
                    None, check_path, self._arm, self._other, request
                )
                self._running = request, result
            return None
        running, result = self._running
        if not result.done():
            return None
        self._running = None
        return running, result.result()
