"""Test the commissioning of a laboratory: its steps, state, report and command."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch import cli
from flexsheet.launch.calibration.arm_poses import SimulatedArm, make_lens_rig
from flexsheet.launch.calibration.commission import (
    CommissionError,
    Commissioning,
    NodeValue,
    StepName,
    StepResult,
    list_doubts,
)
from flexsheet.launch.calibration.commission_steps import (
    BOARD,
    INSTRUCTIONS,
    Laboratory,
    describe_sheet,
    open_laboratory,
)
from flexsheet.launch.calibration.delays import DelaysError, MeasuredLag, read_measured_lags
from flexsheet.launch.calibration.hand_eye import BoardDetection, CornerView, calibrate_base
from flexsheet.launch.calibration.prediction import Knowledge, PredictedError, draw_apparatus
from flexsheet.launch.calibration.sheet_rows import simulate_rows
from flexsheet.launch.calibration.touches import simulate_touches
from flexsheet.launch.commands import capture
from flexsheet.launch.commands.calibrate_rows import make_marker_calibration as fit_marker
from flexsheet.launch.commands.calibrate_rows import make_sheet_calibration as fit_sheet
from flexsheet.launch.commands.output import NOT_GOOD
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.robustness import summarize_commissioning
from flexsheet.launch.experiments.stroke import SampledMotion, apply_compliance
from flexsheet.launch.experiments.trial import run_robustness_trial
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, identify_scene, nominal_apparatus
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.marker_calibration import MarkerCalibration
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import ArmState
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_vector,
    transform,
    transform_from_rpy,
    vector_from_rotation,
)
from flexsheet.nodes.twin import projector as twin_projector
from flexsheet.nodes.twin.rig import make_true_camera, pixels_of
from flexsheet.nodes.twin.tolerance_table import sample_apparatus
from flexsheet.nodes.twin.truth import align_world_to_camera, apply_apparatus
from tests.arm_states import arm_state
from tests.rv_1a import CENTRE_RAD

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "launch" / "demo.yaml"
SCENE_FILE = ROOT / "launch" / "scenes" / "cylinder.yaml"
OPTICS = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"
SCENE = load_scene(SCENE_FILE)
OVERLOADED = (
    "the computer was overloaded during the verification; repeat it on an idle computer "
    "(--step verification)"
)
PREDICTED = {"typical": 0.3, "limit_95": 0.45, "tolerance": 0.5, "within": True}


def matrix(pose: Any) -> Floats:
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def changed(section: str, **values: Any) -> Apparatus:
    given = nominal_apparatus(SCENE).model_dump(mode="json")
    for key, value in values.items():
        if isinstance(value, dict):
            given[section][key] |= value
        else:
            given[section][key] = value
    return Apparatus.model_validate(given)


# The world frame of the camera


def test_the_camera_defines_the_world_and_the_hardware_stays_the_same() -> None:
    drawn = sample_apparatus(SCENE, 5)
    aligned = align_world_to_camera(SCENE, drawn)
    before, after = apply_apparatus(SCENE, drawn), apply_apparatus(SCENE, aligned)
    assert matrix(after.camera.world_from_left) == pytest.approx(
        matrix(SCENE.camera.world_from_left), abs=1e-12
    )
    assert before.projector is not None
    assert after.projector is not None
    for pose in (
        lambda scene: scene.arms.left.world_from_base,
        lambda scene: scene.arms.right.world_from_base,
        lambda scene: scene.projector.world_from_projector,
    ):
        relative = [
            inverse(matrix(one.camera.world_from_left)) @ matrix(pose(one))
            for one in (before, after)
        ]
        assert relative[0] == pytest.approx(relative[1], abs=1e-9)
    eyes = [
        apply(inverse(matrix(one.camera.world_from_left)), one.eyes.centre_world_m[None])
        for one in (before, after)
    ]
    assert eyes[0] == pytest.approx(eyes[1], abs=1e-9)
    assert aligned.sheet == drawn.sheet


def test_a_camera_at_its_nominal_pose_changes_nothing() -> None:
    given = changed("arms", left={"base_position_offset_m": [1e-3, 2e-3, 0.0]})
    aligned = align_world_to_camera(SCENE, given)
    assert aligned.arms.left.base_position_offset_m == pytest.approx((1e-3, 2e-3, 0.0), abs=1e-12)


# Simulated observations


def test_the_simulated_board_is_seen_by_the_camera_of_the_apparatus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = changed("camera", left={"focal_ratio": 1.01}, right_position_offset_m=[1e-3, 0.0, 0.0])
    cameras = []

    class Board:
        def __init__(self, camera: Any, *_: Any, **__: Any) -> None:
            cameras.append(camera)

        def poses(self, count: int) -> list[Floats]:
            return []

    monkeypatch.setattr("flexsheet.nodes.twin.board.TwinBoard", Board)
    assert not list(capture.simulate_views(SCENE, BOARD, given, pairs=1, seed=1))
    nominal = make_true_camera(SCENE.camera)
    assert cameras[0].left.fx_px == pytest.approx(1.01 * nominal.left.fx_px)
    moved = cameras[0].right_from_left[:3, 3] - nominal.right_from_left[:3, 3]
    assert moved[0] == pytest.approx(-1e-3, abs=1e-5)


def test_the_arm_of_an_apparatus_is_found_within_the_stated_uncertainty() -> None:
    """The corners are exact but for noise; backlash is the error of the arm."""
    given = changed(
        "arms",
        left={
            "base_position_offset_m": [2e-3, -1e-3, 1e-3],
            "base_rotation_offset_rad": [2e-3, 1e-3, -3e-3],
            "backlash_rad": 4e-4,
        },
    )
    arm = SimulatedArm(SCENE, "left", given, seed=3)
    assert arm.world_from_base == pytest.approx(
        matrix(apply_apparatus(SCENE, given).arms.left.world_from_base)
    )
    rig, random = make_lens_rig(SCENE, None), np.random.default_rng(4)
    grid = np.mgrid[:7, :5].T.reshape(-1, 2) * 0.015
    corners = np.concatenate([grid, np.zeros((35, 1))], axis=1)
    held = arm.place_flange(CENTRE_RAD, exact=True)
    facing = rig.world_from_left[:3, :3]
    middle = held[:3, 3] + 0.06 * held[:3, 2]
    flange_from_board = inverse(held) @ transform(facing, middle - facing @ corners.mean(axis=0))
    detections = []
    for number in range(14):
        joints = CENTRE_RAD + random.normal(0.0, 0.15, 6)
        left_from_board = (
            inverse(rig.world_from_left) @ arm.place_flange(joints) @ flange_from_board
        )
        views = []
        for lens, eye in (
            (SCENE.camera.left, np.eye(4)),
            (SCENE.camera.right, SCENE.camera.right_from_left),
        ):
            in_eye = apply(eye @ left_from_board, corners)
            pixels = pixels_of(lens, in_eye[:, :2] / in_eye[:, 2:])
            views.append(CornerView(corners, pixels + random.normal(0.0, 0.05, pixels.shape)))
        detections.append(BoardDetection(f"pose {number}", joints, *views))
    fit = calibrate_base(detections, rig)
    error = arm.world_from_base @ inverse(fit.world_from_base)
    std_m, std_rad = fit.compute_std(np.zeros(3))
    assert np.linalg.norm(error[:3, 3]) < 3.0 * std_m < 2e-3
    assert np.linalg.norm(vector_from_rotation(error[:3, :3])) < 3.0 * std_rad < 3e-3


def test_joint_offsets_of_an_apparatus_turn_the_true_flange() -> None:
    offsets = [0.0, 0.0, 0.0, 0.0, 0.0, 0.01]
    arms = [
        SimulatedArm(SCENE, "right", one, seed=1)
        for one in (nominal_apparatus(SCENE), changed("arms", right={"joint_offsets_rad": offsets}))
    ]
    flanges = [arm.place_flange(CENTRE_RAD, exact=True) for arm in arms]
    turned = vector_from_rotation(flanges[0][:3, :3].T @ flanges[1][:3, :3])
    assert np.abs(turned) == pytest.approx([0.0, 0.0, 0.01], abs=1e-9)


def test_a_stiffer_sheet_is_identified_from_pushes_between_the_true_arms() -> None:
    """The clamps slip, and hysteresis gives one row for each direction."""
    given = changed(
        "sheet",
        modulus_ratio=1.2,
        slack_width_offset_m=5e-4,
        hysteresis_ratio=0.1,
        density_kg_per_m3=0.0,
    )
    reduced = SCENE.model_copy(
        update={"working_range": SCENE.working_range.model_copy(update={"push_depth_m": 0.012})}
    )
    rows = simulate_rows(reduced, noise_n=0.003, seed=2, apparatus=given)
    assert [row.unloading for row in rows[:2]] == [False, True]
    assert rows[0].force_n > rows[1].force_n
    found = fit_sheet(SCENE, rows, list(range(len(rows))), source="twin")
    assert found.modulus_thickness_n_per_m.value == pytest.approx(1200.0, rel=0.06)
    assert found.slack_width_m.value == pytest.approx(0.2405, abs=8e-4)
    assert found.hysteresis_ratio is not None
    assert found.hysteresis_ratio.value == pytest.approx(0.1, abs=0.03)


def test_a_measured_sheet_keeps_the_displacement_of_the_flanges() -> None:
    arm = SCENE.arms.left.model_copy(update={"flange_compliance_m_per_n": 60e-6})
    scene = SCENE.model_copy(update={"arms": SCENE.arms.model_copy(update={"left": arm})})
    before = scene.sheet.young_modulus_pa * scene.sheet.thickness_m
    values = describe_sheet(scene, 1.2 * before, scene.sheet.width_m)
    assert values == pytest.approx(
        {
            "sheet.young_modulus_pa": 1.2 * scene.sheet.young_modulus_pa,
            "sheet.width_m": scene.sheet.width_m,
            "arms.left.flange_compliance_m_per_n": 50e-6,
            "arms.right.flange_compliance_m_per_n": 0.0,
        }
    )


def test_the_reported_edges_yield_to_the_tension_of_the_sheet() -> None:
    """The arms of a sheet of stretched width 0.252 m are further apart, as the bridge commands."""
    arms = {
        side: getattr(SCENE.arms, side).model_copy(update={"flange_compliance_m_per_n": 1e-4})
        for side in ("left", "right")
    }
    scene = SCENE.model_copy(update={"arms": SCENE.arms.model_copy(update=arms)})
    offsets_m = [ArmGeometry(scene, side).edge_offset_m(1.05) for side in ("left", "right")]
    assert offsets_m[1] > 0.5 * 0.252 + 1e-3
    rigid = tuple(
        SampledMotion(np.array([0, 10]), np.tile([x, 0, 0, 0, 1, 0, 0, 0, 1], (2, 1)))
        for x in offsets_m
    )
    left, right = apply_compliance(scene, (rigid[0], rigid[1]))
    assert left.values[:, 0] == pytest.approx([-0.126] * 2, abs=1e-6)
    assert right.values[:, 0] == pytest.approx([0.126] * 2, abs=1e-6)


@cache
def fit_tilted_marker() -> tuple[Apparatus, MarkerCalibration]:
    """Fit the marker offset of a finger that is tilted against its usual orientation."""
    given = changed("finger", marker_from_pad_m=[1e-3, -1e-3, 0.010], finger_tilt_rad=[0.2, -0.15])
    touches = simulate_touches(SCENE, given, calibration=StereoCalibration.load(OPTICS), seed=1)
    return given, fit_marker(touches, SCENE, "twin")


def test_the_marker_is_calibrated_in_the_usual_orientation_of_the_finger() -> None:
    """The triangulator assumes `direction_world`, so the offset must contain the finger's tilt."""
    given, found = fit_tilted_marker()
    used_m = world_from_finger(SCENE.finger.direction_world) @ np.array(found.marker_from_pad_m)
    true_m = find_marker_offset(given)
    assert np.abs(used_m - true_m).max() < 3.0 * max(found.standard_deviations_m)


