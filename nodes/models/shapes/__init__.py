"""Provide the shapes of virtual objects. All shapes implement the interface `surface.Shape`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flexsheet.nodes.models.shapes.geometries import (
    GEOMETRIES,
    CuboidMap,
    GeometryDescription,
    map_nearest_points,
)
from flexsheet.nodes.models.shapes.smooth_mesh import SmoothMeshShape
from flexsheet.nodes.models.shapes.solids import (
    CylinderShape,
    EllipsoidShape,
    PlaneShape,
    RoundedBoxShape,
    SphereShape,
)
from flexsheet.nodes.models.shapes.surface import (
    Convex,
    Nearest,
    Shape,
    principal_curvatures,
    projection_jacobian,
    tightest_curvature,
)
from flexsheet.nodes.models.shapes.triangles import MeshError


def make_shape(geometry: Mapping[str, Any]) -> Shape:
    """Make a shape from a description such as `dict(scene.object.geometry)`.

    geometry: the key `shape` is the name of the shape, the key `origin` is ignored, and the other
        keys are the dimensions.

    Raises KeyError if the name is unknown, and ValueError if a dimension is invalid. For an invalid
    mesh, the error is MeshError, a subclass of ValueError.
    """
    dimensions = {key: value for key, value in geometry.items() if key not in ("shape", "origin")}
    return GEOMETRIES[geometry["shape"]].make_shape(**dimensions)


__all__ = [
    "GEOMETRIES",
    "Convex",
    "CuboidMap",
    "CylinderShape",
    "EllipsoidShape",
    "GeometryDescription",
    "MeshError",
    "Nearest",
    "PlaneShape",
    "RoundedBoxShape",
    "Shape",
    "SmoothMeshShape",
    "SphereShape",
    "make_shape",
    "map_nearest_points",
    "principal_curvatures",
    "projection_jacobian",
    "tightest_curvature",
]
