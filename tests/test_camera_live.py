"""Test live cameras with fakes of cv2.VideoCapture and real threads."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from camera_bench import (
    HEIGHT,
    WIDTH,
    CameraBag,
    FakeCamera,
    load_scene,
    picture,
    read_number,
    running,
)
from hypothesis import given
from hypothesis import strategies as st

from flexsheet.messages.scene import Scene
from flexsheet.nodes.camera import live
from flexsheet.nodes.camera.image_pair import DeviceError, ImagePair, Region, Regions
from flexsheet.nodes.camera.live import CameraReader
from flexsheet.nodes.camera.sources import OpenCvSource
from flexsheet.nodes.camera.stamps import MAX_IMPLAUSIBLE, SLACK, Pairing, StampCheck
from tests.examples import examples
from tests.note_text import note_text
from tests.waiting import DEADLINE_S

MS = 1_000_000
PERIOD_NS = round(1e9 / 60)
PAIR = {"kind": "live", "left": 0, "right": 2}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene()


@pytest.fixture
def bag(monkeypatch: pytest.MonkeyPatch) -> Iterator[CameraBag]:
    bag = CameraBag()
    monkeypatch.setattr(cv2, "VideoCapture", bag.open)
    yield bag
    bag.empty()


@pytest.fixture
def cameras(bag: CameraBag) -> tuple[FakeCamera, FakeCamera]:
    return bag.plug(0), bag.plug(2)


@contextmanager
def reading(
    bag: CameraBag, scene: Scene, wanted: Regions | None = None, **source: Any
) -> Iterator[CameraReader]:
    """Open a reader of both cameras, and close it at the end."""
    description = OpenCvSource.model_validate({**PAIR, **source})
    reader = CameraReader(description, scene.camera, bag.now_ns, wanted)
    try:
        yield reader
    finally:
        bag.empty()
        reader.close()


def read(reader: CameraReader) -> ImagePair:
    pictures = reader.read()
    assert pictures is not None
    return pictures


def test_the_drivers_stamp_gives_the_exposure(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    with reading(bag, scene) as reader:
        left.shoot(100 * MS, number=1)
        right.shoot(103 * MS, number=1, side=1)
        pictures = read(reader)
    # 4 ms of exposure: its middle is 2 ms before the stamp; and 1.5 ms is the middle of both.
    assert pictures.exposure_ns == pytest.approx(bag.base_ns + 99.5 * MS, abs=1000)
    assert pictures.skew_s == pytest.approx(3e-3, abs=1e-6)
    assert pictures.exposure_s == pytest.approx(4e-3)
    assert "stamped by the driver" in pictures.notes
    assert (read_number(pictures.left), read_number(pictures.right) - 5) == (1, 1)


def test_a_driver_that_stamps_the_beginning_of_the_exposure(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    with reading(bag, scene, exposure_to_stamp_s=-0.002) as reader:
        for camera in cameras:
            camera.shoot(100 * MS)
        assert read(reader).exposure_ns == pytest.approx(bag.base_ns + 102 * MS, abs=1000)


@pytest.mark.parametrize("stamp_ns", [0, 1_790_000_000 * 10**9], ids=["none", "time of day"])
def test_stamps_of_another_clock_are_replaced_by_the_arrival(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene, stamp_ns: int
) -> None:
    left, right = cameras
    with reading(bag, scene) as reader:
        for number in range(MAX_IMPLAUSIBLE):
            left.shoot(number * PERIOD_NS, number=number)
            right.shoot(number * PERIOD_NS, number=number, side=1, stamp_ns=stamp_ns)
        pictures = read(reader)
    assert "stamped on arrival" in pictures.notes
    newest_ns = bag.base_ns + (MAX_IMPLAUSIBLE - 1) * PERIOD_NS
    assert pictures.exposure_ns == newest_ns + 8 * MS - 2 * MS
    assert read_number(pictures.left) == read_number(pictures.right) - 5 == MAX_IMPLAUSIBLE - 1


def test_a_stated_delay_from_exposure_to_arrival(
    bag: CameraBag, scene: Scene, cameras: tuple[FakeCamera, FakeCamera]
) -> None:
    """OpenCV provides no timestamps for a network stream."""
    bag.cameras = {"rtsp://left": cameras[0], "rtsp://right": cameras[1]}
    source = {"left": "rtsp://left", "right": "rtsp://right", "exposure_to_grab_s": 0.020}
    with reading(bag, scene, **source) as reader:
        for camera in cameras:
            camera.shoot(100 * MS)
        assert read(reader).exposure_ns == bag.base_ns + (100 + 8 - 20) * MS
        assert all("exposure" in text for text in reader.warnings if "rate" not in text)


@given(
    offset_ns=st.integers(-(10**19), 10**19),
    jitter_ns=st.lists(st.integers(0, 15 * MS), min_size=MAX_IMPLAUSIBLE, max_size=30),
)
def test_only_a_reading_of_our_clock_is_believed(offset_ns: int, jitter_ns: list[int]) -> None:
    check = StampCheck()
    arrivals = [10**15 + n * PERIOD_NS + jitter for n, jitter in enumerate(jitter_ns)]
    stamps = [10**15 + n * PERIOD_NS - offset_ns for n in range(len(jitter_ns))]
    good = [check.is_plausible(s, a) for s, a in zip(stamps, arrivals, strict=True)]
    if 0 <= offset_ns <= 900 * MS:
        assert all(good)
        assert check.trusted
    if not -2 * 10**9 <= offset_ns <= 2 * 10**9:
        assert not any(good)
        assert not check.trusted


def test_one_lapse_costs_one_frame_and_a_repeated_stamp_is_one() -> None:
    check = StampCheck()
    stamps = [100, 200, 200, 300, 0, 400]
    assert [check.is_plausible(s * MS, 1000 * MS) for s in stamps] == [
        True,
        True,
        False,
        True,
        False,
        True,
    ]
    assert check.trusted


@examples(100)
@given(
    phase=st.floats(-0.49, 0.49),
    lost_left=st.sets(st.integers(0, 39)),
    lost_right=st.sets(st.integers(0, 39)),
    jitter=st.lists(st.floats(-0.004, 0.004), min_size=80, max_size=80),
)
def test_frames_meet_their_own_partner(
    phase: float, lost_left: set[int], lost_right: set[int], jitter: list[float]
) -> None:
    """Two cameras without a common trigger lose frames, and the frames arrive in any order."""
    moments = {
        ("left", n): round((n + jitter[n]) * PERIOD_NS) for n in range(40) if n not in lost_left
    } | {
        ("right", n): round((n + phase + jitter[40 + n]) * PERIOD_NS)
        for n in range(40)
        if n not in lost_right
    }
    pairing = Pairing(PERIOD_NS * 1e-9)
    queues: dict[str, deque[tuple[str, int]]] = {"left": deque(), "right": deque()}
    pairs = []
    for frame in sorted(moments, key=lambda frame: moments[frame]):
        queues[frame[0]].append(frame)
        pair = pairing.pop_pair(queues["left"], queues["right"], lambda frame: moments[frame])
        if pair is not None:
            pairs.append(pair)
    waiting = len(queues["left"]) + len(queues["right"])
    assert 2 * len(pairs) + pairing.unpaired + waiting == len(moments)
    for left, right in pairs:
        assert abs(moments[right] - moments[left]) <= (0.5 + SLACK) * PERIOD_NS + 1
    if abs(phase) <= 0.4:
        # Nobody nearer than the own partner: every frame that has one meets it.
        kept = set(range(40)) - lost_left - lost_right
        assert [(left[1], right[1]) for left, right in pairs] == [(n, n) for n in sorted(kept)]


async def test_the_skew_is_published_and_too_much_is_rejected(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    async with running(scene, clock=bag, source=PAIR, max_skew_s=0.004) as bench:
        left.shoot(0)
        right.shoot(3 * MS)
        await bench.until(lambda: len(bench.sent) == 1)
        assert bench.sent[0][0].skew_s == pytest.approx(3e-3, abs=1e-6)
        left.shoot(PERIOD_NS)
        right.shoot(PERIOD_NS - 6 * MS)
        await bench.until(lambda: bench.node.rejected == 1)
        assert "pairs-rejected: 1, -6.0 ms between left and right exposure" in note_text(bench.node)
        left.shoot(2 * PERIOD_NS)
        right.shoot(2 * PERIOD_NS + MS)
        await bench.until(lambda: len(bench.sent) == 2)
        pair, header = bench.sent[1]
        assert pair.dropped_frames == 1
        assert header.source_ns == pytest.approx(bag.base_ns + 2 * PERIOD_NS - 1.5 * MS, abs=1000)
        bag.empty()


async def test_frames_that_a_camera_lost_show_in_its_stamps(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    async with running(scene, clock=bag, source=PAIR) as bench:
        for number, lost_so_far in ((0, 0), (1, 0), (4, 2), (5, 2)):
            left.shoot(number * PERIOD_NS + (number % 2) * MS)
            right.shoot(number * PERIOD_NS)
            await bench.until(lambda: bool(bench.sent) and len(left.shots.queue) == 0)
            count = {0: 1, 1: 2, 4: 3, 5: 4}[number]
            await bench.until(lambda count=count: len(bench.sent) == count)
            assert bench.sent[-1][0].dropped_frames == lost_so_far
        # The right camera alone loses one: the left's is without a partner, and a pair is lost.
        left.shoot(6 * PERIOD_NS)
        left.shoot(7 * PERIOD_NS)
        right.shoot(7 * PERIOD_NS)
        await bench.until(lambda: len(bench.sent) == 5)
        assert bench.sent[-1][0].dropped_frames == 3
        assert "1 frames without a partner" in note_text(bench.node)
        bag.empty()


def test_a_side_by_side_camera_has_one_exposure(bag: CameraBag, scene: Scene) -> None:
    camera = bag.plug("/dev/video4")
    with reading(bag, scene, left="/dev/video4", right=None) as reader:
        camera.shoot(50 * MS, image=np.hstack([picture(2, 0), picture(3, 1)]))
        pictures = read(reader)
        assert camera.properties[cv2.CAP_PROP_FRAME_WIDTH] == 2 * WIDTH
    assert (read_number(pictures.left), read_number(pictures.right) - 5) == (2, 3)
    assert pictures.skew_s == 0.0
    assert pictures.exposure_ns == pytest.approx(bag.base_ns + 48 * MS, abs=1000)


def test_settings_are_made_in_the_devices_units(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    camera = scene.camera.model_copy(update={"gain": 12.0})
    scene = scene.model_copy(update={"camera": camera})
    with reading(bag, scene, pixel_format="MJPG") as reader:
        for fake in cameras:
            has = fake.properties
            assert has[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
            assert has[cv2.CAP_PROP_EXPOSURE] == 40
            assert has[cv2.CAP_PROP_GAIN] == 12
            assert has[cv2.CAP_PROP_AUTO_WB] == 0
            assert has[cv2.CAP_PROP_FPS] == 60
            assert has[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")
            assert (has[cv2.CAP_PROP_FRAME_WIDTH], has[cv2.CAP_PROP_FRAME_HEIGHT]) == (
                WIDTH,
                HEIGHT,
            )
            # A device without auto focus gets no command for it.
            assert (cv2.CAP_PROP_AUTOFOCUS, 0.0) not in fake.calls
        assert reader.warnings == ()


async def test_a_rejected_setting_is_reported_once(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    left.bounds[cv2.CAP_PROP_EXPOSURE] = (78, 10_000)
    left.fixed.add(cv2.CAP_PROP_AUTO_WB)
    right.fixed.add(cv2.CAP_PROP_FPS)
    async with running(scene, clock=bag, source=PAIR, retry_s=0.01) as bench:
        for fake in cameras:
            fake.shoot(0)
        await bench.until(lambda: len(bench.sent) == 1)
        # The exposure that the device has is what is published and reckoned with.
        pair, header = bench.sent[0]
        assert pair.exposure_s == pytest.approx(7.8e-3)
        assert header.source_ns == pytest.approx(bag.base_ns - (3.9 + 2.0) / 2 * MS, abs=1000)
        assert bench.node.errors == 3
        for text in (
            "camera 0: exposure: requested 40 units of 100 us, actual: 78",
            "camera 0: auto white balance: requested 0 (off), actual: 1",
            "camera 2: rate: requested 60 Hz, actual: 30 Hz",
        ):
            assert text in note_text(bench.node)
        for fake in cameras:
            fake.shots.put(None)
        await bench.until(lambda: bench.node.errors == 4 and len(right.captures) == 2)
        left.shoot(PERIOD_NS)
        right.shoot(PERIOD_NS)
        await bench.until(lambda: len(bench.sent) == 2)
        assert bench.node.errors == 4
        bag.empty()


def test_with_automatic_exposure_the_exposure_is_unknown(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    for fake in cameras:
        fake.fixed |= {cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE}
    with reading(bag, scene) as reader:
        assert "camera 0: auto exposure: requested 1 (manual), actual: 3" in reader.warnings
        for fake in cameras:
            fake.shoot(0)
        assert read(reader).exposure_s == scene.camera.exposure_s


SENSOR = {"FRAME_WIDTH": WIDTH, "FRAME_HEIGHT": HEIGHT, "XI_OFFSET_X": 0, "XI_OFFSET_Y": 0}
WANTED = (Region(32, 20, 64, 40), Region(16, 30, 80, 50))


def ximea(bag: CameraBag) -> tuple[FakeCamera, FakeCamera]:
    properties = {**SENSOR, "XI_AEAG": 1, "FPS": 60}
    return bag.plug(0, **properties), bag.plug(2, **properties)


def test_a_device_reads_the_region_only(bag: CameraBag, scene: Scene) -> None:
    fakes = ximea(bag)
    with reading(bag, scene, WANTED, api="ximea") as reader:
        for fake, region in zip(fakes, WANTED, strict=True):
            assert fake.properties[cv2.CAP_PROP_XI_OFFSET_X] == region.column
            assert fake.properties[cv2.CAP_PROP_XI_OFFSET_Y] == region.row
            assert fake.properties[cv2.CAP_PROP_EXPOSURE] == 4000
            fake.shoot(0, image=np.zeros((region.height, region.width), np.uint8))
        pictures = read(reader)
    assert pictures.regions == WANTED


def test_a_device_that_cannot_begin_there_reads_everything(bag: CameraBag, scene: Scene) -> None:
    fakes = ximea(bag)
    fakes[1].fixed.add(cv2.CAP_PROP_XI_OFFSET_X)
    with reading(bag, scene, WANTED, api="ximea") as reader:
        assert fakes[1].properties[cv2.CAP_PROP_FRAME_WIDTH] == WIDTH
        assert fakes[1].properties[cv2.CAP_PROP_XI_OFFSET_Y] == 0
        fakes[0].shoot(0, image=np.zeros((40, 64), np.uint8))
        fakes[1].shoot(0)
        assert read(reader).regions == (WANTED[0], Region(0, 0, WIDTH, HEIGHT))


async def test_the_regions_come_out_with_their_origins(bag: CameraBag, scene: Scene) -> None:
    fakes = ximea(bag)
    fakes[1].fixed.add(cv2.CAP_PROP_XI_OFFSET_X)
    region = {"left": list(WANTED[0]), "right": list(WANTED[1])}
    ramp = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)).astype(np.uint8)
    source = {**PAIR, "api": "ximea"}
    async with running(scene, clock=bag, source=source, region=region) as bench:
        fakes[0].shoot(0, image=ramp[20:60, 32:96])
        fakes[1].shoot(0, image=ramp)
        await bench.until(lambda: len(bench.sent) == 1)
        pair, _ = bench.sent[0]
        assert (pair.left_origin_px, pair.right_origin_px) == ((32, 20), (16, 30))
        np.testing.assert_array_equal(pair.left, ramp[20:60, 32:96])
        np.testing.assert_array_equal(pair.right, ramp[30:80, 16:96])
        assert "regions cropped from the device's region" in note_text(bench.node)
        bag.empty()


@pytest.mark.alone
async def test_a_camera_is_unplugged_and_comes_back(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    async with running(scene, clock=bag, source=PAIR, retry_s=0.01) as bench:
        for fake in cameras:
            fake.shoot(0)
        await bench.until(lambda: len(bench.sent) == 1)
        right.unplug()
        left.shots.put(None)
        await bench.until(lambda: "cannot be opened" in note_text(bench.node))
        assert note_text(bench.node).startswith("no-images: 2 cannot be opened")
        assert all(capture.released.is_set() for capture in right.captures)
        tried = len(left.captures)
        await bench.until(lambda: len(left.captures) > tried)
        right.plugged = True
        opened = len(right.captures)
        await bench.until(lambda: len(right.captures) > opened)
        left.shoot(10 * PERIOD_NS, number=3)
        right.shoot(10 * PERIOD_NS, number=3, side=1)
        await bench.until(lambda: len(bench.sent) == 2)
        assert bench.numbers()[-1] == (3, 3)
        bag.empty()


@pytest.mark.alone
def test_a_camera_that_hangs_is_named_and_released_when_it_wakes(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    left, right = cameras
    with reading(bag, scene, silence_s=0.5) as reader:
        for fake in cameras:
            fake.shoot(0)
        read(reader)
        left.shoot(PERIOD_NS)
        with pytest.raises(DeviceError, match=r"^camera 2: no image for 0\.5 s; check the device"):
            read(reader)
        left.shots.put(None)
        reader.close()
        assert not right.captures[0].released.is_set()
        right.shots.put(None)
        assert right.captures[0].released.wait(DEADLINE_S)


@pytest.mark.alone
def test_two_cameras_without_pairs_are_reported(
    bag: CameraBag,
    cameras: tuple[FakeCamera, FakeCamera],
    scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "FIRST_FRAME_S", 0.01)
    with reading(bag, scene, silence_s=1.0) as reader:
        told_of: list[str] = []

        def wait_for_a_pair() -> None:
            with pytest.raises(DeviceError) as caught:
                reader.read()
            told_of.append(str(caught.value))

        waiting = threading.Thread(target=wait_for_a_pair)
        waiting.start()
        for number in range(3):
            cameras[0].shoot(3 * number * PERIOD_NS)
            cameras[1].shoot((3 * number + 1) * PERIOD_NS)
        waiting.join(DEADLINE_S)
    assert told_of
    assert "no two images were taken within half a period" in told_of[0]


def test_a_reader_that_waits_is_interrupted(
    bag: CameraBag, cameras: tuple[FakeCamera, FakeCamera], scene: Scene
) -> None:
    with reading(bag, scene, silence_s=60.0) as reader:
        results: list[ImagePair | None] = []
        waiting = threading.Thread(target=lambda: results.append(reader.read()))
        waiting.start()
        reader.interrupt()
        waiting.join(DEADLINE_S)
        assert results == [None]


def test_a_failed_second_camera_lets_go_of_the_first(bag: CameraBag, scene: Scene) -> None:
    left = bag.plug(0)
    with pytest.raises(DeviceError, match=r"^2 cannot be opened"):
        CameraReader(OpenCvSource.model_validate(PAIR), scene.camera, bag.now_ns)
    assert left.captures[0].released.is_set()
