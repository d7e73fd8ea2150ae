"""Stroke the virtual cylinder with a finger, and measure the error of the sheet.

This is the experiment of Furukawa et al. 2007, section V and Table I. D is the point of the object
nearest to the finger, and D' is the contact point of the sheet. The errors (Fig. 9) are the
distance delta d from D to D', and the angle delta theta between the normals at D and D'.

The experiment also measures latencies from a camera exposure to later events. One of these events,
called "light", is the display of an image by the projector.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments import ExperimentError, find_recorded
from flexsheet.launch.experiments.lag import estimate_lag_s
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.busy import is_busy
from flexsheet.messages.scene import ArmSpec, Cylinder, Scene, require_cylinder
from flexsheet.messages.types import (
    ArmState,
    FingerPath,
    Fingertip,
    Frame,
    HostStatus,
    SheetTarget,
    Side,
    SoftBody,
    Status,
    TwinArms,
    TwinFinger,
)
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.models.shapes import Nearest, Shape, make_shape, principal_curvatures
from flexsheet.nodes.twin.sheet_surface import SheetPlanes, SheetSurface
from flexsheet.nodes.twin.truth import apply_apparatus, find_display_delay_s

STROKE_ANGLE_RAD = np.radians(60.0)
APPROACH_S = 0.8
DWELL_S = 0.7
HOVER_M = 0.04
WANDER_M = 0.0005
TREMOR_M = 0.00005

PAPER_TABLE_1 = {
    10.0: {"delta_d_mm": (0.443, 0.0330), "delta_theta_deg": (0.359, 0.267)},
    30.0: {"delta_d_mm": (0.277, 0.0221), "delta_theta_deg": (0.225, 0.179)},
}
"""The errors in Table I of Furukawa et al. 2007; the keys are durations of finger strokes (s).

