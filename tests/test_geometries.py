"""Every kind of geometry is described once, and a new one needs no more than its description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import BaseSupport, Geometry, Part, Pose, Positive, Scene
from flexsheet.nodes.console.scenes import edit_scene, front_m
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh, mesh_spec
from flexsheet.nodes.models.shapes import (
    GEOMETRIES,
    Convex,
    GeometryDescription,
    Nearest,
    make_shape,
    map_nearest_points,
)
from flexsheet.nodes.models.shapes.surface import check_points, check_previous
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import SheetTrajectoryPlanner
from flexsheet.nodes.renderer.object_surface import make_surface
from flexsheet.nodes.twin.true_object import TrueBody
from tests.scene_solids import SHAPES, geometry

Floats = NDArray[np.float64]

SCENE = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
KINDS = get_args(get_args(Geometry)[0])
HALF_M, RADIUS_M = 0.03, 0.02


@dataclass(frozen=True)
class CapsuleShape(Convex):
    """A cylinder about x with half spheres at both ends."""

    half_length_m: float
    radius_m: float

    def closest(self, points: ArrayLike, *, previous: ArrayLike | None = None) -> Nearest:
        queries = check_points(points)
        check_previous(previous, queries)
        centre = np.zeros_like(queries)
        centre[..., 0] = np.clip(queries[..., 0], -self.half_length_m, self.half_length_m)
        offset = queries - centre
        undecided = np.linalg.norm(offset, axis=-1) < 1e-6
        offset = np.where(undecided[..., None], [0.0, 0.0, 1e-9], offset)
        distance = np.linalg.norm(offset, axis=-1)
        normal = offset / distance[..., None]
        tangential = np.eye(3) - normal[..., :, None] * normal[..., None, :]
        on_side = np.abs(queries[..., 0]) < self.half_length_m
        operator = tangential / self.radius_m
        operator[on_side] -= np.diag([1.0, 0.0, 0.0]) / self.radius_m
        no = np.zeros(distance.shape, dtype=bool)
        point = centre + self.radius_m * normal
        return Nearest(point, normal, distance - self.radius_m, operator, no, undecided)

    def signed_distance(self, points: ArrayLike) -> Floats:
        return self.closest(points).height_m


class Capsule(Part):
    """Solid capsule about the object frame's origin, its axis along x."""

    shape: Literal["capsule"] = "capsule"
    half_length_m: Positive
    radius_m: Positive


def capsule_half_m(capsule: Any) -> Floats:
    radius_m = capsule.radius_m
    return np.array([capsule.half_length_m + radius_m, radius_m, radius_m])


CAPSULE = GeometryDescription(
    CapsuleShape,
    bounds_m=lambda capsule: (-capsule_half_m(capsule), capsule_half_m(capsule)),
    extent_m=lambda capsule, direction: float(
        capsule.half_length_m * abs(direction[0]) + capsule.radius_m
    ),
    scale=lambda capsule, ratio: {
        "half_length_m": ratio * capsule.half_length_m,
        "radius_m": ratio * capsule.radius_m,
    },
    cuboid_map=lambda capsule, shape: map_nearest_points(capsule_half_m(capsule), shape),
)


@pytest.fixture
def capsule_scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """A scene with a kind of geometry that only its description makes known."""
    monkeypatch.setitem(GEOMETRIES, "capsule", CAPSULE)
    body = SCENE.object.model_copy(
        update={
            "geometry": Capsule(half_length_m=HALF_M, radius_m=RADIUS_M),
            "world_from_object": Pose(position_m=np.zeros(3), rpy_rad=np.zeros(3)),
            "support": BaseSupport(height_m=0.01),
        }
    )
    return SCENE.model_copy(update={"object": body})


def distances_m(points: Floats) -> Floats:
    return CapsuleShape(HALF_M, RADIUS_M).signed_distance(points)


def test_a_new_geometry_is_meshed(capsule_scene: Scene) -> None:
    mesh = build_mesh(mesh_spec(capsule_scene, 0.006))
    assert np.abs(distances_m(mesh.nodes[mesh.skin])).max() < 1e-6
    assert mesh.fixed.any()


