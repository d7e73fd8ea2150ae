"""What the arms do when anything of three computers fails: `python -m benchmarks.faults`.

Network namespaces at a bad switch, each with its own launcher and keys (`tests/lab.py`; needs
root).  Each trouble is brought about while the arms follow; judged by what both bridges said and by
the arms' true joints, from their own computers' bags.
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
from messages.types import ArmState, TwinArms
from tests.lab import HOSTS, LIGHT, Lab, missing

Work = Callable[[Callable[[], None]], Awaitable[Any]]

SIDES = ("left", "right")
JOINT_SPEEDS_RAD_PER_S = np.radians([150.0, 150.0, 180.0, 180.0, 180.0, 240.0])
"""The maker's; a joint of the twin that is faster has been told what no arm may be."""

LONGEST_M = 0.24 * 1.15
BACK_WITHIN_S = 60.0


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one trouble.

    stopped_s: until neither arm followed, None: they never stopped; back_s: until both followed.
    """

    trouble: str
    stopped_s: float | None
    back_s: float | None
    faults: tuple[str, ...]
    longest_m: float


async def tried(lab: Lab, name: str, work: Work) -> Result:
    """Bring a trouble about, let it end, and see both arms follow again.

    work: says when the trouble itself begins; what it looks up before does not count.
    """
    await lab.until(lambda: lab.modes() == {"follow"}, f"both to follow, before {name}")
    begin, began_s = len(lab.seen), time.monotonic()
    stopped: list[float] = []

    def begins() -> None:
        nonlocal began_s
        began_s = time.monotonic()

    async def see_stop() -> None:
        await lab.until(lambda: "follow" not in lab.modes(), "a stop", within_s=1e6)
        stopped.append(time.monotonic() - began_s)

    seeing = asyncio.create_task(see_stop())
    try:
        await work(begins)
        ended_s = time.monotonic()
        back_s: float | None
        try:
            await lab.until(lambda: lab.modes() == {"follow"}, name, within_s=BACK_WITHIN_S)
            back_s = time.monotonic() - ended_s
        except AssertionError as error:
            print(f"{name}: {str(error)[:600]}", file=sys.stderr)
            back_s = None
    finally:
        seeing.cancel()
    states = [state for _, state in lab.seen[begin:] if isinstance(state, ArmState)]
    faults = {fault for state in states for fault in state.faults if state.mode == "fault"}
    longest_m = max((state.edge_distance_m or 0.0 for state in states), default=0.0)
    return Result(name, stopped[0] if stopped else None, back_s, tuple(sorted(faults)), longest_m)


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

    async def cable(
        seconds: float, hosts: tuple[str, ...], begins: Callable[[], None], **values: Any
    ) -> None:
        begins()
        for host in hosts:
            await lab.cable(host, **values)
        await asyncio.sleep(seconds)
        for host in hosts:
            await lab.cable(host)

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
            if node.type != "recorder":
                await case(f"{node.name} killed", partial(kill, lab, host, node.name))
    for host in HOSTS:
        await case(f"the launcher of {host} killed", partial(kill_launcher, lab, host))
    return results


async def kill(lab: Lab, host: str, node: str, begins: Callable[[], None]) -> None:
    # Looking for it takes up to 0.1 s on a busy computer, and the arms' time runs from the kill.
    pid = pid_of(lab, host, node)
    before = restarts(lab, host, node)
    begins()
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


async def kill_launcher(lab: Lab, host: str, begins: Callable[[], None]) -> None:
    """The launcher dies, its nodes with it; somebody (systemd) starts it again."""
    process = lab.launchers[host]
    begins()
    process.kill()
    await asyncio.to_thread(process.wait)
    await asyncio.sleep(4.0)
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


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", default="", metavar="WORD", help="troubles with this in the name")
    given = parser.parse_args()
    if why := missing():
        print(f"skipped: {why}", file=sys.stderr)
        return 0
    async with Lab(without=LIGHT) as lab:
        results = await matrix(lab, given.only)
        for process in lab.launchers.values():
            process.send_signal(signal.SIGINT)
        for process in lab.launchers.values():
            await asyncio.to_thread(process.wait, 40)
        speed = max(
            fastest(bag, side) for side in SIDES for bag in lab.folder.glob(f"{side}*.mcap")
        )
    bad = [one for one in results if one.back_s is None or one.faults or one.longest_m > LONGEST_M]
    violations = [one.trouble for one in bad] + (["joint speed"] if speed > 1.0 else [])
    report = {
        "cases": [asdict(one) for one in results],
        "largest_joint_speed_ratio": speed,
        "violations": violations,
    }
    if given.json:
        print(json.dumps(report, indent=1))
    else:
        print("| trouble | neither follows after | both follow again after | faults |")
        print("|---|---|---|---|")
        for one in results:
            stopped = "went on" if one.stopped_s is None else f"{one.stopped_s:.2f} s"
            back = "never" if one.back_s is None else f"{one.back_s:.1f} s"
            print(f"| {one.trouble} | {stopped} | {back} | {'; '.join(one.faults) or '-'} |")
        print(f"\nlargest true joint speed over the maker's: {speed:.2f}")
        print(f"violations: {', '.join(violations) or 'none'}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
