"""Evaluate the probes of hosts, and return findings with remedies.

A probe (`launch.health.probe`) contains the messages that were received from one host. Each check
of a probe returns findings. Further findings come from checks of this computer.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import psutil

from flexsheet.launch.health.doctor import MIN_FREE_DISK_BYTES, check_libraries, check_opengl
from flexsheet.launch.health.opengl import OPENGL_REMEDY
from flexsheet.launch.health.probe import HostProbe, Reachability
from flexsheet.launch.plans.hosts import is_loopback
from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
from flexsheet.launch.plans.routing import FIRST_PORT, PORT_COUNT
from flexsheet.launch.running.host import (
    find_recording_folder,
    list_device_files,
    python_version,
    software,
)
from flexsheet.launch.running.keys import secret_file
from flexsheet.launch.running.runs import is_free
from flexsheet.messages.busy import describe_busy, describe_busy_remedy, describe_pressure, is_busy
from flexsheet.messages.notes import SELF_CHECK_REMEDIES, describe_self_check
from flexsheet.messages.security import SecurityError, derive_public_key, read_secret
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import HostStatus, PortStatus
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arm_bridge.link_drivers import TCP_DRIVERS

State = Literal["ok", "warning", "failed", "not asked"]
RATE_TOLERANCE_RATIO = 0.1
"""The relative tolerance of message rates, which are measured over one second."""

MIN_FREE_MEMORY_BYTES = 256 << 20
CONTROLLER_S = 2.0
MAX_NAMES_SHOWN = 3


@dataclass(frozen=True, slots=True)
class HostFinding:
    """The result of a check of a host.

    what: text that describes the result.
    remedy: text that states what the user can do; empty if the check passed.
    """

    host: str
    check: str
    state: State
    what: str
    remedy: str = ""


NETWORK_FAULTS: dict[Reachability, tuple[str, str]] = {
    Reachability.NO_ROUTE: (
        "this computer has no route to {address}",
        "check the network of this computer (ip address) and its cable",
    ),
    Reachability.UNREACHABLE: (
        "no computer has the address {address}",
        "check that {host} is on and connected, and that its address is {address} (ip address)",
    ),
    Reachability.NO_REPLY: (
        "no reply from {address}",
        "check that {host} is on, that its address is {address}, and its firewall",
    ),
    Reachability.BLOCKED: (
        "{address} is on, but its firewall blocks the ports of flexsheet",
        "open the TCP ports {first}-{last} of {address} for the other hosts in the firewall",
    ),
}
"""The texts of the finding and the remedy for each reason why a host cannot be reached."""

LAUNCHER_FAULTS: dict[Reachability, tuple[str, str, str]] = {
    Reachability.CLOSED: (
        "launcher",
        "the host is on, but no launcher runs there",
        "on {host}: flexsheet launch {file} --host {host}; under systemd: journalctl -u "
        "flexsheet@{host}; if it runs, compare the addresses in the launch files",
    ),
    Reachability.HANDSHAKE_TIMEOUT: (
        "launcher",
        "the host accepts connections, but does not complete the handshake",
        "the launcher hangs, or another program uses its ports; on {host}: flexsheet doctor",
    ),
    Reachability.NO_RESPONSE: (
        "launcher",
        "the keys match, but no valid message arrived",
        "the launcher hangs or runs another version; see the refused messages",
    ),
    Reachability.KEY_MISMATCH: (
        "keys",
        "the host's key differs from its key in the launch file of this computer",
        "on {host}: flexsheet keys show {host}; here: flexsheet keys install {file} {host} 'KEY'",
    ),
    Reachability.KEY_REJECTED: (
        "keys",
        "the host rejects the key of {here}: its launch file has no key or another key for {here}",
        "copy {file} from here to {host}, and start its launcher again",
    ),
    Reachability.UNENCRYPTED: (
        "keys",
        "the host does not encrypt its messages, or another program uses its ports",
        "copy {file} from here to {host} and restart the launcher there",
    ),
    Reachability.OWN_KEY_INVALID: (
        "keys",
        "the host accepts connections, but the key of {here} cannot be used",
        "correct the key of this computer first; see the findings of {here}",
    ),
}
"""The name of the check, the finding and the remedy for hosts whose launcher does not respond.

