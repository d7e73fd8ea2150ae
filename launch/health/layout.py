"""Whether two arms reach all of a scene's working range, what keeps them from it, what helps.

The range is sampled: where a finger can touch the object, how the sheet can lie there, how deep it
is pushed, how far it is stretched, how fast it must move on.  How the sheet lies follows the
planner's own rules (`flexsheet.nodes.planner.rolling`), whether an arm can hold it the bridge's
(`flexsheet.nodes.arm_bridge.reach`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Arms, ArmSpec, Pose, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.reach import (
    LIMITS,
    RANGES,
    SPEED_LIMITS,
    SPEEDS,
    ArmReach,
    PathError,
    SheetPoses,
    find_best_reach,
    plan_path,
)
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import apply, inverse, transform_from_rpy
from flexsheet.nodes.models.shapes import Nearest, make_shape
from flexsheet.nodes.models.sheet import stretch_for_edge_force
from flexsheet.nodes.planner.rolling import (
    SheetContact,
    compute_rolling_twist,
    make_tangent_contact,
    roll_contact,
)

Floats = NDArray[np.float64]
Progress = Callable[[str], None]

TILTS, TURNS, DEPTHS = 17, 5, 6
"""Samples over the tilts up and down, those to the sides, and the depths."""

FAR_M = 1.0
SAME_M, SAME_NORMAL = 0.004, 0.02
"""Contacts nearer than both count as one."""

STARTS = 24
"""Contacts that the sheet is rolled from, to see where on it a place can be touched."""

CLAMP_MARGIN_M = 0.03
"""A finger does not come nearer to a clamped edge than this."""

OFFSETS_M = (-0.15, -0.1, -0.05, -0.025, 0.0, 0.025, 0.05, 0.1, 0.15)
"""Along each axis, where else a base is tried."""

REACHED_COLOR = "#dcefdc"

THINNED = 600
"""Number of samples that decide whether a base position is worth a complete check."""


@dataclass(frozen=True, slots=True)
class Touch:
    """A place where the finger can touch, and how the sheet can lie there without a push.

    tilt_rad: of the normal away from the user, positive upwards.
    world_from_sheet: (4, 4).  twists_world: (k, 6), the sheet's motions when the finger strokes on
    from there at the scene's working speed.
    """

    tilt_rad: float
    contact_world_m: Floats
    world_from_sheet: Floats
    twists_world: Floats


Touches = Callable[[Scene], Sequence[Touch]]
"""Where a scene's object can be touched and how the sheet lies there."""


@dataclass(frozen=True, slots=True)
class Samples:
    """All that the arms are asked: places, with the tilt (n,), depth (n,) and contact (n, 3)."""

    places: SheetPoses
    tilt_rad: Floats
    depth_m: Floats
    contact_world_m: Floats


@dataclass(frozen=True, slots=True)
class Remedy:
    """Something that would make all of the range reachable, in words and figures."""

    what: str
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Layout:
    """What the check found: each arm's reach at the samples, ways between them, remedies."""

    scene: Scene
    samples: Samples
    left: ArmReach
    right: ArmReach
    broken_ways: tuple[str, ...]
    remedies: tuple[Remedy, ...]

    @property
    def reached(self) -> NDArray[np.bool_]:
        return self.left.reachable & self.right.reachable

    @property
    def followed(self) -> NDArray[np.bool_]:
        return self.left.trackable & self.right.trackable

    @property
    def reachable(self) -> bool:
        return bool(self.reached.all()) and not self.broken_ways

    def speed_m_per_s(self, share: float) -> float:
        """With what speed a finger may move at that share (0..1) of the places reached; else 0."""
        if not self.reached.any():
            return 0.0
        speeds = np.minimum(*(self.speeds_m_per_s(reach) for _, reach in self.arms()))
        return float(np.quantile(speeds[self.reached], 1.0 - share))

    def speeds_m_per_s(self, reach: ArmReach) -> Floats:
        """With what speed (n,) a finger may stroke and push, for this arm to follow; NaN: nowhere.

        All speeds of arm and sheet are in proportion to the finger's.
        """
        used = np.max([1.0 - reach.margins[limit] for limit in SPEED_LIMITS], axis=0)
        return np.asarray(self.scene.working_range.speed_m_per_s / used)

    def arms(self) -> tuple[tuple[Side, ArmReach], tuple[Side, ArmReach]]:
        return ("left", self.left), ("right", self.right)


