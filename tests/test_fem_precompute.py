"""Test the precomputed response and its cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from flexsheet.nodes.cache import default_cache_dir, load_cached, save_cached
from flexsheet.nodes.fem_solver import precompute
from flexsheet.nodes.fem_solver.elasticity import degrees_of_freedom
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute import (
    SoftBodyModel,
    compute,
    estimate_budget,
    load_or_compute,
    response_cache,
)
from tests.linear_elasticity import solve, stiffness_matrix
from tests.soft_bodies import cylinder_spec

SPEC = cylinder_spec(0.02, 0.06, touch_angle_rad=1.2, skin_spacing_m=0.005)


def quiet(done: int, total: int, need: str) -> None:
    pass


@pytest.fixture(scope="module")
def model() -> SoftBodyModel:
    return compute(SPEC, quiet)


def same(a: SoftBodyModel, b: SoftBodyModel) -> bool:
    pairs = [(getattr(a.response, f.name), getattr(b.response, f.name)) for f in fields(a.response)]
    pairs += [(a.triangles, b.triangles), (a.bounds, b.bounds)]
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in pairs)


def test_each_column_is_the_solution_under_its_load(model: SoftBodyModel) -> None:
    mesh = build_mesh(SPEC.mesh)
    matrix = stiffness_matrix(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.45)
    held = degrees_of_freedom(np.flatnonzero(mesh.fixed))
    for number in (0, len(mesh.contact_nodes) // 2, len(mesh.contact_nodes) - 1):
        loads = np.zeros(matrix.shape[0])
        loads[degrees_of_freedom(mesh.contact_nodes[[number]])] = -mesh.contact_normals[number]
        wanted = solve(matrix, held, np.zeros(len(held)), loads).reshape(-1, 3)
        got = model.response.influence[number].reshape(-1, 3)
        assert np.abs(got - wanted[mesh.skin]).max() < 1e-6 * np.abs(wanted).max()
        inward = -np.einsum("ij,ij->i", wanted[mesh.contact_nodes], mesh.contact_normals)
        assert model.response.compliance[number] == pytest.approx(inward, rel=1e-8)


def test_compliance_is_symmetric_and_positive(model: SoftBodyModel) -> None:
    compliance = model.response.compliance
    assert np.array_equal(compliance, compliance.T)
    assert np.linalg.eigvalsh(compliance).min() > 0.0


def test_a_kept_model_comes_back_the_same(model: SoftBodyModel, tmp_path: Path) -> None:
    assert load_cached(response_cache(SPEC), tmp_path) is None
    path = save_cached(response_cache(SPEC), tmp_path / "new" / "folder", model)
    kept = load_cached(response_cache(SPEC), path.parent)
    assert kept is not None
    assert same(kept, model)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_the_second_start_computes_nothing(model: SoftBodyModel, tmp_path: Path) -> None:
    save_cached(response_cache(SPEC), tmp_path, model)

    def refuse(done: int, total: int, need: str) -> None:
        raise AssertionError("computed although it was kept")

    assert same(load_or_compute(SPEC, tmp_path, refuse), model)


def test_every_part_of_the_specification_has_its_own_file() -> None:
    others = [
        replace(SPEC, poisson_ratio=0.4),
        cylinder_spec(0.021, 0.06, touch_angle_rad=1.2, skin_spacing_m=0.005),
        cylinder_spec(0.02, 0.061, touch_angle_rad=1.2, skin_spacing_m=0.005),
        cylinder_spec(0.02, 0.06, touch_angle_rad=1.1, skin_spacing_m=0.005),
        cylinder_spec(0.02, 0.06, touch_angle_rad=1.2, skin_spacing_m=0.004),
    ]
    assert len({spec.key() for spec in (SPEC, *others)}) == len(others) + 1
    assert replace(SPEC).key() == SPEC.key()


def test_another_version_of_the_code_has_its_own_file(monkeypatch: pytest.MonkeyPatch) -> None:
    before = SPEC.key()
    monkeypatch.setattr(precompute, "VERSION", precompute.VERSION + 1)
    assert SPEC.key() != before


@pytest.mark.parametrize("where", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999])
def test_a_flipped_byte_is_found(model: SoftBodyModel, tmp_path: Path, where: float) -> None:
    path = save_cached(response_cache(SPEC), tmp_path, model)
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 0x40
    path.write_bytes(content)
    kept = load_cached(response_cache(SPEC), tmp_path)
    # a byte of the archive's own directory may be one that nothing depends on
    assert kept is None or same(kept, model)
    assert kept is None or where > 0.99


@pytest.mark.parametrize("part", [0.0, 0.2, 0.8, 0.9999])
def test_a_half_written_file_is_never_used_and_is_replaced(
    model: SoftBodyModel, tmp_path: Path, part: float
) -> None:
    path = save_cached(response_cache(SPEC), tmp_path, model)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    assert load_cached(response_cache(SPEC), tmp_path) is None
    again = load_or_compute(SPEC, tmp_path, quiet)
    assert np.allclose(again.response.compliance, model.response.compliance, rtol=1e-9)
    kept = load_cached(response_cache(SPEC), tmp_path)
    assert kept is not None
    assert same(kept, again)


def test_an_archive_with_other_content_is_not_used(tmp_path: Path) -> None:
    with response_cache(SPEC).path(tmp_path).open("wb") as file:
        np.savez(file, triangles=np.zeros((1, 3), dtype=np.int32), something=np.zeros(3))
    assert load_cached(response_cache(SPEC), tmp_path) is None


def test_progress_runs_from_nothing_to_all() -> None:
    seen: list[tuple[int, int]] = []
    compute(SPEC, lambda done, total, need: seen.append((done, total)))
    assert seen[0][0] == 0
    assert seen[-1][0] == seen[-1][1]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_an_interrupted_computation_leaves_no_file(tmp_path: Path) -> None:
    def stop(done: int, total: int, need: str) -> None:
        if done >= 0.5 * total:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        load_or_compute(SPEC, tmp_path, stop)
    assert list(tmp_path.iterdir()) == []


def test_a_write_that_fails_leaves_no_file(
    model: SoftBodyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_cached(response_cache(SPEC), tmp_path, model)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_swept(model: SoftBodyModel, tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    stem = response_cache(SPEC).path(tmp_path).stem
    leftover = tmp_path / f".{stem}.{gone.pid}.tmp"
    alive = tmp_path / f".{stem}.{os.getppid()}.tmp"
    leftover.write_bytes(b"half")
    alive.write_bytes(b"half")
    save_cached(response_cache(SPEC), tmp_path, model)
    assert not leftover.exists()
    assert alive.exists()


def test_too_little_memory_is_reported_before_allocation(monkeypatch: pytest.MonkeyPatch) -> None:
    fine = cylinder_spec(0.02, 0.06, touch_angle_rad=1.2, skin_spacing_m=0.003)
    mesh = build_mesh(fine.mesh)
    need = estimate_budget(fine)
    assert 0.5 < need.loads / len(mesh.contact_nodes) < 2.0

    class Little:
        available = need.working_bytes

    monkeypatch.setattr("psutil.virtual_memory", Little)
    monkeypatch.setattr(precompute, "build_mesh", None)  # not reached
    with pytest.raises(MemoryError, match="skin_spacing_m"):
        compute(fine, quiet)


def test_the_cache_follows_the_desktop_standard(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "flexsheet"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / ".cache" / "flexsheet"


def test_the_node_module_is_light_to_import() -> None:
    """Processes must start quickly, so no part of scipy is loaded before a scene needs it."""
    code = (
        "import sys, json, flexsheet.nodes.fem_solver.node;"
        "print(json.dumps([m for m in sys.modules if m.split('.')[0] in ('scipy', 'matplotlib')]))"
    )
    root = Path(__file__).parents[1]
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    assert json.loads(out.stdout) == []
