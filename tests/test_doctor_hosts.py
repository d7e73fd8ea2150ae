"""Findings of `flexsheet doctor` about hosts that report, and about those that do not."""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.commands.doctor import check_hosts, find_host
from flexsheet.launch.commands.graph import describe_launch
from flexsheet.launch.commands.output import CommandError
from flexsheet.launch.health import probe as probe_module
from flexsheet.launch.health.doctor import Finding
from flexsheet.launch.health.doctor_hosts import (
    FAULTS as SILENCES,
)
from flexsheet.launch.health.doctor_hosts import (
    check_before_start,
    evaluate_probes,
    find_key_problem,
    find_rate_problem,
)
from flexsheet.launch.health.probe import HostProbe, Reachability
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import MAIN, ResolvedGraph
from flexsheet.launch.running import runs
from flexsheet.launch.running.keys import KEYS_VARIABLE, secret_file
from flexsheet.launch.running.runs import HOST_FILE, Run
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages.bus import Publisher
from flexsheet.messages.notes import Note
from flexsheet.messages.security import make_key_pair, write_secret
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import (
    ArmState,
    ClockOffset,
    Clocks,
    HostKey,
    HostStatus,
    NodeProcess,
    PortStatus,
    Status,
)
from tests.hosts import Hosts, hosts
from tests.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parent.parent
BEACON = {"type": "tests.launch_nodes:Beacon"}
# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
ADDRESSES = {"main": {"address": f"{NET}.1"}, "left": {"address": f"{NET}.2"}}
NAMES = ("main", "left", "right")


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(made / "r"))
    monkeypatch.setenv(KEYS_VARIABLE, str(made / "k"))
    yield made
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def three() -> ResolvedGraph:
    plan = load_graph(ROOT / "launch" / "three.yaml")
    keys = {name: make_key_pair()[0] for name in NAMES}
    return plan.model_copy(update={"keys": keys})


def port(topic: str, rate_hz: float, *, rejected: int = 0) -> PortStatus:
    return PortStatus(
        topic=topic, rate_hz=rate_hz, age_s=0.0, messages=9, dropped=0, gaps=0, rejected=rejected
    )


def make_status(node: str, *outputs: PortStatus, note: str = "", inputs: Any = ()) -> Status:
    return Status(
        node=node, state="running", pid=1, uptime_s=9.0, cpu_ratio=0.1, resident_bytes=1,
        inputs=tuple(inputs), outputs=outputs, errors=0, last_error="",
        notes=(Note(detail=note),), plan_hash="",
    )  # fmt: skip


def good(plan: ResolvedGraph) -> dict[str, HostProbe]:
    """Return the reports of three hosts without faults."""
    found = {}
    for name in plan.hosts:
        nodes = plan.nodes_on(name)
        found[name] = HostProbe(
            name,
            Reachability.RESPONDING,
            status=HostStatus(
                host=name, run="1.2.3", plan_hash=plan.hash, code="abc", python="3.11.7",
                uptime_s=5.0, load_ratio=0.5, disk_free_bytes=9 << 30, memory_free_bytes=9 << 30,
                nodes=tuple(
                    NodeProcess(name=one.name, state="ready", restarts=0, hangs=0) for one in nodes
                ),
                missing_devices=(), software="flexsheet 1",
                keys=tuple(HostKey(host=host, key=key) for host, key in plan.keys.items()),
            ),
            clock_id=f"clock-{name}",
            clocks=Clocks(
                max_offset_uncertainty_s=0.005, max_drift_ratio=5e-4,
                offsets=tuple(
                    ClockOffset(clock_id=f"clock-{other}", at_ns=1, offset_ns=7, drift_ratio=0.0,
                                uncertainty_s=1e-4, resets=0)
                    for other in plan.hosts if other != name
                ),
            ),
        )  # fmt: skip
        for node in nodes:
            ports = [
                port(one.topic, TOPICS[one.topic].rate_hz[1])  # type: ignore[index]  # has one
                for one in node.outputs
                if TOPICS[one.topic].rate_hz is not None and one.endpoints
            ]
            found[name].nodes[node.name] = make_status(node.name, *ports, note="well")
        if name != MAIN:
            found[name].arms[name] = arm(name)
    return found


