"""What the mouse means, and how the finger gets there."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from messages.base import Message
from messages.scene import Scene
from messages.types import (
    FingerPath,
)
from nodes.console.aim import HOVER_M, Aim
from nodes.console.desk import SceneDesk
from nodes.console.finger import Finger
from tests.console_parts import cylinder
from tests.waiting import DEADLINE_S

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return cylinder()


def test_the_mouse_means_a_point_below_the_surface_or_beside_it(scene: Scene) -> None:
    aim = Aim(scene)
    eye, forward = np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, -2.0])
    np.testing.assert_allclose(aim.under_ray(eye, forward, 0.0), [0.0, 0.0, 0.0], atol=2e-4)
    np.testing.assert_allclose(aim.under_ray(eye, forward, 0.01), [0.0, 0.0, -0.01], atol=2e-4)
    np.testing.assert_allclose(aim.place(0.03, 0.0, 0.01), [0.03, 0.0, -0.01], atol=2e-4)
    beside = aim.under_ray(eye, np.array([0.0, 0.3, -0.6]), 0.01)
    assert beside[1] > 0.05
    assert (beside >= scene.finger.volume_min_m).all()
    assert (beside <= scene.finger.volume_max_m).all()
    np.testing.assert_allclose(aim.lifted(np.array([0.0, 0.0, -0.01])), [0, 0, HOVER_M], atol=1e-6)
    for bad in (np.zeros(3), np.array([np.nan, 0, 1])):
        with pytest.raises(ValueError, match="direction"):
            aim.under_ray(eye, bad, 0.0)


def test_the_finger_goes_round_the_object_and_not_through_it(scene: Scene) -> None:
    aim, sent = Aim(scene), []
    finger = Finger(sent.append, speed_m_per_s=0.1)
    finger.use(aim)
    finger.push(0.003)
    finger.place(0.0, -0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    begun = len(sent)
    finger.place(0.0, 0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    ways = np.array([path.positions_world_m[0] for path in sent[begun:]])
    radius = scene.object.geometry.radius_m  # type: ignore[union-attr]  # it is a cylinder
    centre = scene.object.world_from_object.position_m
    depths = radius - np.linalg.norm(ways[:, 1:] - centre[1:], axis=1)
    assert depths.max() < 0.003 + 2e-4
    assert ways[-1, 1] == pytest.approx(0.04, abs=2e-3)
    assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 0.008
    rested = len(sent)
    finger.advance(0.05, None)
    assert len(sent) == rested, "a finger that is there is told nothing"
    assert all(isinstance(path, FingerPath) for path in sent)


def test_a_finger_that_cannot_be_moved_says_why(scene: Scene) -> None:
    finger = Finger(lambda message: None, speed_m_per_s=0.1)
    with pytest.raises(ValueError, match="still being read"):
        finger.place(0.0, 0.0)
    finger.use(Aim(scene))
    for depth in (-0.001, np.nan, np.inf):
        with pytest.raises(ValueError, match="no depth"):
            finger.push(depth)


async def test_an_object_is_made_ready_to_point_at_beside_the_loop(
    scene: Scene, tmp_path: Path
) -> None:
    sent: list[Message] = []
    desk = SceneDesk(sent.append, tmp_path, scene)
    finger, failures = Finger(sent.append, speed_m_per_s=1.0), []
    desk.make_aim(finger, failures.append)
    with pytest.raises(ValueError, match="still being read"):
        finger.lift()
    async with asyncio.timeout(DEADLINE_S):
        while not sent:
            await asyncio.sleep(0)
            try:
                finger.lift()
            except ValueError:
                continue
            finger.advance(1.0, None)
    await desk.close()
    assert not failures