The keys are the reasons why a launcher does not respond although its host is on.
"""

SAME_COMMIT_REMEDY = "use the same commit on all hosts: git pull, make setup, and start again"
SELF_CHECK = "self-check"
"""The name of the check for calibration errors that the nodes of a host suspect."""


def evaluate_probes(
    plan: ResolvedGraph, here: str, probes: Mapping[str, HostProbe]
) -> list[HostFinding]:
    found: list[HostFinding] = []
    own = probes[here].status
    reference = (
        (python_version(), software(), "") if own is None else (own.python, own.software, own.code)
    )
    running = any(probe.status is not None for probe in probes.values())
    for host, probe in probes.items():
        if probe.status is not None:
            # Report overload first, because it causes most other faults.
            found.append(_check_load(probe.status))
        found += _check_reachability(plan, here, probe, running=running)
        if probe.status is None:
            continue
        found += _check_plan(plan, here, probe)
        if plan.keys:
            found.append(_check_keys(plan, probe))
        found.append(_check_software(probe, reference))
        if len(plan.hosts) > 1:
            found.append(_check_clocks(plan, probe, probes))
        found.append(_check_nodes(plan, probe))
        found.append(_check_rates(plan, probe))
        found += _check_devices(plan.nodes_on(host), probe)
        found += check_apparatus(probe, plan.nodes_on(host))
        found += _check_resources(probe)
    return found


REQUIRED_FOR_CHECKS = {
    "reference_marks_world_m": "the pose of the camera",
    "touch_point_world_m": "the marker on the finger",
    "sheet_calibration": "the sheet's modulus (`flexsheet calibrate sheet`)",
}
"""The quantities that optional self-checks test.

