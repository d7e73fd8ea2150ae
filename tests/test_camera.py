"""Test the camera node with video and image files."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_bench import (
    FRAMES,
    HEIGHT,
    WIDTH,
    CameraHarness,
    load_scene,
    picture,
    read_number,
    running,
    write_video,
)
from pydantic import ValidationError

from flexsheet.messages.base import Header
from flexsheet.messages.notes import Note, NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.camera.devices import ReaderThread, open_reader
from flexsheet.nodes.camera.image_pair import DeviceError, ImagePair, split_side_by_side
from flexsheet.nodes.camera.node import CameraParameters
from flexsheet.nodes.camera.sources import ImagesSource, OpenCvSource, VideoSource
from tests.note_text import note_text
from tests.waiting import DEADLINE_S


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene()


@pytest.fixture
def videos(tmp_path: Path) -> tuple[Path, Path]:
    left, right = ([picture(n, side) for n in range(FRAMES)] for side in (0, 1))
    return write_video(tmp_path / "l.avi", left), write_video(tmp_path / "r.avi", right)


@pytest.fixture
def side_by_side(tmp_path: Path) -> Path:
    frames = [np.hstack([picture(n, 0), picture(n, 1)]) for n in range(FRAMES)]
    return write_video(tmp_path / "both.avi", frames)


@pytest.fixture
def images(tmp_path: Path) -> dict[str, str]:
    for number in range(FRAMES):
        cv2.imwrite(str(tmp_path / f"left{number:02}.png"), picture(number, 0))
        colour = cv2.cvtColor(picture(number, 1), cv2.COLOR_GRAY2BGR)
        cv2.imwrite(str(tmp_path / f"right{number:02}.png"), colour)
    return {"left": str(tmp_path / "left*.png"), "right": str(tmp_path / "right*.png")}


IN_ORDER = [(number, number) for number in range(FRAMES)]


async def test_two_video_files_are_played_to_their_end(
    scene: Scene, videos: tuple[Path, Path]
) -> None:
    source = {"kind": "video", "left": videos[0], "right": videos[1]}
    async with running(scene, source=source) as bench:
        await bench.until(lambda: NoteCode.SOURCE_ENDED in [one.code for one in bench.node.notes])
        assert bench.node.notes == (
            Note(code=NoteCode.SOURCE_ENDED, detail=f"{FRAMES} pairs read"),
        )
        # A busy machine publishes only the newest.
        numbers = bench.numbers()
        assert numbers == sorted(set(numbers) & set(IN_ORDER))
        assert numbers[-1] == IN_ORDER[-1]
        stamps = [header.source_ns for _, header in bench.sent]
        assert stamps == sorted(set(stamps))
        assert {pair.device for pair, _ in bench.sent} == {scene.camera.device}
        assert bench.node.errors == 0


async def test_a_side_by_side_video_is_cut_in_the_middle(scene: Scene, side_by_side: Path) -> None:
    source = {"kind": "video", "left": side_by_side, "rate_hz": 200.0}
    async with running(scene, source=source) as bench:
        await bench.until(lambda: NoteCode.SOURCE_ENDED in [one.code for one in bench.node.notes])
        assert all(left == right for left, right in bench.numbers())
        assert bench.sent[0][0].left.shape == (HEIGHT, WIDTH)


async def test_a_video_starts_again_when_it_loops(scene: Scene, videos: tuple[Path, Path]) -> None:
    source = {"kind": "video", "left": videos[0], "right": videos[1], "rate_hz": 100, "loop": True}
    async with running(scene, source=source) as bench:
        await bench.until(lambda: bench.numbers().count((0, 0)) >= 3)
        assert NoteCode.SOURCE_ENDED not in [one.code for one in bench.node.notes]


def test_images_come_in_the_order_of_their_names(scene: Scene, images: dict[str, str]) -> None:
    reader = open_reader(ImagesSource(kind="images", **images), scene.camera, lambda: 0)
    pairs = list(iter(reader.read, None))
    assert [(read_number(pair.left), read_number(pair.right) - 5) for pair in pairs] == IN_ORDER


async def test_looping_images_and_a_new_scene(scene: Scene, images: dict[str, str]) -> None:
    source = {"kind": "images", **images, "rate_hz": 200, "loop": True}
    async with running(scene, source=source) as bench:
        await bench.until(lambda: len(bench.sent) > 2 * FRAMES)
        first = bench.node.reader
        other = scene.camera.model_copy(update={"device": "renamed"})
        again = scene.model_copy(update={"camera": other})
        await bench.node.step("scene", again, Header(2, 0, 0, "virtual", "test", 1))
        assert first is not None
        assert not first.is_alive()
        await bench.until(lambda: bench.sent[-1][0].device == "renamed")


async def test_a_live_camera_is_reopened_when_it_ends(scene: Scene, side_by_side: Path) -> None:
    """OpenCV opens a video file like a camera. The end of the file corresponds to an unplugged
    camera.
    """
    source = {"kind": "live", "left": str(side_by_side)}
    async with running(scene, source=source, retry_s=0.01) as bench:
        # A file has no exposure control and its own rate: both are reported once.
        await bench.until(lambda: bench.node.errors >= 4 and len(bench.sent) > 2)
        assert len(bench.node.warned) == 2
        assert "does not deliver images any more" in bench.node.last_error
        assert all(left == right for left, right in bench.numbers())


async def test_a_camera_that_is_not_there_is_tried_again(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "camera.avi"
    source = {"kind": "live", "left": str(path)}
    async with running(scene, source=source, retry_s=0.01) as bench:
        await bench.until(lambda: bench.node.errors >= 2)
        assert f"{str(path)!r} cannot be opened" in note_text(bench.node)
        assert bench.sent == []
        frames = [np.hstack([picture(n, 0), picture(n, 1)]) for n in range(FRAMES)]
        write_video(tmp_path / "ready.avi", frames).rename(path)
        await bench.until(lambda: len(bench.sent) > 0)


async def test_images_of_another_size_are_an_error(scene: Scene, tmp_path: Path) -> None:
    wide = write_video(tmp_path / "w.avi", [picture(n, 0, 2 * WIDTH) for n in range(3)])
    source = {"kind": "video", "left": wide, "right": wide}
    async with running(scene, source=source, retry_s=0.01) as bench:
        await bench.until(lambda: bench.node.errors >= 1)
        assert "left view has 320x120 px" in bench.node.last_error
        assert "160x120" in bench.node.last_error
        assert bench.sent == []


async def test_the_twins_images_pass_with_their_time(scene: Scene) -> None:
    async with running(scene, source="twin") as bench:
        pair = StereoPair(
            device="twin-bumblebee",
            exposure_s=0.004,
            dropped_frames=3,
            left=picture(1, 0),
            right=picture(1, 1),
        )
        header = Header(1, 123_456, 130_000, bench.node.clock.id, "twin", 1)
        await bench.node.step("twin__stereo", pair, header)
        passed, passed_header = bench.sent[0]
        assert passed.left is pair.left
        assert passed.right is pair.right
        assert (passed.device, passed.exposure_s) == (pair.device, pair.exposure_s)
        assert passed.dropped_frames == pair.dropped_frames
        assert passed.left_origin_px == passed.right_origin_px == (0, 0)
        assert passed_header.source_ns == 123_456
        wrong = pair.model_copy(update={"right": picture(1, 1, 80)})
        await bench.node.step("twin__stereo", wrong, header)
        assert "right view has 80x120 px" in bench.node.last_error
        assert len(bench.sent) == 1
        assert bench.node.reader is None


async def test_the_measured_offset_is_added_to_timestamps(scene: Scene) -> None:
    async with running(scene, source="twin", stamp_offset_s=-0.002) as bench:
        pair = StereoPair(
            device="t", exposure_s=0, dropped_frames=0, left=picture(1, 0), right=picture(1, 1)
        )
        header = Header(1, 9_000_000, 9_500_000, bench.node.clock.id, "twin", 1)
        await bench.node.step("twin__stereo", pair, header)
        assert bench.sent[0][1].source_ns == 7_000_000


async def test_the_twins_images_are_left_alone_by_a_real_camera(
    scene: Scene, images: dict[str, str]
) -> None:
    pair = StereoPair(
        device="t", exposure_s=0, dropped_frames=0, left=picture(0, 0), right=picture(0, 1)
    )
    bench = CameraHarness(source={"kind": "images", **images})
    await bench.node.step("twin__stereo", pair, Header(1, 1, 1, "virtual", "twin", 1))
    assert bench.sent == []


@pytest.mark.parametrize(
    ("source", "printed"),
    [
        (lambda p: VideoSource(kind="video", left=p / "absent.avi"), "absent.avi: file not found"),
        (lambda p: VideoSource(kind="video", left=p / "text.avi"), "cannot be opened"),
        (lambda p: OpenCvSource(kind="live", left=str(p / "absent")), "cannot be opened"),
        (
            lambda p: ImagesSource(kind="images", left=str(p / "x*.png"), right=str(p / "a*.png")),
            "matches no file",
        ),
        (
            lambda p: ImagesSource(kind="images", left=str(p / "a*.png"), right=str(p / "b*.png")),
            "matches 2 files, .* 1",
        ),
    ],
    ids=["absent video", "no video", "absent camera", "no images", "unequal images"],
)
def test_what_cannot_be_opened_is_named(
    scene: Scene, tmp_path: Path, source: Callable[[Path], Any], printed: str
) -> None:
    (tmp_path / "text.avi").write_text("no video")
    for name in ("a1.png", "a2.png", "b1.png"):
        cv2.imwrite(str(tmp_path / name), picture(0, 0))
    with pytest.raises(DeviceError, match=printed):
        open_reader(source(tmp_path), scene.camera, lambda: 0)


def test_an_unreadable_image_is_named(scene: Scene, tmp_path: Path) -> None:
    for name in ("l.png", "r.png"):
        (tmp_path / name).write_text("no picture")
    source = ImagesSource(kind="images", left=str(tmp_path / "l*"), right=str(tmp_path / "r*"))
    with pytest.raises(DeviceError, match=r"l\.png cannot be read as an image"):
        open_reader(source, scene.camera, lambda: 0).read()


def test_a_side_by_side_image_of_odd_width_is_rejected() -> None:
    with pytest.raises(DeviceError, match="camera: an image with the odd width of 161 px"):
        split_side_by_side(picture(0, 0, 161), "camera")


class StutteringReader:
    """A reader at 60 Hz that loses three frames."""

    paced = False
    rate_hz: float | None = 60.0
    warnings: tuple[str, ...] = ()
    opened: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.frames = iter([1, 2, 3, 7, 8])

    def read(self) -> ImagePair | None:
        frame = next(self.frames, None)
        if frame is None:
            return None
        return ImagePair(picture(0, 0), picture(0, 1), round(frame * 1e9 / 60))

    def interrupt(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def test_frames_that_a_device_lost_are_counted(scene: Scene) -> None:
    lost: list[int] = []
    ended = threading.Event()
    thread = ReaderThread(
        StutteringReader,
        camera=scene.camera,
        name="stutter",
        now=lambda: 0,
        retry_s=1.0,
        deliver=lambda pictures, count: lost.append(count),
        fail=lambda error: pytest.fail(str(error)),
        report=lambda text: None,
        warn=pytest.fail,
        finish=lambda pairs: ended.set(),
    )
    thread.start()
    thread.join(DEADLINE_S)
    assert ended.is_set()
    assert lost == [0, 0, 0, 3, 3]


class BrokenReader(StutteringReader):
    """A reader that raises an error of OpenCV."""

    def read(self) -> ImagePair | None:
        raise cv2.error("no such colour")


def test_an_error_inside_opencv_is_a_device_error_and_tried_again(scene: Scene) -> None:
    failures: list[str] = []

    def fail(error: DeviceError) -> None:
        failures.append(str(error))
        if len(failures) == 2:
            thread.stop()

    thread = ReaderThread(
        BrokenReader,
        camera=scene.camera,
        name="broken",
        now=lambda: 0,
        retry_s=0.001,
        deliver=lambda pictures, count: pytest.fail("nothing to deliver"),
        fail=fail,
        report=lambda text: None,
        warn=pytest.fail,
        finish=lambda pairs: pytest.fail("not finished"),
    )
    thread.start()
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert failures == ["broken: OpenCV: no such colour"] * 2


@pytest.mark.parametrize(
    "source",
    [
        "twim",
        {"kind": "live"},
        {"kind": "video", "left": "a", "lop": True},
        {"kind": "twin", "x": 1},
    ],
)
def test_a_wrong_source_is_rejected(source: object) -> None:
    with pytest.raises(ValidationError):
        CameraParameters.model_validate({"source": source})
