"""Inject random faults between three computers: `python -m benchmarks.faults --random`.

python -m benchmarks.faults --random [--minutes 60] [--every 10] [--seed 1]

The setup is that of `benchmarks.faults`: network namespaces, keys, a launcher per host, and a
finger that strokes continuously. Faults are drawn from a seed. Afterwards the bags and the
simulated joints are evaluated. Violations are:

- a joint beyond its speed or range, a sheet longer than its limit, or an arm that moves during an
  e-stop
- arms that do not both follow within a minute after a fault
- a remaining process, socket file or directory of a run, or a process whose descriptors or memory
  grow
- messages that are missing in the bag of the main host outside of the time of a fault
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import resource
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.faults import MAX_LENGTH_M, RECORDERS, Result, Span, kill, kill_launcher, run_fault
from flexsheet.launch.running.runs import MAX_FINISHED_RUNS, RUN_VARIABLE
from flexsheet.launch.running.tools import READER_RECONNECT_S
from flexsheet.messages.bag import FLUSH_PERIOD_S
from tests.lab import HOSTS, LIGHT, Lab
from tests.lab_bags import Arm, Gap, bags, gaps, read_arm

PUBLISH_PERIOD_S = 1.0
MARGIN_NS = round(1e9 * (FLUSH_PERIOD_S + PUBLISH_PERIOD_S + READER_RECONNECT_S + 0.5))
"""The allowed gap in a bag before and after a fault, in nanoseconds.

