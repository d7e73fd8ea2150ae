"""Test the calibration of the marker's position on the finger."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch.calibration.marker_fit import MarkerFitError, Touch, fit_marker
from flexsheet.launch.calibration.touches import (
    SIMULATED_POINTS_M,
    TOUCHED_ORIENTATIONS,
    read_touches,
    simulate_touches,
)
from flexsheet.launch.cli import app
from flexsheet.launch.commands.output import CommandError
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, CameraTruth, FingerTruth
from flexsheet.messages.calibration_file import CalibrationFileError
from flexsheet.messages.marker_calibration import MarkerCalibration
from flexsheet.messages.types import Fingertip, StereoPair
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.tolerance_table import sample_apparatus
from tests.node_harness import build_node

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SCENE_FILE = ROOT / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(SCENE_FILE)
OPTICS = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"
OFFSET_M = (0.012, 0.002, 0.008)
POINT_M = np.array([0.01, 0.02, 0.01])
TILTS_DEG = ((0, 0), (-20, 0), (15, 0), (0, -25), (0, 25), (-15, -20), (12, 18))

HEADER = (
    "marker_x_mm,marker_y_mm,marker_z_mm,point_x_mm,point_y_mm,point_z_mm,tilt_x_deg,tilt_y_deg"
)
ROW = "10,20,30,10,20,22,0,0"


def touch(tilt_deg: tuple[float, float], random: np.random.Generator, **options: Floats) -> Touch:
    finger = world_from_finger(SCENE.finger.direction_world, np.radians(tilt_deg))
    marker = POINT_M + finger @ np.array(OFFSET_M) + random.normal(0.0, 2e-4, 3)
    return Touch(marker, POINT_M, finger, **options)


def calibrate(arguments: list[str]) -> dict[str, object]:
    arguments = ["calibrate", "marker", *arguments, "--json"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_touches_of_a_point_give_the_offset() -> None:
    random = np.random.default_rng(5)
    fit = fit_marker([touch(tilt, random) for tilt in TILTS_DEG * 2])
    errors = fit.marker_from_pad_m - OFFSET_M
    assert np.abs(errors).max() < 3e-4
    assert (np.abs(errors) < 3.5 * fit.standard_deviations_m).all()
    assert 1e-4 < fit.residual_rms_m < 5e-4


def test_errors_of_points_and_orientations_determine_the_covariance() -> None:
    """For errors from the model, the mean of the squared normalized error is 3."""
    lengths, stated_m = [], []
    for seed, error_m in enumerate([5e-5] * 8 + [3e-4] * 8):
        random = np.random.default_rng(seed)
        turned = random.normal(0.0, error_m, (len(TILTS_DEG), 3))
        touches = []
        for place in random.uniform(-0.05, 0.05, (6, 3)):
            point_error = random.normal(0.0, 1e-4, 3)
            for tilt, bias in zip(TILTS_DEG, turned, strict=True):
                one = touch(tilt, random)
                marker = one.marker_m - POINT_M + place + bias
                touches.append(Touch(marker, place + point_error, one.world_from_finger))
        fit = fit_marker(touches)
        assert (fit.points, fit.orientations) == (6, len(TILTS_DEG))
        error = fit.marker_from_pad_m - OFFSET_M
        lengths.append(error @ np.linalg.solve(fit.covariance_m2, error))
        stated_m.append(float(np.sqrt(np.trace(fit.covariance_m2))))
    assert 1.5 < np.mean(lengths) < 5.0
    assert np.mean(stated_m[8:]) > 1.5 * np.mean(stated_m[:8])


def test_touches_of_the_sheet_give_the_offset() -> None:
    """The position of the pad along the sheet is arbitrary."""
    random = np.random.default_rng(6)
    normal = np.array([0.0, 0.0, 1.0])
    touches = []
    for tilt in ((-40, 0), (40, 0), (0, -40), (0, 40), (0, 0), (-30, 30), (30, -30)) * 3:
        one = touch(tilt, random)
        aside = np.array([*random.uniform(-0.05, 0.05, 2), 0.0])
        touches.append(Touch(one.marker_m + aside, POINT_M, one.world_from_finger, normal))
    fit = fit_marker(touches)
    assert np.abs(fit.marker_from_pad_m - OFFSET_M).max() < 5e-4


@pytest.mark.parametrize(
    ("tilts_deg", "words"),
    [
        (
            ((0, 0), (15, 0)),
            "there are 2 touches in 2 orientations, but at least 4 touches in 3 orientations",
        ),
        (((0, 0), (1, 0), (0, 1), (1, 1), (2, 0)), "touch in at least 2 more orientations"),
    ],
)
def test_too_few_orientations_are_refused(
    tilts_deg: tuple[tuple[float, float], ...], words: str
) -> None:
    random = np.random.default_rng(7)
    with pytest.raises(MarkerFitError, match=words):
        fit_marker([touch(tilt, random) for tilt in tilts_deg])


def test_orientations_that_leave_a_component_free_are_refused() -> None:
    """Rotations about the sheet's normal do not determine the offset across the normal."""
    random = np.random.default_rng(8)
    finger = world_from_finger(SCENE.finger.direction_world)
    touches = []
    for angle_deg in (-40.0, -20.0, 0.0, 20.0, 40.0):
        turned = rotation_from_vector((0.0, 0.0, np.radians(angle_deg))) @ finger
        marker = POINT_M + turned @ np.array(OFFSET_M) + random.normal(0.0, 1e-4, 3)
        touches.append(Touch(marker, POINT_M, turned, np.array([0.0, 0.0, 1.0])))
    with pytest.raises(MarkerFitError, match=r"do not determine|has an uncertainty of"):
        fit_marker(touches)


