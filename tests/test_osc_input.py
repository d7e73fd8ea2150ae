"""Test the OSC input with packets of an independent encoder that a real socket carries."""

from __future__ import annotations

import asyncio
import math
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.nodes.external_input import Rejection
from flexsheet.nodes.renderer.output import select_eyes
from flexsheet.nodes.triangulator.osc_node import OscInput, OscInputParameters, OscStream
from tests.scenes import CYLINDER_FILE, load_cylinder
from tests.waiting import until

SCENE = load_cylinder()
CENTRE = SCENE.eyes.centre_world_m
TIP = np.array([0.0, 0.01, 0.1])
STEP_NS = 10_000_000
BOTH: dict[str, Any] = {"fingertip": OscStream(address="/tip")}


def pad(text: bytes) -> bytes:
    return text + b"\0" * (4 - len(text) % 4)


def osc(address: str, *values: float | str) -> bytes:
    """Encode a message as OSC 1.0 defines it; it shares no code with the node."""
    tags, data = ",", b""
    for value in values:
        tags += "s" if isinstance(value, str) else "f"
        data += pad(value.encode()) if isinstance(value, str) else struct.pack(">f", value)
    return pad(address.encode()) + pad(tags.encode()) + data


def bundle(*messages: bytes) -> bytes:
    parts = (struct.pack(">i", len(one)) + one for one in messages)
    return b"#bundle\0" + struct.pack(">Q", 1) + b"".join(parts)


class Sender:
    """Sender of packets to a node, and what the node has published."""

    def __init__(self, **parameters: Any) -> None:
        self.clock = VirtualClock()
        self.sent: list[tuple[str, Any]] = []
        self.node = OscInput(
            OscInputParameters(port=0, **parameters), name="osc", clock=self.clock,
            send=lambda topic, message, header: self.sent.append((topic.name, message)),
        )  # fmt: skip

    def published(self, topic: str) -> list[Any]:
        return [message for name, message in self.sent if name == topic]

    async def send(self, *packets: bytes) -> None:
        """Send each packet a camera period after the last one, and wait until it is counted."""
        assert self.node.transport is not None
        address = self.node.transport.get_extra_info("sockname")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for packet in packets:
                self.clock.move_to(self.clock.now_ns() + STEP_NS)
                before = self.count()
                sender.sendto(packet, address)
                await until(lambda: self.count() > before, "the packet")  # noqa: B023

    def count(self) -> int:
        node = self.node
        return node.accepted.total() + node.rejected.total() + node.ignored


@asynccontextmanager
async def listening(*, scene: bool = True, **parameters: Any) -> AsyncIterator[Sender]:
    sender = Sender(**parameters)
    await sender.node.setup()
    try:
        if scene:
            sender.node.on_scene(SCENE, Header(1, 0, 0, "virtual", "t", 1))
        yield sender
    finally:
        await sender.node.close()


async def test_a_pose_is_converted_from_the_senders_coordinates() -> None:
    """The sender uses millimetres and a z axis that points away from the user."""
    rows = ((1e-3, 0.0, 0.0, 0.0), (0.0, 1e-3, 0.0, 0.0), (0.0, 0.0, -1e-3, 0.0))
    stream = OscStream(address="/Head", world_from_source=rows)
    half = math.sqrt(0.5)
    x, y, z = 1e3 * CENTRE
    async with listening(eye=stream) as sender:
        await sender.send(osc("/Head", "head", x, y, -z, 0.0, half, 0.0, half))
    (eye,) = sender.published("eye")
    assert eye.valid
    np.testing.assert_allclose(eye.centre_world_m, CENTRE, atol=1e-6)
    right = eye.right_world / np.linalg.norm(eye.right_world)
    np.testing.assert_allclose(right, [0.0, 0.0, 1.0], atol=1e-6)


