"""Test the head camera with a fake camera, and the detector with a photograph."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Lens
from flexsheet.messages.types import Eye
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.camera import head_eyes, head_node
from flexsheet.nodes.camera.head_eyes import EyeFilter, load_detector, locate_eyes
from flexsheet.nodes.camera.head_node import HeadCamera, HeadCameraParameters
from flexsheet.nodes.camera.image_pair import DeviceError
from flexsheet.nodes.renderer.output import select_eyes
from tests.scenes import CYLINDER_FILE, load_cylinder
from tests.waiting import until

SCENE = load_cylinder()
CENTRE = SCENE.eyes.centre_world_m
LENS = Lens(fx_px=610.0, fy_px=605.0, cx_px=322.0, cy_px=236.0,
            distortion=(-0.1, 0.05, 0.001, -0.002, 0.0))  # fmt: skip
CAMERA_M = np.array([0.02, 0.25, 0.01])
TILT_RAD = 0.2
SIZE = (480, 640)


def world_from_camera() -> Floats:
    """Return the pose of a camera above the screen that is tilted down towards the user."""
    z = np.array([0.0, -np.sin(TILT_RAD), np.cos(TILT_RAD)])
    x = np.array([-1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, np.cross(z, x), z, CAMERA_M])
    return pose


def project(points: Floats) -> Floats:
    """Project world points (n, 3) into the image of the camera, px."""
    pose = world_from_camera()
    rotation, _ = cv2.Rodrigues(pose[:3, :3].T)
    matrix = np.array([[LENS.fx_px, 0, LENS.cx_px], [0, LENS.fy_px, LENS.cy_px], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(
        points, rotation, -pose[:3, :3].T @ CAMERA_M, matrix, np.array(LENS.distortion)
    )
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def eyes_at(centre: Floats, yaw_rad: float = 0.0) -> Floats:
    """Return the positions (2, 3) of the left and right eye of a head, rotated about the
    vertical.
    """
    half = 0.5 * SCENE.eyes.interocular_m * np.array([np.cos(yaw_rad), 0.0, np.sin(yaw_rad)])
    return np.array([centre - half, centre + half])


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.1, 0.05, 0.2), (-0.08, 0.0, -0.05)])
def test_eyes_are_located_by_their_distance_in_the_image(offset: tuple[float, ...]) -> None:
    centre = CENTRE + np.array(offset)
    found, right = locate_eyes(project(eyes_at(centre)), LENS, SCENE.eyes.interocular_m,
                               world_from_camera())  # fmt: skip
    np.testing.assert_allclose(found, centre, atol=1e-4)
    np.testing.assert_allclose(right, [SCENE.eyes.interocular_m, 0.0, 0.0], atol=1e-4)


def test_a_rotated_head_is_located_too_far_away_by_the_stated_factor() -> None:
    yaw_rad = np.deg2rad(20.0)
    centre = CAMERA_M + 0.45 * world_from_camera()[:3, 2]
    found, _ = locate_eyes(project(eyes_at(centre, yaw_rad)), LENS, SCENE.eyes.interocular_m,
                           world_from_camera())  # fmt: skip
    ratio = np.linalg.norm(found - CAMERA_M) / 0.45
    assert ratio == pytest.approx(1.0 / np.cos(yaw_rad), rel=0.01)


def test_the_filter_reduces_noise_at_rest_and_follows_a_motion() -> None:
    random = np.random.default_rng(5)
    times = np.arange(300) / 15.0
    noise = random.normal(0.0, 0.003, (300, 3))
    still = EyeFilter(1.0, 20.0)
    rest = np.array([still.update(*one) for one in zip(times, noise, strict=True)])
    assert rest[50:].std() < 0.6 * noise[50:].std()
    moving = EyeFilter(1.0, 20.0)
    path = np.outer(times, [0.3, 0.0, 0.0])
    followed = np.array([moving.update(*one) for one in zip(times, path, strict=True)])
    lag_s = (path - followed)[50:, 0] / 0.3
    assert lag_s.max() < 1.0 / (2.0 * np.pi * 5.0), "the cutoff frequency is over 5 Hz at 0.3 m/s"


class FakeCapture:
    """A fake camera that delivers an image when the test permits it."""

    def __init__(self, shape: tuple[int, int] = SIZE) -> None:
        self.image = np.zeros(shape, np.uint8)
        self.released = threading.Event()
        self._permits = threading.Semaphore(0)
        self.fails = False

    def deliver(self) -> None:
        self._permits.release()

    def set(self, *_: float) -> bool:
        return True

    def grab(self) -> bool:
        return self._permits.acquire(timeout=60.0) and not self.fails

    def retrieve(self) -> tuple[bool, Any]:
        return True, self.image

    def release(self) -> None:
        self.released.set()


class Harness:
    """A head camera node with a fake camera, and the messages that the node has published."""

    def __init__(self, capture: FakeCapture) -> None:
        self.capture, self.clock = capture, VirtualClock()
        self.pixels: Floats | None = project(eyes_at(CENTRE))
        self.search_ns = 0
        self.sent: list[Eye] = []
        self.thread_names: set[str] = set()
        pose = {"position_m": CAMERA_M.tolist(), "rpy_rad": [-TILT_RAD, 0.0, np.pi]}
        self.node = HeadCamera(
            HeadCameraParameters.model_validate(
                {"lens": LENS, "world_from_camera": pose, "retry_s": 0.001}
            ),
            name="head", clock=self.clock, send=lambda _, message, __: self.sent.append(message),
        )  # fmt: skip

    def detect(self, image: Any) -> Floats | None:
        self.thread_names.add(threading.current_thread().name)
        self.clock.move_to(self.clock.now_ns() + self.search_ns)
        return self.pixels

    async def next_eye(self, step_ns: int = 100_000_000) -> Eye:
        """Deliver an image after a time step, and return the published eye message."""
        count = len(self.sent)
        self.clock.move_to(self.clock.now_ns() + step_ns)
        self.capture.deliver()
        await until(lambda: len(self.sent) > count, "an eye")
        return self.sent[-1]


@asynccontextmanager
async def running(
    monkeypatch: pytest.MonkeyPatch,
    capture: FakeCapture | None = None,
    load: Callable[[int], Any] | None = None,
) -> AsyncIterator[Harness]:
    harness = Harness(capture or FakeCapture())
    monkeypatch.setattr(head_node, "open_capture", lambda _: harness.capture)
    monkeypatch.setattr(head_node, "load_detector", load or (lambda _: harness.detect))
    await harness.node.setup()
    harness.node.on_scene(SCENE, Header(1, 0, 0, "virtual", "t", 1))
    try:
        yield harness
    finally:
        reader = harness.node.reader
        assert reader is not None
        reader.stopping.set()
        harness.capture.deliver()
        await harness.node.close()
        assert not reader.is_alive()


async def test_eyes_are_published_with_the_time_of_the_exposure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch) as harness:
        eye = await harness.next_eye()
        assert eye.valid
        np.testing.assert_allclose(eye.centre_world_m, CENTRE, atol=1e-4)
        used, across, note = select_eyes(SCENE.eyes, eye)
        np.testing.assert_allclose(used.centre_world_m, CENTRE, atol=1e-4)
        np.testing.assert_allclose(across, [1.0, 0.0, 0.0], atol=1e-3)
        assert note == ""
        assert all(name.startswith("head camera") for name in harness.thread_names)
    assert harness.capture.released.is_set()


async def test_without_a_face_the_eyes_are_invalid_and_keep_their_position(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch) as harness:
        seen = await harness.next_eye()
        harness.pixels = None
        lost = await harness.next_eye()
        assert not lost.valid
        np.testing.assert_array_equal(lost.centre_world_m, seen.centre_world_m)
        assert "no face" in harness.node.note
        moved = CENTRE + np.array([0.1, 0.0, 0.0])
        harness.pixels = project(eyes_at(moved))
        found = await harness.next_eye(step_ns=10**9)
        assert found.valid
        np.testing.assert_allclose(found.centre_world_m, moved, atol=1e-4)


async def test_silence_makes_the_eyes_invalid_until_the_next_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch) as harness:
        await harness.next_eye()
        harness.clock.move_to(harness.clock.now_ns() + 200_000_000)
        await harness.node.watch()
        assert harness.sent[-1].valid, "the last image is new"
        harness.clock.move_to(harness.clock.now_ns() + 10**9)
        await harness.node.watch()
        assert not harness.sent[-1].valid
        assert (await harness.next_eye(step_ns=0)).valid


async def test_implausible_eyes_are_invalid(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch) as harness:
        harness.pixels = project(eyes_at(CENTRE + np.array([0.0, 0.0, 2.0])))
        assert not (await harness.next_eye()).valid
        assert "check lens and world_from_camera" in harness.node.note


async def test_images_above_the_rate_limit_are_not_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch) as harness:
        first = await harness.next_eye()
        harness.capture.deliver()  # no time has passed
        second = await harness.next_eye()
        assert harness.sent == [first, second]


async def test_an_image_that_waited_during_a_slow_search_is_not_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch) as harness:
        harness.search_ns = 10**9
        first = await harness.next_eye()
        harness.capture.deliver()  # it arrived during the search
        second = await harness.next_eye()
        assert harness.sent == [first, second]


@pytest.mark.parametrize("shape", [SIZE, (240, 320)])
async def test_a_failed_camera_is_reported_and_opened_again(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """The camera fails if it delivers no image, or an image of the wrong size."""
    broken = FakeCapture(shape)
    broken.fails = shape == SIZE
    async with running(monkeypatch, broken) as harness:
        harness.capture = FakeCapture()
        broken.deliver()
        await until(lambda: harness.node.errors, "the report")
        assert (
            "does not deliver images any more" if broken.fails else "320x240 px"
        ) in harness.node.note
        await until(broken.released.is_set, "the release")
        assert (await harness.next_eye()).valid


async def test_without_the_packages_the_node_runs_and_names_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(head_eyes, "find_spec", lambda _: None)
    async with running(monkeypatch, load=load_detector) as harness:
        await until(lambda: harness.node.note, "the note")
        assert "pip install 'flexsheet[head]'" in harness.node.note
        harness.clock.move_to(10**9)
        await harness.node.watch()
        (eye,) = harness.sent
        assert not eye.valid
        np.testing.assert_array_equal(eye.centre_world_m, CENTRE)
        assert harness.node.errors == 1, "the retries are not counted again"


PUPILS_PX = np.array([[306.3, 186.7], [223.0, 189.7]])
"""Pupils of the left and right eye in Matplotlib's sample photograph, read by eye, +-1 px."""


