"""Test the selection of methods for a scene: the fastest sufficient one, else the nearest."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.commands.output import NOT_GOOD
from flexsheet.launch.methods import system_chart, tune
from flexsheet.launch.methods.charts import UnknownFamilyError, find_family
from flexsheet.launch.methods.results import describe_load
from flexsheet.launch.methods.tune import choose, evaluate_methods, find_tunables
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.methods import Methods, SoftBodyChoice
from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.soft_body_factory import choose_method
from flexsheet.nodes.methods import Case, Family, Point
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel
from flexsheet.nodes.planner.force_table import (
    choose_force_model,
    load_or_compute,
    make_table_cache,
)

SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"
SCENE = load_scene(SCENES / "cylinder.yaml")


CHEAP_FIRST = {"cheap": 1e-5, "middle": 1e-4, "dear": 1e-3}
SETTINGS: dict[str, tune.Setting] = {name: name for name in CHEAP_FIRST}


def point(method: str, error: float, *, depth: int = 1, **more: Any) -> Point:
    case: Case = {"depth_mm": depth}
    took = more.pop("took", CHEAP_FIRST.get(method, 1e-3))
    reported = {"in_range": True} | more
    return Point(method, case, case, median_s=took, p99_s=took, error=error, **reported)


def chosen_of(points: Sequence[Point]) -> tune.MethodEvaluation:
    return choose(evaluate_methods(points, SETTINGS, tolerance=1.0))


def test_the_cheapest_that_is_good_enough_everywhere_is_chosen() -> None:
    points = [
        point("cheap", 0.1),
        point("cheap", 0.9, depth=2),  # more than the margin leaves
        point("middle", 0.2),
        point("middle", 0.7, depth=2),
        point("dear", 0.01),
        point("dear", 0.02, depth=2),
    ]
    assert chosen_of(points).method == "middle"


def test_a_method_out_of_its_range_is_not_selected_even_if_exact() -> None:
    points = [point("cheap", 0.0, in_range=False), point("dear", 0.5)]
    assert chosen_of(points).method == "dear"


def test_cases_that_the_scene_does_not_ask_for_do_not_count() -> None:
    points = [point("cheap", 0.1), point("cheap", 9.0, depth=50, in_scene=False)]
    assert chosen_of(points).is_sufficient


def test_of_methods_with_equal_time_the_more_exact_is_selected() -> None:
    points = [point("cheap", 0.5, took=1.0e-3), point("dear", 0.1, took=1.05e-3)]
    assert chosen_of(points).method == "dear"


@pytest.mark.parametrize("error", [float("nan"), float("inf")])
def test_a_method_without_a_reference_is_not_sufficient(error: float) -> None:
    found = chosen_of([point("cheap", 0.1), point("cheap", error, depth=2)])
    assert not found.is_sufficient
    assert found.wrong == 1


def test_if_none_is_sufficient_the_nearest_is_selected() -> None:
    points = [
        point("cheap", 3.0),
        point("cheap", 4.0, depth=2),
        point("middle", 0.1),
        point("middle", 1.5, depth=2),
        point("dear", 0.1),
        point("dear", 0.3, depth=2, in_range=False),
    ]
    found = chosen_of(points)
    assert (found.method, found.outside, found.wrong) == ("middle", 0, 1)


def test_a_method_that_is_meant_for_little_is_no_near_miss() -> None:
    """It is exact in its range, but has no results elsewhere."""
    points = [
        point("cheap", 1.1),
        *(point("cheap", 0.1, depth=depth, in_range=False) for depth in (2, 3)),
        *(point("dear", 1.3, depth=depth) for depth in (1, 2, 3)),
    ]
    found = chosen_of(points)
    assert (found.method, found.wrong) == ("dear", 3)


def family(name: str, methods: Sequence[str]) -> Family:
    return Family(name, "mm", "the truth", methods, lambda scene: (), lambda scene: 1.0)


def choice_of(points: Sequence[Point], key: str = "correction") -> tune.Choice:
    checked = evaluate_methods(points, SETTINGS, tolerance=1.0)
    return tune.Choice("made-up", key, "mm", 1.0, choose(checked), tuple(checked))


def test_a_choice_is_printed_as_a_line_of_the_scene() -> None:
    met = choice_of([point("cheap", 4.2), point("dear", 0.25)])
    assert met.line() == "  correction: dear  # 1 ms, error 0.25 of 1 mm"
    missed = choice_of([point("cheap", 4.2), point("dear", 2.5), point("dear", 0.1, depth=2)])
    assert missed.line() == (
        "  correction: dear  # 1 ms, error 2.5 of 1 mm, not met in 1 of 2 cases"
    )


def test_the_lines_are_the_methods_of_a_scene() -> None:
    for tunable in tune.TUNABLES:
        for setting in tunable.settings.values():
            evaluation = tune.MethodEvaluation("a", setting, 1e-3, 0.1, 1, 0, 0)
            choice = tune.Choice(tunable.name, tunable.key, "mm", 1.0, evaluation, ())
            lines = YAML(typ="safe").load(f"methods:\n{choice.line()}\n")
            methods = Methods.model_validate(lines["methods"]).model_dump()
            assert methods[tunable.key] == setting
    assert {one.key for one in tune.TUNABLES} == set(Methods.model_fields) - {"compliance"}


def test_two_passes_go_onto_the_shape_that_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    there = {
        "sheet-shape": family("sheet-shape", ["four_triangles", "reduced_order"]),
        "correction": family("correction", ["one_plane", "two_pass", "two_pass_triangles"]),
    }
    monkeypatch.setattr(tune, "find_family", there.__getitem__)
    errors = {"four_triangles": 0.2, "reduced_order": 0.1, "one_plane": 9.0}

    def measured(asked: Family, scene: Scene, **_: Any) -> Sequence[Point]:
        return [point(name, errors.get(name, 0.3), took=1e-3) for name in asked.methods]

    monkeypatch.setattr(tune, "measure_family", measured)
    tunables = find_tunables(["correction", "sheet-shape"], SCENE)
    shape, correction = tune.tune(SCENE, tunables)
    assert shape.chosen.setting == "reduced_order"  # as quick as the others, and more exact
    assert (correction.chosen.method, correction.chosen.setting) == ("two_pass", "two_pass")
    errors["reduced_order"] = 9.0
    shape, correction = tune.tune(SCENE, tunables)
    assert shape.chosen.setting == "four_triangles"
    assert correction.chosen.method == "two_pass_triangles"
    assert correction.chosen.setting == "two_pass"


def test_method_families_that_a_scene_does_not_use_are_not_tuned() -> None:
    """The plane has neither a material, thus no force, nor a projector, thus no image."""
    plane = load_scene(SCENES / "rigid-plane.yaml")
    assert find_tunables([], plane) == []
    assert len(find_tunables([], SCENE)) == 3
    with pytest.raises(UnknownFamilyError, match=r'"correction": it has no `projector`'):
        find_tunables(["correction"], plane)


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["tune", *map(str, arguments)])


def test_methods_that_exceed_a_tolerance_have_a_separate_exit_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    missed = choice_of([point("cheap", 2.0)])
    monkeypatch.setattr(tune, "tune", lambda *_: [missed])
    outcome = run(SCENES / "demanding.yaml", "--family", "correction", "--json")
    assert outcome.exit_code == NOT_GOOD
    result = json.loads(outcome.stdout)
    assert not result["met"]
    assert result["lines"] == ["methods:", missed.line()]


@pytest.mark.parametrize("failing", [[], ["sheet_mm.p95"]])
def test_the_whole_system_is_checked_once_with_the_chosen_methods(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, failing: list[str]
) -> None:
    chosen = choice_of([point("cheap", 0.1)])
    configured: list[system_chart.Configuration] = []

    def measure(*_: Any, **settings: Any) -> dict[str, Any]:
        assert (settings["blocks"], settings["apparatuses"]) == (1, 0)
        configured.extend(settings["list_configurations"](SCENE))
        return {"failed": [], "points": [{"failing": failing}]}

    shape = replace(chosen.chosen, setting="four_triangles")
    choices = [replace(chosen, key="sheet_shape", chosen=shape)]
    monkeypatch.setattr(tune, "run_system_chart", measure)
    monkeypatch.setattr(tune, "tune", lambda *_: choices)
    outcome = run(SCENES / "cylinder.yaml", "--output", tmp_path)
    assert outcome.exit_code == (NOT_GOOD if failing else 0)
    (configuration,) = configured
    assert configuration.methods == SCENE.methods.model_copy(
        update={"sheet_shape": "four_triangles"}
    )
    assert ("sheet_mm" in outcome.output) == bool(failing)


@pytest.mark.parametrize("tunable", tune.TUNABLES, ids=lambda one: one.name)
def test_every_setting_has_a_method_in_the_chart(tunable: tune.Tunable) -> None:
    assert set(tunable.settings) <= set(find_family(tunable.name).methods)


def test_an_unknown_family_is_named_with_the_nearest() -> None:
    outcome = run(SCENES / "cylinder.yaml", "--family", "corection")
    assert isinstance(outcome.exception, UnknownFamilyError)
    assert 'did you mean "correction"?' in str(outcome.exception)
    assert 'unknown method family "kinematics"' in str(
        run(SCENES / "sphere.yaml", "--family", "kinematics").exception
    )


def with_methods(**methods: object) -> Scene:
    return SCENE.model_copy(update={"methods": Methods.model_validate(methods)})


def test_the_soft_body_follows_the_scene() -> None:
    assert choose_method(SCENE_BARE) == SoftBodyChoice(
        method="nonlinear_table", skin_spacing_m=0.003
    )
    linear = SoftBodyChoice(method="linear", skin_spacing_m=0.006)
    scene = with_methods(soft_body=linear.model_dump())
    assert choose_method(scene) == linear
    assert choose_method(scene, "nonlinear_table", 0.0045) == SoftBodyChoice(
        method="nonlinear_table", skin_spacing_m=0.0045
    )


SCENE_BARE = SCENE.model_copy(update={"methods": Methods()})


def test_a_missing_force_table_is_replaced_and_reported(tmp_path: Path) -> None:
    sheet = SCENE.sheet.model_copy(update={"thickness_m": 0.0012})
    scene = SCENE.model_copy(update={"sheet": sheet})
    law, reported = choose_force_model(scene, None, tmp_path)
    assert law.name == "scaled"
    assert f'the scene "{scene.name}" as SCENE, run flexsheet precompute SCENE' in reported


@pytest.mark.parametrize("file", sorted(SCENES.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_package_contains_the_force_table_of_each_shipped_scene(
    file: Path, tmp_path: Path
) -> None:
    """If this test fails, run `python -m benchmarks.ship_tables`."""
    scene = load_scene(file)
    law, reported = choose_force_model(scene, None, tmp_path)
    assert (law.name, reported) == ("table", "table")
    stored = load_or_compute(scene, tmp_path)
    assert isinstance(law, TabulatedSheetModel)
    assert np.array_equal(stored.ratios, law.ratios)
    assert make_table_cache(scene).path(tmp_path).is_file()


@pytest.mark.parametrize(("load", "busy"), [(0.2, False), (3.9, False), (4.1, True), (40.0, True)])
def test_a_busy_machine_is_reported(
    monkeypatch: pytest.MonkeyPatch, load: float, busy: bool
) -> None:
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    assert (describe_load() is not None) == busy