def find_marker_offset(given: Apparatus) -> Floats:
    """Return the true vector from pad to marker in the world, from the definition of the frame."""
    turn = rotation_from_vector((*given.finger.finger_tilt_rad, 0.0))
    x = turn @ np.array(SCENE.finger.direction_world)
    x /= np.linalg.norm(x)
    z = np.cross(x, turn[:, 0])
    z /= np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z]) @ np.array(given.finger.marker_from_pad_m)


def test_light_meets_a_bent_sheet_where_it_is() -> None:
    """The rays of the camera meet the surface z = 0.02 x, not the plane z = 0."""
    assert SCENE.projector is not None
    camera = make_true_camera(SCENE.camera)
    lit = twin_projector.LitSheet(SCENE, camera, SCENE.projector, seed=1)
    axis = np.linspace(-0.12, 0.12, 7)
    x, y = (one.ravel() for one in np.meshgrid(axis, axis))
    bend = twin_projector._fit_bend(np.column_stack([x, y, 0.02 * x]))
    view = matrix(camera.world_from_left)
    tilted = transform(rotation_from_vector([0.0, -np.arctan(0.02), 0.0]), np.zeros(3))
    rays = lit._rays[0][::40, ::40]
    found = lit._lit_by(rays, view, np.eye(4), bend)
    expected = lit._lit_by(rays, view, tilted, None)
    both = found[2] & expected[2]
    assert both.sum() > 20
    assert found[0][both] == pytest.approx(expected[0][both], abs=0.02)
    assert found[1][both] == pytest.approx(expected[1][both], abs=0.02)


