"""How the sheet gets from where it is to its target, and whether both arms can take it there.

Looked at before a motion begins: each bridge knows both arms' joints, rehearses how the sheet will
go, and asks for each place on the way whether both arms hold it there within their limits.  That
takes some milliseconds, so it is not for the cycle in which an arm is sent a command.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.limiter import (
    SheetLimits,
    place_trouble,
    relaxed_limits,
    sheet_trouble,
)
from flexsheet.nodes.arm_bridge.reach import PathError, Step, hold_step, path_through, sheet_between
from flexsheet.nodes.arm_bridge.standstill import edge_shift_m
from flexsheet.nodes.models.motion import EdgeBound, SheetBounds, SheetMotion, follow_sheet
from flexsheet.nodes.models.rigid import is_rigid, vector_from_rotation

Floats = NDArray[np.float64]

# From a standstill to the target, with a person perhaps at the sheet: a quarter of the tool speed.
START_BOUNDS = SheetBounds(
    speed_m_per_s=0.06,
    acceleration_m_per_s2=0.3,
    turn_rad_per_s=0.5,
    turn_acceleration_rad_per_s2=2.5,
    stretch_rate_per_s=0.03,
    stretch_acceleration_per_s2=0.2,
)

REHEARSAL_STEP_S = 0.05
LONGEST_REHEARSAL_S = 60.0
"""At START_BOUNDS a sheet is anywhere in its workspace sooner."""

CORNER_EVERY = 4
"""Of the rehearsal's places, for the path between two of them bends by less than a millimetre."""

NEAR_M, NEAR_RAD, NEAR_STRETCH = 0.03, 0.2, 0.02
"""A target this near to the one that was looked at lies on the same way."""

MAX_START_MOTION_RAD = 0.002
"""Arms that have moved further since then begin elsewhere."""

