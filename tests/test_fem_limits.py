"""Test the limits of the soft-body methods: errors, range flags and bounded results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexsheet.messages.scene import BaseSupport, Sphere
from flexsheet.nodes.fem_solver.body import state_force_error_ratio
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor, ContactQuery
from flexsheet.nodes.fem_solver.mesh.from_scene import MeshSpec
from flexsheet.nodes.fem_solver.snapshots import has_focused_meshes
from flexsheet.nodes.models import rigid
from tests.limit_bodies import (
    CYLINDER,
    Body,
    count_inverted,
    cylinder,
    make_body,
    make_sample,
    make_scene,
    solve_deepest_mm,
)
from tests.soft_bodies import cylinder_spec

ENDS = {"kind": "box_patch", "min_m": [-1, -0.008, -0.008], "max_m": [1, 0.008, 0.008]}


@pytest.fixture(scope="module")
def body() -> Body:
    return make_body(cylinder())


def test_a_skin_coarser_than_the_fingertip_is_rejected() -> None:
    """Without this check, the force would be more than twice too large."""
    with pytest.raises(ValueError, match=r"skin_spacing_m: 0.005 .* finger.radius_m \(0.0045\)"):
        make_body(cylinder(finger_m=0.0045))


def test_an_incompressible_body_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"poisson_ratio: 0.49995 .* use 0.499"):
        make_body(cylinder(nu=0.49995))


def test_two_supports_hold_and_one_point_is_rejected(body: Body) -> None:
    hanging = make_body(make_scene(CYLINDER, ENDS, height_m=0.02))
    sample = make_sample(hanging)
    answers = [
        one.soft.method.respond(ContactQuery(sample.point, sample.normal, 0.005))
        for one in (hanging, body)
    ]
    forces = [float(answer.force_n @ sample.normal) for answer in answers]
    assert 0.3 * forces[1] < forces[0] < forces[1]
    assert solve_deepest_mm(hanging, sample, (0.002, 0.004)) == 4.0
    point = {"kind": "sphere_patch", "centre_m": [0.025, 0.0, 0.0], "radius_m": 0.0005}
    with pytest.raises(ValueError, match=r"object.support: .* at least three"):
        make_body(make_scene(CYLINDER, point, height_m=0.02))


def test_a_finger_that_jumps_is_answered_where_it_is(body: Body) -> None:
    """After a jump by less than a right angle, the response is that of the new position."""
    rng = np.random.default_rng(7)
    jumped: ContactAnchor | None = None
    for _ in range(40):
        x, angle, depth = rng.uniform([-0.02, -0.7, -0.002], [0.02, 0.7, 0.012])
        normal = np.array([0.0, np.sin(angle), np.cos(angle)])
        point = (0.02 - depth) * normal + np.array([x, 0.0, 0.0])
        there = rigid.apply(body.soft.world_from_mesh, point)
        answer, jumped = body.soft.respond(there, jumped)
        fresh, _ = body.soft.respond(there, None)
        assert np.array_equal(answer.displacement, fresh.displacement)
        assert answer.in_range == fresh.in_range
        assert count_inverted(body, answer.displacement) == 0


ON_STRIP = cylinder_spec(0.03, 0.1, touch_angle_rad=1.0, skin_spacing_m=0.0045).mesh


@pytest.mark.parametrize(
    "mesh",
    [
        ON_STRIP,
        replace(ON_STRIP, support=BaseSupport(height_m=0.01)),
        replace(ON_STRIP, geometry=Sphere(radius_m=0.03)),
    ],
    ids=["cylinder on a strip", "cylinder on a base", "sphere"],
)
def test_the_stated_error_decreases_with_depth_and_precision(mesh: MeshSpec) -> None:
    depths = np.linspace(0.0, 0.02, 81)
    stated = np.array(
        [
            [state_force_error_ratio(method, mesh, depth) for depth in depths]
            for method in ("linear", "coarse_table", "nonlinear_table")
        ]
    )
    assert (np.diff(stated, axis=0) <= 0.0).all()
    assert (np.diff(stated, axis=1) <= 0.0).all()
    assert (np.diff(stated[:, -1]) < 0.0).all()
    # Light pushes are least precise; beyond the last depth the error is constant.
    assert (stated[:, 0] > 1.5 * stated[:, -1]).all()
    assert (stated[:, depths > 0.005] == stated[:, -1:]).all()
    # Without meshes that are fine near the push, the forces of tables are not corrected.
    assert (stated[2, 0] < 0.2) == has_focused_meshes(mesh)
