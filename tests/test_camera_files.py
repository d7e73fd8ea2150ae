"""Test the frame times of video and image files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_bench import (
    FRAMES,
    HEIGHT,
    WIDTH,
    Image,
    load_scene,
    picture,
    read_number,
    running,
    write_video,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.nodes.camera.devices import ReaderThread, open_reader
from flexsheet.nodes.camera.files import read_times
from flexsheet.nodes.camera.image_pair import DeviceError, ImagePair, Reader
from flexsheet.nodes.camera.sources import AnySource, ImagesSource, VideoSource
from tests.waiting import DEADLINE_S

MS = 1_000_000
UNEVEN_MS = [0, 20, 40, 90, 100, 133]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene()


def write_timed_video(path: Path, frames: list[Image], times_ms: list[int]) -> Path:
    """Write a motion JPEG video in which each frame has its own time."""
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    height, width = frames[0].shape
    raw = [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, 1000.0, (width, height), raw)
    assert writer.isOpened()
    for frame, time_ms in zip(frames, times_ms, strict=True):
        writer.set(cv2.VIDEOWRITER_PROP_PTS, time_ms)
        writer.set(cv2.VIDEOWRITER_PROP_KEY_FLAG, 1)
        coded = cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))[1]
        writer.write(coded.reshape(1, -1))
    writer.release()
    return path


def write_images(folder: Path, count: int = FRAMES) -> dict[str, Path]:
    for number in range(count):
        for side, name in enumerate(("left", "right")):
            cv2.imwrite(str(folder / f"{name}{number:02}.png"), picture(number, side))
    return {"left": folder / "left*.png", "right": folder / "right*.png"}


def opened(source: AnySource, scene: Scene) -> Reader:
    return open_reader(source, scene.camera, lambda: 0)


def read_all(source: AnySource, scene: Scene, at_most: int = 1000) -> list[ImagePair]:
    reader = opened(source, scene)
    pictures = []
    while len(pictures) < at_most and (pair := reader.read()) is not None:
        pictures.append(pair)
    reader.close()
    return pictures


def times_ms(pictures: list[ImagePair]) -> list[float]:
    return [pair.exposure_ns / MS for pair in pictures]


def numbers(pictures: list[ImagePair]) -> list[tuple[int, int]]:
    return [(read_number(pair.left), read_number(pair.right) - 5) for pair in pictures]


def both(frames: list[int]) -> list[Image]:
    return [np.hstack([picture(n, 0), picture(n, 1)]) for n in frames]


def test_a_video_of_even_rate_has_its_frame_times(scene: Scene, tmp_path: Path) -> None:
    path = write_video(tmp_path / "both.avi", both([*range(FRAMES)]), rate_hz=50.0)
    pictures = read_all(VideoSource(kind="video", left=path), scene)
    assert times_ms(pictures) == pytest.approx([20.0 * n for n in range(FRAMES)], abs=1e-3)
    assert all(pair.skew_s == 0.0 for pair in pictures)
    assert pictures[0].notes == ("frame times of the file",)


@pytest.mark.parametrize("container", ["mkv", "mov"])
def test_a_video_of_variable_rate_keeps_it(scene: Scene, tmp_path: Path, container: str) -> None:
    path = write_timed_video(tmp_path / f"v.{container}", both([*range(FRAMES)]), UNEVEN_MS)
    pictures = read_all(VideoSource(kind="video", left=path), scene)
    assert times_ms(pictures) == pytest.approx(UNEVEN_MS, abs=1e-3)
    assert numbers(pictures) == [(n, n) for n in range(FRAMES)]


def test_a_rate_overrides_the_files_times(scene: Scene, tmp_path: Path) -> None:
    path = write_timed_video(tmp_path / "v.mkv", both([*range(FRAMES)]), UNEVEN_MS)
    pictures = read_all(VideoSource(kind="video", left=path, rate_hz=100.0), scene)
    assert times_ms(pictures) == pytest.approx([10.0 * n for n in range(FRAMES)])


async def test_the_published_stamps_follow_the_files_time(scene: Scene, tmp_path: Path) -> None:
    path = write_timed_video(tmp_path / "v.mkv", both([*range(FRAMES)]), UNEVEN_MS)
    async with running(scene, source={"kind": "video", "left": path}) as bench:
        await bench.until(lambda: NoteCode.SOURCE_ENDED in [one.code for one in bench.node.notes])
    shown = [(read_number(pair.left), header.source_ns) for pair, header in bench.sent]
    begin_ns = shown[0][1]
    assert shown[0][0] == 0
    for number, source_ns in shown:
        assert (source_ns - begin_ns) / MS == pytest.approx(UNEVEN_MS[number], abs=1e-3)


def test_two_videos_are_paired_by_their_times(scene: Scene, tmp_path: Path) -> None:
    """The right video lacks a frame, and its frames are 3 ms late from the second frame on."""
    left = write_timed_video(
        tmp_path / "l.mkv", [picture(n, 0) for n in range(6)], [0, 20, 40, 60, 80, 100]
    )
    right = write_timed_video(
        tmp_path / "r.mkv", [picture(n, 1) for n in (0, 1, 3, 4, 5)], [0, 23, 63, 83, 103]
    )
    pictures = read_all(VideoSource(kind="video", left=left, right=right), scene)
    assert numbers(pictures) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert [pair.skew_s for pair in pictures] == pytest.approx([0, *[3e-3] * 4])
    assert times_ms(pictures) == pytest.approx([0, 21.5, 61.5, 81.5, 101.5], abs=1e-3)
    assert pictures[-1].notes[-1] == "1 frames without a partner"


def test_two_videos_end_with_the_shorter_one(scene: Scene, tmp_path: Path) -> None:
    left = write_video(tmp_path / "l.avi", [picture(n, 0) for n in range(5)])
    right = write_video(tmp_path / "r.avi", [picture(n, 1) for n in range(3)])
    source = VideoSource(kind="video", left=left, right=right)
    assert numbers(read_all(source, scene)) == [(0, 0), (1, 1), (2, 2)]


def test_time_runs_on_when_a_video_begins_again(scene: Scene, tmp_path: Path) -> None:
    path = write_timed_video(tmp_path / "v.mkv", both([0, 1, 2]), [0, 20, 50])
    source = VideoSource(kind="video", left=path, loop=True)
    assert times_ms(read_all(source, scene, 7)) == pytest.approx(
        [0, 20, 50, 80, 100, 130, 160], abs=1e-3
    )


class TimelessVideo:
    """A decoder of a video without frame times."""

    def __init__(self, path: str, api: int) -> None:
        """Do nothing."""

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, Image]:
        return True, np.hstack([picture(0, 0), picture(0, 1)])

    def get(self, property_id: int) -> float:
        return 0.0

    def release(self) -> None:
        """Do nothing."""


def test_a_video_without_frame_times_needs_a_rate(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bare.h264"
    path.touch()
    monkeypatch.setattr(cv2, "VideoCapture", TimelessVideo)
    reader = opened(VideoSource(kind="video", left=path), scene)
    reader.read()
    with pytest.raises(
        DeviceError, match=r"bare\.h264: the time of frame 1, 0 ms, is not after.*set rate_hz"
    ):
        reader.read()
    timed = opened(VideoSource(kind="video", left=path, rate_hz=50.0), scene)
    pictures = [timed.read(), timed.read()]
    assert [pair and pair.exposure_ns for pair in pictures] == [0, 20 * MS]


def test_images_take_their_times_from_a_file(scene: Scene, tmp_path: Path) -> None:
    patterns = write_images(tmp_path)
    times = tmp_path / "times.csv"
    rows = [f"{5 + ms / 1000},note" for ms in UNEVEN_MS]
    times.write_text("\n".join(["t_s, what", *rows]))
    source = ImagesSource(kind="images", times=times, **patterns)
    assert times_ms(read_all(source, scene)) == pytest.approx(UNEVEN_MS, abs=1e-3)


def test_images_without_times_come_at_the_scenes_rate(scene: Scene, tmp_path: Path) -> None:
    source = ImagesSource(kind="images", loop=True, **write_images(tmp_path, 2))
    expected = [n * 1000 / scene.camera.rate_hz for n in range(5)]
    assert times_ms(read_all(source, scene, 5)) == pytest.approx(expected, abs=1e-3)


def test_one_looping_pair_comes_at_the_given_rate(scene: Scene, tmp_path: Path) -> None:
    patterns = write_images(tmp_path, 1)
    source = ImagesSource(kind="images", loop=True, rate_hz=100.0, **patterns)
    assert times_ms(read_all(source, scene, 3)) == pytest.approx([0, 10, 20])


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("t_ms\n1\n2\n", r"times\.csv: the column t_s is missing"),
        ("", r"times\.csv: the column t_s is missing"),
        ("t_s\n1\n", r"times\.csv has 1 rows for 2 image pairs"),
        ("t_s\n1\nsoon\n", r"times\.csv, line 3: t_s is 'soon'; it must be a number of seconds"),
        ("t_s\n1\nnan\n", r"times\.csv, line 3: t_s is 'nan'; it must be a number of seconds"),
        ("x,t_s\n0,1\n0\n", r"times\.csv, line 3: t_s is None; it must be a number of seconds"),
        (
            "t_s\n2\n2\n",
            r"times\.csv, line 3: t_s is 2 s, which is not after the time in the previous row",
        ),
    ],
)
def test_wrong_times_are_named(tmp_path: Path, text: str, printed: str) -> None:
    path = tmp_path / "times.csv"
    path.write_text(text)
    with pytest.raises(DeviceError, match=printed):
        read_times(path, 2)


def test_absent_times_and_times_beside_a_rate_are_rejected(scene: Scene, tmp_path: Path) -> None:
    patterns = write_images(tmp_path, 1)
    absent = ImagesSource(kind="images", times=tmp_path / "absent.csv", **patterns)
    with pytest.raises(DeviceError, match=r"absent\.csv: file not found"):
        opened(absent, scene)
    twice = absent.model_copy(update={"rate_hz": 50.0})
    with pytest.raises(
        DeviceError, match=r"source has times \(.*absent\.csv\) and rate_hz; remove one of them"
    ):
        opened(twice, scene)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(
    steps_us=st.lists(st.integers(1, 10**9), min_size=1, max_size=20),
    begin_us=st.integers(-(10**9), 10**9),
)
def test_times_come_back_as_they_were_written(
    tmp_path: Path, steps_us: list[int], begin_us: int
) -> None:
    microseconds = np.cumsum([begin_us, *steps_us])
    path = tmp_path / "times.csv"
    path.write_text("t_s\n" + "".join(f"{us / 1e6:.6f}\n" for us in microseconds))
    read_us = np.array(read_times(path, len(microseconds))) / 1000
    np.testing.assert_allclose(read_us, microseconds - begin_us, atol=0.01)


def test_a_side_by_side_video_has_the_scenes_size(scene: Scene, tmp_path: Path) -> None:
    path = write_video(tmp_path / "both.avi", both([0]))
    (pair,) = read_all(VideoSource(kind="video", left=path), scene)
    assert pair.left.shape == pair.right.shape == (HEIGHT, WIDTH)


def test_times_that_are_not_text_are_reported(tmp_path: Path) -> None:
    times = tmp_path / "times.csv"
    times.write_text("t_s\n0.0\n0.1\n", encoding="utf-16")
    with pytest.raises(DeviceError, match=r"times\.csv is not a CSV file with UTF-8 text"):
        read_times(times, 2)


def test_all_errors_of_a_reader_are_reported() -> None:
    """Without a report, the node would seem healthy after the end of the thread."""
    errors: list[DeviceError] = []

    def corrupted() -> Reader:
        raise MemoryError("no room for a picture")

    def tell(error: DeviceError) -> None:
        errors.append(error)
        if len(errors) == 2:
            thread.stop()

    thread = ReaderThread(
        corrupted,
        camera=load_scene().camera,
        name="cam",
        now=lambda: 0,
        retry_s=0.001,
        deliver=lambda pictures, lost: None,
        fail=tell,
        report=lambda text: None,
        warn=lambda text: None,
        finish=lambda pairs: None,
    )
    thread.start()
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert [str(error) for error in errors] == ["cam: MemoryError: no room for a picture"] * 2
