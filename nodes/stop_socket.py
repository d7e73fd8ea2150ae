"""Receive e-stops on a unix socket of a launcher or a node.

All tools share one endpoint of the topic `estop`, and only one command-line tool at a time can use
that endpoint. Many tools can connect to this socket at the same time. Each tool sends one packet
and receives an answer. This module imports only small modules, so that the tools start quickly.
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Literal

SUFFIX = ".stop"
Kind = Literal["launcher", "node"]
REQUEST, ANSWER = b"stop ", b"stopped"
MAX_REQUEST_BYTES = 4096
MAX_CONNECTIONS = 32
"""The maximum number of open connections. When a further connection opens, the oldest connection is
closed."""

_PEER = struct.Struct("3i")


class StopSocket:
    """A unix socket that receives e-stops and calls `on_stop(reason)` for each e-stop.

    Only processes of the same user or of root may connect.
    """

    def __init__(
        self, directory: Path, kind: Kind, name: str, on_stop: Callable[[str], None]
    ) -> None:
        self._path, self._on_stop = directory / f"{name}.{kind}{SUFFIX}", on_stop
        self._listener: socket.socket | None = None
        self._connections: list[socket.socket] = []

    def open(self) -> None:
        """Open the socket, and accept connections in the running event loop.

        Raises OSError if the path of the socket is too long.
        """
        self._path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            listener.bind(os.fspath(self._path))
            self._path.chmod(0o600)
            listener.listen(MAX_CONNECTIONS)
        except BaseException:
            listener.close()
            raise
        self._listener = listener
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(listener.fileno(), self._accept, listener)

    def close(self) -> None:
        """Close the socket, and remove its file. This has no effect on a closed socket."""
        if self._listener is None:
            return
        self._path.unlink(missing_ok=True)
        self._loop.remove_reader(self._listener.fileno())
        self._listener.close()
        self._listener = None
        for connection in list(self._connections):
            self._drop(connection)

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, _ = listener.accept()
        except BlockingIOError:
            return
        connection.setblocking(False)
        _, user = read_peer(connection)
        if user not in (os.getuid(), 0):
            connection.close()
            return
        if len(self._connections) >= MAX_CONNECTIONS:
            self._drop(self._connections[0])
        self._connections.append(connection)
        self._loop.add_reader(connection.fileno(), self._read, connection)

    def _read(self, connection: socket.socket) -> None:
        try:
            request = connection.recv(MAX_REQUEST_BYTES)
            if request.startswith(REQUEST):
                self._on_stop(request.removeprefix(REQUEST).decode(errors="replace"))
                connection.send(ANSWER)
        except (BlockingIOError, ConnectionError):
            # The peer has closed before the answer; a stop that it sent is engaged nevertheless.
            pass
        finally:
            self._drop(connection)

    def _drop(self, connection: socket.socket) -> None:
        self._connections.remove(connection)
        self._loop.remove_reader(connection.fileno())
        connection.close()


def read_peer(connection: socket.socket) -> tuple[int, int]:
    """Return the process ID and the user ID of the process at the other end of a unix socket."""
    packed = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
    process, user, _ = _PEER.unpack(packed)
    return process, user
