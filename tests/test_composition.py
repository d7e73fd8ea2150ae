"""Test the composition of methods: budgets of known tables, and graphs of known errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.methods import tune_system
from flexsheet.launch.methods.composition import (
    P95_OVER_RMS,
    Combination,
    Figures,
    StageOption,
    SystemMetric,
    Unexplained,
    budget,
    compose,
    list_combinations,
    name_methods,
    predict,
)
from flexsheet.launch.methods.tune import Choice, MethodEvaluation, choose, evaluate_methods
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.benchmarks import FORCE
from flexsheet.nodes.methods import Point
from flexsheet.nodes.triangulator.tracking_benchmark import HORIZON_MS

SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"
FINGERTIP, SHEET, IMAGE = SystemMetric.FINGERTIP, SystemMetric.SHEET, SystemMetric.IMAGE
FORCE_ERROR, TO_ARM, TO_LIGHT = SystemMetric.FORCE, SystemMetric.TO_ARM, SystemMetric.TO_LIGHT

STAGES = {
    "marker": [
        StageOption("quick", 0.1, biases={TO_ARM: 1.0}),
        StageOption("fine", 0.3, biases={TO_ARM: 3.0}),
    ],
    "tracking": [
        StageOption("raw", 0.1, {FINGERTIP: 0.9, SHEET: 3.0}, given={"marker": "quick"}),
        StageOption("raw", 0.1, {FINGERTIP: 0.1, SHEET: 2.5}, given={"marker": "fine"}),
        StageOption("filter", 0.2, {FINGERTIP: 0.6, SHEET: 0.9}, given={"marker": "quick"}),
        StageOption("filter", 0.2, {FINGERTIP: 0.1, SHEET: 0.3}, given={"marker": "fine"}),
    ],
    "sheet-force": [
        StageOption("linear", 0.01, biases={FORCE_ERROR: 12.0}),
        StageOption("table", 0.05, biases={FORCE_ERROR: -3.0}),
    ],
    "soft-body": [StageOption("fem", 0.1, biases={FORCE_ERROR: 5.0, TO_LIGHT: 4.0})],
    "correction": [
        StageOption("planes", 0.2, {IMAGE: 0.4}, {TO_LIGHT: 20.0}),
        StageOption("passes", 0.4, {IMAGE: 0.1}, {TO_LIGHT: 1000.0}),
    ],
}
LIMITS: dict[SystemMetric, float] = {
    FINGERTIP: 1.0, SHEET: 1.0, IMAGE: 0.5, FORCE_ERROR: 20.0, TO_ARM: 15.0, TO_LIGHT: 60.0,
}  # fmt: skip


class SimulatedGraph:
    """A graph whose errors are the tables' and what no table contains; it counts its runs."""

    def __init__(self, hidden: Figures | None = None) -> None:
        self.hidden, self.ran = hidden or {}, list[dict[str, str]]()

    def __call__(self, combination: Combination) -> Figures:
        self.ran.append(name_methods(combination))
        return predict(combination, Unexplained(self.hidden))


def test_spreads_add_as_squares_and_biases_as_they_are() -> None:
    combination = {
        "a": StageOption("a", 1.0, {SHEET: 3.0}, {SHEET: -0.5}),
        "b": StageOption("b", 1.0, {SHEET: 4.0}, {TO_ARM: 2.0}),
        "c": StageOption("c", 1.0, {}, {SHEET: 0.25, TO_ARM: 3.0}),
    }
    assert predict(combination) == pytest.approx({SHEET: 5.75, TO_ARM: 5.0})
    rest = Unexplained({SHEET: 12.0, TO_ARM: 6.0})
    assert predict(combination, rest) == pytest.approx({SHEET: 13.75, TO_ARM: 11.0})
    assert budget(combination, SHEET) == {"a": 3.5, "b": 4.0, "c": 0.25}


def test_only_methods_whose_figures_belong_together_are_combined() -> None:
    combinations = list_combinations({name: STAGES[name] for name in ("marker", "tracking")})
    assert len(combinations) == 4
    for one in combinations:
        assert one["tracking"].given["marker"] == one["marker"].method


def test_tracking_is_composed_with_the_noise_of_the_chosen_marker() -> None:
    """Alone, both would be the cheapest; together they exceed the sheet's tolerance."""
    graph = SimulatedGraph()
    found = compose(STAGES, LIMITS, graph, margin=0.2)
    assert found.accepted
    chosen = name_methods(found.chosen)
    assert (chosen["marker"], chosen["tracking"]) == ("fine", "filter")
    assert (chosen["sheet-force"], chosen["correction"]) == ("table", "planes")
    assert len(graph.ran) == 1


