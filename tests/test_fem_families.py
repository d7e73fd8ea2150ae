"""The soft body's family: what the chart is drawn from."""

from __future__ import annotations

import shutil
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from launch.health.compliance import SKIN_SPACING_M, front_curve
from launch.methods.charts import write_overview
from messages.scene import Scene
from nodes.fem_solver import charted, peers, precompute, pushes
from nodes.fem_solver.body import spec_of, table_spec_of
from nodes.fem_solver.families import FORCE, LARGEST, NEWTON, SOFT_BODY, Charted
from nodes.fem_solver.precompute_table import save_table
from nodes.fem_solver.table import Table
from nodes.methods import measure
from tests.soft_bodies import Here

SCENE = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"
CHARTS = Path(__file__).parents[1] / "docs" / "charts"


def small_scene() -> Scene:
    """A small cylinder, that a coarse mesh does for."""
    content = YAML(typ="safe").load(SCENE.read_text())
    content["object"]["geometry"] |= {"radius_m": 0.02, "length_m": 0.05}
    content["object"]["world_from_object"]["position_m"] = [0.0, 0.0, -0.02]
    return Scene.model_validate(content)


def test_every_method_is_judged_by_a_finer_newton(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pushes, "DEPTHS_M", (0.0015, 0.003, 0.005, 0.0075))
    monkeypatch.setattr(pushes, "SPACING_RATIO", 1.0)
    monkeypatch.setattr(pushes, "STATIONS", (0.0,))
    monkeypatch.setattr(pushes, "ANGLE_STEP_RAD", 2.0)
    # pushes are solved here: other processes would not know of the few sites
    monkeypatch.setattr(charted, "local_processes", lambda count: nullcontext(Here()))
    chart = Charted(
        small_scene(),
        tmp_path,
        depths_m=(0.001, 0.003, 0.0075, 0.05),
        linear_m={"linear": 0.005},
        table_m={"table": 0.005},
        newton_m=(0.003,),
        peers_m=(0.003,),
        focused=(0.7,),
        even_m=(0.005,),
    )
    told: list[tuple[int, int]] = []
    chart.prepare(lambda done, total: told.append((done, total)))
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1]
    monkeypatch.setattr(charted, "local_processes", pytest.fail)  # what was solved is kept
    points = {
        (p.method, p.case["depth_mm"]): p for p in (measure(t, repeats=1) for t in chart.trials())
    }
    assert {method for method, _ in points} >= {"linear", "table", NEWTON, peers.SCIKIT_FEM}
    linear, table = points["linear", 3.0], points["table", 3.0]
    assert points["linear", 1.0].in_range
    assert points["linear", 1.0].error < 0.2
    assert not points["linear", 7.5].in_range
    assert abs(table.also[FORCE]) < abs(linear.also[FORCE])
    assert 0.0 < linear.doubts["error"] < 1.0
    # others get the same skin from the same forces
    for peer in (peers.SPARSE_FACTOR, peers.SCIKIT_FEM):
        assert points[peer, 3.0].error == pytest.approx(linear.error, rel=1e-3)
        assert points[peer, 3.0].also[FORCE] == pytest.approx(linear.also[FORCE])
    assert points[NEWTON, 3.0].error < 0.3
    assert points[NEWTON, 3.0].median_s > linear.median_s
    # so deep no mesh can be followed: nothing is said of the error, the skin is held
    deep = [points[method, 50.0] for method in ("linear", "table")]
    assert all(np.isnan(point.error) and not point.in_range for point in deep)
    assert all(point.also[LARGEST] < 12.0 for point in deep)


def test_a_peer_that_is_not_there_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    assert peers.peer("skfem") is None


def test_the_objects_curve_is_the_tables_where_one_is_kept(tmp_path: Path) -> None:
    scene = small_scene()
    by_linear = front_curve(scene, tmp_path)
    spec = spec_of(scene, SKIN_SPACING_M)
    model = precompute.load(spec, tmp_path)
    assert model is not None
    response, depths = model.response, np.linspace(0.0, 0.02, 6)
    pascals = 1.0 / scene.object.material.young_modulus_pa
    count = len(response.touch)
    table = Table(
        depths_m=depths,
        fields=np.zeros((count, 5, response.rest.size), dtype=np.float32),
        force_n=100.0 * pascals * depths[:, None] * response.normals[:, None],
        reach_m=np.full(count, 0.02),
    )
    save_table(table, table_spec_of(scene, spec), tmp_path)
    by_table = front_curve(scene, tmp_path)
    assert by_table[:, 1] == pytest.approx(100.0 * by_table[:, 0], rel=1e-3, abs=1e-9)
    assert by_linear[-1, 1] != pytest.approx(by_table[-1, 1], rel=0.05)


def test_the_family_says_what_it_is_judged_by() -> None:
    scene = Scene.model_validate(YAML(typ="safe").load(SCENE.read_text()))
    assert SOFT_BODY.tolerance(scene) == 0.5
    assert "Newton" in SOFT_BODY.reference
    assert len(SOFT_BODY.methods) >= 5


def test_the_page_of_charts_shows_what_benchmarks_left_beside_them(tmp_path: Path) -> None:
    for name in ("soft-body.json", "soft-body-size.svg"):
        shutil.copy(CHARTS / name, tmp_path)
    assert "![soft-body-size](soft-body-size.svg)" in write_overview(tmp_path).read_text()