def arm(side: str, **values: Any) -> ArmState:
    return ArmState.model_construct(
        **{"side": side, "mode": "idle", "reason": "", "faults": (), "ready": True} | values
    )


def bad(found: list[Finding]) -> list[tuple[str, str, str]]:
    return [(one.host, one.check, one.state) for one in found if one.state != "ok"]


def test_where_all_is_well_nothing_is_found(three: ResolvedGraph) -> None:
    found = evaluate_probes(three, "main", good(three))
    assert bad(found) == []
    checks = {one.check for one in found}
    assert checks >= {
        "launcher", "plan", "keys", "software", "clocks", "nodes", "rates", "camera",
        "image", "arm left", "arm right", "disk", "load", "memory",
    }  # fmt: skip
    assert {one.host for one in found} == set(NAMES)


def test_a_host_with_other_code_may_report_topics_unknown_here(
    three: ResolvedGraph,
) -> None:
    probes = good(three)
    probes["left"].nodes["arm_left_bridge"] = make_status(
        "arm_left_bridge", port("a_topic_of_tomorrow", 50.0), note="well"
    )
    assert "failed" not in {one.state for one in evaluate_probes(three, "main", probes)}


def test_a_port_that_is_not_connected_needs_no_messages(three: ResolvedGraph) -> None:
    (arms,) = (one for one in three.nodes["twin_finger"].inputs if one.topic == "twin/arms")
    assert arms.endpoints == ()
    probes = good(three)
    status = make_status("twin_finger", port("twin/finger", 60.0), inputs=(port("twin/arms", 0.0),))
    probes["main"].nodes["twin_finger"] = status
    assert bad(evaluate_probes(three, "main", probes)) == []


def test_runs_of_several_hosts_are_named_by_host(tmp_path: Path) -> None:
    run = Run("run", tmp_path)
    assert describe_launch(run) == "starting"
    (tmp_path / HOST_FILE).write_text("left")
    assert describe_launch(run) == "starting, host left"


def changed(probe: HostProbe, **values: Any) -> None:
    assert probe.status is not None
    probe.status = probe.status.model_copy(update=values)