def touches(scene: Scene) -> list[Touch]:
    """The places that a finger can touch, and the sheet there, for any shape.

    The object is looked at from all sides within the scene's tilt.  At each place the sheet may lie
    with its middle line there, as it is presented to a finger that comes, or as it lies when it was
    rolled there from another place: those rolls that bring the touched point furthest along the
    sheet, each way, are taken, as far as the sheet's usable half-height and half-width go.
    """
    shape = make_shape(dict(scene.object.geometry))
    place = scene.object.world_from_object
    world_from_object = transform_from_rpy(place.position_m, place.rpy_rad)
    home = world_from_object[:3, :3].T
    most = np.array([0.5 * scene.sheet.width_m - CLAMP_MARGIN_M, scene.sheet.usable_half_height_m])
    found = _seen(scene, world_from_object, shape.closest)
    ready = [make_tangent_contact(home, one, float(most[0])) for one in found]
    begun = ready[:: max(1, len(ready) // STARTS)]
    turn = np.kron(np.eye(2), world_from_object[:3, :3])
    result = []
    for one, waiting in zip(found, ready, strict=True):
        normal = world_from_object[:3, :3] @ one.normal
        lean = float(np.arctan2(np.hypot(normal[0], normal[1]), normal[2]))
        for contact in _ways_to_lie(waiting, begun, one, most):
            result.append(
                Touch(
                    tilt_rad=lean if normal[1] >= -1e-9 else -lean,
                    contact_world_m=apply(world_from_object, one.point),
                    world_from_sheet=world_from_object @ contact.object_from_sheet,
                    twists_world=np.array(
                        [
                            turn
                            @ compute_rolling_twist(
                                contact, scene.working_range.speed_m_per_s * way
                            )
                            for way in (contact.axes[:, 0], contact.axes[:, 1])
                        ]
                    ),
                )
            )
    return result


def _seen(
    scene: Scene, world_from_object: Floats, closest: Callable[[Floats], Nearest]
) -> list[Nearest]:
    """Touchable points whose normals lean no further than the scene's tilt, each once."""
    most = scene.working_range.tilt_rad
    low, high = (np.array(v) for v in (scene.finger.volume_min_m, scene.finger.volume_max_m))
    shares = np.linspace(0.0, 1.0, 3)
    beside = [
        np.array([x, y, 0.0])
        for x in low[0] + shares * (high[0] - low[0])
        for y in low[1] + shares * (high[1] - low[1])
    ]
    middle = world_from_object[:3, 3]
    queries = []
    for up, side in product(np.linspace(-most, most, TILTS), np.linspace(-most, most, TURNS)):
        lean = float(np.hypot(up, side))
        if lean > most + 1e-9:
            continue
        aside = np.array([side, up]) / lean if lean > 0.0 else np.zeros(2)
        away = np.array([*(np.sin(lean) * aside), np.cos(lean)])
        queries += [middle + FAR_M * away + offset for offset in beside]
    found = closest(apply(inverse(world_from_object), np.array(queries)))
    front = world_from_object[:3, :3].T[:, 2]
    leans = np.arccos(np.clip(found.normal @ front, -1.0, 1.0))
    kept: list[int] = []
    for index in np.flatnonzero(leans <= most + 1e-6):
        near = np.linalg.norm(found.point[kept] - found.point[index], axis=1) < SAME_M
        alike = np.linalg.norm(found.normal[kept] - found.normal[index], axis=1) < SAME_NORMAL
        if not (near & alike).any():
            kept.append(int(index))
    return [
        Nearest(
            found.point[i],
            found.normal[i],
            found.height_m[i],
            found.shape_operator[i],
            found.on_edge[i],
            found.undecided[i],
        )
        for i in kept
    ]


def _ways_to_lie(
    waiting: SheetContact, begun: Sequence[SheetContact], found: Nearest, most: Floats
) -> Iterator[SheetContact]:
    """The sheet held ready at a point, and as it lies there after the longest rolls."""
    yield waiting
    rolls = [roll_contact(contact, found) for contact in begun]
    position_sheet_m = np.array([contact.position_sheet_m for contact in rolls])
    chosen = {
        int(pick(position_sheet_m[:, axis])) for axis in (0, 1) for pick in (np.argmin, np.argmax)
    }
    for index in sorted(chosen):
        yield replace(rolls[index], position_sheet_m=np.clip(position_sheet_m[index], -most, most))


def samples_of(scene: Scene, touch_places: Sequence[Touch]) -> Samples:
    """Every touch at every depth and at the least and largest stretch.

    With the push the sheet yields along its normal, by at most as much; pushing at the working
    speed is one of the motions that the arms must follow.
    """
    sheet = scene.sheet
    longest = stretch_for_edge_force(
        sheet.max_edge_force_n,
        young_modulus_pa=sheet.young_modulus_pa,
        width_m=sheet.width_m,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    # A hair inside, so that the limit itself is not what rounding makes of it.
    largest = max(sheet.min_stretch_ratio, min(sheet.max_stretch_ratio, longest) - 1e-9)
    poses, stretches, twists, tilts, depths, contacts = [], [], [], [], [], []
    for touch in touch_places:
        normal = touch.world_from_sheet[:3, 2]
        push = np.concatenate([-scene.working_range.speed_m_per_s * normal, np.zeros(3)])
        for depth in np.linspace(0.0, scene.working_range.push_depth_m, DEPTHS):
            pose = touch.world_from_sheet.copy()
            pose[:3, 3] -= depth * normal
            for stretch in (sheet.min_stretch_ratio, largest):
                poses.append(pose)
                stretches.append(stretch)
                twists.append(np.vstack([touch.twists_world, push]))
                tilts.append(touch.tilt_rad)
                depths.append(depth)
                contacts.append(touch.contact_world_m)
    return Samples(
        SheetPoses(np.array(poses), np.array(stretches), np.array(twists)),
        np.array(tilts),
        np.array(depths),
        np.array(contacts),
    )


def check_layout(
    scene: Scene, *, progress: Progress = lambda text: None, touches_of: Touches = touches
) -> Layout:
    """Ask both arms for all of the scene's working range, and look for remedies where it fails."""
    progress("where the object can be touched")
    samples = samples_of(scene, touches_of(scene))
    left, right = ArmGeometry(scene, "left"), ArmGeometry(scene, "right")
    progress(f"{len(samples.places)} places of the sheet, left arm")
    left_reach = find_best_reach(left, right, samples.places)
    progress(f"{len(samples.places)} places of the sheet, right arm")
    right_reach = find_best_reach(right, left, samples.places)
    found = Layout(scene, samples, left_reach, right_reach, (), ())
    progress("ways from the front to the farthest places")
    found = replace(found, broken_ways=tuple(_broken_ways(found, left, right)))
    if found.reached.all():
        return found
    return replace(found, remedies=tuple(_remedies(found, progress)))


def _broken_ways(layout: Layout, left: ArmGeometry, right: ArmGeometry) -> Iterator[str]:
    """Where the arms cannot go from the front to a reachable place at the range's rim."""
    places, reached = layout.samples.places, layout.reached
    if not reached.any():
        return
    fair = np.flatnonzero(reached)

    def motion(index: int) -> SheetMotion:
        stretch = float(places.stretch_ratio[index])
        return SheetMotion(places.world_from_sheet[index], np.zeros(6), stretch, 0.0)

    tilt, depth = layout.samples.tilt_rad[fair], layout.samples.depth_m[fair]
    start = int(fair[np.lexsort((depth, np.abs(tilt)))[0]])
    centre = places.world_from_sheet[fair, :3, 3]
    rim = {
        int(fair[pick(values)]) for values in (tilt, *centre.T) for pick in (np.argmin, np.argmax)
    }
    for goal in sorted(rim):
        try:
            plan_path(
                left,
                right,
                motion(start),
                motion(goal),
                left_rad=layout.left.joints_rad[start],
                right_rad=layout.right.joints_rad[start],
            )
        except PathError as error:
            tilt_deg = np.degrees(layout.samples.tilt_rad[goal])
            depth_mm = 1e3 * layout.samples.depth_m[goal]
            yield f"to {tilt_deg:.0f} degrees, {depth_mm:.0f} mm deep: {error}"


def _remedies(layout: Layout, progress: Progress) -> Iterator[Remedy]:
    """What would make all reachable: bases moved, less tilt, less depth, less speed."""
    moved: dict[Side, Floats] = {}
    for side, reach in layout.arms():
        if not reach.reachable.all():
            progress(f"other places for the {side} base")
            offset = _base_offset(layout, side)
            if offset is None:
                moved.clear()
                break
            moved[side] = offset
    if moved:
        words = " and ".join(
            f"{side} base by ({', '.join(f'{1e3 * one:+.0f}' for one in offset)}) mm"
            for side, offset in moved.items()
        )
        yield Remedy(
            f"move the {words} along the world's x, y, z",
            {f"{side}_base_offset_m": offset.tolist() for side, offset in moved.items()},
        )
    reached = layout.reached
    for name, values, unit, factor in (
        ("tilt", np.abs(layout.samples.tilt_rad), "degrees", 180.0 / np.pi),
        ("push_depth", layout.samples.depth_m, "mm", 1e3),
    ):
        bad = values[~reached]
        fair = values[values < bad.min() - 1e-9] if len(bad) else values
        if len(fair) and fair.max() > 0.0:
            largest = float(fair.max())
            key = "tilt_rad" if name == "tilt" else "push_depth_m"
            yield Remedy(
                f"working_range.{key}: no more than {factor * largest:.1f} {unit}", {key: largest}
            )


def with_base_moved(scene: Scene, side: Side, offset_m: Floats) -> Scene:
    """The scene with one arm's base shifted in the world."""
    arms = scene.arms
    arm: ArmSpec = getattr(arms, side)
    base = Pose(
        position_m=np.asarray(arm.world_from_base.position_m) + offset_m,
        rpy_rad=arm.world_from_base.rpy_rad,
    )
    changed: Arms = arms.model_copy(update={side: arm.model_copy(update={"world_from_base": base})})
    return scene.model_copy(update={"arms": changed})


def _base_offset(layout: Layout, side: Side) -> Floats | None:
    """The least of the tried shifts of a base with which that arm reaches all, or None."""
    other: Side = "right" if side == "left" else "left"
    reach = layout.left if side == "left" else layout.right
    bad = np.flatnonzero(~reach.reachable)
    fair = np.flatnonzero(reach.reachable)
    # Where the flange may be does not depend on where the base is.
    elsewhere = {"workspace", "flange distance", "edge force"}
    if any(LIMITS[number] in elsewhere for number in set(reach.binding[bad].tolist())):
        return None
    chosen = np.concatenate(
        [bad[:: max(1, 2 * len(bad) // THINNED)], fair[:: max(1, 2 * len(fair) // THINNED)]]
    )
    thin = layout.samples.places.some(chosen)
    other_arm = ArmGeometry(layout.scene, other)
    offsets = sorted(
        (np.array(one) for one in product(OFFSETS_M, repeat=3)),
        key=lambda one: (round(float(np.linalg.norm(one)), 6), *np.abs(one)),
    )
    for offset in offsets[1:]:
        arm = ArmGeometry(with_base_moved(layout.scene, side, offset), side)
        if not find_best_reach(arm, other_arm, thin.without_twists()).reachable.all():
            continue
        if find_best_reach(arm, other_arm, layout.samples.places.without_twists()).reachable.all():
            return offset
    return None


def layout_result(layout: Layout) -> dict[str, Any]:
    """What `doctor scene --json` prints."""
    return {
        "scene": layout.scene.name,
        "reachable": layout.reachable,
        "share": float(layout.reached.mean()),
        "share_at_working_speed": float(layout.followed.mean()),
        "speed_everywhere_m_per_s": layout.speed_m_per_s(1.0),
        "speed_at_half_m_per_s": layout.speed_m_per_s(0.5),
        "samples": len(layout.samples.places),
        "arms": {side: _arm_result(layout, reach) for side, reach in layout.arms()},
        "broken_ways": list(layout.broken_ways),
        "remedies": [{"what": one.what, **one.values} for one in layout.remedies],
    }


def _arm_result(layout: Layout, reach: ArmReach) -> dict[str, Any]:
    binding = reach.binding
    present = sorted(set(binding[binding >= 0].tolist()))
    return {
        "share": float(reach.reachable.mean()),
        "share_at_working_speed": float(reach.trackable.mean()),
        "branch": reach.branch._asdict(),
        "binding": [_first(layout, number, binding) for number in present],
        "least_margins": least_margins(layout, reach),
    }


def _first(layout: Layout, number: int, binding: NDArray[np.intp]) -> dict[str, Any]:
    """Where a limit binds, and where nearest to the front: by the tilt, then by the depth."""
    where = np.flatnonzero(binding == number)
    samples = layout.samples
    order = np.lexsort((samples.depth_m[where], np.round(np.abs(samples.tilt_rad[where]), 6)))
    first = int(where[order[0]])
    return {
        "limit": LIMITS[number],
        "share": float(len(where) / len(binding)),
        "first_tilt_rad": float(samples.tilt_rad[first]),
        "first_depth_m": float(samples.depth_m[first]),
        "first_contact_world_m": samples.contact_world_m[first].tolist(),
    }


def least_margins(layout: Layout, reach: ArmReach) -> dict[str, dict[str, float | str]]:
    """The least margin of each kind over all samples, what it is of, and at what tilt and depth."""
    kinds = {
        "joint range": (RANGES, "rad"),
        "shoulder singularity": (("shoulder singularity",), "m"),
        "elbow singularity": (("elbow singularity",), "rad"),
        "wrist singularity": (("wrist singularity",), "rad"),
        "workspace": (("workspace",), "m"),
        "flange distance": (("flange distance",), "m"),
        "edge force": (("edge force",), "N"),
        "joint speed": (SPEEDS, "share"),
        "tool speed": (("tool speed",), "share"),
    }
    result: dict[str, dict[str, float | str]] = {}
    for kind, (limits, unit) in kinds.items():
        values = np.stack([reach.margins[limit] for limit in limits])
        if not np.isfinite(values).any():
            continue
        limit, sample = np.unravel_index(np.nanargmin(values), values.shape)
        result[kind] = {
            "limit": limits[int(limit)],
            "margin": float(values[limit, sample]),
            "unit": unit,
            "tilt_rad": float(layout.samples.tilt_rad[sample]),
            "depth_m": float(layout.samples.depth_m[sample]),
        }
    return result


def draw_layout(layout: Layout, path: Path) -> None:
    """Draw maps over tilt and depth, for each arm: what binds where, and how fast it can follow."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    grid = _Grid.of(layout)
    present = {int(n) for _, reach in layout.arms() for n in set(_place_binding(reach).tolist())}
    colors = {n: f"C{i % 10}" for i, n in enumerate(sorted(present - {-1}))}
    asked = 1e3 * layout.scene.working_range.speed_m_per_s
    for column, (side, reach) in enumerate(layout.arms()):
        upper, lower = panels[0, column], panels[1, column]
        upper.imshow(grid.colored(_place_binding(reach), colors), **grid.frame)
        upper.set_title(f"{side} arm: reaches {100 * reach.reachable.mean():.1f} %")
        speeds = np.where(reach.reachable, 1e3 * layout.speeds_m_per_s(reach), np.nan)
        shown = lower.imshow(grid.least(speeds), vmin=0.0, vmax=2.0 * asked, **grid.frame)
        followed = 100 * reach.trackable.mean()
        lower.set_title(f"{side} arm: follows {asked:.0f} mm/s at {followed:.1f} %")
        lower.set_xlabel("tilt of the contact, degrees (positive: facing up)")
        panels[column, 0].set_ylabel("push depth, mm")
    figure.colorbar(shown, ax=panels[1], label="finger's speed that is followed, mm/s")
    legend = [Patch(color=REACHED_COLOR, label="reached")]
    legend += [Patch(color=color, label=LIMITS[n]) for n, color in colors.items()]
    panels[0, 1].legend(handles=legend, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    figure.suptitle(
        f"{layout.scene.name}: both arms reach {100 * layout.reached.mean():.1f} % of the working "
        "range"
    )
    figure.savefig(path, dpi=100)


def _place_binding(reach: ArmReach) -> NDArray[np.intp]:
    """Number of the limit that keeps the arm from a place, (n,); -1 where it reaches it."""
    return np.where(reach.reachable, -1, reach.binding)


@dataclass(frozen=True, slots=True)
class _Grid:
    """Cells over tilt and depth; rows, columns: of each sample (n,).  frame: how to draw them."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    frame: dict[str, Any]

    @classmethod
    def of(cls, layout: Layout) -> _Grid:
        tilt, depth = layout.samples.tilt_rad, layout.samples.depth_m
        most = layout.scene.working_range.tilt_rad
        deepest = layout.scene.working_range.push_depth_m
        columns = np.rint((tilt + most) / (2.0 * most) * (TILTS - 1)).astype(np.intp)
        rows = np.rint(depth / deepest * (DEPTHS - 1)).astype(np.intp)
        wide, high = np.degrees(most) / (TILTS - 1), 0.5e3 * deepest / (DEPTHS - 1)
        extent = (
            -np.degrees(most) - wide,
            np.degrees(most) + wide,
            -high,
            1e3 * deepest + high,
        )
        frame = {"origin": "lower", "aspect": "auto", "extent": extent}
        return cls(rows, np.clip(columns, 0, TILTS - 1), frame)

    def least(self, values: Floats) -> Floats:
        """The least value in each cell; NaN where there is none."""
        cells = np.full((DEPTHS, TILTS), np.inf)
        finite = np.isfinite(values)
        np.minimum.at(cells, (self.rows[finite], self.columns[finite]), values[finite])
        return np.where(np.isfinite(cells), cells, np.nan)

    def colored(self, binding: NDArray[np.intp], colors: dict[int, str]) -> Floats:
        """Each cell's colour: of the limit that binds most often, paler where it seldom does."""
        from matplotlib.colors import to_rgb

        cells = np.ones((DEPTHS, TILTS, 3))
        for row, column in product(range(DEPTHS), range(TILTS)):
            here = binding[(self.rows == row) & (self.columns == column)]
            if len(here) == 0:
                continue
            cells[row, column] = to_rgb(REACHED_COLOR)
            out = here[here >= 0]
            if len(out):
                share = 0.3 + 0.7 * len(out) / len(here)
                worst = np.array(to_rgb(colors[int(np.bincount(out).argmax())]))
                cells[row, column] = (1.0 - share) * cells[row, column] + share * worst
        return cells
