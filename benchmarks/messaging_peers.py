"""Measure the time of a message by flexsheet and by other messaging libraries, in the same run.

make bench-peers
python -m benchmarks.messaging_peers [--quick] [--over ipc tcp veth] [--json]

As in `benchmarks.messaging`, one process publishes at a constant rate, and one process per library
receives; results are ratios to blocking ZeroMQ within a round. zenoh and dora transfer as many
untyped bytes. Cyclone DDS and LCM transfer their own types with the same fields, without
validation. dora's nodes use a daemon on the same computer, so that dora is not measured between two
networks.

As root, the benchmark runs in a new network namespace, in which loopback has the multicast that LCM
needs. A second namespace is connected by a pair of virtual Ethernet devices ("veth"). There
flexsheet encrypts its messages, which it requires between computers; the others do not.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any

import zmq
from rich.console import Console
from rich.progress import Progress

from benchmarks import keys, messaging, peers
from benchmarks.messaging import (
    NODES_USE,
    PAYLOADS,
    REFERENCE,
    BusLine,
    Design,
    Line,
    Payload,
    Sender,
)
from flexsheet.launch.methods.results import machine_name

CLONE_NEWNET = 0x40000000
ADDRESSES = ("10.78.0.1", "10.78.0.2")
DEVICE = "bench"
PORTS = count(7450)
DOMAINS = count(1)
OVER = ("ipc", "tcp", "veth")


@dataclass(frozen=True)
class Peer:
    """A messaging library: its package, its address for each transport, and its transports."""

    package: str
    design: Design
    place: Callable[[str, Path], str]
    over: tuple[str, ...] = ("ipc", "tcp", "veth")


def zenoh_place(over: str, folder: Path) -> str:
    number = next(PORTS)
    if over == "ipc":
        return f"unixsock-stream/{folder}/z{number}"
    return f"tcp/{ADDRESSES[0] if over == 'veth' else '127.0.0.1'}:{number}"


def dds_place(over: str, folder: Path) -> str:
    interface = (DEVICE, *ADDRESSES) if over == "veth" else ("lo", "127.0.0.1")
    return " ".join((str(next(DOMAINS)), *interface))


def lcm_place(over: str, folder: Path) -> str:
    return f"udpm://239.255.76.67:{next(PORTS)}?ttl={1 if over == 'veth' else 0}"


def dora_place(over: str, folder: Path) -> str:
    return str(folder / f"dora{next(PORTS)}")


PEERS = (
    Peer(
        "dora-rs",
        Design("dora", "raw bytes, event loop", False, peers.receive_dora, open=peers.DoraLine),
        dora_place,
        over=("ipc",),
    ),
    Peer(
        "eclipse-zenoh",
        Design("zenoh", "raw bytes, callback", False, peers.receive_zenoh, open=peers.ZenohLine),
        zenoh_place,
    ),
    Peer(
        "cyclonedds",
        Design("cyclone_dds", "typed, reliable UDP", True, peers.receive_dds, open=peers.DdsLine),
        dds_place,
    ),
    Peer(
        "lcm",
        Design("LCM", "typed, UDP multicast", True, peers.receive_lcm, open=peers.LcmLine),
        lcm_place,
    ),
)


OURS = Design(NODES_USE, "typed, validated", True, messaging.flexsheet_uvloop)
OURS_KEYED = Design(NODES_USE, "typed, validated, CURVE", True, keys.listen)
RAW = Design(REFERENCE, "raw ZeroMQ: the reference", False, messaging.blocking)


def _libc(call: str, *arguments: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, call)(*arguments):
        raise OSError(ctypes.get_errno(), f"{call}: {os.strerror(ctypes.get_errno())}")


def enter_network(pid: int) -> None:
    """Enter the network namespace of a process. Must be called before a socket is opened."""
    with open(f"/proc/{pid}/ns/net") as space:
        _libc("setns", space.fileno(), CLONE_NEWNET)


def leave_for_own_network() -> None:
    """Enter a new network namespace with loopback multicast.

    Raises OSError without permission.
    """
    _libc("unshare", CLONE_NEWNET)
    _ip("link", "set", "lo", "up", "multicast", "on")
    _ip("route", "add", "224.0.0.0/4", "dev", "lo")


@contextmanager
def second_network() -> Iterator[int]:
    """Create a network namespace with a virtual cable, and yield the id of a process in it."""
    holder = subprocess.Popen(
        ["unshare", "--net", "sh", "-c", "echo here; exec cat"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdin is not None
    assert holder.stdout is not None
    try:
        holder.stdout.readline()
        there = ("nsenter", "-t", str(holder.pid), "-n")
        _ip("link", "add", DEVICE, "type", "veth", "peer", "name", DEVICE, "netns", str(holder.pid))
        for command, address in zip(((), there), ADDRESSES, strict=True):
            _ip("addr", "add", f"{address}/24", "dev", DEVICE, through=command)
            _ip("link", "set", DEVICE, "up", through=command)
        # LCM's multicast uses the cable on both sides.
        _ip("route", "replace", "224.0.0.0/4", "dev", DEVICE)
        _ip("route", "add", "224.0.0.0/4", "dev", DEVICE, through=there)
        yield holder.pid
    finally:
        holder.stdin.close()
        holder.wait()


def _ip(*words: str, through: Sequence[str] = ()) -> None:
    subprocess.run([*through, "ip", *words], check=True, capture_output=True)


def installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def measure_over(
    over: str, found: Sequence[Peer], options: argparse.Namespace, step: Callable[[], object]
) -> list[dict[str, Any]]:
    """Return the rows of one transport."""
    ours = OURS_KEYED if over == "veth" else OURS
    asked = [one for one in found if over in one.over]
    places = {one.design.name: one.place for one in asked}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        prepare = None
        if over == "veth":
            prepare = partial(enter_network, stack.enter_context(second_network()))
            ring = stack.enter_context(keys.create_two_rings(folder))
            loop = keys.Loop()
            stack.callback(loop.close)

        def open_line(design: Design, payload: Payload, number: int) -> Line:
            if design.open is not None and design.name in places:
                return design.open(payload, places[design.name](over, folder))
            place = {
                "ipc": f"ipc://{folder}/{payload.topic.name}-{number}",
                "tcp": "tcp://127.0.0.1:*",
                "veth": f"tcp://{ADDRESSES[0]}:*",
            }[over]
            if design.name == REFERENCE:
                return peers.ZmqLine(payload, place)
            if over == "veth":
                return keys.KeyedLine(payload, place, ring, loop)
            return BusLine(design, payload, place)

        rows = []
        for payload in PAYLOADS:
            rows += messaging.measure(
                payload,
                (RAW, ours, *(one.design for one in asked)),
                rounds=options.rounds,
                seconds=options.seconds,
                open_sender=lambda design, payload, number: Sender(
                    design, payload, open_line(design, payload, number), prepare
                ),
                step=step,
            )
    return [{"over": over, **row} for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="2 rounds of 1 s")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=1.5, help="per library and round")
    parser.add_argument("--over", nargs="+", choices=OVER, default=OVER)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.seconds = 2, 1.0
    packages = {one.package: installed(one.package) for one in PEERS}
    left_out = [f"{name}, not installed" for name, number in packages.items() if number is None]
    found = [one for one in PEERS if packages[one.package] is not None]
    over = list(options.over)
    words = Console(stderr=True)
    try:
        leave_for_own_network()
    except OSError as error:
        left_out += [
            f"LCM and two networks, which need a network of their own (be root): {error.strerror}"
        ]
        found = [one for one in found if one.package != "lcm"]
        over = [one for one in over if one != "veth"]
    for text in left_out:
        words.print(f"left out: {text}")
    load_before = os.getloadavg()[0]
    latency = []
    with Progress(console=words) as progress:
        designs = sum(2 + sum(way in one.over for one in found) for way in over)
        total = designs * len(PAYLOADS) * options.rounds
        task = progress.add_task("measuring", total=total)
        for one in over:
            latency += measure_over(one, found, options, lambda: progress.advance(task))
    report = {
        "machine": machine_name(),
        "load": [load_before, os.getloadavg()[0]],
        "zmq": zmq.zmq_version(),
        "packages": {name: number for name, number in packages.items() if number is not None},
        "left_out": left_out,
        "over": over,
        "rounds": options.rounds,
        "latency": latency,
    }
    messaging.print_report(report, "latency", as_json=options.json)


if __name__ == "__main__":
    main()