FAULTS: dict[str, tuple[Any, tuple[str, str, str], str]] = {
    "plan": (lambda v: changed(v["left"], plan_hash="else"), ("left", "plan", "failed"), "same"),
    "load": (
        lambda v: changed(v["left"], load_ratio=1.6),
        ("left", "load", "warning"),
        "end other programs",
    ),
    "stop": (lambda v: changed(v["left"], estop="a hand"), ("left", "e-stop", "warning"), "reset"),
    "keys": (
        lambda v: changed(v["right"], keys=v["right"].status.keys[1:]),
        ("right", "keys", "failed"), "copy",
    ),
    "python": (
        lambda v: changed(v["left"], python="3.12.1"), ("left", "software", "warning"), "git"
    ),
    "code": (lambda v: changed(v["left"], code="def"), ("left", "software", "warning"), "git"),
    "away": (
        lambda v: changed(v["left"], nodes=(
            NodeProcess(name="arm_left_bridge", state="exited", restarts=2, hangs=0),)),
        ("left", "nodes", "failed"), "log",
    ),
    "starting": (
        lambda v: changed(v["left"], nodes=(
            NodeProcess(name="arm_left_bridge", state="starting", restarts=0, hangs=0),)),
        ("left", "nodes", "warning"), "log",
    ),
    "device": (
        lambda v: changed(v["main"], missing_devices=("/dev/video0",)),
        ("main", "devices", "failed"), "cable",
    ),
    "disk": (lambda v: changed(v["main"], disk_free_bytes=1), ("main", "disk", "warning"), "bags"),
    "memory": (
        lambda v: changed(v["main"], memory_free_bytes=1), ("main", "memory", "warning"), "top"
    ),
    "clock": (
        lambda v: setattr(v["left"], "clocks", v["left"].clocks.model_copy(update={"offsets": ()})),
        ("left", "clocks", "failed"), "chrony",
    ),
    "no clock": (lambda v: setattr(v["left"], "clocks", None), ("left", "clocks", "failed"), "log"),
    "rate": (
        lambda v: v["main"].nodes.update(
            triangulator=make_status("triangulator", port("fingertip", 12.0))),
        ("main", "rates", "warning"), "upstream",
    ),
    "refused": (
        lambda v: v["left"].nodes.update(
            arm_left_bridge=make_status("arm_left_bridge", port("arm_left", 140.0, rejected=3))),
        ("left", "rates", "warning"), "log",
    ),
    "camera": (
        lambda v: v["main"].nodes.update(camera=make_status("camera", note="no pictures: gone")),
        ("main", "camera", "failed"), "program",
    ),
    "image": (
        lambda v: v["main"].nodes.pop("renderer"), ("main", "image", "failed"), "log"
    ),
    "arm": (
        lambda v: v["right"].arms.update(right=arm("right", mode="disconnected", reason="away")),
        ("right", "arm right", "failed"), "controller at 127.0.0.1:5023",
    ),
    "fault": (
        lambda v: v["right"].arms.update(right=arm("right", mode="fault", faults=("J1",))),
        ("right", "arm right", "warning"), "reset",
    ),
    "bridge": (lambda v: v["right"].arms.clear(), ("right", "arm right", "failed"), "log"),
    "version": (
        lambda v: v["left"].refused.append("message refused"),
        ("left", "messages", "failed"), "commit",
    ),
    "busy": (
        lambda v: v["left"].failed_handshakes.append("in any words"),
        ("left", "keys", "warning"), "busy",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_at_its_host_and_has_a_remedy(three: ResolvedGraph, name: str) -> None:
    bring_about, expected, remedy = FAULTS[name]
    found = good(three)
    bring_about(found)
    findings = evaluate_probes(three, "main", found)
    assert expected in bad(findings)
    assert {host for host, _, _ in bad(findings)} == {expected[0]}
    wanted = [one for one in findings if (one.host, one.check, one.state) == expected]
    assert remedy in wanted[0].remedy


@pytest.mark.parametrize("reachability", SILENCES)
def test_silence_has_a_cause_and_the_rest_was_not_asked(
    three: ResolvedGraph, reachability: Reachability
) -> None:
    found = good(three) | {"left": HostProbe("left", reachability)}
    findings = [one for one in evaluate_probes(three, "main", found) if one.host == "left"]
    states = [one.state for one in findings if one.state != "ok"]
    assert states == ["failed", "not asked"]
    failed = next(one for one in findings if one.state == "failed")
    assert failed.remedy
    assert "{" not in failed.what + failed.remedy


def test_before_anything_is_started_nothing_is_wrong(three: ResolvedGraph) -> None:
    found = {name: HostProbe(name, Reachability.CLOSED) for name in NAMES} | {
        "main": HostProbe("main", Reachability.LOCAL)
    }
    states = {one.state for one in evaluate_probes(three, "main", found)}
    assert states == {"warning", "not asked"}


@pytest.mark.parametrize(
    ("topic", "rate_hz", "wrong"),
    [
        ("arm_left", 140.0, False), ("arm_left", 39.0, False), ("arm_left", 25.0, True),
        ("arm_left", 0.0, True), ("arm_left", 300.0, True), ("scene", 0.0, False),
        ("of a later version", 0.0, False),
    ],
)  # fmt: skip
def test_rates_are_held_against_the_table(topic: str, rate_hz: float, wrong: bool) -> None:
    assert (find_rate_problem(port(topic, rate_hz)) is not None) is wrong


async def test_a_closed_port_is_distinguished_from_a_host_that_cannot_be_reached(
    three: ResolvedGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = server.getsockname()[1]
        assert await probe_module.connect("127.0.0.1", taken) == 0
    assert await probe_module.connect("127.0.0.1", taken) == errno.ECONNREFUSED

    async def find_out(number: int) -> HostProbe:
        async def connect(*_: object) -> int:
            return number

        monkeypatch.setattr(probe_module, "connect", connect)
        return await probe_module._probe_remote(three, "left", "main", None, 0.0)

    assert (await find_out(errno.ECONNREFUSED)).reachability == Reachability.CLOSED
    away = await find_out(errno.EHOSTUNREACH)
    assert (away.reachability, away.problem) == (Reachability.UNREACHABLE, "No route to host")


async def shaken(
    known: Hosts, server: str | None, expected: str, asker: str = "main"
) -> Reachability:
    """Return the finding at a publisher of `server` where `expected` is expected."""
    keys = None if server is None else known.ring(server)
    publisher = Publisher(TOPICS["host"], ["tcp://127.0.0.1:*"], keys=keys)
    try:
        return await probe_module._try_handshake(
            publisher.endpoints[0], expected, known.ring(asker)
        )
    finally:
        publisher.close()


async def test_keys_that_do_not_match_are_distinguished(monkeypatch: pytest.MonkeyPatch) -> None:
    with hosts("main", "left") as known:
        assert await shaken(known, "left", "left") == Reachability.RESPONDING
        assert await shaken(known, "main", "left") == Reachability.KEY_MISMATCH
        assert await shaken(known, "left", "left", asker="stranger") == Reachability.KEY_REJECTED
        assert await shaken(known, None, "left") == Reachability.KEY_REJECTED
        monkeypatch.setattr(probe_module, "HANDSHAKE_S", 0.1)
        with socket.create_server(("127.0.0.1", 0)) as mute:
            endpoint = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
            assert (
                await probe_module._try_handshake(endpoint, "left", known.ring("main"))
                == Reachability.SILENT
            )


def plan_of(folder: Path, **values: Any) -> ResolvedGraph:
    path = folder / "graph.yaml"
    nodes = {"beacon": BEACON, "other": BEACON | {"host": "left", "topics": {"twin__finger": None}}}
    path.write_text(json.dumps({"nodes": nodes, "hosts": ADDRESSES} | values))
    return load_graph(path)


async def test_a_running_graph_is_asked_with_its_keys(folder: Path) -> None:
    addresses: dict[str, dict[str, str]] = {}
    for name, host in ADDRESSES.items():
        public, secret = make_key_pair()
        write_secret(secret_file(name), secret)
        addresses[name] = host | {"key": public}
    plan = plan_of(folder, hosts=addresses)
    asked_not = await check_hosts(plan, "left", None, 2.0)
    assert {("main", "launcher", "warning"), ("left", "launcher", "warning")} <= set(bad(asked_not))
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(DEADLINE_S)
        found = await check_hosts(plan, "main", graph.run, DEADLINE_S)
        for check in ("launcher", "plan", "keys", "clocks", "nodes"):
            states = {one.host: one.state for one in found if one.check == check}
            assert states == {"main": "ok", "left": "ok"}, (check, found)
        # Another host of the plan asks, from outside of any run, about another plan.
        other = plan_of(folder, hosts=addresses, external_topics=["twin/stereo"], nodes={
            "beacon": BEACON | {"parameters": {"rate_hz": 17.0}},
            "other": BEACON | {"host": "left", "topics": {"twin__finger": None}},
        })  # fmt: skip
        assert other.hash != plan.hash
        found = await check_hosts(other, "left", None, 10.0)
        assert ("main", "plan", "failed") in bad(found)


def test_own_keys_and_address_are_checked_before_the_start(
    folder: Path, three: ResolvedGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexsheet.launch.health.doctor.find_opengl_problem", lambda: "no EGL")
    assert "does not exist; create a key" in (find_key_problem(three, "main") or "")
    public, secret = make_key_pair()
    write_secret(secret_file("main"), secret)
    assert "does not match hosts.main.key" in (find_key_problem(three, "main") or "")
    fitting = three.model_copy(update={"keys": three.keys | {"main": public}})
    assert find_key_problem(fitting, "main") is None
    secret_file("main").chmod(0o644)
    problem = find_key_problem(fitting, "main")
    assert "other users may read it" in (problem or "")
    failed = {
        one.check for one in check_before_start(fitting, "main", problem) if one.state == "failed"
    }
    assert failed == {"address", "keys", "opengl"}


def test_which_host_this_is(
    folder: Path, three: ResolvedGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = plan_of(folder)
    monkeypatch.setattr(
        "flexsheet.launch.health.doctor_hosts.list_own_addresses", lambda: {f"{NET}.2"}
    )
    assert find_host(two, None, None) == "left"
    monkeypatch.setattr(
        "flexsheet.launch.health.doctor_hosts.list_own_addresses", lambda: {f"{NET}.1", f"{NET}.2"}
    )
    assert find_host(two, None, None) == MAIN
    assert find_host(two, None, "left") == "left"
    with pytest.raises(CommandError, match="no address of this computer"):
        find_host(three, None, None)
    with pytest.raises(CommandError, match='did you mean "left"'):
        find_host(two, None, "lef")