# State, order and results


def result(residual: float = 0.1, **values: Any) -> StepResult:
    return StepResult(residual=residual, unit="mm", limit=0.5, advice="Repeat.", **values)


def open_lab(folder: Path, apparatus: str | None = "seed:3") -> Commissioning:
    return Commissioning(folder, DEMO, SCENE_FILE, apparatus)


def test_results_go_into_scene_and_launch_file(tmp_path: Path) -> None:
    lab = open_lab(tmp_path)
    lab.run(StepName.ARMS, lambda _: result(scene_values={"finger.radius_m": 0.0081}))
    (tmp_path / "stereo.yaml").write_text(OPTICS.read_text())
    lab.run(
        StepName.MARKER, lambda _: result(parameters={"triangulator.calibration": "stereo.yaml"})
    )
    assert load_scene(lab.scene_copy).finger.radius_m == 0.0081
    graph = load_graph(lab.launch_copy)
    assert graph.nodes["triangulator"].parameters["calibration"] == str(tmp_path / "stereo.yaml")
    assert lab.find_file("stereo.yaml") == tmp_path / "stereo.yaml"
    assert lab.find_file("sheet.yaml") is None


def test_a_scene_with_a_mesh_stays_valid_in_the_folder(tmp_path: Path) -> None:
    lab = Commissioning(tmp_path, DEMO, SCENE_FILE.parent / "organ.yaml", None)
    lab.write()
    organ = load_scene(SCENE_FILE.parent / "organ.yaml")
    assert identify_scene(load_scene(lab.scene_copy)) == identify_scene(organ)


