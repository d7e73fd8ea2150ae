"""Close tcp connections on which a publisher receives more data than a subscriber sends.

A ZeroMQ publisher stores every subscription that a peer sends. A stored subscription needs about 45
times as much memory as the received data. The subscriptions are stored in the call that sends the
next message. This call does not return while more subscriptions arrive. ZeroMQ has no option that
limits the number of subscriptions or the number of frames in a message.

A subscriber of this package sends only a handshake, one subscription, and one reply to each
heartbeat. A thread therefore counts the bytes that the kernel has received on each accepted
connection (TCP_INFO). The thread closes a connection that has received too many bytes. The thread
sleeps until data arrives (edge-triggered epoll), so it needs no processor time while peers send
nothing.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from typing import ClassVar

import zmq
from zmq.utils.monitor import parse_monitor_message

MAX_BYTES_AT_ONCE = 4096
"""The number of bytes that a new connection may receive immediately.

A CURVE handshake and a subscription have 900 bytes together.
"""

MAX_BYTES_PER_S = 256
"""The number of bytes per second that a connection may receive after the handshake.

An encrypted reply to a heartbeat has 40 bytes and is sent once per second.
"""

MAX_CONNECTIONS_PER_ADDRESS = 64
"""The maximum number of connections to a publisher from one network address.

The nodes, the recorder and the tools of one computer need fewer connections.
"""

EXCLUSION_S = 1.0
"""The time (s) for which a publisher refuses an address that has sent too much data."""

RECEIVE_BUFFER_BYTES = 16_384
"""The size (bytes) of the receive buffer of a connection.

ZeroMQ still reads the content of this buffer after the connection has been closed.
"""

THREAD_NAME = "connection guard"
TCP_INFO_FORMAT, TCP_INFO_BYTES_RECEIVED = "=Q", 128

OnRefused = Callable[[str, str], None]
"""A function that is called with the address of a refused peer and the reason.

