"""Publish and subscribe by ZeroMQ sockets in the asyncio event loop.

A publisher binds its socket and subscribers connect to it, in any order. Publishers and subscribers
can be restarted. A subscriber reads plain (not asyncio) sockets in a callback of the event loop and
calls the handler there. `benchmarks/messaging.py` compares this design with others; this design has
the smallest latency. A subscriber never waits in a `recv` call, whose cancellation could lose a
message.

A subscriber has one socket per host, which identifies the host of each message. From each host, the
subscriber accepts only messages of the nodes that run there. Sockets that other computers can reach
always use keys (`flexsheet.messages.security`).

The file descriptor of a ZeroMQ socket is edge-triggered: its signal means only that the state of
the socket has changed. A message need not be ready. Any call on the socket can clear the signal.
Each callback therefore reads until the socket is empty, or schedules itself again. No other code
uses a socket that is being read.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import zmq
from zmq.utils.monitor import parse_monitor_message

from flexsheet.messages.base import Header, Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.local_bus import LocalBus, LocalConnection
from flexsheet.messages.security import KeyRing, ZapAuthenticator
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.wire import Envelope, WireError, encode, read_envelope

Handler = Callable[[Any, Header], None]
Problem = Callable[[str], None]
MessageFilter = Callable[[Any, Header], str | None]
"""A function that returns the reason to reject a message, or None to accept the message."""

QUEUE_S = 0.5
MAX_QUEUE_LENGTH = 1000
MIN_QUEUE_LENGTH = 16
MAX_QUEUE_BYTES = 1 << 30
BATCH = 256
LINGER_MS = 500
IPC, IPC_PATH_BYTES = "ipc://", 107
BIND_TIMEOUT_S = 1.0
IPC_CLOSING_S = 0.02
MAX_EXCESS_BYTES = 256 << 20
MAX_SUBSCRIPTION_BYTES = 512
"""The maximum size (bytes) of a frame that a publisher receives.

The largest such frame is the last frame of a CURVE handshake.
"""

HANDSHAKE_MS = 5000
REOPEN_DELAY_S = 0.5
RECONNECT_MS = 100
"""The maximum period (ms) of attempts to reconnect to a publisher.

After a node restarts, its subscribers receive no messages for up to this time.
"""

WATCHED_RECONNECT_MS = 50
"""The maximum reconnection period (ms) of subscribers that report the end of a connection."""

MAX_PAST_CLOCKS = 16

# Plain integers, because operations on Python's enumerations take longer than ZeroMQ's calls.
EVENTS, POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)
NOBLOCK, NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)

_log = logging.getLogger("flexsheet.bus")


HEARTBEATS = {zmq.HEARTBEAT_IVL: 1000, zmq.HEARTBEAT_TIMEOUT: 5000, zmq.HEARTBEAT_TTL: 5000}
"""The socket options for heartbeats (ms) from a publisher over tcp.

Over ipc, publishers send no heartbeats, because the end of a process is detected without
heartbeats. A subscriber over ipc that is busy for seconds would not answer and would be
disconnected.

Subscribers send no heartbeats, because of a fault in libzmq 4.3.5. The process is aborted if a
heartbeat is due after the publisher has disconnected while its messages still fill the queue.
"""

TCP_KEEPALIVE_OPTIONS = {
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 4,
    zmq.TCP_MAXRT: 5000,
    zmq.CONNECT_TIMEOUT: 2000,
}
"""The socket options with which a subscriber detects within 5 s that a host is unreachable.