def test_a_commissioning_resumes_and_a_repeated_step_invalidates_later_ones(
    tmp_path: Path,
) -> None:
    lab = open_lab(tmp_path)
    radii = iter((0.008, 0.009))

    def step(_: Commissioning) -> StepResult:
        return result(scene_values={"finger.radius_m": next(radii)})

    lab.run(StepName.CAMERA, step)
    lab.skip(StepName.ARMS, "the arms come next week")
    lab.run(StepName.EDGES, lambda _: result())
    again = open_lab(tmp_path)
    assert again.pending() == list(StepName)[3:]
    assert again.state == lab.state
    again.run(StepName.CAMERA, step)
    assert again.pending() == list(StepName)[1:]
    assert load_scene(again.scene_copy).finger.radius_m == 0.009


def test_a_step_starts_from_the_scene_of_the_steps_before_it(tmp_path: Path) -> None:
    lab = open_lab(tmp_path)
    seen = []

    def add(one: Commissioning) -> StepResult:
        radius_m = load_scene(one.scene_copy).finger.radius_m
        seen.append(radius_m)
        return result(scene_values={"finger.radius_m": radius_m + 0.001})

    for _ in range(2):
        lab.run(StepName.EDGES, add)
    assert seen == [SCENE.finger.radius_m] * 2


def test_a_failed_step_leaves_the_earlier_results(tmp_path: Path) -> None:
    lab = open_lab(tmp_path)
    lab.run(StepName.CAMERA, lambda _: result())

    def fail(_: Commissioning) -> StepResult:
        raise CommissionError("the arm is off")

    with pytest.raises(CommissionError, match="the arm is off"):
        lab.run(StepName.ARMS, fail)
    assert open_lab(tmp_path).pending() == list(StepName)[1:]


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda folder: open_lab(folder, "seed:4").write(), "uses seed:4, .* names seed:3"),
        (lambda folder: (folder / "notes.txt").write_text("x"), "not empty and has no commission"),
        (
            lambda folder: (folder / "commission.json").write_text("{]"),
            "not a valid commissioning state",
        ),
    ],
)
def test_a_folder_of_something_else_is_refused(tmp_path: Path, prepare: Any, words: str) -> None:
    prepare(tmp_path)
    with pytest.raises(CommissionError, match=words):
        open_lab(tmp_path)


