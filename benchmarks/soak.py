"""Detect growth, leaks and drift during long use of the whole graph.

python -m benchmarks.soak [--minutes 60] [--busy 0] [--set NODE.PARAMETER=VALUE]
                          [--output FOLDER]

Starts `launch/demo.yaml`, strokes and pushes continuously, and records the logged topics. With
`--busy N`, N other processes compute continuously, each in a separate session as a user's programs
would. Reports

- per process: growth of its private and its resident memory (median of the slopes between all pairs
  of samples, after a warm-up), descriptors, threads, processor time, restarts and hangs
- per topic and reader: numbers of messages, of superseded or overflown, lost and rejected ones
- per window of five minutes: latency from exposure to arm command, fingertip and frame; fraction of
  the time in which the arms followed; number of interruptions by mode; fraction of images with a
  fingertip
- lines of log per node
- findings: growth and errors

Each window is a separate bag, requested by the topic `recording`. It is evaluated when it is
complete and then removed, except for the newest one, so that the disk contains two windows at most.
Ctrl-C ends the run with a report of the data up to then.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from scipy.stats import theilslopes

from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.experiments import image
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.finger_paths import gesture_path
from flexsheet.launch.experiments.run import DEMO_FILE, new_folder
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.precompute import precompute_graph
from flexsheet.launch.running.supervisor import NodeFailedError, RunningGraph
from flexsheet.launch.running.tools import GraphWriter, make_subscriber
from flexsheet.messages.bag import BagError, BagReader, info
from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS, Delivery
from flexsheet.messages.types import (
    ArmMode,
    ArmState,
    FingerPath,
    Fingertip,
    Frame,
    Recording,
    Status,
)
from flexsheet.nodes.arrays import Floats

SAMPLE_S = 10.0
WARM_UP_S = 600.0
WARM_UP_SHARE = 0.25
"""The warm-up of a short run, as a fraction of its duration."""

MIN_FIT_S = 900.0
"""The minimum duration for slopes in seconds.

In a shorter time, caches that fill look like leaks.
"""

READER_NICE = 15

GROWTH_B_PER_H = 2 << 20
"""The minimum growth of memory that is reported, in bytes per hour: 0.3 GB in a week."""

MIN_GROWTH_B = 1 << 20
DRIFT_RATIO = 1.2
"""The maximum ratio of the median latencies in the last and the first third of a run."""

MIN_DRIFT_MS = 1.0
LAUNCHER = "launcher"
MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Sample:
    """Resources of a process at one time.

    uss: private memory. The proportional memory would hide a leak, because it decreases when other
        processes load the same libraries.
    """

    time_s: float
    pid: int
    uss: int
    rss: int
    descriptors: int
    threads: int
    cpu_s: float


@dataclass(frozen=True, slots=True)
class MachineSample:
    """Processor time of the machine and of the graph's processes, and the size of the logs."""

    time_s: float
    busy_s: float
    graph_s: float
    logs_bytes: int


@dataclass(frozen=True, slots=True)
class Slope:
    """The growth per hour: the estimate and its 95 % interval."""

    per_h: float
    low_per_h: float
    high_per_h: float


@dataclass
class PortTotal:
    """The sum of the counters of a reader over all starts of its process."""

    messages: int = 0
    dropped: int = 0
    gaps: int = 0
    rejected: int = 0


