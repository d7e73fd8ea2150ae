"""Test a moving finger in two images with different exposure times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.tracking_bench import Observer, bench_scene, twin_camera
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.triangulator.skew import compensate_skew
from flexsheet.nodes.triangulator.triangulation import (
    StereoGeometry,
    TriangulatedPoint,
    measure,
)
from flexsheet.nodes.twin.clutter import CLUTTER
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
SCENE = load_cylinder()
GEOMETRY = StereoGeometry.of(SCENE.camera)
NOISE_PX2 = 1e-4 * np.eye(2)


def seen(point: Floats, velocity: Floats, skew_s: float) -> TriangulatedPoint:
    left = GEOMETRY.project(point - 0.5 * skew_s * velocity)[0]
    right = GEOMETRY.project(point + 0.5 * skew_s * velocity)[1]
    found = measure(GEOMETRY, left, right, covariance=NOISE_PX2)
    assert found is not None
    return found


@given(
    place=st.tuples(*[st.floats(-0.06, 0.06)] * 3),
    velocity=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    skew_s=st.floats(-0.008, 0.008),
)
@settings(max_examples=60, deadline=None)
def test_a_known_velocity_undoes_the_skew(
    place: tuple[float, float, float], velocity: tuple[float, float, float], skew_s: float
) -> None:
    point, moving = np.array(place), np.array(velocity)
    found = seen(point, moving, skew_s)
    corrected = compensate_skew(found, GEOMETRY, skew_s, moving, np.zeros((3, 3)))
    # What is left is of second order in the way between the exposures, a few times over the
    # baseline.
    way_m = float(np.linalg.norm(moving)) * abs(skew_s)
    assert np.linalg.norm(corrected.point_world - point) <= 6.0 * way_m**2 / 0.1205 + 1e-6
    assert corrected.covariance == pytest.approx(found.covariance)


def test_an_unknown_velocity_is_in_the_covariance() -> None:
    velocity = np.array([0.3, 0.0, 0.0])
    found = seen(np.zeros(3), velocity, 0.008)
    error = found.point_world
    assert np.linalg.norm(error) > 0.005, "a skew of half a frame is centimetres of depth"
    careful = compensate_skew(found, GEOMETRY, 0.008, np.zeros(3), 0.3**2 * np.eye(3))
    assert error @ np.linalg.solve(careful.covariance, error) < 9.0
    assert error @ np.linalg.solve(found.covariance, error) > 1000.0


async def test_the_node_undoes_the_skew_that_a_pair_states() -> None:
    """8 ms at up to 90 mm/s are two millimetres without the compensation."""
    scene = bench_scene()
    camera = twin_camera(scene, CLUTTER["none"])

    def place(time_s: float) -> Floats:
        return np.array([0.03 * np.sin(3.0 * time_s), 0.01, 0.0])

    async def worst_m(*, reported: bool) -> float:
        observer = await Observer(scene).start()
        errors = []
        for frame in range(1, 60):
            time_s = frame / 60.0
            left, right = (
                camera.picture(
                    lambda offset_s, at_s=time_s + shift_s: place(at_s + offset_s),
                    exposure_s=0.004,
                )[side]
                for side, shift_s in enumerate((-0.004, 0.004))
            )
            pair = StereoPair(
                device=scene.camera.device, exposure_s=0.004, dropped_frames=0,
                skew_s=0.008 if reported else 0.0, left=left, right=right,
            )  # fmt: skip
            fingertip = await observer.process_pair(pair, round(1e9 * time_s))
            if fingertip is not None and fingertip.valid and frame > 20:
                errors.append(np.linalg.norm(fingertip.position_world_m - place(time_s)))
        assert len(errors) > 30
        return float(max(errors))

    assert await worst_m(reported=False) > 1.5e-3
    assert await worst_m(reported=True) < 4e-4
