"""Receive e-stops on a unix socket of a launcher or a node.

All tools share one endpoint of the topic `estop`, and only one command-line tool at a time can use
that endpoint. Many tools can connect to this socket at the same time. Each tool sends one line and
receives an answer. This module imports only small modules, so that the tools start quickly.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

SUFFIX = ".stop"
Kind = Literal["launcher", "node"]
REQUEST, ANSWER = b"stop ", b"stopped"
MAX_REQUEST_BYTES = 4096


class StopSocket:
    """A unix socket that receives e-stops and calls `on_stop(reason)` for each e-stop.

    Only processes of the same user or of root may connect.
    """

    def __init__(
        self, directory: Path, kind: Kind, name: str, on_stop: Callable[[str], None]
    ) -> None:
        self._path, self._on_stop = directory / f"{name}.{kind}{SUFFIX}", on_stop
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def open(self) -> None:
        """Open the socket, and accept connections in the running event loop.

        Raises OSError if the path of the socket is too long.
        """
        self._path.unlink(missing_ok=True)
        self._server = await asyncio.start_unix_server(
            self._answer, self._path, limit=MAX_REQUEST_BYTES, start_serving=False
        )
        self._path.chmod(0o600)
        # If this call is cancelled, `close` closes the server.
        await self._server.start_serving()

    def close(self) -> None:
        """Close the socket, and remove its file. This has no effect on a closed socket."""
        if self._server is not None:
            self._path.unlink(missing_ok=True)
            self._server.close()
            self._server = None
        for writer in self._writers:
            writer.transport.abort()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        # The peer may send a line that is too long, or close before the answer.
        with suppress(ValueError, ConnectionError):
            request = await reader.readline()
            if request.startswith(REQUEST) and self._server is not None:
                self._on_stop(request.removeprefix(REQUEST).decode(errors="replace").strip())
                writer.write(ANSWER)
                await writer.drain()
        self._writers.discard(writer)
        writer.close()