It covers data that are not yet written, and messages that are sent before a reader reconnects.
"""

STANDS_RAD = 1e-3
STOPPED_NS = 200_000_000
"""The time that joints need to reach a command in nanoseconds, because servos lag."""

MAX_MORE_DESCRIPTORS = 10
MAX_MORE_BYTES = 20 << 20
MIN_LIFE_S = 600.0
"""The minimum lifetime of a process for the detection of leaks in seconds, with its warm-up."""

RESET_TRIES = 10


class FaultKind(StrEnum):
    """The kind of a fault."""

    NODE_KILLED = "node killed"
    NODE_SUSPENDED = "node suspended"
    LAUNCHER_KILLED = "launcher killed"
    LAUNCHER_SUSPENDED = "launcher suspended"
    CABLE_CUT = "cable cut"
    CABLE_BAD = "cable bad"
    ESTOP = "e-stop and reset"
    DISK_FULL = "disk full"


@dataclass(frozen=True, slots=True)
class Fault:
    """A random fault: its host, its node (or None) and its duration."""

    kind: FaultKind
    host: str
    node: str | None
    seconds: float

    @property
    def name(self) -> str:
        what = f"{self.kind} on {self.host}"
        return f"{what}, {self.node}" if self.node else what


def draw_fault(
    rng: random.Random, nodes: dict[str, list[str]], kinds: Sequence[FaultKind] = tuple(FaultKind)
) -> Fault:
    """Draw a fault.

    nodes: name of one node per process, by host.
    """
    kind = rng.choice(kinds)
    host = "main" if kind is FaultKind.DISK_FULL else rng.choice(HOSTS)
    of_a_node = kind in (FaultKind.NODE_KILLED, FaultKind.NODE_SUSPENDED)
    node = rng.choice(nodes[host]) if of_a_node else None
    return Fault(kind, host, node, round(rng.uniform(0.2, 4.0), 1))


async def inject(lab: Lab, fault: Fault, span: Span) -> None:
    """Cause and end a fault, and wait until killed processes run again."""
    match fault.kind:
        case FaultKind.NODE_KILLED:
            assert fault.node is not None
            await kill(lab, fault.host, fault.node, span)
        case FaultKind.NODE_SUSPENDED:
            assert fault.node is not None
            await suspend(lab.pid_of(fault.host, fault.node), fault.seconds, span)
        case FaultKind.LAUNCHER_KILLED:
            await kill_launcher(lab, fault.host, span)
        case FaultKind.LAUNCHER_SUSPENDED:
            await suspend(lab.launchers[fault.host].pid, fault.seconds, span)
        case FaultKind.CABLE_CUT:
            await spoil_cable(lab, fault, span, cut=True)
        case FaultKind.CABLE_BAD:
            await spoil_cable(lab, fault, span, loss=0.02, delay_s=0.02, jitter_s=0.01)
        case FaultKind.ESTOP:
            await stop_and_reset(lab, fault.host, span)
        case FaultKind.DISK_FULL:
            await refuse_writing(lab, fault.seconds, span)


async def suspend(process: int, seconds: float, span: Span) -> None:
    span.begin()
    os.kill(process, signal.SIGSTOP)
    await asyncio.sleep(seconds)
    os.kill(process, signal.SIGCONT)
    span.end()


async def spoil_cable(lab: Lab, fault: Fault, span: Span, **how: Any) -> None:
    span.begin()
    await lab.cable(fault.host, **how)
    await asyncio.sleep(fault.seconds)
    await lab.cable(fault.host)
    span.end()


async def stop_and_reset(lab: Lab, host: str, span: Span) -> None:
    """Stop both arms by a command on any host, and reset the stop on the main host."""
    span.begin()
    code, printed = await lab.run(host, "arms", "stop", "--reason", f"drawn on {host}")
    assert code == 0, printed
    await lab.until(lambda: lab.modes() == {"estop"}, "both arms to stop")
    for _ in range(RESET_TRIES):
        code, printed = await lab.run("main", "arms", "reset")
        if code == 0:
            break
    assert code == 0, printed
    span.end()


async def refuse_writing(lab: Lab, seconds: float, span: Span) -> None:
    """Make each write of the main recorder fail, as with a full disk."""
    await lab.until(lambda: lab.restarts("main", "recorder") >= 0, "the recorder to be ready")
    process = lab.pid_of("main", "recorder")
    before = len(bags(lab.folder, "main"))
    _, hard = resource.prlimit(process, resource.RLIMIT_FSIZE)
    span.begin()
    resource.prlimit(process, resource.RLIMIT_FSIZE, (0, hard))
    # The recorder notices at its next write, at the latest after a flush period.
    await asyncio.sleep(max(seconds, 2.0 * FLUSH_PERIOD_S))
    try:
        resource.prlimit(process, resource.RLIMIT_FSIZE, (hard, hard))
    except ProcessLookupError as error:
        raise AssertionError("the recorder ended while its disk was full") from error
    span.end()
    await lab.until(lambda: len(bags(lab.folder, "main")) > before, "the next bag")
    newest = bags(lab.folder, "main")[-1]
    await lab.until(lambda: newest.stat().st_size > 0, "the next bag to be written")


@dataclass(slots=True)
class Sample:
    """Descriptors and memory of one process at one time."""

    at_s: float
    descriptors: int
    bytes: int


@dataclass
class ProcessMonitor:
    """Samples of all processes, and files and processes that ended processes have left."""

    lab: Lab
    samples: dict[tuple[int, float, str], list[Sample]] = field(
        default_factory=lambda: defaultdict(list)
    )
    violations: list[str] = field(default_factory=list)

    def sample(self) -> None:
        """Sample all processes, and record what ended processes have left."""
        launchers = {process.pid for process in self.lab.launchers.values()}
        root = str(self.lab.folder)
        for process in psutil.process_iter():
            try:
                command, run = process.cmdline(), process.environ().get(RUN_VARIABLE)
                if not any(root in word for word in command):
                    continue
                if run is not None and int(run.partition(".")[0]) not in launchers:
                    self.violations.append(f"process {process.pid} of a dead launcher: {command}")
                key = (process.pid, process.create_time(), Path(command[-1]).name)
                sample = Sample(time.monotonic(), process.num_fds(), process.memory_full_info().uss)
            except psutil.Error:
                # The process has ended in the meantime.
                continue
            self.samples[key].append(sample)
        for host in HOSTS:
            self._check_runs(host, launchers)

    def _check_runs(self, host: str, launchers: set[int]) -> None:
        directories = [one for one in (self.lab.folder / host / "r").iterdir() if one.is_dir()]
        # A start keeps this number of finished runs, in addition to its own.
        if len(directories) > MAX_FINISHED_RUNS + 1:
            self.violations.append(f"{len(directories)} directories of runs on {host}")
        for directory in directories:
            launcher = int(directory.name.removeprefix(".begun-").partition(".")[0])
            dead = launcher not in launchers
            left = [entry.name for entry in directory.iterdir() if entry.is_socket()]
            if dead and left:
                self.violations.append(f"sockets of a dead run on {host}: {', '.join(left)}")

    def leaks(self) -> list[str]:
        """Return the processes with growing descriptors or private memory."""
        found = []
        for (process, _, name), samples in self.samples.items():
            begun_s, ended_s = samples[0].at_s, samples[-1].at_s
            if ended_s - begun_s < MIN_LIFE_S:
                continue
            warm = [one for one in samples if one.at_s >= begun_s + 0.25 * (ended_s - begun_s)]
            third = max(1, len(warm) // 3)
            for what, limit in (("descriptors", MAX_MORE_DESCRIPTORS), ("bytes", MAX_MORE_BYTES)):
                first = float(np.median([getattr(one, what) for one in warm[:third]]))
                last = float(np.median([getattr(one, what) for one in warm[-third:]]))
                if last > first + limit:
                    found.append(f"{name}, pid {process}: {what} {first:.0f} to {last:.0f}")
        return found


def missing_outside_faults(lost: list[Gap], results: list[Result]) -> list[Gap]:
    """Return the gaps of the main host's bag that are not within the times of faults.

    A gap may extend over several faults if no time between them is free of faults: a launcher that
    is killed again before its recorder is connected leaves one gap.
    """
    spans = merge_spans([(one.during_ns[0], one.during_ns[1]) for one in results])
    return [
        gap
        for gap in lost
        if not any(begin <= gap.from_ns and gap.to_ns <= end for begin, end in spans)
    ]


def merge_spans(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Extend the times (start, end), ns, of faults by the margin, and merge those that overlap."""
    merged: list[tuple[int, int]] = []
    for begin, end in sorted((begin - MARGIN_NS, end + MARGIN_NS) for begin, end in spans):
        if merged and begin <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(merged[-1][1], end)
        else:
            merged.append((begin, end))
    return merged


