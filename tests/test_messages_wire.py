"""Test the wire format: lossless encoding, and WireError for any invalid input."""

from __future__ import annotations

import math
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from pydantic import BaseModel, Field, create_model

from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.base import Header, Message, compute_fingerprint
from flexsheet.messages.notes import Note, NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import EStop, Fingertip, Frame, PortStatus, Skin, Status, StereoPair
from flexsheet.messages.wire import PROTOCOL, WireError, count_bytes, decode, encode, get_codec
from tests.examples import examples
from tests.fingertips import fingertip
from tests.scenes import load_cylinder

HEADER = Header(3, 1_000, 2_000, "host-1234abcd", "triangulator", 77)

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=0, max_value=1e12)


def vectors(*shape: int) -> st.SearchStrategy[Any]:
    return npst.arrays(np.float64, shape, elements=finite)


fingertips = st.builds(
    Fingertip,
    valid=st.booleans(),
    state=st.sampled_from(["lost", "acquiring", "tracking", "coasting"]),
    reason=st.sampled_from(["ok", "no_marker", "too_fast"]),
    position_world_m=vectors(3),
    velocity_world_m_per_s=vectors(3),
    covariance=vectors(6, 6),
    predicted_path_world_m=vectors(5, 3),
    prediction_step_s=st.floats(1e-6, 10.0),
    measured_world_m=vectors(3),
    reprojection_px=positive,
)
images = npst.arrays(np.uint8, npst.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=60))
stereo_pairs = st.builds(
    StereoPair,
    device=st.text(max_size=30),
    exposure_s=positive,
    dropped_frames=st.integers(0, 2**40),
    left=images,
    right=images,
)
skins = st.integers(0, 200).flatmap(
    lambda points: st.builds(
        Skin,
        mesh_id=st.text(max_size=20),
        vertices_world_m=npst.arrays(
            np.float32, (points, 3), elements=st.floats(-10, 10, width=32)
        ),
        triangles=npst.arrays(np.int32, (points, 3), elements=st.integers(0, 1000)),
    )
)
ports = st.builds(
    PortStatus,
    topic=st.text(max_size=10),
    rate_hz=positive,
    age_s=st.none() | positive,
    messages=st.integers(0, 2**60),
    dropped=st.integers(0, 9),
    gaps=st.integers(0, 9),
    rejected=st.integers(0, 9),
)
statuses = st.builds(
    Status,
    node=st.text(max_size=20),
    state=st.just("running"),
    pid=st.integers(1, 2**22),
    uptime_s=positive,
    cpu_ratio=positive,
    resident_bytes=st.integers(0, 2**45),
    inputs=st.lists(ports, max_size=3).map(tuple),
    outputs=st.lists(ports, max_size=3).map(tuple),
    errors=st.integers(0, 5),
    last_error=st.text(max_size=30),
    notes=st.tuples(st.builds(Note, code=st.sampled_from(NoteCode), detail=st.text(max_size=30))),
    plan_hash=st.text(max_size=10),
)
stops = st.builds(EStop, engaged=st.booleans(), reason=st.text(max_size=50))
messages = st.one_of(fingertips, stereo_pairs, skins, statuses, stops)
numbers = st.integers(0, 2**63 - 1)
names = st.text(min_size=1, max_size=40)
headers = st.builds(Header, numbers, numbers, numbers, names, names, numbers, st.text(max_size=40))


def frame_with_pixels(count: int) -> Frame:
    image = np.arange(20 * 30 * 3, dtype=np.uint8).reshape(20, 30, 3)
    return Frame(
        number=1,
        correction="one_plane",
        stereo="mono",
        label="",
        eyes_world_m=np.zeros((2, 3)),
        world_from_sheet=np.eye(4),
        pushed_point_world_m=np.zeros(3),
        predicted_to_ns=5,
        draw_s=0.001,
        late_frames=0,
        pixels=tuple(image + k for k in range(count)),
    )


def scene() -> Scene:
    return load_cylinder()


def same(a: object, b: object) -> bool:
    """Return whether two values are equal bit by bit, including arrays."""
    if isinstance(a, BaseModel):
        return type(a) is type(b) and same(a.__dict__, b.__dict__)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and a == b


def as_bytes(frames: list[Any]) -> list[bytes]:
    return [bytes(frame) for frame in frames]


@examples(25)
@given(messages, headers, st.sampled_from([0, 64, 1024]))
def test_round_trip(message: Message, header: Header, inline_bytes: int) -> None:
    frames = as_bytes(encode(message, header, inline_bytes=inline_bytes))
    back, header_back = decode(frames, type(message))
    assert same(back, message)
    assert header_back == header
    assert as_bytes(encode(back, header_back, inline_bytes=inline_bytes)) == frames