def test_a_new_geometry_is_drawn(capsule_scene: Scene) -> None:
    solid = capsule_scene.object.geometry
    surface = make_surface(
        solid, make_shape(dict(solid)), world_from_object=np.eye(4), spacing_m=0.004
    )
    assert np.abs(distances_m(surface.rest_world_m)).max() < 1e-9


def test_a_new_geometry_is_simulated(capsule_scene: Scene) -> None:
    true = TrueBody(capsule_scene).at_rest()
    assert np.abs(distances_m(true.vertices)).max() < 1e-6


def test_a_new_geometry_is_presented(capsule_scene: Scene) -> None:
    settings = PlannerParameters()
    planner = SheetTrajectoryPlanner(capsule_scene, settings)
    assert planner.motion.world_from_sheet[:3, 3] == pytest.approx([0.0, 0.0, RADIUS_M])


def test_a_new_geometry_is_scaled_in_the_console(capsule_scene: Scene) -> None:
    solid = capsule_scene.object.geometry
    described = GEOMETRIES["capsule"].scale(solid, 2.0)
    assert described == {"half_length_m": 2.0 * HALF_M, "radius_m": 2.0 * RADIUS_M}
    assert front_m(solid, np.eye(3)) == RADIUS_M


def test_every_geometry_of_a_scene_is_described_with_its_dimensions() -> None:
    assert {kind.model_fields["shape"].default for kind in KINDS} == set(GEOMETRIES)
    for name in SHAPES:
        solid = next(kind for kind in KINDS if kind.model_fields["shape"].default == name)
        make_shape(dict(solid.model_validate(geometry(name))))


@pytest.mark.parametrize("name", SHAPES)
def test_bounds_and_extents_are_those_of_the_shape(name: str) -> None:
    """Compared with nearest points of queries far outside, which lie on the touchable surface."""
    kind = next(kind for kind in KINDS if kind.model_fields["shape"].default == name)
    solid = kind.model_validate(geometry(name))
    random = np.random.default_rng(0).normal(size=(2000, 3))
    directions = random / np.linalg.norm(random, axis=1, keepdims=True)
    found = make_shape(dict(solid)).closest(0.3 * directions).point
    low, high = GEOMETRIES[name].bounds_m(solid)
    rounding_m = 0.0015 if name == "mesh" else 1e-9
    assert (found >= low - rounding_m).all()
    assert (found <= high + rounding_m).all()
    for direction in directions[:20]:
        extent_m = GEOMETRIES[name].extent_m(solid, direction)
        if name == "plane":
            assert extent_m == 0.0
            continue
        beyond_axis = 0.5 * getattr(solid, "length_m", 0.0) * abs(direction[0])
        farthest_m = float((found @ direction).max()) - beyond_axis
        assert farthest_m == pytest.approx(extent_m, abs=0.003)


@pytest.mark.parametrize("name", SHAPES)
def test_a_scaled_geometry_is_larger_by_the_ratio(name: str) -> None:
    kind = next(kind for kind in KINDS if kind.model_fields["shape"].default == name)
    solid = kind.model_validate(geometry(name))
    changes = GEOMETRIES[name].scale(solid, 1.5)
    larger = kind.model_validate({**dict(solid), **changes})
    low, high = GEOMETRIES[name].bounds_m(larger)
    expected = {"plane": 1.0}.get(name, 1.5) * np.array(GEOMETRIES[name].bounds_m(solid))
    axes = slice(1, 3) if name == "cylinder" else slice(0, 3)
    assert np.array([low, high])[:, axes] == pytest.approx(expected[:, axes])


def test_a_scaled_object_keeps_its_front() -> None:
    material, sheet = SCENE.object.material, SCENE.sheet
    larger = edit_scene(
        SCENE,
        young_modulus_pa=material.young_modulus_pa,
        stretch_ratio=sheet.min_stretch_ratio,
        size_ratio=1.2,
    )
    fronts = [
        front_m(scene.object.geometry, np.eye(3)) + scene.object.world_from_object.position_m[2]
        for scene in (SCENE, larger)
    ]
    assert fronts[0] == pytest.approx(fronts[1])
