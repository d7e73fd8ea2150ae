"""Test the nonlinear table of shapes other than cylinders: smoothness and bounds."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from flexsheet.nodes.fem_solver import snapshots
from flexsheet.nodes.fem_solver.body import SceneBody, attach_table, make_table_spec
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.precompute_table import compute_table
from flexsheet.nodes.fem_solver.table import END_SPAN_M
from tests.limit_bodies import Body, count_inverted, make_body, make_scene
from tests.soft_bodies import InlineExecutor

DEPTHS = (0.0015, 0.002, 0.003, 0.004)
BASE = {"kind": "base", "height_m": 0.01}
SCENES = {
    "sphere": make_scene({"shape": "sphere", "radius_m": 0.025}, BASE, height_m=0.025),
    "rounded_box": make_scene(
        {"shape": "rounded_box", "size_m": [0.06, 0.05, 0.03], "edge_radius_m": 0.01},
        BASE,
        height_m=0.015,
    ),
}


@pytest.fixture(scope="module", params=SCENES)
def both(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Body, SceneBody]:
    """Return a body with the linear method, and with a table of few samples and small depths."""
    scene = SCENES[request.param]
    linear = make_body(scene, 0.0065)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snapshots, "DEPTHS_M", DEPTHS)
        patch.setattr(snapshots, "APART_RATIO", 6.0)
        spec = make_table_spec(scene, linear.soft.spec)
        folder: Path = tmp_path_factory.mktemp("table")
        table = compute_table(spec, linear.model, folder, InlineExecutor(), lambda *_: None)
    return linear, attach_table(linear.soft, scene, linear.model, table)


def pushed(body: SceneBody, x: float, y: float, depth: float) -> tuple[Response, ContactQuery]:
    found = body.shape.closest(body.front + np.array([x, y, 0.0]))
    push = ContactQuery(found.point, found.normal, depth)
    return body.method.respond(push), push


def hertz_n(body: SceneBody, push: ContactQuery) -> float:
    """Return Hertz' force on a finger that is pushed into a sphere or a flat side, N."""
    curvature = float(np.linalg.norm(body.shape.closest(push.surface).shape_operator, 2))
    radius_m = 1.0 / (1.0 / 0.007 + curvature)
    modulus_pa, poisson = 4000.0, 0.45
    factor = 4.0 / 3.0 * modulus_pa / (1.0 - poisson**2)
    return float(factor * np.sqrt(radius_m) * push.depth_m**1.5)


def test_it_deforms_at_the_push_like_the_linear_method_with_the_force_of_hertz(
    both: tuple[Body, SceneBody],
) -> None:
    linear, table = both
    for x, y in ((0.0, 0.0), (0.004, 0.003), (-0.005, 0.002)):
        answer, push = pushed(table, x, y, 0.0025)
        other, _ = pushed(linear.soft, x, y, 0.0025)
        assert answer.in_range
        inward = -(answer.displacement @ push.normal.astype(np.float32))
        # The nodes are 6.5 mm apart, so that none may be at the deepest point.
        assert 0.6 * 0.0025 < inward.max() < 1.2 * 0.0025
        deepest = table.rest[int(inward.argmax())]
        assert np.linalg.norm(deepest - push.surface) < 0.007
        assert answer.force_n @ push.normal == pytest.approx(hertz_n(table, push), rel=0.15)
        away = np.linalg.norm(table.rest - push.surface, axis=1) > 0.0105
        apart = np.linalg.norm(answer.displacement - other.displacement, axis=1)
        assert apart[away].max() < 0.6e-3  # elements of 13 mm


def test_a_slide_moves_no_skin_node_a_tenth_of_a_millimetre(both: tuple[Body, SceneBody]) -> None:
    for depth in (0.002, 0.01):
        answers = [pushed(both[1], -0.002 + 2e-5 * i, 0.001, depth)[0] for i in range(200)]
        moves = [
            np.linalg.norm(a.displacement - b.displacement, axis=1).max()
            for a, b in itertools.pairwise(answers)
        ]
        assert max(moves) < 0.1e-3


def test_deeper_than_solved_is_flagged_and_bounded(both: tuple[Body, SceneBody]) -> None:
    linear, table = both
    for depth in (DEPTHS[-1] - END_SPAN_M - 1e-4, 0.006, 0.02):
        answer, _ = pushed(table, 0.001, 0.002, depth)
        assert answer.in_range == (depth < DEPTHS[-1] - END_SPAN_M)
        assert np.linalg.norm(answer.displacement, axis=1).max() < 1.2 * DEPTHS[-1]
        assert count_inverted(linear, answer.displacement) == 0
