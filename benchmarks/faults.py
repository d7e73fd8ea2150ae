"""What the arms do when anything of three computers fails: `python -m benchmarks.faults`.

Network namespaces at a bad switch, each with its own launcher and keys (`tests/lab.py`; needs
root).  Each trouble is brought about while the arms follow; judged by what both bridges said, by
the arms' true joints, from their own computers' bags, and by what is missing in the main one's bag.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from messages.bag import BagReader
from messages.base import Header
from messages.types import ArmState, TwinArms
from tests.lab import HOSTS, LIGHT, Lab, missing


class Span:
    """When a trouble began, and when it was over; s of the monotonic clock."""

    def __init__(self) -> None:
        self.begun_s = self.over_s = time.monotonic()

    def begin(self) -> None:
        """What was looked up before does not count; one that is told no end is over at once."""
        self.begun_s = self.over_s = time.monotonic()

    def end(self) -> None:
        self.over_s = time.monotonic()


Work = Callable[[Span], Awaitable[Any]]

SIDES = ("left", "right")
JOINT_SPEEDS_RAD_PER_S = np.radians([150.0, 150.0, 180.0, 180.0, 180.0, 240.0])
"""The maker's; a joint of the twin that is faster has been told what no arm may be."""

LONGEST_M = 0.24 * 1.15
BACK_WITHIN_S = 60.0
SILENT_S = 0.1
"""A bridge that says nothing for so long follows nothing."""
MARGIN_NS = 1_500_000_000
"""What is said once a second and lost at the beginning was last heard so long before."""


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one trouble.

    stopped_s: until neither arm followed, None: they never stopped.  back_s: the longest that they
    did not both follow, without the time that the trouble itself lasted; None: they never did
    again.  during_ns: from its beginning until all was well.
    """

    trouble: str
    stopped_s: float | None
    back_s: float | None
    during_ns: tuple[int, int]
    faults: tuple[str, ...]
    longest_m: float


async def tried(lab: Lab, name: str, work: Work) -> Result:
    """Bring a trouble about, let it end, and see both arms follow again.

    work: brings it about and ends when it is over and what was killed has been started again.
    """
    await lab.until(lambda: lab.modes() == {"follow"}, f"both to follow, before {name}")
    begin, span = len(lab.seen), Span()
    told: list[tuple[float, set[str]]] = []

    async def watch() -> None:
        newest: dict[str, tuple[float, object]] = {}
        while True:
            modes = lab.modes()
            for side in SIDES:
                state = lab.newest.get(f"arm_{side}")
                if newest.get(side, (0.0, None))[1] is not state:
                    newest[side] = (time.monotonic(), state)
                elif time.monotonic() - newest[side][0] > SILENT_S:
                    modes = {"silent"}
            if not told or told[-1][1] != modes:
                told.append((time.monotonic(), modes))
            await asyncio.sleep(0.005)

    watching = asyncio.create_task(watch())
    failed = False
    try:
        await work(span)
        await lab.until(lambda: lab.modes() == {"follow"}, name, within_s=BACK_WITHIN_S)
    except AssertionError as error:
        print(f"{name}: {str(error)[:600]}", file=sys.stderr)
        failed = True
    finally:
        watching.cancel()
    stopped_s = next(
        (at for at, modes in told if at > span.begun_s and "follow" not in modes), None
    )
    back_s = None if failed else longest_away_s(told, span)
    states = [state for _, state in lab.seen[begin:] if isinstance(state, ArmState)]
    faults = {fault for state in states for fault in state.faults if state.mode == "fault"}
    longest_m = max((state.edge_distance_m or 0.0 for state in states), default=0.0)
    return Result(
        name,
        None if stopped_s is None else stopped_s - span.begun_s,
        back_s,
        (round(span.begun_s * 1e9), time.monotonic_ns()),
        tuple(sorted(faults)),
        longest_m,
    )


def longest_away_s(told: list[tuple[float, set[str]]], span: Span) -> float:
    """The longest time that not both arms followed, as far as it lies after the trouble was over.

    A busy computer makes arms hold for moments of its own, which are shorter.
    """
    longest_s = 0.0
    since_s: float | None = None
    for at_s, modes in [*told, (time.monotonic(), {"follow"})]:
        if modes != {"follow"}:
            since_s = at_s if since_s is None else since_s
        elif since_s is not None:
            longest_s = max(longest_s, at_s - max(since_s, span.over_s))
            since_s = None
    return longest_s


async def matrix(lab: Lab, only: str) -> list[Result]:
    """All troubles, or those whose name has `only` in it."""
    await lab.start_all()
    results = []

    async def case(name: str, work: Work) -> None:
        if only not in name:
            return
        result = await tried(lab, name, work)
        print(json.dumps(asdict(result)), file=sys.stderr, flush=True)
        results.append(result)

    async def cable(seconds: float, hosts: tuple[str, ...], span: Span, **values: Any) -> None:
        span.begin()
        for host in hosts:
            await lab.cable(host, **values)
        await asyncio.sleep(seconds)
        for host in hosts:
            await lab.cable(host)
        span.end()

    arms = ("left", "right")
    await case("1 % loss on the arms' cables, 8 s", partial(cable, 8.0, arms, loss=0.01))
    await case(
        "1 % loss, 20 +- 10 ms on the arms' cables, 10 s",
        partial(cable, 10.0, arms, loss=0.01, delay_s=0.02, jitter_s=0.01),
    )
    await case("5 % loss, 8 s", partial(cable, 8.0, arms, loss=0.05))
    for host in HOSTS:
        await case(f"cable of {host} cut for 2 s", partial(cable, 2.0, (host,), cut=True))
    await case("cable of left cut for 12 s", partial(cable, 12.0, ("left",), cut=True))
    for host in HOSTS:
        for node in lab.plan().nodes_on(host):
            if node.name not in ("record_left", "record_right"):
                await case(f"{node.name} killed", partial(kill, lab, host, node.name))
    for host in HOSTS:
        await case(f"the launcher of {host} killed", partial(kill_launcher, lab, host))
    return results


async def kill(lab: Lab, host: str, node: str, span: Span) -> None:
    # Looking for it takes up to 0.1 s on a busy computer, and the arms' time runs from the kill.
    pid = pid_of(lab, host, node)
    before = restarts(lab, host, node)
    span.begin()
    os.kill(pid, signal.SIGKILL)
    await lab.until(lambda: restarts(lab, host, node) > before, f"{node} to be started again")


def pid_of(lab: Lab, host: str, node: str) -> int:
    """The process of a node: its command line names its configuration, in the run's directory."""
    directory = lab.run_directory(host)
    assert directory is not None
    wanted = str(directory / f"{node}.json").encode()
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if wanted in entry.read_bytes().split(b"\0"):
                return int(entry.parent.name)
        except OSError:
            continue
    raise AssertionError(f"{node} does not run on {host}")