@dataclass
class StatusTotals:
    """Totals from the nodes' status messages since the start of the graph."""

    ports: dict[tuple[str, str], PortTotal] = field(default_factory=lambda: defaultdict(PortTotal))
    errors: Counter[str] = field(default_factory=Counter)
    last_error: dict[str, str] = field(default_factory=dict)
    degraded: Counter[str] = field(default_factory=Counter)
    _before: dict[str, Status] = field(default_factory=dict)

    def take(self, status: Status, header: Header) -> None:
        """Add the changes since the last status of the node.

        The counters of a new process start at 0.
        """
        before = self._before.get(status.node)
        self._before[status.node] = status
        if before is None:
            return
        same = before.pid == status.pid
        known = {port.topic: port for port in before.inputs} if same else {}
        for port in status.inputs:
            total = self.ports[status.node, port.topic]
            old = known.get(port.topic)
            for name in ("messages", "dropped", "gaps", "rejected"):
                grown = getattr(port, name) - (getattr(old, name) if old else 0)
                setattr(total, name, getattr(total, name) + grown)
        errors = status.errors - (before.errors if same else 0)
        if errors > 0:
            self.errors[status.node] += errors
        if status.last_error and status.last_error != (before.last_error if same else ""):
            self.last_error[status.node] = status.last_error
        self.degraded[status.node] += status.state == "degraded"


@dataclass(frozen=True, slots=True)
class Window:
    """The results of one bag. Latencies (ms) count from mid-exposure, at percentiles 50 and 99."""

    begin_ns: int
    seconds: float
    megabytes: float
    messages: int
    to_fingertip_ms: tuple[float, float] | None
    to_arm_ms: tuple[float, float] | None
    to_frame_ms: tuple[float, float] | None
    valid_share: float
    follow_share: float
    stops: dict[str, int]
    stops_by_mode: dict[ArmMode, int]
    faults: tuple[str, ...]


def read_window(bag: Path) -> Window:
    """Compute the results of a window's bag."""
    first: dict[tuple[str, int], float] = {}
    valid: Counter[bool] = Counter()
    modes: Counter[str] = Counter()
    stops: Counter[str] = Counter()
    stops_by_mode: Counter[ArmMode] = Counter()
    faults: set[str] = set()
    last_mode: dict[str, str] = {}

    def delay(event: str, source_ns: int, event_ns: int) -> None:
        first.setdefault((event, source_ns), (event_ns - source_ns) * 1e-6)

    for _, message, header, _ in BagReader(bag, ["arm_left", "arm_right", "fingertip", "frame"]):
        match message:
            case Fingertip():
                valid[message.valid] += 1
                delay("fingertip", header.source_ns, header.publish_ns)
            case Frame():
                delay("frame", header.source_ns, message.drawn_ns or header.publish_ns)
            case ArmState():
                modes[message.mode] += 1
                if message.mode == "fault":
                    faults.update(message.faults)
                before, last_mode[message.side] = last_mode.get(message.side), message.mode
                if before == "follow" and message.mode != "follow":
                    stops[f"{message.side} arm: {message.mode}, {message.reason}"] += 1
                    stops_by_mode[message.mode] += 1
                if message.target_source_ns and message.command_sent_ns:
                    delay(message.side, message.target_source_ns, message.command_sent_ns)
            case _:
                pass
    events: dict[str, list[float]] = defaultdict(list)
    for (event, _), value in first.items():
        events["arm" if event in ("left", "right") else event].append(value)

    def percentiles(event: str) -> tuple[float, float] | None:
        if not events[event]:
            return None
        low, high = np.percentile(events[event], (50.0, 99.0))
        return float(low), float(high)

    whole = info(bag)
    return Window(
        begin_ns=whole.start_ns,
        seconds=whole.duration_s,
        megabytes=whole.size_bytes * 1e-6,
        messages=whole.count,
        to_fingertip_ms=percentiles("fingertip"),
        to_arm_ms=percentiles("arm"),
        to_frame_ms=percentiles("frame"),
        valid_share=valid[True] / max(valid.total(), 1),
        follow_share=modes["follow"] / max(modes.total(), 1),
        stops=dict(stops.most_common()),
        stops_by_mode=dict(stops_by_mode.most_common()),
        faults=tuple(sorted(faults)),
    )