Each key is the node parameter that enables the self-check.
"""


def check_apparatus(probe: HostProbe, nodes: Sequence[ResolvedNode]) -> Iterator[HostFinding]:
    """Yield the results of the nodes' self-checks, which detect errors of the calibration.

    Each suspected error is a finding. If no error is suspected, the finding lists the self-checks
    that are disabled.

    nodes: nodes of the host in the launch file.
    """
    checks = [one for status in probe.nodes.values() for one in status.self_checks]
    suspected = [one for one in checks if one.suspected]
    for one in suspected:
        what, remedy = describe_self_check(one), SELF_CHECK_REMEDIES[one.cause]
        yield HostFinding(probe.host, SELF_CHECK, "warning", what, remedy)
    missing = [
        f"{subject}: set `{parameter}` of {node.name}"
        for node in nodes
        for parameter, subject in REQUIRED_FOR_CHECKS.items()
        if parameter in node.parameters and not node.parameters[parameter]
    ]
    if not suspected and (checks or missing):
        unchecked = (f"no check of {one}" for one in missing)
        text = "; ".join([f"{len(checks)} residuals as expected", *unchecked])
        yield HostFinding(probe.host, SELF_CHECK, "ok", text)


def _check_reachability(
    plan: ResolvedGraph, here: str, probe: HostProbe, *, running: bool
) -> Iterator[HostFinding]:
    host, address = probe.host, plan.hosts[probe.host]
    fields = {
        "host": host,
        "here": here,
        "address": address,
        "file": plan.launch_file,
        "first": FIRST_PORT,
        "last": FIRST_PORT + PORT_COUNT - 1,
    }
    if probe.reachability in NETWORK_FAULTS:
        what, remedy = NETWORK_FAULTS[probe.reachability]
        problem = what.format(**fields)
        yield HostFinding(host, "reachable", "failed", problem, remedy.format(**fields))
        yield HostFinding(host, "other checks", "not asked", "the host cannot be reached")
        return
    what = f"{address}, {'this computer' if host == here else 'by TCP'}"
    yield HostFinding(host, "reachable", "ok", what)
    if probe.status is not None:
        up = f"up for {probe.status.uptime_s:.0f} s, run {probe.status.run}"
        yield HostFinding(host, "launcher", "ok", up)
    elif probe.reachability == Reachability.LOCAL:
        remedy = f"flexsheet launch {plan.launch_file} --host {host}"
        fault: State = "failed" if running else "warning"
        yield HostFinding(host, "launcher", fault, "no graph runs here", remedy)
    else:
        check, what, remedy = LAUNCHER_FAULTS[probe.reachability]
        # A closed port is not a fault before any graph is started.
        state: State = (
            "warning" if probe.reachability == Reachability.CLOSED and not running else "failed"
        )
        yield HostFinding(host, check, state, what.format(**fields), remedy.format(**fields))
        yield HostFinding(host, "other checks", "not asked", "the host's launcher does not report")
    for text in probe.failed_handshakes[:MAX_NAMES_SHOWN]:
        # The first handshake of this probe succeeded, so the keys are correct.
        remedy = "the host is very busy or the network is slow; run this check again"
        yield HostFinding(host, "keys", "warning", text, remedy)
    for text in probe.refused[:MAX_NAMES_SHOWN]:
        yield HostFinding(host, "messages", "failed", text, SAME_COMMIT_REMEDY)


def _check_plan(plan: ResolvedGraph, here: str, probe: HostProbe) -> Iterator[HostFinding]:
    assert probe.status is not None
    if probe.status.plan_hash == plan.hash:
        yield HostFinding(probe.host, "plan", "ok", plan.hash)
    else:
        remedy = "use the same launch file, scene and --set on all hosts, then start again"
        if probe.host == here:
            remedy = (
                "the file was changed after the start, or --set was used: start again; to check "
                "the running graph: flexsheet doctor hosts"
            )
        what = (
            f"the host runs plan {probe.status.plan_hash}, but {plan.launch_file} resolves to plan "
            f"{plan.hash}"
        )
        yield HostFinding(probe.host, "plan", "failed", what, remedy)
    if probe.status.estop is not None:
        what = f"an e-stop is engaged: {probe.status.estop}"
        remedy = "when it is safe, run on a host that may reset it: flexsheet arms reset"
        yield HostFinding(probe.host, "e-stop", "warning", what, remedy)


def _check_keys(plan: ResolvedGraph, probe: HostProbe) -> HostFinding:
    assert probe.status is not None
    theirs = {one.host: one.key for one in probe.status.keys}
    names = sorted(theirs.keys() | plan.keys.keys())
    other = [name for name in names if theirs.get(name) != plan.keys.get(name)]
    if other:
        what = f"the host's keys differ from this launch file for {', '.join(other)}"
        remedy = f"copy {plan.launch_file} to {probe.host}, and start its launcher again"
        return HostFinding(probe.host, "keys", "failed", what, remedy)
    what = f"the host accepts the same keys as this computer: {', '.join(names)}"
    return HostFinding(probe.host, "keys", "ok", what)


def _check_software(probe: HostProbe, reference: tuple[str, str, str]) -> HostFinding:
    status = probe.status
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
        what += f"; different from this computer: {', '.join(other)}"
        return HostFinding(probe.host, "software", "warning", what, SAME_COMMIT_REMEDY)
    return HostFinding(probe.host, "software", "ok", what)


def _check_clocks(
    plan: ResolvedGraph, probe: HostProbe, probes: Mapping[str, HostProbe]
) -> HostFinding:
    """Check that the clock offsets from a host to the other hosts are known accurately enough.

    The clock node of the host states the maximum uncertainty that is allowed.
    """
    finding = partial(HostFinding, probe.host, "clocks")
    if probe.clocks is None:
        what = "the clock node of the host does not publish"
        return finding("failed", what, "see the log of the clock node")
    limit_s = probe.clocks.max_offset_uncertainty_s
    known = {one.clock_id: one for one in probe.clocks.offsets}
    texts, bad = [], False
    for name, other in probes.items():
        if name == probe.host or not other.clock_id:
            continue
        offset = known.get(other.clock_id)
        if other.clock_id == probe.clock_id:
            texts.append(f"{name}: the same clock")
        elif offset is None:
            bad = True
            texts.append(f"{name}: not measured")
        else:
            bad = bad or offset.uncertainty_s > limit_s
            texts.append(
                f"{name}: {offset.offset_ns * 1e-9:+.6f} s within "
                f"{1e3 * offset.uncertainty_s:.2f} ms, drift {1e6 * offset.drift_ratio:+.0f} ppm"
                + (f", stepped {offset.resets} times" if offset.resets else "")
            )
    if not texts:
        return finding("not asked", "no other host reports")
    what = f"{'; '.join(texts)}; {1e3 * limit_s:g} ms are allowed"
    if bad:
        return finding("failed", what, "check chrony and the load of the network: docs/clocks.md")
    return finding("ok", what)


def _check_nodes(plan: ResolvedGraph, probe: HostProbe) -> HostFinding:
    assert probe.status is not None
    nodes = probe.status.nodes
    ended = [one.name for one in nodes if one.state == "exited"]
    starting = [one.name for one in nodes if one.state == "starting"]
    restarted = [f"{one.name} {one.restarts}" for one in nodes if one.restarts]
    remedy = f"see {probe.status.run}/logs in the folder of runs on {probe.host}"
    finding = partial(HostFinding, probe.host, "nodes")
    if ended:
        return finding("failed", f"these nodes have ended: {', '.join(ended)}", remedy)
    if starting:
        what = f"these nodes are still starting: {', '.join(starting)}"
        return finding("warning", what, f"wait some seconds; otherwise {remedy}")
    if restarted:
        what = f"{len(nodes)} nodes are ready; restarts: {', '.join(restarted)}"
        return finding("warning", what, remedy)
    return finding("ok", f"{len(nodes)} nodes are ready")


def _check_rates(plan: ResolvedGraph, probe: HostProbe) -> HostFinding:
    odd, right, refused = [], 0, []
    # Nodes report the ports that their scene does not need, too; these have no endpoints.
    unconnected = {
        (node.name, port.topic)
        for node in plan.nodes.values()
        for port in (*node.inputs, *node.outputs)
        if not port.endpoints
    }
    for name, status in probe.nodes.items():
        ports = [(one, "publishes") for one in status.outputs]
        ports += [(one, "receives") for one in status.inputs]
        for port, verb in ports:
            if (name, port.topic) in unconnected:
                continue
            if port.rejected:
                refused.append(f"{name} {port.rejected} of {port.topic}")
            wrong = find_rate_problem(port)
            topic = TOPICS.get(port.topic)  # another version may have other topics
            if wrong:
                odd.append(f"{name} {verb} {wrong}")
            elif topic is not None and topic.rate_hz is not None:
                right += 1
    if odd or refused:
        texts = _shorten(odd)
        if refused:
            texts.append(f"refused: {', '.join(_shorten(refused))}")
        remedy = "start with the first node upstream; see its status and log"
        return HostFinding(probe.host, "rates", "warning", "; ".join(texts), remedy)
    if not right:
        return HostFinding(probe.host, "rates", "not asked", "its nodes report no rates yet")
    return HostFinding(probe.host, "rates", "ok", f"{right} ports at the rate of their topic")


def find_rate_problem(port: PortStatus) -> str | None:
    """Return a text if the message rate at an input or output of a node is not as expected.

    Return None if the rate is as expected.
    """
    topic = TOPICS.get(port.topic)
    if topic is None or topic.rate_hz is None or topic.many_writers:
        return None
    low, high = topic.rate_hz
    if port.rate_hz == 0.0:
        return f"no {port.topic}"
    low_hz, high_hz = low * (1 - RATE_TOLERANCE_RATIO) - 1, high * (1 + RATE_TOLERANCE_RATIO) + 1
    if not low_hz <= port.rate_hz <= high_hz:
        return f"{port.topic} at {port.rate_hz:.0f} Hz, expected {low:g} to {high:g}"
    return None


OUTPUT_CHECKS: dict[NodeRole | None, tuple[str, str]] = {
    NodeRole.CAMERA: ("camera", "check whether another program uses the camera: docs/camera.md"),
    NodeRole.RENDERER: (
        "image",
        f"check OpenGL on that host: flexsheet doctor; {OPENGL_REMEDY}",
    ),
}
"""The name and the remedy of a check, by the role of the checked node.

