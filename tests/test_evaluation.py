"""Test the evaluation of apparatuses: sweeps, offline errors, and the bound of the error."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.experiments import (
    ExperimentError,
    robustness,
    select_names,
    sensitivity,
    sweep,
)
from flexsheet.launch.experiments.follow import (
    LimitedMotion,
    bound_errors,
    find_least_deviation,
)
from flexsheet.launch.experiments.offline import (
    CROSS_RATIOS,
    Evaluation,
    Metric,
    NodeCalibrations,
    OfflineEvaluator,
    exceeded_tolerances,
)
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.experiments.sweep import TrialError, execute_trial, run_sweep
from flexsheet.launch.experiments.trial import read_flags, run_sensitivity_trial
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import SelfCheck, Status, SuspectedCause
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.paths import touchable
from flexsheet.nodes.twin.tolerance_table import NOT_SIMULATED, Profile, load_tolerances
from tests.indentation_bases import few_dents

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "launch" / "demo.yaml"
FINGERTIP = frozenset({Metric.FINGERTIP})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(ROOT / "launch" / "scenes" / "cylinder.yaml")


@pytest.fixture(scope="module")
def evaluator(scene: Scene) -> OfflineEvaluator:
    """Return the evaluator with the calibration of the demo's camera."""
    return OfflineEvaluator(scene, NodeCalibrations.of(load_graph(DEMO)))


def changed(scene: Scene, section: str, **values: Any) -> Apparatus:
    """Return the nominal apparatus with other values in one section."""
    nominal = nominal_apparatus(scene)
    content = nominal.model_dump(mode="json")
    content[section] |= values
    return Apparatus.model_validate(content)


def row_of(seed: int) -> dict[str, Any]:
    figures = {"sheet_mm": 0.1 * seed, "sheet_deg": 0.2, "image_mm": 0.3}
    figures |= {"force_percent": 4.0, "fingertip_mm": 0.05}
    return {"seed": seed, **figures, "out_of_tolerance": [], "flagged": []}


# Sweeps


def describe(seeds: range) -> dict[str, dict[str, Any]]:
    return {f"seed-{seed}": {"kind": "fake", "seed": seed} for seed in seeds}


def test_an_interrupted_sweep_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    executed: list[int] = []

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        executed.append(trial["seed"])
        return row_of(trial["seed"])

    def interrupt(text: str) -> None:
        if text.startswith("2 of 5"):
            raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "execute_trial", execute)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(tmp_path, {"seconds": 3}, describe(range(5)), interrupt)
    assert {file.name for file in tmp_path.iterdir()} == {
        "sweep.json",
        "seed-0.json",
        "seed-1.json",
    }
    executed.clear()
    rows = run_sweep(tmp_path, {"seconds": 3}, describe(range(5)), lambda text: None)
    assert executed == [2, 3, 4]
    assert [row["seed"] for row in rows.values()] == [0, 1, 2, 3, 4]
    assert not list(tmp_path.glob("*.part"))


def test_a_failed_trial_is_recorded_and_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes: list[Any] = [TrialError("the arms are out of reach"), row_of(0)]

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return dict(outcome)

    monkeypatch.setattr(sweep, "execute_trial", execute)
    first = run_sweep(tmp_path, {}, describe(range(1)), lambda text: None)
    assert "out of reach" in first["seed-0"]["error"]
    with pytest.raises(ExperimentError, match=r"all 1 trials failed.*out of reach"):
        sweep.raise_if_all_failed(first, tmp_path)
    again = run_sweep(tmp_path, {}, describe(range(1)), lambda text: None)
    assert again["seed-0"]["seed"] == 0


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    sweep.open_sweep(tmp_path, {"profile": "modern", "seconds": 10.0})
    sweep.open_sweep(tmp_path, {"profile": "modern", "seconds": 10.0})
    with pytest.raises(ExperimentError, match=r"profile is 'modern'.* 'paper'.*another --output"):
        sweep.open_sweep(tmp_path, {"profile": "paper", "seconds": 10.0})


def test_progress_names_the_time_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "execute_trial", lambda trial: row_of(trial["seed"]))
    texts: list[str] = []
    run_sweep(tmp_path, {}, describe(range(2)), texts.append)
    assert texts == ["0 of 2 trials: 0 %", *texts[1:-1], "2 of 2 trials: 100 %"]


def test_a_trial_is_a_process_whose_error_comes_back() -> None:
    with pytest.raises(TrialError, match=r"missing\.yaml"):
        execute_trial({"kind": "sensitivity", "launch_file": "missing.yaml", "settings": []})