def test_the_cheapest_configuration_is_accepted_if_the_graph_confirms_it() -> None:
    loose = {**LIMITS, FINGERTIP: 5.0, SHEET: 5.0, FORCE_ERROR: 50.0}
    found = compose(STAGES, loose, SimulatedGraph(), margin=0.2)
    assert set(name_methods(found.chosen).values()) == {"quick", "raw", "linear", "fem", "planes"}


def test_a_frame_of_one_second_exceeds_the_tolerance_of_the_image() -> None:
    strict = {**LIMITS, IMAGE: 0.2}
    found = compose(STAGES, strict, SimulatedGraph(), margin=0.2)
    assert not found.accepted
    exceeded = set(found.last.exceeded)
    assert exceeded <= {IMAGE, TO_LIGHT}
    assert any("tolerance" in line for line in found.explain())


def test_what_the_graph_adds_leads_to_a_more_exact_proposal() -> None:
    """The tables allow the linear force; the graph has another 12 percent."""
    limits = {**LIMITS, FORCE_ERROR: 22.0}
    graph = SimulatedGraph({FORCE_ERROR: 12.0})
    found = compose(STAGES, limits, graph, margin=0.1)
    assert [one["sheet-force"] for one in graph.ran] == ["linear", "table"]
    assert found.accepted
    assert found.chosen["sheet-force"].method == "table"


def test_a_tolerance_that_no_method_meets_is_named_with_its_cost() -> None:
    graph = SimulatedGraph({TO_ARM: 14.5})
    found = compose(STAGES, LIMITS, graph, margin=0.0)
    assert not found.accepted
    assert set(found.last.exceeded) == {TO_ARM}
    assert found.unmet == "Not met at the 95 % value: exposure to arm."
    verdict, reason = found.explain()
    assert verdict.startswith("no tested configuration meets all tolerances")
    assert "exposure_to_arm_ms: 15.5, tolerance 15; methods add marker 1" in reason
    assert len(graph.ran) <= 4


def test_a_tolerance_that_no_method_meets_does_not_end_the_search() -> None:
    """The latency is too large with all methods; the methods still have to meet the others."""
    limits = {**LIMITS, FORCE_ERROR: 22.0}
    graph = SimulatedGraph({TO_ARM: 30.0, FORCE_ERROR: 12.0})
    found = compose(STAGES, limits, graph, margin=0.1)
    assert [one["sheet-force"] for one in graph.ran][:2] == ["linear", "table"]
    assert set(found.last.exceeded) == {TO_ARM}
    assert found.chosen["sheet-force"].method == "table"


def test_a_method_out_of_its_range_is_not_accepted_even_if_the_graph_is_exact() -> None:
    stages = {"soft-body": [StageOption("fem", 0.1, outside=0.5)]}
    found = compose(stages, LIMITS, lambda _: {SHEET: 0.1}, margin=0.2)
    assert not found.accepted
    assert any("range" in line for line in found.explain())


@pytest.mark.parametrize(("tolerance", "methods"), [(13.0, ["table", "linear"]), (11.0, ["table"])])
def test_a_cheaper_configuration_is_tried_if_the_prediction_was_too_large(
    tolerance: float, methods: list[str]
) -> None:
    """The worst cases of both force models add up to 17 percent; the graph has a third of it.

    The graph cannot disprove a worst case of 12 percent that alone exceeds the tolerance.
    """
    limits = {**LIMITS, FORCE_ERROR: tolerance}
    ran: list[str] = []

    def run_graph(combination: Combination) -> Figures:
        ran.append(combination["sheet-force"].method)
        predicted = dict(predict(combination))
        return predicted | {FORCE_ERROR: predicted[FORCE_ERROR] / 3.0}

    found = compose(STAGES, limits, run_graph, margin=0.2)
    assert ran == methods
    assert found.accepted
    assert found.chosen["sheet-force"].method == methods[-1]


