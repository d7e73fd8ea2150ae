"""What the hosts' answers mean: one finding for each host and check, with the remedy.

Plain functions of what was heard (`launch.health.visits`) and of what this computer can see of
itself.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil

from flexsheet.launch.health.doctor import LEAST_DISK_BYTES, check_libraries
from flexsheet.launch.health.system import OPENGL, opengl_problem
from flexsheet.launch.health.visits import Reach, Visit
from flexsheet.launch.plans.hosts import is_loopback
from flexsheet.launch.plans.planned import Plan, PlannedNode
from flexsheet.launch.plans.wires import FIRST_PORT, PORTS
from flexsheet.launch.running.host import devices_of, folder_of, python_version, software
from flexsheet.launch.running.keys import secret_file
from flexsheet.launch.running.runs import is_free
from flexsheet.messages.bus import HANDSHAKE_FAILED
from flexsheet.messages.busy import BUSY_REMEDY, describe_busy, is_busy
from flexsheet.messages.security import SecurityError, public_of, read_secret
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import HostStatus, PortStatus
from flexsheet.nodes import NodeRole

State = Literal["ok", "warning", "failed", "not asked"]
SLACK = 0.1
"""Rates are of one second, in which a message more or less says nothing."""

LEAST_MEMORY_BYTES = 256 << 20
CONTROLLER_S = 2.0
NAMES_SHOWN = 3


@dataclass(frozen=True, slots=True)
class HostFinding:
    """One check of one host; `remedy` says what to do where it is not ok."""

    host: str
    check: str
    state: State
    what: str
    remedy: str = ""


WAYS: dict[Reach, tuple[str, str]] = {
    "no way": (
        "this computer has no way to {address}",
        "look at its own network: ip address; is the cable in?",
    ),
    "absent": (
        "nobody has the address {address}",
        "is {host} on, its cable in, and {address} its address? there: ip address",
    ),
    "dropped": (
        "no answer from {address}, not even a refusal",
        "is {host} on and {address} its address? or a firewall there drops everything",
    ),
    "blocked": (
        "{address} is on, but the ports of flexsheet are barred",
        "a firewall: let TCP {first}-{last} of {address} through to the other hosts",
    ),
}
"""Nothing there can be asked."""

SILENCES: dict[Reach, tuple[str, str, str]] = {
    "closed": (
        "launcher",
        "it is on, and nothing of flexsheet runs there",
        "there: flexsheet launch {file} --host {host}; under systemd: journalctl -u "
        "flexsheet@{host}; if it runs, its launch file gives it another address",
    ),
    "silent": (
        "launcher",
        "takes connections and says nothing",
        "its launcher hangs, or something else has its ports; there: flexsheet doctor",
    ),
    "mute": (
        "launcher",
        "the keys fit, but nothing can be understood",
        "its launcher hangs, or is of another version; see what was refused",
    ),
    "other key": (
        "keys",
        "it has not the key that the launch file here has for {host}",
        "there: flexsheet keys show {host}; here: flexsheet keys install {file} {host} 'KEY'",
    ),
    "refuses us": (
        "keys",
        "it refuses the key of {here}: its launch file has none or another for {here}",
        "copy {file} from here to {host}; its launcher takes it over by itself",
    ),
    "no keys": (
        "keys",
        "it speaks without keys, or something else has its ports",
        "copy {file} from here to {host} and start it there again",
    ),
    "unasked": (
        "keys",
        "it takes connections, but the key of {here} cannot be used",
        "put this computer's key right first, see {here}",
    ),
}
"""It is there, and this is what hinders the rest."""


def judge(plan: Plan, here: str, visits: Mapping[str, Visit]) -> list[HostFinding]:
    """All findings, host by host, about what the visits brought."""
    found: list[HostFinding] = []
    own = visits[here].status
    reference = (
        (python_version(), software(), "") if own is None else (own.python, own.software, own.code)
    )
    running = any(visit.status is not None for visit in visits.values())
    for host, visit in visits.items():
        if visit.status is not None:
            # First, since it explains most of what else may be wrong.
            found.append(_load(visit.status))
        found += _way(plan, here, visit, running=running)
        if visit.status is None:
            continue
        found += _plan(plan, here, visit)
        if plan.keys:
            found.append(_keys(plan, visit))
        found.append(_software(visit, reference))
        if len(plan.hosts) > 1:
            found.append(_clocks(plan, visit, visits))
        found.append(_nodes(plan, visit))
        found.append(_rates(visit))
        found += _parts(plan.nodes_on(host), visit)
        found += _room(visit)
    return found


def _way(plan: Plan, here: str, visit: Visit, *, running: bool) -> Iterator[HostFinding]:
    host, address = visit.host, plan.hosts[visit.host]
    words = {
        "host": host,
        "here": here,
        "address": address,
        "file": plan.launch_file,
        "first": FIRST_PORT,
        "last": FIRST_PORT + PORTS - 1,
    }
    if visit.reach in WAYS:
        what, remedy = WAYS[visit.reach]
        yield HostFinding(host, "reachable", "failed", what.format(**words), remedy.format(**words))
        yield HostFinding(host, "all else", "not asked", "it cannot be reached")
        return
    yield HostFinding(
        host, "reachable", "ok", f"{address}, {'this computer' if host == here else 'by TCP'}"
    )
    if visit.status is not None:
        up = f"up for {visit.status.uptime_s:.0f} s, run {visit.status.run}"
        yield HostFinding(host, "launcher", "ok", up)
    elif visit.reach == "itself":
        yield HostFinding(
            host,
            "launcher",
            "failed" if running else "warning",
            "no graph runs here",
            f"flexsheet launch {plan.launch_file} --host {host}",
        )
    else:
        check, what, remedy = SILENCES[visit.reach]
        # Before anything is started it is no fault that nothing runs.
        state: State = "warning" if visit.reach == "closed" and not running else "failed"
        yield HostFinding(host, check, state, what.format(**words), remedy.format(**words))
        yield HostFinding(host, "all else", "not asked", "its launcher would say")
    for text in visit.refused[:NAMES_SHOWN]:
        if text.endswith(tuple(HANDSHAKE_FAILED.values())):
            # Its keys were right when it was asked first.
            yield HostFinding(host, "keys", "warning", text, "it is very busy, or far: ask again")
            continue
        yield HostFinding(
            host,
            "messages",
            "failed",
            text,
            "the same commit on all hosts? git pull, make setup, and start again",
        )


def _plan(plan: Plan, here: str, visit: Visit) -> Iterator[HostFinding]:
    assert visit.status is not None
    if visit.status.plan_hash == plan.hash:
        yield HostFinding(visit.host, "plan", "ok", plan.hash)
    else:
        remedy = "launch file, scene and --set the same on all hosts, then start again"
        if visit.host == here:
            remedy = (
                "the file was changed since, or started with --set: start again, or, to ask about "
                "what runs: flexsheet doctor hosts"
            )
        yield HostFinding(
            visit.host,
            "plan",
            "failed",
            f"runs {visit.status.plan_hash}, {plan.launch_file} is {plan.hash}",
            remedy,
        )
    if visit.status.estop is not None:
        yield HostFinding(
            visit.host,
            "e-stop",
            "warning",
            f"kept: {visit.status.estop}",
            "when the danger is over, on a host that may: flexsheet arms reset",
        )


def _keys(plan: Plan, visit: Visit) -> HostFinding:
    assert visit.status is not None
    theirs = {one.host: one.key for one in visit.status.keys}
    names = sorted(theirs.keys() | plan.keys.keys())
    other = [name for name in names if theirs.get(name) != plan.keys.get(name)]
    if other:
        return HostFinding(
            visit.host,
            "keys",
            "failed",
            f"has other keys than this launch file for {', '.join(other)}",
            f"copy {plan.launch_file} to {visit.host}; its launcher takes it over by itself",
        )
    return HostFinding(visit.host, "keys", "ok", f"lets in {', '.join(names)}, as here")


def _software(visit: Visit, reference: tuple[str, str, str]) -> HostFinding:
    status = visit.status
    assert status is not None
    python, versions, code = reference
    what = f"python {status.python}, {status.software}, commit {status.code}"
    other = [
        name
        for name, theirs, ours in (
            ("python", status.python, python),
            ("libraries", status.software, versions),
            ("commit", status.code, code or status.code),
        )
        if theirs != ours
    ]
    if other:
        remedy = "the same commit on all hosts: git pull, make setup, and start again"
        what += f"; not as here: {', '.join(other)}"
        return HostFinding(visit.host, "software", "warning", what, remedy)
    return HostFinding(visit.host, "software", "ok", what)


def _clocks(plan: Plan, visit: Visit, visits: Mapping[str, Visit]) -> HostFinding:
    """The other hosts' clocks as this one's clock node knows them, against the plan's limit."""
    remedy = "docs/clocks.md: chrony, and is the network quiet?"
    if visit.clocks is None:
        return HostFinding(
            visit.host, "clocks", "failed", "its clock node says nothing", "see its log"
        )
    limit_s = visit.clocks.max_offset_uncertainty_s
    known = {one.clock_id: one for one in visit.clocks.offsets}
    words, bad = [], False
    for name, other in visits.items():
        if name == visit.host or not other.clock_id:
            continue
        offset = known.get(other.clock_id)
        if other.clock_id == visit.clock_id:
            words.append(f"{name}: the same clock")
        elif offset is None:
            bad = True
            words.append(f"{name}: not measured")
        else:
            bad = bad or offset.uncertainty_s > limit_s
            words.append(
                f"{name}: {offset.offset_ns * 1e-9:+.6f} s within "
                f"{1e3 * offset.uncertainty_s:.2f} ms, drift {1e6 * offset.drift_ratio:+.0f} ppm"
                + (f", stepped {offset.resets} times" if offset.resets else "")
            )
    if not words:
        return HostFinding(visit.host, "clocks", "not asked", "no other host speaks")
    what = f"{'; '.join(words)}; {1e3 * limit_s:g} ms are allowed"
    if bad:
        return HostFinding(visit.host, "clocks", "failed", what, remedy)
    return HostFinding(visit.host, "clocks", "ok", what)


