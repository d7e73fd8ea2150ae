"""Test a launcher's e-stop: accepted senders, and its persistence across restarts."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Self

import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import RUN_DIRECTORY, ResolvedGraph
from flexsheet.launch.running.estop_file import STATE_VARIABLE, EStopFile
from flexsheet.launch.running.host import (
    REASON_LENGTH,
    HostAgent,
    has_estop,
    has_manual_arming,
    list_arms,
)
from flexsheet.launch.running.runs import Run
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher, Source, Subscriber
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.clock_table import MAX_STAMP_AHEAD_NS
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import EStop
from flexsheet.nodes.arm_bridge.control import ArmControl, Timeouts
from flexsheet.nodes.node import PortCounts
from tests.arm_states import arm_state
from tests.waiting import DEADLINE_S, NOTHING_COMES_S, until

STOP = EStop(engaged=True, reason="hand in the sheet")
RESET = EStop(engaged=False, reason="")
BRIDGE = {"type": "arm_bridge", "parameters": {"side": "left"},
          "topics": {"arm": "arm_left", "other_arm": "arm_right"}}  # fmt: skip
# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
HOSTS = {"main": {"address": f"{NET}.1"}, "left": {"address": f"{NET}.2"}}


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(STATE_VARIABLE, str(made / "state"))
    yield made
    shutil.rmtree(made)


def plan_of(folder: Path, *, arming: str = "manual") -> ResolvedGraph:
    """Load a graph with an arm that waits for arming; only its launchers are started."""
    path = folder / "graph.yaml"
    bridge = BRIDGE | {"parameters": {"side": "left", "arming": arming}}
    topics = ["arm_right", "scene", "sheet_target"]
    values = {"nodes": {"bridge": bridge}, "hosts": HOSTS, "external_topics": topics}
    path.write_text(json.dumps(values))
    return load_graph(path)


@dataclass
class Launchers:
    """Host agents of all hosts, and a tool that sends e-stops."""

    folder: Path
    plan: ResolvedGraph
    printed: list[str] = field(default_factory=list)
    agents: dict[str, HostAgent] = field(default_factory=dict)

    async def __aenter__(self) -> Self:
        self._clock = SystemClock()
        self._epoch, self._sequence = self._clock.now_ns(), 0
        for host in self.plan.hosts:
            self.agents[host] = HostAgent(
                self.plan, host, run=Run("1", self.folder), code="", processes=tuple,
                keys=None, on_problem=self.printed.append,
            )  # fmt: skip
            await self.agents[host].start()
        writer = self.plan.writer("estop", "tools")
        assert writer is not None
        self._tool = Publisher(find_topic("estop"), [self._near(one) for one in writer.endpoints])
        return self

    async def arms(self, modes: dict[str, str]) -> None:
        """Publish the arms' states as bridges do, until cancelled."""
        publishers = {}
        for side in modes:
            writer = self.plan.writers[f"arm_{side}"][0]
            ends = [self._near(one) for one in writer.endpoints]
            publishers[side] = writer.name, Publisher(find_topic(f"arm_{side}"), ends)
        try:
            for number in count(1):
                for side, (name, publisher) in publishers.items():
                    now_ns = self._clock.now_ns()
                    header = Header(number, now_ns, now_ns, self._clock.id, name, self._epoch,
                                    self.plan.hash)  # fmt: skip
                    publisher.send(arm_state(side, mode=modes[side]), header)
                await asyncio.sleep(0.01)
        finally:
            for _, publisher in publishers.values():
                publisher.close()

    async def __aexit__(self, *_: object) -> None:
        for agent in self.agents.values():
            await agent.close()
        self._tool.close()

    def _near(self, endpoint: str) -> str:
        return endpoint.replace(RUN_DIRECTORY, str(self.folder))

    def say(self, estop: EStop, *, before_ns: int = 0) -> None:
        """Publish as a tool on main does.

        before_ns: age of the stamp; negative: in the future.
        """
        self._sequence += 1
        now_ns = self._clock.now_ns() - before_ns
        self._tool.send(
            estop,
            Header(self._sequence, now_ns, now_ns, self._clock.id, "tools", self._epoch,
                   self.plan.hash),
        )  # fmt: skip

    async def heard_late(self, expected: str | None) -> set[str]:
        """Return the reasons of the e-stops that a new bridge receives.

        Wait for a reason with the expected text; without one, wait NOTHING_COMES_S.
        """
        found: set[str] = set()
        others = [one for one in self.plan.sources_to_read("estop") if one.writer != "tools"]
        subscriber = Subscriber(
            find_topic("estop"),
            [Source(self._near(one.endpoint), one.writer, one.host) for one in others],
            lambda estop, _: found.add(estop.reason),
            PortCounts(),
        )
        subscriber.start()
        if expected is None:
            await asyncio.sleep(NOTHING_COMES_S)
        else:
            await until(lambda: any(expected in reason for reason in found), found)
        subscriber.close()
        return found


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "state").glob("*"))


