"""Read, check and repair the mesh file of a scene.

A scene file can give an object as

geometry: {shape: mesh_file, file: liver.obj, metres_per_unit: 0.01}

with a path relative to the scene file. The scene message contains the mesh itself.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from flexsheet.launch.objects.arm_models import load_arm_models
from flexsheet.launch.objects.textures import load_image
from flexsheet.launch.plans.documents import Document, Key, did_you_mean, validate
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Mesh, Positive, Scene
from flexsheet.nodes.models.shapes import GEOMETRIES, MeshError, SmoothMeshShape
from flexsheet.nodes.models.shapes.smooth_mesh import default_smoothing_m
from flexsheet.nodes.models.shapes.triangles import (
    MAX_TRIANGLES,
    check_mesh,
    count_intersections,
    find_degenerate,
    unify_winding,
    volume_m3,
)
from flexsheet.nodes.models.sheet.tension import edge_force_n

GEOMETRY: Key = ("object", "geometry")
MESH_FILE = "mesh_file"
SHAPE_NAMES = (*(name for name in GEOMETRIES if name != "mesh"), MESH_FILE)
"""The names of shapes that scene files can contain.

A scene file refers to a mesh by a file name, and does not contain the arrays of the mesh.
"""
SUFFIXES = (".obj", ".stl")
MAX_BYTES = 64 << 20
MIN_EXTENT_M, MAX_EXTENT_M = 0.005, 1.0
"""The minimum and maximum plausible extent of an object, in metres.

An extent outside this range is probably caused by a wrong unit.
"""
MAX_COORDINATE = 1e9
"""The maximum coordinate in a mesh file, in the unit of the file.

The limit prevents numeric overflow.
"""

MAX_CUTTING_RATIO = 0.01
"""The maximum number of intersecting triangle pairs, divided by the number of triangles.

If the ratio is smaller, the smooth surface bridges the intersections. If it is larger, the mesh is
not a solid.
"""


class MeshFile(LimitedModel):
    """The geometry of an object in a scene file that refers to a mesh file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    shape: Literal["mesh_file"] = "mesh_file"
    file: str = Field(description="path of the STL or OBJ file, relative to the scene file")
    metres_per_unit: Annotated[
        Positive, Field(description="unit of length in the mesh file, m: 0.001 for millimetres")
    ]
    smoothing_m: Positive | None = Field(
        default=None,
        description="length over which the surface is smoothed, m; null: a length that hides the "
        "facets is computed from the mesh",
    )


def make_scene(document: Document) -> Scene:
    """Make the scene message from a parsed scene file, including its mesh, image and arms.

    Raises BadInputError if the scene file or a file in it is invalid.
    """
    name = document.find((*GEOMETRY, "shape"))
    if name is not None and name not in SHAPE_NAMES:
        what = f'unknown shape "{name}"'
        raise document.error((*GEOMETRY, "shape"), what, did_you_mean(name, SHAPE_NAMES))
    if name == MESH_FILE:
        geometry = validate(MeshFile, document, at=GEOMETRY)
        path = document.path.parent / geometry.file
        try:
            mesh = read_mesh(path, geometry.metres_per_unit, geometry.smoothing_m)
        except MeshError as error:
            raise document.error((*GEOMETRY, "file"), f'"{geometry.file}": {error}') from error
        document.values["object"]["geometry"] = dict(mesh)
    load_image(document)
    load_arm_models(document)
    scene = validate(Scene, document)
    _check_edge_force(scene, document)
    _check_push_depth(scene, document)
    return scene


def _check_push_depth(scene: Scene, document: Document) -> None:
    """Raise BadInputError if the finger would push deeper than the largest size of a solid."""
    geometry = scene.object.geometry
    if geometry.shape == "plane":
        return
    extent_m = GEOMETRIES[geometry.shape].extent_m
    axes = np.eye(3)
    size_m = max(extent_m(geometry, axis) + extent_m(geometry, -axis) for axis in axes)
    depth_m = scene.working_range.push_depth_m
    if depth_m > size_m:
        what = f"{depth_m:g} m is more than the size of the object, {size_m:.3g} m"
        raise document.error(("working_range", "push_depth_m"), what, "give a smaller depth")


def _check_edge_force(scene: Scene, document: Document) -> None:
    """Raise BadInputError if the sheet exceeds its edge force already at its minimum stretch."""
    sheet = scene.sheet
    force_n = edge_force_n(sheet.min_stretch_ratio, sheet)
    if force_n > sheet.max_edge_force_n:
        what = (
            f"{sheet.min_stretch_ratio:g} needs {force_n:.4g} N on each clamped edge, more than "
            f"max_edge_force_n, {sheet.max_edge_force_n:g} N"
        )
        raise document.error(
            ("sheet", "min_stretch_ratio"), what, "check young_modulus_pa, or give a smaller ratio"
        )


