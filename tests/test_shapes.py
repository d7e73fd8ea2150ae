"""Test shapes with a formula: nearest points, distances and singular cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from flexsheet.nodes.models.shapes import (
    GEOMETRIES,
    CylinderShape,
    EllipsoidShape,
    Nearest,
    PlaneShape,
    RoundedBoxShape,
    Shape,
    SphereShape,
    make_shape,
    principal_curvatures,
    projection_jacobian,
    tightest_curvature,
)

Floats = NDArray[np.float64]

CYLINDER = CylinderShape(0.035, 0.12)
SOLIDS: dict[str, Shape] = {
    "cylinder": CYLINDER,
    "sphere": SphereShape(0.03),
    "plane": PlaneShape(0.2, 0.1),
    "ellipsoid": EllipsoidShape((0.05, 0.03, 0.02)),
    "disc": EllipsoidShape((0.05, 0.05, 0.01)),
    "cigar": EllipsoidShape((0.06, 0.01, 0.01)),
    "ball": EllipsoidShape((0.03, 0.03, 0.03)),
    "rounded box": RoundedBoxShape((0.1, 0.06, 0.04), 0.005),
    "capsule": RoundedBoxShape((0.1, 0.03, 0.03), 0.015),
}
solids = pytest.mark.parametrize("shape", SOLIDS.values(), ids=SOLIDS.keys())
places = npst.arrays(np.float64, 3, elements=st.floats(-0.1, 0.1))


def every(rng_seed: int, count: int = 400) -> Floats:
    return np.random.default_rng(rng_seed).uniform(-0.09, 0.09, (count, 3))


def where_smooth(found: Nearest) -> NDArray[np.bool_]:
    return np.asarray(~found.on_edge & ~found.undecided)


@solids
@settings(max_examples=40)
@given(point=places)
def test_the_nearest_point_is_on_the_surface_along_the_normal(shape: Shape, point: Floats) -> None:
    found = shape.closest(point)
    assert abs(float(shape.signed_distance(found.point))) < 1e-12
    assert np.linalg.norm(found.normal) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(found.shape_operator @ found.normal, 0.0, atol=1e-9)
    if not found.on_edge:
        assert found.point + found.height_m * found.normal == pytest.approx(
            point, abs=2e-6 if found.undecided else 1e-9
        )
        if not isinstance(shape, CylinderShape):  # inside it the caps, untouchable, may be nearer
            assert float(found.height_m) == pytest.approx(
                float(shape.signed_distance(point)), abs=1e-12
            )


@solids
@settings(max_examples=40)
@given(one=places, other=places)
def test_the_signed_distance_is_one_lipschitz(shape: Shape, one: Floats, other: Floats) -> None:
    apart = float(np.linalg.norm(one - other))
    rise = abs(float(shape.signed_distance(one)) - float(shape.signed_distance(other)))
    assert rise <= apart * (1.0 + 1e-9) + 1e-12


@solids
def test_no_surface_point_is_nearer(shape: Shape) -> None:
    queries = every(1)
    surface = shape.closest(every(2, 2000)).point
    nearest = np.linalg.norm(queries[:, None] - surface[None], axis=2).min(axis=1)
    found = shape.closest(queries)
    inner = ~found.on_edge
    assert (np.abs(found.height_m)[inner] <= nearest[inner] + 1e-9).all()


@solids
def test_the_gradient_of_the_distance_is_the_normal(shape: Shape) -> None:
    # Outside, where the solid's nearest point is a touchable one.
    queries = every(3)
    found = shape.closest(queries)
    keep = where_smooth(found) & (found.height_m > 1e-4)
    step = 1e-6 * np.eye(3)
    rise = [
        shape.signed_distance(queries + one) - shape.signed_distance(queries - one) for one in step
    ]
    gradient = np.stack(rise, axis=1) / 2e-6
    assert keep.sum() > 50
    assert np.allclose(gradient[keep], found.normal[keep], atol=1e-6)


@solids
def test_curvature_is_how_the_normal_turns(shape: Shape) -> None:
    found = shape.closest(every(4))
    keep = where_smooth(found)
    point, normal = found.point[keep], found.normal[keep]
    across = np.cross(normal, np.random.default_rng(5).normal(size=normal.shape))
    along = across / np.linalg.norm(across, axis=1, keepdims=True)
    ahead, behind = (shape.closest(point + way * along) for way in (1e-7, -1e-7))
    turned = (ahead.normal - behind.normal) / 2e-7
    expected = (found.shape_operator[keep] @ along[:, :, None])[:, :, 0]
    # A rounded box's curvature steps; a pair that straddles a seam sees the mean of both sides.
    wrong = np.linalg.norm(turned - expected, axis=1) > 1e-4 * (1.0 + np.linalg.norm(turned))
    assert wrong.mean() < 0.01


@solids
def test_the_foot_moves_by_its_jacobian(shape: Shape) -> None:
    queries = every(6)
    found = shape.closest(queries)
    keep = where_smooth(found) & (found.height_m > 1e-3)
    moved = np.array([3e-8, -2e-8, 1e-8])
    after = shape.closest(queries + moved).point - shape.closest(queries - moved).point
    kept = Nearest(
        *(getattr(found, name)[keep] for name in ("point", "normal", "height_m")),
        found.shape_operator[keep],
        found.on_edge[keep],
        found.undecided[keep],
    )
    wrong = np.linalg.norm(0.5 * after[keep] - projection_jacobian(kept) @ moved, axis=1) > 1e-11
    assert wrong.mean() < 0.01


@solids
def test_single_and_batch_queries_agree(shape: Shape) -> None:
    queries = every(7)
    before = shape.closest(queries + 2e-4).point
    many = shape.closest(queries, previous=before)
    for i in np.flatnonzero(~many.undecided)[:150]:
        one = shape.closest(queries[i], previous=before[i])
        assert one.point == pytest.approx(many.point[i], abs=1e-11)
        assert one.normal == pytest.approx(many.normal[i], abs=1e-9)
        assert one.shape_operator == pytest.approx(many.shape_operator[i], rel=1e-6, abs=1e-6)


@solids
def test_a_convex_solid_has_no_concavity_and_a_known_curvature(shape: Shape) -> None:
    found = shape.closest(every(8, 40))
    for point, normal, operator in zip(
        found.point, found.normal, found.shape_operator, strict=True
    ):
        assert shape.rise_m(point, normal, 0.03) == 0.0
        known = principal_curvatures(operator, normal)[0].max()
        assert tightest_curvature(operator) == pytest.approx(known, rel=1e-7, abs=1e-9)


def test_principal_curvatures_of_known_surfaces() -> None:
    side = CYLINDER.closest(np.array([0.01, 0.02, 0.04]))
    values, ways = principal_curvatures(side.shape_operator, side.normal)
    assert values == pytest.approx([0.0, 1.0 / 0.035])
    assert np.abs(ways[0]) == pytest.approx([1.0, 0.0, 0.0])
    pole = EllipsoidShape((0.05, 0.03, 0.02)).closest(np.array([0.0, 0.0, 0.05]))
    values, ways = principal_curvatures(pole.shape_operator, pole.normal)
    assert values == pytest.approx([0.02 / 0.05**2, 0.02 / 0.03**2])
    assert np.abs(ways) == pytest.approx(np.eye(3)[:2], abs=1e-6)
    corner = RoundedBoxShape((0.1, 0.06, 0.04), 0.005).closest(np.array([0.06, 0.04, 0.03]))
    assert principal_curvatures(corner.shape_operator, corner.normal)[0] == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("point", "height", "signed", "on_edge"),
    [
        ((0.0, 0.0, 0.045), 0.01, 0.01, False),
        ((0.0, 0.030, 0.0), -0.005, -0.005, False),
        ((0.058, 0.0, 0.0), -0.035, -0.002, False),
        ((0.06, 0.0, 0.035), 0.0, 0.0, False),
        ((0.063, 0.0, 0.039), 0.004, 0.005, True),
        ((-0.07, 0.0, 0.02), -0.015, 0.01, True),
    ],
)
def test_the_cylinders_ends(
    point: tuple[float, float, float], height: float, signed: float, on_edge: bool
) -> None:
    found = CYLINDER.closest(point)
    assert float(found.height_m) == pytest.approx(height, abs=1e-12)
    assert float(CYLINDER.signed_distance(point)) == pytest.approx(signed, abs=1e-12)
    assert bool(found.on_edge) is on_edge
    assert abs(found.point[0]) <= 0.06


def test_the_planes_rim() -> None:
    found = PlaneShape(0.2, 0.1).closest(np.array([[0.11, 0.0, 0.02], [0.1, 0.05, -0.03]]))
    assert found.on_edge.tolist() == [True, False]
    assert found.point.tolist() == [[0.1, 0.0, 0.0], [0.1, 0.05, 0.0]]
    assert found.height_m.tolist() == [0.02, -0.03]


@pytest.mark.parametrize(
    ("shape", "point"),
    [
        (CYLINDER, (0.01, 0.0, 0.0)),
        (SphereShape(0.03), (0.0, 0.0, 0.0)),
        (SOLIDS["ellipsoid"], (0.001, 0.002, 0.0)),
        (SOLIDS["cigar"], (0.01, 0.0, 0.0)),
        (SOLIDS["ball"], (0.0, 0.0, 0.0)),
        (SOLIDS["rounded box"], (0.0, 0.0, 0.0)),
        (SOLIDS["rounded box"], (0.001, 0.0, 0.0)),
        (SOLIDS["capsule"], (0.01, 0.0, 0.0)),
    ],
)
def test_of_equally_near_points_the_front_or_the_earlier_one_is_returned(
    shape: Shape, point: tuple[float, float, float]
) -> None:
    query = np.array(point)
    again = shape.closest(query)
    assert bool(again.undecided)
    assert again.normal[2] > 0.8
    behind = shape.closest(np.array([point[0], 0.0, -0.2])).point
    assert shape.closest(query, previous=behind).normal[2] < -0.8
    # A point without a direction says nothing.
    assert np.isfinite(shape.closest(query, previous=np.zeros(3)).normal).all()


@pytest.mark.parametrize("name", ["ellipsoid", "disc", "rounded box"])
def test_a_push_past_the_middle_stays_on_its_side(name: str) -> None:
    shape, previous = SOLIDS[name], None
    for depth in np.linspace(0.03, -0.004, 120):
        query = np.array([0.004, 0.003, depth])
        found = shape.closest(query, previous=previous)
        assert found.normal[2] > 0.8
        if previous is not None:
            assert np.linalg.norm(found.point - previous) < 5e-4
        previous = found.point
    assert shape.closest(query).normal[2] < 0.0


@solids
def test_a_path_outside_has_no_jump(shape: Shape) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 4000)
    path = 0.09 * np.stack([np.sin(angle), 0.4 * np.cos(angle), np.cos(angle)], axis=1)
    found = shape.closest(path)
    points = found.point
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1)
    outside = (shape.signed_distance(path) > 1e-3) & ~found.on_edge
    outside = outside[1:] & outside[:-1]
    # Outside a convex solid the nearest point moves no faster than the query.
    assert (np.linalg.norm(np.diff(points, axis=0), axis=1)[outside] <= moved[outside] + 1e-9).all()


@solids
def test_one_is_as_many(shape: Shape) -> None:
    queries = every(7, 20)
    many = shape.closest(queries)
    for i, query in enumerate(queries):
        one = shape.closest(query)
        for name in ("point", "normal", "height_m", "shape_operator", "on_edge", "undecided"):
            assert np.shape(getattr(one, name)) == np.shape(getattr(many, name)[i])
            assert np.allclose(getattr(one, name), getattr(many, name)[i], atol=1e-9)
    none = shape.closest(np.zeros((0, 3)))
    assert none.point.shape == (0, 3)
    assert none.shape_operator.shape == (0, 3, 3)


@solids
def test_bad_queries_are_rejected_and_far_ones_answered(shape: Shape) -> None:
    for bad in ([np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [2e6, 0.0, 0.0]):
        with pytest.raises(ValueError, match="NaN, infinity or coordinates beyond"):
            shape.closest(bad)
        with pytest.raises(ValueError, match="NaN, infinity or coordinates beyond"):
            shape.signed_distance(bad)
    for wrong in (1.0, [0.0, 0.0], np.zeros((2, 2, 3))):
        with pytest.raises(ValueError, match=r"the shape is \(.*\), expected \(3,\) or \(n, 3\)"):
            shape.closest(wrong)
    with pytest.raises(ValueError, match=r"previous: the shape is \(2, 3\), expected \(3,\)"):
        shape.closest(np.zeros(3), previous=np.zeros((2, 3)))
    far = shape.closest(np.array([3e5, -4e5, 5e5]))
    assert np.isfinite(far.point).all()
    assert np.linalg.norm(far.point) < 0.2


@pytest.mark.parametrize(
    "measures",
    [
        {"shape": "cylinder", "radius_m": 0.0, "length_m": 0.1},
        {"shape": "sphere", "radius_m": float("nan")},
        {"shape": "plane", "width_m": -1.0, "height_m": 1.0},
        {"shape": "ellipsoid", "semi_axes_m": (0.1, float("inf"), 0.1)},
        {"shape": "rounded_box", "size_m": (0.1, 0.1, 0.02), "edge_radius_m": 0.011},
    ],
)
def test_measures_that_make_no_solid_are_rejected(measures: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"length|half the minimum"):
        make_shape(measures)


def test_shapes_are_made_by_name() -> None:
    made = make_shape({"shape": "cylinder", "radius_m": 0.035, "length_m": 0.12})
    assert made == CYLINDER
    with pytest.raises(KeyError):
        make_shape({"shape": "torus"})
    assert set(GEOMETRIES) == {"cylinder", "sphere", "plane", "ellipsoid", "rounded_box", "mesh"}


@given(st.floats(-3.0, 3.0))
def test_the_angle_grows_from_z_towards_y(angle: float) -> None:
    point = np.array([0.02, np.sin(angle), np.cos(angle)])
    assert CYLINDER.angle_rad(point) == pytest.approx(angle)
