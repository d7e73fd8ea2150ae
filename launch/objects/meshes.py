"""Mesh files that a scene names: read, repaired or refused, and put into the scene.

In a scene file an object may be given as

    geometry: {shape: mesh_file, file: liver.obj, metres_per_unit: 0.01}

with a path relative to the scene file.  What the scene message holds is the mesh itself.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from flexsheet.launch.objects.textures import put_image
from flexsheet.launch.plans.documents import BadInputError, Document, Key, did_you_mean, validate
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

GEOMETRY: Key = ("object", "geometry")
MESH_FILE = "mesh_file"
SHAPE_NAMES = (*(name for name in GEOMETRIES if name != "mesh"), MESH_FILE)
"""What a scene file may say; a mesh's arrays are no matter for YAML."""
SUFFIXES = (".obj", ".stl")
MOST_BYTES = 64 << 20
SMALLEST_M, LARGEST_M = 0.005, 1.0
"""Objects that a hand can be shown; what is outside has its unit wrong."""
LARGEST_UNITS = 1e9
"""Of a coordinate in the file, whatever its unit: beyond it numbers of the mesh run over."""

MOST_CUTTING = 0.01
"""Pairs of triangles that cut through one another, over all triangles: more is no flaw of a rim but
another object.  Fewer are bridged by the smooth surface."""


class MeshFile(LimitedModel):
    """An object's geometry as a scene file gives it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    shape: Literal["mesh_file"] = "mesh_file"
    file: str = Field(description="STL or OBJ, relative to the scene file")
    metres_per_unit: Annotated[
        Positive, Field(description="the file's unit: 0.001 for millimetres, 0.01 for centimetres")
    ]
    smoothing_m: Positive | None = Field(
        default=None, description="null: as long as it takes to hide the facets"
    )


def scene_of(document: Document) -> Scene:
    """The scene of a scene file, with the mesh that it names; raises BadInputError."""
    name = _shape_name(document)
    if name is not None and name not in SHAPE_NAMES:
        what = f'unknown shape "{name}"'
        problem = document.problem((*GEOMETRY, "shape"), what, did_you_mean(name, SHAPE_NAMES))
        raise BadInputError([problem])
    if name == MESH_FILE:
        asked = validate(MeshFile, document, at=GEOMETRY)
        path = document.path.parent / asked.file
        try:
            mesh = read_mesh(path, asked.metres_per_unit, asked.smoothing_m)
        except MeshError as error:
            problem = document.problem((*GEOMETRY, "file"), f'"{asked.file}": {error}')
            raise BadInputError([problem]) from error
        document.values["object"]["geometry"] = dict(mesh)
    put_image(document)
    return validate(Scene, document)


def _shape_name(document: Document) -> Any:
    """What the document says as the shape's name; None where it says none."""
    value: Any = document.values
    for key in (*GEOMETRY, "shape"):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def read_mesh(path: Path, metres_per_unit: float, smoothing_m: float | None) -> Mesh:
    """The mesh of a file, in metres, one that can be touched; MeshError says why it is none.

    Repaired: vertices stored once per triangle are merged, degenerate and repeated triangles and
    unused vertices are dropped, winding is unified and turned outwards.  `Mesh.origin` tells what
    was done.  Refused is what `check_mesh` refuses of the rest, holes among them: a closed surface
    cannot be guessed.
    """
    vertices, triangles, repairs = _repaired(_read(path), metres_per_unit)
    extent_m = float(np.ptp(vertices, axis=0).max())
    if not SMALLEST_M <= extent_m <= LARGEST_M:
        raise MeshError(
            f"the object would be {extent_m:.3g} m wide; is metres_per_unit {metres_per_unit:g} "
            "right? (0.001 for millimetres, 0.01 for centimetres)"
        )
    check_mesh(vertices, triangles)
    cutting = count_intersections(vertices, triangles)
    if cutting > MOST_CUTTING * len(triangles):
        raise MeshError(
            f"the surface cuts through itself: {cutting} pairs of triangles; untangle it"
        )
    if cutting:
        repairs.append(f"{cutting} pairs of triangles that cut through one another are bridged")
    if smoothing_m is None:
        smoothing_m = default_smoothing_m(vertices, triangles)
    deviation_m = SmoothMeshShape(vertices, triangles, smoothing_m).deviation_m()
    told = [
        f"{path.name} by {metres_per_unit:g}",
        *repairs,
        f"smoothed over {smoothing_m * 1e3:.3g} mm, at most {deviation_m * 1e3:.2g} mm off",
    ]
    return Mesh(
        vertices_m=vertices,
        triangles=triangles.astype(np.int32),
        smoothing_m=smoothing_m,
        origin="; ".join(told),
    )


def _read(path: Path) -> Any:
    """The file as a `trimesh.Trimesh`, as it stands; MeshError where it holds none."""
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"meshes are read from {' and '.join(SUFFIXES)} files")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise MeshError(f"cannot be read at {path}: {error.strerror}; check the path") from error
    if size > MOST_BYTES:
        raise MeshError(f"has {size >> 20} MiB, at most {MOST_BYTES >> 20} are read; decimate it")
    # Late, because only scenes with a mesh need it.
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False, skip_materials=True)
    # A file of any content makes it raise errors of many kinds.
    except Exception as error:
        raise MeshError(f"is no mesh that can be read: {error}") from error
    faces = np.asarray(getattr(mesh, "faces", ()))
    if len(faces):
        _refuse_odd(np.asarray(mesh.vertices), faces)
    return mesh


def _refuse_odd(vertices: NDArray[Any], faces: NDArray[Any]) -> None:
    """Arrays that are no mesh, which the library lets through; MeshError."""
    if faces.shape[1:] != (3,) or vertices.shape[1:] != (3,):
        raise MeshError("its faces are no triangles of points in space")
    if not (np.abs(vertices) < LARGEST_UNITS).all():
        raise MeshError(f"a vertex is NaN or infinite, or further away than {LARGEST_UNITS:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError("a triangle names a vertex that is not there")


def _repaired(
    mesh: Any, metres_per_unit: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], list[str]]:
    """Vertices (v, 3) m, triangles (t, 3) and what was repaired; MeshError for nothing at all."""
    repairs = []
    if not len(getattr(mesh, "faces", ())):
        raise MeshError("holds no triangles")
    if len(mesh.faces) > 2 * MAX_TRIANGLES:
        raise MeshError(
            f"{len(mesh.faces)} triangles, at most {MAX_TRIANGLES} are taken; decimate the mesh"
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
            repairs.append(f"{dropped} {what} triangles dropped")
    if not len(mesh.faces):
        raise MeshError("all its triangles are degenerate")
    mesh.remove_unreferenced_vertices()
    vertices = np.array(mesh.vertices, dtype=np.float64) * metres_per_unit
    before = np.array(mesh.faces, dtype=np.int64)
    triangles = unify_winding(before)
    if volume_m3(vertices, triangles) < 0.0:
        triangles = triangles[:, ::-1]
    turned = int((before != triangles).any(axis=1).sum())
    if turned:
        repairs.append(f"{turned} triangles turned over")
    return vertices, np.ascontiguousarray(triangles), repairs
