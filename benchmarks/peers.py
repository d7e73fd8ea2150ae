"""Transfer the messages of `benchmarks.messaging` by other messaging libraries.

Each library has a line, the sending end, and a receiving function, as recommended in its manual.
Addresses are given explicitly, and discovery is limited to the given interface.

zenoh and dora transfer bytes, Cyclone DDS and LCM messages of their own types with the same fields.
LCM's types are written as its generator writes them. DDS's images are arrays of octets whose size
is part of the type. Its Python binding copies these at once, while it encodes a sequence element by
element, which takes 25 ms.
"""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import zmq

from benchmarks.messaging import EPOCH, Payload, make_header
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import Fingertip, StereoPair
from flexsheet.messages.wire import encode

Arrived = Callable[[int, int], bool]
PICTURE_BYTES = 480 * 640
STAMPS = struct.Struct("<QQ")
DORA_STARTS_S, DORA_ENDS_S = 20.0, 5.0


def raw_bytes(payload: Payload) -> bytearray:
    """Make a block of bytes as long as the message, with sequence number and timestamp first."""
    return bytearray(b"".join(encode(payload.make(0), make_header(0, 0))))


class ZmqLine:
    """A ZeroMQ publisher: the reference between networks, where flexsheet requires keys."""

    def __init__(self, payload: Payload, place: str) -> None:
        self._frames = [bytearray(one) for one in encode(payload.make(0), make_header(0, 0))]
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUB)
        self._socket.bind(place)
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def send(self, sequence: int, stamp_ns: int) -> None:
        STAMPS.pack_into(self._frames[0], 0, sequence, stamp_ns)
        head, *arrays = self._frames
        self._socket.send_multipart([bytes(head), *arrays], zmq.NOBLOCK, copy=not arrays)

    def close(self) -> None:
        self._socket.close(linger=0)


def zenoh_session(mode: str, endpoint: str) -> Any:
    import json

    import zenoh

    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [endpoint] if mode == "listen" else [],
        "connect/endpoints": [endpoint] if mode == "connect" else [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class ZenohLine:
    def __init__(self, payload: Payload, place: str) -> None:
        self.endpoint = place
        self._raw = raw_bytes(payload)
        self._session = zenoh_session("listen", place)
        self._publisher = self._session.declare_publisher("bench")

    def send(self, sequence: int, stamp_ns: int) -> None:
        STAMPS.pack_into(self._raw, 0, sequence, stamp_ns)
        self._publisher.put(self._raw)

    def close(self) -> None:
        self._session.close()


def receive_zenoh(topic: Topic, endpoint: str, arrived: Arrived) -> None:
    session = zenoh_session("connect", endpoint)
    ended = Event()

    def on_sample(sample: Any) -> None:
        if not arrived(*STAMPS.unpack_from(sample.payload.to_bytes())):
            ended.set()

    session.declare_subscriber("bench", on_sample)
    ended.wait()
    session.close()


DORA_DATAFLOW = """\
nodes:
  - {id: sender, path: dynamic, outputs: [message]}
  - {id: receiver, path: dynamic, inputs: {message: {source: sender/message, queue_size: 1000}}}
"""
"""The dataflow of dora. The nodes are processes of this benchmark."""


def dora_node(name: str) -> Any:
    """Connect to the daemon as a node of the dataflow. Retry until the daemon is ready."""
    from dora import Node

    patience_ends = time.monotonic() + DORA_STARTS_S
    while True:
        try:
            return Node(name)
        except RuntimeError:
            if time.monotonic() > patience_ends:
                raise
            time.sleep(0.1)


class DoraLine:
    """A dataflow whose daemon `dora run` starts.

    place: folder for its files.
    """

    def __init__(self, payload: Payload, place: str) -> None:
        self.endpoint = "receiver"
        self._raw = raw_bytes(payload)
        self._octets = np.frombuffer(self._raw, dtype=np.uint8)
        self._node: Any = None
        folder = Path(place)
        folder.mkdir()
        (folder / "dataflow.yml").write_text(DORA_DATAFLOW)
        with open(folder / "dora.log", "wb") as log:
            command = [str(Path(sys.executable).parent / "dora"), "run", "dataflow.yml"]
            self._daemon = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)

    def send(self, sequence: int, stamp_ns: int) -> None:
        import pyarrow

        # It waits until the receiver is connected to the daemon.
        self._node = self._node or dora_node("sender")
        STAMPS.pack_into(self._raw, 0, sequence, stamp_ns)
        self._node.send_output("message", pyarrow.array(self._octets))

    def close(self) -> None:
        self._node = None
        self._daemon.send_signal(signal.SIGINT)
        try:
            self._daemon.wait(DORA_ENDS_S)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()


def receive_dora(topic: Topic, endpoint: str, arrived: Arrived) -> None:
    for event in dora_node(endpoint):
        if event["type"] == "INPUT":
            octets = event["value"].to_numpy()
            if not arrived(*STAMPS.unpack_from(octets)):
                return