def test_graphs_of_trials_use_other_ports() -> None:
    first, second = choose_ports(DEMO), choose_ports(DEMO)
    assert len(first) == 4
    nodes = load_graph(DEMO, settings=first).nodes
    arms = nodes["twin_arms"].parameters
    assert nodes["arm_left_bridge"].parameters["port"] == arms["left_port"]
    assert nodes["arm_right_bridge"].parameters["port"] == arms["right_port"] != arms["left_port"]
    assert first != second


# Robustness


def test_seeds_are_parsed() -> None:
    assert robustness.parse_seeds("3-5") == [3, 4, 5]
    assert robustness.parse_seeds("7") == [7]
    assert robustness.apparatus_text(7, Profile.PAPER, calibrated=True) == "seed:7,paper,calibrated"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5-3", "3 is less than 5; give 3-5"),
        ("a-b", "expected A-B"),
        ("0-99999", "more than 10000"),
    ],
)
def test_wrong_seeds_are_refused(text: str, message: str) -> None:
    with pytest.raises(ExperimentError, match=message):
        robustness.parse_seeds(text)


def test_robustness_prints_rows_and_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        row = row_of(trial["seed"])
        return row | ({"out_of_tolerance": ["sheet_mm"]} if trial["seed"] == 3 else {})

    monkeypatch.setattr(sweep, "execute_trial", execute)
    arguments = ["experiment", "robustness", "--seeds", "0-3", "--output", str(tmp_path), "--json"]
    printed = CliRunner().invoke(app, arguments, catch_exceptions=False)
    result = json.loads(printed.stdout)
    assert [row["seed"] for row in result["rows"]] == [0, 1, 2, 3]
    assert set(row_of(0)) <= set(result["rows"][0])
    summary = result["summary"]["sheet_mm"]
    assert summary["median"] == pytest.approx(0.15)
    assert summary["p95"] == pytest.approx(0.285)
    assert (summary["worst"], summary["worst_seed"]) == (pytest.approx(0.3), 3)
    assert (summary["trials"], summary["out_of_tolerance"], summary["not_flagged"]) == (4, 1, 1)
    assert result["out_of_tolerance"] == result["out_of_tolerance_not_flagged"] == [3]
    assert result["measured"]["image_mm"] == "offline"


# Offline evaluation against hand-computed cases


def test_a_shifted_camera_shifts_the_fingertip(scene: Scene, evaluator: OfflineEvaluator) -> None:
    nominal = evaluator.evaluate(nominal_apparatus(scene), FINGERTIP)
    shifted = evaluator.evaluate(
        changed(scene, "camera", position_offset_m=[1e-3, 0.0, 0.0]), FINGERTIP
    )
    assert nominal.fingertip_m is not None
    assert shifted.fingertip_m is not None
    # A camera that is 1 mm further right than believed sees the finger 1 mm further left.
    difference = shifted.fingertip_m - nominal.fingertip_m
    np.testing.assert_allclose(difference, [[-1e-3, 0.0, 0.0]] * len(difference), atol=3e-5)
    assert shifted.change_from(nominal)[Metric.FINGERTIP] == pytest.approx(1.0, abs=0.03)


def test_a_late_stamp_moves_the_fingertip_by_speed_times_time(
    scene: Scene, evaluator: OfflineEvaluator
) -> None:
    speed_m_per_s = scene.working_range.speed_m_per_s
    given = changed(scene, "camera", stamp_offset_s=0.005)
    nominal = evaluator.evaluate(nominal_apparatus(scene), FINGERTIP, speed_m_per_s)
    late = evaluator.evaluate(given, FINGERTIP, speed_m_per_s)
    at_rest = evaluator.evaluate(given, FINGERTIP)
    assert at_rest.change_from(nominal)[Metric.FINGERTIP] < 1e-3
    expected_mm = 1e3 * 0.005 * speed_m_per_s
    assert late.change_from(nominal)[Metric.FINGERTIP] == pytest.approx(expected_mm, rel=0.05)
    measured = OfflineEvaluator(
        scene, replace(NodeCalibrations.of(load_graph(DEMO)), stamp_offset_s=0.005)
    )
    known = measured.evaluate(given, FINGERTIP, speed_m_per_s)
    assert known.change_from(nominal)[Metric.FINGERTIP] == pytest.approx(0.0, abs=1e-9)


