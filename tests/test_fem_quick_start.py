"""Test what makes the first table early: order of the pushes, symmetry, and force correction."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.nodes.fem_solver import snapshots as snapshots_module
from flexsheet.nodes.fem_solver.body import make_soft_body_spec, make_table_spec
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute_table import make_table_cache
from flexsheet.nodes.fem_solver.shipped_pushes import load_shipped, shipped_path
from flexsheet.nodes.fem_solver.snapshot_interpolator import SurfaceLocator
from flexsheet.nodes.fem_solver.snapshots import (
    COARSE_COUNT,
    COARSE_DEPTHS_M,
    FINE_RATIO,
    SamplePoint,
    Snapshot,
    choose_sample_points,
    find_mirror_planes,
    make_fine_job,
    make_snapshot_job,
    order_by_spread,
    solve_snapshot,
)
from flexsheet.nodes.fem_solver.table import compute_force_factors, find_mirror_images
from flexsheet.nodes.renderer import deflection_cache
from tests.soft_bodies import cylinder_spec

Floats = NDArray[np.float64]
FINGER = 0.007
MESH = cylinder_spec(0.03, 0.1, touch_angle_rad=1.4, skin_spacing_m=0.007).mesh
UP = np.array([0.0, 0.0, 1.0])
LAUNCH = Path(__file__).resolve().parent.parent / "launch"


def test_the_first_pushes_cover_the_touchable_skin() -> None:
    solid = build_mesh(MESH)
    mirrors = find_mirror_planes(solid)
    samples = choose_sample_points(MESH, solid, mirrors, FINGER)
    ordered = order_by_spread(samples, mirrors, UP)
    assert sorted(map(id, ordered)) == sorted(map(id, samples))
    assert ordered[0].point == pytest.approx([0.0, 0.0, 0.03])
    points = np.array([one.point for one in samples])

    def gap(chosen: list[SamplePoint]) -> float:
        images = [one.point * signs for one in chosen for signs in mirrors]
        away = np.linalg.norm(points[:, None] - np.array(images), axis=2)
        return float(away.min(axis=1).max())

    assert gap(ordered[:COARSE_COUNT]) < 0.7 * gap(samples[:COARSE_COUNT])


def test_the_fine_push_has_smaller_elements_at_the_same_point() -> None:
    solid = build_mesh(MESH)
    sample = SamplePoint(0.03 * UP, UP)
    given: dict[str, Any] = {"poisson_ratio": 0.45, "finger_radius_m": FINGER}
    fine = make_fine_job(MESH, sample, **given)
    usual = make_snapshot_job(MESH, solid, sample, **given)

    def spacing(job: Any) -> float:
        away = np.sort(np.linalg.norm(job.nodes[np.unique(job.faces)] - sample.point, axis=1))
        return float(away[1])

    assert spacing(fine) < 1.2 * FINE_RATIO * spacing(usual)


@pytest.mark.parametrize(
    ("x_m", "angle_rad", "axes"), [(0.0, 0.0, (0, 1)), (0.02, 0.0, (1,)), (0.0, 0.6, (0,))]
)
def test_a_part_of_a_symmetric_body_gives_the_solution_of_the_whole_body(
    monkeypatch: pytest.MonkeyPatch, x_m: float, angle_rad: float, axes: tuple[int, ...]
) -> None:
    normal = np.array([0.0, np.sin(angle_rad), np.cos(angle_rad)])
    sample = SamplePoint(0.03 * normal + [x_m, 0.0, 0.0], normal)

    def solve() -> tuple[int, Snapshot]:
        job = make_snapshot_job(
            MESH,
            build_mesh(MESH),
            sample,
            poisson_ratio=0.45,
            finger_radius_m=FINGER,
            spacing_m=0.005,
            depths_m=(0.003, 0.006),
        )
        assert job.mirror_axes in (axes, ())
        return len(job.nodes), solve_snapshot(job)

    count, part = solve()
    monkeypatch.setattr(snapshots_module, "_mirror_axes", lambda spec, sample: ())
    whole_count, whole = solve()
    assert count < (0.4 if len(axes) == 2 else 0.65) * whole_count
    assert part.rest.shape == whole.rest.shape
    assert part.force_n == pytest.approx(whole.force_n, rel=1e-2, abs=3e-7)
    nodes, weights = SurfaceLocator(part.rest, part.faces).weights(whole.rest)
    moved = np.einsum("qa,kqai->kqi", weights, part.moved[:, nodes])
    error = np.linalg.norm(moved - whole.moved, axis=2)
    assert error.max() < 1e-4


def test_mirror_images_of_contact_nodes_have_the_mirrored_skin() -> None:
    solid = build_mesh(MESH)
    points, rest = solid.nodes[solid.contact_nodes], solid.nodes[solid.skin]
    mirrors = find_mirror_planes(solid)
    images = find_mirror_images(points, rest, mirrors)
    assert len(images) > 0.4 * len(points)
    for number, (partner, signs, permutation) in images.items():
        assert partner not in images
        assert points[partner] * signs == pytest.approx(points[number], abs=1e-7)
        assert rest[permutation] == pytest.approx(rest * signs, abs=1e-7)
    assert find_mirror_images(points, rest, mirrors[:1]) == {}


def test_the_shipped_pushes_of_the_demo_are_current() -> None:
    """If this test fails, run `python -m benchmarks.ship_tables`."""
    scene = load_scene(LAUNCH / "scenes" / "cylinder.yaml")
    choice = scene.methods.soft_body
    spec = make_soft_body_spec(scene, choice.skin_spacing_m)
    path = shipped_path(make_table_cache(make_table_spec(scene, spec, coarse=True)))
    shipped = load_shipped(path)
    assert sorted(shipped) == ["fine", *(f"push-{number:04d}" for number in range(COARSE_COUNT))]
    sample = SamplePoint(np.array([0.0, 0.0, 0.0353553]), UP)
    given: dict[str, Any] = {"poisson_ratio": 0.45, "finger_radius_m": FINGER}
    job = make_snapshot_job(
        spec.mesh, build_mesh(spec.mesh), sample, depths_m=COARSE_DEPTHS_M, **given
    )
    solved, first = solve_snapshot(job), shipped["push-0000"]
    assert first.reached == solved.reached == len(COARSE_DEPTHS_M)
    assert first.depths_m == pytest.approx(solved.depths_m)
    assert first.force_n == pytest.approx(solved.force_n, rel=1e-3, abs=1e-9)
    assert first.rest == pytest.approx(solved.rest, abs=1e-7)
    assert first.moved == pytest.approx(solved.moved, abs=2e-5)
    assert (first.faces == solved.faces).all()


@pytest.mark.parametrize("file", sorted((LAUNCH / "scenes").glob("*.yaml")), ids=lambda f: f.stem)
def test_the_package_contains_what_a_first_start_needs(file: Path) -> None:
    """If this test fails, run `python -m benchmarks.ship_tables`."""
    scene = load_scene(file)
    if scene.methods.sheet_shape == "reduced_order":
        for _, stored in deflection_cache.list_stored(scene):
            assert deflection_cache.shapes_cache(stored).path(deflection_cache.FOLDER).exists()
    choice = scene.methods.soft_body
    if scene.object.material is not None and choice.method == "nonlinear_table":
        spec = make_soft_body_spec(scene, choice.skin_spacing_m)
        assert shipped_path(make_table_cache(make_table_spec(scene, spec, coarse=True))).exists()


def test_forces_are_corrected_to_those_of_an_infinitely_fine_mesh() -> None:
    """Use a table whose forces are 12 % too large, in proportion to the squared element size."""
    depths = np.array([0.0, 0.0007, 0.0015, 0.005, 0.010, 0.020])
    exact = 1e-3 * (depths / 0.01) ** 1.5
    sample = SamplePoint(0.03 * UP, UP)
    snapshots = exact[2:, None] * UP * 1.12
    interpolator = SimpleNamespace(
        interpolate=lambda sample, rest: (np.zeros((4, 1, 3), dtype=np.float32), snapshots, 4.0)
    )
    linear = SimpleNamespace(
        respond=lambda query: SimpleNamespace(
            displacement=np.zeros((1, 3), dtype=np.float32), force_n=1.3 * exact[1] * UP
        )
    )
    solved = np.array([0.0007, 0.0015, 0.005, 0.010])
    excess = np.where(solved < 0.001, 0.0, 0.12 * FINE_RATIO**2)
    push = Snapshot(
        rest=np.zeros((1, 3)),
        faces=np.zeros((0, 6), dtype=np.int64),
        depths_m=solved,
        moved=np.zeros((4, 1, 3), dtype=np.float32),
        force_n=(1.0 + excess)[:, None] * exact[1:5, None] * UP,
        reached=4,
    )
    response = SimpleNamespace(rest=np.zeros((1, 3)))
    factors = compute_force_factors(
        (sample, push), cast(Any, response), cast(Any, linear), cast(Any, interpolator), depths
    )
    assert factors == pytest.approx([1.0, 1 / 1.3, 1 / 1.12, 1 / 1.12, 1 / 1.12, 1 / 1.12])
