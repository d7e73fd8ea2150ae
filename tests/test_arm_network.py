"""Test network cuts between the computers during a stroke, on real interfaces."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.base import Header
from flexsheet.messages.bus import Source, Subscriber
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import ArmState, Clocks, Status
from flexsheet.nodes.node import PortCounts
from flexsheet.nodes.runner import NodeConfig, PortConfig
from tests.hosts import hosts
from tests.network import Computers
from tests.waiting import until

pytestmark = pytest.mark.alone

PATIENT = {"arming": "auto", "timeout_s": 0.25, "hold_after_s": 0.1, "stop_after_s": 0.6}
PATIENT_TWIN = {"watchdog_s": 0.8}
SIDES = ("left", "right")
MAX_LENGTH_M = 0.24 * 1.09


@dataclass
class Watch:
    """States that both bridges publish."""

    states: dict[str, list[ArmState]] = field(default_factory=lambda: {side: [] for side in SIDES})
    clocks: dict[str, tuple[Clocks, str]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    def take_status(self, status: Status, _: Header) -> None:
        self.notes[status.node] = status.note_text

    def take_clocks(self, host: str, clocks: Clocks, header: Header) -> None:
        self.clocks[host] = clocks, header.clock_id

    def worst_clock_error_s(self) -> float:
        """Return the largest uncertainty of the hosts' clocks; infinite for an unknown host."""
        ahead_s = {clock_id: AHEAD_S[host] for host, (_, clock_id) in self.clocks.items()}
        errors = [
            abs(one.offset_ns * 1e-9 - (ahead_s[one.clock_id] - AHEAD_S[host]))
            for host, (clocks, _) in self.clocks.items()
            for one in clocks.offsets
        ]
        return max(errors) if len(errors) == len(AHEAD_S) * (len(AHEAD_S) - 1) else float("inf")

    def take(self, side: str, state: ArmState, _: Header) -> None:
        self.states[side].append(state)

    def modes(self) -> set[str]:
        return {self.states[side][-1].mode if self.states[side] else "none" for side in SIDES}

    async def lasts(self, count: int) -> dict[str, list[ArmState]]:
        """Return the next `states` states of each arm."""
        began = {side: len(self.states[side]) for side in SIDES}
        await until(lambda: all(len(self.states[side]) >= began[side] + count for side in SIDES))
        return {side: self.states[side][began[side] :] for side in SIDES}


def config(
    name: str,
    type_: str,
    inputs: Any,
    outputs: Any,
    *,
    keys: Path,
    clocks: PortConfig | None = None,
    **parameters: Any,
) -> str:
    def ports(given: dict[str, tuple[str, tuple[str | Source, ...]]]) -> tuple[PortConfig, ...]:
        return tuple(
            PortConfig(port=port, topic=topic, endpoints=endpoints)
            for port, (topic, endpoints) in given.items()
        )

    return NodeConfig(
        name=name,
        type=type_,
        parameters=parameters,
        inputs=ports(inputs),
        outputs=ports(outputs),
        plan_hash="test",
        run_dir="",
        keys_file=keys,
        clocks=clocks,
    ).model_dump_json()


AHEAD_S = {"main": 0, "left": 7 * 3600, "right": 123}
"""Uptime of the computers before main started; their clocks are unrelated."""


def clock_config(host: str, folder: Path, tcp: dict[str, str], keys: Path, limit_s: float) -> str:
    """Return the clock node of a host."""
    pings = tuple(
        Source(f"{address}:7003", f"clock_{other}", other)
        for other, address in tcp.items()
        if other != host
    )
    return config(
        f"clock_{host}",
        "clock",
        {"clock_ping": ("clock_ping", pings)},
        {
            "clock_ping_out": ("clock_ping", (f"{tcp[host]}:7003",)),
            "clocks": ("clocks", (f"ipc://{folder}/clocks-{host}",)),
        },
        keys=keys,
        max_offset_uncertainty_s=limit_s,
    )