Each value is a mean and a standard deviation.
"""

NO_VALUES: Floats = np.empty(0)


class LatencyEvent(StrEnum):
    """An event that an exposure of the camera causes; its latency is measured from the exposure."""

    FINGERTIP = "fingertip"
    SHEET_TARGET = "sheet target"
    SOFT_BODY = "soft body"
    LEFT_ARM_COMMAND = "left arm command"
    RIGHT_ARM_COMMAND = "right arm command"
    FRAME_BEGUN = "frame begun"
    FRAME_DRAWN = "frame drawn"
    LIGHT = "light"


ARM_EVENTS: dict[Side, LatencyEvent] = {
    "left": LatencyEvent.LEFT_ARM_COMMAND,
    "right": LatencyEvent.RIGHT_ARM_COMMAND,
}


@dataclass(frozen=True, slots=True)
class DrawnFrames:
    """The data of displayed frames, with the time (ns) at the centre of each frame's display.

    fingertip: drawn fingertip position (3,), m.
    sheet: centre (m) and normal of the drawn sheet, (6,).
    deformation_ages: age (s) of the finger measurement from which the drawn deformation was
        computed, (1,).
    """

    fingertip: list[tuple[int, Floats]]
    sheet: list[tuple[int, Floats]]
    deformation_ages: list[tuple[int, Floats]]

    def add(self, frame: Frame) -> None:
        """Store the data of a displayed frame. Ignore a frame that was not displayed."""
        if not frame.light_ns:
            return
        pose = frame.world_from_sheet
        self.sheet.append((frame.light_ns, np.concatenate([pose[:3, 3], pose[:3, 2]])))
        if len(frame.fingertip_world_m):
            self.fingertip.append((frame.light_ns, frame.fingertip_world_m[0]))
        if frame.shaped_for_ns:
            age_s = (frame.light_ns - frame.shaped_for_ns) * 1e-9
            self.deformation_ages.append((frame.light_ns, np.array([age_s])))

    def shifted(self, late_ns: int) -> DrawnFrames:
        """Return a copy of the data with display times that are later by `late_ns`.

        The ages of the drawn deformation increase by the same time.
        """
        late_s = np.array([late_ns * 1e-9])
        return DrawnFrames(
            [(at_ns + late_ns, row) for at_ns, row in self.fingertip],
            [(at_ns + late_ns, row) for at_ns, row in self.sheet],
            [(at_ns + late_ns, row + late_s) for at_ns, row in self.deformation_ages],
        )


def stroke_label(seconds: float) -> str:
    """Return the label of the finger path of a stroke with the given duration (s)."""
    return f"stroke {seconds:g} s"


def stroke_path(scene: Scene, seconds: float) -> FingerPath:
    """Return the finger path of the experiment.

    The finger approaches, touches, dwells, strokes over 60 degrees at constant speed, and lifts.
    """
    radius = require_cylinder(scene).radius_m
    world_from_object = object_pose(scene)
    stroke_times = np.linspace(0.0, seconds, max(int(seconds * 20), 2))
    angles = np.concatenate(
        [[0.0, 0.0, 0.0], STROKE_ANGLE_RAD * stroke_times / seconds, [STROKE_ANGLE_RAD] * 2]
    )
    heights = np.concatenate([[HOVER_M, 0.0, 0.0], np.zeros_like(stroke_times), [0.0, HOVER_M]])
    times = np.concatenate(
        [
            [0.0, APPROACH_S, APPROACH_S + DWELL_S - 1e-3],
            APPROACH_S + DWELL_S + stroke_times,
            APPROACH_S + DWELL_S + seconds + np.array([0.3, 0.3 + APPROACH_S]),
        ]
    )
    points = np.column_stack(
        [
            np.zeros_like(angles),
            (radius + heights) * np.sin(angles),
            (radius + heights) * np.cos(angles),
        ]
    )
    return FingerPath(
        label=stroke_label(seconds),
        times_s=times,
        positions_world_m=apply(world_from_object, points),
        wander_m=WANDER_M,
        tremor_m=TREMOR_M,
    )


def stroke_window_s(seconds: float) -> tuple[float, float]:
    """Return the start and end of the stroke, in seconds from the start of the finger path."""
    begin = APPROACH_S + DWELL_S
    return begin, begin + seconds


def object_pose(scene: Scene) -> Floats:
    """Return the pose world_from_object (4, 4) of a scene's object."""
    return pose_matrix(scene.object.world_from_object)


