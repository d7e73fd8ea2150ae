"""Test the nonlinear table: interpolation, smoothness, bounds, cache, and worker processes."""

from __future__ import annotations

import itertools
import os
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.cache import load_cached, save_cached
from flexsheet.nodes.fem_solver import precompute_table, snapshots
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import CURVE_FRACTIONS, Response, SkinResponse
from flexsheet.nodes.fem_solver.mesh import cylinder
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, compute
from flexsheet.nodes.fem_solver.precompute_table import (
    TableSpec,
    compute_table,
    make_table_cache,
    solve_all,
)
from flexsheet.nodes.fem_solver.snapshot_interpolator import SurfaceLocator, minimal_rotation
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, Snapshot, solve_snapshot
from flexsheet.nodes.fem_solver.table import (
    END_SPAN_M,
    CubicInterpolator,
    Table,
    TableSoftBody,
    count_valid_levels,
    find_mirror_images,
)
from flexsheet.nodes.worker_processes import local_processes
from tests.soft_bodies import InlineExecutor, cylinder_spec
from tests.waiting import wait_until

Floats = NDArray[np.float64]

RADIUS, LENGTH, FINGER = 0.02, 0.06, 0.007
SPEC = TableSpec(cylinder_spec(RADIUS, LENGTH, touch_angle_rad=1.2, skin_spacing_m=0.005), FINGER)
DEPTHS = (0.0015, 0.003, 0.005, 0.0075)
MODULUS = 4000.0


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    """Reduce the number of samples and depths of all tables, and coarsen their meshes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snapshots, "DEPTHS_M", DEPTHS)
        patch.setattr(snapshots, "FINE_DEPTHS_M", (0.0015, 0.003))
        patch.setattr(snapshots, "SPACING_RATIO", 1.0)
        patch.setattr(snapshots, "STATIONS", (0.0, 0.6))
        patch.setattr(snapshots, "ANGLE_STEP_RAD", 0.9)
        patch.setattr(cylinder, "FOCUS_GROWTH", 0.8)
        yield


class CachingExecutor(InlineExecutor):
    """An executor that computes equal tasks only once, because tests share tables."""

    results: ClassVar[dict[bytes, Future[Any]]] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        key = sha256(pickle.dumps((fn, args, kwargs))).digest()
        if key not in self.results:
            self.results[key] = super().submit(fn, *args, **kwargs)
        return self.results[key]


@pytest.fixture(scope="module")
def model() -> SoftBodyModel:
    return compute(SPEC.body, lambda done, total, need: None)


@pytest.fixture(scope="module")
def table(model: SoftBodyModel, tmp_path_factory: pytest.TempPathFactory) -> Table:
    folder = tmp_path_factory.mktemp("table")
    made = compute_table(SPEC, model, folder, CachingExecutor(), lambda done, total, need: None)
    assert [path.name for path in folder.iterdir()] == [make_table_cache(SPEC).path(folder).name]
    return made


def soft_body(response: SkinResponse, bounds: Floats, table: Table) -> TableSoftBody:
    return TableSoftBody(
        response,
        bounds,
        table,
        young_modulus_pa=MODULUS,
        finger_radius_m=FINGER,
        push_depth_m=0.02,
        linear_depth_m=0.003,
    )


@pytest.fixture(scope="module")
def body(model: SoftBodyModel, table: Table) -> TableSoftBody:
    return soft_body(model.response, model.response.rest[model.bounds], table)


def push(x: float, angle: float, depth: float) -> ContactQuery:
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    beyond = max(0.0, abs(x) - 0.5 * LENGTH)
    return ContactQuery(RADIUS * normal + np.array([x, 0.0, 0.0]), normal, depth, beyond)


def largest_move(a: Response, b: Response) -> float:
    return float(np.linalg.norm(a.displacement - b.displacement, axis=1).max())


def test_away_from_the_finger_it_is_what_newton_finds(
    body: TableSoftBody, model: SoftBodyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compare at a point that is not a sample point of the table."""
    monkeypatch.setattr(snapshots, "DEPTHS_M", DEPTHS[:2])
    there = push(0.005, 0.2, 0.003)
    mesh = build_mesh(SPEC.body.mesh)
    sample = SamplePoint(there.surface, there.normal)
    job = snapshots.make_snapshot_job(
        SPEC.body.mesh, mesh, sample, poisson_ratio=0.45, finger_radius_m=FINGER
    )
    wanted = solve_snapshot(job)
    nodes, weights = SurfaceLocator(wanted.rest, wanted.faces).weights(model.response.rest)
    moved = np.einsum("qa,qai->qi", weights, wanted.moved[DEPTHS.index(0.003)][nodes])
    answer = body.respond(there)
    away = np.linalg.norm(model.response.rest - there.surface, axis=1) > 1.5 * FINGER
    assert (
        np.linalg.norm(answer.displacement - moved, axis=1)[away].max() < 0.6e-3
    )  # elements of 10 mm
    fine_job = snapshots.make_fine_job(
        SPEC.body.mesh, sample, poisson_ratio=0.45, finger_radius_m=FINGER
    )
    assert fine_job is not None
    fine = solve_snapshot(replace(fine_job, depths_m=(0.003,)))
    coarse_n = MODULUS * wanted.force_n[DEPTHS.index(0.003)] @ there.normal
    fine_n = MODULUS * fine.force_n[0] @ there.normal
    # extrapolated from two meshes, one half as fine as the other
    assert answer.force_n @ there.normal == pytest.approx(
        fine_n - (coarse_n - fine_n) / 3.0, rel=0.1
    )
    assert answer.in_range


