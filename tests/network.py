"""Simulate network faults: a TCP relay, and computers whose cables can be unplugged."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


class TcpRelay:
    """A relay to a TCP port. If `half_open` is true, the relay discards data in both directions."""

    def __init__(self, target_port: int) -> None:
        self.half_open = False
        self.refuse = False
        self._target_port = target_port
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> TcpRelay:
        self._server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
        self.port = int(self._server.sockets[0].getsockname()[1])
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.close_all()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    def close_all(self) -> None:
        """Reset every connection."""
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


class Computers:
    """A set of network namespaces that simulate computers at one switch.

    The system must permit namespaces; otherwise, `missing` returns the reason.
    """

    def __init__(self, *names: str) -> None:
        self.address = {name: f"10.77.0.{number}" for number, name in enumerate(names, start=1)}
        self._tag = f"fs{os.getpid()}"
        self._switch = f"{self._tag}-switch"

    @staticmethod
    def missing() -> str | None:
        name = f"fs{os.getpid()}-try"
        try:
            _ip("netns", "add", name)
            _ip("netns", "del", name)
            subprocess.run(["unshare", "--time", "--fork", "true"], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            return f"no namespaces of network and time can be made here: {error}"
        return None

    def __enter__(self) -> Computers:
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge", "up")
        for name in self.address:
            self._set_up(name)
        return self

    def __exit__(self, *_: object) -> None:
        for name in (*map(self._space, self.address), self._switch):
            _ip("netns", "del", name)

    def _set_up(self, name: str) -> None:
        space, address = self._space(name), self.address[name]
        # The card keeps its number whatever becomes of the system.
        card = "02:00:00:00:00:" + address.rpartition(".")[2].zfill(2)
        peer = ["peer", "eth", "netns", space, "address", card]
        _ip("netns", "add", space)
        _ip("-n", self._switch, "link", "add", name, "type", "veth", *peer)
        _ip("-n", self._switch, "link", "set", name, "master", "bridge", "up")
        _ip("-n", space, "link", "set", "lo", "up")
        _ip("-n", space, "addr", "add", f"{address}/24", "dev", "eth")
        _ip("-n", space, "link", "set", "eth", "up")

    def power_cut(self, name: str, *processes: subprocess.Popen[bytes]) -> None:
        """Remove a computer with its processes, without closing its connections."""
        self.plug(name, into_switch=False)
        for process in processes:
            process.kill()
            process.wait()
        _ip("-n", self._switch, "link", "del", name)
        _ip("netns", "del", self._space(name))

    def boot(self, name: str) -> None:
        """Restart a computer after a power cut, with its cable and address."""
        self._set_up(name)

    def plug(self, name: str, *, into_switch: bool) -> None:
        """Unplug or plug in the network cable of a computer."""
        _ip("-n", self._switch, "link", "set", name, "up" if into_switch else "down")

    def start(self, name: str, *arguments: str, ahead_s: int = 0) -> subprocess.Popen[bytes]:
        """Start a Python process on a computer.

        ahead_s: offset of the computer's clock, s.
        """
        command = ["ip", "netns", "exec", self._space(name)]
        if ahead_s:
            # Of a process of its own, which is why `end` speaks to a group of them.
            command += ["unshare", "--time", "--monotonic", str(ahead_s)]
            command += ["--fork", "--kill-child=SIGTERM"]
        return subprocess.Popen(
            [*command, sys.executable, *arguments],
            cwd=Path(__file__).parent.parent,
            start_new_session=True,
        )

    @staticmethod
    def end(process: subprocess.Popen[bytes]) -> None:
        """Terminate a process on a computer, and wait until the process has ended."""
        os.killpg(process.pid, signal.SIGTERM)

    def _space(self, name: str) -> str:
        return f"{self._tag}-{name}"


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
