"""Measure the time of a message from one process to another, by the method of receiving.

python -m benchmarks.messaging [--quick] [--transport ipc|tcp] [--json]

One process publishes at a constant rate, and one process per design receives; one design is within
a single process. The latency is the one-way time on the shared clock, from before a typed message
is constructed to the handler of the validated message. Raw designs transfer as many bytes in as
many frames without decoding. The designs run in random order in every round. The result is the
ratio to blocking ZeroMQ within the round, because absolute times on a shared machine vary by a
factor of two.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import multiprocessing
import os
import random
import tempfile
import time
import timeit
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import uvloop
import zmq
import zmq.asyncio
from rich.console import Console
from rich.progress import Progress

from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.methods.results import machine_name
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Publisher, Subscriber
from flexsheet.messages.local_bus import LocalBus
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import Fingertip, StereoPair
from flexsheet.messages.wire import INLINE_BYTES, count_bytes, decode, encode
from flexsheet.nodes.node import PortCounts

REFERENCE = "blocking"
ONE_PROCESS = "one_process"
NODES_USE = "flexsheet_uvloop"
EPOCH = 1


class Line(Protocol):
    """The sending end of a design.

    endpoint: address for the receiver.
    """

    endpoint: str

    def send(self, sequence: int, stamp_ns: int) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True)
class Payload:
    name: str
    topic: Topic
    rate_hz: float
    make: Callable[[int], Message]


@dataclass(frozen=True)
class Design:
    """A method of receiving messages.

    typed: whether the receiver gets validated messages. Other designs receive bytes.
    open: function that opens the sending end; None: a publisher of `flexsheet.messages.bus`.
    """

    name: str
    about: str
    typed: bool
    receive: Callable[[Topic, str, Callable[[int, int], bool]], None]
    inline_bytes: int | None = None
    open: Callable[[Payload, str], Line] | None = None


def subscriber_socket(context: Any, endpoint: str) -> Any:
    opened = context.socket(zmq.SUB)
    opened.setsockopt(zmq.SUBSCRIBE, b"")
    opened.setsockopt(zmq.RCVHWM, 1000)
    opened.connect(endpoint)
    return opened


def raw_stamp(frames: Sequence[Any]) -> tuple[int, int]:
    """Return the sequence and stamp at the start of a raw message."""
    head = bytes(memoryview(frames[0])[:16])
    return int.from_bytes(head[:8], "little"), int.from_bytes(head[8:], "little")


def blocking(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    opened = subscriber_socket(zmq.Context.instance(), endpoint)
    while arrived(*raw_stamp(opened.recv_multipart(copy=False))):
        pass
    opened.close(linger=0)


def zmq_asyncio(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    async def run() -> None:
        opened = subscriber_socket(zmq.asyncio.Context.instance(), endpoint)
        while arrived(*raw_stamp(await opened.recv_multipart(copy=False))):
            pass
        opened.close(linger=0)

    asyncio.run(run())


def zmq_asyncio_typed(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    async def run() -> None:
        opened = subscriber_socket(zmq.asyncio.Context.instance(), endpoint)
        going = True
        while going:
            _, header = decode(await opened.recv_multipart(copy=False), topic)
            going = arrived(header.sequence, header.publish_ns)
        opened.close(linger=0)

    asyncio.run(run())


async def read_descriptor(endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    loop = asyncio.get_running_loop()
    opened = subscriber_socket(zmq.Context.instance(), endpoint)
    ended = loop.create_future()

    def drain() -> None:
        while not ended.done():
            try:
                frames = opened.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            if not arrived(*raw_stamp(frames)):
                ended.set_result(None)

    loop.add_reader(opened.fileno(), drain)
    loop.call_soon(drain)
    await ended
    loop.remove_reader(opened.fileno())
    opened.close(linger=0)


def descriptor(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    asyncio.run(read_descriptor(endpoint, arrived))


def descriptor_uvloop(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    uvloop.run(read_descriptor(endpoint, arrived))


async def subscribe(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    ended = asyncio.get_running_loop().create_future()

    def on_message(message: Message, header: Header) -> None:
        if not arrived(header.sequence, header.publish_ns) and not ended.done():
            ended.set_result(None)

    subscriber = Subscriber(topic, [endpoint], on_message, PortCounts())
    subscriber.start()
    await ended
    subscriber.close()


def flexsheet_asyncio(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    asyncio.run(subscribe(topic, endpoint, arrived))


def flexsheet_uvloop(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    uvloop.run(subscribe(topic, endpoint, arrived))


DESIGNS = (
    Design(REFERENCE, "raw, blocking recv in a separate thread: the reference", False, blocking),
    Design("zmq.asyncio", "raw, await recv_multipart()", False, zmq_asyncio),
    Design("descriptor", "raw, add_reader on the socket's descriptor", False, descriptor),
    Design("descriptor_uvloop", "the same on uvloop", False, descriptor_uvloop),
    Design(
        "zmq.asyncio_typed", "await recv_multipart(), decoded, validated", True, zmq_asyncio_typed
    ),
    Design(
        "flexsheet_asyncio", "flexsheet.messages.bus, decoded, validated", True, flexsheet_asyncio
    ),
    Design(NODES_USE, "the same on uvloop: what nodes use", True, flexsheet_uvloop),
    Design("flexsheet_all_frames", "the same, each array its own frame", True, flexsheet_uvloop, 0),
)


def refuse_receiver(topic: Topic, endpoint: str, arrived: Callable[[int, int], bool]) -> None:
    """Raise RuntimeError, because this design has no receiving process."""
    raise RuntimeError(f'"{ONE_PROCESS}" has no receiving process')


LOCAL = Design(ONE_PROCESS, "between nodes of one process, validated", True, refuse_receiver)


IMAGES = np.random.default_rng(0).integers(0, 255, (2, 480, 640), np.uint8)
POINT = np.array([0.01, 0.02, 0.03])
COVARIANCE = np.eye(6)
AHEAD = np.zeros((13, 3))


def fingertip(number: int) -> Fingertip:
    return Fingertip(
        valid=True,
        state="tracking",
        reason="ok",
        position_world_m=POINT,
        velocity_world_m_per_s=POINT,
        covariance=COVARIANCE,
        predicted_path_world_m=AHEAD,
        prediction_step_s=0.01,
        measured_world_m=POINT,
        reprojection_px=0.1,
    )


def stereo(number: int) -> StereoPair:
    return StereoPair(
        device="bench", exposure_s=0.001, dropped_frames=0, left=IMAGES[0], right=IMAGES[1]
    )


PAYLOADS = (
    Payload("fingertip", TOPICS["fingertip"], 250.0, fingertip),
    Payload("stereo_640x480", TOPICS["stereo"], 60.0, stereo),
)


def receive_rounds(
    design: Design,
    topic: Topic,
    endpoint: str,
    results: Connection,
    prepare: Callable[[], None] | None,
) -> None:
    """Receive messages in a child process, and send the latencies of each round to the parent."""
    if prepare is not None:
        prepare()
    latencies: list[int] = []
    # As nodes do after `setup`: existing objects are excluded from garbage collection.
    gc.collect()
    gc.freeze()

    def arrived(sequence: int, stamp_ns: int) -> bool:
        now_ns = time.monotonic_ns()
        kind = stamp_ns & 3
        if kind == 0:
            latencies.append(now_ns - stamp_ns)
        elif kind == 1:
            results.send("here")
        elif kind == 2:
            results.send(latencies.copy())
            latencies.clear()
        return kind != 3

    design.receive(topic, endpoint, arrived)


# A stamp's two lowest bits contain the message's kind, an error of up to 4 ns.
MEASURE, WARM_UP, END_ROUND, END = range(4)
PATIENCE_S = 30.0
ANSWER_S = 8.0
CLOSING_S = 5.0


def make_header(sequence: int, stamp_ns: int) -> Header:
    return Header(sequence, stamp_ns, stamp_ns, "bench", "bench", EPOCH)


class BusLine:
    """A publisher of `messages.bus`, which sends the same number of raw bytes for raw designs."""

    def __init__(
        self,
        design: Design,
        payload: Payload,
        endpoint: str,
        open_publisher: Callable[[Topic, list[str]], Publisher] = Publisher,
    ) -> None:
        self._design, self._payload = design, payload
        self._raw = [bytearray(frame) for frame in encode(payload.make(0), make_header(0, 0))]
        self._publisher = open_publisher(payload.topic, [endpoint])
        self.endpoint = self._publisher.endpoints[0]

    def send(self, sequence: int, stamp_ns: int) -> None:
        if not self._design.typed:
            raw = self._raw[0]
            raw[:16] = sequence.to_bytes(8, "little") + stamp_ns.to_bytes(8, "little")
            self._publisher._send([bytes(raw), *self._raw[1:]])
        elif self._design.inline_bytes is None:
            self._publisher.send(self._payload.make(sequence), make_header(sequence, stamp_ns))
        else:
            message = self._payload.make(sequence)
            inline_bytes = self._design.inline_bytes
            self._publisher._send(
                encode(message, make_header(sequence, stamp_ns), inline_bytes=inline_bytes)
            )

    def close(self) -> None:
        self._publisher.close()


class Sender:
    """The sender of one design and its receiving child process.

    prepare: function that the child calls first.
    """

    def __init__(
        self,
        design: Design,
        payload: Payload,
        line: Line,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self.design, self.payload, self._line = design, payload, line
        self.sequence = 0
        spawn = multiprocessing.get_context("spawn")
        self.results, childs_end = spawn.Pipe()
        self._child = spawn.Process(
            target=receive_rounds,
            args=(design, payload.topic, line.endpoint, childs_end, prepare),
            daemon=True,
        )
        try:
            self._child.start()
            self._warm_up()
        except BaseException:
            line.close()
            raise

    def _warm_up(self) -> None:
        """Send until the child has received enough messages."""
        patience_ends = time.monotonic() + PATIENCE_S
        while not self.results.poll(0.01):
            if not self._child.is_alive() or time.monotonic() > patience_ends:
                raise RuntimeError(f"{self.design.name}: no message arrives")
            self.send(WARM_UP)
        time.sleep(0.05)
        while self.results.poll(0):
            self.results.recv()

    def send(self, kind: int) -> None:
        self.sequence += 1
        self._line.send(self.sequence, (time.monotonic_ns() & ~3) | kind)

    def round(self, count: int) -> list[int]:
        """Send `count` messages at the payload's rate; return the latencies, ns."""
        period_s = 1.0 / self.payload.rate_hz
        next_s = time.monotonic()
        for _ in range(count):
            next_s += period_s
            time.sleep(max(0.0, next_s - time.monotonic()))
            self.send(MEASURE)
        patience_ends = time.monotonic() + ANSWER_S
        # Repeated because some transports lose messages; later answers are empty lists,
        # and those to warm-up may come late.
        while time.monotonic() < patience_ends:
            time.sleep(0.05)
            self.send(END_ROUND)
            while self.results.poll(0.5):
                answer = self.results.recv()
                if isinstance(answer, list) and answer:
                    return answer[-count:]
        return []

    def close(self) -> None:
        patience_ends = time.monotonic() + CLOSING_S
        while self._child.is_alive() and time.monotonic() < patience_ends:
            self.send(END)
            self._child.join(0.2)
        self._line.close()


