"""Publishers and subscribers: one ZeroMQ socket each, driven by the asyncio loop.

A publisher binds, subscribers connect, in any order; either side may be restarted.  A subscriber
reads its plain (not asyncio) socket in a callback of the loop and calls the handler right there:
of the designs in `benchmarks/messaging.py` this has the least latency, and there is no pending
`recv` that could be cancelled with a message in it.

ZeroMQ's file descriptor is edge-triggered: it tells that something changed, not that something is
there, and any call on the socket may swallow the news.  So each callback reads until nothing is
left or comes back by itself, and nothing but the callback touches a socket that is being read.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import zmq

from messages.base import Header, Message
from messages.topics import Delivery, Topic
from messages.wire import Envelope, WireError, encode, read_envelope

Handler = Callable[[Any, Header], None]
Problem = Callable[[str], None]

QUEUE_SECONDS = 0.5
QUEUE_LENGTH = 1000
QUEUE_LENGTH_MIN = 16
QUEUE_BYTES = 1 << 30
BATCH = 256
LINGER_MS = 500
IPC_PATH_BYTES = 107
BIND_PATIENCE_S = 1.0
IPC_CLOSING_S = 0.02
REFUSABLE_BYTES = 256 << 20

_log = logging.getLogger("flexsheet.bus")


class BusError(RuntimeError):
    """A socket that cannot be had; the sentence names topic and endpoint."""


class Counts(Protocol):
    """Where a subscriber counts what its handler does not see."""

    dropped: int
    gaps: int
    rejected: int


def queue_length(topic: Topic) -> int:
    """Messages that either end of a connection holds for a reader that is busy.

    ZeroMQ refuses the newest when it is full, so on `latest` topics the queue must outlast the
    longest handler: half a second at the topic's highest rate.  On others it is as long as memory
    allows.
    """
    if topic.delivery is Delivery.LATEST and topic.rate_hz is not None:
        wanted = round(QUEUE_SECONDS * topic.rate_hz[1])
    else:
        wanted = min(QUEUE_LENGTH, QUEUE_BYTES // topic.max_bytes)
    return max(QUEUE_LENGTH_MIN, wanted)


class Publisher:
    """Sends the messages of one topic to whoever is connected; needs a running loop if latched.

    bind: endpoints, "ipc:///path" or "tcp://address:port" ("tcp://127.0.0.1:*" takes a free port).
    """

    def __init__(self, topic: Topic, bind: Sequence[str]) -> None:
        self.topic = topic
        self.endpoints: list[str] = []
        self._last: list[Any] | None = None
        self._latched = topic.delivery is Delivery.LATCHED
        self._loop = asyncio.get_running_loop() if self._latched else None
        self._socket = _open_socket(zmq.XPUB if self._latched else zmq.PUB, topic)
        try:
            if self._latched:
                self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
            for endpoint in bind:
                self.endpoints.append(_bind(self._socket, topic, endpoint))
        except BaseException:
            self._socket.close(linger=0)
            raise
        if self._loop is not None:
            self._loop.add_reader(self._socket.fileno(), self._serve_late_subscribers)
            self._loop.call_soon(self._serve_late_subscribers)

    def send(self, message: Message, header: Header) -> None:
        """Hand the message to the socket; never blocks.

        Its large arrays are not copied and must not be changed afterwards.  Raises WireError for a
        message that is larger than the topic allows.
        """
        frames = encode(message, header, max_bytes=self.topic.max_bytes)
        self._send(frames)
        if self._latched:
            self._last = frames
            self._serve_late_subscribers()

    def _send(self, frames: list[Any]) -> None:
        # A PUB socket drops for a subscriber whose queue is full, which that one sees as a gap.
        if len(frames) == 1:
            self._socket.send(frames[0], zmq.NOBLOCK)
        else:
            self._socket.send_multipart(frames, zmq.NOBLOCK, copy=False)

    def _serve_late_subscribers(self) -> None:
        """Send the last message again if somebody subscribed; until nobody else did meanwhile."""
        while not self._socket.closed and self._new_subscribers() and self._last is not None:
            self._send(self._last)

    def _new_subscribers(self) -> bool:
        found = False
        try:
            while True:
                found |= self._socket.recv(zmq.NOBLOCK)[:1] == b"\x01"
        except zmq.Again:
            return found

    def close(self) -> None:
        """Give the endpoints free; what was sent is still delivered for half a second."""
        if self._socket.closed:
            return
        if self._loop is not None and not self._loop.is_closed():
            self._loop.remove_reader(self._socket.fileno())
        self._socket.close(linger=LINGER_MS)


class Subscriber:
    """Receives one topic and calls `on_message(message, header)` on the loop's thread.

    connect: the endpoints of all writers; a writer may come later or come again.
    counts: gets what was superseded or overflown, lost on the way, or refused.
    on_problem: told in a sentence of losses (at the 1st, 2nd, 4th, 8th, ...; not on `latest`
        topics, where losing is meant), of the first refusal for each cause, and of an exception in
        `on_message`, which ends nothing.
    unopened: call `on_message(frames, header)` with every message that came, whatever the topic's
        delivery; its fields are not looked at.
    """

    def __init__(
        self,
        topic: Topic,
        connect: Sequence[str],
        on_message: Handler,
        counts: Counts,
        *,
        on_problem: Problem = _log.error,
        unopened: bool = False,
    ) -> None:
        self.topic, self._endpoints, self._unopened = topic, tuple(connect), unopened
        self._on_message, self._on_problem, self._counts = on_message, on_problem, counts
        self._newest_only = topic.delivery is Delivery.LATEST and not unopened
        self._seen: dict[str, tuple[int, int]] = {}
        self._reported_causes: set[str] = set()
        self._report_gaps_from = 1
        self._socket: zmq.Socket[bytes] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def start(self) -> None:
        """Connect and begin to deliver; needs a running loop."""
        if self._socket is not None:
            raise BusError(f'topic "{self.topic.name}": this subscriber has been started already')
        self._loop = asyncio.get_running_loop()
        self._socket = _open_socket(zmq.SUB, self.topic)
        try:
            self._socket.setsockopt(zmq.SUBSCRIBE, b"")
            for endpoint in self._endpoints:
                _check_endpoint(self.topic, endpoint)
                try:
                    self._socket.connect(endpoint)
                except zmq.ZMQError as error:
                    raise BusError(
                        f'topic "{self.topic.name}": cannot connect to {endpoint}: {error.strerror}'
                    ) from error
        except BaseException:
            self._socket.close(linger=0)
            self._socket = None
            raise
        self._loop.add_reader(self._socket.fileno(), self._read)
        # The calls above may have swallowed the first wake-up.
        self._loop.call_soon(self._read)

    def close(self) -> None:
        """Stop at once; may be called from the handler."""
        if self._socket is not None and not self._socket.closed:
            if self._loop is not None and not self._loop.is_closed():
                self._loop.remove_reader(self._socket.fileno())
            self._socket.close(linger=0)

    def _read(self) -> None:
        """The loop's callback: deliver what is there, or a batch of it and come back."""
        if self._socket is None or self._socket.closed or self._loop is None:
            return
        drained = False
        try:
            drained = self._deliver_newest() if self._newest_only else self._deliver_every()
        finally:
            if not drained and not self._socket.closed:
                self._loop.call_soon(self._read)

    def _deliver_newest(self) -> bool:
        """Hand over the newest message of each writer; the fields of others are not looked at."""
        newest: dict[str, Envelope] = {}
        drained = False
        for _ in range(BATCH):
            # Asking for events costs less than the exception of a recv in vain, and here the
            # message at hand waits for the answer.
            if newest and not self._has_more():
                drained = True
                break
            frames = self._receive()
            if frames is None:
                drained = True
                break
            envelope = self._accept(frames)
            if envelope is not None:
                # Taken out first, so that the order is that of arrival.
                self._counts.dropped += newest.pop(envelope.header.writer, None) is not None
                newest[envelope.header.writer] = envelope
        for envelope in newest.values():
            self._deliver(envelope)
        return drained

    def _deliver_every(self) -> bool:
        for _ in range(BATCH):
            frames = self._receive()
            if frames is None:
                return True
            envelope = self._accept(frames)
            if envelope is not None and self._unopened:
                self._call(frames, envelope.header)
            elif envelope is not None:
                self._deliver(envelope)
        return False

    def _has_more(self) -> bool:
        if self._socket is None or self._socket.closed:
            return False
        events: Any = self._socket.getsockopt(zmq.EVENTS)
        return bool(events & zmq.POLLIN)

    def _receive(self) -> list[Any] | None:
        """The frames of one message, or None where there is none; large ones are not copied."""
        if self._socket is None or self._socket.closed:
            return None
        try:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        frames = [frame]
        while frame.more:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
            frames.append(frame)
        return frames

    def _accept(self, frames: list[Any]) -> Envelope | None:
        """The envelope, its sequence number accounted for; None if refused or seen before."""
        try:
            envelope = read_envelope(frames, self.topic)
        except WireError as error:
            self._reject(error)
            return None
        header = envelope.header
        epoch, last = self._seen.get(header.writer, (None, 0))
        if epoch == header.epoch:
            if header.sequence <= last:
                return None
            if header.sequence > last + 1:
                self._count_gap(header.sequence - last - 1, header.writer)
        self._seen[header.writer] = (header.epoch, header.sequence)
        return envelope

    def _deliver(self, envelope: Envelope) -> None:
        if self._socket is None or self._socket.closed:
            return
        try:
            message = envelope.open()
        except WireError as error:
            self._reject(error)
            return
        self._call(message, envelope.header)

    def _call(self, message: Any, header: Header) -> None:
        try:
            self._on_message(message, header)
        except Exception as error:
            _log.exception("handler of topic %s failed", self.topic.name)
            self._on_problem(
                f'topic "{self.topic.name}": handler failed: {type(error).__name__}: {error}'
            )

    def _reject(self, error: WireError) -> None:
        self._counts.rejected += 1
        if error.cause not in self._reported_causes:
            self._reported_causes.add(error.cause)
            self._on_problem(f'topic "{self.topic.name}": message refused: {error}')

    def _count_gap(self, lost: int, writer: str) -> None:
        self._counts.gaps += lost
        if not self._newest_only and self._counts.gaps >= self._report_gaps_from:
            self._report_gaps_from = 2 * self._counts.gaps
            self._on_problem(
                f'topic "{self.topic.name}": {lost} messages of {writer} lost, '
                f"{self._counts.gaps} in all; a reader or the network is too slow"
            )