@pytest.mark.parametrize("depth", [0.0005, 0.002, 0.005, 0.02])
def test_a_slide_moves_no_skin_node_a_tenth_of_a_millimetre(
    body: TableSoftBody, depth: float
) -> None:
    answers = [
        body.respond(push(0.003 + 1.2e-5 * i, 0.1 + 1.6e-5 * i / RADIUS, depth)) for i in range(300)
    ]
    assert max(largest_move(a, b) for a, b in itertools.pairwise(answers)) < 0.1e-3
    forces = np.array([np.linalg.norm(a.force_n) for a in answers])
    assert np.abs(np.diff(forces)).max() < 0.01 * forces.mean()


def test_a_push_grows_from_nothing_and_never_jumps(body: TableSoftBody) -> None:
    answers = [body.respond(push(0.004, 0.1, d)) for d in np.linspace(-1e-4, 0.03, 800)]
    assert max(largest_move(a, b) for a, b in itertools.pairwise(answers)) < 0.08e-3
    forces = np.array([a.force_n @ push(0, 0.1, 0).normal for a in answers])
    assert forces[0] == 0.0
    assert (np.diff(forces) >= -1e-4 * forces.max()).all()


def test_deeper_than_solved_is_flagged_bounded_and_never_inverted(
    body: TableSoftBody, model: SoftBodyModel
) -> None:
    rest = model.response.rest

    def normals(vertices: Floats) -> Floats:
        a, b, c = vertices[model.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    for depth in (0.004, 0.0075, 0.03):
        answer = body.respond(push(0.004, 0.1, depth))
        assert answer.in_range == (depth <= DEPTHS[-1] - END_SPAN_M)
        assert np.linalg.norm(answer.displacement, axis=1).max() < 1.2 * DEPTHS[-1]
        alignments = np.einsum("ij,ij->i", normals(rest), normals(rest + answer.displacement))
        assert alignments.min() > 0.0


def test_past_the_end_the_indentation_fades_and_is_flagged(body: TableSoftBody) -> None:
    answers = [body.respond(push(0.02 + 1e-4 * i, 0.1, 0.004)) for i in range(300)]
    assert max(largest_move(a, b) for a, b in itertools.pairwise(answers)) < 0.25e-3
    assert answers[0].in_range
    assert not answers[110].in_range
    assert not answers[-1].displacement.any()


def test_the_curve_is_what_pushes_then_give(body: TableSoftBody) -> None:
    there = push(0.004, 0.1, 0.003)
    curve = body.force_curve(there.surface)
    assert (np.diff(curve[:, 1]) >= 0.0).all()
    assert curve[-1, 0] == pytest.approx(0.02)
    for depth in (0.0015, 0.003, 0.006, 0.015):
        answer = body.respond(push(0.004, 0.1, depth))
        wanted = np.interp(depth, *curve.T)
        assert answer.force_n @ there.normal == pytest.approx(wanted, rel=0.12)
    secant = curve[len(CURVE_FRACTIONS), 1] / 0.003
    assert body.stiffness_n_per_m(there.surface) == pytest.approx(secant)


def test_the_force_curve_between_unlike_nodes_never_falls(
    model: SoftBodyModel, table: Table
) -> None:
    random = np.random.default_rng(3)
    factors = random.uniform(0.0, 1.0, (*table.force_n.shape[:2], 1))
    uneven = soft_body(
        model.response,
        model.response.rest[model.bounds],
        replace(table, force_n=table.force_n * factors),
    )
    for angle, x in random.uniform((-0.9, -0.02), (0.9, 0.02), (200, 2)):
        forces = uneven.force_curve(push(x, angle, 0.001).surface)[:, 1]
        assert forces[0] == 0.0
        assert (np.diff(forces) >= 0.0).all()


def test_a_finger_in_the_air_moves_nothing(body: TableSoftBody) -> None:
    answer = body.respond(push(0.0, 0.0, -0.01))
    assert not answer.displacement.any()
    assert not answer.force_n.any()
    assert answer.stiffness_n_per_m > 0.0


def test_the_body_answers_its_mirror_image_alike(body: TableSoftBody) -> None:
    here, there = (body.respond(push(0.006, sign * 0.3, 0.004)) for sign in (1.0, -1.0))
    assert there.force_n == pytest.approx(here.force_n * [1, -1, 1], rel=0.05, abs=1e-4)


def test_pushes_cover_what_can_be_touched_but_for_reflections() -> None:
    mesh = build_mesh(SPEC.body.mesh)
    mirrors = snapshots.find_mirror_planes(mesh)
    assert len(mirrors) == 4
    samples = snapshots.choose_sample_points(SPEC.body.mesh, mesh, mirrors, FINGER)
    assert all(sample.point[0] >= 0.0 and sample.point[1] >= 0.0 for sample in samples)
    one_sided = snapshots.choose_sample_points(SPEC.body.mesh, mesh, mirrors[:1], FINGER)
    assert len(one_sided) == (2 * 2 - 1) * (2 * len(samples) // 2 - 1)


def test_a_point_is_found_on_the_hull() -> None:
    mesh = build_mesh(SPEC.body.mesh)
    answer = Snapshot(mesh.nodes, mesh.contact_nodes[mesh.contact_faces], *[np.zeros(1)] * 3, 0)
    points = mesh.nodes[mesh.contact_nodes]
    nodes, weights = SurfaceLocator(answer.rest, answer.faces).weights(points)
    found = np.einsum("qa,qai->qi", weights, mesh.nodes[nodes])
    assert found == pytest.approx(points, abs=1e-12)
    assert weights.sum(axis=1) == pytest.approx(1.0)


def test_the_smallest_rotation_maps_one_direction_to_another() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        start, end = rng.normal(size=(2, 3))
        start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
        rotation = minimal_rotation(start, end)
        assert rotation @ start == pytest.approx(end)
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)


def test_cubics_go_through_their_points_and_reproduce_parabolas() -> None:
    depths = np.array([0.0, 0.7, 1.5, 3.0, 5.0, 7.5])
    cubics = CubicInterpolator(depths)

    def through(values: Floats, at: float) -> float:
        first, weights = cubics.weights_at(at)
        return float(weights @ values[first : first + 4])

    any_values = np.random.default_rng(1).normal(size=6)
    assert [through(any_values, float(d)) for d in depths] == pytest.approx(any_values)
    fine = np.linspace(0.0, 7.5, 301)
    parabola = 2.0 + depths - 0.3 * depths**2
    assert [through(parabola, float(d)) for d in fine] == pytest.approx(2 + fine - 0.3 * fine**2)
    slopes = np.diff([through(any_values, float(d)) for d in fine]) / np.diff(fine)
    assert np.abs(np.diff(slopes)).max() < 0.1 * np.ptp(slopes)  # continuous


def test_levels_that_turn_triangles_over_are_left_out() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2]], dtype=np.int32)
    moved = np.zeros((4, 3, 3), dtype=np.float32)
    moved[1, 1] = [-0.5, 0.0, 0.0]
    moved[2, 1] = [-1.5, 0.0, 0.0]
    assert count_valid_levels(rest, moved, triangles) == 2
    assert count_valid_levels(rest, moved[:2], triangles) == 2