def read_mesh(path: Path, metres_per_unit: float, smoothing_m: float | None) -> Mesh:
    """Read a closed mesh from a file, convert its unit to metres, and repair the mesh.

    The repairs merge duplicate vertices, remove degenerate triangles, duplicate triangles and
    unused vertices, and orient the triangles outwards. `Mesh.origin` lists the repairs.

    smoothing_m: smoothing length of the surface. If it is None, the default is used.

    Raises MeshError if the mesh has holes or other faults that cannot be repaired.
    """
    vertices, triangles, repairs = _repair(_load_trimesh(path), metres_per_unit)
    extent_m = float(np.ptp(vertices, axis=0).max())
    if not MIN_EXTENT_M <= extent_m <= MAX_EXTENT_M:
        raise MeshError(
            f"the object is {extent_m:.3g} m wide; check metres_per_unit {metres_per_unit:g} "
            "(0.001 for millimetres, 0.01 for centimetres)"
        )
    check_mesh(vertices, triangles)
    crossings = count_intersections(vertices, triangles)
    if crossings > MAX_CUTTING_RATIO * len(triangles):
        raise MeshError(f"{crossings} pairs of triangles intersect; repair the mesh")
    if crossings:
        repairs.append(f"{crossings} intersecting pairs of triangles bridged")
    if smoothing_m is None:
        smoothing_m = default_smoothing_m(vertices, triangles)
    deviation_m = SmoothMeshShape(vertices, triangles, smoothing_m).deviation_m()
    history = [
        f"{path.name} by {metres_per_unit:g}",
        *repairs,
        f"smoothed over {smoothing_m * 1e3:.3g} mm, maximum deviation {deviation_m * 1e3:.2g} mm",
    ]
    return Mesh(
        vertices_m=vertices,
        triangles=triangles.astype(np.int32),
        smoothing_m=smoothing_m,
        origin="; ".join(history),
    )


def _load_trimesh(path: Path) -> Any:
    """Read a mesh file as an unrepaired `trimesh.Trimesh`; raise MeshError if it is invalid."""
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(
            f"the mesh format {path.suffix} is not supported; convert the file to "
            f"{' or '.join(SUFFIXES)}"
        )
    try:
        size = path.stat().st_size
    except OSError as error:
        raise MeshError(
            f"the mesh file {path} cannot be read: {error.strerror}; check the path"
        ) from error
    if size > MAX_BYTES:
        raise MeshError(
            f"the file has {size >> 20} MiB, but at most {MAX_BYTES >> 20} MiB are allowed; "
            "decimate the mesh"
        )
    # Import only when needed, because only scenes with a mesh use trimesh.
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False, skip_materials=True)
    # trimesh raises errors of many types for invalid files.
    except Exception as error:
        raise MeshError(f"the mesh file is not valid: {error}; export the mesh again") from error
    faces = np.asarray(getattr(mesh, "faces", ()))
    if len(faces):
        _check_arrays(np.asarray(mesh.vertices), faces)
    return mesh


def _check_arrays(vertices: NDArray[Any], faces: NDArray[Any]) -> None:
    """Raise MeshError if arrays are invalid although trimesh has accepted them.

    vertices: positions (v, 3) of v vertices.
    faces: vertex indices (t, 3) of t triangles.
    """
    if faces.shape[1:] != (3,) or vertices.shape[1:] != (3,):
        raise MeshError("the faces are not triangles of 3D points; triangulate the mesh")
    if not (np.abs(vertices) < MAX_COORDINATE).all():
        raise MeshError(
            f"a vertex coordinate is not finite or exceeds {MAX_COORDINATE:g}; export the mesh "
            "again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError("a triangle refers to a missing vertex; export the mesh again")


def _repair(
    mesh: Any, metres_per_unit: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], list[str]]:
    """Repair a mesh, and convert its unit to metres.

    Returns the vertices (v, 3) in m, the vertex indices of the triangles (t, 3), and descriptions
    of the repairs. Raises MeshError if no valid triangle remains, or if there are too many
    triangles.
    """
    repairs = []
    if not len(getattr(mesh, "faces", ())):
        raise MeshError("the mesh contains no triangles; export a triangle mesh")
    if len(mesh.faces) > 2 * MAX_TRIANGLES:
        raise MeshError(
            f"the mesh has {len(mesh.faces)} triangles, but at most {MAX_TRIANGLES} are allowed; "
            "decimate the mesh"
        )
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    for what, keep in (
        ("degenerate", ~find_degenerate(np.asarray(mesh.vertices), np.asarray(mesh.faces))),
        ("repeated", None),
    ):
        kept = mesh.unique_faces() if keep is None else keep
        dropped = len(mesh.faces) - int(np.count_nonzero(kept))
        if dropped:
            mesh.update_faces(kept)
            repairs.append(f"{dropped} {what} triangles removed")
    if not len(mesh.faces):
        raise MeshError("all triangles of the mesh are degenerate; export the mesh again")
    mesh.remove_unreferenced_vertices()
    vertices = np.array(mesh.vertices, dtype=np.float64) * metres_per_unit
    before = np.array(mesh.faces, dtype=np.int64)
    triangles = unify_winding(before)
    if volume_m3(vertices, triangles) < 0.0:
        triangles = triangles[:, ::-1]
    flipped = int((before != triangles).any(axis=1).sum())
    if flipped:
        repairs.append(f"{flipped} triangles flipped")
    return vertices, np.ascontiguousarray(triangles), repairs