def paths(scene: Scene) -> Iterator[FingerPath]:
    """Yield strokes and pushes endlessly, each with a unique label."""
    for number in count(1):
        for name in ("stroke-10", "stroke-push", "tap", "circle"):
            path = gesture_path(name, scene)
            yield path.model_copy(update={"label": f"{number} {path.label}"})
        for depth_mm in (10.0, 30.0, 50.0, 5.0):
            path = image.PUSH.path(scene, depth_mm)
            yield path.model_copy(update={"label": f"{number} {path.label}"})


class Soak:
    """One run of the graph: its samples, its windows, and the nodes' totals.

    seconds: duration of the strokes.
    window_s: duration of each bag.
    folder: folder for bags and report.
    busy: number of other processes that compute.
    """

    def __init__(
        self,
        seconds: float,
        window_s: float,
        folder: Path,
        settings: Sequence[str],
        *,
        busy: int = 0,
    ) -> None:
        self.seconds, self.window_s, self.folder, self.busy = seconds, window_s, folder, busy
        self.samples: dict[str, list[Sample]] = defaultdict(list)
        self.machine: list[MachineSample] = []
        self.inbox = StatusTotals()
        self.windows: list[Window] = []
        self.problems: list[str] = []
        self.paths_followed = 0
        self.log_lines: dict[str, int] = {}
        self.began_s = self.lasted_s = 0.0
        bag = folder / "soak-%Y%m%d-%H%M%S.mcap"
        self.plan = load_graph(
            DEMO_FILE, record=bag, settings=["recorder.start_paused=true", *settings]
        )
        self.graph = RunningGraph(self.plan)
        self._processes: dict[int, psutil.Process] = {}
        self._cpu_s: dict[int, float] = {}

    async def run(self) -> None:
        """Run the graph for the duration. A premature end is recorded in `problems`."""
        scene = self.plan.scene_message()
        assert scene is not None  # the demo has one
        precompute_graph(self.plan, say)
        try:
            async with self.graph:
                await self.graph.wait_ready()
                async with Driver(self.plan, self.graph.run) as driver:
                    await driver.wait_ready()
                    await self._use(driver, scene)
        except asyncio.CancelledError:
            self.problems.append(f"interrupted after {self.lasted_s / 60.0:.1f} minutes")
        except Exception as error:
            # Report any error that ends the graph, with the results up to then.
            self.problems.append(f"{type(error).__name__}: {error}")
        await self._read_bags(all_of_them=True)

    async def _use(self, driver: Driver, scene: Scene) -> None:
        status = make_subscriber(
            "status", self.plan, self.graph.run, self.inbox.take, on_problem=self.problems.append
        )
        writer = GraphWriter(self.plan, self.graph.run, ["recording"])
        status.start()
        others = [start_busy_process() for _ in range(self.busy)]
        lines_before = self._count_log_lines()
        self.began_s = time.monotonic()
        writer.publish("recording", Recording(running=True))
        say(f"{self.seconds / 60.0:g} minutes begin")
        tasks = [
            asyncio.create_task(self._stroke(driver, scene)),
            asyncio.create_task(self._sample()),
            asyncio.create_task(self._record(writer)),
            asyncio.create_task(self.graph.wait()),
        ]
        try:
            done, _ = await asyncio.wait(
                tasks, timeout=self.seconds, return_when=asyncio.FIRST_COMPLETED
            )
            for task in done:
                task.result()
                raise NodeFailedError("the nodes have ended")
        finally:
            self.lasted_s = time.monotonic() - self.began_s
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for other in others:
                other.kill()
                other.wait()
            self._take_samples()
            for name, lines in self._count_log_lines().items():
                self.log_lines[name] = lines - lines_before.get(name, 0)
            writer.publish("recording", Recording(running=False))
            status.close()
            writer.close()

    def _count_log_lines(self) -> dict[str, int]:
        """Count the lines of each log of the run."""
        logs = self.graph.run.logs.glob("*.log")
        return {log.stem: len(log.read_bytes().splitlines()) for log in logs}

    async def _stroke(self, driver: Driver, scene: Scene) -> None:
        for path in paths(scene):
            await driver.follow(path)
            self.paths_followed += 1

    async def _sample(self) -> None:
        while True:
            self._take_samples()
            await asyncio.sleep(SAMPLE_S)

    def _take_samples(self) -> None:
        time_s = time.monotonic() - self.began_s
        for name, pid in {**self.graph.pids, LAUNCHER: os.getpid()}.items():
            try:
                process = self._processes.setdefault(pid, psutil.Process(pid))
                memory, times = process.memory_full_info(), process.cpu_times()
                sample = Sample(
                    time_s=time_s,
                    pid=pid,
                    uss=memory.uss,
                    rss=memory.rss,
                    descriptors=process.num_fds(),
                    threads=process.num_threads(),
                    cpu_s=times.user + times.system,
                )
            except psutil.Error:
                continue  # it was just killed; the launcher counts its restart
            self.samples[name].append(sample)
            self._cpu_s[pid] = sample.cpu_s
        times = psutil.cpu_times()
        self.machine.append(
            MachineSample(
                time_s=time_s,
                busy_s=sum(times) - times.idle - times.iowait,
                graph_s=sum(self._cpu_s.values()),
                logs_bytes=sum(one.stat().st_size for one in self.graph.run.logs.iterdir()),
            )
        )

    async def _record(self, writer: GraphWriter) -> None:
        for number in count(1):
            # Reading a bag takes part of the next window's time.
            await asyncio.sleep(self.began_s + number * self.window_s - time.monotonic())
            writer.publish("recording", Recording(running=False))
            writer.publish("recording", Recording(running=True))
            await self._read_bags()
            newest = self.windows[-1].to_arm_ms if self.windows else None
            say(f"{(time.monotonic() - self.began_s) / 60.0:.0f} minutes: to arm {newest} ms")

    async def _read_bags(self, *, all_of_them: bool = False) -> None:
        """Evaluate the complete bags in a process with low priority, and remove them.

        The newest bag is complete only at the end of the run. It is not removed.
        """
        bags = sorted(self.folder.glob("soak-*.mcap"), key=lambda bag: bag.stat().st_mtime_ns)
        context = multiprocessing.get_context("spawn")
        for bag in bags if all_of_them else bags[:-1]:
            with ProcessPoolExecutor(1, mp_context=context, initializer=lower_priority) as pool:
                work = asyncio.get_running_loop().run_in_executor(pool, read_window, bag)
                try:
                    self.windows.append(await work)
                except BagError as error:
                    self.problems.append(str(error))
            if bag is not bags[-1]:
                bag.unlink()