def test_crosses_are_seen_where_they_are_touched_unless_the_eyes_are_elsewhere(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A coarse basis, because the full one takes minutes.
    monkeypatch.setattr(deflection_cache, "load_or_compute", lambda *_: few_dents())
    evaluator = OfflineEvaluator(scene, NodeCalibrations.of(load_graph(DEMO)))
    nominal = evaluator.compare_crosses(nominal_apparatus(scene))
    assert nominal.errors_m.shape == (15, 2, 2)
    assert nominal.figures()["max_mm"] < 0.2
    # Eyes 10 mm further right see a point at the depth d behind the screen, and at the distance D
    # from them, 10 mm d / (D + d) further right, but the cross on the sheet almost unmoved.
    moved = evaluator.compare_crosses(changed(scene, "eyes", centre_offset_m=[0.01, 0.0, 0.0]))
    radius_m = require_cylinder(scene).radius_m
    angles = np.repeat(np.array(CROSS_RATIOS), 3) * 0.5 * touchable(scene)[1] / radius_m
    depths_m = radius_m * (1.0 - np.cos(angles))
    expected_m = -0.01 * depths_m / (scene.eyes.centre_world_m[2] + depths_m)
    for eye in (0, 1):
        change_m = moved.errors_m[:, eye] - nominal.errors_m[:, eye]
        np.testing.assert_allclose(change_m[:, 0], expected_m, atol=3e-5)
        np.testing.assert_allclose(change_m[:, 1], 0.0, atol=3e-5)
    wider = evaluator.compare_crosses(changed(scene, "eyes", interocular_offset_m=0.01))
    disparity_m = np.diff(wider.errors_m - nominal.errors_m, axis=1)[:, 0, 0]
    np.testing.assert_allclose(disparity_m, expected_m, atol=3e-5)


def test_the_nominal_sheet_is_tangent_and_a_shifted_pair_of_arms_is_not(
    scene: Scene, evaluator: OfflineEvaluator
) -> None:
    metrics = frozenset({Metric.SHEET})
    nominal = evaluator.evaluate(nominal_apparatus(scene), metrics)
    bases = {side: {"base_position_offset_m": [0.0, 0.0, 1e-3]} for side in ("left", "right")}
    moved = evaluator.evaluate(changed(scene, "arms", **bases), metrics)
    assert nominal.sheet_m is not None
    assert moved.sheet_m is not None
    # At the front the normal is z, so the whole shift is an error; the error is finger minus sheet.
    np.testing.assert_allclose(moved.sheet_m[0] - nominal.sheet_m[0], [0, 0, -1e-3], atol=1e-6)


def test_a_stiffer_sheet_pushes_harder(scene: Scene) -> None:
    metrics = frozenset({Metric.FORCE})
    weightless = scene.model_copy(
        update={"sheet": scene.sheet.model_copy(update={"density_kg_per_m3": 0.0})}
    )
    evaluator = OfflineEvaluator(weightless)
    nominal = evaluator.evaluate(nominal_apparatus(weightless), metrics)
    stiff = evaluator.evaluate(changed(weightless, "sheet", modulus_ratio=1.1), metrics)
    assert nominal.felt_n is not None
    assert stiff.felt_n is not None
    # Without weight, all forces are proportional to the modulus.
    np.testing.assert_allclose(stiff.felt_n, 1.1 * nominal.felt_n, rtol=2e-3)


def test_parallax_is_that_of_points_behind_the_screen(
    scene: Scene, evaluator: OfflineEvaluator
) -> None:
    eye = scene.eyes.centre_world_m
    moved = eye + np.array([0.02, 0.0, 0.0])
    _, points = evaluator._object_points
    shifts = evaluator._parallax(moved)
    row, column = np.argwhere(np.isfinite(shifts[..., 0]))[500]
    depth_m = -points[row, column, 2]
    # By similar triangles: a point behind the screen follows the eye by depth over its distance.
    expected_m = 0.02 * depth_m / (eye[2] + depth_m)
    assert shifts[row, column] == pytest.approx([expected_m, 0.0], abs=1e-12)


def test_figures_are_means_and_root_mean_squares() -> None:
    image = np.full((2, 2, 2), np.nan)
    image[0, 0], image[1, 1] = [3e-3, 4e-3], [0.0, 0.0]
    found = Evaluation(
        fingertip_m=np.array([[3e-3, 4e-3, 0.0]]),
        image_m=(image,),
        felt_n=np.array([1.1, 0.8]),
        expected_n=np.array([1.0, 1.0]),
    ).figures()
    assert found[Metric.FINGERTIP] == pytest.approx(5.0)
    assert found[Metric.IMAGE] == pytest.approx(5.0 / np.sqrt(2.0))
    assert found[Metric.FORCE] == pytest.approx(15.0)
    assert found[Metric.SHEET] is None


def test_tolerances_are_those_of_the_scene(scene: Scene) -> None:
    figures = {"sheet_mm": 0.51, "image_mm": 0.49, "force_percent": 10.1, "fingertip_mm": None}
    assert exceeded_tolerances(scene, figures) == ["sheet_mm", "force_percent"]


# Sensitivity


def test_each_parameter_is_evaluated_or_says_why_not() -> None:
    assert set(load_tolerances()) >= sensitivity.TIMING
    for parameter in load_tolerances():
        found = sensitivity.evaluation_of(parameter)
        assert (found is sensitivity.EvaluationKind.NOT_SIMULATED) == (parameter in NOT_SIMULATED)
        assert parameter.partition(".")[0] in sensitivity.AFFECTED
    found = sensitivity.evaluation_of("arms.*.servo_lag_s")
    assert found is sensitivity.EvaluationKind.SIMULATED_TIME


def test_the_history_of_the_rubber_raises_the_force_inwards_and_lowers_it_outwards() -> None:
    def ratios(**sheet: float) -> np.ndarray:
        given = Apparatus.model_validate({"scene": "cylinder", "sheet": sheet})
        return compute_history_ratios(given)

    np.testing.assert_array_equal(ratios(), 1.0)
    inwards, outwards = ratios(hysteresis_ratio=0.1)
    assert inwards > 1.02
    assert outwards < 0.98
    assert ratios(creep_ratio_per_decade=0.05)[0] > ratios(creep_ratio_per_decade=0.05)[1]


def test_sensitivity_ranks_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lag = "arms.*.servo_lag_s"
    sizes = {"sheet.modulus_ratio": 10.0, "camera.position_offset_m": 0.3, lag: 0.1}

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        assert not trial["with_images"]
        assert bool(trial["stroke_seeds"]) == (trial["parameter"] == lag)
        metrics = ["sheet_mm", "fingertip_mm"] if trial["stroke_seeds"] else trial["metrics"]
        effects = {
            f"{sigma:g}": dict.fromkeys(metrics, abs(sigma) * sizes[trial["parameter"]])
            for sigma in trial["sigmas"]
        }
        return {"parameter": trial["parameter"], "effects": effects}

    monkeypatch.setattr(sweep, "execute_trial", execute)
    options = [f"--parameter={name}" for name in (*sizes, "eyes.sway_m", "finger.hand_mass_kg")]
    arguments = ["experiment", "sensitivity", *options, "--output", str(tmp_path)]
    printed = CliRunner().invoke(app, [*arguments, "--json"], catch_exceptions=False)
    result = json.loads(printed.stdout)
    keys = {"parameter", "sigma", "sheet_mm", "image_mm", "force_percent", "fingertip_mm"}
    assert all(keys <= set(row) for row in result["rows"])
    assert len(result["rows"]) == 5 * 4
    assert [row["parameter"] for row in result["ranking"]] == [
        "sheet.modulus_ratio",
        "camera.position_offset_m",
        lag,
    ]
    assert result["ranking"][0] == {
        "parameter": "sheet.modulus_ratio",
        "share": pytest.approx(20.0),
        "metric": "sheet_mm",
    }
    by_parameter = {row["parameter"]: row for row in result["rows"]}
    assert by_parameter["sheet.modulus_ratio"]["fingertip_mm"] == 0.0
    assert by_parameter[lag]["evaluation"] == "simulated_time"
    assert by_parameter[lag]["image_mm"] is None
    assert by_parameter["eyes.sway_m"]["evaluation"] == "not_measured"
    assert by_parameter["finger.hand_mass_kg"]["evaluation"] == "not_simulated"


def test_parameters_that_matter_in_motion_are_evaluated_in_simulated_time() -> None:
    trial = {
        "launch_file": str(DEMO_FILE),
        "settings": [],
        "profile": "modern",
        "calibrated": True,
        "sigmas": [3.0],
        "metrics": [],
        "stroke_seeds": [0],
        "with_images": False,
        "seconds": 2.0,
    }

    def effects(parameter: str) -> dict[str, float]:
        found = run_sensitivity_trial(trial | {"parameter": parameter})["effects"]["3"]
        assert isinstance(found, dict)
        return found

    lag, tremor = effects("arms.*.servo_lag_s"), effects("finger.tremor_rms_m")
    assert lag["sheet_mm"] != 0.0
    assert lag["fingertip_mm"] == 0.0  # both apparatuses have the same random numbers
    assert tremor["sheet_mm"] > 0.02


def test_an_unknown_parameter_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"sheet\.modulus_ration.*sheet\.modulus_ratio"):
        select_names(["sheet.modulus_ration"], load_tolerances(), "parameter")


