"""Test what the simulator's sheet takes from the apparatus: weight, friction and its history."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.experiments.compliance import ForceReference, make_presses
from flexsheet.launch.experiments.stroke import SampledMotion
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import Apparatus
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin import sheet_pull
from flexsheet.nodes.twin.sheet_pull import SheetPull, true_rubber
from flexsheet.nodes.twin.truth import apply_apparatus
from tests.scenes import set_density
from tests.test_compliance_experiment import held

SCENE = set_density(
    load_scene(Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"), 1200.0
)
DEPTH_M = 0.02


def apparatus(**parts: object) -> Apparatus:
    return Apparatus.model_validate({"scene": "cylinder", **parts})


def density_of(given: Apparatus) -> float:
    return true_rubber(apply_apparatus(SCENE, given).sheet, given).density_kg_per_m3


def test_the_true_density_is_the_scenes_unless_stated() -> None:
    assert density_of(apparatus()) == SCENE.sheet.density_kg_per_m3 == 1200.0
    assert density_of(apparatus(sheet={"density_kg_per_m3": 1100.0})) == 1100.0
    assert density_of(apparatus(sheet={"density_kg_per_m3": 0.0})) == 0.0


def test_the_true_friction_is_that_of_the_apparatus(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float | None] = []
    monkeypatch.setattr(
        sheet_pull,
        "solve",
        lambda *_, **options: given.append(options["friction_coefficient"]),
    )
    for one in (None, apparatus(sheet={"friction_coefficient": 0.4})):
        sheet_pull.solve_sheet(SCENE, one, (np.eye(4), np.eye(4)))
    assert given == [None, 0.4]


def test_the_pull_relaxes_and_has_hysteresis() -> None:
    arms = {"left": {"flange_compliance_m_per_n": 1e-4}}
    given = apparatus(arms=arms, sheet={"hysteresis_ratio": 0.2, "creep_ratio_per_decade": 0.05})
    pull = SheetPull.of(SCENE.sheet, given)
    elastic = SheetPull.of(SCENE.sheet, apparatus(arms=arms))
    assert pull is not None
    assert elastic is not None

    def yielded_m(sheet: SheetPull, stretch: float, time_s: float) -> float:
        half = 0.5 * stretch * SCENE.sheet.width_m
        left, right = (transform(np.eye(3), [side * half, 0.0, 0.0]) for side in (-1, 1))
        moved = sheet.displace(left, right, np.eye(4), np.eye(4), time_s=time_s)
        return float(moved[0][0, 3] - left[0, 3])

    wanted = yielded_m(elastic, 1.1, 0.0)
    assert yielded_m(pull, 1.1, 0.0) == pytest.approx(wanted, rel=1e-3)
    assert yielded_m(pull, 1.1, 9.0) == pytest.approx(0.95 * wanted, rel=0.02)
    yielded_m(pull, 1.2, 10.0)
    falling = yielded_m(pull, 1.1, 11.0)
    assert falling < 0.9 * wanted, "less while the stretch decreases"


def test_the_presented_force_depends_on_the_history() -> None:
    press = make_presses(SCENE)[0]
    begin, middle, end = 0, 1_000_000_000, 2_000_000_000
    times = np.array([begin, middle, end], dtype=np.int64)
    tips = np.array([press.surface - depth * press.normal for depth in (0.0, DEPTH_M, 0.0)])
    still = held(press, DEPTH_M, 0.0)
    edges = tuple(
        SampledMotion(times, np.tile(edge.interpolate(np.array([0]))[0], (3, 1)))
        for edge in still.edges
    )
    recorded = replace(
        still,
        finger=SampledMotion(times, tips),
        windows_ns={press.path.label: (begin, end)},
        edges=(edges[0], edges[1]),
    )
    given = apparatus(sheet={"hysteresis_ratio": 0.2})
    rubber = ForceReference(replace(recorded, apparatus=given))
    elastic = ForceReference(replace(recorded, apparatus=apparatus()))
    half = (middle // 2, middle + middle // 2)
    ratios = [rubber.evaluate(at, press).felt_n / elastic.evaluate(at, press).felt_n for at in half]
    assert ratios == pytest.approx([1.136, 0.864], abs=0.01)
