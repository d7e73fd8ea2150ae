"""Test bags: writing, reading, truncation and damage."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk as ChunkRecord
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from flexsheet.messages import bag as bag_module
from flexsheet.messages.bag import (
    BagError,
    BagReader,
    BagWriter,
    NoBagError,
    info,
    join_frames,
    recover,
    split_frames,
)
from flexsheet.messages.base import Header
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import EStop, Fingertip, StereoPair, TwinFinger
from flexsheet.messages.wire import WireError, encode
from tests.waiting import wait_until

ROOT = Path(__file__).parent.parent


def header(sequence: int) -> Header:
    return Header(sequence, 10 * sequence, 10 * sequence + 1, "clock", "twin", 5)


def finger(number: int) -> TwinFinger:
    return TwinFinger(
        path_label="line",
        path_done=False,
        path_time_s=float(number),
        position_world_m=np.random.default_rng(number).normal(size=3),
        velocity_world_m_per_s=np.zeros(3),
    )


def pictures(number: int) -> StereoPair:
    image = np.random.default_rng(number).integers(0, 255, (120, 160), np.uint8)
    return StereoPair(
        device="t", exposure_s=0.001, dropped_frames=0, left=image, right=image[:, ::-1]
    )


STEP_NS = 10_000_000


def fill(writer: BagWriter, count: int, *, flush_every: int = 0) -> None:
    """Write `count` finger messages, 10 ms apart from 1 s.

    The first message is an e-stop. Every tenth finger message is followed by an image.
    """
    writer.write(TOPICS["estop"], EStop(engaged=False, reason="start"), header(1), 10**9)
    for number in range(count):
        log_ns = 10**9 + number * STEP_NS
        writer.write(TOPICS["twin/finger"], finger(number), header(number + 1), log_ns)
        if number % 10 == 0:
            writer.write(TOPICS["stereo"], pictures(number), header(number + 1), log_ns + 1)
        if flush_every and number % flush_every == flush_every - 1:
            writer.flush()


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    path = tmp_path / "whole.mcap"
    with BagWriter(path, {"clock": {"id": "clock"}}) as writer:
        writer.add_attachment("launch.yaml", b"nodes: {}\n", "application/yaml")
        fill(writer, 200, flush_every=25)
        writer.add_attachment("offsets.json", b"{}", "application/json")
    return path


def numbers(path: Path, **selection: Any) -> list[int]:
    reader = BagReader(path, ["twin/finger"], **selection)
    return [
        round(message.path_time_s) for _, message, _, _ in reader if type(message) is TwinFinger
    ]


def test_round_trip(whole: Path) -> None:
    entries = list(BagReader(whole))
    assert len(entries) == 1 + 200 + 20
    stamps = [log_ns for _, _, _, log_ns in entries]
    assert stamps == sorted(stamps)
    fingers = [entry for entry in entries if entry[0] == "twin/finger"]
    for number, (_, message, head, log_ns) in enumerate(fingers):
        assert isinstance(message, TwinFinger)
        assert np.array_equal(message.position_world_m, finger(number).position_world_m)
        assert head == header(number + 1)
        assert log_ns == 10**9 + number * STEP_NS
    pair = next(message for name, message, _, _ in entries if name == "stereo")
    assert isinstance(pair, StereoPair)
    assert np.array_equal(pair.left, pictures(0).left)
    assert not pair.left.flags.writeable


def test_the_bytes_are_those_of_the_wire(whole: Path) -> None:
    for name, frames, _ in BagReader(whole, ["stereo"]).frames():
        assert name == "stereo"
        assert len(frames) == 3
    first = next(BagReader(whole, ["stereo"]).frames())[1]
    assert [bytes(frame) for frame in first] == [
        bytes(frame) for frame in encode(pictures(0), header(1))
    ]
    assert np.frombuffer(first[1], np.uint8).ctypes.data % 8 == 0


def test_selection_by_topic_and_time(whole: Path) -> None:
    assert numbers(whole) == list(range(200))
    cut = numbers(whole, start_ns=10**9 + 50 * STEP_NS, end_ns=10**9 + 60 * STEP_NS)
    assert cut == list(range(50, 60))
    assert numbers(whole, start_ns=10**12) == []
    assert {name for name, *_ in BagReader(whole, ["estop", "stereo"])} == {"estop", "stereo"}
    assert list(BagReader(whole, ["sheet_target"])) == []
    with pytest.raises(BagError, match='did you mean "stereo"'):
        BagReader(whole, ["stero"])


def test_time_filter_reads_only_the_chunks_it_needs(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = BagReader(whole, start_ns=10**9, end_ns=10**9 + 1)
    assert len(reader.chunks) > 3
    read: list[int] = []
    original = BagReader.read_chunk

    def counting(self: BagReader, file: Any, chunk: Any) -> Any:
        read.append(chunk.offset)
        return original(self, file, chunk)

    monkeypatch.setattr(BagReader, "read_chunk", counting)
    assert len(list(reader)) == 2
    assert read == [reader.chunks[0].offset]


def test_order_of_log_time_across_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    order = np.random.default_rng(0).permutation(60)
    with BagWriter(path) as writer:
        for number in order:
            writer.write(TOPICS["twin/finger"], finger(number), header(1), int(number))
            writer.flush()
    assert numbers(path) == list(range(60))


def test_info_attachments_and_metadata(whole: Path) -> None:
    summary = info(whole)
    assert summary.complete
    assert summary.problem == ""
    assert summary.count == 221
    assert summary.start_ns == 10**9
    assert summary.duration_s == pytest.approx(1.99)
    by_name = {topic.name: topic for topic in summary.topics}
    assert by_name["twin/finger"].count == 200
    assert by_name["twin/finger"].rate_hz == pytest.approx(100.0)
    assert by_name["twin/finger"].type == "TwinFinger"
    assert by_name["estop"].rate_hz == 0.0
    assert all(topic.readable for topic in summary.topics)
    assert [held.name for held in summary.attachments] == ["launch.yaml", "offsets.json"]
    assert summary.metadata == {"clock": {"id": "clock"}}
    reader = BagReader(whole)
    assert reader.attachment("launch.yaml") == b"nodes: {}\n"
    with pytest.raises(
        BagError, match=r'does not contain the attachment "x"; attachments: launch.yaml'
    ):
        reader.attachment("x")


def test_other_tools_can_read_it(whole: Path) -> None:
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        rows = list(reader.iter_messages())
        assert len(rows) == 221
        schema, channel, message = next(row for row in rows if row[1].topic == "twin/finger")
        assert schema is not None
        assert schema.encoding == "jsonschema"
        assert b"velocity_world_m_per_s" in schema.data
        assert channel.message_encoding == "flexsheet/2"
        assert message.publish_time == 10
        assert message.sequence == 1


@given(st.lists(st.binary(max_size=70), min_size=1, max_size=5))
def test_frames_joined_and_split(frames: list[bytes]) -> None:
    data = join_frames(frames)
    assert [bytes(frame) for frame in split_frames(data)] == frames
    for wrong in (data[:-1], data + b"x"):
        with pytest.raises(WireError):
            split_frames(wrong)


@given(st.binary(max_size=100))
def test_foreign_data_is_rejected_as_frames(data: bytes) -> None:
    try:
        frames = split_frames(data)
    except WireError:
        return
    assert join_frames(frames)[8:] == data[8:]


def entries_by_boundary(path: Path) -> list[tuple[int, int]]:
    """Return pairs: the end of a complete chunk in bytes, and the number of messages before it."""
    found: list[tuple[int, int]] = []
    count = 0
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, ChunkRecord):
                inner = BagReader(path).chunks[len(found)]
                count += sum(len(times) for times in inner.times_ns.values())
                found.append((inner.offset + inner.length, count))
    return found


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[Any], Path]:
    folder = tmp_path_factory.mktemp("bags")
    path = folder / "sample.mcap"
    with BagWriter(path, {"clock": {"id": "c"}}) as writer:
        writer.add_attachment("launch.yaml", b"x" * 100, "text/plain")
        for number in range(60):
            writer.write(TOPICS["twin/finger"], finger(number), header(number + 1), number)
            if number == 20:
                writer.add_attachment("scene.yaml", b"y" * 100, "text/plain")
            if number % 6 == 5:
                writer.write(
                    TOPICS["estop"], EStop(engaged=True, reason="x"), header(number), number
                )
                writer.flush()
    return path.read_bytes(), entries_by_boundary(path), folder


def check_cut(data: bytes, boundaries: list[tuple[int, int]], cut: int, folder: Path) -> None:
    path = folder / "cut.mcap"
    path.write_bytes(data[:cut])
    wanted = max((count for end, count in boundaries if end <= cut), default=0)
    try:
        reader = BagReader(path)
    except BagError:
        assert wanted == 0
        return
    assert reader.complete == (cut == len(data))
    assert bool(reader.problem) != reader.complete
    got = list(reader)
    assert len(got) == wanted
    assert reader.info().count == wanted
    assert sum(topic.count for topic in reader.info().topics) == wanted


def test_bag_truncated_at_and_beside_every_boundary(sample: tuple[bytes, list[Any], Path]) -> None:
    data, boundaries, folder = sample
    assert len(boundaries) == 10
    for end, _ in boundaries:
        for cut in (end - 1, end, end + 1, end + 9, end + 12):
            check_cut(data, boundaries, cut, folder)
    for cut in (*range(40), len(data) - 1, len(data) - 8, len(data) - 9, len(data) - 40, len(data)):
        check_cut(data, boundaries, cut, folder)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_bag_truncated_at_any_byte(
    sample: tuple[bytes, list[Any], Path], draw: st.DataObject
) -> None:
    data, boundaries, folder = sample
    check_cut(data, boundaries, draw.draw(st.integers(0, len(data))), folder)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_bag_damaged_at_any_byte(
    sample: tuple[bytes, list[Any], Path], draw: st.DataObject
) -> None:
    """Reading a damaged bag returns only recorded messages, or raises BagError."""
    data, _, folder = sample
    damaged = bytearray(data)
    at = draw.draw(st.integers(0, len(data) - 1))
    damaged[at : at + 4] = draw.draw(st.binary(min_size=1, max_size=4))
    path = folder / "damaged.mcap"
    path.write_bytes(damaged)
    try:
        reader = BagReader(path)
        for name, message, _, log_ns in reader:
            if name == "twin/finger" and isinstance(message, TwinFinger):
                assert round(message.path_time_s) == log_ns
        reader.info()
    except BagError:
        pass
    out = folder / "saved.mcap"
    out.unlink(missing_ok=True)
    try:
        report = recover(path, out)
    except BagError:
        return
    assert len(list(BagReader(out).frames())) == report.messages


@given(st.binary(max_size=300))
def test_foreign_files(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "foreign.mcap"
    for content in (data, b"\x89MCAP0\r\n" + data):
        path.write_bytes(content)
        with pytest.raises(BagError, match=r"foreign\.mcap"):
            BagReader(path)


def test_common_foreign_files_are_rejected(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no bag at all\n")
    with pytest.raises(BagError, match="not an MCAP file"):
        info(text)
    (tmp_path / "empty").touch()
    with pytest.raises(BagError, match="is empty"):
        info(tmp_path / "empty")
    with pytest.raises(NoBagError, match="does not exist"):
        info(tmp_path / "absent")
    with pytest.raises(BagError, match="cannot be read"):
        info(tmp_path)
    other = tmp_path / "ros.mcap"
    with other.open("wb") as file:
        foreign: Any = Writer(file)
        foreign.start(profile="ros2")
        foreign.finish()
    with pytest.raises(BagError, match='profile "ros2", expected "flexsheet"'):
        info(other)


def test_existing_files_are_not_overwritten(whole: Path, tmp_path: Path) -> None:
    before = whole.read_bytes()
    with pytest.raises(BagError, match="cannot be overwritten"):
        BagWriter(whole)
    with pytest.raises(BagError, match="cannot be overwritten"):
        recover(whole, whole)
    assert whole.read_bytes() == before
    with pytest.raises(BagError, match="cannot be written"):
        BagWriter(tmp_path / "no" / "folder.mcap")
    writer = BagWriter(tmp_path / "closed.mcap")
    writer.close()
    writer.close()
    with pytest.raises(BagError, match="is closed"):
        fill(writer, 1)


def test_empty_bag(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "e.mcap"):
        pass
    assert list(BagReader(tmp_path / "e.mcap")) == []
    assert info(tmp_path / "e.mcap").complete


def test_full_disk_is_reported(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = BagWriter(tmp_path / "full.mcap")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(BagError, match=r"full\.mcap: cannot be written: File too large"):
            fill(writer, 10_000, flush_every=10)
        with pytest.raises(BagError, match="File too large"):
            fill(writer, 1)
        with pytest.raises(BagError, match="File too large"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(list(BagReader(tmp_path / "full.mcap"))) > 20


def test_changed_type_is_rejected_by_name_but_its_bytes_stay_readable(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = replace(TOPICS["twin/finger"], message=Fingertip)
    monkeypatch.setattr(bag_module, "TOPICS", {**TOPICS, "twin/finger": changed})
    words = r'topic "twin/finger": the recorded .* TwinFinger differs from the current one'
    with pytest.raises(BagError, match=words):
        list(BagReader(whole))
    assert len(list(BagReader(whole, ["stereo"]))) == 20
    assert len(list(BagReader(whole).frames())) == 221
    readable = {topic.name: topic.readable for topic in info(whole).topics}
    assert readable == {"twin/finger": False, "stereo": True, "estop": True}


def test_removed_topic(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        bag_module, "TOPICS", {n: t for n, t in TOPICS.items() if n != "twin/finger"}
    )
    with pytest.raises(BagError, match='this version of flexsheet has no topic "twin/finger"'):
        list(BagReader(whole))


def test_recover(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    report = recover(cut, saved)
    assert not report.was_complete
    assert report.damaged_chunks == report.orphan_messages == 0
    assert report.messages == info(cut).count > 50
    assert info(saved).complete
    assert [frames[1] for frames in BagReader(saved).frames()] == [
        frames[1] for frames in BagReader(cut).frames()
    ]
    assert BagReader(saved).attachment("launch.yaml") == b"nodes: {}\n"
    assert info(saved).metadata == {"clock": {"id": "clock"}}


def test_recover_leaves_out_a_damaged_chunk_only(whole: Path, tmp_path: Path) -> None:
    reader = BagReader(whole)
    chunk = reader.chunks[1]
    data = bytearray(whole.read_bytes())
    middle = chunk.offset + chunk.length // 2
    data[middle : middle + 8] = b"xxxxxxxx"
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with pytest.raises(BagError, match="damaged chunk at byte"):
        list(BagReader(damaged))
    report = recover(damaged, tmp_path / "saved.mcap")
    assert report.damaged_chunks == 1
    lost = sum(len(times) for times in chunk.times_ns.values())
    assert report.messages == 221 - lost
    assert len(list(BagReader(tmp_path / "saved.mcap"))) == report.messages


WRITE_FOREVER = """
import sys
sys.path.insert(0, sys.argv[2])
from flexsheet.messages.bag import BagWriter
from tests.test_messages_bag import TOPICS, finger, header
writer = BagWriter(sys.argv[1])
writer.add_attachment("launch.yaml", b"a", "text/plain")
for number in range(1000):
    writer.write(TOPICS["twin/finger"], finger(number), header(number + 1), number)
print("written", flush=True)
sys.stdin.read()
"""


def test_killed_writer_loses_at_most_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", WRITE_FOREVER, str(path), str(ROOT)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
    ) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == b"written\n"
            # The writer does nothing more: its own thread must bring the rest to the disk.
            wait_until(lambda: info(path).count == 1000, "1000 messages in the bag")
        finally:
            child.send_signal(signal.SIGKILL)
    summary = info(path)
    assert not summary.complete
    assert summary.count == 1000
    assert numbers(path) == list(range(1000))
    assert recover(path, tmp_path / "saved.mcap").messages == 1000
    assert info(tmp_path / "saved.mcap").complete
