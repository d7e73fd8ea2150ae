"""Run one configuration of the graph, and measure its speed and all of its errors.

The finger strokes around the object, pushes its front and stays at rest for two images of the
simulated eye. Processor time and
latency are measured during the stroke. All errors are computed from the bag, relative to the
simulator's ground truth, by the code of the other experiments.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from flexsheet.launch.experiments import compliance, image, stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import Progress, require_scene, run_experiment
from flexsheet.launch.methods.blocks import attribute_error
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.methods import Correction, resolve_method
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, Frame, SheetTarget
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.shapes import Nearest, make_shape
from flexsheet.nodes.twin.paths import map_to_surface, touchable
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from flexsheet.nodes.twin.truth import find_display_delay_s

Times = NDArray[np.int64]

STROKE = "system stroke"
TOUCH_M = 0.001
"""Push depth during the stroke. It keeps the finger in contact despite drift and tremor."""

STROKED_RATIO = 0.9
"""Fraction of the touchable arc length of the object that is stroked."""

SAMPLE_S = 0.05
MAX_STEP_RAD = 0.1
"""Maximum phase of the stroke between two points of its path."""

APPROACH_S = 1.0
HOVER_M = 0.03
TILTED, PUSHED = "system tilt", "system push"
PUSH_RATIO = 0.5
"""Ratio of the push depth during an image to the push depth of the scene."""

METRES_PER_PX = 0.0014
"""Resolution of the images; the error map interpolates between the drawn coordinates."""

DELAY_TOPICS = ("twin/apparatus", "arm_left", "arm_right", "frame")

STAGES = ("fingertip", "planner and arms", "geometry of the arms")
"""Stages whose errors add up to the sheet's error: measured minus true finger; sheet computed from
the arms' measured joints minus measured finger; true sheet minus that computed sheet."""


@dataclass(slots=True)
class CpuUse:
    """Average number of processor cores that the processes of a graph use, by node name."""

    cores: dict[str, float] = field(default_factory=dict)

    async def measure(self, driver: Driver, path: FingerPath) -> None:
        """Move the finger along a path, and measure the processor use during this time."""
        before, begin_s = read_cpu_s(driver.pids()), time.monotonic()
        await driver.follow(path)
        after, passed_s = read_cpu_s(driver.pids()), time.monotonic() - begin_s
        self.cores = {
            name: (used_s - before[name]) / passed_s
            for name, used_s in after.items()
            if name in before
        }


def read_cpu_s(pids: Mapping[str, int]) -> dict[str, float]:
    """Return the processor time (s) of each process, including its ended child processes.

    pids: process id of each node. Nodes that share a process have one common entry, whose key is
    their names joined by "+".
    """
    names: dict[int, list[str]] = {}
    for name, pid in pids.items():
        names.setdefault(pid, []).append(name)
    used: dict[str, float] = {}
    for pid, together in names.items():
        try:
            times = psutil.Process(pid).cpu_times()
        except psutil.NoSuchProcess:
            continue
        total = times.user + times.system + times.children_user + times.children_system
        used["+".join(sorted(together))] = total
    return used


def make_stroke(scene: Scene, seconds: float) -> FingerPath:
    """Make a finger path that strokes back and forth around the object, up to the scene's speed."""
    half_m = 0.5 * STROKED_RATIO * touchable(scene)[1]
    frequency_rad_per_s = scene.working_range.speed_m_per_s / half_m
    times = np.arange(0.0, seconds, min(SAMPLE_S, MAX_STEP_RAD / frequency_rad_per_s))
    arcs = half_m * np.sin(frequency_rad_per_s * times)
    places = np.column_stack([np.zeros_like(arcs), arcs, np.full_like(arcs, -TOUCH_M)])
    first, last = ([*place[:2], HOVER_M] for place in (places[0], places[-1]))
    return FingerPath(
        label=STROKE,
        times_s=np.concatenate(
            [[0.0], APPROACH_S + times, [APPROACH_S + seconds + HOVER_M / scene_speed(scene)]]
        ),
        positions_world_m=map_to_surface(scene, np.vstack([first, places, last])),
        wander_m=stroke.WANDER_M,
        tremor_m=stroke.TREMOR_M,
    )


def scene_speed(scene: Scene) -> float:
    """Return the speed at which the finger moves away from the object, m/s."""
    return max(scene.working_range.speed_m_per_s, compliance.PUSH_M_PER_S)


def _make_rest(scene: Scene, label: str, place: Sequence[float]) -> FingerPath:
    above = [place[0], place[1], HOVER_M]
    return FingerPath(
        label=label,
        times_s=image.REACH_S * np.array([1.0, 2.0]),
        positions_world_m=map_to_surface(scene, np.array([above, list(place)])),
        wander_m=0.0,
        tremor_m=0.0,
    )


