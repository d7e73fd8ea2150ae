"""Measure how the sheet follows the measured and the true finger over a whole bag.

The errors of the sheet (Furukawa et al. 2007, Fig. 9) are defined in `launch.experiments.stroke`.
If the planner lowers the sheet to render compliance, the errors are relative to the object's
surface lowered by the commanded `normal_offset_m`.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from flexsheet.launch.experiments import find_recorded
from flexsheet.launch.experiments.stroke import (
    SampledMotion,
    object_pose,
    sheet_errors,
    summarize_sizes,
    summary,
)
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, Fingertip, SheetTarget, Side, TwinArms, TwinFinger
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from flexsheet.nodes.twin.truth import apply_apparatus

MAX_CONTACT_HEIGHT_M = 0.001
"""The maximum height (m) above the undeformed object at which the finger counts as in contact.

The pad of a fingertip deforms by about this amount.
"""

TOPICS_READ = (
    "scene",
    "twin/apparatus",
    "sheet_target",
    "twin/finger",
    "arm_left",
    "arm_right",
    "twin/arms",
)
"""The topics from which errors relative to the true finger are computed.

In a bag of the simulator, the timestamps of these topics are on one clock.
"""

BLOCK = 2000
"""The number of exposures for which errors are computed together, which limits the memory."""

SAME_RUN_NS = 1_000_000_000

SILENT_NS = 100_000_000
"""The maximum age (ns) of the last state of an arm that follows the finger.