@pytest.mark.parametrize("count", [0, 1, 2])
def test_tuples_of_arrays_and_nested_parts(count: int) -> None:
    for message in (frame_with_pixels(count), scene()):
        frames = encode(message, HEADER)
        back, _ = decode(frames, type(message))
        assert same(back, message)
    assert len(encode(frame_with_pixels(count), HEADER)) == 1 + count


def test_large_arrays_are_not_copied() -> None:
    image = np.zeros((480, 640), np.uint8)
    pair = StereoPair(device="a", exposure_s=0, dropped_frames=0, left=image, right=image)
    frames = encode(pair, HEADER)
    assert len(frames) == 3
    assert np.shares_memory(np.frombuffer(frames[1], np.uint8), image)
    back, _ = decode(frames, StereoPair)
    assert np.shares_memory(back.left, image)


@pytest.mark.parametrize("inline_bytes", [0, 1024])
def test_received_arrays_are_read_only_and_aligned(inline_bytes: int) -> None:
    tip = fingertip(np.ones(3), np.ones(3))
    writable = [bytearray(frame) for frame in encode(tip, HEADER, inline_bytes=inline_bytes)]
    back, _ = decode([memoryview(frame) for frame in writable], type(tip))
    for array in (back.position_world_m, back.covariance):
        assert array.flags.aligned
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.setflags(write=True)


def test_non_contiguous_arrays_are_sent_in_order() -> None:
    columns = np.asfortranarray(np.arange(36.0).reshape(6, 6))
    tip = Fingertip.model_construct(position_world_m=columns[::2, 1])
    with pytest.raises(WireError, match="Fingertip"):
        decode(encode(tip, HEADER), Fingertip)  # the other fields are missing
    assert np.array_equal(ArraySpec("<f8", (6, 6)).validate(columns), columns)


def refused(frames: list[Any], expected: Topic | type[Message] = Fingertip) -> WireError:
    with pytest.raises(WireError) as caught:
        decode(frames, expected)
    assert str(caught.value)
    return caught.value


@given(st.lists(st.binary(max_size=200), max_size=4))
def test_random_bytes(frames: list[bytes]) -> None:
    refused(frames)