async def test_a_fingertip_is_tracked_before_it_is_valid() -> None:
    async with listening(**BOTH) as sender:
        both = bundle(osc("/tip", *TIP), osc("/flexsheet/eye", *CENTRE))
        await sender.send(both, both, both)
    tips = sender.published("fingertip")
    assert [one.reason for one in tips] == ["unconfirmed", "unconfirmed", "ok"]
    np.testing.assert_allclose(tips[-1].position_world_m, TIP, atol=1e-4)
    assert len(sender.published("eye")) == 3


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (b"", Rejection.MALFORMED),
        (b"/flexsheet/eye", Rejection.MALFORMED),
        (bundle(b"#bundle\0" * 8), Rejection.MALFORMED),
        (osc("/flexsheet/eye", *range(1000)), Rejection.MALFORMED),
        (osc("/flexsheet/eye", 0.0, 0.0), Rejection.MALFORMED),
        (osc("/flexsheet/eye", math.nan, 0.0, 0.5), Rejection.NOT_FINITE),
        (osc("/flexsheet/eye", 0.0, 0.0, 9.0), Rejection.OUTSIDE_RANGE),
        (osc("/flexsheet/eye", *CENTRE, 0.0, 0.0, 0.0, 0.0), Rejection.NOT_A_ROTATION),
    ],
)
async def test_bad_packets_are_refused_and_counted(packet: bytes, reason: Rejection) -> None:
    async with listening() as sender:
        await sender.send(packet, osc("/other", 1.0))
        assert sender.node.rejected == {reason: 1}
        assert sender.node.ignored == 1
        assert not sender.sent
        await sender.node.watch()
        assert f"1 {reason}" in sender.node.note


async def test_two_messages_of_one_time_and_none_before_the_scene() -> None:
    message = osc("/flexsheet/eye", *CENTRE)
    async with listening(scene=False) as sender:
        await sender.send(message)
        assert sender.node.rejected == {Rejection.NO_SCENE: 1}
        sender.node.on_scene(SCENE, Header(1, 0, 0, "virtual", "t", 1))
        await sender.send(bundle(message, message))
        assert sender.node.rejected[Rejection.NOT_NEWER] == 1
        assert len(sender.published("eye")) == 1


async def test_a_silent_sender_makes_the_inputs_invalid() -> None:
    async with listening(**BOTH) as sender:
        tracked = CENTRE + np.array([0.05, 0.0, 0.0])
        await sender.send(osc("/flexsheet/eye", *tracked), osc("/tip", *TIP))
        sender.sent.clear()
        await sender.node.watch()
        assert not sender.sent, "both messages are new"
        sender.clock.move_to(sender.clock.now_ns() + 10**9)
        await sender.node.watch()
    (eye,), (tip,) = sender.published("eye"), sender.published("fingertip")
    assert (eye.valid, tip.valid) == (False, False)
    used, _, note = select_eyes(SCENE.eyes, eye)
    np.testing.assert_array_equal(used.centre_world_m, CENTRE)
    assert "the eyes of the scene are used" in note


async def test_a_port_in_use_is_reported_and_opened_later() -> None:
    async with listening() as first:
        assert first.node.transport is not None
        port = first.node.transport.get_extra_info("sockname")[1]
        second = Sender()
        second.node.parameters = OscInputParameters(port=port)
        await second.node.setup()
        assert f"UDP port {port}" in second.node.note
    for _ in range(2):  # The transport closes its socket in the next step of the event loop.
        await asyncio.sleep(0)
    await second.node.watch()
    assert second.node.transport is not None
    await second.node.close()


def test_streams_need_different_addresses() -> None:
    with pytest.raises(ValidationError, match="different addresses"):
        OscInputParameters(eye=None)
    assert OscInputParameters().host == "127.0.0.1"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "tracker"])
def test_only_this_computer_can_send_positions(host: str) -> None:
    with pytest.raises(ValidationError, match="not a loopback address"):
        OscInputParameters(host=host)
    assert OscInputParameters(host="::1").host == "::1"


@pytest.mark.parametrize("fingertip", [False, True])
def test_a_launch_file_connects_only_what_is_received(tmp_path: Path, fingertip: bool) -> None:
    given = ", fingertip: {address: /tip}" if fingertip else ""
    file = tmp_path / "graph.yaml"
    file.write_text(
        f"scene: {CYLINDER_FILE}\nnodes:\n  osc: {{type: osc_input, parameters: {{port: 9001{given}"
        "}}\n"
    )
    plan = load_graph(file)
    assert plan.writers["eye"][0].name == "osc"
    assert ("fingertip" in plan.writers) == fingertip