@dataclass(frozen=True, slots=True)
class SampledMotion:
    """A motion that is sampled at n times (ns), with k values at each time."""

    times_ns: NDArray[np.int64]
    values: Floats

    def interpolate(self, times_ns: NDArray[np.int64]) -> Floats:
        """Return the k values at each of the given times (ns), by linear interpolation.

        Times are converted to floats relative to the first sample, because a float cannot store the
        time since the computer's start in ns exactly.
        """
        zero = self.times_ns[0]
        x, xp = (times_ns - zero).astype(np.float64), (self.times_ns - zero).astype(np.float64)
        return np.column_stack([np.interp(x, xp, column) for column in self.values.T])

    def covers(self, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask that is True for the times between the first and the last sample."""
        inside: NDArray[np.bool_] = (times_ns >= self.times_ns[0]) & (times_ns <= self.times_ns[-1])
        return inside


def make_motion(samples: list[tuple[int, Floats]], name: str) -> SampledMotion:
    """Make a motion from samples (time in ns, value); sort them and drop repeated times.

    name: name of the samples in the error text.

    Raises ExperimentError if there are fewer than two samples.
    """
    if len(samples) < 2:
        raise ExperimentError(
            f"the bag contains {len(samples)} samples of {name}, but at least 2 are required; "
            "record the experiment again"
        )
    times = np.array([time for time, _ in samples], dtype=np.int64)
    values = np.array([value for _, value in samples])
    times, first = np.unique(times, return_index=True)
    return SampledMotion(times, values[first])


@dataclass(frozen=True, slots=True)
class StrokeRecording:
    """The data of a stroke experiment, read from a bag.

    fingertip, finger: measured and true position of the fingertip.
    windows_ns: start and end (ns) of each finger path, by label of the path.
    measured_edges, true_edges: motion of the left and the right clamped edge of the sheet. Each row
        (9,) contains the centre, y axis and z axis of an edge in the world frame.
    delays_s: delays from the centre of an exposure to its effects, by kind of effect.
    drops: number of lost or refused messages. Messages that a node skips because it needs only the
        latest one are not counted.
    apparatus: origin of the true parameters of the simulated hardware.
    surface, true_surface: shape of the unloaded sheet in the scene and in the simulated hardware.
    loads: time (ns) of each load report of a computer, and whether the computer was overloaded.
    """

    scene: Scene
    fingertip: SampledMotion
    finger: SampledMotion
    windows_ns: dict[str, tuple[int, int]]
    measured_edges: tuple[SampledMotion, SampledMotion]
    true_edges: tuple[SampledMotion, SampledMotion]
    delays_s: dict[str, Floats]
    drops: int
    apparatus: str = "nominal"
    frames: DrawnFrames = field(default_factory=lambda: DrawnFrames([], [], []))
    surface: SheetSurface | None = None
    true_surface: SheetSurface | None = None
    loads: tuple[tuple[int, bool], ...] = ()


def make_edge_row(world_from_flange: Floats, flange_from_edge: Floats) -> Floats:
    """Return the centre, y axis and z axis of a clamped edge as a row (9,).

    world_from_flange, flange_from_edge: poses (4, 4).
    """
    edge = world_from_flange @ flange_from_edge
    return np.concatenate([edge[:3, 3], edge[:3, 1], edge[:3, 2]])


def frame_events(frame: Frame, published_ns: int) -> list[tuple[LatencyEvent, int]]:
    """Return the events of a frame with their times in ns.

    The events are the start and the end of drawing and, if the frame was displayed, its display.
    """
    drawn_ns = frame.drawn_ns or published_ns
    begun_ns = drawn_ns - round(frame.draw_s * 1e9)
    events = [(LatencyEvent.FRAME_BEGUN, begun_ns), (LatencyEvent.FRAME_DRAWN, drawn_ns)]
    return [*events, (LatencyEvent.LIGHT, frame.light_ns)] if frame.light_ns else events


def list_events(message: Message, header: Header) -> list[tuple[LatencyEvent, int, int]]:
    """Return the events in a message whose latency is measured from a camera exposure.

    Each event is a tuple: kind, time (ns) of the exposure that caused the event, and time (ns) of
    the event.
    """
    exposure_ns = header.source_ns
    match message:
        case Fingertip() if message.valid:
            return [(LatencyEvent.FINGERTIP, exposure_ns, header.publish_ns)]
        case SheetTarget():
            return [(LatencyEvent.SHEET_TARGET, exposure_ns, header.publish_ns)]
        case SoftBody():
            return [(LatencyEvent.SOFT_BODY, exposure_ns, header.publish_ns)]
        case ArmState() if message.target_source_ns and message.command_sent_ns:
            event = ARM_EVENTS[message.side]
            return [(event, message.target_source_ns, message.command_sent_ns)]
        case Frame():
            events = frame_events(message, header.publish_ns)
            return [(event, exposure_ns, at_ns) for event, at_ns in events]
    return []


def read_recording(bag: Path) -> StrokeRecording:
    """Read the data of a finger stroke from a bag; raise ExperimentError if data are missing."""
    scene: Scene | None = None
    apparatus: Apparatus | None = None
    fingertip: list[tuple[int, Floats]] = []
    finger: list[tuple[int, Floats]] = []
    windows_ns: dict[str, tuple[int, int]] = {}
    flanges: dict[str, list[tuple[int, Floats]]] = {
        key: [] for key in ("left", "right", "true_left", "true_right")
    }
    delays: dict[str, dict[int, float]] = {}
    frames = DrawnFrames([], [], [])
    frame: Frame | None = None
    losses: dict[tuple[str, int, str], int] = {}
    for _, message, header, _ in BagReader(bag):
        for event, source_ns, event_ns in list_events(message, header):
            delays.setdefault(event, {}).setdefault(source_ns, (event_ns - source_ns) * 1e-9)
        match message:
            case Scene():
                scene = message
            case Apparatus():
                apparatus = message
            case Fingertip() if message.valid:
                fingertip.append((header.source_ns, message.position_world_m))
            case TwinFinger():
                finger.append((header.source_ns, message.position_world_m))
                begin_ns = header.source_ns - round(message.path_time_s * 1e9)
                windows_ns[message.path_label] = begin_ns, header.source_ns
            case ArmState():
                flanges[message.side].append((header.source_ns, message.world_from_flange))
            case TwinArms():
                flanges["true_left"].append((header.source_ns, message.world_from_flange_left))
                flanges["true_right"].append((header.source_ns, message.world_from_flange_right))
            case Frame():
                frames.add(message)
                frame = message
            case Status():
                for port in message.inputs:
                    # A restarted node counts from zero, so the last status after each start
                    # contains the total since that start.
                    losses[message.node, header.epoch, port.topic] = port.gaps + port.rejected
            case _:
                pass
    if scene is None:
        raise ExperimentError(f"{bag}: contains no scene; record the topic scene")

    def make_edges(key: str, arm: ArmSpec) -> SampledMotion:
        flange_from_edge = pose_matrix(arm.flange_from_edge)
        rows = [(time, make_edge_row(flange, flange_from_edge)) for time, flange in flanges[key]]
        return make_motion(rows, f"arm {key}")

    true_arms = apply_apparatus(scene, apparatus).arms
    delays_s = {event: np.array(list(found.values())) for event, found in delays.items()}
    if apparatus is not None:
        late_s = find_display_delay_s(frame, apparatus)
        frames = frames.shifted(round(1e9 * late_s))
        if LatencyEvent.LIGHT in delays_s:
            delays_s[LatencyEvent.LIGHT] += late_s
    return StrokeRecording(
        scene=scene,
        fingertip=make_motion(fingertip, "fingertip"),
        finger=make_motion(finger, "twin/finger"),
        windows_ns=windows_ns,
        measured_edges=apply_compliance(
            scene, (make_edges("left", scene.arms.left), make_edges("right", scene.arms.right))
        ),
        true_edges=(
            make_edges("true_left", true_arms.left),
            make_edges("true_right", true_arms.right),
        ),
        delays_s=delays_s,
        drops=sum(losses.values()),
        apparatus="nominal" if apparatus is None else apparatus.origin,
        frames=frames,
        surface=SheetSurface.of(scene),
        true_surface=SheetSurface.of(scene, apparatus),
        loads=read_loads(bag),
    )


def read_loads(bag: Path) -> tuple[tuple[int, bool], ...]:
    """Return the times (ns) of the computers' load reports, and whether each states an overload."""
    return tuple(
        (header.source_ns, is_busy(message))
        for _, message, header, _ in BagReader(bag, topics=["host"])
        if isinstance(message, HostStatus)
    )


def apply_compliance(
    scene: Scene, edges: tuple[SampledMotion, SampledMotion]
) -> tuple[SampledMotion, SampledMotion]:
    """Correct the reported motions of both edges by the compliance of the flanges.

    The arms report poses of rigid flanges, but the tension of the sheet displaces the flanges.
    """
    limits = ArmGeometry(scene, "left").sheet_limits
    moved = []
    for own, other, arm in (
        (edges[0], edges[1], scene.arms.left),
        (edges[1], edges[0], scene.arms.right),
    ):
        across = other.interpolate(own.times_ns)[:, :3] - own.values[:, :3]
        distances_m = np.linalg.norm(across, axis=1)
        forces_n = np.array([limits.force_n(limits.sheet_length_m(one)) for one in distances_m])
        values = own.values.copy()
        shifts_m = arm.flange_compliance_m_per_n * forces_n
        values[:, :3] += (shifts_m / distances_m)[:, None] * across
        moved.append(SampledMotion(own.times_ns, values))
    return moved[0], moved[1]


def compute_sheet_planes(
    edges: tuple[SampledMotion, SampledMotion],
    world_from_object: Floats,
    times_ns: NDArray[np.int64],
) -> SheetPlanes:
    """Return the planes through both clamped edges at n times (ns), in the object's frame."""
    object_from_world = inverse(world_from_object)
    left, right = (
        np.concatenate(
            [
                apply(object_from_world, row[:, :3]),
                row[:, 3:6] @ object_from_world[:3, :3].T,
                row[:, 6:9] @ object_from_world[:3, :3].T,
            ],
            axis=1,
        )
        for row in (edges[0].interpolate(times_ns), edges[1].interpolate(times_ns))
    )
    across = right[:, :3] - left[:, :3]
    normal = np.cross(across, left[:, 3:6] + right[:, 3:6])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.linalg.norm(across, axis=1)
    return SheetPlanes(
        0.5 * (left[:, :3] + right[:, :3]), normal, across / distance[:, None], distance
    )


def find_presented_points(planes: SheetPlanes, x_m: Floats) -> tuple[Floats, Floats]:
    """Return the sheet's contact points on a cylinder, and the directions of the sheet's normals.

    The contact point D' is the point of the sheet's plane that is nearest to a point on the axis of
    the cylinder. Return n contact points (n, 3), in m, in the object's frame. Also return n angles
    (n,), in rad, of the plane's normal around the axis.

    planes: n planes of the sheet.
    x_m: positions (n,) of n points on the axis, m, in the object's frame.
    """
    normal = planes.normals
    axis_point = np.column_stack([x_m, np.zeros_like(x_m), np.zeros_like(x_m)])
    distance = np.einsum("ij,ij->i", planes.points - axis_point, normal)
    return axis_point + distance[:, None] * normal, np.arctan2(normal[:, 1], normal[:, 2])


MIN_CURVATURE_PER_M = 1.0
"""The minimum principal curvature (1/m) of a surface on which the contact point is computed.

Flatter surfaces have many points with nearly the same normal.
"""


def project_presented_point(foot: Nearest, centre: Floats, normal: Floats) -> Floats:
    """Return n contact points D' (n, 3), in m, of a sheet on an object of any shape.

    The sheet is tangent to the object at the surface point whose normal equals the normal of the
    sheet's plane. This point is computed from the surface curvatures, and projected onto the plane.
    Along a direction without curvature, the point is not unique, so the object point nearest to the
    finger is used. The error of this approximation is of second order in the angle between the
    normals.

    foot: points of the object nearest to the finger.
    centre, normal: (n, 3), point and normal of the sheet's plane.
    """
    curvatures, directions = principal_curvatures(foot.shape_operator, foot.normal)
    slopes = np.einsum("nki,ni->nk", directions, normal)
    curved = np.abs(curvatures) > MIN_CURVATURE_PER_M
    shifts_m = np.divide(slopes, curvatures, out=np.zeros_like(slopes), where=curved)
    drop_m = 0.5 * (curvatures * shifts_m**2).sum(axis=1)
    point = foot.point + np.einsum("nk,nki->ni", shifts_m, directions)
    point -= drop_m[:, None] * foot.normal
    gap_m = np.einsum("ni,ni->n", point - centre, normal)
    return np.asarray(point - gap_m[:, None] * normal)


def sheet_errors(
    scene: Scene,
    finger: SampledMotion,
    edges: tuple[SampledMotion, SampledMotion],
    times_ns: NDArray[np.int64],
    normal_offset_m: Floats | float = 0.0,
    *,
    shape: Shape | None = None,
    surface: SheetSurface | None = None,
) -> tuple[Floats, Floats]:
    """Return the sheet's errors delta d (n,), in m, and delta theta (n,), in rad, at n times.

    Delta d is the distance from the object point at the finger to the contact point of the sheet.
    The planner can lower the sheet below the undeformed surface to render a soft object. This
    commanded depth does not count as an error.

    On a cylinder, delta theta is the angle about its axis, as in Furukawa et al. 2007. On other
    shapes, delta theta is the angle between the normals.

    finger, edges: motions of the fingertip and of both clamped edges.
    normal_offset_m: (n,), commanded depth of the sheet below the undeformed surface.
    shape: shape of the scene's object; if it is None, the function computes the shape.
    surface: shape of the unloaded sheet; None if the sheet is flat.
    """
    world_from_object = object_pose(scene)
    points = apply(inverse(world_from_object), finger.interpolate(times_ns))
    planes = compute_sheet_planes(edges, world_from_object, times_ns)
    if surface is not None:
        planes = surface.find_tangent_planes(planes, points, world_from_object[1, :3])
    if not isinstance(scene.object.geometry, Cylinder):
        foot = (shape or make_shape(dict(scene.object.geometry))).closest(points)
        normal = planes.normals
        offset_m = np.broadcast_to(normal_offset_m, len(points))[:, None]
        on_surface = foot.point - offset_m * foot.normal
        sine = np.linalg.norm(np.cross(foot.normal, normal), axis=1)
        cosine = np.einsum("ni,ni->n", foot.normal, normal)
        error = on_surface - project_presented_point(foot, planes.points, normal)
        return np.linalg.norm(error, axis=1), np.arctan2(sine, cosine)
    angles = np.arctan2(points[:, 1], points[:, 2])
    radius = require_cylinder(scene).radius_m - normal_offset_m
    on_surface = np.column_stack([points[:, 0], radius * np.sin(angles), radius * np.cos(angles)])
    presented_points, presented_angles = find_presented_points(planes, points[:, 0])
    delta_theta = (angles - presented_angles + np.pi) % (2 * np.pi) - np.pi
    return np.linalg.norm(on_surface - presented_points, axis=1), np.abs(delta_theta)


def summary(values: Floats, scale: float) -> dict[str, float]:
    """Return mean, standard deviation and maximum of the values, multiplied by `scale`."""
    scaled = values * scale
    return {
        "mean": float(scaled.mean()),
        "std": float(scaled.std()),
        "max": float(scaled.max()),
    }


def summarize_sizes(values: Floats) -> dict[str, float] | None:
    """Return the mean, 95 % quantile and maximum of the values; None if there are no values."""
    if len(values) == 0:
        return None
    p95 = float(np.quantile(values, 0.95))
    return {"mean": float(values.mean()), "p95": p95, "max": float(values.max())}


def percentiles_ms(values_s: Floats) -> dict[str, float | None]:
    """Return the median and the 95 % and 99 % quantiles, in ms, of durations in s.

    They are None if there are no durations.
    """
    if len(values_s) == 0:
        return dict.fromkeys(("p50", "p95", "p99"))
    p50, p95, p99 = 1e3 * np.quantile(values_s, (0.5, 0.95, 0.99))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}


