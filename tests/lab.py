"""A lab of three computers: namespaces at a bad switch, each with its own launcher and keys.

What runs is `launch/three.yaml` by the `flexsheet` command, as in a lab; the test looks on through
the launchers' ipc sockets, which lie in this file system, and reads the bags afterwards.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Self

import pytest
from ruamel.yaml import YAML
from ruamel.yaml.scalarstring import SingleQuotedScalarString

from launch.plans.plan import load_plan
from launch.plans.planned import Plan
from launch.running.estop_file import STATE_VARIABLE
from launch.running.keys import KEYS_VARIABLE
from launch.running.runs import ROOT_VARIABLE
from messages.base import Header, Message
from messages.bus import Subscriber
from messages.security import new_key_pair, write_secret
from messages.topics import topic_named
from messages.types import ArmState, HostStatus
from nodes.node import PortCounts

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = ROOT / "launch" / "systemd" / "90-flexsheet.conf"
HOSTS = ("main", "left", "right")
ADDRESS = {name: f"10.77.0.{number}" for number, name in enumerate(HOSTS, start=1)}
LIGHT = ("fem_solver", "renderer")
"""What is seen is not what these tests are about; a busy computer is better off without."""


def missing() -> str | None:
    """Why there can be no such lab here, or None."""
    name = f"fs{os.getpid()}-try"
    try:
        _ip("netns", "add", name)
        _ip("netns", "del", name)
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except (OSError, subprocess.CalledProcessError) as error:
        return f"three computers cannot be played here (root, namespaces, /dev/net/tun): {error}"
    return None


class Network:
    """Namespaces named after computers, at a switch whose cables can be spoilt; while entered.

    addresses: of each computer, in one /24.
    """

    def __init__(self, tag: str, addresses: Mapping[str, str]) -> None:
        self._tag, self._addresses = tag, addresses

    def space(self, name: str) -> str:
        return f"{self._tag}-{name}"

    async def __aenter__(self) -> Self:
        spaces = [self.space(name) for name in self._addresses]
        for space in spaces:
            _ip("netns", "add", space)
        self._switch = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.switch", *spaces, cwd=ROOT,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        assert self._switch.stdout is not None
        assert await self._switch.stdout.readline() == b"ready\n"
        for name, address in self._addresses.items():
            space = self.space(name)
            _ip("-n", space, "link", "set", "lo", "up")
            _ip("-n", space, "addr", "add", f"{address}/24", "dev", "eth")
            _ip("-n", space, "link", "set", "eth", "up")
            # As docs/deploy.md has it for real ones.
            _ip("netns", "exec", space, "sysctl", "-q", "-e", "-p", str(SETTINGS))
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._switch.stdin is not None
        self._switch.stdin.close()
        await self._switch.wait()
        for name in self._addresses:
            _ip("netns", "del", self.space(name))

    async def cable(self, host: str, **values: Any) -> None:
        """Set what the cable of a computer does to frames; nothing: it is a good one."""
        assert self._switch.stdin is not None
        assert self._switch.stdout is not None
        self._switch.stdin.write(json.dumps({self.space(host): values}).encode() + b"\n")
        await self._switch.stdin.drain()
        assert await self._switch.stdout.readline() == b"done\n"


class Lab:
    """Use as an async context manager; skips the test where it cannot be.

    without: nodes that are left out.  arming, bridge: parameters of both bridges.
    watchdog_s: of both arms.
    """

    def __init__(
        self,
        *,
        without: Collection[str] = LIGHT,
        arming: str = "by_itself",
        watchdog_s: float = 0.1,
        **bridge: Any,
    ) -> None:
        if why := missing():
            pytest.skip(why)
        self.folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
        self.launch_file = self.folder / "launch" / "three.yaml"
        self.newest: dict[str, Message] = {}
        self.seen: list[tuple[str, Message]] = []
        self._write_launch_file(without, {"arming": arming, **bridge}, watchdog_s)
        self.launchers: dict[str, subprocess.Popen[bytes]] = {}
        self._subscribers: dict[str, list[Subscriber]] = {}
        self.network = Network(f"fs{os.getpid()}", ADDRESS)

    def _write_launch_file(
        self, without: Collection[str], bridge: dict[str, Any], watchdog_s: float
    ) -> None:
        shutil.copytree(ROOT / "launch", self.launch_file.parent, ignore=_only_data)
        yaml = YAML()
        values = yaml.load(self.launch_file)
        for name in without:
            del values["nodes"][name]
        if "fem_solver" in without:
            values["nodes"]["planner"]["topics"] = {"soft_body": None}
        for side in ("left", "right"):
            values["nodes"][f"arm_{side}_bridge"]["parameters"].update(bridge)
            values["nodes"][f"twin_{side}"]["parameters"]["watchdog_s"] = watchdog_s
            # The arm's own record, which no network can spoil.
            values["nodes"][f"record_{side}"] = {
                "type": "recorder",
                "host": side,
                "parameters": {
                    "bag": str(self.bag(side)),
                    "topics": [f"arm_{side}", f"twin/arms_{side}"],
                },
            }
        values["record"] = {"bag": str(self.bag("main"))}
        for host in HOSTS:
            public, secret = new_key_pair()
            write_secret(self.folder / host / "keys" / f"{host}.secret", secret)
            values["hosts"][host]["key"] = SingleQuotedScalarString(public)
        yaml.dump(values, self.launch_file)

    def bag(self, host: str) -> Path:
        return self.folder / f"{host}.mcap"

    async def __aenter__(self) -> Self:
        await self.network.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        try:
            self._close_subscribers(*self._subscribers)
            running = [one for one in self.launchers.values() if one.poll() is None]
            for process in running:
                process.send_signal(signal.SIGINT)
            for process in running:
                await asyncio.to_thread(process.wait, 40)
        finally:
            await self.network.__aexit__()
            shutil.rmtree(self.folder)

    def _environment(self, host: str) -> dict[str, str]:
        return {
            **os.environ,
            ROOT_VARIABLE: str(self.folder / host / "r"),
            KEYS_VARIABLE: str(self.folder / host / "keys"),
            STATE_VARIABLE: str(self.folder / host / "state"),
        }

    def command(self, host: str, *arguments: str) -> list[str]:
        flexsheet = [sys.executable, str(ROOT / "flexsheet.py")]
        return ["ip", "netns", "exec", self.network.space(host), *flexsheet, *arguments]

    def start(self, *hosts: str) -> None:
        """`flexsheet launch` on those hosts."""
        for host in hosts:
            log = (self.folder / f"{host}.log").open("ab")
            self.launchers[host] = subprocess.Popen(
                self.command(host, "launch", str(self.launch_file), "--host", host),
                env=self._environment(host), cwd=self.folder, stdout=log, stderr=log,
            )  # fmt: skip
            log.close()

    async def run(self, host: str, *arguments: str) -> tuple[int, str]:
        """Run a command there; its exit code and words."""
        process = await asyncio.create_subprocess_exec(
            *self.command(host, *arguments), env=self._environment(host), cwd=self.folder,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        output, _ = await process.communicate()
        assert process.returncode is not None
        return process.returncode, output.decode()

    async def cable(self, host: str, **values: Any) -> None:
        """As that of `Network`."""
        await self.network.cable(host, **values)

    def run_directory(self, host: str) -> Path | None:
        """Of the newest launcher there that has got so far as to write its plan."""
        found = sorted(
            (self.folder / host / "r").glob("*/plan.json"), key=lambda path: path.stat().st_mtime_ns
        )
        return found[-1].parent if found else None

    def plan(self) -> Plan:
        return load_plan(self.launch_file)

    async def watch(self, host: str, *topics: str) -> None:
        """Take what a host's own writers of these topics say, as soon as its launcher runs."""
        process = self.launchers[host]
        known = self._subscribers.pop(host, [])
        for subscriber in known:
            subscriber.close()
        mark = f"{process.pid}."

        def ready() -> bool:
            directory = self.run_directory(host)
            return directory is not None and directory.name.startswith(mark)

        await self.until(ready, f"the launcher of {host}")
        directory = self.run_directory(host)
        assert directory is not None
        plan = self.plan()
        subscribers = []
        for topic in topics:
            ends = [
                writer.ipc.replace("@run", str(directory))
                for writer in plan.writers[topic]
                if writer.host == host and writer.name != "tools"
            ]
            subscriber = Subscriber(topic_named(topic), ends, self._take(topic, host), PortCounts())
            subscriber.start()
            subscribers.append(subscriber)
        self._subscribers[host] = subscribers

    def _take(self, topic: str, host: str) -> Callable[[Message, Header], None]:
        key = f"host {host}" if topic == "host" else topic

        def take(message: Message, header: Header) -> None:
            self.newest[key] = message
            if isinstance(message, ArmState):
                self.seen.append((topic, message))

        return take

    def _close_subscribers(self, *hosts: str) -> None:
        for host in hosts:
            for subscriber in self._subscribers.pop(host, []):
                subscriber.close()

    async def start_all(self) -> None:
        """All three up, and both arms with their bridges heard of."""
        self.start(*HOSTS)
        for host in HOSTS:
            await self.watch_usual(host)

    async def watch_usual(self, host: str) -> None:
        arm = [f"arm_{host}"] if host != "main" else ["sheet_target", "twin/finger"]
        await self.watch(host, "host", *arm)

    def status(self, host: str) -> HostStatus | None:
        found = self.newest.get(f"host {host}")
        return found if isinstance(found, HostStatus) else None

    def modes(self) -> set[str]:
        arms = [self.newest.get(f"arm_{side}") for side in ("left", "right")]
        return {arm.mode if isinstance(arm, ArmState) else "none" for arm in arms}

    async def until(
        self, condition: Callable[[], bool], what: str, *, within_s: float = 60.0
    ) -> None:
        loop = asyncio.get_running_loop()
        end_s = loop.time() + within_s
        while not condition():
            for host, process in self.launchers.items():
                log = self.folder / f"{host}.log"
                assert process.poll() in (None, 0, -9), f"{host}:\n{log.read_text()[-3000:]}"
            assert loop.time() < end_s, f"waited in vain for {what}: {self._state()}"
            await asyncio.sleep(0.01)

    def _state(self) -> str:
        arms = [self.newest.get(f"arm_{side}") for side in ("left", "right")]
        said = [(arm.mode, arm.reason, arm.faults) for arm in arms if isinstance(arm, ArmState)]
        logs = [(self.folder / f"{host}.log") for host in HOSTS]
        return f"{said}\n" + "\n".join(log.read_text()[-1500:] for log in logs if log.exists())


def _only_data(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name.endswith(".py") or name in ("__pycache__", "commands")]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
