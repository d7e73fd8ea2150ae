"""Test the simulated finger and camera: the truth is a function of time, and the images show it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from flexsheet.launch.experiments.finger_paths import recorded_path
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Lens, Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import FingerPath, StereoPair, TwinFinger
from flexsheet.messages.wire import WireError, decode, encode
from flexsheet.nodes.twin.finger import FingerMotion, FingerPathError
from flexsheet.nodes.twin.finger_node import TwinFingerNode, TwinFingerParameters
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from tests.note_text import note_text
from tests.scenes import load_cylinder
from tests.waiting import until

ROOT = Path(__file__).resolve().parent.parent
RECORDING = ROOT.parent / "shared" / "data" / "finger" / "reach_and_grip.csv"
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


@pytest.fixture(scope="module")
def camera(scene: Scene) -> TwinCamera:
    return TwinCamera(scene.camera, finger_radius_m=scene.finger.radius_m, seed=3)


def header(at_ns: int = 0) -> Header:
    return Header(1, at_ns, at_ns, "virtual", "test", 1)


def motion_along(
    times_s: list[float], points: list[list[float]], *, wander_m: float = 0, tremor_m: float = 0
) -> FingerMotion:
    return FingerMotion.resting(np.array([0.0, 0.0, 0.1]), seed=1).followed_by(
        0.5,
        times_s=np.array(times_s),
        points=np.array(points),
        wander_m=wander_m,
        tremor_m=tremor_m,
        max_speed_m_per_s=1.5,
    )


def path_time(motion: FingerMotion, path_time_s: float) -> float:
    """Return the seconds since the start of the path at which `path_time_s` is reached."""
    return path_time_s - motion.at(0.0).path_time_s


POINTS = st.lists(st.tuples(*[st.floats(-0.1, 0.1)] * 3), min_size=1, max_size=6)


@given(points=POINTS, wander_m=st.sampled_from([0.0, 0.001]), tremor_m=st.sampled_from([0.0, 2e-4]))
@settings(max_examples=40, deadline=None)
def test_position_is_continuous_and_velocity_is_its_slope(
    points: list[tuple[float, float, float]], wander_m: float, tremor_m: float
) -> None:
    times = [0.4 * i for i in range(len(points))]
    motion = motion_along(times, [list(p) for p in points], wander_m=wander_m, tremor_m=tremor_m)
    end = path_time(motion, times[-1]) + 0.2
    step = 1e-5
    for time_s in np.linspace(step, end, 60):
        slope = (motion.at(time_s + step).position - motion.at(time_s - step).position) / (2 * step)
        # Velocity bends where a corner's rounding begins, by at most 2 * speed * step / 0.08 s.
        assert np.allclose(slope, motion.at(time_s).velocity, atol=1e-3)


def test_a_path_given_in_mid_motion_starts_without_a_step() -> None:
    first = motion_along([0.0, 1.0], [[0.0, 0.0, 0.1], [0.1, 0.0, 0.05]], wander_m=1e-3)
    at_s = path_time(first, 0.5)
    second = first.followed_by(
        at_s,
        times_s=np.array([0.0]),
        points=np.array([[0.0, 0.05, 0.02]]),
        wander_m=0.0,
        tremor_m=1e-4,
        max_speed_m_per_s=1.5,
    )
    assert np.allclose(first.at(at_s).position, second.at(0.0).position, atol=1e-12)
    # The new path's tremor has no amplitude yet, so the velocities agree as well.
    assert np.allclose(first.at(at_s).velocity, second.at(0.0).velocity, atol=1e-9)
    assert np.linalg.norm(second.at(30.0).position - [0.0, 0.05, 0.02]) < 5e-4


def test_waypoints_are_reached_in_time_and_the_end_is_held() -> None:
    points = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.05, 0.05, 0.0]]
    motion = motion_along([2.0, 3.0, 4.0], points)
    for path_time_s, expected in ((0.5, [0.025, 0, 0]), (1.5, [0.05, 0.025, 0]), (9.0, points[2])):
        state = motion.at(path_time(motion, path_time_s))
        assert state.path_time_s == pytest.approx(path_time_s)
        assert np.allclose(state.position, expected, atol=1e-12)
    assert not motion.at(path_time(motion, 1.99)).path_done
    assert motion.at(path_time(motion, 2.0)).path_done
    assert motion.at(0.0).path_time_s < 0


def test_speed_stays_below_the_paths_own() -> None:
    points = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.08, 0.0]]
    motion = motion_along([0.0, 0.1, 0.2, 0.4], points)
    speeds = [np.linalg.norm(motion.at(t).velocity) for t in np.linspace(0, 2, 4000)]
    assert max(speeds) <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("times", "points", "printed"),
    [
        ([], [], "at least one"),
        ([0.0, 1.0], [[0.0, 0, 0]], "one time per point"),
        ([0.0, 1.0, 1.0], [[0.0, 0, 0]] * 3, "times_s[2]: 1 does not come after"),
    ],
)
def test_paths_that_cannot_be_followed_are_rejected(
    times: list[float], points: list[list[float]], printed: str
) -> None:
    positions = np.array(points).reshape(-1, 3)
    path = FingerPath(label="wrong", times_s=np.array(times), positions_world_m=positions)
    assert printed in path.find_problem()


def test_a_path_that_is_too_fast_is_rejected() -> None:
    with pytest.raises(FingerPathError, match=r"speed 10 m/s after times_s\[0\]"):
        motion_along([0.0, 0.01], [[0.0, 0, 0], [0.1, 0, 0]])


@pytest.mark.parametrize("name", ["wander_m", "tremor_m"])
def test_a_path_with_more_noise_than_a_hand_is_no_message(name: str) -> None:
    path = FingerPath(label="wild", times_s=np.zeros(1), positions_world_m=np.zeros((1, 3)))
    forged = path.model_copy(update={name: 1e6})
    with pytest.raises(WireError, match=name):
        decode(encode(forged, header()), FingerPath)


def test_wander_and_tremor_are_as_large_and_as_fast_as_asked() -> None:
    rate_hz, seconds = 100.0, 200.0
    for wander_m, tremor_m, band_hz in ((1e-3, 0.0, (0.1, 1.3)), (0.0, 2e-4, (7.9, 12.1))):
        motion = motion_along([0.0], [[0.0, 0.0, 0.0]], wander_m=wander_m, tremor_m=tremor_m)
        times = 2.0 + np.arange(int(seconds * rate_hz)) / rate_hz
        path = np.array([motion.at(time_s).position for time_s in times])
        deviation = wander_m or tremor_m / np.sqrt(2)
        assert np.allclose(path.std(axis=0), deviation, rtol=0.15)
        power = np.abs(np.fft.rfft(path - path.mean(axis=0), axis=0)) ** 2
        frequency_hz = np.fft.rfftfreq(len(times), 1 / rate_hz)
        inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
        assert power[inside].sum() / power.sum() > 0.97


def test_the_same_seed_gives_the_same_finger_and_another_does_not() -> None:
    def place(seed: int) -> Floats:
        rest = FingerMotion.resting(np.zeros(3), seed=seed)
        moving = rest.followed_by(
            0.0,
            times_s=np.zeros(1),
            points=np.zeros((1, 3)),
            wander_m=1e-3,
            tremor_m=1e-4,
            max_speed_m_per_s=1.0,
        )
        return moving.at(3.21).position

    assert np.array_equal(place(1), place(1))
    assert not np.allclose(place(1), place(2))


def write_recording(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def check_recorded(path: FingerPath, scene: Scene) -> None:
    """Assert that a recorded path is followed within the volume, and touches, presses and
    leaves."""
    radius_m = scene.object.geometry.radius_m
    points = path.positions_world_m
    assert (points >= scene.finger.volume_min_m).all()
    assert (points <= scene.finger.volume_max_m).all()
    from_axis = np.hypot(points[:, 1], points[:, 2] + radius_m) - radius_m
    assert -0.2 * scene.working_range.push_depth_m < from_axis.min() < -1e-4
    assert from_axis.max() > 0.01
    assert np.ptp(np.arctan2(points[:, 1], points[:, 2] + radius_m)) > 0.3
    FingerMotion.resting(np.zeros(3), seed=1).followed_by(
        0.0,
        times_s=path.times_s,
        points=points,
        wander_m=0.0,
        tremor_m=0.0,
        max_speed_m_per_s=scene.finger.max_speed_m_per_s,
        joined_by=path.joined_by,
    )


def test_a_recording_is_laid_on_the_object(tmp_path: Path, scene: Scene) -> None:
    t = np.linspace(0, 6, 300)
    columns = [t, 300 * np.sin(t), 200 + 300 * np.sin(2.1 * t), -50 + 200 * np.cos(1.3 * t)]
    lines = ["t_s,x_mm,y_mm,z_mm", *(",".join(map(str, row)) for row in zip(*columns, strict=True))]
    path = recorded_path(write_recording(tmp_path / "hand.csv", "\n".join(lines)), scene)
    assert path.label == "hand"
    check_recorded(path, scene)


@pytest.mark.skipif(not RECORDING.is_file(), reason="../shared/data is not here")
def test_the_real_recording_is_laid_on_the_object(scene: Scene) -> None:
    path = recorded_path(RECORDING, scene)
    assert len(path.times_s) == 495
    check_recorded(path, scene)


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("", "is empty"),
        ("t_s,x_mm,y_mm\n0,1,2\n", "z_mm: missing column"),
        ("t_s,x_mm,y_mm,z_mm\n0,1,2,3\n1,a,2,3\n", 'csv:3: x_mm: expected a number, found "a"'),
        ("t_s,x_mm,y_mm,z_mm\n0,1,2,3\n1,nan,2,3\n", "csv:3: x_mm: expected a finite number"),
        ("t_s,x_mm,y_mm,z_mm\n0,1,2,3\n0,1,2,3\n", "csv:3: t_s: does not increase"),
        ("t_s,x_mm,y_mm,z_mm\n0,1,2,3\n", "give a path with at least two samples"),
    ],
)
def test_a_bad_recording_is_rejected(tmp_path: Path, scene: Scene, text: str, printed: str) -> None:
    with pytest.raises(BadInputError, match=printed):
        recorded_path(write_recording(tmp_path / "hand.csv", text), scene)
    with pytest.raises(BadInputError, match="cannot be read"):
        recorded_path(tmp_path / "absent.csv", scene)


def opencv_pixel(camera: TwinCamera, eye: int, point: Floats) -> Floats:
    lens: Lens = camera.eyes[eye].lens
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    pose = camera.eyes[eye].camera_from_world
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    pixel, _ = cv2.projectPoints(
        point[None, None], rotation, pose[:3, 3], matrix, np.array(lens.distortion)
    )
    return np.asarray(pixel, dtype=np.float64).reshape(2)


@given(point=st.tuples(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(-0.1, 0.2)))
@settings(max_examples=50, deadline=None)
def test_the_twins_own_optics_agree_with_opencv(
    camera: TwinCamera, point: tuple[float, float, float]
) -> None:
    for eye in (0, 1):
        pixel, depth = camera.eyes[eye].see(np.array(point))
        assert depth > 0
        assert np.allclose(pixel, opencv_pixel(camera, eye, np.array(point)), atol=1e-9)


def light_centre(image: NDArray[np.uint8], near: Floats) -> Floats:
    """Return the centre of the light brighter than any finger, within 12 px of a position."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = np.maximum(image.astype(float) - 110.0, 0.0)
    weight[np.hypot(x - near[0], y - near[1]) > 12] = 0.0
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize("speed_m_per_s", [0.0, 0.1, 1.5])
def test_the_markers_light_is_centred_on_the_fingertip(
    camera: TwinCamera, speed_m_per_s: float
) -> None:
    """The light is compared with the marker over black ground."""
    generator = np.random.default_rng(5)
    velocity = speed_m_per_s * np.array([0.8, 0.6, 0.0])
    for _ in range(10):
        tip = generator.uniform([-0.05, -0.05, -0.02], [0.05, 0.05, 0.08])

        def moving(offset_s: float, tip: Floats = tip) -> Floats:
            return tip + offset_s * velocity

        lit, unlit = (
            camera.levels(moving, exposure_s=0.004, marker=marker) for marker in (True, False)
        )
        for eye, with_mark, without in zip(camera.eyes, lit, unlit, strict=True):
            share = (with_mark - without) / (camera.sensor.marker_level - without)
            y, x = np.mgrid[: share.shape[0], : share.shape[1]]
            centre = np.array([(share * x).sum(), (share * y).sum()]) / share.sum()
            assert np.abs(centre - eye.see(tip)[0]).max() < 0.02


