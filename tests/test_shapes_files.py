"""Test scenes with objects of every shape, and the repair or rejection of meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML

from flexsheet.launch.objects.meshes import MAX_BYTES, read_mesh
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.base import Header
from flexsheet.messages.scene import Mesh, Scene, UnfitGeometryError, require_cylinder
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.wire import decode, encode
from flexsheet.nodes.models.shapes import GEOMETRIES, MeshError, SmoothMeshShape, make_shape
from tests.scenes import load_values

ROOT = Path(__file__).resolve().parent.parent
LIVER = ROOT.parent / "shared" / "data" / "mesh" / "liver.obj"
HEADER = Header(1, 1_000, 2_000, "host-1234abcd", "launch", 1)


def scene_file(folder: Path, geometry: dict[str, Any]) -> Path:
    values = load_values()
    values["object"]["geometry"] = geometry
    path = folder / "scene.yaml"
    with path.open("w") as file:
        YAML(typ="safe").dump(values, file)
    return path


def ball(radius_mm: float = 30.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=radius_mm)


def mesh_scene(folder: Path) -> Scene:
    ball().export(folder / "ball.stl")
    asked = {"shape": "mesh_file", "file": "ball.stl", "metres_per_unit": 0.001}
    return load_scene(scene_file(folder, asked))


@pytest.mark.parametrize("suffix", ["stl", "obj", "STL"])
def test_a_scene_carries_the_mesh_that_its_file_names(tmp_path: Path, suffix: str) -> None:
    ball().export(tmp_path / f"ball.{suffix}", file_type=suffix.lower())
    asked = {"shape": "mesh_file", "file": f"ball.{suffix}", "metres_per_unit": 0.001}
    scene = load_scene(scene_file(tmp_path, asked))
    mesh = scene.object.geometry
    assert isinstance(mesh, Mesh)
    assert len(mesh.vertices_m) == 162
    assert np.linalg.norm(mesh.vertices_m, axis=1) == pytest.approx(0.03, abs=1e-6)
    assert mesh.origin.startswith(f"ball.{suffix} by 0.001; smoothed over ")
    frames = encode(scene, HEADER, max_bytes=TOPICS["scene"].max_bytes)
    (tmp_path / f"ball.{suffix}").unlink()
    received = decode(frames, Scene)[0].object.geometry
    assert isinstance(received, Mesh)
    assert received.vertices_m.tobytes() == mesh.vertices_m.tobytes()
    shape = make_shape(dict(received))
    assert float(shape.signed_distance(np.array([0.0, 0.0, 0.035]))) == pytest.approx(
        0.005, abs=1e-4
    )


def test_a_plan_holds_the_mesh_for_all_hosts(tmp_path: Path) -> None:
    mesh_scene(tmp_path)
    launch_file = tmp_path / "launch.yaml"
    launch_file.write_text(
        "scene: scene.yaml\nnodes:\n  finger: {type: twin_finger}\n  camera: {type: camera}\n"
    )
    plan = load_graph(launch_file)
    scene = plan.scene_message()
    assert scene is not None
    assert isinstance(scene.object.geometry, Mesh)


def test_the_largest_mesh_fits_the_scene_topic() -> None:
    # By Euler's formula a closed surface of t triangles has about t / 2 vertices.
    largest = 100_000 * 3 * 4 + 50_000 * 3 * 8
    assert largest < TOPICS["scene"].max_bytes


@pytest.mark.parametrize(
    "geometry",
    [
        {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.1},
        {"shape": "sphere", "radius_m": 0.03},
        {"shape": "plane", "width_m": 0.2, "height_m": 0.2},
        {"shape": "ellipsoid", "semi_axes_m": [0.05, 0.03, 0.02]},
        {"shape": "rounded_box", "size_m": [0.1, 0.06, 0.04], "edge_radius_m": 0.005},
    ],
)
def test_scenes_hold_every_shape_under_one_name(tmp_path: Path, geometry: dict[str, Any]) -> None:
    scene = load_scene(scene_file(tmp_path, geometry))
    shape = make_shape(dict(scene.object.geometry))
    assert type(shape) is GEOMETRIES[geometry["shape"]].make_shape
    again = decode(encode(scene, HEADER), Scene)[0]
    assert make_shape(dict(again.object.geometry)) == shape


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        ({"shape": "torus"}, 'object.geometry.shape: unknown shape "torus"'),
        ({"shape": "sper", "radius_m": 1.0}, 'did you mean "sphere"?'),
        ({"shape": "mesh"}, 'did you mean "mesh_file"?'),
        ({"shape": "sphere", "radius_m": 0.0}, "object.geometry.radius_m: 0.0 is invalid"),
        ({"shape": "sphere", "radius": 0.1}, 'unknown key "radius"; did you mean "radius_m"?'),
        ({"shape": "ellipsoid", "semi_axes_m": [0.1, 0.1, -0.1]}, "semi_axes_m.2: -0.1"),
        (
            {"shape": "rounded_box", "size_m": [0.1, 0.1, 0.02], "edge_radius_m": 0.02},
            "reduce it",
        ),
        ({"shape": "mesh_file", "file": "a.stl"}, '"metres_per_unit" is missing'),
        (
            {"shape": "mesh_file", "file": "none.stl", "metres_per_unit": 1.0},
            'object.geometry.file: "none.stl": the mesh file',
        ),
    ],
)
def test_errors_name_file_key_value_and_remedy(
    tmp_path: Path, geometry: dict[str, Any], words: str
) -> None:
    path = scene_file(tmp_path, geometry)
    with pytest.raises(BadInputError) as caught:
        load_scene(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"{path}:")


def written(folder: Path, mesh: trimesh.Trimesh, name: str = "mesh.obj") -> Path:
    mesh.export(folder / name)
    return folder / name


def test_repairs_are_made_and_reported(tmp_path: Path) -> None:
    good = ball()
    faces = np.array(good.faces)
    flipped = faces.copy()
    flipped[:50] = flipped[:50, ::-1]
    twice = np.concatenate([flipped, faces[:7], np.repeat(faces[:3, :1], 3, axis=1)])
    bad = trimesh.Trimesh([*good.vertices, [9.0, 9.0, 9.0]], twice, process=False)
    mesh = read_mesh(written(tmp_path, bad), 0.001, None)
    for reported in ("3 degenerate triangles", "7 repeated triangles", "triangles flipped"):
        assert reported in mesh.origin
    assert mesh.triangles.shape == faces.shape
    assert len(mesh.vertices_m) == 162
    inside_out = trimesh.Trimesh(good.vertices, faces[:, ::-1], process=False)
    assert "320 triangles flipped" in read_mesh(written(tmp_path, inside_out), 0.001, None).origin


@pytest.mark.parametrize(
    ("mesh", "metres_per_unit", "words"),
    [
        (trimesh.Trimesh(ball().vertices, ball().faces[1:], process=False), 0.001, "not closed"),
        (ball(), 1.0, r"60 m wide; check metres_per_unit 1 "),
        (ball(), 1e-6, "wide; check metres_per_unit 1e-06 "),
        (
            trimesh.util.concatenate([ball(), ball().apply_translation([17.0, 1.0, 2.0])]),
            0.001,
            "pairs of triangles intersect",
        ),
        (
            trimesh.Trimesh([[0, 0, 0], [30, 0, 0], [0, 30, 0]], [[0, 1, 2]], process=False),
            0.001,
            "a closed surface needs at least 4",
        ),
    ],
    ids=["hole", "large", "small", "cut", "single"],
)
def test_what_is_no_solid_is_rejected(
    tmp_path: Path, mesh: trimesh.Trimesh, metres_per_unit: float, words: str
) -> None:
    with pytest.raises(MeshError, match=words):
        read_mesh(written(tmp_path, mesh), metres_per_unit, None)


def test_files_that_are_no_meshes_are_rejected(tmp_path: Path) -> None:
    for name, content in (("a.obj", b""), ("b.obj", b"v 1 2\nf 9 9"), ("c.stl", b"\x00" * 90)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(
            MeshError,
            match=r"the mesh file is not valid|the mesh contains no triangles",
        ):
            read_mesh(tmp_path / name, 0.001, None)
    with pytest.raises(MeshError, match=r"convert the file to \.obj or \.stl"):
        read_mesh(tmp_path / "a.ply", 0.001, None)
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(MeshError, match="at most 64 MiB"):
        read_mesh(tmp_path / "huge.stl", 0.001, None)


def test_too_long_a_smoothing_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"smoothing_m: .*reduce smoothing_m"):
        read_mesh(written(tmp_path, trimesh.creation.box((40, 40, 40))), 0.001, 0.2)


def test_the_real_mesh_is_used_unchanged() -> None:
    if not LIVER.is_file():
        pytest.skip(f"the real mesh is not there: {LIVER}")
    mesh = read_mesh(LIVER, 0.01, None)
    assert mesh.triangles.shape == (4384, 3)
    assert "7 intersecting pairs of triangles bridged" in mesh.origin
    with pytest.raises(MeshError, match=r"6.39 m wide"):
        read_mesh(LIVER, 1.0, None)


def test_an_object_that_is_not_a_cylinder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        UnfitGeometryError,
        match=r'object.geometry.shape of the scene is "mesh", expected "cylinder"',
    ):
        require_cylinder(mesh_scene(tmp_path))


def test_the_message_is_enough_to_make_the_shape(tmp_path: Path) -> None:
    geometry = mesh_scene(tmp_path).object.geometry
    assert isinstance(make_shape(dict(geometry)), SmoothMeshShape)