plain = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
packable = st.recursive(
    plain
    | st.binary()
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=40))
    | st.builds(msgpack.Timestamp, st.integers(0, 2**32), st.integers(0, 999)),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(plain | st.binary(), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(packable, st.lists(st.binary(max_size=100), max_size=2))
def test_foreign_msgpack(value: object, more: list[bytes]) -> None:
    refused([msgpack.packb(value), *more])


@given(st.data())
def test_right_header_with_foreign_parts(data: st.DataObject) -> None:
    """One element of a valid header, or one field, is replaced by an arbitrary value."""
    message = data.draw(fingertips)
    codec = get_codec(Fingertip)
    fields: dict[str, object] = {
        "valid": message.valid,
        "reason": message.reason,
        "reprojection_px": message.reprojection_px,
    }
    if data.draw(st.booleans()):
        fields[data.draw(st.sampled_from(sorted(Fingertip.model_fields)))] = data.draw(packable)
    head: list[object] = [PROTOCOL, codec.name, codec.fingerprint, 1, 2, 3, "c", "w", 4, "", fields]
    if data.draw(st.booleans()):
        head[data.draw(st.integers(0, 10))] = data.draw(packable)
    refused([msgpack.packb(head), *data.draw(st.lists(st.binary(max_size=100), max_size=2))])


@examples(150)
@given(messages, st.data())
def test_mutated_messages_are_rejected_or_valid(message: Message, data: st.DataObject) -> None:
    """Decoding a mutated message raises WireError or returns a valid message."""
    frames = [bytearray(frame) for frame in encode(message, HEADER, inline_bytes=64)]
    which = data.draw(st.integers(0, len(frames) - 1))
    frame = frames[which]
    how = data.draw(st.sampled_from(["flip", "cut", "grow", "drop", "repeat", "swap"]))
    if how == "flip" and frame:
        for _ in range(data.draw(st.integers(1, 3))):
            frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    elif how == "cut" and frame:
        del frame[data.draw(st.integers(0, len(frame) - 1)) :]
    elif how == "grow":
        frame += data.draw(st.binary(min_size=1, max_size=20))
    elif how == "drop":
        del frames[which]
    elif how == "repeat":
        frames.insert(which, frame)
    else:
        frames.reverse()
    received = [memoryview(bytes(frame)) for frame in frames]
    try:
        back, header = decode(received, type(message))
    except WireError:
        return
    type(message).model_validate(back.__dict__)
    assert isinstance(header.writer, str)


@pytest.mark.parametrize("cut", range(1, 400, 7))
def test_truncated_header(cut: int) -> None:
    frames = encode(scene(), HEADER)
    refused([bytes(frames[0])[:-cut], *frames[1:]], Scene)


def test_causes_are_distinguished() -> None:
    good = as_bytes(encode(EStop(engaged=True, reason="x"), HEADER))
    assert refused([b"GET / HTTP/1.1\r\n\r\n"], EStop).cause == "malformed"
    assert refused([], EStop).cause == "frames"
    assert refused([*good, b"more"], EStop).cause == "frames"
    other = refused(good, Fingertip)
    assert other.cause == "type"
    assert str(other) == "the message has the type 'EStop', expected Fingertip"
    head = msgpack.unpackb(good[0])
    head[2] = bytes(8)
    assert refused([msgpack.packb(head)], EStop).cause == "fingerprint"
    head = msgpack.unpackb(good[0])
    head[10] = {"engaged": True, "reason": "x", "colour": 1}
    extra = refused([msgpack.packb(head)], EStop)
    assert extra.cause == "field"
    assert "EStop.colour" in str(extra)
    small = Topic("estop", EStop, TOPICS["estop"].delivery, None, True, "", max_bytes=50)
    assert refused(good, small).cause == "size"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_arrays_are_rejected(value: float) -> None:
    tip = Fingertip.model_construct(
        valid=True,
        state="tracking",
        reason="ok",
        position_world_m=np.array([0.0, value, 0.0]),
        velocity_world_m_per_s=np.zeros(3),
        covariance=np.zeros((6, 6)),
        predicted_path_world_m=np.zeros((2, 3)),
        prediction_step_s=0.01,
        measured_world_m=np.zeros(3),
        reprojection_px=0.0,
    )
    error = refused(encode(tip, HEADER))
    assert "Fingertip.position_world_m" in str(error)
    assert "NaN or infinite" in str(error)


@pytest.mark.parametrize("value", [1e200, -1.7e308])
def test_huge_but_finite_arrays_pass(value: float) -> None:
    array = ArraySpec("<f8", (3,)).validate([value, value, 0.0])
    assert array[0] == value


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(4),
        np.zeros((3, 1)),
        np.zeros(3, np.float32),
        np.zeros(3, np.int64),
        np.zeros(3, ">f8"),
    ],
)
def test_wrong_arrays_are_rejected(array: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        ArraySpec("<f8", (3,)).validate(array)


def test_lists_with_fractions_are_no_whole_numbers() -> None:
    spec = ArraySpec("<i4", ("n",))
    assert spec.validate([1, 2.0]).tolist() == [1, 2]
    for bad in ([1.5], [2**40], ["x"], [[1]], [math.nan], [None]):
        with pytest.raises(ValueError, match="array"):
            spec.validate(bad)


def test_a_type_without_a_wire_format_is_reported() -> None:
    for value in (np.array([object()]), object(), np.zeros(2, ">f8"), np.zeros(3, np.complex128)):
        with pytest.raises(WireError, match="EStop cannot be encoded"):
            encode(EStop.model_construct(engaged=True, reason=value), HEADER)
    with pytest.raises(WireError):
        encode(EStop(engaged=True, reason="\ud800"), HEADER)


def test_size_limit_holds_at_both_ends() -> None:
    stop = EStop(engaged=True, reason="x" * 100)
    size = count_bytes(encode(stop, HEADER))
    assert encode(stop, HEADER, max_bytes=size)
    with pytest.raises(WireError, match=f"the message has {size} bytes; at most {size - 1}"):
        encode(stop, HEADER, max_bytes=size - 1)


def test_a_better_sentence_does_not_change_the_fingerprint_but_a_field_does() -> None:
    def example(doc: str, **fields: object) -> type[Message]:
        return create_model("Example", __base__=Message, __doc__=doc, **fields)

    plain = example("One.", title=(str, Field(description="of the example")))
    reworded = example("Another.", title=(str, Field(description="what it is called")))
    widened = example("One.", title=(str | None, Field(description="of the example")))
    renamed = example("One.", name=(str, Field(description="of the example")))
    fingerprints = [compute_fingerprint(kind) for kind in (plain, reworded, widened, renamed)]
    assert fingerprints[0] == fingerprints[1]
    assert len(set(fingerprints)) == 3


def test_every_topic_type_has_a_fingerprint_of_its_own() -> None:
    types = {topic.message for topic in TOPICS.values()}
    assert len({compute_fingerprint(message_type) for message_type in types}) == len(types)


def test_every_array_field_has_a_dtype_of_the_wire() -> None:
    def specs(annotation: Any) -> list[ArraySpec]:
        found = [
            part for part in getattr(annotation, "__metadata__", ()) if isinstance(part, ArraySpec)
        ]
        return found + [spec for inner in get_args(annotation) for spec in specs(inner)]

    for topic in TOPICS.values():
        for field in topic.message.model_fields.values():
            found = [part for part in field.metadata if isinstance(part, ArraySpec)]
            for spec in found + specs(field.annotation):
                empty = np.zeros([0 if isinstance(n, str) else n for n in spec.shape], spec.dtype)
                encode(EStop.model_construct(engaged=True, reason=empty), HEADER)