def test_a_seed_counts_from_the_scene_that_was_commissioned(tmp_path: Path) -> None:
    """Any calibrated values give the same hardware as the apparatus file of the commissioning."""
    lab, _ = open_laboratory(tmp_path / "lab", DEMO, None, "seed:3")
    radius = {"finger.radius_m": 0.0085, "arms.left.flange_compliance_m_per_n": 5e-5}
    lab.run(StepName.EDGES, lambda _: result(scene_values=radius))
    drawn, stored = (
        load_graph(lab.launch_copy, apparatus=text).apparatus_message()
        for text in ("seed:3", str(tmp_path / "lab" / "apparatus.yaml"))
    )
    assert drawn is not None
    assert stored is not None
    scene = load_scene(lab.scene_copy)
    true = [apply_apparatus(scene, one) for one in (drawn, stored)]
    assert true[0].finger.radius_m == pytest.approx(true[1].finger.radius_m, abs=1e-9)
    assert drawn.arms.left.flange_compliance_m_per_n == pytest.approx(
        stored.arms.left.flange_compliance_m_per_n
    )
    # A draw of calibrated devices counts from the calibrated values.
    calibrated = load_graph(lab.launch_copy, apparatus="seed:3,calibrated").apparatus_message()
    assert calibrated is not None
    assert apply_apparatus(scene, calibrated).finger.radius_m == pytest.approx(0.0085, abs=1e-3)
    lab.state = lab.state.model_copy(update={"scene_file": str(tmp_path / "gone.yaml")})
    (tmp_path / "lab" / "commission.json").write_text(lab.state.model_dump_json())
    with pytest.raises(BadInputError, match=r"gone.yaml.*does not exist.*apparatus.yaml"):
        load_graph(lab.launch_copy, apparatus="seed:3")


def test_an_unknown_apparatus_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="not a random sample"):
        open_laboratory(tmp_path / "lab", DEMO, None, "seed:x")
    assert not (tmp_path / "lab").exists()


def test_a_laboratory_is_doubted_for_each_reason(tmp_path: Path) -> None:
    lab = open_lab(tmp_path)
    lab.run(StepName.CAMERA, lambda _: result())
    figures = {"predicted": {"image_mm": PREDICTED}, "flagged": [], "overloaded": False}
    assert list_doubts(lab.state.steps, figures, (0.2, 0.5)) == []
    lab.run(StepName.ARMS, lambda _: result(0.7))
    lab.skip(StepName.EDGES, "no marks")
    figures = {
        "predicted": {"image_mm": {**PREDICTED, "within": False, "limit_95": 0.9}},
        "flagged": ["marker_offset"],
        "overloaded": True,
    }
    doubts = list_doubts(lab.state.steps, figures, (0.6, 0.5))
    for doubt, words in zip(
        doubts,
        (
            OVERLOADED,
            "step arms: residual 0.7",
            "edges was skipped",
            "image_mm: 95 %",
            "marker",
            "0.6 mm",
        ),
        strict=True,
    ):
        assert words in doubt


# Verification

VERIFIED: dict[str, Any] = {
    "stroke": {
        "true_delta_d_mm": {"mean": 0.3, "std": 0.1, "max": 0.9},
        "delta_d_mm": {"mean": 0.2, "std": 0.1, "max": 0.8},
        "delta_theta_deg": {"mean": 0.4, "std": 0.1, "max": 1.1},
        "fingertip_mm": {"mean": 0.06, "std": 0.01, "max": 0.1},
        "latency_ms": {
            "exposure_to_frame": {"p50": 21.0, "p99": 35.0},
            "exposure_to_light": {"p50": None, "p99": None},
        },
        "drops": 90,
        "bag": None,
    },
    "at_rest": {
        "before": {"image_mm": 7.77},
        "after": {"sheet_mm": 0.04, "image_mm": 0.1, "force_percent": 4.0, "fingertip_mm": 0.05},
    },
    "co_location": {"mean_mm": 0.052, "max_mm": 0.11, "disparity_mm": 0.0123},
    "predicted": {
        "sheet_mm": PREDICTED,
        "image_mm": PREDICTED,
        "force_percent": {**PREDICTED, "limit_95": 6.0, "tolerance": 10.0},
        "fingertip_mm": PREDICTED,
    },
    "flagged": [],
    "overloaded": False,
    "doubts": [],
}


def test_a_failed_stroke_leaves_the_finished_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, devices = open_laboratory(tmp_path / "lab", DEMO, None, "seed:3")
    lab.run(StepName.CAMERA, lambda _: result())

    def fail(*_: object) -> None:
        raise ExperimentError("the bag contains 0 valid fingertip measurements")

    monkeypatch.setattr("flexsheet.launch.experiments.trial.run_stroke", fail)
    with pytest.raises(ExperimentError, match="0 valid fingertip"):
        lab.run(StepName.VERIFICATION, devices.verify)
    assert list(lab.state.steps) == [StepName.CAMERA]


# Predicted errors


