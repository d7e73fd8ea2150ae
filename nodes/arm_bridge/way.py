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

from nodes.arm_bridge.geometry import ArmGeometry
from nodes.arm_bridge.reach import PathError, path_through
from nodes.models.motion import EdgeBound, SheetBounds, SheetMotion, follow_sheet
from nodes.models.rigid import is_rigid, vector_from_rotation

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


@dataclass(frozen=True, slots=True)
class Way:
    """From where the sheet is, with the joints (6,) of this arm and the other, to its target."""

    start: SheetMotion
    goal: SheetMotion
    own_rad: Floats
    other_rad: Floats

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


def trouble_on_way(arm: ArmGeometry, other: ArmGeometry, way: Way) -> str | None:
    """Which arm cannot take the sheet along the way, by which limit and where; None: both can."""
    left, right = (arm, other) if arm.left else (other, arm)
    if not (is_rigid(way.start.world_from_sheet) and is_rigid(way.goal.world_from_sheet)):
        return "no way: the edges do not say where the sheet is"
    own_rad, other_rad = way.own_rad, way.other_rad
    left_rad, right_rad = (own_rad, other_rad) if arm.left else (other_rad, own_rad)
    corners = rehearsed(way.start, way.goal, arm.edge_bound)
    try:
        path_through(left, right, corners, left_rad=left_rad, right_rad=right_rad)
    except PathError as error:
        return f"no way: {error}"
    return None


class Lookout:
    """Looks at one way after another in a thread, so that the cycles go on meanwhile."""

    def __init__(self, arm: ArmGeometry, other: ArmGeometry) -> None:
        self._arm, self._other = arm, other
        self._looking: tuple[Way, asyncio.Future[str | None]] | None = None

    def answer(self, question: Way | None) -> tuple[Way, str | None] | None:
        """The way that was asked for last and its trouble, once both are known; None: not yet.

        While none is looked at the question is taken up.  Called in every cycle.
        """
        if self._looking is None:
            if question is not None:
                looked = asyncio.get_running_loop().run_in_executor(
                    None, trouble_on_way, self._arm, self._other, question
                )
                self._looking = question, looked
            return None
        way, looked = self._looking
        if not looked.done():
            return None
        self._looking = None
        return way, looked.result()
