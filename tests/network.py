"""A cable that can be cut: a TCP relay on the loopback."""

from __future__ import annotations

import asyncio
from contextlib import suppress


class Cut:
    """Relays every connection to a port; `half_open` swallows what is sent, both ways."""

    def __init__(self, target_port: int) -> None:
        self.half_open = False
        self.refuse = False
        self._target_port = target_port
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Cut:
        self._server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.close_all()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    def close_all(self) -> None:
        """Reset every connection, as when a plug is drawn at a switch."""
        for writer in self._writers:
            writer.transport.abort()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.refuse:
            writer.transport.abort()
            return
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target_port)
        pairs = ((reader, far_writer), (far_reader, writer))
        self._writers |= {writer, far_writer}
        tasks = {asyncio.create_task(self._pass_on(*pair)) for pair in pairs}
        self._tasks |= tasks
        await asyncio.wait(tasks)
        self._tasks -= tasks
        self._writers -= {writer, far_writer}

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(4096):
                if not self.half_open:
                    writer.write(data)
        writer.transport.abort()
