"""Publish the eyes and the fingertip that a tracking program sends as OSC 1.0 messages over UDP."""

from __future__ import annotations

import asyncio
import ipaddress
import struct
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import ConfigDict, Field, field_validator, model_validator

from flexsheet.messages.base import Header
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, NonNegative, Positive, Scene
from flexsheet.messages.types import Eye, Fingertip
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.external_input import (
    RejectedError,
    Rejection,
    check_finite,
    check_period,
    make_eye,
    rotate_x_axis,
)
from flexsheet.nodes.node import Input, Node, NodeParameters, Output, periodic
from flexsheet.nodes.triangulator.external_fingertip import ExternalFingertip
from flexsheet.nodes.triangulator.osc_packet import read_packet

MAX_PACKET_BYTES = 2048
"""The maximum size of a packet. It also limits how deeply OSC bundles can be nested."""

POSITION, POSE = 3, 7
"""The numbers of values in a position message, and in a pose message (position and quaternion)."""

Row = tuple[Finite, Finite, Finite, Finite]
IDENTITY: tuple[Row, Row, Row] = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
)


class OscStream(LimitedModel):
    """The OSC address of a stream of positions, and their transform to the world frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    address: Annotated[str, Field(pattern="^/")] = Field(
        description="OSC address. Its messages contain x, y, z, or x, y, z and a quaternion x, y, "
        "z, w. String arguments of the messages are ignored"
    )
    world_from_source: tuple[Row, Row, Row] = Field(
        default=IDENTITY,
        description="affine transform from the sender's coordinates to the world, m, row by row. "
        "It may convert units and mirror an axis",
    )
    delay_s: NonNegative = Field(
        default=0.0, description="time from the measurement to the arrival of its message, s"
    )


class OscInputParameters(NodeParameters):
    """The parameters of the OSC input."""

    host: str = Field(
        default="127.0.0.1",
        description="loopback address on which the node listens. OSC has no authentication: run "
        "this node on the computer that sends the positions",
    )
    port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default=9000, description="UDP port; 0: any free port is used"
    )
    eye: OscStream | None = Field(
        default=OscStream(address="/flexsheet/eye"),
        description="OSC address of the pose at the midpoint between the eyes. The x axis of its "
        "orientation points from the left to the right eye. null: the topic eye is not published",
    )
    fingertip: OscStream | None = Field(
        default=None,
        description="OSC address of the position of the finger's pad. null: the topic fingertip is "
        "not published",
    )
    fingertip_noise_m: Positive = Field(
        default=0.001, description="standard deviation of the fingertip's positions, m"
    )
    silence_s: Positive = Field(
        default=0.2,
        description="time without a valid message after which an input is published as invalid, s",
    )
    watch_hz: Positive = Field(
        default=20.0, description="rate at which the node checks for missing messages, Hz"
    )

    @field_validator("host")
    @classmethod
    def _check_loopback(cls, host: str) -> str:
        try:
            is_loopback = ipaddress.ip_address(host).is_loopback
        except ValueError:
            is_loopback = False
        if not is_loopback:
            raise ValueError(
                f'"{host}" is not a loopback address, and OSC has no authentication; use '
                "127.0.0.1, and run osc_input on the computer that sends the positions"
            )
        return host

    @model_validator(mode="after")
    def _check_streams(self) -> Self:
        addresses = [one.address for one in (self.eye, self.fingertip) if one is not None]
        if not addresses or len(set(addresses)) < len(addresses):
            raise ValueError(
                "osc_input: eye and fingertip are both null or have the same address; set at "
                "least one of them, and use different addresses"
            )
        return self


class OscInput(Node):
    """A node that publishes the positions of the eyes and the fingertip that it receives by OSC.

    If no messages arrive, the published messages are marked as invalid. The renderer then uses the
    eye positions in the scene.
    """

    opens_devices: ClassVar[bool] = True
    parameters: OscInputParameters
    scene: Input[Scene]
    eye: Output[Eye]
    fingertip: Output[Fingertip]

    current_scene: Scene | None = None
    transport: asyncio.DatagramTransport | None = None

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it reads a network port; the bag has its messages as topics eye and fingertip"

    @classmethod
    def unused_outputs(cls, parameters: Any) -> frozenset[str]:
        return frozenset(name for name in ("eye", "fingertip") if getattr(parameters, name) is None)

    async def setup(self) -> None:
        self.accepted: Counter[str] = Counter()
        self.rejected: Counter[Rejection] = Counter()
        self.ignored = 0
        self._newest_ns: dict[str, int] = {}
        self._last_eye: Eye | None = None
        self._problem = ""
        self._inputs = {
            stream.address: (name, stream)
            for name in ("eye", "fingertip")
            if (stream := getattr(self.parameters, name)) is not None
        }
        await self._open()

    async def close(self) -> None:
        if self.transport is not None:
            self.transport.close()
            self.transport = None

    async def _open(self) -> None:
        p = self.parameters
        make_protocol = partial(_Receiver, self._receive)
        try:
            self.transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                make_protocol, local_addr=(p.host, p.port)
            )
        except OSError as error:
            text = (
                f"cannot listen on {p.host}, UDP port {p.port}: {error}; end the program that uses "
                "the port, or change the parameter port of osc_input"
            )
            self._report(OSError(text))
            return
        self._problem = ""

    def _report(self, error: Exception) -> None:
        self.note = str(error)
        if str(error) != self._problem:
            self._problem = str(error)
            self.report_error("source", error)

    def on_scene(self, scene: Scene, header: Header) -> None:
        self.current_scene = scene
        self._finger = ExternalFingertip(scene, self.parameters.fingertip_noise_m)
        self._last_eye = Eye(valid=False, centre_world_m=scene.eyes.centre_world_m)

    def _receive(self, data: bytes) -> None:
        now_ns = self.clock.now_ns()
        if len(data) > MAX_PACKET_BYTES:
            self.rejected[Rejection.MALFORMED] += 1
            return
        try:
            messages = list(read_packet(data))
        except (ValueError, struct.error):
            self.rejected[Rejection.MALFORMED] += 1
            return
        for address, numbers in messages:
            if address not in self._inputs:
                self.ignored += 1
                continue
            name, stream = self._inputs[address]
            try:
                self._publish(name, stream, numbers, now_ns)
            except RejectedError as error:
                self.rejected[error.reason] += 1

    def _publish(self, name: str, stream: OscStream, numbers: list[float], now_ns: int) -> None:
        scene = self.current_scene
        if scene is None:
            raise RejectedError(Rejection.NO_SCENE)
        if len(numbers) not in (POSITION, POSE):
            raise RejectedError(Rejection.MALFORMED)
        values: Floats = check_finite(np.array(numbers, dtype=np.float64))
        at_ns = now_ns - round(1e9 * stream.delay_s)
        check_period(at_ns, self._newest_ns.get(name))
        transform = np.array(stream.world_from_source)
        position = transform @ [*values[:POSITION], 1.0]
        if name == "fingertip":
            self.fingertip.publish(self._finger.update(at_ns, position), source_ns=at_ns)
        else:
            right = np.array([1.0, 0.0, 0.0])
            if len(numbers) == POSE:
                right = transform[:, :3] @ rotate_x_axis(values[POSITION:])
            self._last_eye = make_eye(position, right, scene)
            self.eye.publish(self._last_eye, source_ns=at_ns)
        self._newest_ns[name] = at_ns
        self.accepted[name] += 1

    @periodic("watch_hz")
    async def watch(self) -> None:
        """Reopen a closed port, and report inputs that receive no data.

        For such an input, a message that is marked as invalid is published.
        """
        if self.transport is None:
            await self._open()
        else:
            rejected = ", ".join(f"{count} {reason}" for reason, count in self.rejected.items())
            accepted = ", ".join(f"{count} {name}" for name, count in self.accepted.items())
            self.note = (
                f"accepted: {accepted or 'none'}; rejected: {rejected or 'none'}; "
                f"{self.ignored} of other addresses"
            )
        if self._last_eye is None:  # no scene yet
            return
        now_ns = self.clock.now_ns()
        for name, stream in self._inputs.values():
            at_ns = now_ns - round(1e9 * stream.delay_s)
            newest_ns = self._newest_ns.get(name)
            if newest_ns is not None and at_ns - newest_ns <= 1e9 * self.parameters.silence_s:
                continue
            if name == "fingertip":
                self.fingertip.publish(self._finger.predict(at_ns), source_ns=at_ns)
            else:
                invalid = self._last_eye.model_copy(update={"valid": False})
                self.eye.publish(invalid, source_ns=at_ns)


class _Receiver(asyncio.DatagramProtocol):
    def __init__(self, receive: Callable[[bytes], None]) -> None:
        self._receive = receive

    def datagram_received(self, data: bytes, address: Any) -> None:
        self._receive(data)