async def test_a_stop_outlives_all_launchers_until_it_is_reset(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of(folder)
    async with Launchers(folder, plan) as first:
        # The topic is latched: who connects later gets it, too.
        first.say(STOP)
        await until(lambda: len(files(folder)) == 2, first.printed)
    async with Launchers(folder, plan) as second:
        assert await second.heard_late(STOP.reason) == {STOP.reason}
        # What a console said last before all this is no answer to it.
        second.say(RESET, before_ns=10**10)
        await asyncio.sleep(NOTHING_COMES_S)
        assert len(files(folder)) == 2
        modes = {"left": "estop", "right": "idle"}
        arms = asyncio.create_task(second.arms(modes))
        second.say(RESET)
        # The left bridge refuses while its arm moves: a stop that it holds is not forgotten.
        await until(
            lambda: sum("arm_left did not confirm it" in line for line in second.printed) == 2
        )
        assert len(files(folder)) == 2
        modes["left"] = "idle"
        monkeypatch.setattr("flexsheet.launch.running.host.RESET_WITHIN_S", DEADLINE_S)
        second.say(RESET)
        await until(lambda: files(folder) == [], second.printed)
        assert await second.heard_late(None) == set()
        arms.cancel()
    async with Launchers(folder, plan) as third:
        assert await third.heard_late(None) == set()


async def test_a_reset_from_the_future_is_rejected(folder: Path) -> None:
    async with Launchers(folder, plan_of(folder)) as launchers:
        launchers.say(STOP)
        await until(lambda: len(files(folder)) == 2, launchers.printed)
        launchers.say(RESET, before_ns=-(10**10))
        refused = "e-stop not reset by tools: its timestamp is in the future"
        await until(lambda: launchers.printed.count(refused) == 2, launchers.printed)
        assert len(files(folder)) == 2


def test_a_bridge_refuses_a_reset_from_the_future() -> None:
    """Sent again to a late reader, it would clear all stops until then."""
    control = ArmControl(Timeouts(0.02, 0.1), max_tracking_error_rad=0.12)
    assert control.on_estop(STOP, 200, 200) is None
    now_ns = 10**9
    far_ns = now_ns + MAX_STAMP_AHEAD_NS + 1
    assert control.on_estop(RESET, far_ns, now_ns) == "it is stamped in the future"
    assert control.estop_reason == STOP.reason
    assert control.on_estop(RESET, far_ns, now_ns + 1) is None
    assert control.estop_reason is None


async def test_what_cannot_be_read_counts_as_a_stop(folder: Path) -> None:
    plan = plan_of(folder)
    file = EStopFile("left", list_arms(plan))
    file.path.parent.mkdir()
    file.path.write_text("[" * 100_000)
    async with Launchers(folder, plan) as launchers:
        await launchers.heard_late("cannot be read")
        assert any("arms reset" in line for line in launchers.printed)


async def test_failed_writes_are_reported_and_retried(folder: Path) -> None:
    plan = plan_of(folder)
    (folder / "state").write_text("no folder")
    async with Launchers(folder, plan) as launchers:
        launchers.say(STOP)
        await until(lambda: any("cannot be written" in line for line in launchers.printed))
        await launchers.heard_late(STOP.reason)
        (folder / "state").unlink()
        await until(lambda: len(files(folder)) == 2)


async def test_a_reason_without_end_is_cut(folder: Path) -> None:
    async with Launchers(folder, plan_of(folder)) as launchers:
        launchers.say(EStop(engaged=True, reason="a" * 1_000_000))
        await until(lambda: len(files(folder)) == 2, launchers.printed)
        assert await launchers.heard_late("a") == {"a" * REASON_LENGTH}


def test_graphs_of_other_arms_keep_stops_of_their_own(folder: Path) -> None:
    """Graphs of the same arms share stops, even with different launch files."""
    lab, twin = EStopFile("main", ["192.0.2.1:502", "192.0.2.2:502"]), EStopFile("main", ["::1:7"])
    lab.write(STOP)
    twin.remove()
    assert twin.read() is None
    assert EStopFile("main", ["192.0.2.2:502", "192.0.2.1:502"]).read() == STOP


def test_simulated_arms_that_go_by_themselves_forget(folder: Path) -> None:
    assert has_manual_arming(plan_of(folder))
    assert not has_manual_arming(plan_of(folder, arming="auto"))


def test_a_file_of_a_stop_is_whole_or_not_there(folder: Path) -> None:
    file = EStopFile("main", ["127.0.0.1:5020"])
    assert file.read() is None
    file.remove()
    file.write(STOP)
    assert file.read() == STOP
    file.write(EStop(engaged=True, reason="another"))
    assert file.read() == EStop(engaged=True, reason="another")
    file.remove()
    assert file.read() is None
    assert files(folder) == []


def test_an_arm_shows_an_estop_by_its_typed_field_only() -> None:
    assert has_estop(arm_state("left", mode="stopping", estop_engaged=True, faults=("Halt",)))
    assert has_estop(arm_state("left", mode="estop"))
    assert not has_estop(arm_state("left", mode="fault", faults=("e-stop: button",)))
