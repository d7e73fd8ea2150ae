"""The soft body's family: what the chart is drawn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from messages.scene import Scene
from nodes.fem_solver.families import SOFT_BODY, soft_body_trials
from nodes.methods import measure

SCENE = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"


def test_finer_meshes_come_nearer_to_the_reference(tmp_path: Path) -> None:
    scene = Scene.model_validate(YAML(typ="safe").load(SCENE.read_text()))
    trials = list(
        soft_body_trials(
            scene,
            spacings_m={"coarse": 0.0085, "fine": 0.006},
            reference_spacing_m=0.0045,
            cache_dir=tmp_path,
        )
    )
    points = [measure(trial, repeats=2) for trial in trials]
    mean = {
        name: np.mean([p.error for p in points if p.method == name and p.in_range])
        for name in ("coarse", "fine")
    }
    assert 0.0 < mean["fine"] < mean["coarse"] < 1.0
    assert {p.params["depth_mm"] for p in points if not p.in_range} == {8.0, 10.0}
    assert all(p.median_s > 0.0 for p in points)


def test_the_family_says_what_it_is_judged_by() -> None:
    scene = Scene.model_validate(YAML(typ="safe").load(SCENE.read_text()))
    assert SOFT_BODY.tolerance(scene) == 0.5
    assert "linear" in SOFT_BODY.reference
    assert len(SOFT_BODY.methods) >= 3
