"""Evaluate the probes of hosts, and return findings with remedies.

A probe (`launch.health.probe`) contains the messages that were received from one host. Each check
of a probe returns findings. Further findings come from checks of this computer.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import psutil

from flexsheet.launch.health.doctor import (
    Finding,
    State,
    check_disk,
    check_free_disk,
    check_libraries,
    check_opengl,
)
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
from flexsheet.messages.busy import BUSY_REMEDY, describe_busy, is_busy
from flexsheet.messages.notes import SELF_CHECK_REMEDIES, describe_self_check
from flexsheet.messages.security import SecurityError, derive_public_key, read_secret
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import HostStatus, PortStatus
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arm_bridge.link_drivers import TCP_DRIVERS

RATE_TOLERANCE_RATIO = 0.1
"""The relative tolerance of message rates, which are measured over one second."""

MIN_FREE_MEMORY_BYTES = 256 << 20
CONTROLLER_S = 2.0
MAX_NAMES_SHOWN = 3


FAULTS: dict[Reachability, tuple[str, str, str]] = {
    Reachability.UNREACHABLE: (
        "reachable",
        "{address} cannot be reached: {problem}",
        "check that {host} is on, its cable, that its address is {address} (ip address), and that "
        "its firewall opens the TCP ports {first}-{last} for the other hosts",
    ),
    Reachability.CLOSED: (
        "launcher",
        "the host is on, but no launcher runs there",
        "on {host}: flexsheet launch {file} --host {host}; under systemd: journalctl -u "
        "flexsheet@{host}; if it runs, compare the addresses in the launch files",
    ),
    Reachability.SILENT: (
        "launcher",
        "the host accepts connections, but no valid message arrived",
        "the launcher hangs or runs another version, or another program uses its ports; on "
        "{host}: flexsheet doctor",
    ),
    Reachability.KEY_MISMATCH: (
        "keys",
        "the host's key differs from its key in the launch file of this computer",
        "on {host}: flexsheet keys {host}; here: flexsheet keys {host} --install {file} --key KEY",
    ),
    Reachability.KEY_REJECTED: (
        "keys",
        "the host rejects the key of {here}, or does not encrypt its messages",
        "copy {file} from here to {host}, and start its launcher again",
    ),
    Reachability.OWN_KEY_INVALID: (
        "keys",
        "the host accepts connections, but the key of {here} cannot be used",
        "correct the key of this computer first; see the findings of {here}",
    ),
}
"""The check, the finding and the remedy for hosts that do not report, by what was found out."""

SAME_COMMIT_REMEDY = "use the same commit on all hosts: git pull, make setup, and start again"
SELF_CHECK = "self-check"
"""The name of the check for calibration errors that the nodes of a host suspect."""


def evaluate_probes(
    plan: ResolvedGraph, here: str, probes: Mapping[str, HostProbe]
) -> list[Finding]:
    found: list[Finding] = []
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
        found.append(_check_nodes(probe))
        found.append(_check_rates(plan, probe))
        found += _check_devices(plan.nodes_on(host), probe)
        found += check_apparatus(probe)
        found += [check_free_disk(probe.status.disk_free_bytes, host), _check_memory(probe.status)]
    return found


def check_apparatus(probe: HostProbe) -> Iterator[Finding]:
    """Yield each calibration error that the self-checks of the nodes suspect."""
    checks = [one for status in probe.nodes.values() for one in status.self_checks]
    suspected = [one for one in checks if one.suspected]
    for one in suspected:
        what, remedy = describe_self_check(one), SELF_CHECK_REMEDIES[one.cause]
        yield Finding(probe.host, SELF_CHECK, "warning", what, remedy)
    if checks and not suspected:
        yield Finding(probe.host, SELF_CHECK, "ok", f"{len(checks)} residuals as expected")


def _check_reachability(
    plan: ResolvedGraph, here: str, probe: HostProbe, *, running: bool
) -> Iterator[Finding]:
    host, address = probe.host, plan.hosts[probe.host]
    if probe.status is not None:
        up = f"up for {probe.status.uptime_s:.0f} s at {address}, run {probe.status.run}"
        yield Finding(host, "launcher", "ok", up)
    elif probe.reachability == Reachability.LOCAL:
        remedy = f"flexsheet launch {plan.launch_file} --host {host}"
        fault: State = "failed" if running else "warning"
        yield Finding(host, "launcher", fault, "no graph runs here", remedy)
    else:
        check, what, remedy = FAULTS[probe.reachability]
        fields = {
            "host": host,
            "here": here,
            "address": address,
            "problem": probe.problem,
            "file": plan.launch_file,
            "first": FIRST_PORT,
            "last": FIRST_PORT + PORT_COUNT - 1,
        }
        # A closed port is not a fault before any graph is started.
        closed = probe.reachability == Reachability.CLOSED and not running
        state: State = "warning" if closed else "failed"
        yield Finding(host, check, state, what.format(**fields), remedy.format(**fields))
        yield Finding(host, "other checks", "not asked", "the host does not report")
    for text in probe.failed_handshakes[:MAX_NAMES_SHOWN]:
        # The first handshake of this probe succeeded, so the keys are correct.
        remedy = "the host is very busy or the network is slow; run this check again"
        yield Finding(host, "keys", "warning", text, remedy)
    for text in probe.refused[:MAX_NAMES_SHOWN]:
        yield Finding(host, "messages", "failed", text, SAME_COMMIT_REMEDY)


def _check_plan(plan: ResolvedGraph, here: str, probe: HostProbe) -> Iterator[Finding]:
    assert probe.status is not None
    if probe.status.plan_hash == plan.hash:
        yield Finding(probe.host, "plan", "ok", plan.hash)
    else:
        remedy = "use the same launch file, scene and --set on all hosts, then start again"
        if probe.host == here:
            remedy = (
                "the file was changed after the start, or --set was used: start again; to check "
                "the running graph: flexsheet doctor"
            )
        what = (
            f"the host runs plan {probe.status.plan_hash}, but {plan.launch_file} resolves to plan "
            f"{plan.hash}"
        )
        yield Finding(probe.host, "plan", "failed", what, remedy)
    if probe.status.estop is not None:
        what = f"an e-stop is engaged: {probe.status.estop}"
        remedy = "when it is safe, run on a host that may reset it: flexsheet arms reset"
        yield Finding(probe.host, "e-stop", "warning", what, remedy)


def _check_keys(plan: ResolvedGraph, probe: HostProbe) -> Finding:
    assert probe.status is not None
    theirs = {one.host: one.key for one in probe.status.keys}
    names = sorted(theirs.keys() | plan.keys.keys())
    other = [name for name in names if theirs.get(name) != plan.keys.get(name)]
    if other:
        what = f"the host's keys differ from this launch file for {', '.join(other)}"
        remedy = f"copy {plan.launch_file} to {probe.host}, and start its launcher again"
        return Finding(probe.host, "keys", "failed", what, remedy)
    what = f"the host accepts the same keys as this computer: {', '.join(names)}"
    return Finding(probe.host, "keys", "ok", what)


def _check_software(probe: HostProbe, reference: tuple[str, str, str]) -> Finding:
    status = probe.status
    assert status is not None
    what = f"python {status.python}, {status.software}, commit {status.code}"
    # Without a graph on this computer, its commit is unknown.
    if reference != (status.python, status.software, reference[2] and status.code):
        what += "; different from this computer"
        return Finding(probe.host, "software", "warning", what, SAME_COMMIT_REMEDY)
    return Finding(probe.host, "software", "ok", what)


def _check_clocks(
    plan: ResolvedGraph, probe: HostProbe, probes: Mapping[str, HostProbe]
) -> Finding:
    """Check that the clock offsets from a host to the other hosts are known accurately enough.

    The clock node of the host states the maximum uncertainty that is allowed.
    """
    finding = partial(Finding, probe.host, "clocks")
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


def _check_nodes(probe: HostProbe) -> Finding:
    assert probe.status is not None
    nodes = probe.status.nodes
    remedy = f"see {probe.status.run}/logs in the folder of runs on {probe.host}"
    exited = [one.name for one in nodes if one.state == "exited"]
    if exited:
        what = f"these nodes have ended: {', '.join(exited)}"
        return Finding(probe.host, "nodes", "failed", what, remedy)
    starting = [one.name for one in nodes if one.state == "starting"]
    if starting:
        what = f"these nodes are starting: {', '.join(starting)}"
        return Finding(probe.host, "nodes", "warning", what, remedy)
    restarted = [f"{one.name} {one.restarts}" for one in nodes if one.restarts]
    if restarted:
        what = f"{len(nodes)} nodes are ready; restarts: {', '.join(restarted)}"
        return Finding(probe.host, "nodes", "warning", what, remedy)
    return Finding(probe.host, "nodes", "ok", f"{len(nodes)} nodes are ready")


def _check_rates(plan: ResolvedGraph, probe: HostProbe) -> Finding:
    odd = []
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
                odd.append(f"{name} refused {port.rejected} of {port.topic}")
            if wrong := find_rate_problem(port):
                odd.append(f"{name} {verb} {wrong}")
    if odd:
        texts = odd[:MAX_NAMES_SHOWN]
        if len(odd) > len(texts):
            texts.append(f"and {len(odd) - len(texts)} more")
        remedy = "start with the first node upstream; see its status and log"
        return Finding(probe.host, "rates", "warning", "; ".join(texts), remedy)
    return Finding(probe.host, "rates", "ok", "all ports at the rate of their topic")


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


def _report_devices(host: str, devices: Sequence[str], missing: Sequence[str]) -> Iterator[Finding]:
    if missing:
        what = f"these device files do not exist: {', '.join(missing)}"
        remedy = "check the cable and the device number: v4l2-ctl --list-devices"
        yield Finding(host, "devices", "failed", what, remedy)
    elif devices:
        yield Finding(host, "devices", "ok", ", ".join(devices))


def _check_devices(nodes: Sequence[ResolvedNode], probe: HostProbe) -> Iterator[Finding]:
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
            yield Finding(host, check, "failed", what, "see the node's log")
            continue
        sent = max((one.rate_hz for one in status.outputs if one.topic != "status"), default=0.0)
        what = f"{sent:.0f} Hz; {status.note_text or 'no note'}"
        if sent > 0.0:
            yield Finding(host, check, "ok", what)
        else:
            yield Finding(host, check, "failed", what, remedy)
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _check_arm(node, probe)


def _check_arm(node: ResolvedNode, probe: HostProbe) -> Finding:
    arm = probe.arms.get(str(node.arm_side))
    check = f"arm {node.arm_side}"
    where = "" if node.device_address is None else f" at {node.device_address}"
    if arm is None:
        status = probe.nodes.get(node.name)
        what = f"{node.name} does not report" if status is None else status.note_text
        remedy = f"check that the controller{where} is on and its program runs; see the node's log"
        return Finding(probe.host, check, "failed", what, remedy)
    what = ", ".join(filter(None, (arm.mode, arm.reason, "; ".join(arm.faults))))
    if arm.mode == "disconnected":
        remedy = f"check that the controller{where} is on and its program runs: docs/modbus.md"
        return Finding(probe.host, check, "failed", what, remedy)
    if arm.faults:
        remedy = "when the cause is fixed: flexsheet arms reset"
        return Finding(probe.host, check, "warning", what, remedy)
    return Finding(probe.host, check, "ok", what)


def _check_memory(status: HostStatus) -> Finding:
    what = f"{status.memory_free_bytes / 2**30:.1f} GiB free"
    if status.memory_free_bytes < MIN_FREE_MEMORY_BYTES:
        remedy = "find the largest programs on that host: top"
        return Finding(status.host, "memory", "warning", what, remedy)
    return Finding(status.host, "memory", "ok", what)


def _check_load(status: HostStatus) -> Finding:
    if is_busy(status):
        return Finding(status.host, "load", "warning", describe_busy(status), BUSY_REMEDY)
    return Finding(status.host, "load", "ok", f"load {status.load_ratio:.2f} per core")


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
) -> Iterator[Finding]:
    address, nodes, own = plan.hosts[here], plan.nodes_on(here), list_own_addresses()
    if is_loopback(address) or address in own:
        yield Finding(here, "address", "ok", f"{address} is an address of this computer")
    else:
        what = f"{address} is not an address of this computer, which has {', '.join(sorted(own))}"
        remedy = "name the right host with --host, or correct the launch file on all hosts"
        yield Finding(here, "address", "failed", what, remedy)
    if key_problem is not None:
        remedy = f"flexsheet keys {here} --install {plan.launch_file}, then copy it to all hosts"
        yield Finding(here, "keys", "failed", key_problem, remedy)
    elif plan.keys:
        what = f"{secret_file(here)} matches the launch file; only its owner can read it"
        yield Finding(here, "keys", "ok", what)
    elif not all(map(is_loopback, plan.hosts.values())):
        remedy = "create and install a key for each host: docs/deploy.md"
        yield Finding(here, "keys", "failed", "the launch file has no keys", remedy)
    yield check_libraries(here)
    yield _check_ports(plan, here)
    devices = list_device_files(nodes)
    yield from _report_devices(here, devices, [one for one in devices if not os.path.exists(one)])
    if any(node.role is NodeRole.RENDERER for node in nodes):
        yield check_opengl(here)
    for node in nodes:
        if node.role is NodeRole.ARM_BRIDGE:
            yield _check_controller(here, node)
    yield check_disk(find_recording_folder(nodes), here)


def _check_ports(plan: ResolvedGraph, here: str) -> Finding:
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
        return Finding(here, "ports", "failed", what, remedy)
    return Finding(here, "ports", "ok", f"{len(ports)} ports are free")


def _check_controller(here: str, node: ResolvedNode) -> Finding:
    """Check that the controller of an arm accepts connections.

    This function must be called only if no graph is running.
    """
    finding = partial(Finding, here, f"arm {node.arm_side}")
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