def fault_free_ratio(results: list[Result]) -> float:
    """Return the fraction of the time that is outside of all faults and their margins."""
    spans = merge_spans([(one.during_ns[0], one.during_ns[1]) for one in results])
    covered_ns = sum(end - begin for begin, end in spans)
    return 1.0 - covered_ns / (spans[-1][1] - spans[0][0]) if spans else 1.0


def missing_by_fault(lost: list[Gap], results: list[Result]) -> dict[str, float]:
    """Return the longest gap in the main host's bag after each fault, s, sorted by length."""
    longest: dict[str, float] = {}
    for gap in lost:
        earlier = [one for one in results if one.during_ns[0] - MARGIN_NS <= gap.from_ns]
        name = max(earlier, key=lambda one: one.during_ns[0]).problem if earlier else "start"
        longest[name] = max(longest.get(name, 0.0), gap.seconds)
    return dict(sorted(longest.items(), key=lambda item: -item[1]))


def moves_under_estop(arm: Arm) -> float:
    """Return the maximum rotation of a joint, rad, while the bridge reported an e-stop."""
    spans = [(begin + STOPPED_NS, end) for begin, end in arm.spans("estop")]
    return max((arm.turned_rad(span) for span in spans if span[1] > span[0]), default=0.0)


async def restore(lab: Lab) -> None:
    """Restart all launchers after a fault from which the arms did not recover."""
    for host in HOSTS:
        await lab.cable(host)
    for process in lab.launchers.values():
        process.kill()
    for process in lab.launchers.values():
        await asyncio.to_thread(process.wait)
    lab.newest.clear()
    await lab.start_all()