@dataclass(frozen=True, slots=True)
class StrokeErrors:
    """The errors of a stroke as functions of time, in m and rad.

    seconds: times (s) of the n exposures with a valid fingertip, since the start of the stroke. The
        measured errors belong to these times.
    true_seconds: times (s) of all k exposures, to which the true errors belong.
    fingertip_m: (n,), errors of the fingertip.
    arcs_m: (k, 2), arc lengths around the object to the true contact line and to the true finger.
    """

    seconds: Floats
    delta_d_m: Floats
    delta_theta_rad: Floats
    fingertip_m: Floats
    true_seconds: Floats
    true_delta_d_m: Floats
    true_delta_theta_rad: Floats
    arcs_m: Floats


def stroke_span_ns(recording: StrokeRecording, seconds: float) -> tuple[int, int]:
    """Return the start and end time (ns) of the finger stroke with a duration of `seconds`.

    Raises ExperimentError if the recording does not contain this stroke.
    """
    windows = recording.windows_ns
    zero_ns, end_ns = find_recorded(windows, "finger path", stroke_label(seconds))
    begin_s, finish_s = stroke_window_s(seconds)
    return zero_ns + round(begin_s * 1e9), min(zero_ns + round(finish_s * 1e9), end_ns)


def stroke_errors(recording: StrokeRecording, seconds: float) -> StrokeErrors:
    """Compute the errors at each exposure of the finger stroke with a duration of `seconds`.

    Raises ExperimentError if the recording does not contain this stroke.
    """
    begin_ns, finish_ns = stroke_span_ns(recording, seconds)

    def select_stroke(times: NDArray[np.int64]) -> NDArray[np.int64]:
        keep = (times >= begin_ns) & (times <= finish_ns)
        for edges in (*recording.measured_edges, *recording.true_edges, recording.finger):
            keep &= edges.covers(times)
        return times[keep]

    times, exposures = (
        select_stroke(motion.times_ns) for motion in (recording.fingertip, recording.finger)
    )
    if len(times) < 10:
        label = stroke_label(seconds)
        raise ExperimentError(
            f"the bag contains {len(times)} valid fingertip measurements during "
            f'"{label}", but at least 10 are required; check the tracking, then record the '
            "experiment again"
        )
    scene = recording.scene
    delta_d, delta_theta = sheet_errors(
        scene,
        recording.fingertip,
        recording.measured_edges,
        times,
        surface=recording.surface,
    )
    true_d, true_theta = sheet_errors(
        scene, recording.finger, recording.true_edges, exposures, surface=recording.true_surface
    )
    true_points = recording.finger.interpolate(times)
    return StrokeErrors(
        seconds=np.asarray((times - begin_ns) * 1e-9, dtype=np.float64),
        delta_d_m=delta_d,
        delta_theta_rad=delta_theta,
        fingertip_m=np.linalg.norm(recording.fingertip.interpolate(times) - true_points, axis=1),
        true_seconds=np.asarray((exposures - begin_ns) * 1e-9, dtype=np.float64),
        true_delta_d_m=true_d,
        true_delta_theta_rad=true_theta,
        arcs_m=compute_arcs(
            scene, recording.true_edges, exposures, recording.finger.interpolate(exposures)
        ),
    )