def _nodes(plan: Plan, visit: Visit) -> HostFinding:
    assert visit.status is not None
    nodes = visit.status.nodes
    away = [one.name for one in nodes if one.state != "ready"]
    again = [f"{one.name} {one.restarts}" for one in nodes if one.restarts]
    log = f"{visit.status.run}/logs in its folder of runs"
    if away:
        return HostFinding(
            visit.host, "nodes", "failed", f"not ready: {', '.join(away)}", f"see {log}"
        )
    if again:
        what = f"{len(nodes)} ready; started again so many times: {', '.join(again)}"
        return HostFinding(visit.host, "nodes", "warning", what, f"see {log}")
    return HostFinding(visit.host, "nodes", "ok", f"{len(nodes)} ready")


def _rates(visit: Visit) -> HostFinding:
    """Topics that the table expects at a rate, as each node sent and heard them."""
    odd, right, refused = [], 0, []
    for name, status in visit.nodes.items():
        ports = [(one, "sends") for one in status.outputs]
        ports += [(one, "hears") for one in status.inputs]
        for port, verb in ports:
            if port.rejected:
                refused.append(f"{name} {port.rejected} of {port.topic}")
            wrong = rate_problem(port)
            topic = TOPICS.get(port.topic)  # a host with other code may have others
            if wrong:
                odd.append(f"{name} {verb} {wrong}")
            elif topic is not None and topic.rate_hz is not None:
                right += 1
    if odd or refused:
        words = _shown(odd)
        if refused:
            words.append(f"refused: {', '.join(_shown(refused))}")
        remedy = "what is silent upstream comes first; see status and log of these nodes"
        return HostFinding(visit.host, "rates", "warning", "; ".join(words), remedy)
    if not right:
        return HostFinding(visit.host, "rates", "not asked", "its nodes say nothing of rates yet")
    return HostFinding(visit.host, "rates", "ok", f"{right} ports at their topic's rate")


