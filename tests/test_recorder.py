"""Test the recorder: complete bags, counted losses, full disks and killed processes."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import runs
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages import bag
from flexsheet.messages.bag import FLUSH_PERIOD_S, BagError, BagReader, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import EStop
from flexsheet.messages.wire import encode, read_envelope
from flexsheet.nodes.recorder.bag_recording import RETRY_NS, free_path
from flexsheet.nodes.recorder.node import Recorder
from flexsheet.nodes.recorder.parameters import RecorderParameters
from tests.node_harness import NodeHarness
from tests.note_text import note_text
from tests.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(folder))
    yield folder
    shutil.rmtree(folder)


def recorder(clock: VirtualClock, **parameters: Any) -> Recorder:
    return NodeHarness(
        Recorder,
        RecorderParameters(**{"attach": (), **parameters}),
        clock,
        name="recorder",
        topics={"in/estop": "estop", "in/status": "status", "status": "status"},
    ).node


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def estop_message(number: int) -> tuple[list[Any], Header]:
    header = Header(number, 100 + number, 200 + number, "clock", "hand", 7)
    return encode(EStop(engaged=True, reason=f"number {number}"), header), header


async def test_it_writes_what_came_with_times_and_attachments(tmp_path: Path) -> None:
    clock = VirtualClock(5000, clock_id="clock")
    (tmp_path / "launch.yaml").write_text("nodes: {}\n")
    node = recorder(clock, bag=tmp_path / "deep/a.mcap", attach=(tmp_path / "launch.yaml",))
    await node.setup()
    for number in (1, 2):
        clock.move_to(5000 + number)
        frames, header = estop_message(number)
        node.deliver("in/estop", frames, header)
    await node.close()
    reader = BagReader(tmp_path / "deep/a.mcap")
    entries = list(reader)
    assert [(topic, header.sequence, log) for topic, _, header, log in entries] == [
        ("estop", 1, 5001), ("estop", 2, 5002),
    ]  # fmt: skip
    assert [bytes(frames[0]) for _, frames, _ in reader.frames()] == [
        bytes(estop_message(number)[0][0]) for number in (1, 2)
    ]
    assert reader.attachment("launch.yaml") == b"nodes: {}\n"
    assert reader.metadata["recording"]["clock_id"] == "clock"
    assert node.inputs["in/estop"].counts.messages == 2


def test_which_topics_it_subscribes_to() -> None:
    written = [TOPICS[name] for name in ("scene", "stereo", "fingertip")]

    def wants(**parameters: Any) -> list[str]:
        return list(Recorder.further_inputs(RecorderParameters(bag="a", **parameters), written))

    assert wants() == ["scene", "fingertip"]
    assert wants(include=("stereo", "scene")) == ["scene", "fingertip", "stereo"]
    assert wants(topics=("stereo",)) == ["stereo"]


async def test_it_never_writes_over_a_bag(tmp_path: Path) -> None:
    for _ in range(2):
        node = recorder(VirtualClock(), bag=tmp_path / "a.mcap")
        await node.setup()
        await node.close()
    assert names_in(tmp_path) == ["a-2.mcap", "a.mcap"]


@pytest.mark.parametrize("limit", [{"max_bag_duration_s": 10.0}, {"max_bag_bytes": 1}])
async def test_a_bag_is_split_and_no_message_is_lost(
    tmp_path: Path, limit: dict[str, float]
) -> None:
    """Each further bag begins with the latched messages, so that it can be replayed alone."""
    clock = VirtualClock(clock_id="clock")
    node = recorder(clock, bag=tmp_path / "a.mcap", **limit)
    await node.setup()
    for number in (1, 2):
        node.deliver("in/estop", *estop_message(number))
        clock.move_to(clock.now_ns() + 11_000_000_000)
        node.watch_disk()
    await node.close()
    recorded = [
        [header.sequence for _, _, header, _ in BagReader(tmp_path / name)]
        for name in ("a.mcap", "a-2.mcap", "a-3.mcap")
    ]
    assert recorded == [[1], [1, 2], [2]]


def test_free_paths_count_up(tmp_path: Path) -> None:
    for expected in ("a.mcap", "a-2.mcap", "a-3.mcap"):
        path = free_path(tmp_path / "a.mcap")
        assert path.name == expected
        path.touch()


async def test_a_bag_is_named_after_its_start(tmp_path: Path) -> None:
    node = recorder(VirtualClock(), bag=tmp_path / "run-%Y.mcap")
    await node.setup()
    await node.close()
    (name,) = names_in(tmp_path)
    assert name.removeprefix("run-").removesuffix(".mcap").isdigit()


async def test_a_path_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    node = recorder(VirtualClock(), bag=tmp_path / "file" / "a.mcap")
    with pytest.raises(BagError, match="file: the folder cannot be created"):
        await node.setup()
    await node.close()
    node = recorder(VirtualClock(), bag=tmp_path / "a.mcap", attach=(tmp_path / "no.yaml",))
    with pytest.raises(OSError, match=r"no\.yaml"):
        await node.setup()
    await node.close()


async def test_a_failing_disk_is_reported_and_losses_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = VirtualClock()
    node = recorder(clock, bag=tmp_path / "a.mcap", keep_free_bytes=0)
    await node.setup()
    node.deliver("in/estop", *estop_message(1))

    def refuse(*arguments: Any) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(BagWriter, "write_frames", refuse)
    for number in (2, 3, 4):
        node.deliver("in/estop", *estop_message(number))
        node.watch_disk()
    assert node.inputs["in/estop"].counts.dropped == 3
    assert node.errors == 1
    assert [one.code for one in node.notes] == [NoteCode.NOT_RECORDING]
    assert "Input/output error" in note_text(node)
    # It is asked again after a while, in vain, and then it has come back.
    clock.move_to(clock.now_ns() + RETRY_NS)
    node.watch_disk()
    assert node.errors == 2
    monkeypatch.undo()
    clock.move_to(clock.now_ns() + RETRY_NS)
    node.watch_disk()
    node.deliver("in/estop", *estop_message(5))
    await node.close()
    assert len(list(BagReader(tmp_path / "a.mcap"))) == 1
    assert names_in(tmp_path) == ["a-2.mcap", "a.mcap"]
    again = BagReader(tmp_path / "a-2.mcap")
    assert again.metadata["recording"]["lost_messages"] == "3"
    # Latched, the newest of what was lost meanwhile comes first.
    assert [header.sequence for _, _, header, _ in again] == [4, 5]


@pytest.fixture
def small_disk() -> Iterator[Path]:
    """Mount a separate disk of 48 MiB."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(folder)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if mounted.returncode:
        folder.rmdir()
        pytest.skip(f"no disk can be mounted here: {mounted.stderr.strip()}")
    yield folder
    # Lazily: what a failed command had open is closed with its traceback.
    subprocess.run(["umount", "--lazy", str(folder)], check=True)
    folder.rmdir()