@cache
def dds_types() -> dict[type, type]:
    """Return DDS types with the fields of the message types."""
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import array, float64, int64, sequence, uint8, uint32, uint64

    stamps = {"sequence": uint64, "source_ns": int64, "publish_ns": int64, "epoch": int64}
    names = {"clock_id": str, "writer": str}
    three = array[float64, 3]
    tip = {
        "valid": bool,
        "state": str,
        "reason": str,
        "position_world_m": three,
        "velocity_world_m_per_s": three,
        "covariance": array[float64, 36],
        "predicted_path_world_m": sequence[float64],
        "prediction_step_s": float64,
        "measured_world_m": three,
        "reprojection_px": float64,
    }
    pair = {
        "device": str,
        "exposure_s": float64,
        "skew_s": float64,
        "dropped_frames": int64,
        "left_origin_px": array[uint32, 2],
        "right_origin_px": array[uint32, 2],
        "left": array[uint8, PICTURE_BYTES],
        "right": array[uint8, PICTURE_BYTES],
    }
    return {
        message: make_idl_struct(
            message.__name__, f"bench.{message.__name__}", stamps | names | own
        )
        for message, own in ((Fingertip, tip), (StereoPair, pair))
    }


def dds_participant(endpoint: str) -> tuple[Any, Any]:
    """Create a DDS domain on one interface without multicast, and a participant.

    endpoint: number of the domain, name of the interface, and the address of each end.
    """
    from cyclonedds.domain import Domain, DomainParticipant

    number, interface, *addresses = endpoint.split()
    peers = "".join(f'<Peer Address="{one}"/>' for one in addresses)
    domain = Domain(
        int(number),
        f"""<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast>
        <Interfaces><NetworkInterface name="{interface}" multicast="false"/></Interfaces></General>
        <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>{peers}</Peers></Discovery>
        </Domain></CycloneDDS>""",
    )
    return domain, DomainParticipant(int(number))


def dds_qos() -> Any:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    return Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(1000))


class DdsLine:
    def __init__(self, payload: Payload, place: str) -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic as DdsTopic

        self.endpoint, self._payload = place, payload
        self._domain, participant = dds_participant(place)
        self._type = dds_types()[payload.topic.message]
        topic = DdsTopic(participant, "bench", self._type)
        self._writer = DataWriter(participant, topic, qos=dds_qos())
        self._kept = participant, topic
        self._fields = {name: dds_value(value) for name, value in payload.make(0).__dict__.items()}

    def send(self, sequence: int, stamp_ns: int) -> None:
        self._writer.write(
            self._type(
                sequence=sequence,
                source_ns=stamp_ns,
                publish_ns=stamp_ns,
                epoch=EPOCH,
                clock_id="bench",
                writer="bench",
                **self._fields,
            )
        )

    def close(self) -> None:
        del self._writer, self._kept, self._domain


def dds_value(value: Any) -> Any:
    """Convert the bytes to the type of the binding: octets, or a list of numbers."""
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.ravel().tolist()
    return list(value) if isinstance(value, tuple) else value


def receive_dds(topic: Topic, endpoint: str, arrived: Arrived) -> None:
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic
    from cyclonedds.util import duration

    _domain, participant = dds_participant(endpoint)
    dds_topic = DdsTopic(participant, "bench", dds_types()[topic.message])
    reader = DataReader(participant, dds_topic, qos=dds_qos())
    while True:
        for message in reader.take_iter(timeout=duration(seconds=10)):
            if not arrived(message.sequence, message.publish_ns):
                return


LCM_HEADER = struct.Struct(">qQqqq")
LCM_FINGERPRINT = 0x1234567890ABCDEF
LCM_TEXT = struct.Struct(">I")


def lcm_write_text(out: BytesIO, text: str) -> None:
    data = text.encode()
    out.write(LCM_TEXT.pack(len(data) + 1))
    out.write(data)
    out.write(b"\0")


def lcm_read_text(buffer: BytesIO) -> str:
    (length,) = LCM_TEXT.unpack(buffer.read(4))
    return buffer.read(length)[:-1].decode()


@dataclass(slots=True)
class LcmHeader:
    sequence: int
    source_ns: int
    publish_ns: int
    epoch: int
    clock_id: str
    writer: str

    def write(self, out: BytesIO) -> None:
        out.write(
            LCM_HEADER.pack(
                LCM_FINGERPRINT, self.sequence, self.source_ns, self.publish_ns, self.epoch
            )
        )
        lcm_write_text(out, self.clock_id)
        lcm_write_text(out, self.writer)

    @classmethod
    def read(cls, buffer: BytesIO) -> LcmHeader:
        fingerprint, sequence, source, publish, epoch = LCM_HEADER.unpack(
            buffer.read(LCM_HEADER.size)
        )
        if fingerprint != LCM_FINGERPRINT:
            raise ValueError("not a message of this type")
        clock_id, writer = lcm_read_text(buffer), lcm_read_text(buffer)
        return cls(sequence, source, publish, epoch, clock_id, writer)


