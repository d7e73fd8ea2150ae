"""Test meshes that are fine only near a pushed point, for all shapes but cylinders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexsheet.nodes.fem_solver.mesh.from_scene import MeshSpec, build_mesh, mesh_spec
from flexsheet.nodes.fem_solver.mesh.grading import FinePoint, longest_edges
from flexsheet.nodes.fem_solver.mesh.quality import radius_ratios, signed_volumes
from flexsheet.nodes.fem_solver.mesh.solid import UnfitMeshError
from flexsheet.nodes.fem_solver.snapshots import (
    SamplePoint,
    make_job_on_mesh,
    make_snapshot_job,
    solve_snapshot,
)
from flexsheet.nodes.models.shapes import make_shape
from tests.limit_bodies import make_scene
from tests.scene_solids import SHAPES, geometry

FINGER_M, POISSON = 0.007, 0.45
STRIP = {"kind": "strip", "angle_rad": 1.5}
FINE = FinePoint((0.003, -0.002, 0.0), near_m=0.005, growth=0.7, max_element_m=0.028)


def make_spec(shape: str) -> MeshSpec:
    return mesh_spec(make_scene(geometry(shape), STRIP, height_m=0.03), 0.0065)


@pytest.mark.parametrize("shape", sorted(set(SHAPES) - {"cylinder"}))
def test_elements_are_small_near_the_point_and_large_elsewhere(shape: str) -> None:
    spec = make_spec(shape)
    front = np.array([0.004, 0.003, 0.1 if shape != "plane" else 0.0])
    found = make_shape(dict(spec.geometry)).closest(front[None])
    x, y, z = (float(value) for value in found.point[0])
    grading = replace(
        spec.grading, skin_spacing_m=0.003, fine_point=replace(FINE, point_m=(x, y, z))
    )
    usual, focused = build_mesh(spec), build_mesh(spec, grading)
    even = build_mesh(replace(spec, skin_spacing_m=0.003))
    assert len(focused.nodes) < 0.75 * len(even.nodes)
    corners = focused.elements[:, :4]
    assert radius_ratios(focused.nodes, corners).min() > 0.1
    volume = signed_volumes(focused.nodes, focused.elements).sum()
    # The volume of straight-edged elements, of which the largest lose a tenth of a round body.
    assert volume == pytest.approx(signed_volumes(usual.nodes, usual.elements).sum(), rel=0.1)
    away = np.linalg.norm(focused.nodes[corners].mean(axis=1) - found.point[0], axis=1)
    longest = longest_edges(focused.nodes, corners)
    assert longest[away < 0.006].max() < 2.0 * 2.0 * 0.003
    assert longest[away > 0.025].max() > 2.0 * longest[away < 0.004].max(initial=0.006)


@pytest.mark.parametrize("x_m", [0.0, 0.014])
def test_the_force_on_a_plane_is_that_of_hertz(x_m: float) -> None:
    """The finger is a sphere on a half-space, for which Hertz' theory is exact at small depths."""
    spec = make_spec("plane")
    sample = SamplePoint(np.array([x_m, -0.006, 0.0]), np.array([0.0, 0.0, 1.0]))
    x, y, z = (float(value) for value in sample.point)
    mesh = build_mesh(
        spec,
        replace(spec.grading, skin_spacing_m=0.0018, fine_point=replace(FINE, point_m=(x, y, z))),
    )
    depths = (0.001, 0.002, 0.003)
    given = {"poisson_ratio": POISSON, "finger_radius_m": FINGER_M, "depths_m": depths}
    force = solve_snapshot(make_job_on_mesh(mesh, sample, **given)).force_n
    hertz = 4.0 / 3.0 / (1.0 - POISSON**2) * np.sqrt(FINGER_M) * np.array(depths) ** 1.5
    assert force[:, 2] == pytest.approx(hertz, rel=0.06)
    assert (np.abs(force[:, :2]).max(axis=1) < 0.01 * force[:, 2]).all()


def test_snapshots_of_all_shapes_use_focused_meshes() -> None:
    spec = make_spec("sphere")
    sample = SamplePoint(np.array([0.0, 0.0, 0.03]), np.array([0.0, 0.0, 1.0]))
    mesh = build_mesh(spec)
    job = make_snapshot_job(spec, mesh, sample, poisson_ratio=POISSON, finger_radius_m=FINGER_M)
    near = np.linalg.norm(job.nodes - sample.point, axis=1) < 0.007
    usual = np.linalg.norm(mesh.nodes - sample.point, axis=1) < 0.007
    assert near.sum() > 3 * usual.sum()


def test_a_plane_that_is_fixed_at_one_edge_is_refused() -> None:
    """A tilted slab on a base touches it with one edge; it would bend instead of being pressed."""
    content = make_scene(geometry("plane"), {"kind": "base", "height_m": 0.005}, height_m=0.0)
    values = content.model_dump()
    build_mesh(mesh_spec(content, 0.0065))
    values["object"]["world_from_object"]["rpy_rad"] = [-0.17, 0.0, 0.0]
    with pytest.raises(UnfitMeshError, match=r"object\.support: .* at the back of the plane"):
        build_mesh(mesh_spec(type(content).model_validate(values), 0.0065))