def rate_problem(port: PortStatus) -> str | None:
    """What is wrong with a port's rate, by the table of topics; None: nothing."""
    topic = TOPICS.get(port.topic)
    if topic is None or topic.rate_hz is None or topic.many_writers:
        return None
    low, high = topic.rate_hz
    if port.rate_hz == 0.0:
        return f"no {port.topic}"
    if not low * (1 - SLACK) - 1 <= port.rate_hz <= high * (1 + SLACK) + 1:
        return f"{port.topic} at {port.rate_hz:.0f} Hz, expected {low:g} to {high:g}"
    return None


def _parts(nodes: Sequence[PlannedNode], visit: Visit) -> Iterator[HostFinding]:
    """What the host is there for: cameras, projector, its arm."""
    assert visit.status is not None
    host, missing = visit.host, visit.status.missing_devices
    devices = devices_of(list(nodes))
    if missing:
        yield HostFinding(
            host,
            "devices",
            "failed",
            f"not there: {', '.join(missing)}",
            "is it plugged in? else another number: v4l2-ctl --list-devices",
        )
    elif devices:
        yield HostFinding(host, "devices", "ok", ", ".join(devices))
    for node in nodes:
        check = {"camera": "camera", "renderer": "picture"}.get(node.type)
        if check is None:
            continue
        status = visit.nodes.get(node.name)
        if status is None:
            yield HostFinding(host, check, "failed", f"{node.name} is silent", "see its log")
            continue
        sent = max((one.rate_hz for one in status.outputs if one.topic != "status"), default=0.0)
        what = f"{sent:.0f} Hz; {status.note or 'nothing to say'}"
        if sent > 0.0:
            yield HostFinding(host, check, "ok", what)
        else:
            remedy = {
                "camera": "docs/camera.md; does another program hold it?",
                "picture": f"OpenGL: there, flexsheet doctor; on Debian: {OPENGL.manual}",
            }[check]
            yield HostFinding(host, check, "failed", what, remedy)
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _arm(node, visit)


