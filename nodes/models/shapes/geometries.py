"""Describe each kind of geometry in one table, `GEOMETRIES`.

A description contains functions that compute properties from the dimensions of a geometry. They
read the dimensions as attributes, either of the geometry in a scene or of a shape. To add a new
kind of geometry, define a shape class and add a description to the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.shapes.smooth_mesh import SmoothMeshShape
from flexsheet.nodes.models.shapes.solids import (
    CylinderShape,
    EllipsoidShape,
    PlaneShape,
    RoundedBoxShape,
    SphereShape,
)
from flexsheet.nodes.models.shapes.surface import Shape

INNER_RATIO = 0.8
"""The size of the undistorted inner lattice in the mesh of a round solid, divided by the size of
the solid.
"""


@dataclass(frozen=True, slots=True)
class CuboidMap:
    """A map from the surface of the cube [-1, 1]^3 to the surface of a solid, used for meshing.

    half_m: half extents (3,) of the solid.
    inner_m: half extents (3,) of the inner part of the mesh, which is an undistorted lattice of
        cells.
    surface: function that maps points (n, 3) on the cube to points (n, 3), in m, on the solid.
    is_round: whether the whole surface is curved, as on an ellipsoid; false if it has flat faces.
    """

    half_m: Floats
    inner_m: Floats
    surface: Callable[[Floats], Floats]
    is_round: bool


@dataclass(frozen=True, slots=True)
class GeometryDescription:
    """A description of one kind of geometry by functions of its dimensions.

    make_shape: function that makes the shape; the dimensions are its keyword arguments.
    bounds_m: function that returns the lower and upper corner (3,) of the bounding box of the
        solid. For a half-space, the box contains only the touchable rectangle.
    extent_m: function that returns how far (m) the touchable surface extends from the origin along
        a unit vector.
    scale: function that returns the dimensions multiplied by a ratio.
    cuboid_map: function that returns the map from a cube to the solid, by which the solid is
        meshed. The arguments are the dimensions and the shape. None means that another method
        meshes the solid.
    """

    make_shape: Callable[..., Shape]
    bounds_m: Callable[[Any], tuple[Floats, Floats]]
    extent_m: Callable[[Any, Floats], float]
    scale: Callable[[Any, float], dict[str, Any]]
    cuboid_map: Callable[[Any, Shape], CuboidMap] | None = None


def map_round_solid(half_m: Floats) -> CuboidMap:
    """Return the map from a cube to an ellipsoid that is used to mesh the ellipsoid.

    half_m: half extents (3,) of the ellipsoid, which is centred on the origin, m.
    """
    return CuboidMap(half_m, INNER_RATIO * half_m, lambda w: half_m * cube_to_sphere(w), True)


def map_nearest_points(half_m: Floats, shape: Shape) -> CuboidMap:
    """Return the map from a cube to a solid that is used to mesh the solid.

    Each point of the cube's surface, scaled to a box, is mapped to the nearest point on `shape`.

    half_m (3,): half extents of the box, m.
    """
    return CuboidMap(half_m, half_m, lambda w: shape.closest(half_m * w).point, False)


def cube_to_sphere(w: Floats) -> Floats:
    """Map points w (n, 3) on the surface of the cube [-1, 1]^3 to the unit sphere.

    The map is smooth and nearly area-preserving. The first coordinate of the result is w1 sqrt(1 -
    w2^2/2 - w3^2/2 + w2^2 w3^2/3). The other coordinates follow by cyclic permutation.
    """
    square = np.square(w)
    second, third = np.roll(square, -1, axis=1), np.roll(square, -2, axis=1)
    result: Floats = w * np.sqrt(1.0 - 0.5 * (second + third) + second * third / 3.0)
    return np.asarray(result / np.linalg.norm(result, axis=1, keepdims=True))


def _symmetric(half_m: Floats) -> tuple[Floats, Floats]:
    return -half_m, half_m


def _cylinder_bounds(cylinder: Any) -> tuple[Floats, Floats]:
    return _symmetric(np.array([0.5 * cylinder.length_m, cylinder.radius_m, cylinder.radius_m]))


def _cylinder_extent(cylinder: Any, direction: Floats) -> float:
    """Return how far (m) the lateral surface of a cylinder extends along a unit vector (3,)."""
    return float(cylinder.radius_m * np.hypot(direction[1], direction[2]))


def _plane_bounds(plane: Any) -> tuple[Floats, Floats]:
    return _symmetric(np.array([0.5 * plane.width_m, 0.5 * plane.height_m, 0.0]))


def _box_extent(box: Any, direction: Floats) -> float:
    core = 0.5 * np.array(box.size_m) - box.edge_radius_m
    return float(core @ np.abs(direction)) + float(box.edge_radius_m)


def _scale_box(box: Any, ratio: float) -> dict[str, Any]:
    return {
        "size_m": tuple(ratio * side for side in box.size_m),
        "edge_radius_m": ratio * box.edge_radius_m,
    }


def _mesh_bounds(mesh: Any) -> tuple[Floats, Floats]:
    used = mesh.vertices_m[np.unique(mesh.triangles)]
    return used.min(axis=0), used.max(axis=0)


def _scale_mesh(mesh: Any, ratio: float) -> dict[str, Any]:
    return {"vertices_m": ratio * mesh.vertices_m, "smoothing_m": ratio * mesh.smoothing_m}


GEOMETRIES: dict[str, GeometryDescription] = {
    "cylinder": GeometryDescription(
        CylinderShape,
        bounds_m=_cylinder_bounds,
        extent_m=_cylinder_extent,
        scale=lambda cylinder, ratio: {"radius_m": ratio * cylinder.radius_m},
    ),
    "sphere": GeometryDescription(
        SphereShape,
        bounds_m=lambda sphere: _symmetric(np.full(3, sphere.radius_m)),
        extent_m=lambda sphere, direction: float(sphere.radius_m),
        scale=lambda sphere, ratio: {"radius_m": ratio * sphere.radius_m},
        cuboid_map=lambda sphere, shape: map_round_solid(np.full(3, sphere.radius_m)),
    ),
    "ellipsoid": GeometryDescription(
        EllipsoidShape,
        bounds_m=lambda ellipsoid: _symmetric(np.array(ellipsoid.semi_axes_m)),
        extent_m=lambda ellipsoid, direction: float(
            np.linalg.norm(np.array(ellipsoid.semi_axes_m) * direction)
        ),
        scale=lambda ellipsoid, ratio: {
            "semi_axes_m": tuple(ratio * axis for axis in ellipsoid.semi_axes_m)
        },
        cuboid_map=lambda ellipsoid, shape: map_round_solid(np.array(ellipsoid.semi_axes_m)),
    ),
    "plane": GeometryDescription(
        PlaneShape,
        bounds_m=_plane_bounds,
        extent_m=lambda plane, direction: 0.0,
        scale=lambda plane, ratio: {},
    ),
    "rounded_box": GeometryDescription(
        RoundedBoxShape,
        bounds_m=lambda box: _symmetric(0.5 * np.array(box.size_m)),
        extent_m=_box_extent,
        scale=_scale_box,
        cuboid_map=lambda box, shape: map_nearest_points(0.5 * np.array(box.size_m), shape),
    ),
    "mesh": GeometryDescription(
        SmoothMeshShape,
        bounds_m=_mesh_bounds,
        extent_m=lambda mesh, direction: float((mesh.vertices_m @ direction).max()),
        scale=_scale_mesh,
    ),
}
"""The descriptions of all kinds of geometry.

The keys are the values of `object.geometry.shape` in scene files.
"""