@pytest.mark.parametrize("keep_free_bytes", [8 << 20, 0])
async def test_on_a_full_disk_the_bag_ends_readable_and_another_follows(
    small_disk: Path, keep_free_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bag that is closed in time has an index. A bag on a suddenly full disk has none."""
    # Chunks are cut by their size alone, however long the test takes.
    monkeypatch.setattr(bag, "FLUSH_PERIOD_S", DEADLINE_S)
    clock = VirtualClock()
    node = recorder(clock, bag=small_disk / "a.mcap", keep_free_bytes=keep_free_bytes)
    await node.setup()
    sent = 0

    def send(count: int) -> None:
        nonlocal sent
        for _ in range(count):
            sent += 1
            clock.move_to(clock.now_ns() + 1000)
            # Beyond recognition, so that nothing makes it small.
            reason = random.Random(sent).randbytes(20_000).hex()
            header = Header(sent, sent, sent, "clock", "hand", 7)
            node.deliver("in/status", encode(EStop(engaged=True, reason=reason), header), header)

    send(20)
    left = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
    filler = small_disk / "filler"
    filler.write_bytes(bytes(left - (4 << 20)))
    if keep_free_bytes:
        node.watch_disk()
    send(300)
    assert [one.code for one in node.notes] == [NoteCode.NOT_RECORDING]
    lost = node.inputs["in/status"].counts.dropped
    assert lost == 300 if keep_free_bytes else 100 < lost <= 200
    first = BagReader(small_disk / "a.mcap")
    assert first.complete == bool(keep_free_bytes)
    kept = [header.sequence for _, _, header in read_headers(first)]
    assert kept == list(range(1, len(kept) + 1))
    # A chunk may not have made it.
    assert 320 - lost - 60 <= len(kept) <= 320 - lost
    filler.unlink()
    node.watch_disk()
    assert [one.code for one in node.notes] == [NoteCode.NOT_RECORDING], (
        "it is not asked again at once"
    )
    clock.move_to(clock.now_ns() + RETRY_NS)
    node.watch_disk()
    send(20)
    await node.close()
    second = BagReader(small_disk / "a-2.mcap")
    assert second.complete
    assert [header.sequence for _, _, header in read_headers(second)] == list(range(321, 341))
    assert second.metadata["recording"]["lost_messages"] == str(lost)


def read_headers(reader: BagReader) -> Iterator[tuple[str, list[Any], Header]]:
    for topic, frames, _ in reader.frames():
        yield topic, frames, read_envelope(frames, TOPICS["estop"]).header


async def recorded(bag: Path, since_ns: float) -> int:
    """Wait until a growing bag contains a finger message of a given time or later. Return its
    sequence number.
    """
    async with asyncio.timeout(DEADLINE_S):
        while True:
            with suppress(FileNotFoundError, BagError):
                for _, _, header, log_ns in BagReader(bag, ["twin/finger"]):
                    if log_ns >= since_ns:
                        return header.sequence
            await asyncio.sleep(0.05)


async def test_killed_it_loses_at_most_what_came_since_the_last_flush(tmp_path: Path) -> None:
    """At most one second of messages is lost."""
    assert FLUSH_PERIOD_S <= 1.0
    nodes = {
        "beacon": {"type": "tests.launch_nodes:Beacon", "parameters": {"rate_hz": 100}},
        "recorder": {
            "type": "recorder",
            "parameters": {"bag": str(tmp_path / "a.mcap")},
            "restart": {"delay_s": 0.0},
        },
    }
    (tmp_path / "graph.yaml").write_text(json.dumps({"nodes": nodes}))
    async with RunningGraph(load_graph(tmp_path / "graph.yaml")) as graph:
        await graph.wait_ready(DEADLINE_S)
        running_ns = time.monotonic_ns()
        # More than what the first flush wrote, and no chunk is full by then.
        on_disk = await recorded(tmp_path / "a.mcap", running_ns + FLUSH_PERIOD_S * 1e9)
        graph.kill("recorder")
        async with asyncio.timeout(DEADLINE_S):
            await graph.wait_ready_again("recorder", 1)
        await recorded(tmp_path / "a-2.mcap", running_ns)
    cut = BagReader(tmp_path / "a.mcap", ["twin/finger"])
    assert not cut.complete
    entries = list(cut)
    sequences = [header.sequence for _, _, header, _ in entries]
    assert sequences == list(range(sequences[0], sequences[-1] + 1))
    assert sequences[-1] >= on_disk
    assert cut.attachment("plan.json")
    second = BagReader(tmp_path / "a-2.mcap", ["twin/finger"])
    assert second.complete
    assert next(iter(second))[2].sequence > sequences[-1]


FLOODED = """
import asyncio, time
import numpy as np
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Publisher, Subscriber
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.node import PortCounts

async def main():
    topic, endpoint = find_topic("stereo"), ["ipc://" + sys.argv[1]]
    pixels = np.zeros((480, 640), np.uint8)
    pair = StereoPair(device="", exposure_s=0, dropped_frames=0, left=pixels, right=pixels)
    publisher, heard = Publisher(topic, endpoint), asyncio.Event()
    Subscriber(topic, endpoint, lambda *_: heard.set(), PortCounts()).start()
    before = 0
    while not heard.is_set():
        before += 1
        publisher.send(pair, Header(before, 0, 0, "c", "w", 1))
        await asyncio.sleep(0.01)
    for i in range(before, before + 200):
        publisher.send(pair, Header(i + 1, 0, 0, "c", "w", 1))
        time.sleep(0.001)
    publisher.close()
    # The loop stands still on purpose, for longer than a heartbeat: that is what the fault needs.
    time.sleep(2.5)

asyncio.run(main())
"""


@pytest.mark.alone
def test_a_reader_that_is_behind_outlives_its_writer(runs_root: Path) -> None:
    """In an earlier version, a heartbeat of libzmq aborted the recorder after the end of the
    camera.
    """
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + FLOODED, str(runs_root / "s")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
