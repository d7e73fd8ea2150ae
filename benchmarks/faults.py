"""Test the arms under faults of three computers: `python -m benchmarks.faults`.

The computers are network namespaces at a switch with simulated losses, each with its launcher and
keys (`tests/lab.py`); this requires root. Each fault is injected while the arms follow a finger
that strokes back and forth. The evaluation uses the published states of both bridges, the arms'
true joints, and the bags: targets and missing messages.

With --random, faults are drawn at random: `benchmarks.random_faults`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import psutil

from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.running.runs import RUN_VARIABLE
from flexsheet.messages.types import ArmState
from tests.lab import HOSTS, LIGHT, Lab, missing
from tests.lab_bags import Arm, Floats, Gap, Times, gaps, measure_hold, read_arm, wanted


class Span:
    """The start and the end of a fault, in seconds of the monotonic clock.

    killed_side: arm whose bridge is killed, if any.
    """

    def __init__(self) -> None:
        self.killed_side: str | None = None
        self.begun_s = self.over_s = time.monotonic()

    def begin(self) -> None:
        """Set the start and the preliminary end of the fault to the present time."""
        self.begun_s = self.over_s = time.monotonic()

    def end(self) -> None:
        self.over_s = time.monotonic()


Work = Callable[[Span], Awaitable[Any]]

SIDES = ("left", "right")
RECORDERS = ("record_left", "record_right")
"""The nodes that are never killed, because the evaluation reads their bags."""

MAX_LENGTH_M = 0.24 * 1.15
BACK_WITHIN_S = 60.0
SILENT_S = 0.1
"""The maximum age of the state of a bridge that follows, in seconds."""

KILLED_SILENT_S = 0.02
"""The maximum age of the last state of a killed bridge, in seconds.

The arm of the other bridge then stops.
"""


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one fault.

    stopped_s: time until neither arm followed; None if the arms never stopped.
    back_s: longest time after the fault in which an arm did not follow; None if the arms did not
        follow again.
    during_ns: time from the start of the fault to the recovery.
    reasons: the three most frequent reasons why an arm did not follow.
    """

    problem: str
    stopped_s: float | None
    back_s: float | None
    during_ns: tuple[int, int]
    faults: tuple[str, ...]
    reasons: dict[str, int]
    longest_m: float


async def run_fault(lab: Lab, name: str, work: Work) -> Result:
    """Inject a fault, end it, and wait until both arms follow again.

    work: function that injects the fault, and returns after the fault has ended and killed
        processes run again.
    """
    await lab.until(
        lambda: lab.modes() == {"follow"} and lab.strokes(),
        f"both to follow a stroke, before {name}",
    )
    begin, span = len(lab.seen), Span()
    reported: list[tuple[float, set[str]]] = []

    async def watch() -> None:
        newest: dict[str, tuple[float, object]] = {}
        while True:
            modes: set[str] = set()
            for side in SIDES:
                state = lab.newest.get(f"arm_{side}")
                if newest.get(side, (0.0, None))[1] is not state:
                    newest[side] = (time.monotonic(), state)
                max_age_s = KILLED_SILENT_S if side == span.killed_side else SILENT_S
                is_silent = time.monotonic() - newest[side][0] > max_age_s
                modes.add(state.mode if isinstance(state, ArmState) and not is_silent else "silent")
            if not reported or reported[-1][1] != modes:
                reported.append((time.monotonic(), modes))
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
        (at for at, modes in reported if at > span.begun_s and "follow" not in modes), None
    )
    back_s = None if failed else longest_away_s(reported, span)
    states = [state for _, state in lab.seen[begin:] if isinstance(state, ArmState)]
    faults = {fault for state in states for fault in state.faults if state.mode == "fault"}
    reasons = Counter(state.reason for state in states if state.mode != "follow")
    longest_m = max((state.edge_distance_m or 0.0 for state in states), default=0.0)
    return Result(
        name,
        None if stopped_s is None else stopped_s - span.begun_s,
        back_s,
        (round(span.begun_s * 1e9), time.monotonic_ns()),
        tuple(sorted(faults)),
        dict(reasons.most_common(3)),
        longest_m,
    )


