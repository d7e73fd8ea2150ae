"""Pixels to fingertip: the mark, the node, and all the ways in which there is no fingertip."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ruamel.yaml import YAML

from messages.base import Header, Message
from messages.calibration import Board, CalibrationFileError, StereoCalibration, save_calibration
from messages.clock import VirtualClock
from messages.scene import Scene
from messages.topics import Topic
from messages.types import FingerPath, Fingertip, StereoPair, TwinFinger
from nodes.triangulator.mark import (
    MARK_METHODS,
    MarkLooks,
    find_mark_near,
    find_marks,
    window_around,
)
from nodes.triangulator.node import Triangulator, TriangulatorParameters
from nodes.twin.finger_node import TwinFingerNode, TwinFingerParameters
from nodes.twin.pixels import TwinCamera

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
FRAME_NS = round(1e9 / 60)
LOOKS = MarkLooks()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.model_validate(YAML(typ="safe").load(SCENE_FILE.read_text()))


@pytest.fixture(scope="module")
def camera(scene: Scene) -> TwinCamera:
    return TwinCamera(scene.camera, finger_radius_m=scene.finger.radius_m, seed=4)


def disc(
    centre: tuple[float, float], *, radius: float = 4.0, level: float = 200.0, ground: float = 30.0
) -> Image:
    """A disc on an even ground, every pixel lit by the share of it that is covered."""
    y, x = np.mgrid[0 : 100 * 8, 0 : 120 * 8] / 8.0 - 0.4375
    covered = np.hypot(x - centre[0], y - centre[1]) < radius
    share = covered.reshape(100, 8, 120, 8).mean(axis=(1, 3))
    return np.rint(ground + share * (level - ground)).astype(np.uint8)


@given(x=st.floats(20, 100), y=st.floats(20, 80), radius=st.floats(2.5, 8))
@settings(max_examples=40, deadline=None)
def test_centres_are_exact_to_a_fraction_of_a_pixel(x: float, y: float, radius: float) -> None:
    """Without a lens's blur the least mark is hardest: the grid's worst place, not its mean."""
    image = disc((x, y), radius=radius)
    for name, limit_px in (("moments", 0.35), ("weighted_centroid", 0.06)):
        marks = find_marks(image, LOOKS, MARK_METHODS[name].centroid)
        assert len(marks) == 1
        assert np.linalg.norm(marks[0] - [x, y]) < limit_px


@pytest.mark.parametrize("name", sorted(MARK_METHODS))
def test_a_window_gives_the_same_centre_as_the_whole_picture(name: str) -> None:
    image, centroid = disc((61.3, 40.7)), MARK_METHODS[name].centroid
    whole = find_marks(image, LOOKS, centroid)[0]
    near = find_mark_near(image, LOOKS, centroid, np.array([65.0, 45.0]))[0]
    lost = find_mark_near(image, LOOKS, centroid, np.array([5.0, 90.0]))[0]
    outside = find_mark_near(image, LOOKS, centroid, np.array([-500.0, np.nan]))[0]
    for found in (near, lost, outside):
        assert np.allclose(found, whole, atol=0.02)


def test_a_window_keeps_inside_the_picture() -> None:
    assert window_around(np.array([2.0, 3.0]), (480, 640), 10) == (slice(0, 14), slice(0, 13))
    assert window_around(np.array([-50.0, 3.0]), (480, 640), 10) is None
    assert window_around(np.array([np.inf, 3.0]), (480, 640), 10) is None


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((100, 120), np.uint8),
        np.full((100, 120), 255, np.uint8),
        np.full((100, 120), 128, np.uint8),
        disc((60, 40), level=70),
        disc((60, 40), radius=0.9),
        disc((60, 40), radius=30),
        disc((60, 1)),
        disc((118, 40)),
        np.random.default_rng(0).integers(0, 256, (100, 120)).astype(np.uint8),
    ],
    ids=["black", "saturated", "grey", "dim", "speck", "lamp", "cut top", "cut right", "chaos"],
)
def test_what_is_no_mark_is_not_found(image: Image) -> None:
    marks = find_marks(image, LOOKS, MARK_METHODS["weighted_centroid"].centroid)
    assert len(marks) != 1


class Bench:
    """A triangulator on a bench: pictures in by hand, fingertips out."""

    def __init__(self, camera: TwinCamera, **parameters: Any) -> None:
        self.camera, self.clock, self.sent = camera, VirtualClock(), list[Fingertip]()
        self.node = Triangulator(
            TriangulatorParameters(**parameters), name="eye", clock=self.clock, send=self.keep
        )
        self.frame = 0

    def keep(self, topic: Topic, message: Message, header: Header) -> None:
        assert topic.name == "fingertip"
        assert isinstance(message, Fingertip)
        assert header.source_ns == self.stamp_ns()
        self.sent.append(message)

    def stamp_ns(self) -> int:
        return self.frame * FRAME_NS

    async def start(self, scene: Scene) -> Bench:
        await self.node.setup()
        await self.node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
        return self

    async def show(
        self, left: Image, right: Image, *, frames: int = 1, epoch: int = 1
    ) -> Fingertip:
        self.frame += frames
        pair = StereoPair(
            device=self.camera.camera.device,
            exposure_s=0.004,
            dropped_frames=0,
            left=left,
            right=right,
        )
        header = Header(self.frame, self.stamp_ns(), self.stamp_ns(), "virtual", "camera", epoch)
        await self.node.step("stereo", pair, header)
        assert self.node.errors == 0, self.node.last_error
        return self.sent[-1]

    def pictures(self, *tips: tuple[float, float, float]) -> tuple[Image, Image]:
        """Pictures of so many fingers at once: the brighter of each pixel."""
        left, right = self.camera.picture(lambda _: np.array([0, 0, 5.0]), exposure_s=0.004)
        for tip in tips:
            pair = self.camera.picture(lambda _, tip=tip: np.array(tip), exposure_s=0.004)
            left, right = np.maximum(left, pair[0]), np.maximum(right, pair[1])
        return left, right


HERE = (0.01, 0.0, 0.02)
FAR = (0.09, 0.05, 0.02)


async def test_each_reason_and_back_again(scene: Scene, camera: TwinCamera) -> None:
    bench = await Bench(camera).start(scene)
    empty, here = bench.pictures(), bench.pictures(HERE)
    black, white = np.zeros_like(here[0]), np.full_like(here[0], 255)
    behind = bench.pictures((0.0, 0.0, -0.16))
    crossed = here[0], np.roll(here[1], 12, axis=0)

    async def reason(pictures: tuple[Image, Image]) -> str:
        return (await bench.show(*pictures)).reason

    before_any = await bench.show(*empty)
    assert (before_any.valid, before_any.reason) == (False, "no_mark")
    assert np.linalg.eigvalsh(before_any.covariance).min() >= 1.0

    first = await bench.show(*here)
    assert (first.valid, first.reason) == (True, "ok")
    assert np.linalg.norm(first.position_world_m - HERE) < 3e-4

    cases = {
        "no_mark": [empty, (black, black), (white, white)],
        "mark_in_one_view": [(here[0], empty[1]), (empty[0], here[1])],
        "two_marks": [bench.pictures(HERE, (0.03, 0.0, 0.02))],
        "inconsistent": [crossed],
        "outside_volume": [behind],
        "too_fast": [bench.pictures(FAR)],
    }
    for expected, all_pictures in cases.items():
        for pictures in all_pictures:
            last_good = (await bench.show(*here)).position_world_m
            shown = await bench.show(*pictures)
            assert (shown.valid, shown.reason) == (False, expected)
            assert np.array_equal(shown.position_world_m, last_good)
            assert await reason(here) == "ok"


async def test_a_second_mark_far_from_a_followed_one_does_not_disturb(
    scene: Scene, camera: TwinCamera
) -> None:
    bench = await Bench(camera).start(scene)
    await bench.show(*bench.pictures(HERE))
    assert (await bench.show(*bench.pictures(HERE, FAR))).valid
    # Lost for longer than a track is kept, there is no telling which of the two is the finger.
    lost = await bench.show(*bench.pictures(HERE, FAR), frames=60)
    assert lost.reason == "two_marks"


async def test_a_finger_that_reappears_elsewhere_is_taken_after_confirmation(
    scene: Scene, camera: TwinCamera
) -> None:
    bench = await Bench(camera, confirm_frames=3).start(scene)
    for _ in range(3):
        await bench.show(*bench.pictures(HERE))
    reasons = [(await bench.show(*bench.pictures(FAR))).reason for _ in range(4)]
    assert reasons == ["too_fast", "too_fast", "ok", "ok"]
    assert np.linalg.norm(bench.sent[-1].position_world_m - FAR) < 3e-4


async def test_old_frames_are_dropped_and_counted_and_a_new_camera_is_not_old(
    scene: Scene, camera: TwinCamera
) -> None:
    bench = await Bench(camera).start(scene)
    here = bench.pictures(HERE)
    for _ in range(3):
        await bench.show(*here)
    await bench.show(*here, frames=-2)
    await bench.show(*here, frames=2)
    assert len(bench.sent) == 3
    assert bench.node.out_of_order == 2
    assert "2 out of order" in bench.node.note
    await bench.show(*here, frames=-2, epoch=2)
    assert len(bench.sent) == 4
    assert bench.sent[-1].valid


async def test_foreign_pictures_are_refused_by_name(scene: Scene, camera: TwinCamera) -> None:
    bench = await Bench(camera).start(scene)
    header = Header(1, 1, 1, "virtual", "camera", 1)
    small = np.zeros((240, 320), np.uint8)
    full = np.zeros((480, 640), np.uint8)
    for device, left, said in (
        ("webcam", full, 'pictures of device "webcam", the scene\'s is "twin-bumblebee"'),
        ("twin-bumblebee", small, "left picture of 320x240 px"),
    ):
        pair = StereoPair(device=device, exposure_s=0.0, dropped_frames=0, left=left, right=full)
        await bench.node.step("stereo", pair, header)
        assert said in bench.node.last_error
    assert bench.node.errors == 2
    assert bench.sent == []


async def test_nothing_is_said_before_there_is_a_scene(camera: TwinCamera) -> None:
    bench = Bench(camera)
    pair = StereoPair(
        device="any",
        exposure_s=0.0,
        dropped_frames=0,
        left=np.zeros((4, 4), np.uint8),
        right=np.zeros((4, 4), np.uint8),
    )
    await bench.node.step("stereo", pair, Header(1, 1, 1, "virtual", "camera", 1))
    assert (bench.sent, bench.node.errors) == ([], 0)


async def test_a_calibration_file_is_used_and_a_foreign_one_refused(
    tmp_path: Path, scene: Scene, camera: TwinCamera
) -> None:
    rig = scene.camera
    own = StereoCalibration(
        device=rig.device,
        date="2026-01-01T00:00:00+00:00",
        code_version="0",
        width_px=rig.width_px,
        height_px=rig.height_px,
        left=rig.left,
        right=rig.right,
        right_from_left=rig.right_from_left,
        board=Board(columns=9, rows=6, square_m=0.02),
        reprojection_rms_px=0.1,
        pairs=(),
    )
    save_calibration(own, tmp_path / "own.yaml")
    save_calibration(own.model_copy(update={"device": "other"}), tmp_path / "other.yaml")

    bench = await Bench(camera, calibration=tmp_path / "own.yaml").start(scene)
    plain = await Bench(camera).start(scene)
    here = bench.pictures(HERE)
    found, expected = await bench.show(*here), await plain.show(*here)
    assert np.array_equal(found.position_world_m, expected.position_world_m)

    refused = await Bench(camera, calibration=tmp_path / "other.yaml").start(scene)
    assert 'calibration is of device "other"' in refused.node.last_error
    assert refused.node.geometry is None
    with pytest.raises(CalibrationFileError, match=r"absent\.yaml: cannot be read"):
        await Bench(camera, calibration=tmp_path / "absent.yaml").start(scene)


def stroke() -> tuple[Floats, Floats]:
    """Section V of the paper: 60 degrees around the cylinder in 10 s, its first 4 s."""
    times_s = np.linspace(0.0, 4.0, 200)
    angle = np.radians(6.0) * times_s
    radius_m = 0.0353553
    return times_s, np.stack(
        [0.0 * angle, radius_m * np.sin(angle), radius_m * (np.cos(angle) - 1.0)], axis=1
    )


def fast_reach() -> tuple[Floats, Floats]:
    """To and fro over 0.2 m with a peak speed of 1.2 m/s, as reaching hands do."""
    ends = np.array([[-0.09, -0.03, 0.08], [0.08, 0.05, 0.0]])
    share = np.concatenate([0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 60)[i:]) for i in (0, 1)])
    share[60:] = 1.0 - share[60:]
    length_m = float(np.linalg.norm(ends[1] - ends[0]))
    step_s = 0.5 * np.pi * length_m / 1.2 / 59
    return np.arange(len(share)) * step_s, ends[0] + share[:, None] * (ends[1] - ends[0])


@pytest.mark.parametrize(
    ("path", "limit_mm"), [(stroke, 0.12), (fast_reach, 0.2)], ids=["stroke", "fast reach"]
)
async def test_from_the_twins_pixels_to_the_true_fingertip(
    scene: Scene, path: Callable[[], tuple[Floats, Floats]], limit_mm: float
) -> None:
    """The design asks for 0.3 mm rms near the sheet."""
    clock, truths, found = VirtualClock(10**9), list[TwinFinger](), list[Fingertip]()

    def keep(topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, Fingertip):
            found.append(message)
        elif isinstance(message, TwinFinger):
            truths.append(message)

    twin = TwinFingerNode(TwinFingerParameters(), name="finger", clock=clock, send=keep)
    eye = Triangulator(TriangulatorParameters(), name="eye", clock=clock, send=keep)
    start = Header(1, 0, 0, "virtual", "test", 1)
    times_s, points = path()
    order = FingerPath(
        label="path", times_s=times_s, positions_world_m=points, wander_m=5e-4, tremor_m=1e-4
    )
    await twin.step("scene", scene, start)
    await eye.step("scene", scene, start)
    await twin.step("twin__finger_path", order, start)
    while not (truths and truths[-1].path_done):
        at_ns = clock.now_ns() + FRAME_NS
        clock.move_to(at_ns)
        await eye.step("stereo", twin.expose(at_ns), Header(1, at_ns, at_ns, "virtual", "f", 1))
    assert eye.errors == 0, eye.last_error
    assert all(fingertip.valid for fingertip in found)
    on_path = [truth.path_time_s > 0 for truth in truths]
    error_mm = 1e3 * np.array(
        [f.position_world_m - t.position_world_m for f, t in zip(found, truths, strict=True)]
    )
    stated = np.array([f.covariance[:3, :3] for f in found])
    rms_mm = np.sqrt(np.mean(np.sum(error_mm[on_path] ** 2, axis=1)))
    assert rms_mm < limit_mm
    assert np.linalg.norm(error_mm, axis=1).max() < 5 * limit_mm
    normalized = np.mean(
        [e @ np.linalg.solve(1e6 * c, e) for e, c in zip(error_mm, stated, strict=True)]
    )
    assert 0.5 < normalized < 8.0  # 3 where the stated covariance is the true one