def test_a_table_is_kept_whole_or_not_at_all(table: Table, tmp_path: Path) -> None:
    assert load_cached(make_table_cache(SPEC), tmp_path) is None
    save_cached(make_table_cache(SPEC), tmp_path, table)
    kept = load_cached(make_table_cache(SPEC), tmp_path)
    assert kept is not None
    assert np.array_equal(kept.fields, table.fields)
    path = make_table_cache(SPEC).path(tmp_path)
    path.write_bytes(path.read_bytes()[:-1000])
    assert load_cached(make_table_cache(SPEC), tmp_path) is None


def test_an_interrupted_table_resumes(model: SoftBodyModel, table: Table, tmp_path: Path) -> None:
    def stop(done: int, total: int, need: object) -> None:
        if done >= precompute_table.SNAPSHOT_STEPS * 2:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        compute_table(SPEC, model, tmp_path, CachingExecutor(), stop)
    assert load_cached(make_table_cache(SPEC), tmp_path) is None
    kept = len(list(make_table_cache(SPEC).checkpoints(tmp_path).folder.iterdir()))
    assert kept >= 2
    seen: list[tuple[int, int]] = []
    compute_table(
        SPEC, model, tmp_path, CachingExecutor(), lambda done, total, _: seen.append((done, total))
    )
    assert seen[1][0] == precompute_table.SNAPSHOT_STEPS * kept
    # The progress ends at 100 %, although mirror images of nodes are not interpolated.
    mirrors = snapshots.find_mirror_planes(build_mesh(SPEC.body.mesh))
    rest = model.response.rest
    assert find_mirror_images(rest[model.response.contact_nodes], rest, mirrors)
    assert seen[-1][0] == seen[-1][1]
    again = load_cached(make_table_cache(SPEC), tmp_path)
    assert again is not None
    assert np.allclose(again.fields, table.fields, atol=1e-9)


