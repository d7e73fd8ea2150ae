"""Test the command `flexsheet calibrate sheet`: estimates, invalid rows and files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from flexsheet.launch.calibration.sheet_fit import (
    MAX_RMS_SIGMAS,
    MeasuredPush,
    SheetModelFitError,
    fit_sheet_model,
)
from flexsheet.launch.calibration.sheet_rows import read_rows, simulate_rows
from flexsheet.launch.calibration.simulated_sheet import simulate_force
from flexsheet.launch.cli import app
from flexsheet.launch.commands.calibrate_rows import make_sheet_calibration
from flexsheet.launch.commands.output import CommandError
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.calibration_file import CalibrationFileError, CalibrationMismatchError
from flexsheet.messages.sheet_calibration import (
    SheetCalibration,
)
from flexsheet.nodes.models.sheet.force_models import (
    CENTRE,
    ScaledSheetModel,
    SheetPush,
    make_model,
)
from flexsheet.nodes.planner.sheet_force import make_force_model, make_rubber

SCENE_FILE = Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(SCENE_FILE)
NOMINAL = make_rubber(SCENE.sheet)
RADIUS = 0.007


def pushes_of(
    law: ScaledSheetModel,
    *,
    stretches: tuple[float, ...] = (1.02, 1.04, 1.06, 1.09),
    depths: tuple[float, ...] = (0.004, 0.008, 0.015, 0.025, 0.04),
    noise_n: float = 0.0,
    edges: bool = False,
    seed: int = 1,
) -> list[MeasuredPush]:
    """Simulate the measurements of a gauge on a sheet with a given force model."""
    rng = np.random.default_rng(seed)
    pushes = []
    for stretch in stretches:
        pressed = law.evaluate(SheetPush(stretch, RADIUS), np.array(depths))
        for depth, force, pull in zip(depths, pressed.force_n, pressed.edge_force_n, strict=True):
            pushes.append(
                MeasuredPush(
                    edge_distance_m=stretch * NOMINAL.width_m,
                    depth_m=depth,
                    force_n=float(force) + float(rng.normal(0.0, noise_n)),
                    finger_radius_m=RADIUS,
                    edge_force_n=float(pull) if edges else None,
                )
            )
    return pushes


@settings(max_examples=12, deadline=None)
@given(st.floats(200.0, 4000.0), st.floats(0.237, 0.243), st.floats(0.5, 2.0))
def test_sheet_parameters_are_recovered(modulus: float, width: float, cubic: float) -> None:
    law = make_model(
        NOMINAL,
        modulus_thickness_n_per_m=modulus,
        slack_width_m=width,
        cubic_ratio=cubic,
    )
    fit = fit_sheet_model(pushes_of(law), NOMINAL)
    assert fit.values == pytest.approx((modulus, width, cubic), rel=1e-3)
    assert fit.worst_ratio < 1e-3
    assert fit.used.all()


def test_errors_are_within_stated_deviations_without_outliers() -> None:
    law = make_model(
        NOMINAL,
        modulus_thickness_n_per_m=1500.0,
        slack_width_m=0.2385,
        cubic_ratio=1.3,
    )
    rows = pushes_of(law, noise_n=0.01)
    for number, factor in ((3, 3.0), (12, 0.2)):
        push = rows[number]
        rows[number] = MeasuredPush(
            push.edge_distance_m, push.depth_m, factor * push.force_n, RADIUS
        )
    fit = fit_sheet_model(rows, NOMINAL)
    assert list(np.flatnonzero(~fit.used)) == [3, 12]
    for value, true, deviation in zip(
        fit.values, (1500.0, 0.2385, 1.3), fit.standard_deviations, strict=True
    ):
        assert abs(value - true) < 4.0 * deviation
        assert 0.0 < deviation < 0.2 * true


FAULT_DEPTHS = (0.002, 0.004, 0.007, 0.012, 0.02, 0.03, 0.04, 0.05)


def make_sheet_model(modulus: float = 1000.0, width: float = 0.24) -> ScaledSheetModel:
    return make_model(
        NOMINAL,
        modulus_thickness_n_per_m=modulus,
        slack_width_m=width,
        cubic_ratio=1.0,
    )


@pytest.mark.parametrize(("modulus", "width"), [(1000.0, 0.24), (500.0, 0.24), (1000.0, 0.243)])
def test_a_correct_sheet_with_small_forces_is_not_doubted(modulus: float, width: float) -> None:
    """At small forces, noise causes a large relative residual."""
    law = make_sheet_model(modulus, width)
    rows = pushes_of(law, depths=FAULT_DEPTHS, noise_n=0.01, edges=True)
    fit = fit_sheet_model(rows, NOMINAL)
    assert fit.rms_ratio > 0.05
    assert fit.rms_sigmas < 0.8 * MAX_RMS_SIGMAS
    verified = SheetPush(1.05, RADIUS), np.array([0.004, 0.016])
    expected = law.evaluate(*verified).force_n
    assert fit.law.evaluate(*verified).force_n == pytest.approx(expected, rel=0.03)


def slip(rows: list[MeasuredPush]) -> list[MeasuredPush]:
    """Replace the last rows by those of a sheet that has slipped by 4 mm in a clamp."""
    loose = pushes_of(make_sheet_model(width=0.244), depths=FAULT_DEPTHS, noise_n=0.005, edges=True)
    kept = round(0.85 * len(rows))
    return rows[:kept] + loose[kept:]


@pytest.mark.parametrize(
    "fault",
    [
        slip,
        lambda rows: [replace(one, force_n=one.force_n**0.9) for one in rows],
        lambda rows: [replace(one, force_n=1.1 * one.force_n) for one in rows],
        lambda rows: [replace(one, force_n=one.force_n + 0.05) for one in rows],
        lambda rows: [replace(one, depth_m=one.depth_m + 1e-3) for one in rows],
        lambda rows: [replace(one, edge_distance_m=one.edge_distance_m + 0.03) for one in rows],
    ],
    ids=["slipping clamp", "other force law", "gain", "zero of the gauge", "depth", "edges"],
)
def test_a_wrong_sheet_or_gauge_is_doubted(fault: Any) -> None:
    """The gain error is detected only because another sensor measures the edge forces."""
    good = pushes_of(make_sheet_model(), depths=FAULT_DEPTHS, noise_n=0.005, edges=True)
    assert fit_sheet_model(good, NOMINAL).rms_sigmas < 0.5 * MAX_RMS_SIGMAS
    assert fit_sheet_model(fault(good), NOMINAL).rms_sigmas > 1.1 * MAX_RMS_SIGMAS


def test_edge_forces_reduce_the_uncertainty() -> None:
    law = ScaledSheetModel(NOMINAL)
    without = fit_sheet_model(pushes_of(law), NOMINAL)
    along = fit_sheet_model(pushes_of(law, edges=True), NOMINAL)
    assert along.standard_deviations[1] < without.standard_deviations[1]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            pushes_of(ScaledSheetModel(NOMINAL))[:5],
            r"there are 5 measured pushes, but fitting .* requires 6",
        ),
        (
            pushes_of(ScaledSheetModel(NOMINAL), stretches=(1.05,), depths=(0.005,) * 8),
            r"do not determine|known to",
        ),
    ],
)
def test_rows_that_do_not_determine_the_fit_are_rejected(
    rows: list[MeasuredPush], words: str
) -> None:
    with pytest.raises(SheetModelFitError, match=words):
        fit_sheet_model(rows, NOMINAL)


CSV = """# measured on a bench
edge_distance_mm, depth_mm, force_n, y_mm, edge_force_n, finger_radius_mm
244.8, 5, 0.09, , 5.1, 7
249.6, 10.5, 0.41, -12,,

