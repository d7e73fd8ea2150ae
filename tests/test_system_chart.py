"""Test the chart of the system: statistics with known answers, errors of known motions, a sweep."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.experiments import ExperimentError, stroke, sweep, system_errors, system_run
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.experiments.sweep import TrialError
from flexsheet.launch.experiments.true_geometry import place_edges
from flexsheet.launch.methods import system_chart
from flexsheet.launch.methods.blocks import (
    attribute_error,
    bootstrap_median,
    compare_paired,
    find_front,
    order_blocks,
)
from flexsheet.launch.methods.configurations import (
    CONTROL,
    CONTROL_AGAIN,
    FINEST,
    PAPER,
    choose_cheapest,
    list_configurations,
    select_configurations,
)
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene
from flexsheet.nodes.methods import Interval
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.paths import map_to_surface, touchable
from tests.waiting import wait_until

Floats = NDArray[np.float64]

SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"
LIGHT = SCENES / "light-touch.yaml"


def test_every_block_has_each_configuration_once_in_another_order() -> None:
    blocks = order_blocks(["a", "b", "c", "d"], 20, seed=1)
    assert all(sorted(block) == ["a", "b", "c", "d"] for block in blocks)
    assert len({tuple(block) for block in blocks}) > 5
    assert blocks == order_blocks(["a", "b", "c", "d"], 20, seed=1)


def test_the_interval_of_a_median_covers_it_and_shrinks_with_blocks() -> None:
    random = np.random.default_rng(3)
    few, many = (bootstrap_median(10.0 + random.standard_normal(n)) for n in (8, 400))
    assert few is not None
    assert many is not None
    assert many.low < 10.0 < many.high
    assert many.high - many.low < 0.5 * (few.high - few.low)


def test_95_percent_of_the_intervals_cover_the_median() -> None:
    random = np.random.default_rng(4)
    found = [bootstrap_median(random.standard_normal(25)) for _ in range(60)]
    covered = np.mean([one is not None and one.low <= 0.0 <= one.high for one in found])
    assert 0.85 <= covered <= 1.0


def test_failed_runs_do_not_count_and_one_run_has_no_interval() -> None:
    assert bootstrap_median(np.array([np.nan, np.nan])) is None
    one = bootstrap_median(np.array([2.0, np.nan]))
    assert one == Interval(2.0, -np.inf, np.inf)


def test_paired_ratios_cancel_what_is_common_to_a_block() -> None:
    random = np.random.default_rng(5)
    drift = np.exp(2.0 * random.standard_normal(20))
    noise = np.exp(0.01 * random.standard_normal((2, 20)))
    ratio = compare_paired(1.25 * drift * noise[0], drift * noise[1])
    assert ratio is not None
    assert ratio.low < 1.25 < ratio.high
    assert ratio.high / ratio.low < 1.05
    same = compare_paired(drift * noise[0], drift * noise[1])
    assert same is not None
    assert same.low < 1.0 < same.high


def test_the_stages_of_an_error_add_up_to_all_of_it() -> None:
    random = np.random.default_rng(6)
    independent = random.standard_normal((3, 4000, 3)) * np.array([1.0, 2.0, 3.0])[:, None, None]
    shares = attribute_error(independent)
    assert shares.sum() == pytest.approx(1.0)
    assert shares == pytest.approx(np.array([1.0, 4.0, 9.0]) / 14.0, abs=0.03)
    cancelling = np.stack([independent[0], -0.5 * independent[0]])
    assert attribute_error(cancelling) == pytest.approx([2.0, -1.0])
    assert attribute_error(np.zeros((2, 5, 3))).tolist() == [0.0, 0.0]


def test_the_front_excludes_what_is_worse_by_more_than_the_spread() -> None:
    def near(value: float) -> Interval:
        return Interval(value, value - 0.1, value + 0.1)

    points = {
        "fast": [near(1.0), near(3.0)],
        "exact": [near(3.0), near(1.0)],
        "slow": [near(3.0), near(3.0)],
        "as fast, within the spread": [near(1.15), near(3.15)],
    }
    assert find_front(points) == ["fast", "exact", "as fast, within the spread"]
    unknown = Interval(9.0, -np.inf, np.inf)
    assert find_front({"a": [near(1.0)], "b": [unknown]}) == ["a", "b"]


def make_recording(
    scene: Scene, offset_m: float, control_m: float, arms_m: float
) -> tuple[stroke.StrokeRecording, NDArray[np.int64]]:
    """Make a finger at the front of a plane, with a constant error along x or z of each stage.

    offset_m: the measured finger is that much to the right. control_m: the arms hold the sheet that
    much too far from the user. arms_m: the true arms hold it that much nearer.
    """
    times = np.arange(0, 1_000_000_000, 16_000_000, dtype=np.int64)

    def fixed(values: Floats) -> stroke.SampledMotion:
        return stroke.SampledMotion(times, np.tile(values, (len(times), 1)))

    def edges(z_m: float) -> tuple[stroke.SampledMotion, stroke.SampledMotion]:
        poses = place_edges(transform(np.eye(3), np.array([0.0, 0.0, z_m])), 0.25)
        left, right = (fixed(stroke.make_edge_row(pose, np.eye(4))) for pose in poses)
        return left, right

    finger = np.array([0.01, 0.0, 0.0])
    return stroke.StrokeRecording(
        scene=scene,
        fingertip=fixed(finger + np.array([offset_m, 0.0, 0.0])),
        measured=fixed(finger),
        finger=fixed(finger),
        windows_ns={},
        measured_edges=edges(-control_m),
        true_edges=edges(-control_m + arms_m),
        delays_s={},
        drops=0,
    ), times


def test_the_sheets_error_is_split_into_its_stages() -> None:
    scene = load_scene(SCENES / "plane.yaml")
    upright = scene.object.world_from_object.model_copy(update={"rpy_rad": np.zeros(3)})
    turned = scene.object.model_copy(update={"world_from_object": upright})
    scene = scene.model_copy(update={"object": turned})
    recording, times = make_recording(scene, 0.002, 0.001, 0.0004)
    level = stroke.SampledMotion(times, np.zeros((len(times), 1)))
    parts = system_errors.split_sheet_error(recording, level.values, times)
    expected = [[-0.002, 0.0, 0.0], [0.0, 0.0, 0.001], [0.002, 0.0, -0.0004]]
    assert parts.mean(axis=1) == pytest.approx(np.array(expected), abs=1e-9)
    assert parts.sum(axis=0)[0] == pytest.approx([0.0, 0.0, 0.0006], abs=1e-9)
    lowered = stroke.SampledMotion(times, np.full((len(times), 1), 0.001))
    whole = system_errors.split_sheet_error(recording, lowered.values, times).sum(axis=0)
    assert whole[0] == pytest.approx([0.0, 0.0, -0.0004], abs=1e-9)


@pytest.mark.parametrize("name", ["light-touch", "plane"])
def test_the_stroke_stays_on_the_object_within_the_scenes_speed(name: str) -> None:
    scene = load_scene(SCENES / f"{name}.yaml")
    path = system_errors.make_stroke(scene, 6.0)
    touching = path.positions_world_m[1:-1]
    speeds = np.linalg.norm(np.diff(touching, axis=0), axis=1) / system_errors.SAMPLE_S
    assert speeds.max() <= 1.05 * scene.working_range.speed_m_per_s
    half_m = 0.5 * touchable(scene)[1]
    front = map_to_surface(scene, np.array([[0.0, 0.0, 0.0]]))[0]
    assert np.linalg.norm(touching - front, axis=1).max() <= 1.02 * half_m
    assert np.all(np.diff(path.times_s) > 0.0)


def test_processes_with_several_nodes_count_once() -> None:
    import os

    found = system_run.read_cpu_s({"planner": os.getpid(), "bridge": os.getpid()})
    assert list(found) == ["bridge+planner"]
    assert found["bridge+planner"] > 0.0


def test_the_cheapest_methods_are_those_whose_range_contains_the_scene() -> None:
    light = choose_cheapest(load_scene(LIGHT))
    deep = choose_cheapest(load_scene(SCENES / "cylinder.yaml"))
    assert (light.correction, deep.correction) == ("four_triangles", "two_pass")
    assert light.soft_body is not None
    assert deep.soft_body is not None
    assert (light.soft_body.method, deep.soft_body.method) == ("linear", "nonlinear_table")
    assert light.tracking == "one_euro"  # a finger that moves is out of the range of none


def test_a_scene_without_choices_is_tuned_to_the_defaults() -> None:
    scene = load_scene(SCENES / "cylinder.yaml").model_copy(update={"methods": Methods()})
    names = [one.name for one in list_configurations(scene)]
    assert "default" not in names
    assert len(names) == 4
    scene = load_scene(LIGHT)
    assert [one.name for one in select_configurations(scene, ["paper"])] == ["paper", CONTROL]
    with pytest.raises(ExperimentError, match="unknown configuration"):
        select_configurations(scene, ["papers"])


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> system_chart.SceneTrials:
    """Return the trials of all configurations of a scene."""
    folder = tmp_path_factory.mktemp("system")
    return system_chart.plan_trials(LIGHT, folder, blocks=12, seconds=3.0, apparatuses=3)


def test_a_configuration_sets_the_methods_of_all_nodes(planned: system_chart.SceneTrials) -> None:
    names = [name for _, name in planned.places.values()]
    assert len(names) == 12 * 6  # five configurations and the control again
    assert names.count(CONTROL) == names.count(CONTROL_AGAIN) == 12
    trial = planned.trials["block-001-most-exact"]
    errors = planned.trials["errors-100"]
    assert errors["apparatus"] == "seed:100,modern,calibrated"
    assert planned.trials[system_chart.NOMINAL]["apparatus"] is None
    assert errors["configurations"]["paper"]["planner"] == {"prediction_horizon_s": 0.0}
    graph = load_graph(Path(trial["launch_file"]), settings=trial["settings"])
    assert graph.scene is not None
    assert graph.scene["name"] == "light-touch"
    assert graph.nodes["triangulator"].parameters["tracking"] == FINEST.tracking
    assert graph.nodes["fem_solver"].parameters["method"] == "nonlinear_table"
    assert graph.nodes["planner"].parameters["sheet_force"] == "table"


def make_row(
    arm_ms: float, sheet_mm: float, *, cores: float = 1.0, light_ms: float = 40.0
) -> dict[str, Any]:
    """Make the row of a trial with these 95 % values; image, force and fingertip are fixed."""

    def latency(p50: float) -> dict[str, float]:
        return {"p50": p50, "p95": 1.1 * p50, "p99": 1.2 * p50}

    def error(p95: float) -> dict[str, float]:
        return {"mean": 0.5 * p95, "p95": p95, "max": 2.0 * p95}

    return {
        "cpu_cores": cores,
        "cpu_cores_by_node": {"planner": 0.25 * cores, "renderer": 0.75 * cores},
        "exposure_to_arm_ms": latency(arm_ms),
        "exposure_to_light_ms": latency(light_ms),
        "sheet_mm": error(sheet_mm),
        "image_mm": error(0.2),
        "force_percent": error(5.0),
        "fingertip_mm": error(0.1),
        "budget": {"fingertip": 0.7, "planner and arms": 0.4, "geometry of the arms": -0.1},
        "drops": 0,
    }


FIGURES = {
    "paper": (10.0, 3.0, 0.8),
    "cheapest in range": (10.0, 0.8, 0.8),
    "default": (13.0, 0.7, 1.4),
    CONTROL: (11.0, 0.5, 1.0),
    CONTROL_AGAIN: (11.0, 0.5, 1.0),
    "most exact": (40.0, 0.1, 2.0),
}
"""Latency to the arm (ms), sheet error (mm) and cores of each configuration; tolerances of the
scene are 15 ms and 1 mm."""


def simulate_trials(planned: system_chart.SceneTrials) -> dict[str, dict[str, Any]]:
    """Return rows whose blocks differ by a common factor, and whose runs differ by 1 %."""
    random = np.random.default_rng(7)
    drift = np.exp(0.05 * random.standard_normal(100))
    rows = {}
    for trial, (block, name) in planned.places.items():
        arm_ms, sheet_mm, cores = FIGURES[name]
        noise = np.exp(0.01 * random.standard_normal(3))
        rows[trial] = make_row(
            arm_ms * drift[block] * noise[0], sheet_mm * noise[1], cores=cores * noise[2]
        )
    errors = {name: make_row(1.0, sheet_mm) for name, (_, sheet_mm, _) in FIGURES.items()}
    return rows | {name: errors for name in planned.trials if name.startswith("errors-")}


def test_points_have_the_figures_their_spread_and_a_verdict(
    planned: system_chart.SceneTrials,
) -> None:
    points = {
        one["configuration"]: one
        for one in system_chart.summarize_scene(planned, simulate_trials(planned))
    }
    assert list(points) == [
        "paper",
        "cheapest in range",
        "default",
        CONTROL,
        "most exact",
        CONTROL_AGAIN,
    ]
    for name, (arm_ms, sheet_mm, cores) in FIGURES.items():
        assert points[name]["exposure_to_arm_ms"]["p50"] == pytest.approx(arm_ms, rel=0.1)
        assert points[name]["sheet_mm"] == pytest.approx(sheet_mm, rel=0.02)
        assert points[name]["cpu_cores"] == pytest.approx(cores, rel=0.02)
        spread = points[name]["spread"]["sheet_mm.p95"]
        assert spread["low"] <= points[name]["sheet_mm"] <= spread["high"]
    met = {name: point["failing"] for name, point in points.items()}
    assert met["paper"] == ["sheet_mm.p95"]
    assert met["most exact"] == ["exposure_to_arm_ms.p95"]
    assert met["cheapest in range"] == met[CONTROL] == []
    ratio = points["default"]["ratio_to_control"]["exposure_to_arm_ms.p50"]
    assert ratio["low"] < 13.0 / 11.0 < ratio["high"]
    noise = points[CONTROL_AGAIN]["ratio_to_control"]["exposure_to_arm_ms.p50"]
    assert noise["low"] < 1.0 < noise["high"]
    assert points[CONTROL]["random_apparatuses"]["runs"] == 3
    assert points[CONTROL]["random_apparatuses"]["within_tolerances"] == 3
    front = system_chart.find_system_front(list(points.values()))
    assert "paper" not in front  # as fast as the cheapest, and less exact
    assert "most exact" in front


def test_a_latency_that_is_within_its_tolerance_by_less_than_its_spread_fails() -> None:
    scene = load_scene(LIGHT)
    latencies = np.linspace(11.0, 15.5, 9)
    rows = {CONTROL: {block: make_row(value, 0.5) for block, value in enumerate(latencies)}}
    point = system_chart.summarize_configuration(scene, CONTROL, rows, make_row(1.0, 0.5), [])
    assert point["exposure_to_arm_ms"]["p95"] < 15.0
    assert point["failing"] == ["exposure_to_arm_ms.p95"]


def test_a_graph_without_image_or_force_has_no_error_of_them() -> None:
    scene = load_scene(LIGHT)
    absent = {"image_mm": None, "force_percent": None, "exposure_to_light_ms": None}
    row = make_row(9.0, 0.5) | absent
    rows = {CONTROL: dict.fromkeys(range(3), row)}
    point = system_chart.summarize_configuration(scene, CONTROL, rows, row, [])
    assert point["meets_tolerances"]
    assert point["image_mm"] is point["force_percent"] is point["exposure_to_light_ms"] is None


@pytest.mark.long
def test_methods_change_the_errors_of_the_stages_that_they_belong_to() -> None:
    scene = load_scene(SCENES / "rigid-plane.yaml")
    calibrations = NodeCalibrations.of(load_graph(DEMO_FILE))
    errors = system_errors.ErrorEvaluator(
        scene, nominal_apparatus(scene), calibrations, seconds=0.7, seed=3
    )
    exact, paper = (errors.evaluate(one, {}) for one in (FINEST, PAPER))
    assert exact["image_mm"] is exact["force_percent"] is None
    assert exact["fingertip_mm"]["p95"] < 0.5 * paper["fingertip_mm"]["p95"]
    assert errors.evaluate(FINEST, {}) == exact


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, Any]]:
    """Substitute the processes of the trials; return the descriptions of those that ran."""
    ran: list[Mapping[str, Any]] = []

    def execute(trial: Mapping[str, Any]) -> dict[str, Any]:
        ran.append(trial)
        if len(ran) == 3:
            raise TrialError("the node planner has ended")
        row = make_row(10.0, 0.5)
        return row if trial["kind"] == "system" else dict.fromkeys(("paper", CONTROL), row)

    monkeypatch.setattr(sweep, "execute_trial", execute)
    monkeypatch.setattr(
        "flexsheet.launch.methods.configurations.Configuration.prepare", lambda *_: None
    )
    return ran


def run_chart(folder: Path, *options: str) -> dict[str, Any]:
    arguments: Sequence[str] = ["--blocks", "2", "--apparatuses", "1", "--configuration", "paper"]
    command = ["chart", "system", "--scene", str(LIGHT), "-o", str(folder), "--json"]
    found = CliRunner().invoke(app, [*command, *arguments, *options])
    assert found.exit_code == 0, found.output
    return dict(json.loads(found.stdout))


def test_the_command_draws_the_chart_and_continues(
    tmp_path: Path, trials: list[Mapping[str, Any]]
) -> None:
    first = run_chart(tmp_path)
    assert len(trials) == 8  # errors with two apparatuses, two blocks of three runs
    assert [one["configuration"] for one in first["points"]] == ["paper", CONTROL, CONTROL_AGAIN]
    (failure,) = first["failed"]
    assert failure["error"] == "the node planner has ended"
    keys = {
        "scene", "configuration", "cpu_cores", "exposure_to_arm_ms", "exposure_to_light_ms",
        "sheet_mm", "image_mm", "force_percent", "fingertip_mm", "meets_tolerances",
    }  # fmt: skip
    assert all(keys <= set(point) for point in first["points"])
    assert "<svg" in (tmp_path / "system.svg").read_text()
    assert json.loads((tmp_path / "system.json").read_text()) == first
    again = run_chart(tmp_path)
    assert len(trials) == 9  # only the failed trial ran again
    assert again["failed"] == []


def test_a_stopped_trial_leaves_no_worker_that_holds_its_pipes() -> None:
    import subprocess
    import sys

    child = "import subprocess, sys; print(subprocess.Popen(['sleep', '1000']).pid, flush=True); "
    process = subprocess.Popen(
        [sys.executable, "-c", child + "import time; time.sleep(1000)"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    sweep._end(process)
    assert process.returncode is not None
    wait_until(lambda: not _is_running(worker), "the worker to end")


def _is_running(pid: int) -> bool:
    import psutil

    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


@pytest.mark.parametrize(("scene", "expected"), [("cylinder", [0.0045]), ("rigid-plane", [])])
def test_the_table_of_the_soft_body_is_computed_before_its_configuration_runs(
    scene: str, expected: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[float] = []
    where = "flexsheet.launch.methods.configurations"
    for name in ("precompute_deflection_shapes", "precompute_force_table"):
        monkeypatch.setattr(f"{where}.{name}", lambda *_: None)
    monkeypatch.setattr(
        f"{where}.precompute_soft_body", lambda _, spacing_m, *others: computed.append(spacing_m)
    )
    (finest,) = [
        one
        for one in list_configurations(load_scene(SCENES / f"{scene}.yaml"))
        if one.name == "most exact"
    ]
    finest.prepare(load_scene(SCENES / f"{scene}.yaml"), lambda text: None)
    assert computed == expected