def test_predicted_errors_match_errors_drawn_from_the_same_uncertainties() -> None:
    """The reference draws fingertip errors without the evaluator: marker and timestamp."""
    covariance_m2 = 1e-8 * np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 9.0]])
    optics = StereoCalibration.load(OPTICS)
    marker = fit_tilted_marker()[1].model_copy(
        update={"covariance_m2": tuple(map(tuple, covariance_m2.tolist()))}
    )
    known = Knowledge(
        scene=SCENE,
        calibrations=NodeCalibrations(optics, None, marker),
        edges={},
        projector_px2=np.zeros((2, 2)),
        eyes_m2=np.zeros((3, 3)),
        stamp_std_s=0.0,
    )
    random = np.random.default_rng(5)
    believed = known.calibrations.find_marker_offset_m(SCENE)
    drawn = np.array([find_marker_offset(draw_apparatus(known, random)) for _ in range(400)])
    assert drawn.mean(axis=0) == pytest.approx(believed, abs=5e-5)
    turned = world_from_finger(SCENE.finger.direction_world)
    expected_m = np.sqrt(np.diag(turned @ covariance_m2 @ turned.T))
    assert drawn.std(axis=0) == pytest.approx(expected_m, rel=0.12)


# The command


@pytest.mark.parametrize(
    ("changes", "code", "verdict"),
    [
        ({}, 0, ["The laboratory is good: all errors are expected within tolerance."]),
        (
            {"doubts": [OVERLOADED]},
            NOT_GOOD,
            ["The laboratory is not good:", f"- {OVERLOADED}"],
        ),
    ],
)
def test_the_command_ends_with_the_verdict(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
    code: int,
    verdict: list[str],
) -> None:
    step = result(figures={**VERIFIED, **changes})
    monkeypatch.setattr(
        Laboratory, "steps", property(lambda _: {name: lambda _: step for name in StepName})
    )
    line = ["commission", "--apparatus", "seed:3", "--output", str(tmp_path / "lab")]
    done = CliRunner().invoke(cli.app, line)
    assert done.exit_code == code
    lines = done.stderr.splitlines()
    assert lines[-len(verdict) :] == verdict
    assert lines[-1 - len(verdict)].startswith("launch file: ")


def test_a_skipped_verification_gives_no_verdict(
    tmp_path: Path, quick_steps: list[StepName]
) -> None:
    line = ["commission", "--apparatus", "seed:3", "--output", str(tmp_path / "lab")]
    done = CliRunner().invoke(cli.app, [*line, "--skip", "verification=no finger"])
    assert StepName.VERIFICATION not in quick_steps
    assert done.exit_code == NOT_GOOD
    assert done.stderr.splitlines()[-1] == "The laboratory was not verified: no finger."


def invoke(*arguments: str) -> tuple[int, Any, str]:
    done = CliRunner().invoke(cli.app, ["commission", *arguments, "--json"])
    text = str(done.exception) if done.exception is not None else done.stderr
    return done.exit_code, json.loads(done.stdout) if done.stdout else None, text


@pytest.fixture
def quick_steps(monkeypatch: pytest.MonkeyPatch) -> list[StepName]:
    """Replace all steps by ones that only record their names."""
    ran: list[StepName] = []

    def make(name: StepName) -> Any:
        def step(_: Commissioning) -> StepResult:
            ran.append(name)
            figures = {"flagged": []} if name is StepName.VERIFICATION else {}
            return result(figures=figures)

        return step

    monkeypatch.setattr(
        Laboratory, "steps", property(lambda _: {name: make(name) for name in StepName})
    )
    return ran


def test_the_command_runs_skips_repeats_and_checks(
    tmp_path: Path, quick_steps: list[StepName]
) -> None:
    folder = ("--apparatus", "seed:3", "--output", str(tmp_path / "lab"))
    code, found, printed = invoke(*folder, "--skip", "marker=the finger is not here")
    assert code == 0
    assert "step projector\n" in printed
    assert "step verification\n" in printed
    assert found["complete"]
    assert quick_steps == [name for name in StepName if name is not StepName.MARKER]
    assert [one["name"] for one in found["steps"]] == list(StepName)
    assert {"name", "seconds", "residual", "unit"} <= set(found["steps"][0])
    assert found["steps"][5]["skipped_because"] == "the finger is not here"
    assert found["launch_file"] == str(tmp_path / "lab" / "launch.yaml")
    assert found["verification"] == {"flagged": []}
    # The apparatus file describes the same hardware, whatever the commissioned scene says.
    graph = load_graph(Path(found["launch_file"]), apparatus=found["apparatus"])
    assert graph.apparatus is not None
    quick_steps.clear()
    assert invoke(*folder)[0] == 0
    assert quick_steps == []
    invoke(*folder, "--step", "verification")
    assert quick_steps == [StepName.VERIFICATION]
    quick_steps.clear()
    invoke(*folder, "--step", "edges", "--step", "marker")
    assert quick_steps == list(StepName)[2:]