def test_a_metric_that_the_graph_does_not_measure_has_its_predicted_value() -> None:
    skin = SystemMetric.SKIN
    stages = {
        "soft-body": [
            StageOption("coarse", 0.01, biases={FORCE_ERROR: 9.0, skin: 0.4}),
            StageOption("fine", 0.05, biases={FORCE_ERROR: 3.0, skin: 0.2}),
        ]
    }

    def run_graph(combination: Combination) -> Figures:
        return {FORCE_ERROR: predict(combination)[FORCE_ERROR] / 3.0}

    found = compose(stages, {FORCE_ERROR: 10.0, skin: 1.0}, run_graph, margin=0.2)
    assert [run.measured[skin] for run in found.runs] == [0.2, 0.4]
    assert found.accepted
    assert found.chosen["soft-body"].method == "coarse"


def test_the_method_with_the_fewest_cases_out_of_range_is_preferred() -> None:
    """The error of a method counts only within its range, so a small range must not help it."""
    stages = {
        "soft-body": [
            StageOption("shallow", 0.1, biases={FORCE_ERROR: 5.0}, outside=0.6),
            StageOption("deep", 0.2, biases={FORCE_ERROR: 25.0}, outside=0.1),
        ]
    }
    found = compose(stages, LIMITS, SimulatedGraph(), margin=0.2)
    assert name_methods(found.chosen) == {"soft-body": "deep"}
    assert not found.accepted
    assert "soft-body deep: 10% of the scene's cases are out of range" in found.explain()
    assert found.unmet.endswith("The scene exceeds the range of the method: soft-body.")


def test_predictions_learn_only_what_the_tables_lack() -> None:
    combination = {"a": StageOption("a", 1.0, {SHEET: 3.0}, {TO_ARM: 4.0, FORCE_ERROR: -5.0})}
    learned = Unexplained().learn(combination, {SHEET: 5.0, TO_ARM: 10.0, FORCE_ERROR: 12.0})
    assert learned.parts == pytest.approx({SHEET: 4.0, TO_ARM: 6.0, FORCE_ERROR: 7.0})
    assert predict(combination, learned) == pytest.approx(
        {SHEET: 5.0, TO_ARM: 10.0, FORCE_ERROR: 12.0}
    )
    assert Unexplained().learn(combination, {SHEET: 2.0}).parts == {}
    assert learned.learn(combination, {SHEET: 3.1}).parts[SHEET] == pytest.approx(4.0)


def evaluate(method: str, error: float, took: float, **more: Any) -> list[MethodEvaluation]:
    cases = more.pop("cases", [{"depth_mm": 1}])
    points = [
        Point(method, case, case, took, took, error * case.get("factor", 1.0), True, **more)
        for case in cases
    ]
    return evaluate_methods(points, {method: method}, tolerance=1.0)


def make_choice(family: str, *evaluations: MethodEvaluation) -> Choice:
    key = family.replace("-", "_")
    return Choice(family, key, "mm", 1.0, choose(evaluations), evaluations)