def _open_socket(kind: int, topic: Topic) -> zmq.Socket[bytes]:
    opened: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    length = queue_length(topic)
    options = {
        zmq.SNDHWM: length,
        zmq.RCVHWM: length,
        zmq.LINGER: LINGER_MS,
        # A larger frame makes ZeroMQ give the endpoint up, for good and without a word.  So what is
        # merely too large is let in, to be refused and counted; this limit saves the memory.
        zmq.MAXMSGSIZE: topic.max_bytes + REFUSABLE_BYTES,
        zmq.RECONNECT_IVL: 20,
        zmq.RECONNECT_IVL_MAX: 500,
    }
    if kind != zmq.SUB:
        # Publishers ask, and tell subscribers to expect it.  A subscriber must not ask by itself:
        # libzmq 4.3.5 aborts the process when its heartbeat comes due after a publisher has gone
        # whose messages still fill the queue.
        options |= {
            zmq.HEARTBEAT_IVL: 1000,
            zmq.HEARTBEAT_TIMEOUT: 5000,
            zmq.HEARTBEAT_TTL: 5000,
        }
    for option, value in options.items():
        opened.setsockopt(option, value)
    return opened


def _bind(opened: zmq.Socket[bytes], topic: Topic, endpoint: str) -> str:
    """Bind and return the endpoint with its port filled in."""
    _check_endpoint(topic, endpoint)
    patience_ends = time.monotonic() + BIND_PATIENCE_S
    while True:
        try:
            if _ipc_is_served(endpoint):
                raise zmq.ZMQError(errno.EADDRINUSE)
            opened.bind(endpoint)
            break
        except zmq.ZMQError as error:
            if error.errno != errno.EADDRINUSE:
                raise BusError(
                    f'topic "{topic.name}": {endpoint} cannot be bound: {error.strerror}; '
                    "is its folder or address on this host?"
                ) from error
            # A writer that was just closed keeps its endpoint until ZeroMQ's thread lets go of it.
            if time.monotonic() > patience_ends:
                raise BusError(
                    f'topic "{topic.name}": {endpoint} is in use by another process; '
                    "is the same launch file running already?"
                ) from error
            time.sleep(0.01)
    bound: str = opened.getsockopt_string(zmq.LAST_ENDPOINT)
    return bound


