"""Simulate a lab of three computers: network namespaces at a faulty switch, with launchers and
keys.

The `flexsheet` command runs `launch/three.yaml`. The test monitors it by the launchers' ipc
sockets, which are in this file system, and reads the bags afterwards.
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

import numpy as np
import pytest
from ruamel.yaml import YAML
from ruamel.yaml.scalarstring import SingleQuotedScalarString

from flexsheet.launch.experiments.stroke import STROKE_ANGLE_RAD, TREMOR_M, WANDER_M, object_pose
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.estop_file import STATE_VARIABLE
from flexsheet.launch.running.keys import KEYS_VARIABLE
from flexsheet.launch.running.runs import ROOT_VARIABLE, Run
from flexsheet.launch.running.tools import GraphWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.security import make_key_pair, write_secret
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import ArmState, FingerPath, HostStatus, TwinFinger
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.node import PortCounts
from tests.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = ROOT / "launch" / "systemd" / "90-flexsheet.conf"
HOSTS = ("main", "left", "right")
ADDRESS = {name: f"10.77.0.{number}" for number, name in enumerate(HOSTS, start=1)}
LIGHT = ("fem_solver", "renderer")
"""Nodes that these tests omit, to reduce the load of a busy computer."""

FINGER_PATH = "twin/finger_path"
STROKES = "strokes"
STROKE_S = 3.0
"""Duration of a stroke over 60 degrees. With delayed messages the arms' distance error grows with
speed; half of this time on bad cables would exceed the allowed twist of the sheet."""
STROKE_POINTS_HZ = 25


def missing() -> str | None:
    """Return the reason why the simulated lab cannot run on this computer, or None."""
    name = f"fs{os.getpid()}-try"
    try:
        _ip("netns", "add", name)
        _ip("netns", "del", name)
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except (OSError, subprocess.CalledProcessError) as error:
        return f"three computers cannot be played here (root, namespaces, /dev/net/tun): {error}"
    return None


class Network:
    """A set of network namespaces at a simulated switch, as a context manager.

    addresses: address of each computer, all in one /24 network.
    """

    def __init__(self, tag: str, addresses: Mapping[str, str]) -> None:
        self._tag, self._addresses = tag, addresses

    def space(self, name: str) -> str:
        return f"{self._tag}-{name}"

    async def __aenter__(self) -> Self:
        try:
            await self._connect()
        except BaseException:
            self._delete_spaces()
            raise
        return self

    def _delete_spaces(self) -> None:
        for name in self._addresses:
            _ip("netns", "del", self.space(name))

    async def _connect(self) -> None:
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

    async def __aexit__(self, *_: object) -> None:
        assert self._switch.stdin is not None
        self._switch.stdin.close()
        await self._switch.wait()
        self._delete_spaces()

    async def cable(self, host: str, **values: Any) -> None:
        """Set delay, loss and cut of a computer's cable; none for a good cable."""
        assert self._switch.stdin is not None
        assert self._switch.stdout is not None
        self._switch.stdin.write(json.dumps({self.space(host): values}).encode() + b"\n")
        await self._switch.stdin.drain()
        assert await self._switch.stdout.readline() == b"done\n"


def strokes_path(scene: Scene, *, count: int = 40) -> FingerPath:
    """Return a path of strokes around the cylinder, back and forth without a pause, that ends at
    the top.
    """
    times = np.linspace(0.0, count * STROKE_S, round(count * STROKE_S * STROKE_POINTS_HZ) + 1)
    angles = 0.5 * STROKE_ANGLE_RAD * (1.0 - np.cos(np.pi * times / STROKE_S))
    radius = require_cylinder(scene).radius_m
    points = np.column_stack([0.0 * angles, radius * np.sin(angles), radius * np.cos(angles)])
    return FingerPath(
        label=STROKES,
        times_s=times,
        positions_world_m=apply(object_pose(scene), points),
        wander_m=WANDER_M,
        tremor_m=TREMOR_M,
        joined_by="spline",
    )


