"""Test the benchmark of the soft-body methods."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.health.compliance import compute_front_curve
from flexsheet.messages.methods import SoftBodyChoice
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.cache import load_cached, save_cached
from flexsheet.nodes.fem_solver import precompute, reference, snapshots, soft_body_factory
from flexsheet.nodes.fem_solver import table as table_module
from flexsheet.nodes.fem_solver.benchmarks import (
    FORCE,
    MAX_DISPLACEMENT,
    NEWTON,
    SOFT_BODY,
    SoftBodyBenchmark,
)
from flexsheet.nodes.fem_solver.body import make_soft_body_spec, make_table_spec
from flexsheet.nodes.fem_solver.precompute_table import make_table_cache
from flexsheet.nodes.methods import measure
from tests.scenes import load_cylinder, load_values
from tests.soft_bodies import InlineExecutor, make_even_table


def small_scene() -> Scene:
    """Return a small cylinder, for which a coarse mesh is sufficient."""
    content = load_values()
    content["object"]["geometry"] |= {"radius_m": 0.02, "length_m": 0.05}
    content["object"]["world_from_object"]["position_m"] = [0.0, 0.0, -0.02]
    return Scene.model_validate(content)


def choose(scene: Scene, choice: SoftBodyChoice) -> Scene:
    methods = scene.methods.model_copy(update={"soft_body": choice})
    return scene.model_copy(update={"methods": methods})


@pytest.mark.long
def test_every_method_is_compared_with_a_finer_newton(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "COARSE_DEPTHS_M", (0.0015, 0.003, 0.005, 0.0075))
    monkeypatch.setattr(snapshots, "SPACING_RATIO", 1.0)
    monkeypatch.setattr(snapshots, "STATIONS", (0.0,))
    monkeypatch.setattr(snapshots, "ANGLE_STEP_RAD", 2.0)
    # the reference here is as coarse as the table, whose forces are therefore not corrected
    monkeypatch.setattr(
        table_module, "compute_force_factors", lambda *given: np.ones(len(given[-1]))
    )
    # pushes are solved here: other processes would not know of the few sites
    for module in (reference, soft_body_factory):
        monkeypatch.setattr(module, "local_processes", lambda count: nullcontext(InlineExecutor()))
    chart = SoftBodyBenchmark(
        small_scene(),
        tmp_path,
        depths_m=(0.001, 0.003, 0.0075, 0.05),
        choices={
            "linear": SoftBodyChoice(method="linear", skin_spacing_m=0.005),
            "table": SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.005),
        },
        newton_m=(0.003,),
        ratios=(0.6, 0.7),
    )
    reports: list[tuple[int, int]] = []
    chart.prepare(lambda done, total: reports.append((done, total)))
    assert reports[0][0] == 0
    assert reports[-1][0] == reports[-1][1]
    monkeypatch.setattr(snapshots, "solve_snapshot", pytest.fail)  # what was solved is kept
    points = {
        (p.method, p.case["depth_mm"]): p for p in (measure(t, repeats=1) for t in chart.trials())
    }
    assert {method for method, _ in points} == {"linear", "table", NEWTON}
    linear, table = points["linear", 3.0], points["table", 3.0]
    assert points["linear", 1.0].in_range
    assert points["linear", 1.0].error < 0.2
    assert not points["linear", 7.5].in_range
    assert abs(table.extra_metrics[FORCE]) < abs(linear.extra_metrics[FORCE])
    assert 0.0 < linear.reference_uncertainty["error"] < 1.0
    assert points[NEWTON, 3.0].error < 0.3
    assert points[NEWTON, 3.0].median_s > linear.median_s
    # so deep no mesh can be followed: nothing is said of the error, the skin is held
    deep = [points[method, 50.0] for method in ("linear", "table")]
    assert all(np.isnan(point.error) and not point.in_range for point in deep)
    assert all(point.extra_metrics[MAX_DISPLACEMENT] < 12.0 for point in deep)


def test_the_objects_curve_is_that_of_the_chosen_method(tmp_path: Path) -> None:
    chosen = SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.0045)
    scene = choose(small_scene(), chosen)
    chooses_linear = choose(scene, chosen.model_copy(update={"method": "linear"}))
    by_linear = compute_front_curve(chooses_linear, tmp_path, lambda text: None)
    spec = make_soft_body_spec(scene, chosen.skin_spacing_m)
    model = load_cached(precompute.response_cache(spec), tmp_path)
    assert model is not None
    table = make_even_table(model.response, 100.0 / require_material(scene).young_modulus_pa)
    save_cached(make_table_cache(make_table_spec(scene, spec, coarse=True)), tmp_path, table)
    by_table = compute_front_curve(scene, tmp_path, lambda text: None)
    again = compute_front_curve(chooses_linear, tmp_path, lambda text: None)
    assert np.array_equal(again, by_linear)
    assert by_table[:, 1] == pytest.approx(100.0 * by_table[:, 0], rel=1e-3, abs=1e-9)
    assert by_linear[-1, 1] != pytest.approx(by_table[-1, 1], rel=0.05)


def test_the_family_names_its_reference() -> None:
    scene = load_cylinder()
    assert SOFT_BODY.tolerance(scene) == 0.5
    assert "Newton" in SOFT_BODY.reference
    assert len(SOFT_BODY.methods) >= 5