def test_real_devices_stop_at_the_first_step_without_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predicted = {"image_mm": PredictedError(**PREDICTED)}
    monkeypatch.setattr(
        "flexsheet.launch.calibration.commission_steps.predict_errors", lambda *_: predicted
    )
    folder = ("--output", str(tmp_path / "lab"))
    code, found, _ = invoke(*folder)
    assert code == 1
    assert not found["complete"]
    assert INSTRUCTIONS[StepName.CAMERA] in found["next"]
    steps = ("camera", "arms", "sheet", "projector", "edges", "eyes", "delays")
    skips = [part for name in steps for part in ("--skip", f"{name}=as in the data sheet")]
    header = "marker_x_mm,marker_y_mm,marker_z_mm,point_x_mm,point_y_mm,point_z_mm"
    rows = []
    for tilt in ((0, 0), (-20, 0), (15, 0), (0, -25), (0, 25)):
        turn = rotation_from_vector(np.radians([*tilt, 0.0]))
        x, y, z = turn @ np.array([0.0, 5.0, 9.0])
        rows.append(f"{x},{y},{z},0,0,0,{tilt[0]},{tilt[1]}")
    file = tmp_path / "touches.csv"
    file.write_text("\n".join([f"{header},tilt_x_deg,tilt_y_deg", *rows]))
    data = ("--data", f"marker={file}", "--finger-radius-mm", "8.5")
    code, found, _ = invoke(*folder, *skips, *data)
    assert code == 1
    marker = next(one for one in found["steps"] if one["name"] == "marker")
    assert marker["within_limit"]
    assert INSTRUCTIONS[StepName.VERIFICATION] in found["next"]
    assert load_scene(Path(found["scene_file"])).finger.radius_m == 0.0085
    stroke = tmp_path / "stroke.json"
    stroke.write_text(json.dumps({"delta_d_mm": {"mean": 0.07}, "flagged": ["marker_offset"]}))
    code, found, _ = invoke(*folder, "--data", f"verification={stroke}")
    assert code == NOT_GOOD
    assert found["complete"]
    assert found["verification"]["predicted"] == {"image_mm": PREDICTED}
    assert "a self-check suspects: marker_offset" in found["verification"]["doubts"]
    assert not found["verification"]["overloaded"]
    for busy_fraction, overloaded in ((0.04, False), (0.1, True)):
        measured = {"delta_d_mm": {"mean": 0.07}, "flagged": [], "busy_fraction": busy_fraction}
        stroke.write_text(json.dumps(measured))
        _, found, _ = invoke(*folder, "--step", "verification", "--data", f"verification={stroke}")
        assert found["verification"]["overloaded"] is overloaded
        assert (OVERLOADED in found["verification"]["doubts"]) is overloaded


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--step", "lens"), "--step lens: expected one of camera, arms"),
        (("--skip", "camera="), "expected STEP=TEXT with a non-empty text"),
        (("--data", "camera"), "expected STEP=TEXT with a non-empty text"),
        (("--data", "camera=nowhere"), "--data camera=nowhere: does not exist"),
        (("--apparatus", "seed:1", "--data", "camera=x"), "--data, .* are for real devices"),
        (("--board", "9"), "--board 9: expected COLUMNSxROWS"),
    ],
)
def test_bad_options_are_refused(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    import re

    code, _, text = invoke("--output", str(tmp_path / "lab"), *arguments)
    assert code != 0
    assert re.search(words, text)


def test_an_apparatus_without_twin_is_refused() -> None:
    for command in (
        "stereo --left a --right b --board 9x6 --square-mm 25",
        "arms --left-arm . --board 9x6 --square-mm 25 --scene cylinder",
        "projector --scene cylinder --pictures .",
        "sheet --rows a.csv",
        "marker --rows a.csv",
    ):
        output = "" if command.startswith("projector") else " -o result.yaml"
        line = f"calibrate {command} --apparatus seed:1{output}"
        done = CliRunner().invoke(cli.app, line.split())
        assert "--apparatus seed:1: the option is for --twin" in str(done.exception), command


def test_a_robustness_trial_commissions_its_laboratory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {
        key: {"mean": 0.1}
        for key in ("true_delta_d_mm", "true_delta_theta_deg", "delta_d_mm", "fingertip_mm")
    }
    figures = {
        "stroke": errors,
        "at_rest": {"after": {"image_mm": 0.6, "force_percent": 2.0}},
        "at_working_speed": {"fingertip_mm": 0.2},
        "flagged": [],
        "predicted": {"image_mm": PREDICTED},
        "doubts": ["the image"],
    }
    monkeypatch.setattr(
        Laboratory,
        "steps",
        property(lambda _: {name: lambda _: result(figures=figures) for name in StepName}),
    )
    row = run_robustness_trial(
        {
            "seed": 3,
            "launch_file": str(DEMO),
            "settings": [],
            "apparatus": "seed:3,paper",
            "commission_folder": str(tmp_path / "lab"),
            "seconds": 1.0,
        }
    )
    assert [one["name"] for one in row["commission"]["steps"]] == list(StepName)
    assert (row["sheet_mm"], row["image_mm"]) == (0.1, 0.6)
    assert row["out_of_tolerance"] == ["image_mm"]
    summary = summarize_commissioning([row])
    assert summary["confusion"]["doubted_and_exceeded"] == 1
    found = summary["predictions"]["image_mm"]
    assert found["stated_over_true"]["median"] == pytest.approx(0.3 / 0.6)
    assert found["covered"] == 0.0
    assert found["good_but_exceeded"] == 1


def test_commissioned_and_calibrated_exclude_each_other() -> None:
    line = "experiment robustness --seeds 0 --commissioned --calibrated --json"
    done = CliRunner().invoke(cli.app, line.split())
    assert "use only one" in str(done.exception)


@pytest.mark.long
def test_a_simulated_laboratory_is_commissioned_end_to_end(tmp_path: Path) -> None:
    code, found, text = invoke(
        "--apparatus", "seed:3", "--output", str(tmp_path / "lab"), "--duration", "6"
    )
    assert code == (NOT_GOOD if found["verification"]["doubts"] else 0), text
    at_rest = found["verification"]["at_rest"]
    for metric in ("sheet_mm", "image_mm", "force_percent", "fingertip_mm"):
        assert at_rest["after"][metric] < 0.5 * at_rest["before"][metric], metric


# Servo lags


def test_measured_lags_go_to_the_bridge_of_each_arm(tmp_path: Path) -> None:
    lab = open_lab(tmp_path)
    values = tuple(
        NodeValue(node_type="arm_bridge", parameter="servo_lag_s", value=value, side=side)
        for side, value in (("left", 0.041), ("right", 0.052))
    )
    lab.run(StepName.DELAYS, lambda _: result(node_values=values))
    nodes = load_graph(lab.launch_copy).nodes
    lags = [nodes[f"arm_{side}_bridge"].parameters["servo_lag_s"] for side in ("left", "right")]
    assert lags == [0.041, 0.052]


def test_lags_are_read_from_the_bag_of_a_stroke(tmp_path: Path) -> None:
    def write(path: Path, *states: ArmState) -> Path:
        with BagWriter(path) as writer:
            for number, state in enumerate(states, start=1):
                header = Header(number, number, number, "test", "bridge", 1)
                writer.write(TOPICS[f"arm_{state.side}"], state, header, number)
        return path

    known = {"servo_lag_uncertainty_s": 0.001}
    states = [
        arm_state("left", servo_lag_s=0.030),
        arm_state("left", servo_lag_s=0.040, **known),
        arm_state("left", servo_lag_s=0.041, **known),
        arm_state("right", servo_lag_s=0.052, **known),
    ]
    found = read_measured_lags(write(tmp_path / "stroke.mcap", *states))
    assert found == {"left": MeasuredLag(0.041, 0.001), "right": MeasuredLag(0.052, 0.001)}
    with pytest.raises(
        DelaysError, match="the bridge of the right arm did not measure a servo lag"
    ):
        read_measured_lags(write(tmp_path / "short.mcap", *states[:3]))


def test_the_mass_per_area_of_the_sheet_determines_its_density() -> None:
    scene = SCENE
    before = scene.sheet.young_modulus_pa * scene.sheet.thickness_m
    values = describe_sheet(scene, before, scene.sheet.width_m, 1.417)
    assert values["sheet.density_kg_per_m3"] * scene.sheet.thickness_m == pytest.approx(1.417)
    kept = describe_sheet(scene, before, scene.sheet.width_m)
    assert "sheet.density_kg_per_m3" not in kept