# The bound of a followed finger


def test_the_bound_of_a_jump_is_that_of_a_limited_speed() -> None:
    """A jump S at a limited speed v costs the area S^2 / 4 v: half before, half after the jump."""
    step_s, speed, jump = 0.01, 0.1, 0.02
    times = np.arange(0.0, 1.0, step_s)
    wanted = np.where(times < 0.5, 0.0, jump)
    motion = LimitedMotion(
        values=wanted[:, None],
        slopes=np.ones((len(times), 1, 1)),
        max_rate=np.array([speed]),
        max_acceleration=np.array([np.inf]),
        low=np.array([-np.inf]),
        high=np.array([np.inf]),
    )
    found = find_least_deviation(motion, np.ones(len(times)), step_s, max_deviation=0.1)
    assert found is not None
    assert found.sum() * step_s == pytest.approx(jump**2 / (4.0 * speed), rel=0.02)
    assert found.max() == pytest.approx(0.5 * jump, abs=speed * step_s)


def test_the_bound_of_a_limited_range_is_what_lies_beyond() -> None:
    wanted = np.linspace(0.0, 0.03, 31)
    motion = LimitedMotion(
        values=wanted[:, None],
        slopes=np.ones((31, 1, 1)),
        max_rate=np.array([np.inf]),
        max_acceleration=np.array([np.inf]),
        low=np.array([-0.02]),
        high=np.array([0.02]),
    )
    found = find_least_deviation(motion, np.ones(31), 0.01, max_deviation=0.1)
    np.testing.assert_allclose(found, np.maximum(wanted - 0.02, 0.0), atol=1e-9)