class LocalSender:
    """A publisher and a subscriber in one event loop, with the interface of `Sender`."""

    def __init__(self, payload: Payload, endpoint: str) -> None:
        self.design, self._payload, self._endpoint = LOCAL, payload, endpoint

    def round(self, count: int) -> list[int]:
        """Send `count` messages at the payload's rate; return the latencies, ns."""
        return uvloop.run(self._round(count))

    async def _round(self, count: int) -> list[int]:
        local, latencies = LocalBus([self._endpoint]), list[int]()
        topic = self._payload.topic
        publisher = Publisher(topic, [self._endpoint], local=local)

        def on_message(message: Message, header: Header) -> None:
            latencies.append(time.monotonic_ns() - header.publish_ns)

        subscriber = Subscriber(topic, [self._endpoint], on_message, PortCounts(), local=local)
        subscriber.start()
        next_s = time.monotonic()
        for number in range(1, count + LOCAL_WARM_UP + 1):
            next_s += 1.0 / self._payload.rate_hz
            await asyncio.sleep(max(0.0, next_s - time.monotonic()))
            stamp_ns = time.monotonic_ns()
            publisher.send(self._payload.make(number), make_header(number, stamp_ns))
        await asyncio.sleep(0.05)
        subscriber.close()
        publisher.close()
        return latencies[LOCAL_WARM_UP:]

    def close(self) -> None:
        pass