@dataclass(slots=True)
class LcmFingertip:
    """An LCM type with the fields of `Fingertip`."""

    header: LcmHeader
    valid: bool
    state: str
    reason: str
    position_world_m: Any
    velocity_world_m_per_s: Any
    covariance: Any
    points: int
    predicted_path_world_m: Any
    prediction_step_s: float
    measured_world_m: Any
    reprojection_px: float

    def encode(self) -> bytes:
        out = BytesIO()
        self.header.write(out)
        out.write(struct.pack(">b", self.valid))
        lcm_write_text(out, self.state)
        lcm_write_text(out, self.reason)
        out.write(struct.pack(">3d", *self.position_world_m[:3]))
        out.write(struct.pack(">3d", *self.velocity_world_m_per_s[:3]))
        for row in self.covariance:
            out.write(struct.pack(">6d", *row[:6]))
        out.write(struct.pack(">i", self.points))
        for row in self.predicted_path_world_m:
            out.write(struct.pack(">3d", *row[:3]))
        out.write(struct.pack(">d", self.prediction_step_s))
        out.write(struct.pack(">3d", *self.measured_world_m[:3]))
        out.write(struct.pack(">d", self.reprojection_px))
        return out.getvalue()

    @classmethod
    def decode(cls, data: bytes) -> LcmFingertip:
        buffer = BytesIO(data)
        header = LcmHeader.read(buffer)
        valid = bool(struct.unpack(">b", buffer.read(1))[0])
        state, reason = lcm_read_text(buffer), lcm_read_text(buffer)
        position = struct.unpack(">3d", buffer.read(24))
        velocity = struct.unpack(">3d", buffer.read(24))
        covariance = [struct.unpack(">6d", buffer.read(48)) for _ in range(6)]
        (points,) = struct.unpack(">i", buffer.read(4))
        ahead = [struct.unpack(">3d", buffer.read(24)) for _ in range(points)]
        (step,) = struct.unpack(">d", buffer.read(8))
        measured = struct.unpack(">3d", buffer.read(24))
        (reprojection,) = struct.unpack(">d", buffer.read(8))
        return cls(
            header, valid, state, reason, position, velocity, covariance, points, ahead, step,
            measured, reprojection,
        )  # fmt: skip


@dataclass(slots=True)
class LcmStereoPair:
    """An LCM type with the fields of `StereoPair`; images are byte[rows * columns]."""

    header: LcmHeader
    device: str
    exposure_s: float
    skew_s: float
    dropped_frames: int
    left_origin_px: Any
    right_origin_px: Any
    rows: int
    columns: int
    left: Any
    right: Any

    def encode(self) -> bytes:
        out = BytesIO()
        self.header.write(out)
        lcm_write_text(out, self.device)
        out.write(struct.pack(">ddq", self.exposure_s, self.skew_s, self.dropped_frames))
        out.write(struct.pack(">2i", *self.left_origin_px))
        out.write(struct.pack(">2i", *self.right_origin_px))
        out.write(struct.pack(">ii", self.rows, self.columns))
        out.write(self.left)
        out.write(self.right)
        return out.getvalue()

    @classmethod
    def decode(cls, data: bytes) -> LcmStereoPair:
        buffer = BytesIO(data)
        header, device = LcmHeader.read(buffer), lcm_read_text(buffer)
        exposure, skew, dropped = struct.unpack(">ddq", buffer.read(24))
        left_origin = struct.unpack(">2i", buffer.read(8))
        right_origin = struct.unpack(">2i", buffer.read(8))
        rows, columns = struct.unpack(">ii", buffer.read(8))
        left, right = buffer.read(rows * columns), buffer.read(rows * columns)
        return cls(
            header, device, exposure, skew, dropped, left_origin, right_origin, rows, columns,
            left, right,
        )  # fmt: skip


def lcm_message(message: Fingertip | StereoPair, header: LcmHeader) -> LcmFingertip | LcmStereoPair:
    values = dict(message.__dict__)
    if isinstance(message, Fingertip):
        return LcmFingertip(header=header, points=len(message.predicted_path_world_m), **values)
    rows, columns = message.left.shape
    return LcmStereoPair(header=header, rows=rows, columns=columns, **values)


class LcmLine:
    def __init__(self, payload: Payload, place: str) -> None:
        import lcm

        self.endpoint = place
        self._message: Any = payload.make(0)
        self._lcm = lcm.LCM(place)

    def send(self, sequence: int, stamp_ns: int) -> None:
        header = LcmHeader(sequence, stamp_ns, stamp_ns, EPOCH, "bench", "bench")
        self._lcm.publish("bench", lcm_message(self._message, header).encode())

    def close(self) -> None:
        del self._lcm


def receive_lcm(topic: Topic, endpoint: str, arrived: Arrived) -> None:
    import lcm

    kind = LcmFingertip if topic.message is Fingertip else LcmStereoPair
    going = True

    def on_message(channel: str, data: bytes) -> None:
        nonlocal going
        header = kind.decode(data).header
        going = arrived(header.sequence, header.publish_ns)

    opened = lcm.LCM(endpoint)
    opened.subscribe("bench", on_message)
    while going:
        opened.handle()
