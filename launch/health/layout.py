"""Check whether two arms reach the whole working range of a scene.

The range is sampled over contact points on the object, sheet poses, push depths, stretches and
motions. Some sheet poses result from rolling. In this motion, the sheet tilts over the object
without slip, so that the contact also moves on the sheet. The sheet poses follow the rules of the
planner (`flexsheet.nodes.planner.rolling`). The reach of an arm follows the rules of its control
node (`flexsheet.nodes.arm_bridge.reach`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.reach import (
    LIMITS,
    SPEED_LIMITS,
    ArmReach,
    PathError,
    SheetPoses,
    find_best_reach,
    plan_path,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import Nearest, make_shape
from flexsheet.nodes.models.sheet.tension import stretch_for_edge_force
from flexsheet.nodes.planner.rolling import (
    SheetContact,
    compute_rolling_twist,
    make_tangent_contact,
    roll_contact,
)

Progress = Callable[[str], None]

TILTS, SIDE_TILTS, DEPTHS = 17, 5, 6
"""The numbers of sampled vertical tilts, horizontal tilts and push depths."""

VIEW_DISTANCE_M = 1.0
DUPLICATE_DISTANCE_M, DUPLICATE_NORMAL = 0.004, 0.02
"""The maximum differences of position (m) and unit normal between duplicate contacts."""

ROLL_STARTS = 24
"""The approximate number of contacts from which the sheet rolls to other contacts."""

CLAMP_MARGIN_M = 0.03
"""The minimum distance (m) between the finger and a clamped edge of the sheet."""


@dataclass(frozen=True, slots=True)
class ContactSample:
    """A contact of the finger with the object, and the pose of the sheet before a push.

    tilt_rad: angle between the surface normal and the direction towards the user. It is positive if
        the surface faces upwards.
    contact_world_m: contact point (3,).
    world_from_sheet: pose of the sheet (4, 4).
    twists_world: linear (m/s) and angular (rad/s) velocities (k, 6) of the sheet during k strokes
        at the working speed.
    """

    tilt_rad: float
    contact_world_m: Floats
    world_from_sheet: Floats
    twists_world: Floats


@dataclass(frozen=True, slots=True)
class LayoutSamples:
    """The n sampled sheet poses that the arms must reach.

    tilt_rad: tilts (n,) of the contact, as defined in `ContactSample`.
    depth_m: push depths (n,).
    contact_world_m: contact points (n, 3).
    """

    poses: SheetPoses
    tilt_rad: Floats
    depth_m: Floats
    contact_world_m: Floats


@dataclass(frozen=True, slots=True)
class Layout:
    """The result of the layout check: the reach of each arm, and blocked paths."""

    scene: Scene
    samples: LayoutSamples
    left: ArmReach
    right: ArmReach
    blocked_paths: tuple[str, ...]

    @property
    def reached(self) -> NDArray[np.bool_]:
        return self.left.reachable & self.right.reachable

    @property
    def followed(self) -> NDArray[np.bool_]:
        return self.left.trackable & self.right.trackable

    @property
    def reachable(self) -> bool:
        return bool(self.reached.all()) and not self.blocked_paths

    def speed_m_per_s(self, fraction: float) -> float:
        """Return the finger speed (m/s) that both arms can follow in a fraction of the samples.

        A sample is a sheet pose with a stretch and a push depth. Samples that an arm cannot reach
        are ignored. Return 0 if no sample is reachable.

        fraction: required fraction of the reachable samples, from 0 to 1.
        """
        if not self.reached.any():
            return 0.0
        speeds = np.minimum(*(self.speeds_m_per_s(reach) for _, reach in self.arms()))
        return float(np.quantile(speeds[self.reached], 1.0 - fraction))

    def speeds_m_per_s(self, reach: ArmReach) -> Floats:
        """Return the maximum finger speeds (n,), in m/s, that an arm can follow at n samples.

        The speeds of the arm and the sheet are assumed to be proportional to the speed of the
        finger. At samples that the arm cannot reach, the result is NaN.
        """
        used = np.max([1.0 - reach.margins[limit] for limit in SPEED_LIMITS], axis=0)
        return np.asarray(self.scene.working_range.speed_m_per_s / used)

    def arms(self) -> tuple[tuple[Side, ArmReach], tuple[Side, ArmReach]]:
        return ("left", self.left), ("right", self.right)


def sample_contacts(scene: Scene) -> list[ContactSample]:
    """Sample contact points on the object, with sheet poses at each point.

    The contact points are sampled from all directions within the scene's tilt range. In the first
    pose at each contact point, the object touches the centre of the sheet.

    In the other poses, the object touches another point of the sheet, because the sheet has rolled
    without slip from another contact point. Of these poses, only those with the extreme contact
    positions along the two axes of the sheet are used. A contact position outside the sheet's
    usable area is moved to the border of the area.
    """
    shape = make_shape(dict(scene.object.geometry))
    world_from_object = pose_matrix(scene.object.world_from_object)
    home = world_from_object[:3, :3].T
    most = np.array([0.5 * scene.sheet.width_m - CLAMP_MARGIN_M, scene.sheet.usable_half_height_m])
    found = _find_touchable_points(scene, world_from_object, shape.closest)
    ready = [make_tangent_contact(home, one, float(most[0])) for one in found]
    starts = ready[:: max(1, len(ready) // ROLL_STARTS)]
    rotation = np.kron(np.eye(2), world_from_object[:3, :3])
    result = []
    for one, waiting in zip(found, ready, strict=True):
        normal = world_from_object[:3, :3] @ one.normal
        lean = float(np.arctan2(np.hypot(normal[0], normal[1]), normal[2]))
        for contact in _list_contacts(waiting, starts, one, most):
            result.append(
                ContactSample(
                    tilt_rad=lean if normal[1] >= -1e-9 else -lean,
                    contact_world_m=apply(world_from_object, one.point),
                    world_from_sheet=world_from_object @ contact.object_from_sheet,
                    twists_world=np.array(
                        [
                            rotation
                            @ compute_rolling_twist(
                                contact, scene.working_range.speed_m_per_s * direction
                            )
                            for direction in (contact.axes[:, 0], contact.axes[:, 1])
                        ]
                    ),
                )
            )
    return result


def _find_touchable_points(
    scene: Scene, world_from_object: Floats, closest: Callable[[Floats], Nearest]
) -> list[Nearest]:
    most = scene.working_range.tilt_rad
    low, high = (np.array(v) for v in (scene.finger.volume_min_m, scene.finger.volume_max_m))
    fractions = np.linspace(0.0, 1.0, 3)
    offsets = [
        np.array([x, y, 0.0])
        for x in low[0] + fractions * (high[0] - low[0])
        for y in low[1] + fractions * (high[1] - low[1])
    ]
    centre = world_from_object[:3, 3]
    queries = []
    for up, side in product(np.linspace(-most, most, TILTS), np.linspace(-most, most, SIDE_TILTS)):
        lean = float(np.hypot(up, side))
        if lean > most + 1e-9:
            continue
        aside = np.array([side, up]) / lean if lean > 0.0 else np.zeros(2)
        away = np.array([*(np.sin(lean) * aside), np.cos(lean)])
        queries += [centre + VIEW_DISTANCE_M * away + offset for offset in offsets]
    found = closest(apply(inverse(world_from_object), np.array(queries)))
    front = world_from_object[:3, :3].T[:, 2]
    leans = np.arccos(np.clip(found.normal @ front, -1.0, 1.0))
    chosen: list[int] = []
    for index in np.flatnonzero(leans <= most + 1e-6):
        near = (
            np.linalg.norm(found.point[chosen] - found.point[index], axis=1) < DUPLICATE_DISTANCE_M
        )
        similar = (
            np.linalg.norm(found.normal[chosen] - found.normal[index], axis=1) < DUPLICATE_NORMAL
        )
        if not (near & similar).any():
            chosen.append(int(index))
    values = [getattr(found, field.name) for field in fields(Nearest)]
    return [Nearest(*(value[i] for value in values)) for i in chosen]


def _list_contacts(
    waiting: SheetContact, starts: Sequence[SheetContact], found: Nearest, most: Floats
) -> Iterator[SheetContact]:
    yield waiting
    rolls = [roll_contact(contact, found) for contact in starts]
    position_sheet_m = np.array([contact.position_sheet_m for contact in rolls])
    chosen = {
        int(pick(position_sheet_m[:, axis])) for axis in (0, 1) for pick in (np.argmin, np.argmax)
    }
    for index in sorted(chosen):
        yield replace(rolls[index], position_sheet_m=np.clip(position_sheet_m[index], -most, most))


def make_samples(scene: Scene, contacts: Sequence[ContactSample]) -> LayoutSamples:
    """Combine each contact with each push depth, and with the minimum and the maximum stretch.

    Each sample contains the sheet velocities that the arms must follow. These are the velocities of
    strokes over the object, and of a push along the sheet's normal at the scene's working speed.
    """
    sheet = scene.sheet
    longest = stretch_for_edge_force(sheet.max_edge_force_n, sheet)
    # The margin keeps a rounding error from exceeding the limit.
    largest = max(sheet.min_stretch_ratio, min(sheet.max_stretch_ratio, longest) - 1e-9)
    poses, stretches, twists, tilts, depths, positions = [], [], [], [], [], []
    for contact in contacts:
        normal = contact.world_from_sheet[:3, 2]
        push = np.concatenate([-scene.working_range.speed_m_per_s * normal, np.zeros(3)])
        for depth in np.linspace(0.0, scene.working_range.push_depth_m, DEPTHS):
            pose = contact.world_from_sheet.copy()
            pose[:3, 3] -= depth * normal
            for stretch in (sheet.min_stretch_ratio, largest):
                poses.append(pose)
                stretches.append(stretch)
                twists.append(np.vstack([contact.twists_world, push]))
                tilts.append(contact.tilt_rad)
                depths.append(depth)
                positions.append(contact.contact_world_m)
    return LayoutSamples(
        SheetPoses(np.array(poses), np.array(stretches), np.array(twists)),
        np.array(tilts),
        np.array(depths),
        np.array(positions),
    )


def check_layout(scene: Scene, progress: Progress = lambda text: None) -> Layout:
    """Check whether both arms reach the working range.

    progress: function that is called with a description of each step.
    """
    progress("finding the contacts on the object")
    samples = make_samples(scene, sample_contacts(scene))
    left, right = ArmGeometry(scene, "left"), ArmGeometry(scene, "right")
    progress(f"{len(samples.poses)} poses of the sheet, left arm")
    left_reach = find_best_reach(left, right, samples.poses)
    progress(f"{len(samples.poses)} poses of the sheet, right arm")
    right_reach = find_best_reach(right, left, samples.poses)
    found = Layout(scene, samples, left_reach, right_reach, ())
    progress("checking paths from the front to the limits of the range")
    return replace(found, blocked_paths=tuple(_find_blocked_paths(found, left, right)))


def _find_blocked_paths(layout: Layout, left: ArmGeometry, right: ArmGeometry) -> Iterator[str]:
    poses, reached = layout.samples.poses, layout.reached
    if not reached.any():
        return
    inside = np.flatnonzero(reached)

    def motion(index: int) -> SheetMotion:
        stretch = float(poses.stretch_ratio[index])
        return SheetMotion(poses.world_from_sheet[index], np.zeros(6), stretch, 0.0)

    tilt, depth = layout.samples.tilt_rad[inside], layout.samples.depth_m[inside]
    start = int(inside[np.lexsort((depth, np.abs(tilt)))[0]])
    centre = poses.world_from_sheet[inside, :3, 3]
    rim = {
        int(inside[pick(values)]) for values in (tilt, *centre.T) for pick in (np.argmin, np.argmax)
    }
    for goal in sorted(rim):
        try:
            plan_path(
                left,
                right,
                [motion(start), motion(goal)],
                left_rad=layout.left.joints_rad[start],
                right_rad=layout.right.joints_rad[start],
            )
        except PathError as error:
            tilt_deg = np.degrees(layout.samples.tilt_rad[goal])
            depth_mm = 1e3 * layout.samples.depth_m[goal]
            yield f"to {tilt_deg:.0f} degrees, {depth_mm:.0f} mm deep: {error}"


def make_layout_result(layout: Layout) -> dict[str, Any]:
    """Return the result of `flexsheet doctor --scene SCENE --json`."""
    return {
        "scene": layout.scene.name,
        "reachable": layout.reachable,
        "fraction": float(layout.reached.mean()),
        "fraction_at_working_speed": float(layout.followed.mean()),
        "speed_everywhere_m_per_s": layout.speed_m_per_s(1.0),
        "speed_at_half_m_per_s": layout.speed_m_per_s(0.5),
        "samples": len(layout.samples.poses),
        "arms": {side: _arm_result(layout, reach) for side, reach in layout.arms()},
        "blocked_paths": list(layout.blocked_paths),
    }


def _arm_result(layout: Layout, reach: ArmReach) -> dict[str, Any]:
    binding = reach.binding
    present = sorted(set(binding[binding >= 0].tolist()))
    return {
        "fraction": float(reach.reachable.mean()),
        "fraction_at_working_speed": float(reach.trackable.mean()),
        "branch": reach.branch._asdict(),
        "binding": [_summarize_limit(layout, number, binding) for number in present],
    }


def _summarize_limit(layout: Layout, number: int, binding: NDArray[np.intp]) -> dict[str, Any]:
    """Return how often samples violate a certain limit of an arm, and at which tilt this begins.

    A sample is counted if it violates this limit more than all other limits. The result contains
    the fraction of counted samples, and describes the counted sample with the smallest tilt.

    number: index of the limit.
    binding: for each of n samples, index (n,) of the limit that is violated most; -1 for reachable
        samples.
    """
    where = np.flatnonzero(binding == number)
    samples = layout.samples
    order = np.lexsort((samples.depth_m[where], np.round(np.abs(samples.tilt_rad[where]), 6)))
    first = int(where[order[0]])
    return {
        "limit": LIMITS[number],
        "fraction": float(len(where) / len(binding)),
        "first_tilt_rad": float(samples.tilt_rad[first]),
        "first_depth_m": float(samples.depth_m[first]),
        "first_contact_world_m": samples.contact_world_m[first].tolist(),
    }