LOCAL_WARM_UP = 20


def opener(transport: str, folder: Path) -> Callable[[Design, Payload, int], Sender | LocalSender]:
    """Return a function that opens senders for the transport "ipc" or "tcp"."""

    def open_sender(design: Design, payload: Payload, number: int) -> Sender | LocalSender:
        place = f"ipc://{folder}/{payload.topic.name}-{number}"
        if design is LOCAL:
            return LocalSender(payload, place)
        endpoint = place if transport == "ipc" else "tcp://127.0.0.1:*"
        return Sender(design, payload, BusLine(design, payload, endpoint))

    return open_sender


def percentile_us(latencies_ns: Sequence[int], percent: float) -> float:
    """Return a percentile in us, or NaN without messages."""
    if not latencies_ns:
        return float("nan")
    return float(np.percentile(np.asarray(latencies_ns), percent)) * 1e-3


def measure(
    payload: Payload,
    designs: Sequence[Design],
    *,
    rounds: int,
    seconds: float,
    open_sender: Callable[[Design, Payload, int], Sender | LocalSender],
    step: Callable[[], object],
    reference: str = REFERENCE,
) -> list[dict[str, Any]]:
    """Return one row per design: medians over rounds of p50, p99 and their ratios to a reference.

    open_sender: function of the design, the payload and the index of the design.
    reference: name of a design.
    """
    count = round(seconds * payload.rate_hz)
    senders: list[Sender | LocalSender] = []
    by_design: dict[str, list[tuple[float, float]]] = {design.name: [] for design in designs}
    missing = dict.fromkeys(by_design, 0)
    try:
        for number, design in enumerate(designs):
            senders.append(open_sender(design, payload, number))
        # The sender does the same.
        gc.collect()
        gc.freeze()
        for _ in range(rounds):
            for sender in random.sample(senders, len(senders)):
                latencies = sender.round(count)
                name = sender.design.name
                missing[name] += count - len(latencies)
                by_design[name].append((percentile_us(latencies, 50), percentile_us(latencies, 99)))
                step()
    finally:
        for sender in senders:
            sender.close()
    base_rounds = by_design[reference]

    def row(design: Design) -> dict[str, Any]:
        p50s, p99s = zip(*by_design[design.name], strict=True)
        p50_ratios = [own / base for own, (base, _) in zip(p50s, base_rounds, strict=True)]
        p99_ratios = [own / base for own, (_, base) in zip(p99s, base_rounds, strict=True)]
        median = np.nanmedian if np.isfinite(p50s).any() else np.median
        return {
            "payload": payload.name,
            "design": design.name,
            "about": design.about,
            "typed": design.typed,
            "messages": count * rounds,
            "superseded": missing[design.name],
            "p50_us": float(median(p50s)),
            "p99_us": float(median(p99s)),
            "p50_ratio": float(median(p50_ratios)),
            "p99_ratio": float(median(p99_ratios)),
            "p50_ratio_range": [
                float(np.fmin.reduce(p50_ratios)),
                float(np.fmax.reduce(p50_ratios)),
            ],
        }

    return [row(design) for design in designs]