The subscriber detects a restart of the host at once. The heartbeats of the publisher are not
enough, because libzmq 4.3.5 stops waiting for the next heartbeat as soon as a message arrives.
"""

HANDSHAKE_FAILED: dict[int, str] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "rejects the key of this host; check its launch file",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "does not accept keys; its launch file may have none",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "did not prove that it has its key",
}
RECONNECTED = (zmq.EVENT_CONNECTED, zmq.EVENT_CONNECT_DELAYED, zmq.EVENT_CONNECT_RETRIED)
MONITORED_EVENTS = zmq.EVENT_DISCONNECTED | sum(RECONNECTED) | sum(HANDSHAKE_FAILED)


class BusError(FlexsheetError, RuntimeError):
    """Raised if a socket cannot be opened. The text names the topic and the endpoint."""

    remedy = "Another graph has the endpoint. End that graph, or run `flexsheet doctor --sweep`."


class Counts(Protocol):
    """The interface of counters for messages that a subscriber does not pass to its handler.

    dropped: superseded messages.
    gaps: lost messages.
    rejected: invalid messages.
    """

    dropped: int
    gaps: int
    rejected: int


def compute_queue_length(topic: Topic) -> int:
    """Return the maximum number of queued messages at each end of a connection.

    A full queue drops the newest message. On topics with the delivery `latest`, the queue therefore
    holds only the messages of half a second at the topic's maximum rate. On other topics, memory
    limits the length of the queue.
    """
    if topic.delivery is Delivery.LATEST and topic.rate_hz is not None:
        length = round(QUEUE_S * topic.rate_hz[1])
    else:
        length = min(MAX_QUEUE_LENGTH, MAX_QUEUE_BYTES // topic.max_bytes)
    return max(MIN_QUEUE_LENGTH, length)


@dataclass(frozen=True, slots=True)
class Source:
    """An endpoint to which a subscriber connects.

    writer: name of the node that publishes at the endpoint; None means any node.
    host: name of the host at the endpoint. If keys are used, the endpoint must have the key of this
        host.
    """

    endpoint: str
    writer: str | None = None
    host: str | None = None


class Publisher:
    """A publisher of one topic.

    A publisher requires a running event loop if the topic is latched, or if `keys` or `local` is
    given.

    bind: endpoints, "ipc:///path" or "tcp://address:port". "tcp://127.0.0.1:*" selects a free port.
    keys: keys of the hosts that may connect over tcp. If None, tcp is bound to the loopback
        interface.
    on_refused: function that is called with a text for each refused connection.
    local: bus that passes messages to subscribers in this process without encoding them. The socket
        is then used only while another process has subscribed.
    """

    def __init__(
        self,
        topic: Topic,
        bind: Sequence[str],
        *,
        keys: KeyRing | None = None,
        on_refused: Problem = _log.warning,
        local: LocalBus | None = None,
    ) -> None:
        self.topic = topic
        self.endpoints: list[str] = []
        self._channel = None if local is None else local.find(bind)
        self._has_remote_readers = False
        self._last: list[Any] | None = None
        self._latched = topic.delivery is Delivery.LATCHED
        self._keys = keys if any(one.startswith("tcp:") for one in bind) else None
        self._domain: bytes | None = None
        if self._keys is not None:
            self._domain = ZapAuthenticator.register(self._keys, on_refused)
        try:
            self._open(bind)
        except BaseException:
            self._unregister_keys()
            raise

    def _open(self, bind: Sequence[str]) -> None:
        # Only an XPUB socket can be read. Reading it lets ZeroMQ free the memory of ended
        # connections even if no message is sent.
        is_read = self._latched or self._keys is not None or self._channel is not None
        self._loop = asyncio.get_running_loop() if is_read else None
        self._socket = _open_socket(zmq.XPUB if is_read else zmq.PUB, self.topic)
        endpoints = []
        try:
            if self._latched:
                self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
            # Endpoints that are bound before the keys are set need no key, so ipc endpoints are
            # bound first.
            for endpoint in sorted(bind, key=lambda one: one.startswith("tcp:")):
                if endpoint.startswith("tcp:"):
                    for option, value in HEARTBEATS.items():
                        self._socket.setsockopt(option, value)
                    if self._keys is not None and self._domain is not None:
                        self._keys.set_server_keys(self._socket, self._domain)
                endpoints.append(_bind(self._socket, self.topic, endpoint, keys=self._keys))
        except BaseException:
            self._socket.close(linger=0)
            raise
        self.endpoints = endpoints
        if self._loop is not None:
            self._loop.add_reader(self._socket.fileno(), self._serve_late_subscribers)
            self._loop.call_soon(self._serve_late_subscribers)

    def interrupt(self) -> None:
        """Disconnect all subscribers, as if this process had ended.

        The subscribers reconnect automatically. Messages that were sent earlier are still
        delivered.
        """
        if self._channel is not None:
            self._channel.interrupt()
        if not self._socket.closed:
            self._close_socket(unbind=True)
            self._open(self.endpoints)

    def send(self, message: Message, header: Header) -> None:
        """Send a message without blocking.

        Large arrays are not copied, so the caller must not change them after this call. Raises
        WireError if the message is larger than the topic permits.
        """
        if self._channel is not None:
            self._channel.send(self.topic, message, header)
            # Without remote readers the socket is not used, so its descriptor's event is not lost.
            if not (self._latched or self._has_remote_readers):
                return
        frames = encode(message, header, max_bytes=self.topic.max_bytes)
        self._send(frames)
        if self._latched:
            self._last = frames
            self._serve_late_subscribers()
        elif self._channel is not None:
            events: Any = self._socket.getsockopt(EVENTS)
            if events & POLLIN:
                self._serve_late_subscribers()

    def _send(self, frames: list[Any]) -> None:
        # If a subscriber's queue is full, ZeroMQ drops the message. The subscriber counts a gap.
        send = self._socket.send
        if len(frames) == 1:
            send(frames[0], NOBLOCK)
        else:
            for frame in frames[:-1]:
                send(frame, NOBLOCK_MORE, copy=False)
            send(frames[-1], NOBLOCK, copy=False)

    def _serve_late_subscribers(self) -> None:
        """Read a batch of subscriptions, and send the stored message to new subscribers.

        If the topic is not latched, no message is stored. The subscriptions then only show whether
        another process reads the topic.
        """
        if self._socket.closed or self._loop is None:
            return
        found = drained = False
        for _ in range(BATCH):
            try:
                self._has_remote_readers = self._socket.recv(zmq.NOBLOCK)[:1] == b"\x01"
                found |= self._has_remote_readers
            except zmq.Again:
                drained = True
                break
        if found and self._last is not None:
            self._send(self._last)
            # `_send` may have cleared the event of another subscription, so check again.
            drained = False
        if not drained and not self._loop.is_closed():
            self._loop.call_soon(self._serve_late_subscribers)

    def forget(self) -> None:
        """Discard the message that is stored for late subscribers."""
        self._last = None
        if self._channel is not None:
            self._channel.forget()

    def close(self) -> None:
        """Release the endpoints of the publisher.

        Messages that were sent earlier are delivered for up to half a second.
        """
        if self._socket.closed:
            return
        for endpoint in self.endpoints:
            # ZeroMQ does not remove the socket file. No other publisher can own it before the
            # close.
            if endpoint.startswith(IPC):
                Path(endpoint.removeprefix(IPC)).unlink(missing_ok=True)
        self._close_socket(unbind=False)
        self._unregister_keys()

    def _close_socket(self, *, unbind: bool) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.remove_reader(self._socket.fileno())
        if unbind:
            for endpoint in self.endpoints:
                self._socket.unbind(endpoint)
        self._socket.close(linger=LINGER_MS)

    def _unregister_keys(self) -> None:
        if self._domain is not None:
            ZapAuthenticator.unregister(self._domain)
            self._domain = None


class Subscriber:
    """A subscriber of one topic, which calls `on_message(message, header)` in the event loop.

    connect: endpoints of all nodes that publish the topic. A node can start after the subscriber,
        and can restart.
    counts: counters of superseded, lost and rejected messages.
    on_problem: function that is called with a text about a problem: the first rejection for each
        cause, and each exception in `on_message`. Lost messages are reported each time their number
        has doubled, except on topics with the delivery `latest`.
    on_handshake_failed: function that is called with a text for each kind of failed handshake. If
        None, `on_problem` is called.
    raw: whether `on_message(frames, header)` is called with the ZeroMQ frames (parts) of every
        message. The fields are then neither decoded nor validated.
    keys: keys of this host and of the other hosts. If None, tcp connects to the loopback interface
        only.
    plan: hash of the resolved launch file whose messages are accepted. If None, all messages are
        accepted.
    message_filter: function that returns the reason to reject a valid message, or None.
    on_disconnected: function that is called when a connection has ended, after its last message.
    local: bus that delivers messages from nodes in this process; not used if `raw` is true.
    """

    def __init__(
        self,
        topic: Topic,
        connect: Sequence[str | Source],
        on_message: Handler,
        counts: Counts,
        *,
        on_problem: Problem = _log.error,
        on_handshake_failed: Problem | None = None,
        raw: bool = False,
        keys: KeyRing | None = None,
        plan: str | None = None,
        message_filter: MessageFilter | None = None,
        on_disconnected: Callable[[], None] | None = None,
        local: LocalBus | None = None,
    ) -> None:
        self.on_disconnected = on_disconnected
        self.topic, self.counts, self.on_problem = topic, counts, on_problem
        self.on_handshake_failed = on_handshake_failed or on_problem
        self._on_message, self._message_filter, self._plan = on_message, message_filter, plan
        self._latched = topic.delivery is Delivery.LATCHED
        self._latest_only = latest_only = topic.delivery is Delivery.LATEST and not raw
        self._writers_seen: dict[str, _Writer] = {}
        self._reported_causes: set[str] = set()
        self._report_gaps_from = 1
        self._started = False
        sources = [one if isinstance(one, Source) else Source(one) for one in connect]
        bus = None if raw else local
        channels = {
            one: channel
            for one in sources
            if bus is not None and (channel := bus.find([one.endpoint])) is not None
        }
        by_host: dict[str | None, list[Source]] = {}
        for source in sources:
            if source not in channels:
                by_host.setdefault(source.host, []).append(source)
        self._connections: list[_HostConnection | LocalConnection] = [
            _HostConnection(self, host, remote, keys, latest_only=latest_only, raw=raw)
            for host, remote in by_host.items()
        ]
        if channels or not connect:
            self._connections.append(
                LocalConnection(
                    self,
                    tuple(channels.values()),
                    _list_writers(list(channels)),
                    max_waiting=compute_queue_length(topic),
                )
            )

    def start(self) -> None:
        """Connect to the endpoints, and start to deliver messages.

        This requires a running event loop.
        """
        if self._started:
            raise BusError(f'topic "{self.topic.name}": start() was called twice; call it once')
        try:
            for connection in self._connections:
                connection.open()
        except BaseException:
            self.close()
            raise
        self._started = True

    def close(self) -> None:
        """Disconnect from all endpoints. The message handler may call this method."""
        for connection in self._connections:
            connection.close()

    def accept(self, frames: list[Any], writers: frozenset[str] | None) -> Envelope | None:
        """Decode and check the header of a message, and count messages that were lost before it.

        Return None if the message is rejected, or if it has arrived before.

        writers: names of the nodes that may publish at the endpoint; None means any node.
        """
        try:
            envelope = read_envelope(frames, self.topic)
        except WireError as error:
            self.reject(error)
            return None
        return envelope if self.accept_header(envelope.header, writers) else None

    def accept_header(self, header: Header, writers: frozenset[str] | None) -> bool:
        """Check the header of a message, and count the messages that were lost before it.

        Return False if the message is rejected, or if it has arrived before.

        writers: names of the nodes that may publish at the endpoint; None means any node.
        """
        try:
            if writers is not None and header.writer not in writers:
                raise WireError(
                    "writer",
                    f"the message names the writer {header.writer!r:.60}, but only "
                    f"{', '.join(sorted(writers))} may write to this endpoint",
                )
            if self._plan is not None and header.plan != self._plan:
                raise WireError(
                    "plan",
                    f"{header.writer} runs plan {header.plan!r:.40}, this node runs "
                    f"{self._plan}; start all hosts with the same launch file, scene and settings",
                )
            known = self._writers_seen.get(header.writer)
            if known is None:
                self._writers_seen[header.writer] = _Writer(header)
                return True
            lost = known.update(header)
        except WireError as error:
            self.reject(error)
            return False
        if lost > 0:
            self._count_gap(lost, header.writer)
        elif lost < 0:
            if not (self._latched and lost == -1):
                self.reject(
                    WireError(
                        "replayed", f"message {header.sequence} of {header.writer} arrived again"
                    )
                )
            return False
        return True

    def deliver(self, envelope: Envelope) -> None:
        """Validate the fields of a message, and call the handler with the message."""
        header = envelope.header
        try:
            message = envelope.open()
            reason = None if self._message_filter is None else self._message_filter(message, header)
            if reason is not None:
                raise WireError("forbidden", reason)
        except WireError as error:
            self.reject(error)
            return
        self.call(message, header)

    def call(self, message: Any, header: Header) -> None:
        """Call the message handler, and report an exception that the handler raises."""
        try:
            self._on_message(message, header)
        except Exception as error:
            _log.exception('the handler of topic "%s" raised an exception', self.topic.name)
            self.on_problem(
                f'topic "{self.topic.name}": the handler of a message failed: '
                f"{type(error).__name__}: {error}"
            )

    def reject(self, error: WireError) -> None:
        """Count a rejected message. Report only the first rejection for each cause."""
        self.counts.rejected += 1
        if error.cause not in self._reported_causes:
            self._reported_causes.add(error.cause)
            self.on_problem(f'topic "{self.topic.name}": a message was refused: {error}')

    def _count_gap(self, lost: int, writer: str) -> None:
        if self._latest_only:
            # The short queue was full, and a newer message replaces the missing ones.
            self.counts.dropped += lost
            return
        self.counts.gaps += lost
        delivers_newest = self.topic.delivery is Delivery.LATEST
        if not delivers_newest and self.counts.gaps >= self._report_gaps_from:
            self._report_gaps_from = 2 * self.counts.gaps
            self.on_problem(
                f'topic "{self.topic.name}": {lost} messages of {writer} were lost, '
                f"{self.counts.gaps} in total; a subscriber or the network is too slow"
            )


class _Writer:
    """The epoch (start time) and the newest sequence number of a node that writes messages.

    A subscriber uses these values to reject copies of old messages. A node that restarts on the
    same clock has a later epoch. After a reboot of its host, the node has a new clock identifier,
    and messages with an earlier clock identifier are rejected.
    """

    __slots__ = ("clock_id", "epoch", "past_clocks", "sequence")

    def __init__(self, header: Header) -> None:
        self.clock_id, self.epoch, self.sequence = header.clock_id, header.epoch, header.sequence
        self.past_clocks: deque[str] = deque(maxlen=MAX_PAST_CLOCKS)

    def update(self, header: Header) -> int:
        """Store the header of a new message, and return the number of messages lost before it.

        A result of -1 means that the newest message was received again. Other negative results mean
        that an older message was received. Raises WireError for a message that was sent before the
        latest restart of its node.
        """
        if header.clock_id != self.clock_id:
            if header.clock_id in self.past_clocks:
                raise WireError(
                    "replayed", f"a message of {header.writer} was sent before its host restarted"
                )
            self.past_clocks.append(self.clock_id)
            self.clock_id = header.clock_id
        elif header.epoch == self.epoch:
            lost = header.sequence - self.sequence - 1
            if lost >= 0:
                self.sequence = header.sequence
            return lost
        elif header.epoch < self.epoch:
            raise WireError(
                "replayed",
                f"a message from {header.writer} was sent before the writer's last restart",
            )
        self.epoch, self.sequence = header.epoch, header.sequence
        return 0


def _list_writers(sources: Sequence[Source]) -> frozenset[str] | None:
    """Return the names of the nodes that publish at endpoints, or None if one is unknown."""
    known = [one.writer for one in sources if one.writer is not None]
    return frozenset(known) if len(known) == len(sources) > 0 else None


class _HostConnection:
    """A subscriber's socket for the messages of one host."""

    def __init__(
        self,
        subscriber: Subscriber,
        host: str | None,
        sources: list[Source],
        keys: KeyRing | None,
        *,
        latest_only: bool,
        raw: bool,
    ) -> None:
        self._subscriber, self.host, self._sources, self._keys = subscriber, host, sources, keys
        self._latest_only, self._raw = latest_only, raw
        rate_hz = subscriber.topic.rate_hz
        self._fresh_ns = 0 if rate_hz is None else int(0.5e9 / rate_hz[1])
        self._writers = _list_writers(sources)
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._reported_events: set[int] = set()
        self._disconnected: set[bytes] = set()

    @property
    def closed(self) -> bool:
        return self._socket is None or self._socket.closed

    @property
    def secured(self) -> bool:
        """Return whether the connection is encrypted and authenticated by keys."""
        return self._keys is not None and self.host is not None

    def open(self) -> None:
        topic = self._subscriber.topic
        self._loop = asyncio.get_running_loop()
        self._socket = _open_socket(zmq.SUB, topic)
        try:
            if self._raw:
                # A recorder has low priority and may pause for seconds on a busy computer. If its
                # queue were full, it could not read the publisher's heartbeats. The publisher would
                # then disconnect, and libzmq would abort the process as described at `HEARTBEATS`.
                self._socket.setsockopt(zmq.RCVHWM, 0)
            self._socket.setsockopt(zmq.SUBSCRIBE, b"")
            if self._subscriber.on_disconnected is not None:
                self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, WATCHED_RECONNECT_MS)
            if self.secured or self._subscriber.on_disconnected is not None:
                self._monitor = self._socket.get_monitor_socket(MONITORED_EVENTS)
                self._loop.add_reader(self._monitor.fileno(), self._handle_monitor_events)
                self._loop.call_soon(self._handle_monitor_events)
            for source in self._sources:
                _check_endpoint(topic, source.endpoint)
                if self._keys is not None and self.host is not None:
                    self._keys.set_client_keys(self._socket, self.host)
                else:
                    _refuse_beyond_loopback(topic, source.endpoint)
                try:
                    self._socket.connect(source.endpoint)
                except zmq.ZMQError as error:
                    raise BusError(
                        f'topic "{topic.name}": cannot connect to {source.endpoint}: '
                        f"{error.strerror}"
                    ) from error
        except BaseException:
            self.close()
            raise
        self._loop.add_reader(self._socket.fileno(), self._read)
        # The calls above may have cleared the first signal.
        self._loop.call_soon(self._read)

    def close(self) -> None:
        if self._socket is None or self._socket.closed:
            return
        opened = [one for one in (self._socket, self._monitor) if one is not None]
        if self._loop is not None and not self._loop.is_closed():
            for one in opened:
                self._loop.remove_reader(one.fileno())
        if self._monitor is not None:
            self._socket.disable_monitor()
            self._monitor = None
        for one in opened:
            one.close(linger=0)
        self._disconnected.clear()

    def _handle_monitor_events(self) -> None:
        """Report the end of a connection, and connect again.

        This method is a callback of the event loop. ZeroMQ itself does not reconnect after a
        rejected key or after corrupted data.
        """
        while self._monitor is not None:
            try:
                event_fields = parse_monitor_message(self._monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
            event, endpoint = int(event_fields["event"]), bytes(event_fields["endpoint"])
            if event in RECONNECTED:
                self._disconnected.discard(endpoint)
                continue
            self._disconnected.add(endpoint)
            if event == zmq.EVENT_DISCONNECTED and self._subscriber.on_disconnected is not None:
                # Messages that arrived before the end of the connection are delivered first.
                self._read()
                self._subscriber.on_disconnected()
            if self._loop is not None:
                self._loop.call_later(REOPEN_DELAY_S, self._reopen, self._socket)
            if event in HANDSHAKE_FAILED and event not in self._reported_events:
                self._reported_events.add(event)
                self._subscriber.on_handshake_failed(
                    f'topic "{self._subscriber.topic.name}": host {self.host} '
                    f"{HANDSHAKE_FAILED[event]}"
                )

    def _reopen(self, lost: zmq.Socket[bytes] | None) -> None:
        if lost is self._socket and self._disconnected and not self.closed:
            self.close()
            self.open()

    def _read(self) -> None:
        if self._socket is None or self._socket.closed or self._loop is None:
            return
        drained = False
        try:
            drained = self._deliver_newest() if self._latest_only else self._deliver_every()
        finally:
            if not drained and not self._socket.closed:
                self._loop.call_soon(self._read)

    def _deliver_newest(self) -> bool:
        """Deliver the newest message of each node, and skip older messages without validating them.

        The first message is delivered at once if it is younger than half the period of the topic.
        Return whether the socket has no more messages.
        """
        newest: dict[str, Envelope] = {}
        drained = False
        for number in range(BATCH):
            # Checking for events takes less time than the exception of a `recv` without a message.
            if number and not self._has_more():
                drained = True
                break
            frames = self._receive()
            if frames is None:
                drained = True
                break
            envelope = self._subscriber.accept(frames, self._writers)
            if envelope is None:
                continue
            header = envelope.header
            if not number and 0 <= time.monotonic_ns() - header.publish_ns < self._fresh_ns:
                # No newer message can have arrived yet, so the socket's events need not be checked
                # first. With timestamps of another clock, an older message may be delivered before
                # a newer one.
                self._deliver(envelope)
                continue
            # Remove the superseded entry first, so that the dictionary stays in order of arrival.
            self._subscriber.counts.dropped += newest.pop(header.writer, None) is not None
            newest[header.writer] = envelope
        for envelope in newest.values():
            self._deliver(envelope)
        return drained

    def _deliver_every(self) -> bool:
        for _ in range(BATCH):
            frames = self._receive()
            if frames is None:
                return True
            envelope = self._subscriber.accept(frames, self._writers)
            if envelope is not None and self._raw:
                self._subscriber.call(frames, envelope.header)
            elif envelope is not None:
                self._deliver(envelope)
        return False

    def _deliver(self, envelope: Envelope) -> None:
        if self._socket is not None and not self._socket.closed:
            self._subscriber.deliver(envelope)

    def _has_more(self) -> bool:
        if self._socket is None or self._socket.closed:
            return False
        events: Any = self._socket.getsockopt(EVENTS)
        return bool(events & POLLIN)

    def _receive(self) -> list[Any] | None:
        """Return the frames of one message without copying them, or None if there is no message."""
        if self._socket is None or self._socket.closed:
            return None
        try:
            frame = self._socket.recv(NOBLOCK, copy=False)
        except zmq.Again:
            return None
        frames = [frame]
        while frame.more:
            frame = self._socket.recv(NOBLOCK, copy=False)
            frames.append(frame)
        return frames


def _open_socket(kind: int, topic: Topic) -> zmq.Socket[bytes]:
    opened: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    length = compute_queue_length(topic)
    options = {
        zmq.SNDHWM: length,
        zmq.RCVHWM: length,
        zmq.LINGER: LINGER_MS,
        zmq.RECONNECT_IVL: 20,
        zmq.RECONNECT_IVL_MAX: RECONNECT_MS,
        # ZeroMQ closes connections that do not complete the handshake in this time.
        zmq.HANDSHAKE_IVL: HANDSHAKE_MS,
    }
    if kind == zmq.SUB:
        # If a frame exceeds MAXMSGSIZE, ZeroMQ ends the connection permanently without a report.
        # Frames that exceed the topic's limit only slightly are therefore received, rejected and
        # counted.
        options[zmq.MAXMSGSIZE] = topic.max_bytes + MAX_EXCESS_BYTES
        options |= TCP_KEEPALIVE_OPTIONS
    else:
        # A publisher receives only subscriptions and handshakes. If a queue is full when its sender
        # disconnects, libzmq 4.3.5 aborts the process at the next heartbeat, so it has no limit.
        options[zmq.MAXMSGSIZE] = MAX_SUBSCRIPTION_BYTES
        options[zmq.RCVHWM] = 0
    for option, value in options.items():
        opened.setsockopt(option, value)
    return opened


def _bind(opened: zmq.Socket[bytes], topic: Topic, endpoint: str, *, keys: KeyRing | None) -> str:
    """Bind a publisher's socket to an endpoint.

    Return the endpoint with the actual port number instead of "*". Raises BusError if the socket
    cannot be bound.
    """
    _check_endpoint(topic, endpoint)
    if keys is None:
        _refuse_beyond_loopback(topic, endpoint)
    deadline_s = time.monotonic() + BIND_TIMEOUT_S
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
                    "check that its folder or address exists on this host"
                ) from error
            # ZeroMQ's thread may release the endpoint of a closed writer slightly later, so retry.
            if time.monotonic() > deadline_s:
                raise BusError(
                    f'topic "{topic.name}": {endpoint} is in use by another process; '
                    "end the other run of this launch file"
                ) from error
            time.sleep(0.01)
    bound: str = opened.getsockopt_string(zmq.LAST_ENDPOINT)
    return bound