If the last state is older, the arm does not count as following the finger.
"""

Source = Literal["measured", "true"]
"""Whether errors are computed from the positions that the nodes measure, or from the true ones."""


class Samples:
    """Times (ns) with k values each, stored compactly."""

    def __init__(self) -> None:
        self._times, self._values = array("q"), array("d")

    def add(self, at_ns: int, values: Floats) -> None:
        self._times.append(at_ns)
        self._values.extend(values.ravel().tolist())

    @property
    def times_ns(self) -> Ints:
        return np.array(self._times, dtype=np.int64)

    @property
    def values(self) -> Floats:
        """Return the values as rows (n, k)."""
        return np.array(self._values).reshape(len(self._times), -1)

    def motion(self) -> SampledMotion | None:
        """Return the samples, sorted and without repeated times; None if there are fewer than 2."""
        times, first = np.unique(self.times_ns, return_index=True)
        return SampledMotion(times, self.values[first]) if len(times) > 1 else None


@dataclass(slots=True)
class FingerRun:
    """A motion of the simulated finger along a path.

    zero_ns: start time of the path.
    done_ns: time of the last camera exposure during the motion.
    """

    label: str
    zero_ns: int
    done_ns: int


@dataclass(frozen=True, slots=True)
class SheetErrors:
    """The errors of the sheet at n exposures, in m and rad.

    heights_m: (n,), heights of the finger above the undeformed object, negative below it.
    contact: (n,), whether the planner has the sheet in contact with the object.
    """

    times_ns: Ints
    delta_d_m: Floats
    delta_theta_rad: Floats
    heights_m: Floats
    contact: Bools


class FollowedSheet:
    """The motions of finger, sheet and arms that are recorded in a bag.

    Messages must be added in order. If a bag contains several scenes, only the motions in the last
    scene are evaluated.
    """

    def __init__(self) -> None:
        self.runs: list[FingerRun] = []
        self._apparatus: Apparatus | None = None
        self._set_scene(None)

    def _set_scene(self, scene: Scene | None) -> None:
        self.scene = scene
        self._fingers = {source: Samples() for source in get_args(Source)}
        self._flanges = {
            (source, side): Samples() for source in get_args(Source) for side in get_args(Side)
        }
        self._targets, self._following = Samples(), Samples()
        self._arms: dict[str, tuple[int, bool]] = {}
        self._target_holds = True
        self.runs.clear()

    def add(self, message: Any, source_ns: int) -> None:
        """Store a message of the bag. All source timestamps must be on one clock."""
        match message:
            case Scene() if message != self.scene:
                self._set_scene(message)
            case Apparatus():
                self._apparatus = message
            case SheetTarget():
                values = [message.phase == "contact", message.normal_offset_m]
                self._targets.add(message.valid_at_ns, np.array(values, dtype=np.float64))
                self._target_holds = message.phase in ("hold", "wait")
            case Fingertip() if message.valid:
                self._fingers["measured"].add(source_ns, message.position_world_m)
            case TwinFinger():
                self._fingers["true"].add(source_ns, message.position_world_m)
                self._following.add(source_ns, np.array([self._is_following(source_ns)]))
                self._add_run(message, source_ns)
            case ArmState():
                self._arms[message.side] = source_ns, message.mode == "follow"
                self._flanges["measured", message.side].add(
                    source_ns, message.world_from_flange[:3]
                )
            case TwinArms():
                self._flanges["true", "left"].add(source_ns, message.world_from_flange_left[:3])
                self._flanges["true", "right"].add(source_ns, message.world_from_flange_right[:3])

    def _is_following(self, at_ns: int) -> float:
        """Return 1 if the finger moves the sheet target and both arms follow the target, else 0."""
        arms = [self._arms.get(side) for side in get_args(Side)]
        both = all(arm is not None and arm[1] and at_ns - arm[0] <= SILENT_NS for arm in arms)
        return float(both and not self._target_holds)

    def _add_run(self, finger: TwinFinger, source_ns: int) -> None:
        if not finger.path_label or finger.path_time_s < 0.0:
            return
        zero_ns = source_ns - round(finger.path_time_s * 1e9)
        last = self.runs[-1] if self.runs else None
        if (
            last is None
            or last.label != finger.path_label
            or abs(last.zero_ns - zero_ns) > SAME_RUN_NS
        ):
            last = FingerRun(finger.path_label, zero_ns, zero_ns)
            self.runs.append(last)
        last.zero_ns = zero_ns
        if not finger.path_done:
            last.done_ns = source_ns

    def compute_errors(self, source: Source) -> SheetErrors | None:
        """Compute the errors at all exposures at which both edges are known; None without any."""
        scene, finger = self.scene, self._fingers[source].motion()
        if scene is None or finger is None:
            return None
        left, right = (
            self._make_edge(scene, source, "left"),
            self._make_edge(scene, source, "right"),
        )
        if left is None or right is None:
            return None
        times_ns = finger.times_ns[left.covers(finger.times_ns) & right.covers(finger.times_ns)]
        if not len(times_ns):
            return None
        contact, offsets_m = self._read_targets(times_ns)
        shape, object_from_world = (
            make_shape(dict(scene.object.geometry)),
            inverse(object_pose(scene)),
        )
        surface = SheetSurface.of(scene, self._apparatus if source == "true" else None)
        parts = []
        for begin in range(0, len(times_ns), BLOCK):
            block = slice(begin, begin + BLOCK)
            local = apply(object_from_world, finger.interpolate(times_ns[block]))
            found = sheet_errors(
                scene,
                finger,
                (left, right),
                times_ns[block],
                normal_offset_m=offsets_m[block],
                shape=shape,
                surface=surface,
            )
            parts.append((*found, shape.closest(local).height_m))
        delta_d, delta_theta, heights = (np.concatenate(one) for one in zip(*parts, strict=True))
        return SheetErrors(times_ns, delta_d, delta_theta, heights, contact)

    def _make_edge(self, scene: Scene, source: Source, side: Side) -> SampledMotion | None:
        """Return the centre, y axis and z axis of a clamped edge as rows (9,) over time."""
        flange = self._flanges[source, side].motion()
        if flange is None:
            return None
        arms = apply_apparatus(scene, self._apparatus).arms if source == "true" else scene.arms
        arm = arms.left if side == "left" else arms.right
        edges = flange.values.reshape(-1, 3, 4) @ pose_matrix(arm.flange_from_edge)
        return SampledMotion(flange.times_ns, edges[:, :, [3, 1, 2]].swapaxes(1, 2).reshape(-1, 9))

    def _read_targets(self, times_ns: Ints) -> tuple[Bools, Floats]:
        """Return contact flags (n,) and normal offsets (n,), in m, of the sheet target at n times.

        Both are zero at times without data.
        """
        targets = self._targets.motion()
        if targets is None:
            return np.zeros(len(times_ns), np.bool_), np.zeros(len(times_ns))
        touches, offsets_m = targets.interpolate(times_ns).T
        covered = targets.covers(times_ns)
        return (touches > 0.999) & covered, np.where(covered, offsets_m, 0.0)

    def compute_fingertip_errors_m(self) -> Floats:
        """Return the distances (n,) of the measured fingertips from the true finger."""
        measured, true = (self._fingers[source].motion() for source in get_args(Source))
        if measured is None or true is None:
            return np.empty(0)
        times_ns = measured.times_ns[true.covers(measured.times_ns)]
        apart = measured.interpolate(times_ns) - true.interpolate(times_ns)
        return np.asarray(np.linalg.norm(apart, axis=1))

    def summarize_runs(self) -> list[dict[str, Any]]:
        """Return the label, duration and errors of each path of the finger, as `summarize_path`."""
        errors, following = self.compute_errors("true"), self._following.motion()
        if errors is None or following is None:
            return []
        followed = following.interpolate(errors.times_ns)[:, 0] > 0.5
        rows = []
        for run in self.runs:
            inside = (errors.times_ns >= run.zero_ns) & (errors.times_ns <= run.done_ns)
            if inside.any():
                found = summarize_path(
                    errors.delta_d_m[inside],
                    errors.delta_theta_rad[inside],
                    errors.heights_m[inside],
                    followed[inside],
                )
                seconds = (run.done_ns - run.zero_ns) * 1e-9
                rows.append({"path": run.label, "seconds": seconds, **found})
        return rows


def summarize_contact(errors: SheetErrors | None, prefix: str) -> dict[str, Any]:
    """Return mean, standard deviation and maximum of the errors in contact; None without contact.

    prefix: beginning of the keys.
    """
    names = f"{prefix}delta_d_mm", f"{prefix}delta_theta_deg"
    if errors is None or not errors.contact.any():
        return dict.fromkeys(names)
    return {
        names[0]: summary(errors.delta_d_m[errors.contact], 1e3),
        names[1]: summary(errors.delta_theta_rad[errors.contact], np.degrees(1.0)),
    }


def summarize_path(
    delta_d_m: Floats, delta_theta_rad: Floats, heights_m: Floats, following: Bools
) -> dict[str, Any]:
    """Return figures about the errors of the true sheet at n consecutive exposures.

    contact_ratio: fraction of the exposures that are in contact.
    following_ratio: fraction of the exposures in contact at which the arms follow the finger.
    drop_outs: number of intervals in which the arms do not follow the finger and which contain at
        least one exposure in contact.

    Values that are only defined during contact are None if there was no contact.

    heights_m: heights (n,) of the true finger above the undeformed object, negative below it.
    following: whether both arms follow the finger (n,).
    """
    contact = heights_m <= MAX_CONTACT_HEIGHT_M
    # The running number of followed exposures is constant within an interval without following.
    intervals = np.cumsum(following)[contact & ~following]
    return {
        "contact_ratio": float(contact.mean()),
        "following_ratio": float(following[contact].mean()) if contact.any() else None,
        "drop_outs": len(np.unique(intervals)),
        "contact": {
            "true_delta_d_mm": summarize_sizes(1e3 * delta_d_m[contact]),
            "true_delta_theta_deg": summarize_sizes(np.degrees(delta_theta_rad[contact])),
        },
    }


def read_followed(bag: Path) -> list[dict[str, Any]]:
    """Return the errors of the sheet along each path of the simulated finger in a bag."""
    sheet = FollowedSheet()
    for _, message, header, _ in BagReader(bag, topics=TOPICS_READ):
        sheet.add(message, header.source_ns)
    return sheet.summarize_runs()


def read_followed_path(bag: Path, label: str) -> dict[str, Any]:
    """Return the sheet's errors while it followed a finger path, from a bag.

    label: label of the finger path.

    Raises ExperimentError if the bag does not contain the path.
    """
    runs = {run["path"]: run for run in read_followed(bag)}
    return find_recorded(runs, "finger path", label)