def compute_arcs(
    scene: Scene,
    edges: tuple[SampledMotion, SampledMotion],
    times_ns: NDArray[np.int64],
    points: Floats,
) -> Floats:
    """Return two positions around the cylinder at n times, as arc lengths (n, 2), in m.

    The first column contains the position of the sheet's contact line. The second column contains
    the position of `points`. Arc lengths are zero in the direction of the object's z axis.

    edges: motions of both clamped edges.
    points: n points (n, 3), m, in the world frame.
    """
    planes = compute_sheet_planes(edges, object_pose(scene), times_ns)
    _, angles = find_presented_points(planes, np.zeros(len(points)))
    local = apply(inverse(object_pose(scene)), points)
    both = np.stack([angles, np.arctan2(local[:, 1], local[:, 2])], axis=1)
    return np.asarray(require_cylinder(scene).radius_m * both)


def visible_lag_ms(recording: StrokeRecording, seconds: float) -> dict[str, float | None]:
    """Return the lags (ms) of the displayed image behind reality; unknown lags are None.

    fingertip: lag of the drawn fingertip, estimated by cross-correlation with the true motion.
    sheet: lag of the drawn rotation of the sheet about the object, estimated in the same way.
    object: median age of the finger measurement that deforms the drawn object, minus the solver's
        prediction horizon.
    """
    span = stroke_span_ns(recording, seconds)
    world_from_object = object_pose(recording.scene)
    radius = require_cylinder(recording.scene).radius_m

    def within(samples: list[tuple[int, Floats]]) -> list[tuple[int, Floats]]:
        return [sample for sample in samples if span[0] <= sample[0] <= span[1]]

    def measure_lag_ms(
        samples: list[tuple[int, Floats]], times_ns: NDArray[np.int64], truth: Floats
    ) -> float | None:
        if len(samples) < 20:
            return None
        drawn = make_motion(samples, "frame")
        inside = drawn.times_ns < times_ns[-1]
        lag = estimate_lag_s(
            np.asarray((drawn.times_ns[inside] - span[0]) * 1e-9, dtype=np.float64),
            drawn.values[inside],
            truth,
            leader_times_s=np.asarray((times_ns - span[0]) * 1e-9, dtype=np.float64),
        )
        return None if lag is None else 1e3 * lag

    def compute_arcs_m(normals: Floats) -> Floats:
        local = normals @ world_from_object[:3, :3]
        return np.asarray(radius * np.arctan2(local[:, 1], local[:, 2])[:, None])

    true_ns = recording.true_edges[0].times_ns
    true_ns = true_ns[recording.true_edges[1].covers(true_ns)]
    planes = compute_sheet_planes(recording.true_edges, world_from_object, true_ns)
    _, angles = find_presented_points(planes, np.zeros(len(true_ns)))
    sheet = [
        (time, compute_arcs_m(row[None, 3:])[0]) for time, row in within(recording.frames.sheet)
    ]
    finger = recording.finger
    ages = within(recording.frames.deformation_ages)
    return {
        "fingertip": measure_lag_ms(
            within(recording.frames.fingertip), finger.times_ns, finger.values
        ),
        "sheet": measure_lag_ms(sheet, true_ns, radius * angles),
        "object": 1e3 * float(np.median([age[0] for _, age in ages])) if ages else None,
    }