def longest_away_s(reported: list[tuple[float, set[str]]], span: Span) -> float:
    """Return the longest time after the fault in which at least one arm did not follow.

    On a busy computer, arms also hold for short times without a fault.
    """
    longest_s = 0.0
    since_s: float | None = None
    for at_s, modes in [*reported, (time.monotonic(), {"follow"})]:
        if modes != {"follow"}:
            since_s = at_s if since_s is None else since_s
        elif since_s is not None:
            longest_s = max(longest_s, at_s - max(since_s, span.over_s))
            since_s = None
    return longest_s


async def matrix(lab: Lab, only: str) -> list[Result]:
    """Run all faults, or those whose name contains `only`."""
    await lab.start_all()
    lab.stroke()
    results = []

    async def case(name: str, work: Work) -> None:
        if only not in name:
            return
        result = await run_fault(lab, name, work)
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
    await case("none, 10 s", partial(cable, 10.0, ()))
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
        for process in lab.plan().processes_on(host, without=RECORDERS):
            names = [node.name for node in process.nodes]
            await case(f"{' and '.join(names)} killed", partial(kill, lab, host, names[0]))
    for host in HOSTS:
        await case(f"the launcher of {host} killed", partial(kill_launcher, lab, host))
    return results


async def kill(lab: Lab, host: str, node: str, span: Span) -> None:
    # Finding the process takes up to 0.1 s on a busy computer; the time counts from the kill.
    pid = lab.pid_of(host, node)
    before = lab.restarts(host, node)
    span.killed_side = host if "bridge" in node else None
    span.begin()
    os.kill(pid, signal.SIGKILL)
    await lab.until(lambda: lab.restarts(host, node) > before, f"{node} to be started again")
    span.killed_side = None


async def kill_launcher(lab: Lab, host: str, span: Span) -> None:
    """Kill the launcher, and restart it when its nodes have ended, as systemd does.

    The time counts from the restart. systemd's pause before it (RestartSec, 2 s) is left out.
    """
    process, directory = lab.launchers[host], lab.run_directory(host)
    assert directory is not None
    span.killed_side = host if host in SIDES else None
    span.begin()
    process.kill()
    await asyncio.to_thread(process.wait)
    await lab.until(lambda: not is_run_alive(directory.name), f"the nodes of {host} to end")
    span.end()
    span.killed_side = None
    lab.start(host)
    await lab.watch_usual(host)


def is_run_alive(run_id: str) -> bool:
    """Return whether a process of the run exists."""
    for process in psutil.process_iter():
        # Processes may end in the meantime.
        with suppress(psutil.Error):
            if process.environ().get(RUN_VARIABLE) == run_id:
                return True
    return False


def worst_gaps(lost: list[Gap], results: list[Result]) -> list[Gap | None]:
    """Return the longest gap in the messages of one writer for each fault, or None without a gap.

    A gap belongs to the fault that it overlaps most.
    """
    worst: list[Gap | None] = [None] * len(results)
    for gap in lost:
        shared = [
            min(gap.to_ns, one.during_ns[1]) - max(gap.from_ns, one.during_ns[0]) for one in results
        ]
        most = max(range(len(results)), key=shared.__getitem__)
        known = worst[most]
        if shared[most] > 0 and (known is None or gap > known):
            worst[most] = gap
    return worst


KILLED_KINDS = {
    "launcher": ("launcher",),
    "bridge": ("bridge",),
    "arm": ("twin_left", "twin_right"),
    "clock": ("clock",),
    "node": ("",),
}
"""The words in the names of faults, by kind of killed process.

The first kind with a matching word is used.
"""


