"""Test a launcher's reports of its host, and its e-stop for late subscribers."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.plans.hosts import launcher_on
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import TOOLS, ResolvedGraph
from flexsheet.launch.running import runs
from flexsheet.launch.running.host import list_device_files
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import GraphWriter, make_subscriber
from flexsheet.messages.types import EStop, HostStatus
from tests.waiting import DEADLINE_S, NOTHING_COMES_S, until

BEACON = {"type": "tests.launch_nodes:Beacon"}
# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
HOSTS = {"main": {"address": f"{NET}.1"}, "left": {"address": f"{NET}.2"}}
STOP, RESET = EStop(engaged=True, reason="hand in the sheet"), EStop(engaged=False, reason="")


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(folder))
    yield folder
    shutil.rmtree(folder)


def plan_of(folder: Path, nodes: dict[str, Any]) -> ResolvedGraph:
    path = folder / "graph.yaml"
    path.write_text(json.dumps({"nodes": nodes, "hosts": HOSTS}))
    return load_graph(path)


async def heard_late(
    plan: ResolvedGraph, graph: RunningGraph, expected: dict[str, EStop]
) -> dict[str, EStop]:
    """Return the e-stops, by writer, that a new subscriber receives.

    Wait for the expected ones; without any, wait NOTHING_COMES_S.
    """
    inbox: dict[str, EStop] = {}
    subscriber = make_subscriber(
        "estop", plan, graph.run,
        lambda message, header: inbox.update({header.writer: message}),
        on_problem=pytest.fail,
    )  # fmt: skip
    subscriber.start()
    if expected:
        await until(lambda: inbox.keys() >= expected.keys(), "the e-stops that are kept")
    else:
        await asyncio.sleep(NOTHING_COMES_S)
    subscriber.close()
    return inbox


async def test_an_estop_outlives_its_sender_until_it_is_reset(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, {"beacon": BEACON})
    printed: list[str] = []
    async with RunningGraph(plan, report=lambda node, line: printed.append(line)) as graph:
        await graph.wait_ready(DEADLINE_S)

        async def say(estop: EStop, answer: str) -> None:
            # The topic is latched: a launcher that connects later gets it, too.
            writer = GraphWriter(plan, graph.run, ["estop"])
            writer.publish("estop", estop)
            await until(lambda: sum(answer in line for line in printed) == 2, answer)
            writer.close()

        await say(STOP, "latched until it is reset")
        kept = {launcher_on(host): STOP for host in HOSTS}
        assert await heard_late(plan, graph, kept) == kept
        await say(RESET, "reset by tools")
        assert await heard_late(plan, graph, {}) == {}


async def test_each_host_reports_its_state_and_its_nodes(tmp_path: Path) -> None:
    nodes = {
        "beacon": BEACON | {"restart": {"delay_s": 0.01}},
        "other": BEACON | {"host": "left", "topics": {"twin__finger": None}},
    }
    plan = plan_of(tmp_path, nodes)
    newest: dict[str, HostStatus] = {}
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        graph.kill("beacon")
        subscriber = make_subscriber(
            "host", plan, graph.run,
            lambda message, header: newest.update({message.host: message}),
            on_problem=pytest.fail,
        )  # fmt: skip
        subscriber.start()
        await until(
            lambda: (
                newest.keys() == HOSTS.keys()
                and ("beacon", 1, "ready")
                in {(one.name, one.restarts, one.state) for one in newest["main"].nodes}
            ),
            "both hosts, and the restart",
        )
        subscriber.close()
    assert {status.plan_hash for status in newest.values()} == {plan.hash}
    assert "other" in {node.name for node in newest["left"].nodes}
    assert newest["main"].disk_free_bytes > 0


def test_the_launchers_are_writers_of_their_own(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, {"beacon": BEACON})
    assert [(one.name, one.host) for one in plan.writers["host"]] == [
        ("launch", "main"), ("launch_left", "left"),
    ]  # fmt: skip
    assert {one.name for one in plan.writers["estop"]} == {
        "launch", "launch_left", TOOLS, "tools_left",
    }  # fmt: skip


def test_devices_are_found_wherever_parameters_name_them() -> None:
    lab = load_graph(Path(__file__).resolve().parent.parent / "launch" / "lab.yaml")
    assert list_device_files(lab.nodes_on("main")) == ["/dev/video0", "/dev/video2"]
    assert list_device_files(lab.nodes_on("left")) == []