The check tests whether the node publishes messages.
"""


def _report_devices(
    host: str, devices: Sequence[str], missing: Sequence[str]
) -> Iterator[HostFinding]:
    if missing:
        what = f"these device files do not exist: {', '.join(missing)}"
        remedy = "check the cable and the device number: v4l2-ctl --list-devices"
        yield HostFinding(host, "devices", "failed", what, remedy)
    elif devices:
        yield HostFinding(host, "devices", "ok", ", ".join(devices))


def _check_devices(nodes: Sequence[ResolvedNode], probe: HostProbe) -> Iterator[HostFinding]:
    assert probe.status is not None
    host, missing = probe.host, probe.status.missing_devices
    devices = list_device_files(nodes)
    yield from _report_devices(host, devices, missing)
    for node in nodes:
        if node.role not in OUTPUT_CHECKS:
            continue
        check, remedy = OUTPUT_CHECKS[node.role]
        status = probe.nodes.get(node.name)
        if status is None:
            what = f"{node.name} does not report"
            yield HostFinding(host, check, "failed", what, "see the node's log")
            continue
        sent = max((one.rate_hz for one in status.outputs if one.topic != "status"), default=0.0)
        what = f"{sent:.0f} Hz; {status.note_text or 'no note'}"
        if sent > 0.0:
            yield HostFinding(host, check, "ok", what)
        else:
            yield HostFinding(host, check, "failed", what, remedy)
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _check_arm(node, probe)


def _check_arm(node: ResolvedNode, probe: HostProbe) -> HostFinding:
    arm = probe.arms.get(str(node.arm_side))
    check = f"arm {node.arm_side}"
    if arm is None:
        return _check_silent_arm(node, probe, check)
    what = ", ".join(filter(None, (arm.mode, arm.reason, "; ".join(arm.faults))))
    if arm.mode == "disconnected":
        where = "" if node.device_address is None else f" at {node.device_address}"
        remedy = f"check that the controller{where} is on and its program runs: docs/modbus.md"
        return HostFinding(probe.host, check, "failed", what, remedy)
    if arm.faults:
        remedy = "when the cause is fixed: flexsheet arms reset"
        return HostFinding(probe.host, check, "warning", what, remedy)
    if arm.ready:
        next_step = "ready"
    elif arm.auto_arming:
        next_step = "moves when no interlock is active"
    else:
        next_step = "to let it move: flexsheet arms enable"
    return HostFinding(probe.host, check, "ok", f"{what}; {next_step}")


def _check_silent_arm(node: ResolvedNode, probe: HostProbe, check: str) -> HostFinding:
    status = probe.nodes.get(node.name)
    if status is None:
        what = f"{node.name} does not report"
        return HostFinding(probe.host, check, "failed", what, "see the node's log")
    assert probe.status is not None
    starts = any(one.state == "starting" for one in probe.status.nodes)
    where = "" if node.device_address is None else f" at {node.device_address}"
    remedy = f"check that the controller{where} is on and its program runs; see the node's log"
    state: Literal["warning", "failed"] = "warning" if starts else "failed"
    return HostFinding(probe.host, check, state, status.note_text, remedy)


def _check_resources(probe: HostProbe) -> Iterator[HostFinding]:
    status = probe.status
    assert status is not None
    yield _check_disk(probe.host, status.disk_free_bytes)
    finding = partial(HostFinding, probe.host, "memory")
    what = f"{status.memory_free_bytes / 2**30:.1f} GiB free"
    if status.memory_free_bytes < MIN_FREE_MEMORY_BYTES:
        yield finding("warning", what, "find the largest programs on that host: top")
    else:
        yield finding("ok", what)


def _check_load(status: HostStatus) -> HostFinding:
    if is_busy(status):
        remedy = describe_busy_remedy(nice_denied=status.nice_denied)
        return HostFinding(status.host, "load", "warning", describe_busy(status), remedy)
    what = f"load {status.load_ratio:.2f} per core"
    if status.cpu is not None:
        what += f"; {describe_pressure(status.cpu)}"
    return HostFinding(status.host, "load", "ok", what)


def _check_disk(host: str, free_bytes: int) -> HostFinding:
    what = f"{free_bytes / 2**30:.1f} GiB free"
    if free_bytes < MIN_FREE_DISK_BYTES:
        return HostFinding(host, "disk", "warning", what, "free some disk space for bags")
    return HostFinding(host, "disk", "ok", what)


def _shorten(texts: Sequence[str]) -> list[str]:
    more = len(texts) - MAX_NAMES_SHOWN
    return [*texts[:MAX_NAMES_SHOWN], *([f"and {more} more"] if more > 0 else [])]


def find_key_problem(plan: ResolvedGraph, here: str) -> str | None:
    """Return the reason why the key of this computer cannot be used to connect to other hosts.

    Return None if the key can be used.

    here: name of this computer in the launch file.
    """
    if not plan.keys:
        return None
    file = secret_file(here)
    try:
        own = derive_public_key(read_secret(file))
    except SecurityError as error:
        return str(error)
    if own != plan.keys[here]:
        return (
            f"{file} does not match hosts.{here}.key of {plan.launch_file}: "
            f"public key {own} here, {plan.keys[here]} in the launch file"
        )
    return None


def check_before_start(
    plan: ResolvedGraph, here: str, key_problem: str | None
) -> Iterator[HostFinding]:
    address, nodes, own = plan.hosts[here], plan.nodes_on(here), list_own_addresses()
    if is_loopback(address) or address in own:
        yield HostFinding(here, "address", "ok", f"{address} is an address of this computer")
    else:
        what = f"{address} is not an address of this computer, which has {', '.join(sorted(own))}"
        remedy = "name the right host with --host, or correct the launch file on all hosts"
        yield HostFinding(here, "address", "failed", what, remedy)
    if key_problem is not None:
        remedy = f"flexsheet keys install {plan.launch_file} {here}, then copy it to all hosts"
        yield HostFinding(here, "keys", "failed", key_problem, remedy)
    elif plan.keys:
        what = f"{secret_file(here)} matches the launch file; only its owner can read it"
        yield HostFinding(here, "keys", "ok", what)
    elif not all(map(is_loopback, plan.hosts.values())):
        remedy = "run flexsheet keys new on each host, then flexsheet keys install: docs/deploy.md"
        yield HostFinding(here, "keys", "failed", "the launch file has no keys", remedy)
    libraries = check_libraries()
    what = f"python {python_version()}, {software()}; {libraries.what}"
    yield HostFinding(here, "software", libraries.state, what, libraries.remedy)
    yield _check_ports(plan, here)
    devices = list_device_files(nodes)
    yield from _report_devices(here, devices, [one for one in devices if not os.path.exists(one)])
    if any(node.role is NodeRole.RENDERER for node in nodes):
        opengl = check_opengl()
        yield HostFinding(here, opengl.check, opengl.state, opengl.what, opengl.remedy)
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _check_controller(here, node)
    folder = find_recording_folder(nodes)
    yield _check_disk(here, shutil.disk_usage(folder if folder.is_dir() else Path.cwd()).free)


def _check_ports(plan: ResolvedGraph, here: str) -> HostFinding:
    address = plan.hosts[here]
    ports = [
        int(writer.tcp.rpartition(":")[2])
        for writers in plan.writers.values()
        for writer in writers
        if writer.tcp is not None and writer.host == here
    ]
    is_own = is_loopback(address) or address in list_own_addresses()
    used = [port for port in ports if is_own and not is_free(address, port)]
    used += [port for _, port in plan.listening_nodes(here) if not is_free("127.0.0.1", port)]
    if used:
        remedy = "find the program with ss -ltnp; another user may run a graph"
        what = f"these ports are in use: {', '.join(map(str, sorted(used)))}"
        return HostFinding(here, "ports", "failed", what, remedy)
    return HostFinding(here, "ports", "ok", f"{len(ports)} ports are free")


def _check_controller(here: str, node: ResolvedNode) -> HostFinding:
    """Check that the controller of an arm accepts connections.

    This function must be called only if no graph is running.
    """
    finding = partial(HostFinding, here, f"arm {node.arm_side}")
    if node.device_address is None:
        return finding("not asked", f"{node.name} uses its own driver")
    address, _, port = node.device_address.rpartition(":")
    if is_loopback(address):
        return finding("not asked", f"{address}:{port} is simulated and starts with the graph")
    if node.parameters.get("driver") not in TCP_DRIVERS:
        return finding("not asked", f"{address}:{port} uses UDP")
    try:
        socket.create_connection((address, int(port)), CONTROLLER_S).close()
    except OSError as error:
        remedy = f"check that the controller is on at {address} and its Modbus server runs"
        return finding("failed", f"{address}:{port}: {error}", remedy)
    return finding("ok", f"{address}:{port} accepts connections")


def list_own_addresses() -> set[str]:
    """Return the IP addresses of all network interfaces of this computer."""
    families = (socket.AF_INET, socket.AF_INET6)
    return {
        one.address.partition("%")[0]
        for found in psutil.net_if_addrs().values()
        for one in found
        if one.family in families
    }
