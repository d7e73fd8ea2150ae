"""The soft body's family: what the chart is drawn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from messages.scene import Scene
from nodes.fem_solver import families, pushes
from nodes.fem_solver.families import NEWTON, SOFT_BODY, soft_body_trials
from nodes.methods import measure

SCENE = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"


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
    monkeypatch.setattr(pushes, "SPACING_RATIO", 0.6)
    monkeypatch.setattr(pushes, "STATIONS", (0.0,))
    monkeypatch.setattr(pushes, "ANGLE_STEP_RAD", 2.0)
    monkeypatch.setattr(families, "REFERENCE_RATIO", 0.5)
    trials = soft_body_trials(
        small_scene(),
        linear_m={"linear": 0.005},
        table_m={"table": 0.005},
        newton_m=(0.003,),
        depths_m=(0.001, 0.003, 0.0075),
        cache_dir=tmp_path,
    )
    points = {(p.method, p.case["depth_mm"]): p for p in (measure(t, repeats=1) for t in trials)}
    assert {method for method, _ in points} == {"linear", "table", NEWTON}
    assert points["linear", 1.0].in_range
    assert points["linear", 1.0].error < 0.2
    assert not points["linear", 7.5].in_range
    assert points[NEWTON, 3.0].error < 0.3
    assert points[NEWTON, 3.0].median_s > points["linear", 3.0].median_s
    assert all(np.isfinite(p.error) for p in points.values())
    # what was solved is kept
    kept = {path.name.split("-")[2] for path in tmp_path.iterdir()}
    assert {"reference", "table"} <= kept


def test_the_family_says_what_it_is_judged_by() -> None:
    scene = Scene.model_validate(YAML(typ="safe").load(SCENE.read_text()))
    assert SOFT_BODY.tolerance(scene) == 0.5
    assert "Newton" in SOFT_BODY.reference
    assert len(SOFT_BODY.methods) >= 5
