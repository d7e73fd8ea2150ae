"""Test that objects of every shape deform smoothly under the finger, within bounds."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.body import (
    SceneBody,
    build_scene_body,
    find_front,
    make_soft_body_spec,
)
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.precompute import compute, estimate_budget
from flexsheet.nodes.models import rigid
from flexsheet.nodes.models.shapes import make_shape
from tests.examples import long_except
from tests.scenes import load_values

Floats = NDArray[np.float64]

BASE = {"kind": "base", "height_m": 0.01}


def scene(geometry: dict[str, Any], height_m: float, support: dict[str, Any]) -> Scene:
    """Return the demo's scene with another object, whose front is at the origin."""
    content = load_values()
    content["object"] |= {
        "geometry": geometry,
        "support": support,
        "world_from_object": {"position_m": [0.0, 0.0, -height_m], "rpy_rad": [0.0, 0.0, 0.0]},
    }
    return Scene.model_validate(content)


def ball_of_triangles() -> dict[str, Any]:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    return {
        "shape": "mesh",
        "vertices_m": np.array(ball.vertices),
        "triangles": np.array(ball.faces, dtype=np.int32),
        "smoothing_m": 0.012,
        "origin": "a ball",
    }


SCENES = {
    "sphere": scene({"shape": "sphere", "radius_m": 0.03}, 0.03, BASE),
    "ellipsoid": scene({"shape": "ellipsoid", "semi_axes_m": [0.04, 0.03, 0.025]}, 0.025, BASE),
    "rounded_box": scene(
        {"shape": "rounded_box", "size_m": [0.08, 0.06, 0.04], "edge_radius_m": 0.01},
        0.02,
        {"kind": "strip", "angle_rad": 1.0},
    ),
    "plane": scene({"shape": "plane", "width_m": 0.06, "height_m": 0.05}, 0.0, BASE),
    "mesh": scene(ball_of_triangles(), 0.03, BASE),
}


@pytest.fixture(scope="module", params=SCENES)
def soft(request: pytest.FixtureRequest) -> SceneBody:
    chosen = SCENES[request.param]
    spec = make_soft_body_spec(chosen, 0.006)
    model = compute(spec, lambda done, total, need: None)
    expected, table = estimate_budget(spec), model.response.influence
    # said beforehand, and not far off
    assert 0.5 * len(table) < expected.loads < 4.0 * len(table)
    return build_scene_body(chosen, spec, model)


def test_the_front_of_a_tilted_plane_is_not_its_edge() -> None:
    shape = make_shape({"shape": "plane", "width_m": 0.16, "height_m": 0.14})
    rest = np.array([[x, y, z] for x in (-0.08, 0.08) for y in (-0.07, 0.07) for z in (-0.04, 0.0)])
    tilt = np.radians(10.0)
    front = find_front(shape, rest, np.array([0.0, -np.sin(tilt), np.cos(tilt)]))
    assert front == pytest.approx(np.zeros(3), abs=1e-5)


def pushed(soft: SceneBody, x: float, y: float, depth: float) -> tuple[Response, Floats]:
    """Return the response at a depth below the surface near (x, y), and the normal there."""
    found = soft.shape.closest(soft.front + np.array([x, y, 0.0]))
    point = found.point - depth * found.normal
    return soft.respond(rigid.apply(soft.world_from_mesh, point), None)[0], found.normal


def test_a_push_deforms_the_skin_where_it_is(soft: SceneBody) -> None:
    answer, normal = pushed(soft, 0.003, 0.002, 0.004)
    assert answer.in_range
    assert answer.push_depth_m == pytest.approx(0.004)
    inward = -(answer.displacement @ normal.astype(np.float32))
    assert 0.003 < inward.max() < 0.0045
    where = soft.skin.vertices_world_m[int(inward.argmax())]
    assert np.linalg.norm(where[:2] - [0.003, 0.002]) < 0.007
    # within a factor of two of Hertz on a half-space
    hertz = 4.0 / 3.0 * 4000.0 / (1.0 - 0.45**2) * 0.007**0.5 * 0.004**1.5
    assert 0.5 * hertz < answer.force_n @ normal < 2.0 * hertz
    aside = answer.force_n - (answer.force_n @ normal) * normal
    assert np.linalg.norm(aside) < 0.15 * answer.force_n @ normal


@pytest.mark.parametrize("depth", long_except([0.003, 0.008, 0.015], 0.015))
def test_a_slide_moves_no_skin_node_by_a_jump(soft: SceneBody, depth: float) -> None:
    answers = [pushed(soft, 0.001 + 1.6e-5 * i, 1.2e-5 * i, depth)[0] for i in range(200)]
    jumps = [
        np.linalg.norm(a.displacement - b.displacement, axis=1).max()
        for a, b in itertools.pairwise(answers)
    ]
    assert max(jumps) < 0.1e-3
    forces = np.array([np.linalg.norm(answer.force_n) for answer in answers])
    assert np.abs(np.diff(forces)).max() < 0.01 * forces.mean()


def test_what_the_finger_did_before_does_not_count(soft: SceneBody) -> None:
    there = rigid.apply(soft.world_from_mesh, soft.front - [0.0, 0.0, 0.005])
    first, held = soft.respond(there, None)
    _, held = soft.respond(there + np.array([0.004, 0.002, -0.003]), held)
    again, _ = soft.respond(there, held)
    assert np.abs(again.displacement - first.displacement).max() < 1e-7


def test_a_deep_push_is_bounded_and_flagged(soft: SceneBody) -> None:
    held = None
    for depth in np.linspace(0.0, 0.035, 36):
        there = soft.front - np.array([0.0, 0.0, depth])
        answer, held = soft.respond(rigid.apply(soft.world_from_mesh, there), held)
        assert np.linalg.norm(answer.displacement, axis=1).max() < 0.012
        assert np.isfinite(answer.force_n).all()
    assert not answer.in_range


def test_the_force_curve_is_published_before_contact(soft: SceneBody) -> None:
    curve = soft.at_rest().force_curve
    assert (np.diff(curve[:, 1]) >= 0.0).all()
    answer, normal = pushed(soft, 0.0, 0.0, 0.006)
    assert np.interp(0.006, *curve.T) == pytest.approx(answer.force_n @ normal, rel=0.1)