@asynccontextmanager
async def three_computers(*, clock_limit_s: float = 0.05) -> AsyncIterator[tuple[Computers, Watch]]:
    """Run the stroke on main, and an arm with its bridge on left and right."""
    if missing := Computers.missing():
        pytest.skip(missing)
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    watch, started, subscribers = Watch(), [], []
    with Computers("main", *SIDES) as computers, hosts("main", *SIDES) as known:
        keys = {name: known.write_ring(name) for name in known.names}
        tcp = {name: f"tcp://{address}" for name, address in computers.address.items()}
        scene, target = f"{tcp['main']}:7000", f"{tcp['main']}:7001"
        from_main = {
            "scene": ("scene", (Source(scene, "stroker", "main"),)),
            "sheet_target": ("sheet_target", (Source(target, "stroker", "main"),)),
        }
        reported = {side: f"{tcp[side]}:7002" for side in SIDES}
        outputs = {"scene": ("scene", (scene,)), "sheet_target": ("sheet_target", (target,))}
        jobs = {
            "main": [
                config("stroker", "tests.arm_computer:Stroker", {}, outputs, keys=keys["main"])
            ]
        }
        for side, other in (SIDES, SIDES[::-1]):
            ports = {f"{one}_port": 5020 + number for number, one in enumerate(SIDES)}
            seen = {"scene": from_main["scene"]}
            from_other = Source(reported[other], f"arm_{other}_bridge", other)
            jobs[side] = [
                config(
                    f"twin_{side}", "twin_arms", seen, {}, keys=keys[side], **ports, **PATIENT_TWIN
                ),
                config(
                    f"arm_{side}_bridge",
                    "arm_bridge",
                    from_main | {"other_arm": (f"arm_{other}", (from_other,))},
                    {
                        "arm": (f"arm_{side}", (f"ipc://{folder}/{side}", reported[side])),
                        "status": ("status", (f"ipc://{folder}/status-{side}",)),
                    },
                    keys=keys[side],
                    clocks=PortConfig(
                        port="clocks", topic="clocks", endpoints=(f"ipc://{folder}/clocks-{side}",)
                    ),
                    side=side,
                    port=ports[f"{side}_port"],
                    **PATIENT,
                ),
            ]
        try:
            for name, configs in jobs.items():
                configs.append(clock_config(name, folder, tcp, keys[name], clock_limit_s))
                started.append(
                    computers.start(
                        name, "-m", "tests.arm_computer", *configs, ahead_s=AHEAD_S[name]
                    )
                )
            inbox: list[tuple[str, str, Any]] = [
                *((f"arm_{side}", side, partial(watch.take, side)) for side in SIDES),
                *(("status", f"status-{side}", watch.take_status) for side in SIDES),
                *(("clocks", f"clocks-{one}", partial(watch.take_clocks, one)) for one in AHEAD_S),
            ]
            for topic, file, take in inbox:
                subscribers.append(
                    Subscriber(find_topic(topic), [f"ipc://{folder}/{file}"], take, PortCounts())
                )
                subscribers[-1].start()
            await until(lambda: "none" not in watch.modes() and len(watch.clocks) == len(AHEAD_S))
            yield computers, watch
        finally:
            for subscriber in subscribers:
                subscriber.close()
            for process in started:
                computers.end(process)
            codes = [await asyncio.to_thread(process.wait) for process in started]
            shutil.rmtree(folder)
    assert codes == [0] * len(started)


async def test_a_cable_drawn_in_mid_stroke_holds_then_stops_both_arms_until_it_is_back() -> None:
    async with three_computers() as (computers, watch):
        await until(lambda: watch.modes() == {"follow"})
        assert watch.worst_clock_error_s() < 0.05
        for cut in ("main", "left"):
            before = await watch.lasts(60)
            assert {state.mode for states in before.values() for state in states} >= {"follow"}
            leaning = np.ptp([state.joints_rad for state in before["left"]], axis=0)
            assert leaning.max() > 0.01, "it is in mid-stroke"
            began = {side: len(watch.states[side]) for side in SIDES}
            computers.plug(cut, into_switch=False)
            await until(lambda: watch.modes() == {"idle"})
            for side in SIDES:
                modes = [state.mode for state in watch.states[side][began[side] :]]
                assert modes.index("hold") < modes.index("idle"), (cut, side)
            for states in (await watch.lasts(30)).values():
                assert {(state.mode, state.faults) for state in states} == {("idle", ())}
                assert np.ptp([state.joints_rad for state in states], axis=0).max() < 1e-4
            computers.plug(cut, into_switch=True)
            await until(lambda: watch.modes() == {"follow"})
        everything = [state for states in watch.states.values() for state in states]
        assert max(state.edge_distance_m or 0.0 for state in everything) <= MAX_LENGTH_M
        assert {state.faults for state in everything if state.mode != "disconnected"} == {()}


async def test_arms_do_not_move_while_the_clocks_are_not_known_well_enough() -> None:
    async with three_computers(clock_limit_s=1e-7) as (_, watch):
        await until(lambda: watch.worst_clock_error_s() < 0.05)
        await until(lambda: all("ms are allowed" in note for note in watch.notes.values()))
        states = await watch.lasts(100)
    for side in SIDES:
        assert {state.mode for state in states[side]} == {"idle"}
        assert np.ptp([state.joints_rad for state in states[side]], axis=0).max() < 1e-4
