"""Test the prediction of tracked eyes, and the evaluation of both eyes' images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.image_correction import summarize_eyes
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import Eye
from flexsheet.nodes.node import Input
from flexsheet.nodes.renderer.eye_predictor import MAX_SHIFT_M, EyePredictor
from flexsheet.nodes.renderer.max_age import MaxAge
from flexsheet.nodes.twin.error_map import ErrorMap
from tests.test_eye import EyeBench, frame

SCENE = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
CENTRE = np.array([0.0, 0.0, 0.4])
START_NS = 10**10
PERIOD_NS = 16_666_667
HORIZON_S = 0.03


class Tracked:
    """A head tracker at 60 Hz, whose message arrives 10 ms after its measurement."""

    def __init__(self) -> None:
        self.clock = VirtualClock(START_NS, clock_id="clock")
        self.input = Input[Eye](find_topic("eye"), self.clock)
        self.predictor = EyePredictor(MaxAge(0.1))
        self.count = 0

    def send(self, position: np.ndarray, *, valid: bool = True, later_ns: int = PERIOD_NS) -> None:
        self.count += 1
        self.clock.move_to(self.clock.now_ns() + later_ns)
        at_ns = self.clock.now_ns() - 10_000_000
        header = Header(self.count, at_ns, at_ns, "clock", "tracker", 1)
        eye = Eye(valid=valid, centre_world_m=position)
        self.input.accept(eye, header)
        self.predictor.add(eye, header)

    def moving(self, velocity: np.ndarray, count: int, noise_m: float = 0.0) -> np.ndarray:
        """Send a motion, and return the true position at the end of the horizon."""
        random = np.random.default_rng(1)
        first_ns = self.clock.now_ns() + PERIOD_NS - 10_000_000
        for number in range(count):
            at_s = number * PERIOD_NS * 1e-9
            self.send(CENTRE + at_s * velocity + random.normal(0.0, noise_m, 3))
        elapsed_s = (self.clock.now_ns() - first_ns) * 1e-9 + HORIZON_S
        return np.asarray(CENTRE + elapsed_s * velocity)

    def predicted(self, horizon_s: float = HORIZON_S) -> np.ndarray:
        eye = self.predictor.predict(self.input, horizon_s)
        assert eye is not None
        return np.asarray(eye.centre_world_m)


def test_moving_eyes_are_predicted_at_the_display_time() -> None:
    tracked = Tracked()
    expected = tracked.moving(np.array([0.3, -0.1, 0.05]), 12)
    assert tracked.predicted() == pytest.approx(expected, abs=1e-6)


def test_the_noise_of_a_tracker_is_not_amplified_much() -> None:
    tracked = Tracked()
    expected = tracked.moving(np.array([0.3, 0.0, 0.0]), 12, noise_m=5e-4)
    newest = tracked.input.message
    assert newest is not None
    late_m = float(np.linalg.norm(newest.centre_world_m - expected))
    assert late_m > 0.01
    assert np.linalg.norm(tracked.predicted() - expected) < 2e-3


def test_the_prediction_is_bounded() -> None:
    tracked = Tracked()
    tracked.moving(np.array([0.9, 0.0, 0.0]), 12)
    newest = tracked.input.message
    assert newest is not None
    shift_m = np.linalg.norm(tracked.predicted(5.0) - newest.centre_world_m)
    assert shift_m == pytest.approx(MAX_SHIFT_M)
    jumping = Tracked()
    jumping.moving(np.array([5.0, 0.0, 0.0]), 12)
    assert jumping.input.message is not None
    assert np.array_equal(jumping.predicted(), jumping.input.message.centre_world_m)


def test_a_loss_of_the_eyes_restarts_the_prediction() -> None:
    for options in ({"valid": False}, {"later_ns": 500_000_000}):
        tracked = Tracked()
        tracked.moving(np.array([0.3, 0.0, 0.0]), 6)
        tracked.send(CENTRE, **options)
        tracked.send(CENTRE + 0.1)
        assert np.array_equal(tracked.predicted(), CENTRE + 0.1)
    tracked.clock.move_to(tracked.clock.now_ns() + 200_000_000)
    assert tracked.predictor.predict(tracked.input, HORIZON_S) is None


async def test_frames_for_one_eye_are_seen_from_that_eye(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = EyeBench(SCENE)
    await bench.ready()
    eyes: list[np.ndarray] = []
    take = bench.node._camera.take

    def record(projected: object, situation: object, *, eye: np.ndarray) -> object:
        eyes.append(eye)
        return take(projected, situation, eye=eye)

    monkeypatch.setattr(bench.node._camera, "take", record)
    for which in ("left", "right", "left"):
        await bench.show(frame("a", stereo="frame_sequential", eye=which))
    await bench.show(frame("a", stereo="frame_sequential"))
    assert [one.code for one in bench.node.notes] == [NoteCode.FRAME_NOT_RENDERED]
    await bench.finish()
    await bench.node.close()
    assert [eye.viewpoint for eye, _ in bench.sent] == ["left", "right"]
    half = 0.5 * SCENE.eyes.interocular_m
    assert [eye[0] for eye in eyes] == pytest.approx([-half, half])


def test_disparity_is_the_difference_between_the_eyes() -> None:
    left, right = np.full((4, 4, 2), 1e-3), np.full((4, 4, 2), 1e-3)
    left[..., 0], right[..., 0] = -2e-3, 2e-3
    right[0, 0] = np.nan
    found = summarize_eyes(ErrorMap(left), ErrorMap(right))
    assert found == pytest.approx([np.sqrt(5.0), np.sqrt(5.0), 4.0, 0.0])
    dark = summarize_eyes(ErrorMap(left), ErrorMap(np.full((4, 4, 2), np.nan)))
    assert np.isnan(dark[1:]).all()