def _arm(node: PlannedNode, visit: Visit) -> HostFinding:
    arm = visit.arms.get(str(node.arm_side))
    check = f"arm {node.arm_side}"
    if arm is None:
        return _silent_arm(node, visit, check)
    what = ", ".join(filter(None, (arm.mode, arm.reason, "; ".join(arm.faults))))
    if arm.mode == "disconnected":
        where = "" if node.device_address is None else f" at {node.device_address}"
        remedy = f"is the controller{where} on, and its program running? docs/modbus.md"
        return HostFinding(visit.host, check, "failed", what, remedy)
    if arm.faults:
        remedy = "when the cause is mended: flexsheet arms reset"
        return HostFinding(visit.host, check, "warning", what, remedy)
    auto_arming = node.parameters.get("arming") == "auto"
    moves = "moves as soon as no interlock holds"
    waits = moves if auto_arming else "flexsheet arms enable lets it move"
    ready = "ready" if arm.ready else waits
    return HostFinding(visit.host, check, "ok", f"{what}; {ready}")


def _silent_arm(node: PlannedNode, visit: Visit, check: str) -> HostFinding:
    """Tell an arm that its bridge waits for from a bridge that does not report."""
    status = visit.nodes.get(node.name)
    if status is None:
        return HostFinding(visit.host, check, "failed", f"{node.name} is silent", "see its log")
    assert visit.status is not None
    starts = any(one.state == "starting" for one in visit.status.nodes)
    where = f"{node.parameters['host']}:{node.parameters['port']}"
    remedy = f"is the controller at {where} on, and its program running? see its log"
    return HostFinding(visit.host, check, "warning" if starts else "failed", status.note, remedy)


def _room(visit: Visit) -> Iterator[HostFinding]:
    status = visit.status
    assert status is not None
    yield _disk(visit.host, status.disk_free_bytes)
    what = f"{status.memory_free_bytes / 2**30:.1f} GiB free"
    if status.memory_free_bytes < LEAST_MEMORY_BYTES:
        yield HostFinding(visit.host, "memory", "warning", what, "what else runs there? top")
    else:
        yield HostFinding(visit.host, "memory", "ok", what)


def _load(status: HostStatus) -> HostFinding:
    """Whether the processors of a host leave its nodes enough time."""
    if is_busy(status):
        return HostFinding(status.host, "load", "warning", describe_busy(status), BUSY_REMEDY)
    what = f"{status.load_ratio:.2f} processes per core want to run"
    if status.cpu is not None:
        what += f"; {status.cpu.node} waits longest, {status.cpu.wait_ratio:.0%} of the time"
    return HostFinding(status.host, "load", "ok", what)


def _disk(host: str, free_bytes: int) -> HostFinding:
    what = f"{free_bytes / 2**30:.1f} GiB free"
    if free_bytes < LEAST_DISK_BYTES:
        return HostFinding(host, "disk", "warning", what, "bags need room: make some")
    return HostFinding(host, "disk", "ok", what)


def _shown(texts: Sequence[str]) -> list[str]:
    more = len(texts) - NAMES_SHOWN
    return [*texts[:NAMES_SHOWN], *([f"and {more} more"] if more > 0 else [])]


def own_key_problem(plan: Plan, here: str) -> str | None:
    """Why this computer's key cannot be used for a host of the plan; None: it can."""
    if not plan.keys:
        return None
    file = secret_file(here)
    try:
        own = public_of(read_secret(file))
    except SecurityError as error:
        return str(error)
    if own != plan.keys[here]:
        return (
            f"{file} belongs to another public key than hosts.{here}.key of {plan.launch_file}; "
            f"the file's: {plan.keys[here]}, here: {own}"
        )
    return None