@pytest.mark.parametrize("search_width_px", [480, 1000])
def test_the_real_detector_finds_the_pupils_of_a_photograph(search_width_px: int) -> None:
    """The tolerance is 8 % of the distance between the eyes, about 5 mm."""
    pytest.importorskip("dlib", reason="pip install 'flexsheet[head]'")
    from matplotlib.cbook import get_sample_data

    image = cv2.imread(str(get_sample_data("grace_hopper.jpg", asfileobj=False)), 0)
    assert image is not None
    try:
        detect = load_detector(search_width_px)
    except DeviceError as error:
        pytest.skip(str(error))
    pixels = detect(np.asarray(image, dtype=np.uint8))
    assert pixels is not None
    distance_px = np.linalg.norm(PUPILS_PX[0] - PUPILS_PX[1])
    assert np.linalg.norm(pixels - PUPILS_PX, axis=1).max() < 0.08 * distance_px
    assert detect(np.full(SIZE, 128, np.uint8)) is None

    # In an image at 80 % of the size, the head is 1 / 0.8 times as far away.
    small = detect(cv2.resize(image, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA))
    assert small is not None
    assert np.linalg.norm(small[0] - small[1]) / np.linalg.norm(
        pixels[0] - pixels[1]
    ) == pytest.approx(0.8, rel=0.03)


def test_a_launch_file_connects_the_eyes(tmp_path: Path) -> None:
    file = tmp_path / "graph.yaml"
    file.write_text(f"scene: {CYLINDER_FILE}\nnodes:\n  head: {{type: head_camera}}\n")
    assert load_graph(file).writers["eye"][0].name == "head"