def test_contradicting_touches_are_refused() -> None:
    random = np.random.default_rng(9)
    touches = [touch(tilt, random) for tilt in TILTS_DEG]
    touches[3].marker_m[0] += 0.02
    with pytest.raises(
        MarkerFitError, match=r"contradict each other: the rms residual is .* of touch 4"
    ):
        fit_marker(touches)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        (HEADER.replace("tilt_y_deg", "tilt_z_deg"), r"tilt_z_deg: unknown column"),
        (HEADER.rpartition(",")[0] + "\n", r"tilt_y_deg: missing column"),
        (f"{HEADER}\n{ROW}\nnan,20,30,10,20,22,0,0", r':3: marker_x_mm: .* found "nan"'),
        (
            f"{HEADER}\n{ROW}\n10,20,30,10,20,22,0,300",
            r":3: tilt_y_deg: expected a magnitude of at most 120",
        ),
        (f"{HEADER}\n10,20", r":2: expected 8 values, found 2"),
        (f"{HEADER},normal_x,normal_y,normal_z\n{ROW},0,0,0.5", r"normal_x: .* length 0\.5"),
    ],
)
def test_a_bad_file_is_refused_with_line_and_column(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "touches.csv"
    file.write_text(text)
    with pytest.raises(BadInputError, match=words) as caught:
        read_touches(file, SCENE)
    assert str(file) in str(caught.value)


def make_apparatus() -> Apparatus:
    finger = FingerTruth(marker_from_pad_m=OFFSET_M)
    return Apparatus(scene=SCENE.name, finger=finger)


async def test_the_calibrated_fingertip_is_the_pad(tmp_path: Path) -> None:
    file, truth = tmp_path / "marker.yaml", tmp_path / "apparatus.yaml"
    truth.write_text("scene: cylinder\nfinger:\n  marker_from_pad_m: [0.012, 0.002, 0.008]\n")
    found = calibrate(
        ["--twin", str(SCENE_FILE), "--apparatus", str(truth), "--calibration", str(OPTICS),
         "-o", str(file)]
    )  # fmt: skip
    assert found["orientations"] >= 5
    harness = build_node(
        Triangulator,
        TriangulatorParameters(
            calibration=OPTICS, marker_calibration=file, touch_point_world_m=(0.0, 0.0, 0.02)
        ),
    )
    await harness.node.setup()
    await harness.step("scene", SCENE)
    camera = TwinCamera(
        make_true_camera(SCENE.camera),
        finger_radius_m=SCENE.finger.radius_m,
        seed=4,
        nail=Nail.of(make_apparatus().finger),
    )
    errors_m = []
    places = 60 * [(0.0, 0.0, 0.02)] + [(-0.04, 0.03, 0.0), (0.04, -0.03, 0.03)]
    for number, place in enumerate(places):
        pad = np.array(place)
        left, right = camera.picture(lambda _, at=pad: at, exposure_s=SCENE.camera.exposure_s)
        pair = StereoPair(
            device=SCENE.camera.device,
            exposure_s=SCENE.camera.exposure_s,
            dropped_frames=0,
            left=left,
            right=right,
        )
        step_ns = 33_000_000 if number < 60 else 1_000_000_000
        harness.clock.move_to(harness.clock.now_ns() + step_ns)
        await harness.step("stereo", pair)
        errors_m.append(harness.messages(Fingertip)[-1][0].measured_world_m - pad)
    assert np.linalg.norm(errors_m, axis=1).max() < 5e-4
    # The finger that rests at the known point confirms the offset.
    [check] = [one for one in harness.node.self_checks if one.cause == "marker_offset"]
    assert check.value < 5e-4


def test_the_scenes_offset_is_used_without_a_calibration() -> None:
    """The z axis of the horizontal finger points up and towards the user."""
    turned = world_from_finger((0.0, -0.5, 0.866)) @ np.array([0.0, 0.002, 0.01])
    assert turned == pytest.approx([0.002, 0.00866, 0.005], abs=1e-5)


def test_a_marker_of_another_scene_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "marker.yaml"
    found = {"version": 1, "date": "2026-01-01", "code_version": "0", "source": "t.csv",
             "scene": "box", "marker_from_pad_m": list(OFFSET_M),
             "standard_deviations_m": [1e-4] * 3, "point_offset_m": [0.0] * 3,
             "residual_rms_m": 1e-4, "max_residual_m": 2e-4, "touches": 9,
             "orientations": 9}  # fmt: skip
    file.write_text(json.dumps(found))
    setting = f"triangulator.marker_calibration={file}"
    with pytest.raises(BadInputError, match='scene: the marker was calibrated in the scene "box"'):
        load_graph(ROOT / "launch" / "demo.yaml", settings=[setting])
    file.write_text(json.dumps(found).replace("0.012", "NaN"))
    with pytest.raises(CalibrationFileError, match="marker_from_pad_m"):
        MarkerCalibration.load(file)


def test_exactly_one_source_is_required(tmp_path: Path) -> None:
    arguments = ["calibrate", "marker", "-o", str(tmp_path / "marker.yaml")]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, CommandError)
    assert "give exactly one source of touches: --rows CSV or --twin SCENE" in str(result.exception)


@pytest.mark.long
def test_a_marker_on_the_nail_is_found_in_the_orientations_of_touches() -> None:
    """With a round finger in front of the marker, only 6 of 24 orientations were detected."""
    drawn = sample_apparatus(SCENE, 1)
    true = drawn.model_copy(update={"camera": CameraTruth()})
    touches = simulate_touches(SCENE, true, calibration=None, seed=1)
    assert len(touches) >= 0.9 * TOUCHED_ORIENTATIONS * len(SIMULATED_POINTS_M)