def list_image_paths(scene: Scene) -> list[FingerPath]:
    """Return the finger paths for the two images: of a tilted sheet, and of a pushed sheet."""
    arc_m = 0.5 * STROKED_RATIO * touchable(scene)[1]
    depth_m = PUSH_RATIO * scene.working_range.push_depth_m
    return [
        _make_rest(scene, TILTED, (0.0, arc_m, 0.5 * HOVER_M)),
        _make_rest(scene, PUSHED, (0.0, 0.0, -depth_m)),
    ]


def find_correction(plan: ResolvedGraph, scene: Scene) -> Correction:
    """Return the image correction that the graph's renderer uses."""
    for node in plan.nodes.values():
        if node.role is NodeRole.RENDERER:
            given = node.parameters["correction"]
            return resolve_method(given, scene.methods.correction, "two_pass")
    return "none"


def run_system(
    launch_file: Path,
    settings: Sequence[str],
    bag: Path,
    seconds: float,
    progress: Progress,
    *,
    apparatus: str | None = None,
) -> dict[str, Any]:
    """Run the graph once; return its processor use, and the results of `evaluate_system`.

    seconds: duration of the stroke. apparatus: file with true parameters of the simulated hardware.
    """
    plan = load_graph(launch_file, settings=settings, apparatus=apparatus)
    has_images = bool(plan.nodes_of_type("renderer") and plan.nodes_of_type("twin_eye"))
    has_forces = bool(plan.nodes_of_type("fem_solver"))
    correction = find_correction(plan, require_scene(plan))
    used = CpuUse()

    async def procedure(driver: Driver, scene: Scene) -> None:
        if has_forces:
            await driver.wait_for_table(scene, "quick_table", progress)
        progress(f"stroke for {seconds:g} s")
        await used.measure(driver, make_stroke(scene, seconds))
        if has_forces:
            progress("push")
            await driver.follow(compliance.make_presses(scene)[0].path)
        for path in list_image_paths(scene) if has_images else ():
            progress(path.label)
            await driver.follow(path)
            await driver.wait_settled()
            for pattern in image.RAMPS:
                label = image.make_pattern_label(path.label, pattern)
                await driver.capture_image(label, correction, pattern=pattern)

    run_experiment(launch_file, settings, bag, procedure, progress, apparatus=apparatus)
    progress("evaluating")
    return {
        "cpu_cores": sum(used.cores.values()),
        "cpu_cores_by_node": used.cores,
        **evaluate_system(bag, has_images=has_images, has_forces=has_forces),
    }


def evaluate_system(bag: Path, *, has_images: bool, has_forces: bool) -> dict[str, Any]:
    """Compute latencies and errors from a bag; None for images or forces that it lacks.

    Latencies have quantiles p50, p95 and p99. Errors have mean, p95 and max: of sheet and fingertip
    over the stroke, of the image over all visible points, of the force over the depths. budget:
    share of each stage of `STAGES` in the sheet's mean square error.
    """
    recording = stroke.read_recording(bag)
    begin_ns, end_ns = recording.windows_ns[STROKE]
    begin_ns += round(1e9 * APPROACH_S)
    exposures = recording.finger.times_ns
    inside = (exposures >= begin_ns) & (exposures <= end_ns)
    for motion in (recording.fingertip, *recording.measured_edges, *recording.true_edges):
        inside &= motion.covers(exposures)
    times = exposures[inside]
    errors = split_sheet_error(recording, read_offsets(bag), times)
    sheet_m = np.linalg.norm(errors.sum(axis=0), axis=1)
    fingertip_m = np.linalg.norm(
        recording.fingertip.interpolate(times) - recording.finger.interpolate(times), axis=1
    )
    to_arm_s, to_light_s = read_delays_s(bag, begin_ns, end_ns)
    return {
        "exposure_to_arm_ms": summarize_latency(to_arm_s),
        "exposure_to_light_ms": summarize_latency(to_light_s),
        "sheet_mm": summarize_errors(1e3 * sheet_m),
        "fingertip_mm": summarize_errors(1e3 * fingertip_m),
        "image_mm": summarize_errors(_read_image_errors_mm(bag)) if has_images else None,
        "force_percent": summarize_errors(_read_force_errors(bag)) if has_forces else None,
        "budget": dict(zip(STAGES, attribute_error(errors).tolist(), strict=True)),
        "drops": recording.drops,
    }