def compute_busy_fraction(recording: StrokeRecording, seconds: float) -> float | None:
    """Return the fraction of load reports during a finger stroke that report an overload.

    The computers of the graph send load reports. Return None if there are no reports.

    seconds: duration of the stroke.
    """
    begin_ns, finish_ns = stroke_span_ns(recording, seconds)
    busy = [one for at_ns, one in recording.loads if begin_ns <= at_ns <= finish_ns]
    return sum(busy) / len(busy) if busy else None


def stroke_result(
    recording: StrokeRecording, errors: StrokeErrors, seconds: float, bag: Path
) -> dict[str, Any]:
    """Return one finger stroke's results for `experiment stroke --json`, in mm, degrees and ms.

    lag_ms: lag of the true sheet behind the true finger, estimated by cross-correlation.
    """
    lag = estimate_lag_s(errors.true_seconds, errors.arcs_m[:, 0], errors.arcs_m[:, 1])

    def summarize_delays(*events: LatencyEvent) -> dict[str, float | None]:
        found = [recording.delays_s.get(event, NO_VALUES) for event in events]
        return percentiles_ms(np.concatenate(found))

    return {
        "seconds": seconds,
        "apparatus": recording.apparatus,
        "valid_ratio": len(errors.seconds) / len(errors.true_seconds),
        "delta_d_mm": summary(errors.delta_d_m, 1e3),
        "delta_theta_deg": summary(errors.delta_theta_rad, np.degrees(1.0)),
        "true_delta_d_mm": summary(errors.true_delta_d_m, 1e3),
        "true_delta_theta_deg": summary(errors.true_delta_theta_rad, np.degrees(1.0)),
        "lag_ms": None if lag is None else 1e3 * lag,
        "visible_lag_ms": visible_lag_ms(recording, seconds),
        "fingertip_mm": summary(errors.fingertip_m, 1e3),
        "latency_ms": {
            "exposure_to_arm": summarize_delays(*ARM_EVENTS.values()),
            "exposure_to_frame": summarize_delays(LatencyEvent.FRAME_DRAWN),
            "exposure_to_light": summarize_delays(LatencyEvent.LIGHT),
        },
        "drops": recording.drops,
        "busy_fraction": compute_busy_fraction(recording, seconds),
        "bag": str(bag),
    }


def evaluate_stroke(bag: Path, seconds: float) -> dict[str, Any]:
    """Return the results of the finger stroke with a duration of `seconds` in a bag."""
    recording = read_recording(bag)
    return stroke_result(recording, stroke_errors(recording, seconds), seconds, bag)
