"""Define small nodes for the tests of launcher and command line."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, EStop, Fingertip, ParameterChange, Side, TwinFinger
from flexsheet.nodes.node import Input, Node, NodeParameters, Output, periodic
from flexsheet.nodes.recorder.node import Recorder
from flexsheet.nodes.recorder.parameters import RecorderParameters
from tests.arm_states import arm_state
from tests.fingertips import fingertip


class BeaconParameters(NodeParameters):
    rate_hz: float = 50.0
    crash_after: int = 0
    mark: Path | None = None
    ready_after_s: float = 0.0
    unreachable: bool = False
    exit_code: int | None = None
    with_child: bool = False


class FingertipSource(Node):
    """A node that publishes a fingertip at rest at 50 Hz."""

    parameters: BeaconParameters
    fingertip: Output[Fingertip]

    @periodic("rate_hz")
    def publish(self) -> None:
        self.fingertip.publish(fingertip(np.zeros(3)))


class Beacon(Node):
    """A node that publishes numbered fingers. Parameters select a fault."""

    parameters: BeaconParameters
    twin__finger: Output[TwinFinger]

    async def setup(self) -> None:
        self.count = 0
        if self.parameters.with_child:
            await asyncio.create_subprocess_exec("sleep", "1000")
        if self.parameters.unreachable:
            for number in (signal.SIGINT, signal.SIGTERM):
                asyncio.get_running_loop().remove_signal_handler(number)
                signal.signal(number, signal.SIG_IGN)
        if self.parameters.ready_after_s:
            await asyncio.sleep(self.parameters.ready_after_s)

    @periodic("rate_hz")
    def beat(self) -> None:
        self.count += 1
        if self.parameters.crash_after and self.count >= self.parameters.crash_after:
            os._exit(3)
        if self.parameters.exit_code is not None:
            os._exit(self.parameters.exit_code)
        self.twin__finger.publish(
            TwinFinger(
                path_label="count",
                path_done=False,
                path_time_s=float(self.count),
                position_world_m=[0.001 * self.count, 0.0, 0.0],
                velocity_world_m_per_s=[0.0, 0.0, 0.0],
            )
        )
        while self.parameters.unreachable and self.count > 2:
            time.sleep(1.0)


class MisspelledHandler(Beacon):
    """A node with a handler whose name differs from that of its input."""

    scene: Input[Scene]

    def on_scen(self, scene: Scene, header: Header) -> None:
        raise AssertionError("no message can arrive")


class MisspelledRate(Beacon):
    """A node with a periodic method whose rate is not a parameter."""

    @periodic("rate_hs")
    async def show(self) -> None:
        raise AssertionError("the graph is not started")


class UnreachableParameter(Beacon):
    """A node with a live parameter, but without an input for its changes."""

    live_parameters: ClassVar[frozenset[str]] = frozenset({"rate_hz"})


class RelayParameters(NodeParameters):
    rate_hz: float = 10.0
    random: bool = False


class Relay(Node):
    """A node that publishes the age of the newest finger periodically, and optionally random
    values.
    """

    parameters: RelayParameters
    twin__finger: Input[TwinFinger]
    estop: Output[EStop]

    @periodic("rate_hz")
    def tell(self) -> None:
        chance = os.urandom(4).hex() if self.parameters.random else ""
        age_ms = 1e3 * self.twin__finger.age_s()
        self.estop.publish(EStop(engaged=False, reason=f"{age_ms:.0f} ms {chance}"))


class ListenerParameters(NodeParameters):
    patience_s: float = 1.0


class Listener(Node):
    """A node that publishes one e-stop when the finger has reached a given distance."""

    live_parameters: ClassVar[frozenset[str]] = frozenset({"patience_s"})
    parameters: ListenerParameters
    twin__finger: Input[TwinFinger]
    parameter: Input[ParameterChange]
    estop: Output[EStop]

    printed = False

    def on_twin__finger(self, finger: TwinFinger, header: Header) -> None:
        if finger.path_time_s >= 10.0 and not self.printed:
            self.printed = True
            self.estop.publish(EStop(engaged=True, reason="ten"), source_ns=header.source_ns)


class StandInBridgeParameters(NodeParameters):
    rate_hz: float = 50.0
    side: Side
    hangs: Path | None = None


class StandInBridge(Node):
    """A node that publishes an arm which follows until it is stopped. The node hangs while a file
    exists.
    """

    opens_devices: ClassVar[bool] = True
    parameters: StandInBridgeParameters
    estop: Input[EStop]
    arm: Output[ArmState]

    async def setup(self) -> None:
        self.stopped: EStop | None = None

    def on_estop(self, estop: EStop, header: Header) -> None:
        self.stopped = estop if estop.engaged else None

    @periodic("rate_hz")
    def cycle(self) -> None:
        mark = self.parameters.hangs
        while mark is not None and mark.exists():
            time.sleep(0.05)
        side, stopped = self.parameters.side, self.stopped
        faults = () if stopped is None else (f"e-stop: {stopped.reason}",)
        mode = "follow" if stopped is None else "estop"
        self.arm.publish(
            arm_state(side, mode=mode, faults=faults, estop_engaged=stopped is not None)
        )


class SlowRecorderParameters(RecorderParameters):
    closes_after: Path = Field(description="file that must exist before the bag is closed")


class SlowRecorder(Recorder):
    """A recorder that closes the bag when a file exists."""

    parameters: SlowRecorderParameters

    async def close(self) -> None:
        self.log.info("waiting before the bag is closed")
        while not self.parameters.closes_after.exists():  # noqa: ASYNC110  # a test creates it
            await asyncio.sleep(0.01)
        await super().close()


class CrashParameters(NodeParameters):
    fails: bool = False


class Crash(Node):
    """A node that logs a line, and fails on request."""

    parameters: CrashParameters
    twin__finger: Input[TwinFinger]

    async def setup(self) -> None:
        self.log.info("crash is set up")
        print("a line without a node", flush=True)
        if self.parameters.fails:
            raise RuntimeError("the setup fails")
