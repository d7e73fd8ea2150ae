"""A moving finger in two pictures that were not taken at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ruamel.yaml import YAML

from messages.scene import Scene
from nodes.triangulator.skew import unskewed
from nodes.triangulator.triangulation import Measured, StereoGeometry, dlt, measure

Floats = NDArray[np.float64]
SCENE_FILE = Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"
SCENE = Scene.model_validate(YAML(typ="safe").load(SCENE_FILE))
GEOMETRY = StereoGeometry.of(SCENE.camera)
NOISE_PX2 = 1e-4 * np.eye(2)


def seen(point: Floats, velocity: Floats, skew_s: float) -> Measured:
    left = GEOMETRY.project(point - 0.5 * skew_s * velocity)[0]
    right = GEOMETRY.project(point + 0.5 * skew_s * velocity)[1]
    found = measure(
        GEOMETRY, left, right, method=dlt, left_covariance=NOISE_PX2, right_covariance=NOISE_PX2
    )
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
    mended = unskewed(found, GEOMETRY, skew_s, moving, np.zeros((3, 3)))
    # What is left is of second order in the way between the exposures, over the baseline, a few times.
    way_m = float(np.linalg.norm(moving)) * abs(skew_s)
    assert np.linalg.norm(mended.point_world - point) <= 6.0 * way_m**2 / 0.1205 + 1e-6
    assert mended.covariance == pytest.approx(found.covariance)


def test_an_unknown_velocity_is_in_the_covariance() -> None:
    velocity = np.array([0.3, 0.0, 0.0])
    found = seen(np.zeros(3), velocity, 0.008)
    error = found.point_world
    assert np.linalg.norm(error) > 0.005, "a skew of half a frame is centimetres of depth"
    careful = unskewed(found, GEOMETRY, 0.008, np.zeros(3), 0.3**2 * np.eye(3))
    assert error @ np.linalg.solve(careful.covariance, error) < 9.0
    assert error @ np.linalg.solve(found.covariance, error) > 1000.0
