"""Test the object's force over depth from the soft body, with and without contact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.body import SceneBody, build_scene_body, make_soft_body_spec
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import CURVE_FRACTIONS, curve_depths
from flexsheet.nodes.fem_solver.precompute import compute
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
SCENE = load_cylinder()
LINEAR = 0.006


@pytest.fixture(scope="module")
def soft() -> SceneBody:
    spec = make_soft_body_spec(SCENE, 0.0045)
    model = compute(spec, lambda done, total, need: None)
    return build_scene_body(SCENE, spec, model)


def test_the_depths_reach_from_the_touch_to_the_deepest_push() -> None:
    depths = curve_depths(0.006, 0.010, 0.05)
    assert depths[0] == 0.0
    assert depths[len(CURVE_FRACTIONS)] == pytest.approx(0.006)
    assert depths[-1] == pytest.approx(0.05)
    assert (np.diff(depths) > 0.0).all()
    assert curve_depths(0.006, 0.010, None)[-1] == pytest.approx(0.010)
    assert curve_depths(0.006, 0.010, 0.001)[-1] == pytest.approx(0.010)


def test_the_curve_is_what_pushes_then_give(soft: SceneBody) -> None:
    angle = 0.2
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    surface = np.array([0.004, 0.0, 0.0]) + soft.front[2] * normal
    curve = soft.method.force_curve(surface)
    assert (curve[0] == 0.0).all()
    assert (np.diff(curve[:, 1]) >= 0.0).all()
    for depth in (0.003, 0.006, 0.02, 0.05):
        answer = soft.method.respond(ContactQuery(surface, normal, depth))
        wanted = float(np.interp(depth, *curve.T))
        assert answer.force_n @ normal == pytest.approx(wanted, rel=0.1)
        assert np.array_equal(answer.force_curve, curve)


def test_the_curve_is_published_in_the_air_and_changes_smoothly_along_the_skin(
    soft: SceneBody,
) -> None:
    place = np.array([0.0, 0.0, soft.front[2]])
    message = soft.message(soft.respond(np.array([0.0, 0.0, 0.05]), None)[0])
    assert message.force_curve == pytest.approx(soft.method.force_curve(place))
    assert message.push_depth_m == 0.0
    ends = [
        soft.method.force_curve(place + np.array([1e-4 * i, 0.0, 0.0]))[-1, 1] for i in range(200)
    ]
    assert np.abs(np.diff(ends)).max() < 0.01 * ends[0]


def test_the_stiffness_is_the_curves_secant(soft: SceneBody) -> None:
    place = np.array([0.004, 0.0, soft.front[2]])
    curve = soft.method.force_curve(place)
    secant = curve[len(CURVE_FRACTIONS), 1] / LINEAR
    assert soft.method.stiffness_n_per_m(place) == pytest.approx(secant)