def _check_endpoint(topic: Topic, endpoint: str) -> None:
    """Refuse what ZeroMQ would take silently (a port of 99999) or explain badly."""
    transport, _, place = endpoint.partition("://")
    port = place.rpartition(":")[2]
    if transport == "tcp" and port != "*" and not (port.isdecimal() and 0 < int(port) < 1 << 16):
        raise BusError(f'topic "{topic.name}": {endpoint}: a port is a number from 1 to 65535')
    if transport == "ipc" and len(os.fsencode(place)) > IPC_PATH_BYTES:
        raise BusError(
            f'topic "{topic.name}": the path of {endpoint} has {len(os.fsencode(place))} bytes, '
            f"the system allows {IPC_PATH_BYTES}; choose a shorter folder for sockets"
        )
    if transport not in ("tcp", "ipc"):
        raise BusError(
            f'topic "{topic.name}": {endpoint} is neither ipc:///path nor tcp://host:port'
        )


def _ipc_is_served(endpoint: str) -> bool:
    """Whether somebody listens there: binding would take the path from under him."""
    path = endpoint.removeprefix("ipc://")
    if path == endpoint or path.startswith("@"):
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            # The file is a killed writer's, or one that is closing now will remove it: not ours!
            time.sleep(IPC_CLOSING_S)
            return False
        except OSError:
            return False
    return True