async def run_random(given: argparse.Namespace) -> int:
    """Draw faults for `given.minutes`, and print a report. Return 1 if there are violations."""
    rng = random.Random(given.seed)
    kinds = [kind for kind in FaultKind if given.only in kind.value]
    load = os.getloadavg()
    results: list[Result] = []
    counts: dict[str, int] = defaultdict(int)
    async with Lab(without=LIGHT) as lab:
        watch = ProcessMonitor(lab)
        nodes = {
            host: [one.nodes[0].name for one in lab.plan().processes_on(host, without=RECORDERS)]
            for host in HOSTS
        }
        await lab.start_all()
        lab.stroke()
        end_s = time.monotonic() + 60.0 * given.minutes
        while time.monotonic() < end_s:
            next_s = time.monotonic() + given.every
            fault = draw_fault(rng, nodes, kinds)
            result = await attempt(lab, fault)
            results.append(result)
            counts[fault.kind.value] += 1
            print(json.dumps(asdict(fault) | asdict(result)), file=sys.stderr, flush=True)
            if result.back_s is None:
                await restore(lab)
            watch.sample()
            # Delete evaluated data; an hour of it would fill the memory.
            lab.seen.clear()
            await asyncio.sleep(max(0.0, next_s - time.monotonic()))
        for process in lab.launchers.values():
            process.send_signal(signal.SIGINT)
        for process in lab.launchers.values():
            await asyncio.to_thread(process.wait, 40)
        report = evaluate(lab, results, watch)
    report |= {
        "seed": given.seed,
        "minutes": given.minutes,
        "load": [load, os.getloadavg()],
        "faults": dict(counts),
    }
    print(json.dumps(report, indent=1) if given.json else table(report))
    return 1 if report["violations"] else 0


async def attempt(lab: Lab, fault: Fault) -> Result:
    """Inject a fault, and wait until both arms follow again."""
    work: Callable[[Span], Awaitable[Any]] = partial(inject, lab, fault)
    begun_ns = time.monotonic_ns()
    try:
        return await run_fault(lab, fault.name, work)
    except AssertionError as error:
        # They did not follow before this fault: a previous fault left them stuck.
        print(f"{fault.name}: {str(error)[:600]}", file=sys.stderr)
        during = (begun_ns, time.monotonic_ns())
        return Result(fault.name, None, None, during, (), {}, 0.0)


def evaluate(lab: Lab, results: list[Result], watch: ProcessMonitor) -> dict[str, Any]:
    """Evaluate the bags, the simulated joints and the processes."""
    scene = lab.plan().scene_message()
    assert scene is not None
    violations = [f"stuck after: {one.problem}" for one in results if one.back_s is None]
    violations += [f"{one.problem}: {', '.join(one.faults)}" for one in results if one.faults]
    longest_m = max((one.longest_m for one in results), default=0.0)
    if longest_m > MAX_LENGTH_M:
        violations.append(f"sheet of {1e3 * longest_m:.0f} mm")
    speeds = []
    for side in ("left", "right"):
        arm = read_arm(lab.folder, side, scene)
        speeds.append(arm.fastest())
        if arm.fastest() > 1.0:
            violations.append(f"joint speed of the {side} arm: {arm.fastest():.2f} of the limit")
        if arm.leaves_range():
            violations.append(f"joint range of the {side} arm")
        if (moved_rad := moves_under_estop(arm)) > STANDS_RAD:
            violations.append(f"the {side} arm moved by {moved_rad:.4f} rad under an e-stop")
    lost = gaps(lab.folder)
    violations += [
        f"{gap.seconds:.2f} s of {gap.topic} of {gap.writer} missing"
        for gap in missing_outside_faults(lost, results)
    ]
    violations += sorted(set(watch.violations)) + watch.leaks()
    stopped = [one.stopped_s for one in results if one.stopped_s is not None]
    back = [one.back_s for one in results if one.back_s is not None and one.stopped_s is not None]
    return {
        "count": len(results),
        "stopped_s": percentiles(stopped),
        "back_s": percentiles(back),
        "missing_s": percentiles([gap.seconds for gap in lost]),
        "missing_by_fault": missing_by_fault(lost, results),
        "fault_free_ratio": fault_free_ratio(results),
        "longest_sheet_mm": 1e3 * longest_m,
        "largest_joint_speed_ratio": max(speeds),
        "violations": violations,
    }


def percentiles(values: list[float]) -> dict[str, float] | None:
    """Return median, 95 % quantile and maximum, or None without values."""
    if not values:
        return None
    p50, p95 = np.percentile(values, (50.0, 95.0))
    return {"p50": float(p50), "p95": float(p95), "max": max(values)}


def table(report: dict[str, Any]) -> str:
    """Format the report as text."""
    lines = [f"{name}: {value}" for name, value in report.items() if name != "violations"]
    return "\n".join([*lines, "violations:", *(report["violations"] or ["none"])])