def test_noise_is_new_in_each_image_and_as_large_as_stated(camera: TwinCamera) -> None:
    def still(_: float) -> Floats:
        return np.array([0.0, 0.0, 0.02])

    pictures = np.array([camera.picture(still, exposure_s=0.004)[0] for _ in range(200)], float)
    x, y = np.rint(camera.eyes[0].see(still(0))[0]).astype(int)
    core = pictures[:, y, x]
    expected = np.sqrt(core.mean() / camera.sensor.photons_per_level + camera.sensor.read_noise**2)
    assert core.std() == pytest.approx(expected, rel=0.25)
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)


def test_the_background_is_textured_and_darker_than_any_marker(camera: TwinCamera) -> None:
    left, right = camera.picture(lambda _: np.array([0.0, 0.0, 5.0]), exposure_s=0.004)
    for image in (left, right):
        assert image.shape == (480, 640)
        assert image.dtype == np.uint8
        assert image.max() < 0.5 * camera.sensor.marker_level
        assert image.std() > 4


@pytest.mark.parametrize("place", [[0.0, 0.0, 2.0], [5.0, 0.0, 0.0], [0.0, 0.25, 0.4330127]])
def test_a_finger_out_of_sight_is_not_drawn(camera: TwinCamera, place: list[float]) -> None:
    for image in camera.picture(lambda _: np.array(place), exposure_s=0.004):
        assert image.max() < 0.5 * camera.sensor.marker_level