The thread of the connection guard calls the function.
"""


@dataclass(frozen=True, slots=True)
class _Publisher:
    monitor: zmq.Socket[bytes]
    on_refused: OnRefused


@dataclass(frozen=True, slots=True)
class _Connection:
    """An accepted connection, identified by its local and remote address.

    A file descriptor does not identify a connection, because the system reuses descriptors.
    """

    publisher: _Publisher
    local: tuple[object, ...]
    remote: tuple[object, ...]
    accepted_s: float

    @property
    def address(self) -> str:
        return str(self.remote[0])

    def open(self, fd: int) -> socket.socket | None:
        """Return a duplicate of the socket with the file descriptor `fd`.

        Return None if the connection has ended, or if another connection now uses the descriptor.
        """
        try:
            opened = socket.socket(fileno=os.dup(fd))
        except OSError:
            return None
        if _ends(opened) == (self.local, self.remote):
            return opened
        opened.close()
        return None


class ConnectionGuard:
    """A thread that monitors the accepted connections of all publishers of this process."""

    _present: ClassVar[ConnectionGuard | None] = None
    _lock: ClassVar[threading.Lock] = threading.Lock()
    _numbers = count(1)

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._publishers: dict[int, _Publisher] = {}
        self._connections: dict[int, _Connection] = {}
        self._excluded_until_s: dict[tuple[int, str], float] = {}

    @classmethod
    def watch(cls, publisher: zmq.Socket[bytes], on_refused: OnRefused) -> None:
        """Watch all new connections to a publisher until the monitor of its socket is disabled.

        on_refused: function that is called with the peer's address and the reason of each refusal.
        """
        publisher.setsockopt(zmq.RCVBUF, RECEIVE_BUFFER_BYTES)
        events = int(zmq.EVENT_ACCEPTED | zmq.EVENT_MONITOR_STOPPED)
        monitor = publisher.get_monitor_socket(events, f"inproc://accepted-{next(cls._numbers)}")
        # ZeroMQ signals on the descriptor only after all earlier events have been read.
        monitor.getsockopt(zmq.EVENTS)
        with cls._lock:
            guard = cls._present
            if guard is None:
                guard = cls._present = ConnectionGuard()
                threading.Thread(target=guard._run, name=THREAD_NAME, daemon=True).start()
            fd = int(monitor.fileno())
            guard._publishers[fd] = _Publisher(monitor, on_refused)
            guard._epoll.register(fd, select.EPOLLIN)

    def _run(self) -> None:
        while True:
            for fd, _ in self._epoll.poll():
                publisher = self._publishers.get(fd)
                if publisher is None:
                    self._check(fd)
                elif not self._read_monitor(fd, publisher):
                    return

    def _read_monitor(self, fd: int, publisher: _Publisher) -> bool:
        """Register the new connections of a publisher. Return False if no publisher is left."""
        while True:
            try:
                news = parse_monitor_message(publisher.monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                return True
            if news["event"] == zmq.EVENT_MONITOR_STOPPED:
                return self._remove_publisher(fd, publisher)
            endpoint = news["endpoint"].decode()
            if endpoint.startswith("tcp:"):
                self._accept(int(news["value"]), int(endpoint.rpartition(":")[2]), publisher)

    def _accept(self, fd: int, port: int, publisher: _Publisher) -> None:
        """Watch a connection. Close it if its address is excluded or has too many connections."""
        with suppress(OSError), socket.socket(fileno=os.dup(fd)) as opened:
            local, remote = _ends(opened)
            if not remote or local[1] != port:
                return
            now_s = time.monotonic()
            connection = _Connection(publisher, local, remote, now_s)
            if self._excluded_until_s.get((id(publisher), connection.address), 0.0) > now_s:
                opened.shutdown(socket.SHUT_RDWR)
                return
            self._connections.pop(fd, None)
            if self._count(connection) >= MAX_CONNECTIONS_PER_ADDRESS:
                opened.shutdown(socket.SHUT_RDWR)
                publisher.on_refused(
                    connection.address,
                    f"this address has {MAX_CONNECTIONS_PER_ADDRESS} connections already",
                )
                return
            self._connections[fd] = connection
            with suppress(FileExistsError):
                self._epoll.register(fd, select.EPOLLIN | select.EPOLLET)
        self._check(fd)

    def _count(self, new: _Connection) -> int:
        """Return the number of other connections from the same address to the same publisher.

        Connections that have ended are removed from the table.
        """
        number = 0
        for fd, known in list(self._connections.items()):
            if known.publisher is new.publisher and known.address == new.address:
                opened = known.open(fd)
                if opened is None:
                    del self._connections[fd]
                else:
                    opened.close()
                    number += 1
        return number

    def _check(self, fd: int) -> None:
        """Close a connection if it has received more bytes than a subscriber sends."""
        connection = self._connections.get(fd)
        opened = None if connection is None else connection.open(fd)
        if connection is None or opened is None:
            self._connections.pop(fd, None)
            return
        with opened:
            info = opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
            (received,) = struct.unpack_from(TCP_INFO_FORMAT, info, TCP_INFO_BYTES_RECEIVED)
            now_s = time.monotonic()
            allowed = MAX_BYTES_AT_ONCE + MAX_BYTES_PER_S * (now_s - connection.accepted_s)
            if received <= allowed:
                return
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
        del self._connections[fd]
        publisher, address = connection.publisher, connection.address
        self._excluded_until_s[id(publisher), address] = now_s + EXCLUSION_S
        publisher.on_refused(
            address, f"it sent {received} bytes, more than a handshake and one subscription"
        )

    def _remove_publisher(self, fd: int, publisher: _Publisher) -> bool:
        """Stop monitoring the connections to a publisher. Return False if no publisher is left."""
        self._epoll.unregister(fd)
        for connected_fd, connection in list(self._connections.items()):
            if connection.publisher is publisher:
                del self._connections[connected_fd]
        for key in list(self._excluded_until_s):
            if key[0] == id(publisher):
                del self._excluded_until_s[key]
        with self._lock:
            del self._publishers[fd]
            publisher.monitor.close(linger=0)
            if self._publishers:
                return True
            type(self)._present = None
        self._epoll.close()
        return False


def _ends(opened: socket.socket) -> tuple[tuple[object, ...], tuple[object, ...]]:
    """Return the local and remote address of a connection, or empty tuples if it is closed."""
    try:
        local, remote = opened.getsockname(), opened.getpeername()
    except OSError:
        return (), ()
    if not (isinstance(local, tuple) and isinstance(remote, tuple)):
        return (), ()
    return local, remote
