"""Test the planner's correction for hysteresis against the simulator's own model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.calibration.sheet_fit import MeasuredPush, SheetModelFitError
from flexsheet.launch.calibration.sheet_rows import read_rows
from flexsheet.launch.commands.calibrate_rows import make_sheet_calibration
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.nodes.models.sheet.force_models import SheetPush
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.hysteresis import HysteresisCorrection
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.twin.force_history import ForceHistory, apply_history
from tests.test_compliance_controller import object_force_n, soft_body
from tests.test_planner import SCENE

Floats = NDArray[np.float64]
RADIUS = SCENE.finger.radius_m
HYSTERESIS = 0.1
TIMES_S = np.linspace(0.0, 4.0, 481)
DEPTHS_M = 0.015 - 0.015 * np.cos(2.0 * np.pi * TIMES_S / 2.0)


def force_errors(hysteresis_ratio: float) -> Floats:
    """Return relative errors of the force over two cycles to 30 mm, by the simulator's rubber.

    The elastic force is that of the planner's own model, so that only the hysteresis errs.
    """
    model = make_force_model(SCENE.sheet)
    controller = ComplianceController(
        SCENE, model, "force_curve", hysteresis_ratio=hysteresis_ratio
    )
    controller.update(soft_body(), in_contact=False)
    indented_m = np.array(
        [depth - controller.normal_offset(float(depth), (0.0, 0.0))[0] for depth in DEPTHS_M]
    )
    elastic_n = model.evaluate(SheetPush(controller.stretch_ratio, RADIUS), indented_m).force_n
    felt_n = apply_history(ForceHistory(HYSTERESIS, 0.0), TIMES_S, elastic_n)
    wanted_n = object_force_n(DEPTHS_M)
    pressed = DEPTHS_M > 0.005
    return np.asarray(felt_n[pressed] / wanted_n[pressed] - 1.0)


def test_the_correction_reduces_the_force_error() -> None:
    plain, corrected = force_errors(0.0), force_errors(HYSTERESIS)
    rms = [float(np.sqrt(np.mean(errors**2))) for errors in (plain, corrected)]
    assert rms[0] > 0.04
    assert rms[1] < 0.5 * rms[0]


def test_a_reversal_takes_a_share_of_the_depth() -> None:
    correction = HysteresisCorrection(0.1)
    loading = correction.update(0.02)
    assert loading == pytest.approx(1.0 + 0.1 / 1.9)
    assert correction.update(0.02) == loading
    assert correction.update(0.01999) == pytest.approx(loading, abs=1e-3), "tremor"
    assert correction.update(0.015) == pytest.approx(1.0 - 0.1 / 1.9)
    assert correction.update(0.0) == 1.0
    assert correction.update(0.001) == pytest.approx(loading), "a new contact is loading"


def pushes(ratio: float, noise: float = 0.002) -> list[MeasuredPush]:
    """Return loading and unloading rows of rubber with hysteresis."""
    random, model = np.random.default_rng(11), make_force_model(SCENE.sheet)
    amplitude, rows = ratio / (2.0 - ratio), []
    depths = np.array([0.004, 0.008, 0.015, 0.03, 0.045])
    for stretch in (1.02, 1.06, 1.1):
        force_n = model.evaluate(SheetPush(stretch, RADIUS), depths).force_n
        for unloading in (False, True):
            for depth, elastic_n in zip(depths, force_n, strict=True):
                factor = 1.0 - amplitude if unloading else 1.0 + amplitude
                rows.append(
                    MeasuredPush(
                        edge_distance_m=stretch * SCENE.sheet.width_m,
                        depth_m=float(depth),
                        force_n=float(factor * elastic_n * (1.0 + random.normal(0.0, noise))),
                        finger_radius_m=RADIUS,
                        unloading=unloading,
                    )
                )
    return rows


def calibrate(rows: list[MeasuredPush]) -> SheetCalibration:
    lines = list(range(len(rows)))
    return make_sheet_calibration(SCENE, rows, lines, source="test")


def test_the_calibration_estimates_the_hysteresis() -> None:
    found = calibrate(pushes(HYSTERESIS))
    assert found.hysteresis_ratio is not None
    assert float(found.hysteresis_ratio.value) == pytest.approx(HYSTERESIS, abs=0.01)
    expected = SCENE.sheet.young_modulus_pa * SCENE.sheet.thickness_m
    assert float(found.modulus_thickness_n_per_m.value) == pytest.approx(expected, rel=0.02)
    assert found.residual_rms_ratio < 0.01


def test_rows_without_a_direction_give_no_hysteresis() -> None:
    rows = [one for one in pushes(0.0) if not one.unloading]
    assert calibrate(rows).hysteresis_ratio is None


def test_exchanged_directions_are_refused() -> None:
    with pytest.raises(
        SheetModelFitError,
        match=r"the force during unloading is 1\.\d\d times the force during loading",
    ):
        calibrate(pushes(-0.1))


def test_the_column_of_directions_is_read(tmp_path: Path) -> None:
    file = tmp_path / "pushes.csv"
    file.write_text("stretch_ratio,depth_mm,force_n,unloading\n1.05,10,0.5,0\n1.05,10,0.4,1\n")
    read, _ = read_rows(file, SCENE.sheet, RADIUS)
    assert [push.unloading for push in read] == [False, True]
    file.write_text("stretch_ratio,depth_mm,force_n,unloading\n1.05,10,0.5,2\n")
    with pytest.raises(BadInputError, match=r":2: unloading: expected 0 or 1, found 2"):
        read_rows(file, SCENE.sheet, RADIUS)