def test_too_little_memory_is_reported_before_allocation(
    model: SoftBodyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Little:
        available = 1000

    monkeypatch.setattr("psutil.virtual_memory", Little)
    with pytest.raises(MemoryError, match="skin_spacing_m"):
        compute_table(SPEC, model, tmp_path, InlineExecutor(), lambda *_: None)


def test_pushes_are_solved_in_other_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "DEPTHS_M", DEPTHS[:1])
    mesh = build_mesh(SPEC.body.mesh)
    sample = snapshots.choose_sample_points(
        SPEC.body.mesh, mesh, snapshots.find_mirror_planes(mesh), FINGER
    )[0]
    job = snapshots.make_snapshot_job(
        SPEC.body.mesh, mesh, sample, poisson_ratio=0.45, finger_radius_m=FINGER
    )
    parts = precompute_table.CheckpointStore(tmp_path / "parts")
    with local_processes(1) as executor:
        there = solve_all(
            {"push": partial(solve_snapshot, job)}, executor, parts, lambda count: None
        )["push"]
    here = solve_snapshot(job)
    assert np.array_equal(there.moved, here.moved)
    assert there.reached == here.reached == 1


def test_an_interrupted_computation_stops_its_workers_at_once() -> None:
    with suppress(InterruptedError), local_processes(1) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        busy = executor.submit(time.sleep, 60)
        wait_until(busy.running, "the worker to begin")
        raise InterruptedError
    assert isinstance(busy.exception(), BrokenProcessPool)