def before_start(plan: Plan, here: str, key_problem: str | None) -> Iterator[HostFinding]:
    """What this computer can say of itself as a host of the plan while no graph runs on it."""
    address, nodes = plan.hosts[here], plan.nodes_on(here)
    if is_loopback(address) or address in own_addresses():
        yield HostFinding(here, "address", "ok", f"{address} is this computer's")
    else:
        yield HostFinding(
            here,
            "address",
            "failed",
            f"{address} is none of this computer's: {', '.join(sorted(own_addresses()))}",
            "is this the host that you mean (--host)? else mend the launch file on all hosts",
        )
    if key_problem is not None:
        remedy = f"flexsheet keys install {plan.launch_file} {here}, then copy it to all hosts"
        yield HostFinding(here, "keys", "failed", key_problem, remedy)
    elif plan.keys:
        what = f"{secret_file(here)} fits the launch file, and only its owner can read it"
        yield HostFinding(here, "keys", "ok", what)
    elif not all(map(is_loopback, plan.hosts.values())):
        remedy = "flexsheet keys new on each host, flexsheet keys install for each: docs/deploy.md"
        yield HostFinding(here, "keys", "failed", "the launch file has none", remedy)
    libraries = check_libraries()
    yield HostFinding(
        here,
        "software",
        libraries.state,
        f"python {python_version()}, {software()}; {libraries.what}",
        libraries.remedy,
    )
    yield _ports(plan, here)
    devices = devices_of(nodes)
    missing = [one for one in devices if not os.path.exists(one)]
    if missing:
        remedy = "is it plugged in? else another number: v4l2-ctl --list-devices"
        what = f"not there: {', '.join(missing)}"
        yield HostFinding(here, "devices", "failed", what, remedy)
    elif devices:
        yield HostFinding(here, "devices", "ok", ", ".join(devices))
    if any(node.role is NodeRole.RENDERER for node in nodes):
        problem = opengl_problem()
        if problem is None:
            yield HostFinding(here, "opengl", "ok", "a headless context can be made (EGL)")
        else:
            yield HostFinding(here, "opengl", "failed", problem, f"on Debian: {OPENGL.manual}")
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _controller(here, node)
    folder = folder_of(nodes)
    yield _disk(here, shutil.disk_usage(folder if folder.is_dir() else Path.cwd()).free)


def _ports(plan: Plan, here: str) -> HostFinding:
    address = plan.hosts[here]
    wanted = [
        int(writer.tcp.rpartition(":")[2])
        for writers in plan.writers.values()
        for writer in writers
        if writer.tcp is not None and writer.host == here
    ]
    mine = is_loopback(address) or address in own_addresses()
    taken = [port for port in wanted if mine and not is_free(address, port)]
    taken += [port for _, port in plan.listening_nodes(here) if not is_free("127.0.0.1", port)]
    if taken:
        remedy = "ss -ltnp says who; does a graph run here that is another user's?"
        what = f"in use: {', '.join(map(str, sorted(taken)))}"
        return HostFinding(here, "ports", "failed", what, remedy)
    return HostFinding(here, "ports", "ok", f"{len(wanted)} are free")


def _controller(here: str, node: PlannedNode) -> HostFinding:
    """Whether an arm's controller takes connections; a graph that runs holds the only one."""
    check = f"arm {node.arm_side}"
    if node.device_address is None:
        return HostFinding(here, check, "not asked", f"{node.name} has a driver of its own")
    address, port = str(node.parameters["host"]), int(node.parameters["port"])
    if is_loopback(address):
        what = f"{address}:{port}: the twin's, which starts with the graph"
        return HostFinding(here, check, "not asked", what)
    if node.parameters.get("driver") != "modbus":
        return HostFinding(here, check, "not asked", f"{address}:{port} speaks UDP")
    try:
        socket.create_connection((address, port), CONTROLLER_S).close()
    except OSError as error:
        remedy = f"is the controller on, {address} its address, and its Modbus server running?"
        return HostFinding(here, check, "failed", f"{address}:{port}: {error}", remedy)
    return HostFinding(here, check, "ok", f"{address}:{port} takes connections")


def own_addresses() -> set[str]:
    """The IP addresses of this computer."""
    families = (socket.AF_INET, socket.AF_INET6)
    return {
        one.address.partition("%")[0]
        for found in psutil.net_if_addrs().values()
        for one in found
        if one.family in families
    }