def summarize(results: list[Result]) -> dict[str, float]:
    """Return the times from a kill to the stop of the arms, s, by kind of killed process.

    Entries named follow_again are the times until both arms follow again.
    """
    killed = [one for one in results if one.stopped_s is not None and "killed" in one.problem]
    found: dict[str, float] = {}
    for kind, words in KILLED_KINDS.items():
        chosen = [one for one in killed if any(word in one.problem for word in words)]
        killed = [one for one in killed if one not in chosen]
        stopped = [one.stopped_s for one in chosen if one.stopped_s is not None]
        back = [one.back_s for one in chosen if one.back_s is not None]
        for name, values in ((f"stop_{kind}", stopped), (f"{kind}_follow_again", back)):
            if values:
                found |= {f"{name}_min_s": min(values), f"{name}_max_s": max(values)}
    return found


def rows(
    results: list[Result],
    arms: tuple[Arm, Arm],
    targets: tuple[Times, Floats],
    lost: list[Gap],
) -> list[dict[str, Any]]:
    """Return one row per fault with the results of the run and of the bags (lengths in mm)."""
    found = []
    for one, gap in zip(results, worst_gaps(lost, results), strict=True):
        sheet = measure_hold(arms, targets, one.during_ns)
        found.append(
            {
                **asdict(one),
                "missing_s": 0.0 if gap is None else gap.seconds,
                "missing": "" if gap is None else f"{gap.topic} of {gap.writer}",
                "error_p50_mm": sheet.quantile_mm(0.5),
                "error_p95_mm": sheet.quantile_mm(0.95),
                "followed": sheet.followed,
            }
        )
    return found


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--only",
        default="",
        metavar="WORD",
        help="part of the names of the faults or, with --random, of the kinds of faults",
    )
    parser.add_argument("--light", action="store_true", help="without soft body and renderer")
    parser.add_argument("--hold-after", type=float, metavar="S", help="of both bridges, s")
    parser.add_argument("--stop-after", type=float, metavar="S", help="of both bridges, s")
    parser.add_argument("--random", action="store_true", help="random faults, implies --light")
    parser.add_argument("--minutes", type=float, default=60.0, help="duration of --random, min")
    parser.add_argument("--every", type=float, default=10.0, metavar="S", help="period of --random")
    parser.add_argument("--seed", type=int, default=1, help="seed of --random")
    given = parser.parse_args()
    if why := missing():
        print(f"skipped: {why}", file=sys.stderr)
        return 0
    if given.random:
        from benchmarks.random_faults import run_random

        return await run_random(given)
    load = os.getloadavg()
    patience = {"hold_after_s": given.hold_after, "stop_after_s": given.stop_after}
    patience = {name: value for name, value in patience.items() if value is not None}
    async with Lab(without=LIGHT if given.light else (), **patience) as lab:
        results = await matrix(lab, given.only)
        for process in lab.launchers.values():
            process.send_signal(signal.SIGINT)
        for process in lab.launchers.values():
            await asyncio.to_thread(process.wait, 40)
        scene = lab.plan().scene_message()
        assert scene is not None
        pair = read_arm(lab.folder, "left", scene), read_arm(lab.folder, "right", scene)
        cases = rows(results, pair, wanted(lab.folder), gaps(lab.folder))
    bad = [
        one for one in results if one.back_s is None or one.faults or one.longest_m > MAX_LENGTH_M
    ]
    violations = [one.problem for one in bad]
    speed = max(arm.fastest() for arm in pair)
    violations += ["joint speed"] if speed > 1.0 else []
    violations += ["joint range"] if any(arm.leaves_range() for arm in pair) else []
    report = {
        "load": [load, os.getloadavg()],
        "light": given.light,
        "patience": patience,
        "cases": cases,
        "summary": summarize(results),
        "largest_joint_speed_ratio": speed,
        "violations": violations,
    }
    if given.json:
        print(json.dumps(report, indent=1))
    else:
        print_rows(cases, as_json=False)
        print(f"violations: {', '.join(violations) or 'none'}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