def read_delays_s(bag: Path, begin_ns: int, end_ns: int) -> tuple[Floats, Floats]:
    """Return the delays from exposures in a window to arm commands, and to displayed images, s.

    Only the first effect of each exposure counts. The display time includes the true latency of
    the projector beyond the latency that the renderer assumes.
    """
    to_arm: dict[tuple[str, int], float] = {}
    to_light: dict[int, float] = {}
    apparatus: Apparatus | None = None
    frame: Frame | None = None
    for _, message, header, _ in BagReader(bag, topics=DELAY_TOPICS):
        if isinstance(message, Apparatus):
            apparatus = message
        elif isinstance(message, Frame):
            frame = message
        for event, exposure_ns, at_ns in stroke.list_events(message, header):
            if begin_ns <= exposure_ns <= end_ns:
                delay_s = 1e-9 * (at_ns - exposure_ns)
                if event is stroke.LatencyEvent.LIGHT:
                    to_light.setdefault(exposure_ns, delay_s)
                elif event in stroke.ARM_EVENTS.values():
                    to_arm.setdefault((event, exposure_ns), delay_s)
    return np.array(list(to_arm.values())), (
        np.array(list(to_light.values())) + find_display_delay_s(frame, apparatus)
    )


def read_offsets(bag: Path) -> stroke.SampledMotion:
    """Read from a bag the commanded depth (n, 1) of the sheet below the undeformed surface, m."""
    rows = [
        (message.valid_at_ns, np.array([message.normal_offset_m]))
        for _, message, _, _ in BagReader(bag, topics=["sheet_target"])
        if isinstance(message, SheetTarget)
    ]
    return stroke.make_motion(rows, "sheet_target")


def split_sheet_error(
    recording: stroke.StrokeRecording, offsets: stroke.SampledMotion, times_ns: Times
) -> Floats:
    """Split the sheet's error into the errors of the stages `STAGES`, (3, n, 3) m.

    The total is the object's point nearest to the true finger, moved inward by the commanded
    offset, minus the contact point of the true sheet. Vectors are in the object's frame.
    """
    world_from_object = stroke.object_pose(recording.scene)
    object_from_world = inverse(world_from_object)
    shape = make_shape(dict(recording.scene.object.geometry))
    offset_m = offsets.interpolate(times_ns)

    def find_contact(finger: stroke.SampledMotion) -> tuple[Nearest, Floats]:
        foot = shape.closest(apply(object_from_world, finger.interpolate(times_ns)))
        return foot, foot.point - offset_m * foot.normal

    def present(
        edges: tuple[stroke.SampledMotion, stroke.SampledMotion],
        foot: Nearest,
        surface: SheetSurface | None,
    ) -> Floats:
        planes = stroke.compute_sheet_planes(edges, world_from_object, times_ns)
        if surface is not None:
            planes = surface.find_tangent_planes(planes, foot.point, world_from_object[1, :3])
        return stroke.project_presented_point(foot, planes.points, planes.normals)

    true_foot, wanted = find_contact(recording.finger)
    measured_foot, aimed = find_contact(recording.fingertip)
    whole = wanted - present(recording.true_edges, true_foot, recording.true_surface)
    fingertip = wanted - aimed
    control = aimed - present(recording.measured_edges, measured_foot, recording.surface)
    return np.stack([fingertip, control, whole - fingertip - control])


def _read_image_errors_mm(bag: Path) -> Floats:
    images = image.read_images(bag)
    maps = [image.make_error_map(images, label) for label in (TILTED, PUSHED)]
    return 1e3 * np.concatenate([one.sizes_m for one in maps])


def _read_force_errors(bag: Path) -> Floats:
    return np.array(list(_iterate_force_errors(bag)))


def _iterate_force_errors(bag: Path) -> Iterator[float]:
    recorded = compliance.read_bag(bag)
    reference = compliance.ForceReference(recorded)
    press = compliance.make_presses(recorded.scene)[0]
    begin_ns, _ = recorded.windows_ns[press.path.label]
    for hold in press.holds:
        at_ns = begin_ns + round(0.5e9 * (hold.begin_s + hold.end_s))
        yield 100.0 * abs(reference.evaluate(at_ns, press).error_ratio)


def summarize_errors(values: Floats) -> dict[str, float] | None:
    """Return mean, 95 % quantile and maximum of values (n,); None if there are no values."""
    if len(values) == 0:
        return None
    return {
        "mean": float(values.mean()),
        "p95": float(np.quantile(values, 0.95)),
        "max": float(values.max()),
    }


def summarize_latency(values_s: Floats) -> dict[str, float] | None:
    """Return the median and the 95 % and 99 % quantiles, in ms, of delays (n,) in s.

    Return None if there are no delays.
    """
    if len(values_s) == 0:
        return None
    p50, p95, p99 = 1e3 * np.quantile(values_s, (0.5, 0.95, 0.99))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}