def start_busy_process() -> subprocess.Popen[bytes]:
    """Start a process that computes continuously until it is killed."""
    program = [sys.executable, "-c", "while True: pass"]
    return subprocess.Popen(program, start_new_session=True)


def lower_priority() -> None:
    """Lower the priority of the process that reads bags."""
    os.nice(READER_NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def slope(times_s: Floats, values: Floats) -> Slope | None:
    """Return the median slope of all pairs (Theil, Sen), or None if the time is too short."""
    if times_s[-1] - times_s[0] < MIN_FIT_S:
        return None
    found = theilslopes(values, times_s / 3600.0)
    return Slope(float(found.slope), float(found.low_slope), float(found.high_slope))


def warm_up_s(lived_s: float) -> float:
    return min(WARM_UP_S, WARM_UP_SHARE * lived_s)


def process_report(samples: Sequence[Sample]) -> dict[str, Any]:
    """Summarize the samples of a process since its newest start."""
    pid = samples[-1].pid
    ours = [one for one in samples if one.pid == pid]
    settled_from_s = ours[0].time_s + warm_up_s(ours[-1].time_s - ours[0].time_s)
    settled = [one for one in ours if one.time_s >= settled_from_s]
    times = np.array([one.time_s for one in settled])
    lived_s = ours[-1].time_s - ours[0].time_s

    def grown(name: str) -> dict[str, Any]:
        values = np.array([getattr(one, name) for one in settled], dtype=np.float64)
        found = slope(times, values)
        return {
            "start": int(getattr(ours[0], name)),
            "settled": float(np.median(values[: max(len(values) // 4, 1)])),
            "end": float(np.median(values[-max(len(values) // 4, 1) :])),
            "most": int(max(getattr(one, name) for one in ours)),
            "slope_per_h": None if found is None else asdict(found),
        }

    return {
        "starts": len({one.pid for one in samples}),
        "uss": grown("uss"),
        "rss": grown("rss"),
        "descriptors": grown("descriptors"),
        "threads": grown("threads"),
        "processor_share": (ours[-1].cpu_s - ours[0].cpu_s) / lived_s if lived_s else None,
    }


def make_report(soak: Soak) -> dict[str, Any]:
    """Make the report of a run, with its findings."""
    processes = {name: process_report(samples) for name, samples in soak.samples.items() if samples}
    windows = [window_report(soak, window) for window in soak.windows]
    ports = [
        {"node": node, "topic": topic, "delivery": TOPICS[topic].delivery.value, **asdict(total)}
        for (node, topic), total in sorted(soak.inbox.ports.items())
    ]
    result = {
        "machine": machine_name(),
        "minutes": soak.lasted_s / 60.0,
        "busy_processes": soak.busy,
        "paths_followed": soak.paths_followed,
        "processes": processes,
        "ports": ports,
        "windows": windows,
        "restarts": {name: number for name, number in soak.graph.restarts.items() if number},
        "hangs": {name: number for name, number in soak.graph.hangs.items() if number},
        "errors": dict(soak.inbox.errors),
        "last_errors": soak.inbox.last_error,
        "logs_bytes_per_h": logs_growth(soak.machine),
        "log_lines": {name: lines for name, lines in soak.log_lines.items() if lines},
        "series": {name: thin_out(samples) for name, samples in soak.samples.items()},
    }
    return {**result, "findings": [*soak.problems, *findings(result)]}


def window_report(soak: Soak, window: Window) -> dict[str, Any]:
    begin_s = window.begin_ns * 1e-9 - soak.began_s
    inside = [
        one for one in soak.machine if begin_s - SAMPLE_S <= one.time_s <= begin_s + window.seconds
    ]
    busy = graph = None
    if len(inside) > 1:
        seconds = (inside[-1].time_s - inside[0].time_s) * (os.cpu_count() or 1)
        busy = (inside[-1].busy_s - inside[0].busy_s) / seconds
        graph = (inside[-1].graph_s - inside[0].graph_s) / seconds
    return {**asdict(window), "begin_s": begin_s, "machine_busy": busy, "graph_busy": graph}


def logs_growth(machine: Sequence[MachineSample]) -> float | None:
    if len(machine) < 2 or machine[-1].time_s <= machine[0].time_s:
        return None
    grown = machine[-1].logs_bytes - machine[0].logs_bytes
    return 3600.0 * grown / (machine[-1].time_s - machine[0].time_s)


def thin_out(samples: Sequence[Sample]) -> list[dict[str, Any]]:
    """Return one sample per minute, for plots."""
    return [asdict(one) for one in samples[:: round(60.0 / SAMPLE_S)]]


def findings(result: dict[str, Any]) -> list[str]:
    """Describe each growth, drift or error in a sentence."""
    found = []
    for name, process in result["processes"].items():
        memory = process["uss"]
        rate = memory["slope_per_h"]
        grown = memory["end"] - memory["settled"]
        if rate and rate["low_per_h"] > GROWTH_B_PER_H and grown > MIN_GROWTH_B:
            found.append(
                f"{name}: memory grows by {rate['per_h'] / MIB:.1f} MiB/h "
                f"(at least {rate['low_per_h'] / MIB:.1f})"
            )
        for what in ("descriptors", "threads"):
            if rate and process[what]["end"] > process[what]["settled"]:
                found.append(
                    f"{name}: {what} grew from {process[what]['settled']:g} "
                    f"to {process[what]['end']:g}"
                )
    for word in ("restarts", "hangs"):
        found += [f"{name}: {number} {word}" for name, number in result[word].items()]
    for name, number in result["errors"].items():
        found.append(f"{name}: {number} errors")
    for port in result["ports"]:
        lost = port["gaps"] + port["dropped"]
        if port["rejected"] or (lost and port["delivery"] != Delivery.LATEST):
            found.append(
                f"{port['node']}, topic {port['topic']}: {lost} of {port['messages']} lost, "
                f"{port['rejected']} refused"
            )
    for name, text in result["last_errors"].items():
        found.append(f"{name}: {text}")
    for window in result["windows"]:
        found += [f"an arm had a fault: {fault}" for fault in window["faults"]]
    return [*found, *drifts(result["windows"])]


def drifts(windows: Sequence[dict[str, Any]]) -> list[str]:
    """Compare the latencies of the last third of the windows with those of the first."""
    found = []
    third = len(windows) // 3
    for what in ("to_fingertip_ms", "to_arm_ms", "to_frame_ms"):
        medians = [window[what][0] for window in windows if window[what]]
        if third < 2 or len(medians) < len(windows):
            continue
        early, late = np.median(medians[:third]), np.median(medians[-third:])
        if late > DRIFT_RATIO * early and late - early > MIN_DRIFT_MS:
            found.append(
                f"exposure {what[:-3].replace('_', ' ')}: {early:.1f} ms became {late:.1f}"
            )
    return found


def print_report(result: dict[str, Any]) -> None:
    """Print the report as tables, and the findings."""
    processes = [
        {
            "process": name,
            "private_mib": [round(one["uss"][key] / MIB, 1) for key in ("start", "end")],
            "slope_mib_per_h": None
            if one["uss"]["slope_per_h"] is None
            else round(one["uss"]["slope_per_h"]["per_h"] / MIB, 2),
            "descriptors": [one["descriptors"][key] for key in ("settled", "end")],
            "threads": [one["threads"][key] for key in ("settled", "end")],
            "processor_share": one["processor_share"],
            "restarts": one["starts"] - 1,
        }
        for name, one in result["processes"].items()
    ]
    hidden = ("begin_ns", "seconds", "messages", "stops", "faults")
    windows = [
        {"minute": round(one["begin_s"] / 60.0)} | {k: v for k, v in one.items() if k not in hidden}
        for one in result["windows"]
    ]
    ports = [one for one in result["ports"] if one["dropped"] or one["gaps"] or one["rejected"]]
    for rows in (processes, windows, ports):
        print_rows(rows, as_json=False)
        print()
    print("findings:", *(result["findings"] or ["none"]), sep="\n- ")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


async def until_interrupted(soak: Soak) -> None:
    """Run until the end. The first SIGINT or SIGTERM ends the run normally."""
    task = asyncio.create_task(soak.run())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    await task


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--window-minutes", type=float, default=5.0)
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="number of busy processes")
    parser.add_argument("--set", action="append", default=[], metavar="NODE.PARAMETER=VALUE")
    parser.add_argument("--output", type=Path, help="new folder; default: runs/TIME-soak")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if given.output is None:
        folder = new_folder("soak")
    else:
        folder = given.output
        folder.mkdir(parents=True)
    soak = Soak(
        60.0 * given.minutes,
        60.0 * given.window_minutes,
        folder.resolve(),
        given.set,
        busy=given.busy,
    )
    asyncio.run(until_interrupted(soak))
    result = make_report(soak)
    (folder / "soak.json").write_text(json.dumps(result, indent=1))
    if given.json:
        print(json.dumps(result))
    else:
        print_report(result)
    say(f"report and newest bag are in {folder}")
    return 1 if result["findings"] else 0


if __name__ == "__main__":
    sys.exit(main())