class Sent:
    """Messages of a node by topic."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, Any, Header]] = []
        self.news = asyncio.Event()

    def __call__(self, topic: Topic, message: Message, header: Header) -> None:
        self.messages.append((topic.name, message, header))
        self.news.set()

    def on(self, topic: str) -> list[tuple[Any, Header]]:
        return [(message, header) for name, message, header in self.messages if name == topic]

    async def until(self, topic: str, count: int) -> list[tuple[Any, Header]]:
        while len(self.on(topic)) < count:
            self.news.clear()
            await self.news.wait()
        return self.on(topic)


async def test_truth_and_pixels_are_of_the_same_instant(scene: Scene) -> None:
    sent, clock = Sent(), VirtualClock(10**9)
    node = TwinFingerNode(TwinFingerParameters(), name="finger", clock=clock, send=sent)
    path = FingerPath(
        label="there",
        times_s=np.array([0.0, 1.0]),
        positions_world_m=np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]),
        wander_m=5e-4,
        tremor_m=1e-4,
    )
    await node.step("twin__finger_path", path, header())
    await node.step("scene", scene, header())
    at_ns = clock.now_ns() + 1_300_000_000
    pair = node.expose(at_ns)
    truth, truth_header = sent.on("twin/finger")[0]
    assert isinstance(truth, TwinFinger)
    assert truth_header.source_ns == at_ns
    assert truth.path_label == "there"
    assert np.array_equal(truth.position_world_m, node.truth(at_ns).position)
    assert node.camera is not None
    # The rig as it stands, not as its data sheet says.
    assert node.camera.camera.left == make_true_camera(scene.camera).left
    place = node.camera.eyes[0].see(truth.position_world_m)[0]
    assert np.abs(light_centre(pair.left, place) - place).max() < 0.3


async def test_the_node_draws_the_clutter_that_it_is_asked_for(scene: Scene) -> None:
    levels: list[float] = []
    for clutter in ("none", "lab"):
        parameters = TwinFingerParameters.model_validate({"clutter": clutter})
        node = TwinFingerNode(parameters, name="finger", clock=VirtualClock(), send=lambda *_: None)
        await node.step("scene", scene, header())
        levels.append(float(node.expose(10**9).left.mean()))
    assert levels[1] > 1.15 * levels[0]
    with pytest.raises(ValidationError, match="crowded"):
        TwinFingerParameters.model_validate({"clutter": "street"})


async def test_a_bad_path_changes_nothing_and_is_reported(scene: Scene) -> None:
    node = TwinFingerNode(
        TwinFingerParameters(), name="finger", clock=VirtualClock(), send=lambda *_: None
    )
    await node.step("scene", scene, header())
    before = node.truth(10**9).position
    fast = FingerPath(
        label="fast",
        times_s=np.array([0.0, 0.01]),
        positions_world_m=np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        wander_m=0.0,
        tremor_m=0.0,
    )
    await node.step("twin__finger_path", fast, header())
    assert node.errors == 0
    assert note_text(node).startswith('finger-path-refused: "fast": path: the speed')
    assert note_text(node).endswith("increase the times")
    assert [one.code for one in node.notes] == [NoteCode.FINGER_PATH_REFUSED]
    assert np.array_equal(node.truth(10**9).position, before)
    far = fast.model_copy(
        update={
            "times_s": np.array([0.0, 60.0]),
            "positions_world_m": np.array([[0, 0, 20], [0, 0, -5.0]]),
        }
    )
    await node.step("twin__finger_path", far, header())
    assert note_text(node).endswith("give positions in metres (20 mm are 0.02)")
    slow = fast.model_copy(update={"label": "slow", "times_s": np.array([0.0, 1.0])})
    await node.step("twin__finger_path", slow, header())
    assert note_text(node) == 'follows the path "slow"'


async def test_frames_come_on_a_fixed_grid_and_missed_ones_are_counted(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent, clock = Sent(), VirtualClock(10**9)

    async def sleep_until(_: TwinFingerNode, at_ns: int) -> None:
        clock.move_to(at_ns)
        await asyncio.sleep(0)

    monkeypatch.setattr(TwinFingerNode, "_sleep_until", sleep_until)
    node = TwinFingerNode(TwinFingerParameters(), name="finger", clock=clock, send=sent)
    await node.setup()
    try:
        await node.step("scene", scene, header())
        await sent.until("twin/stereo", 5)
        assert not node.missed_frames
        assert not note_text(node)
        clock.move_to(clock.now_ns() + 200_000_000)
        frames = await sent.until("twin/stereo", 12)
        # The number increases before the note that states it.
        busy = "because the computer was busy"
        await until(lambda: note_text(node) == f"frames-missed: {node.missed_frames} {busy}")
        node.path_label = "stroke"
        await until(
            lambda: (
                note_text(node)
                == f'follows the path "stroke"; frames-missed: {node.missed_frames} {busy}'
            )
        )
    finally:
        await node.close()
    period_ns = round(1e9 / scene.camera.rate_hz)
    stamps = np.array([frame_header.source_ns for _, frame_header in frames])
    steps = np.diff(stamps)
    assert (steps % period_ns == 0).all()
    last: StereoPair = frames[-1][0]
    assert last.dropped_frames == int((steps // period_ns - 1).sum())
    assert last.dropped_frames >= 10
    held_ns = round(1e9 * (scene.camera.exposure_s / 2 + node.parameters.transfer_s))
    assert all(sent_as.publish_ns - sent_as.source_ns >= held_ns for _, sent_as in frames)
    assert node.errors == 0