def stroke_points(scene: Scene, angles: np.ndarray) -> np.ndarray:
    radius = require_cylinder(scene).radius_m
    return np.column_stack(
        [np.zeros_like(angles), radius * np.sin(angles), radius * (np.cos(angles) - 1.0)]
    )


def test_arms_follow_a_slow_stroke_and_not_a_jump(scene: Scene) -> None:
    times = np.arange(0.0, 2.0, 1.0 / 60.0)
    slow = bound_errors(scene, times, stroke_points(scene, 0.2 * times))
    assert slow["mean"] == pytest.approx(0.0, abs=1e-6)
    assert slow["windows_without_solution"] == slow["steps_out_of_reach"] == 0
    jump = bound_errors(scene, times, stroke_points(scene, np.where(times < 1.0, -0.3, 0.3)))
    assert 0.1 < jump["mean"] < jump["p95"] < 0.6e3 * require_cylinder(scene).radius_m


def test_a_path_without_contact_has_no_bound(scene: Scene) -> None:
    times = np.arange(0.0, 0.5, 1.0 / 60.0)
    above = stroke_points(scene, 0.1 * times) + np.array([0.0, 0.0, 0.05])
    with pytest.raises(ExperimentError, match="never touches"):
        bound_errors(scene, times, above)


def test_suspected_causes_are_read_from_the_status_messages(tmp_path: Path) -> None:
    def check(cause: SuspectedCause, *, suspected: bool) -> SelfCheck:
        return SelfCheck(
            cause=cause, unit="m", value=2e-3, expected=0.0, threshold=1e-3, suspected=suspected
        )

    checks = [
        (),
        (check("camera_moved", suspected=True), check("marker_offset", suspected=False)),
        (check("servo_lag", suspected=True), check("camera_moved", suspected=True)),
    ]
    bag = tmp_path / "a.mcap"
    with BagWriter(bag, {}) as writer:
        for number, found in enumerate(checks, start=1):
            status = Status(
                node="planner", state="running", pid=1, uptime_s=1.0, cpu_ratio=0.1,
                resident_bytes=1, inputs=(), outputs=(), errors=0, last_error="",
                plan_hash="plan", self_checks=found,
            )  # fmt: skip
            at_ns = 1_000_000_000 * number
            header = Header(number, at_ns, at_ns, "clock", "planner", 1, "plan")
            writer.write(TOPICS["status"], status, header, at_ns)
    assert read_flags(bag) == ["camera_moved", "servo_lag"]