class Lab:
    """A simulated lab of three computers, as an async context manager.

    Tests are skipped if the lab cannot run.

    without: nodes to omit.
    arming, bridge: parameters of both bridges.
    watchdog_s: watchdog time of both arms.
    """

    def __init__(
        self,
        *,
        without: Collection[str] = LIGHT,
        arming: str = "auto",
        watchdog_s: float = 0.1,
        **bridge: Any,
    ) -> None:
        if why := missing():
            pytest.skip(why)
        self.folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
        self.launch_file = self.folder / "launch" / "three.yaml"
        self.newest: dict[str, Message] = {}
        self.seen: list[tuple[str, Message]] = []
        self.listeners: list[Callable[[str, Message], None]] = []
        self._write_launch_file(without, {"arming": arming, **bridge}, watchdog_s)
        self.launchers: dict[str, subprocess.Popen[bytes]] = {}
        self._subscribers: dict[str, list[Subscriber]] = {}
        self._watched: dict[str, Path] = {}
        self._stroking: asyncio.Task[None] | None = None
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
            values["nodes"][f"twin_{side}"]["parameters"].update(
                watchdog_s=watchdog_s, joints_file=str(self.folder / f"{side}.joints")
            )
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
            public, secret = make_key_pair()
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
            if self._stroking is not None:
                self._stroking.cancel()
                await asyncio.gather(self._stroking, return_exceptions=True)
            self._close_subscribers(*self._subscribers)
            running = {host: one for host, one in self.launchers.items() if one.poll() is None}
            for process in running.values():
                process.send_signal(signal.SIGINT)
            unreachable = [host for host, one in running.items() if not await _ends(one)]
            assert not unreachable, (
                f"launchers on {unreachable} did not end after SIGINT and were killed"
            )
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
        flexsheet = [sys.executable, "-m", "flexsheet"]
        return ["ip", "netns", "exec", self.network.space(host), *flexsheet, *arguments]

    def start(self, *hosts: str, launch_file: Path | None = None) -> None:
        """Run `flexsheet launch` on some hosts, by default with the launch file of the lab."""
        for host in hosts:
            log = (self.folder / f"{host}.log").open("ab")
            self.launchers[host] = subprocess.Popen(
                self.command(host, "launch", str(launch_file or self.launch_file), "--host", host),
                env=self._environment(host), cwd=self.folder, stdout=log, stderr=log,
            )  # fmt: skip
            log.close()

    async def run(self, host: str, *arguments: str) -> tuple[int, str]:
        """Run a command on a host, and return its exit code and output."""
        process = await asyncio.create_subprocess_exec(
            *self.command(host, *arguments), env=self._environment(host), cwd=self.folder,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        output, _ = await process.communicate()
        assert process.returncode is not None
        return process.returncode, output.decode()

    async def cable(self, host: str, **values: Any) -> None:
        """Set the cable of a host, see `Network`."""
        await self.network.cable(host, **values)

    def run_directory(self, host: str) -> Path | None:
        """Return the directory of the newest launcher on a host that has written its plan."""
        found = sorted(
            (self.folder / host / "r").glob("*/plan.json"), key=lambda path: path.stat().st_mtime_ns
        )
        return found[-1].parent if found else None

    def plan(self) -> ResolvedGraph:
        return load_graph(self.launch_file)

    async def watch(self, host: str, *topics: str) -> None:
        """Subscribe to topics of a host as soon as its launcher runs."""
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
        self._watched[host] = directory
        plan = self.plan()
        subscribers = []
        for topic in topics:
            ends = [
                writer.ipc.replace("@run", str(directory))
                for writer in plan.writers[topic]
                if writer.host == host and writer.name != "tools"
            ]
            subscriber = Subscriber(find_topic(topic), ends, self._take(topic, host), PortCounts())
            subscriber.start()
            subscribers.append(subscriber)
        self._subscribers[host] = subscribers

    def _take(self, topic: str, host: str) -> Callable[[Message, Header], None]:
        key = f"host {host}" if topic == "host" else topic

        def take(message: Message, header: Header) -> None:
            self.newest[key] = message
            if isinstance(message, ArmState):
                self.seen.append((topic, message))
            for listener in self.listeners:
                listener(key, message)

        return take

    def _close_subscribers(self, *hosts: str) -> None:
        for host in hosts:
            for subscriber in self._subscribers.pop(host, []):
                subscriber.close()

    async def start_all(self) -> None:
        """Start all three hosts, and wait for the states of both arms."""
        self.start(*HOSTS)
        for host in HOSTS:
            await self.watch_usual(host)

    async def watch_usual(self, host: str) -> None:
        arm = [f"arm_{host}"] if host != "main" else ["sheet_target", "fingertip", "twin/finger"]
        await self.watch(host, "host", *arm)

    def stroke(self) -> None:
        """Start continuous strokes of the finger, which also continue after restarts."""
        self._stroking = asyncio.create_task(self._stroke(), name="strokes")

    async def _stroke(self) -> None:
        """Send the path at the start of each run of the main computer, and after each end of the
        path.

        A simulator that restarts within a run receives the latched path again.
        """
        plan = self.plan()
        scene = plan.scene_message()
        assert scene is not None
        path, reported, writer = strokes_path(scene), self.folder, None
        # We stand beside the namespaces, where the sockets in files are all that there is.
        ends = [one.model_copy(update={"tcp": None}) for one in plan.writers[FINGER_PATH]]
        plan = plan.model_copy(update={"writers": {**plan.writers, FINGER_PATH: tuple(ends)}})
        try:
            while True:
                directory = self._watched.get("main")
                if directory is not None and directory != reported:
                    if writer is not None:
                        writer.close()
                    writer = GraphWriter(plan, Run(directory.name, directory), [FINGER_PATH])
                    writer.publish(FINGER_PATH, path)
                    reported = directory
                finger = self.newest.get("twin/finger")
                if writer is not None and isinstance(finger, TwinFinger) and finger.path_done:
                    del self.newest["twin/finger"]
                    writer.publish(FINGER_PATH, path)
                await asyncio.sleep(0.05)
        finally:
            if writer is not None:
                writer.close()

    def strokes(self) -> bool:
        """Return whether the simulated finger moves."""
        finger = self.newest.get("twin/finger")
        return (
            isinstance(finger, TwinFinger)
            and finger.path_label == STROKES
            and finger.path_time_s > 0
            and not finger.path_done
        )

    def status(self, host: str) -> HostStatus | None:
        found = self.newest.get(f"host {host}")
        return found if isinstance(found, HostStatus) else None

    def pid_of(self, host: str, node: str) -> int:
        """Return the process ID of a node, found by the configuration file in the command line."""
        directory = self.run_directory(host)
        assert directory is not None
        wanted = str(directory / f"{self.plan().nodes[node].process}.json").encode()
        for entry in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                if wanted in entry.read_bytes().split(b"\0"):
                    return int(entry.parent.name)
            except OSError:
                continue
        raise AssertionError(f"{node} does not run on {host}")

    def restarts(self, host: str, node: str) -> int:
        """Return the number of restarts of a node; -1 while it is not ready."""
        status = self.status(host)
        found = [one for one in status.nodes if one.name == node] if status else []
        return found[0].restarts if found and found[0].state == "ready" else -1

    def modes(self) -> set[str]:
        arms = [self.newest.get(f"arm_{side}") for side in ("left", "right")]
        return {arm.mode if isinstance(arm, ArmState) else "none" for arm in arms}

    async def until(
        self, condition: Callable[[], bool], what: str, *, within_s: float = DEADLINE_S
    ) -> None:
        loop = asyncio.get_running_loop()
        end_s = loop.time() + within_s
        while not condition():
            for host, process in self.launchers.items():
                log = self.folder / f"{host}.log"
                assert process.poll() in (None, 0, -9), f"{host}:\n{log.read_text()[-3000:]}"
            if self._stroking is not None and self._stroking.done():
                self._stroking.result()
            assert loop.time() < end_s, f"waited in vain for {what}: {self._state()}"
            await asyncio.sleep(0.01)

    def _state(self) -> str:
        arms = [self.newest.get(f"arm_{side}") for side in ("left", "right")]
        printed = [
            str((one.mode, one.reason, one.faults)) for one in arms if isinstance(one, ArmState)
        ]
        finger = self.newest.get("twin/finger")
        if isinstance(finger, TwinFinger):
            printed.append(f'finger on "{finger.path_label}" for {finger.path_time_s:.1f} s')
        logs = [(self.folder / f"{host}.log") for host in HOSTS]
        return f"{printed}\n" + "\n".join(log.read_text()[-1500:] for log in logs if log.exists())


def _only_data(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name.endswith(".py") or name in ("__pycache__", "commands")]


async def _ends(process: subprocess.Popen[bytes]) -> bool:
    """Wait until a process has ended. Return False if the process was killed after DEADLINE_S."""
    try:
        await asyncio.to_thread(process.wait, DEADLINE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        await asyncio.to_thread(process.wait)
        return False
    return True


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