252, 20, 1.3, 0, 12, 8
"""


def test_rows_are_read_with_their_lines(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    file.write_text(CSV)
    rows, lines = read_rows(file, SCENE.sheet, RADIUS)
    assert lines == [3, 4, 6]
    assert rows[0] == MeasuredPush(pytest.approx(0.2448), 0.005, 0.09, 0.007, edge_force_n=5.1)  # type: ignore[arg-type]  # compares as a float
    assert rows[1].position_m == pytest.approx((0.0, -0.012))
    assert rows[1].edge_force_n is None
    assert rows[2].finger_radius_m == pytest.approx(0.008)


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("", "rows.csv: is empty"),
        ("stretch_ratio,depth_mm,force_n\n", "does not contain rows"),
        ("stretch_ratio,depth_mm,forse_n\n1.02,5,0.1", 'did you mean "force_n"'),
        ("stretch_ratio,depth_mm\n1.02,5", "force_n: missing column"),
        ("depth_mm,force_n\n5,1", "expected one of the columns"),
        ("stretch_ratio,depth_mm,force_n,depth_mm\n", "duplicate column"),
        ("stretch_ratio,depth_mm,force_n\n1.02,5", "rows.csv:2: expected 3 values, found 2"),
        (
            "stretch_ratio,depth_mm,force_n\n1.02,five,1",
            'rows.csv:2: depth_mm: expected a number, found "five"',
        ),
        ("stretch_ratio,depth_mm,force_n\n1.02,,1", 'depth_mm: expected a number, found ""'),
        (
            "stretch_ratio,depth_mm,force_n\n1.02,nan,1",
            'depth_mm: expected a finite number, found "nan"',
        ),
        (
            "stretch_ratio,depth_mm,force_n\n1.02,-5,1",
            "expected a positive number, found -5",
        ),
        (
            "stretch_ratio,depth_mm,force_n\n2.5e2,5,1",
            "stretch_ratio: expected a ratio near 1, found 250",
        ),
        ("stretch_ratio,depth_mm,force_n\n1.02,5000,1", "give lengths in mm"),
        ("stretch_ratio,depth_mm,force_n,y_mm\n1.02,5,1,130", "y_mm: 130 mm is outside the sheet"),
        ("stretch_ratio,depth_mm,force_n\n" + "x,5,1\n" * 25, "and 5 more"),
    ],
)
def test_errors_in_rows_name_the_line(tmp_path: Path, text: str, printed: str) -> None:
    file = tmp_path / "rows.csv"
    file.write_text(text)
    with pytest.raises(BadInputError) as caught:
        read_rows(file, SCENE.sheet, RADIUS)
    assert printed in str(caught.value)


def test_a_missing_or_binary_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="cannot be read"):
        read_rows(tmp_path / "none.csv", SCENE.sheet, RADIUS)
    (tmp_path / "rows.csv").write_bytes(b"\xff\xfe\x00depth")
    with pytest.raises(BadInputError, match="UTF-8"):
        read_rows(tmp_path / "rows.csv", SCENE.sheet, RADIUS)


@pytest.fixture(scope="module")
def twin_calibration() -> SheetCalibration:
    small = SCENE.model_copy(
        update={"working_range": SCENE.working_range.model_copy(update={"push_depth_m": 0.02})}
    )
    rows = simulate_rows(small, noise_n=0.003, seed=2)
    return make_sheet_calibration(small, rows, list(range(len(rows))), source="twin")


def test_twin_sheet_is_identified_from_its_pushes(twin_calibration: SheetCalibration) -> None:
    found = twin_calibration
    assert found.modulus_thickness_n_per_m.value == pytest.approx(1000.0, rel=0.06)
    assert found.slack_width_m.value == pytest.approx(0.24, abs=0.0006)
    assert found.cubic_ratio.value == pytest.approx(1.0, abs=0.2)
    assert found.residual_rms_ratio < 0.07
    law = make_force_model(SCENE.sheet, found)
    for stretch, depth in ((1.03, 0.009), (1.05, 0.016)):
        true = simulate_force(SCENE.sheet, stretch, depth, CENTRE, RADIUS)
        pressed = law.evaluate(SheetPush(stretch, RADIUS), np.array([depth]))
        assert pressed.force_n[0] == pytest.approx(true, rel=0.06)


def test_file_round_trip_keeps_the_law(twin_calibration: SheetCalibration, tmp_path: Path) -> None:
    file = tmp_path / "sheet.yaml"
    twin_calibration.save(file, comment="made so")
    assert file.read_text().splitlines()[1] == "# made so"
    again = SheetCalibration.load(file)
    one, two = make_force_model(SCENE.sheet, twin_calibration), make_force_model(SCENE.sheet, again)
    depths = np.linspace(0.001, 0.04, 9)
    answers = [
        law.evaluate(SheetPush(1.037, RADIUS, (0.02, 0.01)), depths).force_n for law in (one, two)
    ]
    assert np.array_equal(answers[0], answers[1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 9}, "the key `version` is 9, expected 1"),
        ({"slack_width_m": None}, "slack_width_m"),
        ({"left_oot": []}, "left_oot"),
    ],
)
def test_a_file_that_does_not_fit_is_rejected(
    twin_calibration: SheetCalibration, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    file = tmp_path / "sheet.yaml"
    file.write_text(json.dumps({**twin_calibration.model_dump(mode="json"), **change}))
    with pytest.raises(CalibrationFileError, match=words):
        SheetCalibration.load(file)


@pytest.mark.parametrize("content", ["- 1\n", "a: 1\n", "a: [\n", "version: 1\nscene: lab\n"])
def test_a_foreign_file_is_rejected(tmp_path: Path, content: str) -> None:
    file = tmp_path / "sheet.yaml"
    file.write_text(content)
    with pytest.raises(
        CalibrationFileError, match=r"not YAML|not a calibration|`flexsheet calibrate sheet`"
    ):
        SheetCalibration.load(file)
    with pytest.raises(CalibrationFileError, match="cannot be read"):
        SheetCalibration.load(tmp_path / "none.yaml")


def test_another_sheets_calibration_is_rejected(twin_calibration: SheetCalibration) -> None:
    other = SCENE.sheet.model_copy(update={"width_m": 0.3})
    with pytest.raises(CalibrationMismatchError, match=r"width_m 0\.24, but the scene"):
        make_force_model(other, twin_calibration)


def test_the_command_fits_rows_and_reports(tmp_path: Path) -> None:
    rows = tmp_path / "rows.csv"
    lines = ["stretch_ratio,depth_mm,force_n"]
    for push in pushes_of(ScaledSheetModel(NOMINAL), noise_n=0.002):
        stretch = push.edge_distance_m / NOMINAL.width_m
        lines.append(f"{stretch:.5f},{1e3 * push.depth_m:.3f},{push.force_n:.5f}")
    lines[7] = lines[7].rsplit(",", 1)[0] + ",9.0"
    rows.write_text("\n".join(lines))
    file = tmp_path / "sheet.yaml"
    arguments = ["calibrate", "sheet", "--rows", str(rows), "-o", str(file)]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    reported = json.loads(result.stdout)
    assert reported["modulus_thickness_n_per_m"]["value"] == pytest.approx(1000.0, rel=0.02)
    assert [one["line"] for one in reported["left_out"]] == [8]
    assert SheetCalibration.load(file).source == str(rows)
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0, shown.output
    assert re.search(r"^left out line 8 +\S+$", shown.stdout, re.MULTILINE)
    assert "N/m" in shown.stdout


@pytest.mark.parametrize("arguments", [[], ["--rows", "a.csv", "--twin", "b.yaml"]])
def test_the_command_requires_one_source(tmp_path: Path, arguments: list[str]) -> None:
    result = CliRunner().invoke(
        app, ["calibrate", "sheet", "-o", str(tmp_path / "o.yaml"), *arguments]
    )
    assert isinstance(result.exception, CommandError)
    assert "--rows" in str(result.exception)