def codec_costs() -> list[dict[str, Any]]:
    """Return the times to encode and decode messages, us, as the minimum of repetitions."""

    def best_us(action: Callable[..., object], *arguments: Any, **named: Any) -> float:
        call = partial(action, *arguments, **named)
        return min(timeit.repeat(call, number=2000, repeat=7)) / 2000 * 1e6

    rows = []
    for payload in PAYLOADS:
        message = payload.make(0)
        for inline_bytes in (INLINE_BYTES, 0):
            frames = encode(message, make_header(1, 2), inline_bytes=inline_bytes)
            rows.append(
                {
                    "payload": payload.name,
                    "inline_bytes": inline_bytes,
                    "frames": len(frames),
                    "bytes": count_bytes(frames),
                    "construct_us": best_us(payload.make, 0),
                    "encode_us": best_us(
                        encode, message, make_header(1, 2), inline_bytes=inline_bytes
                    ),
                    "decode_us": best_us(decode, frames, payload.topic),
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="2 rounds of 1 s: under a minute")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=2.0, help="per design and round")
    parser.add_argument("--transport", choices=["ipc", "tcp"], default="ipc")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rounds, seconds = (2, 1.0) if options.quick else (options.rounds, options.seconds)
    words = Console(stderr=True)
    load_before = os.getloadavg()[0]
    with Progress(console=words) as progress, tempfile.TemporaryDirectory() as folder:
        designs = (*DESIGNS, LOCAL)
        task = progress.add_task("measuring", total=rounds * len(designs) * len(PAYLOADS))
        latency = []
        for payload in PAYLOADS:
            latency += measure(
                payload,
                designs,
                rounds=rounds,
                seconds=seconds,
                open_sender=opener(options.transport, Path(folder)),
                step=lambda: progress.advance(task),
            )
    report = {
        "machine": machine_name(),
        "load": [load_before, os.getloadavg()[0]],
        "zmq": zmq.zmq_version(),
        "transport": options.transport,
        "rounds": rounds,
        "latency": latency,
        "codec": codec_costs(),
    }
    print_report(report, "latency", "codec", as_json=options.json)


def print_report(report: dict[str, Any], *tables: str, as_json: bool) -> None:
    """Print a report as JSON, or the rows of some of its entries as tables."""
    if as_json:
        print(json.dumps(report, indent=1))
        return
    for name in tables:
        print_rows(report[name], as_json=False)
        print()


if __name__ == "__main__":
    main()