def _check_endpoint(topic: Topic, endpoint: str) -> None:
    """Raise BusError if an endpoint is invalid.

    ZeroMQ accepts some invalid endpoints, and reports others with unclear errors.
    """
    transport, _, address = endpoint.partition("://")
    port = address.rpartition(":")[2]
    if transport == "tcp" and port != "*" and not (port.isdecimal() and 0 < int(port) < 1 << 16):
        raise BusError(
            f'topic "{topic.name}": {endpoint}: the port must be a number from 1 to 65535'
        )
    if transport == "ipc" and len(os.fsencode(address)) > IPC_PATH_BYTES:
        raise BusError(
            f'topic "{topic.name}": the path of {endpoint} has {len(os.fsencode(address))} bytes, '
            f"but the system allows only {IPC_PATH_BYTES}; set FLEXSHEET_RUNS to a shorter path"
        )
    if transport not in ("tcp", "ipc"):
        raise BusError(
            f'topic "{topic.name}": {endpoint} is invalid; expected ipc:///path or tcp://host:port'
        )


def _refuse_beyond_loopback(topic: Topic, endpoint: str) -> None:
    """Raise BusError if other hosts can reach a tcp endpoint."""
    transport, _, address = endpoint.partition("://")
    if transport != "tcp":
        return
    try:
        host = address.rpartition(":")[0].strip("[]")
        inside = ipaddress.ip_address(host).is_loopback
    except ValueError:
        inside = False
    if not inside:
        raise BusError(
            f'topic "{topic.name}": other hosts can reach {endpoint}, but there are no keys; '
            "create keys with: flexsheet keys"
        )


def _ipc_is_served(endpoint: str) -> bool:
    """Return whether another process already listens at an ipc endpoint.

    Binding the same endpoint would disconnect the other process.
    """
    path = endpoint.removeprefix(IPC)
    if path == endpoint or path.startswith("@"):
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            # The file was left by a killed publisher, or a publisher that is closing will remove
            # it.
            time.sleep(IPC_CLOSING_S)
            return False
        except OSError:
            return False
    return True