def test_stages_are_made_of_the_measured_families(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(SCENES / "light-touch.yaml")
    horizons = [{HORIZON_MS: 0, "factor": 1.0}, {HORIZON_MS: 20, "factor": 2.0},
             {HORIZON_MS: 50, "factor": 3.0}]  # fmt: skip
    asked: list[float] = []

    def measure(scene: Scene, noise_px: float) -> Sequence[MethodEvaluation]:
        asked.append(noise_px)
        return evaluate("adaptive", 10.0 * noise_px, 1e-4, cases=horizons)

    monkeypatch.setattr(tune_system, "measure_tracking", measure)
    stages = tune_system.make_stages(
        scene,
        [
            make_choice(
                "marker", *evaluate("moments", 0.1, 1e-4), *evaluate("subpixel_fit", 0.01, 4e-4)
            ),
            make_choice("tracking", *evaluate("adaptive", 0.7, 1e-4, cases=horizons)),
            make_choice("correction", *evaluate("two_pass", 0.2, 1.0)),
            make_choice("soft-body", *evaluate("linear", 0.1, 1e-3, extra_metrics={FORCE: -7.0})),
        ],
    )
    assert asked == [0.01]  # tuned with the noise of the chosen marker, measured for the others
    coarse, fine = stages["tracking"]
    assert coarse.given == {"marker": "moments"}
    assert coarse.spreads[FINGERTIP] == pytest.approx(0.7 * P95_OVER_RMS)
    assert coarse.spreads[SHEET] == pytest.approx(2.1 * P95_OVER_RMS)
    assert fine.spreads[FINGERTIP] == pytest.approx(0.1 * P95_OVER_RMS)
    assert stages["correction"][0].biases[TO_LIGHT] == pytest.approx(1000.0)
    assert stages["soft-body"][0].biases[FORCE_ERROR] == pytest.approx(7.0)
    assert stages["marker"][0].cores == pytest.approx(2 * scene.camera.rate_hz * 1e-4)


def test_a_stage_is_made_of_the_measured_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the real method family, so that its cases have the keys that the stage reads."""
    monkeypatch.setattr(tune_system, "REPEATS", 1)
    scene = load_scene(SCENES / "light-touch.yaml")
    evaluations = tune_system.measure_tracking(scene, 0.1)
    (tracking,) = tune_system.make_stages(scene, [make_choice("tracking", *evaluations)]).values()
    spreads = {one.method: one.spreads for one in tracking}["adaptive"]
    assert 0.0 < spreads[FINGERTIP] < spreads[SHEET]


def test_every_tolerance_of_a_scene_is_a_limit() -> None:
    scene = load_scene(SCENES / "cylinder.yaml")
    limits = tune_system.list_tolerances(scene)
    assert set(limits) == set(SystemMetric)
    assert limits[TO_ARM] == pytest.approx(15.0)
    assert limits[TO_LIGHT] == pytest.approx(60.0)
    assert limits[FORCE_ERROR] == pytest.approx(10.0)


def test_the_largest_95_percent_value_of_all_runs_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flexsheet.launch.experiments import sweep
    from flexsheet.launch.methods.configurations import NODE_DEFAULTS, Configuration

    latencies_ms = iter([3.0, 5.0, 4.0])

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        if trial["kind"] == "system":
            return {"exposure_to_arm_ms": {"p95": next(latencies_ms)}}
        return {"proposal": {"sheet_mm": {"p95": 0.5}}}

    monkeypatch.setattr(sweep, "execute_trial", execute)
    monkeypatch.setattr(Configuration, "prepare", lambda *_: None)
    configuration = Configuration("proposal", NODE_DEFAULTS)
    silent: Callable[[str], None] = lambda text: None  # noqa: E731
    scene_file = SCENES / "light-touch.yaml"
    found = tune_system.run_proposal(scene_file, configuration, tmp_path, silent, runs=3)
    assert found == pytest.approx({SHEET: 0.5, TO_ARM: 5.0})


def test_a_shipped_scene_keeps_its_choice_and_an_interrupted_tuning_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tune light-touch.yaml with simulated strokes; one fails, and the next command repeats it."""
    from flexsheet.launch.experiments import sweep
    from flexsheet.launch.experiments.sweep import TrialError
    from flexsheet.launch.methods.configurations import Configuration
    from flexsheet.launch.methods.tune import TUNABLES

    scene_file = SCENES / "light-touch.yaml"
    scene = load_scene(scene_file)
    horizons = [{HORIZON_MS: 0}, {HORIZON_MS: 50}]
    choices = []
    for one in TUNABLES:
        setting = getattr(scene.methods, one.key)
        cases = {"cases": horizons} if one.name == "tracking" else {}
        evaluations = [
            *evaluate(str(setting), 0.1, 1e-5, **cases),
            *evaluate("another", 0.01, 1e-3, **cases),
        ]
        evaluations[0] = replace(evaluations[0], setting=setting)
        choices.append(Choice(one.name, one.key, "mm", 1.0, evaluations[0], tuple(evaluations)))
    (tracking,) = (one for one in choices if one.family == "tracking")
    limits = tune_system.list_tolerances(scene)
    ran: list[Mapping[str, Any]] = []

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        ran.append(trial)
        if len(ran) == 2:
            raise TrialError("interrupted")
        figures = {one.value: {"p95": 0.5 * limit} for one, limit in limits.items()}
        return figures if trial["kind"] == "system" else {"proposal": figures}

    monkeypatch.setattr(sweep, "execute_trial", execute)
    monkeypatch.setattr(Configuration, "prepare", lambda *_: None)
    monkeypatch.setattr(tune_system, "measure_tracking", lambda *_: tracking.evaluations)

    def tune() -> tuple[Any, tuple[Choice, ...]]:
        composition, chosen = tune_system.tune_system(
            scene_file, choices, tmp_path, lambda text: None, margin=0.2, runs=3,
        )  # fmt: skip
        return composition, tuple(chosen)

    failed = f"a run failed: interrupted; see .*{scene.methods.marker}"
    with pytest.raises(ExperimentError, match=failed):
        tune()
    assert len(ran) == 4
    for _ in range(2):
        composition, chosen = tune()
        assert len(ran) == 5
        assert composition.accepted
        for choice in chosen:
            assert choice.chosen.setting == getattr(scene.methods, choice.key)
