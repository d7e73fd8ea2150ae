"""Run one configuration of the graph, and measure its processor time and latency in a stroke."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from flexsheet.launch.experiments import stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import Progress, run_experiment
from flexsheet.launch.experiments.system_errors import (
    APPROACH_S,
    STROKE,
    make_stroke,
    split_sheet_error,
    summarize_errors,
)
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Frame, SheetTarget, TwinFinger
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.truth import find_display_delay_s

DELAY_TOPICS = ("twin/apparatus", "arm_left", "arm_right", "frame")


def read_cpu_s(pids: Mapping[str, int]) -> dict[str, float]:
    """Return the processor time (s) of each process, including its ended child processes.

    Nodes that share a process have one entry. Its key contains their names, joined by "+".

    pids: process id of each node.
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


def run_system(
    launch_file: Path, settings: Sequence[str], bag: Path, seconds: float, progress: Progress
) -> dict[str, Any]:
    """Run the graph during a finger stroke of `seconds`; return processor use and latencies (ms).

    A latency is None if the graph does not have the corresponding output.
    """
    cores: dict[str, float] = {}

    async def procedure(driver: Driver, scene: Scene) -> None:
        progress(f"stroke for {seconds:g} s")
        before, start_s = read_cpu_s(driver.pids()), time.monotonic()
        await driver.follow(make_stroke(scene, seconds))
        after, passed_s = read_cpu_s(driver.pids()), time.monotonic() - start_s
        for name in before.keys() & after.keys():
            cores[name] = (after[name] - before[name]) / passed_s

    run_experiment(launch_file, settings, bag, procedure, progress)
    begin_ns, end_ns = read_window_ns(bag)
    to_arm_s, to_light_s = read_delays_s(bag, begin_ns + round(1e9 * APPROACH_S), end_ns)
    return {
        "cpu_cores": sum(cores.values()),
        "cpu_cores_by_node": dict(sorted(cores.items())),
        "exposure_to_arm_ms": summarize_latency(to_arm_s),
        "exposure_to_light_ms": summarize_latency(to_light_s),
    }


def read_window_ns(bag: Path) -> tuple[int, int]:
    """Return the start and the end (ns) of the finger stroke in a bag."""
    window = 0, 0
    for _, message, header, _ in BagReader(bag, topics=["twin/finger"]):
        if isinstance(message, TwinFinger) and message.path_label == STROKE:
            window = header.source_ns - round(1e9 * message.path_time_s), header.source_ns
    return window


def evaluate_stroke(bag: Path) -> dict[str, Any]:
    """Compute latencies, errors and lost messages of the finger stroke that a bag contains.

    Latencies have quantiles p50, p95 and p99. Errors of sheet and fingertip have mean, p95 and max.
    """
    recording = stroke.read_recording(bag)
    begin_ns, end_ns = recording.windows_ns[STROKE]
    begin_ns += round(1e9 * APPROACH_S)
    exposures = recording.finger.times_ns
    inside = (exposures >= begin_ns) & (exposures <= end_ns)
    for motion in (recording.fingertip, *recording.measured_edges, *recording.true_edges):
        inside &= motion.covers(exposures)
    times = exposures[inside]
    rows = [
        (message.valid_at_ns, np.array([message.normal_offset_m]))
        for _, message, _, _ in BagReader(bag, topics=["sheet_target"])
        if isinstance(message, SheetTarget)
    ]
    offsets_m = stroke.make_motion(rows, "sheet_target").interpolate(times)
    errors = split_sheet_error(recording, offsets_m, times)
    off_m = recording.fingertip.interpolate(times) - recording.finger.interpolate(times)
    to_arm_s, to_light_s = read_delays_s(bag, begin_ns, end_ns)
    return {
        "exposure_to_arm_ms": summarize_latency(to_arm_s),
        "exposure_to_light_ms": summarize_latency(to_light_s),
        "sheet_mm": summarize_errors(1e3 * np.linalg.norm(errors.sum(axis=0), axis=1)),
        "fingertip_mm": summarize_errors(1e3 * np.linalg.norm(off_m, axis=1)),
        "drops": recording.drops,
    }


def read_delays_s(bag: Path, begin_ns: int, end_ns: int) -> tuple[Floats, Floats]:
    """Return the delays (s) from exposures to arm commands, and from exposures to displayed images.

    Only exposures between `begin_ns` and `end_ns` are used. If an exposure causes several commands
    of the same arm or several images, only the first is used. The display times are corrected by
    the true latency of the projector.
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


def summarize_latency(values_s: Floats) -> dict[str, float] | None:
    """Return the median and the 95 % and 99 % quantiles, in ms, of delays in s.

    Returns None if there are no delays.
    """
    if len(values_s) == 0:
        return None
    p50, p95, p99 = 1e3 * np.quantile(values_s, (0.5, 0.95, 0.99))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}