ALIGN_AT = (0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Fractions of the path at which the arms may align to the sheet; the first that is feasible."""

ALIGN_STEP_RAD = 0.02
"""Between two checked points of an alignment no joint goes further."""

MAX_ALIGN_RAD = 1.0
"""An alignment that takes a joint further is not one: the arm would change its branch."""

ALIGN_SPEED_M_PER_S, ALIGN_SPEED_RAD_PER_S = 0.06, 0.5
"""Of any point of an edge, and of any joint, while the arms align."""

EASE = 1.5
"""Ratio of the largest to the mean speed of an eased motion (3 x^2 - 2 x^3)."""


@dataclass(frozen=True, slots=True)
class Way:
    """From where the sheet is, with the joints (6,) of this arm and the other, to its target."""

    start: SheetMotion
    goal: SheetMotion
    own_rad: Floats
    other_rad: Floats

    def begins_at(self, own_rad: Floats, other_rad: Floats) -> bool:
        """Whether both arms, measured again, still stand where the way begins."""
        moved = max(
            float(np.abs(own_rad - self.own_rad).max()),
            float(np.abs(other_rad - self.other_rad).max()),
        )
        return moved <= MAX_START_MOTION_RAD

    def leads_to(self, target: SheetMotion) -> bool:
        """Whether a target, which has moved on since, is still the end of this way."""
        distance, angle = lag(self.goal, target)
        longer = abs(target.stretch_ratio - self.goal.stretch_ratio)
        return distance <= NEAR_M and angle <= NEAR_RAD and longer <= NEAR_STRETCH


def lag(sheet: SheetMotion, target: SheetMotion) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two sheet poses."""
    turn = target.world_from_sheet[:3, :3] @ sheet.world_from_sheet[:3, :3].T
    shift = target.world_from_sheet[:3, 3] - sheet.world_from_sheet[:3, 3]
    return float(np.linalg.norm(shift)), float(np.linalg.norm(vector_from_rotation(turn)))


def rehearsed(start: SheetMotion, goal: SheetMotion, edges: EdgeBound) -> list[SheetMotion]:
    """Places of the sheet from the start to a goal that stands still, as the bridge would go."""
    still = replace(goal, twist_world=np.zeros(6), stretch_rate_per_s=0.0)
    sheet, corners = start, [start]
    for step in range(1, round(LONGEST_REHEARSAL_S / REHEARSAL_STEP_S)):
        sheet = follow_sheet(
            sheet, still, bounds=START_BOUNDS, edges=edges, step_s=REHEARSAL_STEP_S
        )
        distance, angle = lag(sheet, still)
        longer = abs(still.stretch_ratio - sheet.stretch_ratio)
        if not max(distance, angle, longer) > 1e-6:
            break
        if step % CORNER_EVERY == 0:
            corners.append(sheet)
    return [*corners, still]


@dataclass(frozen=True, slots=True)
class Alignment:
    """How an arm gets from where it stands onto the sheet, straight in its joints.

    Two arms that were stopped by a fault hold the sheet twisted, skewed or at an end of a joint's
    range; there may be no pose of an even sheet that both can hold.  sheet: the first pose on the
    path that they can.  from_rad, to_rad: this arm's joints (6,) now and there.  duration_s: of
    both arms alike; 0: they stand there already.
    """

    sheet: SheetMotion
    from_rad: Floats
    to_rad: Floats
    duration_s: float

    def joints_at(self, time_s: float) -> Floats:
        """The joints (6,) after so long."""
        part = min(1.0, time_s / self.duration_s) if self.duration_s > 0.0 else 1.0
        eased: Floats = self.from_rad + part * part * (3.0 - 2.0 * part) * (
            self.to_rad - self.from_rad
        )
        return eased


def check_way(arm: ArmGeometry, other: ArmGeometry, way: Way) -> Alignment | str:
    """Return how this arm begins on the path, or the reason why an arm cannot follow it.

    The reason names the arm, the limit and the position.
    """
    left, right = (arm, other) if arm.left else (other, arm)
    if not (is_rigid(way.start.world_from_sheet) and is_rigid(way.goal.world_from_sheet)):
        return "no way: the edges do not say where the sheet is"
    own_rad, other_rad = way.own_rad, way.other_rad
    left_rad, right_rad = (own_rad, other_rad) if arm.left else (other_rad, own_rad)
    begin = Step(way.start, left_rad, right_rad)
    first: PathError | None = None
    blocked = -1.0
    for fraction in ALIGN_AT:
        if fraction <= blocked:
            continue
        sheet = sheet_between(way.start, way.goal, fraction)
        try:
            there = hold_step(left, right, sheet, begin, share=fraction)
            _check_alignment(left, right, begin, there)
        except PathError as error:
            first = first or error
            continue
        try:
            corners = rehearsed(sheet, way.goal, arm.edge_bound)
            path_through(left, right, corners, left_rad=there.left_rad, right_rad=there.right_rad)
        except PathError as error:
            first = first or error
            # To begin before the place where the path is blocked would lead there again.
            blocked = fraction + error.share * (1.0 - fraction)
            continue
        to_rad = there.left_rad if arm.left else there.right_rad
        return Alignment(sheet, own_rad, to_rad, _duration_s(begin, there))
    assert first is not None
    return f"no way: {first}"


def trouble_on_way(arm: ArmGeometry, other: ArmGeometry, way: Way) -> str | None:
    """Which arm cannot take the sheet along the way, by which limit and where; None: both can."""
    found = check_way(arm, other, way)
    return found if isinstance(found, str) else None


def _check_alignment(left: ArmGeometry, right: ArmGeometry, begin: Step, there: Step) -> None:
    """PathError unless both arms can go straight in their joints from one step to another.

    The limits of the sheet are kept all along, but for what is exceeded at the beginning.
    """
    changes = there.left_rad - begin.left_rad, there.right_rad - begin.right_rad
    furthest = max(float(np.abs(change).max()) for change in changes)
    count = max(1, int(np.ceil(min(furthest, MAX_ALIGN_RAD) / ALIGN_STEP_RAD)))
    arms = (left, right)
    limits: list[SheetLimits] = []
    for part in np.linspace(0.0, 1.0, count + 1):
        joints = begin.left_rad + part * changes[0], begin.right_rad + part * changes[1]
        flanges = [arm.world_from_flange(rad) for arm, rad in zip(arms, joints, strict=True)]
        edges = [flange @ arm.flange_from_edge for arm, flange in zip(arms, flanges, strict=True)]
        for number, arm in enumerate(arms):
            poses = flanges[number], edges[number], flanges[1 - number], edges[1 - number]
            if part == 0.0:
                limits.append(relaxed_limits(arm.sheet_limits, *poses, left=arm.left))
            trouble = place_trouble(poses[0], poses[2], limits[number]) or sheet_trouble(
                poses[1], poses[3], left=arm.left, limits=limits[number]
            )
            if trouble is None and furthest > MAX_ALIGN_RAD:
                trouble = "its joints would leap onto the path"
            if trouble is not None:
                raise PathError(
                    trouble,
                    side=arm.side,
                    limit="alignment",
                    share=0.0,
                    world_from_sheet=there.sheet.world_from_sheet,
                )


def _duration_s(begin: Step, there: Step) -> float:
    """How long an alignment takes at its speeds."""
    longest_s = 0.0
    for start, end in (
        (begin.left_rad, there.left_rad),
        (begin.right_rad, there.right_rad),
    ):
        travel_m = edge_shift_m(start, end)
        turn_rad = float(np.abs(end - start).max())
        longest_s = max(longest_s, travel_m / ALIGN_SPEED_M_PER_S, turn_rad / ALIGN_SPEED_RAD_PER_S)
    return EASE * longest_s


class Lookout:
    """Looks at one way after another in a thread, so that the cycles go on meanwhile."""

    def __init__(self, arm: ArmGeometry, other: ArmGeometry) -> None:
        self._arm, self._other = arm, other
        self._looking: tuple[Way, asyncio.Future[Alignment | str]] | None = None

    def answer(self, question: Way | None) -> tuple[Way, Alignment | str] | None:
        """The way that was asked for last, and what `check_way` found; None: not yet known.

        While none is looked at the question is taken up.  Called in every cycle.
        """
        if self._looking is None:
            if question is not None:
                looked = asyncio.get_running_loop().run_in_executor(
                    None, check_way, self._arm, self._other, question
                )
                self._looking = question, looked
            return None
        way, looked = self._looking
        if not looked.done():
            return None
        self._looking = None
        return way, looked.result()