def restarts(lab: Lab, host: str, node: str) -> int:
    status = lab.status(host)
    found = [one for one in status.nodes if one.name == node] if status else []
    return found[0].restarts if found and found[0].state == "ready" else -1


async def kill_launcher(lab: Lab, host: str, span: Span) -> None:
    """The launcher dies, its nodes with it; somebody (systemd) starts it again."""
    process = lab.launchers[host]
    span.begin()
    process.kill()
    await asyncio.to_thread(process.wait)
    await asyncio.sleep(4.0)
    span.end()
    lab.start(host)
    await lab.watch_usual(host)


def fastest(bag: Path, side: str) -> float:
    """The true joints' largest share of the maker's speeds; 0 where there is no record."""
    stamps, joints = [], []
    for _, message, header, _ in BagReader(bag, [f"twin/arms_{side}"]):
        assert isinstance(message, TwinArms)
        stamps.append(header.source_ns * 1e-9)
        joints.append(message.joints_left_rad if side == "left" else message.joints_right_rad)
    if len(stamps) < 3:
        return 0.0
    steps = np.diff(stamps)
    speeds = np.abs(np.diff(joints, axis=0)) / np.maximum(steps, 2e-3)[:, None]
    return float((speeds / JOINT_SPEEDS_RAD_PER_S).max())


def missing_s(folder: Path, during_ns: tuple[int, int]) -> tuple[float, str]:
    """The longest that one writer's messages are missing in the main computer's bags, and whose.

    By its numbers, from the last that is recorded to the next; what a writer did not say because
    it had been killed is not missing.
    """
    last: dict[tuple[str, str, str, int], Header] = {}
    worst = (0.0, "")
    bags = sorted(folder.glob("main*.mcap"), key=lambda bag: bag.stat().st_mtime_ns)
    for bag in bags:
        for topic, _, header, _ in BagReader(bag):
            key = (topic, header.writer, header.clock_id, header.epoch)
            before, last[key] = last.get(key), header
            if before is None or header.sequence <= before.sequence + 1:
                continue
            if during_ns[0] - MARGIN_NS <= before.publish_ns < during_ns[1]:
                gap_s = (header.publish_ns - before.publish_ns) * 1e-9
                worst = max(worst, (gap_s, f"{topic} of {header.writer}"))
    return worst


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", default="", metavar="WORD", help="troubles with this in the name")
    given = parser.parse_args()
    if why := missing():
        print(f"skipped: {why}", file=sys.stderr)
        return 0
    load = os.getloadavg()
    async with Lab(without=LIGHT) as lab:
        results = await matrix(lab, given.only)
        for process in lab.launchers.values():
            process.send_signal(signal.SIGINT)
        for process in lab.launchers.values():
            await asyncio.to_thread(process.wait, 40)
        speed = max(
            fastest(bag, side) for side in SIDES for bag in lab.folder.glob(f"{side}*.mcap")
        )
        lost = [missing_s(lab.folder, one.during_ns) for one in results]
    bad = [one for one in results if one.back_s is None or one.faults or one.longest_m > LONGEST_M]
    violations = [one.trouble for one in bad] + (["joint speed"] if speed > 1.0 else [])
    report = {
        "load": [load, os.getloadavg()],
        "cases": [
            {**asdict(one), "missing_s": gap_s, "missing": whose}
            for one, (gap_s, whose) in zip(results, lost, strict=True)
        ],
        "largest_joint_speed_ratio": speed,
        "violations": violations,
    }
    if given.json:
        print(json.dumps(report, indent=1))
    else:
        print("| trouble | neither follows after | both again | missing in the bag | faults |")
        print("|---|---|---|---|---|")
        for one, (gap_s, whose) in zip(results, lost, strict=True):
            stopped = "went on" if one.stopped_s is None else f"{one.stopped_s:.2f} s"
            back = (
                "never" if one.back_s is None else f"{one.back_s:.1f} s" if one.stopped_s else "-"
            )
            gap = f"{gap_s:.2f} s of {whose}" if whose else "-"
            print(
                f"| {one.trouble} | {stopped} | {back} | {gap} | {'; '.join(one.faults) or '-'} |"
            )
        print(f"\nload before and after: {load[0]:.1f}, {os.getloadavg()[0]:.1f} (one minute)")
        print(f"largest true joint speed over the maker's: {speed:.2f}")
        print(f"violations: {', '.join(violations) or 'none'}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
