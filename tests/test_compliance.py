"""Test the rendered force over depth within the arms' tension limits, with the simulated
membrane."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch.calibration.simulated_sheet import simulate_push
from flexsheet.launch.cli import app, exit_code
from flexsheet.launch.commands.output import BAD_INPUT
from flexsheet.launch.health.compliance import (
    LoopRisk,
    find_loop_risk,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.running.precompute import report_time_left
from flexsheet.messages.calibration_file import CalibrationFileError
from flexsheet.messages.types import SoftBody
from flexsheet.nodes.models.sheet.force_models import CENTRE, ScaledSheetModel, SheetPush
from flexsheet.nodes.planner.compliance import (
    MAX_ADVANCE_PER_DEPTH,
    TARGET_ERROR_RATIO,
    USABLE_FRACTION,
    Compliance,
    ObjectCurve,
    StretchLimits,
    UnfitCurveError,
    compute_force_uncertainty_ratio,
    fit_compliance,
    make_stretch_limits,
    render_force,
)
from flexsheet.nodes.planner.sheet_force import make_force_model
from tests.examples import long_except
from tests.hand_bounds import make_bounds_60_hz

Floats = NDArray[np.float64]

DEMO = Path(__file__).parent.parent / "launch" / "demo.yaml"
RIGID = DEMO.parent / "scenes" / "rigid-plane.yaml"
SCENE_FILE = Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(SCENE_FILE)
SHEET = SCENE.sheet
LAW = make_force_model(SHEET)
PULL = make_stretch_limits(SHEET, LAW)
RADIUS = SCENE.finger.radius_m


def soft_curve(scale: float, deepest: float = 0.05) -> ObjectCurve:
    """Return a force-depth curve similar to the soft cylinder's: Hertz's power, then linear; 47 N/m
    at 1."""
    depths = deepest * np.linspace(0.0, 1.0, 40) ** 1.5
    forces = scale * 58.0 * (depths - 0.002 * -np.expm1(-depths / 0.002))
    return ObjectCurve(depths, forces)


def compliance(curve: ObjectCurve, deepest: float = 0.05, pull: StretchLimits = PULL) -> Compliance:
    return fit_compliance(curve, LAW, pull, SCENE, max_depth_m=deepest)


@pytest.mark.parametrize("scale", long_except([0.25, 0.6, 1.0], 0.25, 1.0))
@pytest.mark.parametrize("place", [CENTRE, (0.02, 0.05)])
def test_the_twins_sheet_answers_as_the_object(scale: float, place: tuple[float, float]) -> None:
    curve = soft_curve(scale)
    shown = compliance(curve)
    assert shown.note == ""
    depths = np.array([0.005, 0.015, 0.04])
    true = [
        simulate_push(SHEET, shown.stretch_ratio, float(pushed), place, RADIUS, cells=24)
        for pushed in shown.indentation_m(depths, place)
    ]
    assert [one[0] for one in true] == pytest.approx(curve.force_n(depths), rel=TARGET_ERROR_RATIO)
    assert max(one[1] for one in true) < SHEET.max_edge_force_n


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.02, 20.0),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.sampled_from([0.01, 0.05]),
)
def test_the_retreat_is_smooth_and_bounded_for_any_object(
    scale: float, place: tuple[float, float], deepest: float
) -> None:
    shown = compliance(soft_curve(scale), deepest)
    depths = np.linspace(-0.005, 1.2 * deepest, 800)
    retreat = shown.normal_offset_m(depths, place)
    slopes = np.diff(retreat) / np.diff(depths)
    assert np.isfinite(retreat).all()
    assert (retreat[depths <= 0.0] == 0.0).all()
    assert slopes.max() < 1.0 + 1e-6
    assert slopes.min() > -MAX_ADVANCE_PER_DEPTH - 1e-6
    pushed = shown.indentation_m(depths, place)
    assert (np.diff(pushed) >= -1e-9).all()
    inner = slopes[(depths[1:] > 0.02 * deepest) & (depths[1:] < 0.99 * deepest)]
    assert np.abs(np.diff(inner)).max() < 0.25
    held = (min(abs(place[0]), 0.06), min(abs(place[1]), 0.09))
    pressed = LAW.evaluate(SheetPush(shown.stretch_ratio, RADIUS, held), pushed)
    assert pressed.edge_force_n.max() < SHEET.max_edge_force_n
    assert PULL.min_stretch_ratio <= shown.stretch_ratio <= PULL.max_stretch_ratio


@settings(max_examples=15, deadline=None)
@given(st.floats(0.05, 1.0))
def test_what_fits_is_presented_exactly_by_the_law(scale: float) -> None:
    curve = soft_curve(scale)
    shown = compliance(curve)
    depths = np.linspace(0.004, 0.05, 30)
    assert shown.rendered_force_n(depths) == pytest.approx(curve.force_n(depths), rel=0.01)


def test_between_the_sampled_positions_the_law_is_valid() -> None:
    curve = soft_curve(0.6)
    shown = compliance(curve)
    depths = np.array([0.006, 0.012, 0.03])
    for place in ((0.01, 0.02), (0.045, 0.03), (-0.025, -0.075), (0.055, 0.08)):
        assert shown.rendered_force_n(depths, place) == pytest.approx(
            curve.force_n(depths), rel=0.02
        )


def test_a_soft_object_lets_the_sheet_follow_the_finger_and_a_stiff_one_brings_it() -> None:
    soft, stiff = compliance(soft_curve(0.1)), compliance(soft_curve(1.3))
    assert soft.stretch_ratio < stiff.stretch_ratio
    assert soft.normal_offset_m(0.04) > 0.02
    assert soft.centre.advance_per_depth < 0.05
    assert stiff.normal_offset_m(0.006) < 0.0
    assert 0.0 < stiff.centre.advance_per_depth <= MAX_ADVANCE_PER_DEPTH + 1e-9


def test_a_stiffer_object_is_reported_with_the_ratio() -> None:
    shown = compliance(soft_curve(4.0))
    assert "stiffer than the sheet can render" in shown.note
    assert "15 to 22 %" in shown.note
    at = int(np.argmin(shown.centre.force_n - shown.centre.object_force_n))
    error = -100 * shown.centre.error_ratio[at]
    assert f"{error:.0f} % too soft at {1e3 * shown.centre.depths_m[at]:.0f} mm" in shown.note


def test_what_keeps_it_from_a_stiffer_object_is_named() -> None:
    pulled = compliance(soft_curve(1.0), pull=StretchLimits(1.02, 1.02, 5.3))
    assert pulled.centre.force_limited
    assert "edge force is at its limit" in pulled.note
    strong = StretchLimits(1.02, 1.06, 1e3)
    eager = compliance(soft_curve(3.0), 0.01, strong)
    assert not eager.centre.force_limited
    assert "advance towards the finger" in eager.note


def test_a_softer_object_than_the_sheet_can_render_is_reported() -> None:
    shown = compliance(soft_curve(0.02), 0.01)
    assert "too soft for the position tolerance" in shown.note
    assert compute_force_uncertainty_ratio(shown.centre, 0.0005) > 0.15
    assert compute_force_uncertainty_ratio(shown.centre, 0.0) == 0.0


def test_the_edge_force_never_exceeds_the_reserve_at_any_depth() -> None:
    weak = SHEET.model_copy(update={"max_edge_force_n": 9.0})
    pull = make_stretch_limits(weak, LAW)
    assert pull.edge_force_n == pytest.approx(USABLE_FRACTION * 9.0)
    flat = LAW.evaluate(SheetPush(pull.max_stretch_ratio, RADIUS), np.zeros(1))
    assert flat.edge_force_n[0] == pytest.approx(USABLE_FRACTION * 9.0, rel=1e-6)
    for scale in (0.2, 1.0, 10.0):
        shown = compliance(soft_curve(scale), pull=pull)
        assert shown.centre.edge_force_n.max() <= USABLE_FRACTION * 9.0 * (1.0 + 1e-3)


def test_a_sheet_with_too_high_tension_retreats_at_once() -> None:
    shown = render_force(
        soft_curve(1.0),
        LAW,
        StretchLimits(1.08, 1.08, 2.0),
        SheetPush(1.08, RADIUS),
        max_depth_m=0.05,
    )
    assert not shown.indentation_m.any()
    assert shown.force_limited
    assert shown.normal_offset_m == pytest.approx(shown.depths_m)


def test_the_slack_sheet_presents_what_it_can() -> None:
    slack = compliance(soft_curve(0.5), pull=StretchLimits(1.0, 1.0, 17.0))
    assert slack.stretch_ratio == 1.0
    assert np.isfinite(slack.normal_offset_m(np.linspace(0.0, 0.05, 50))).all()
    assert slack.note


def test_an_object_that_is_not_there_is_not_felt() -> None:
    shown = compliance(ObjectCurve(np.array([0.0, 0.05]), np.zeros(2)))
    depths = np.linspace(0.0, 0.05, 20)
    assert shown.rendered_force_n(depths) == pytest.approx(0.0, abs=1e-12)
    assert shown.normal_offset_m(depths) == pytest.approx(depths)


def test_a_curve_elsewhere_keeps_the_stretch() -> None:
    here = compliance(soft_curve(1.0))
    there = fit_compliance(
        soft_curve(0.8), LAW, PULL, SCENE, stretch_ratio=here.stretch_ratio, max_depth_m=0.05
    )
    assert there.stretch_ratio == here.stretch_ratio
    depths = np.array([0.005, 0.02])
    assert there.rendered_force_n(depths) == pytest.approx(
        soft_curve(0.8).force_n(depths), rel=0.01
    )


@pytest.mark.parametrize(
    ("depths", "forces", "words"),
    [
        ([0.0], [0.0], "two or more"),
        ([0.0, 0.01], [0.0], "as many"),
        ([0.0, np.nan], [0.0, 1.0], "finite"),
        ([0.001, 0.01], [0.0, 1.0], "must be 0 m, 0 N"),
        ([0.0, 0.01], [0.1, 1.0], "must be 0 m, 0 N"),
        ([0.0, 0.01, 0.01], [0.0, 1.0, 2.0], "ascend"),
        ([0.0, 0.01, 0.02], [0.0, 1.0, 0.5], "fall"),
    ],
)
def test_curves_that_are_none_are_rejected(
    depths: list[float], forces: list[float], words: str
) -> None:
    with pytest.raises(UnfitCurveError, match=words):
        ObjectCurve(np.array(depths), np.array(forces))


def test_a_curve_comes_from_the_soft_bodys_message_and_is_extended_linearly() -> None:
    field = SoftBody.model_fields["force_curve"]
    assert field.default_factory is not None
    rows = np.array([[0.0, 0.0], [0.01, 0.2], [0.02, 0.5]])
    curve = ObjectCurve.from_rows(rows)
    assert curve.force_n(np.array([-1.0, 0.0, 0.01, 0.02])) == pytest.approx([0.0, 0.0, 0.2, 0.5])
    beyond = curve.force_n(np.array([0.03, 0.04, 0.05]))
    assert np.diff(beyond, 2) == pytest.approx(0.0, abs=1e-12)
    assert beyond[0] > 0.5
    with pytest.raises(UnfitCurveError, match="two or more"):
        ObjectCurve.from_rows(np.zeros((0, 2)))


def test_a_calibrated_law_serves_as_well() -> None:
    stiffer = ScaledSheetModel(LAW.rubber, cubic_ratio=1.4, stretch_scale=1.004)
    curve = soft_curve(0.8)
    limits = make_stretch_limits(SHEET, stiffer)
    shown = fit_compliance(curve, stiffer, limits, SCENE, max_depth_m=0.05)
    depths = np.array([0.005, 0.02, 0.045])
    assert shown.rendered_force_n(depths) == pytest.approx(curve.force_n(depths), rel=0.01)
    assert shown.stretch_ratio < compliance(curve).stretch_ratio


@pytest.mark.parametrize(("scale", "code", "words"), [(0.8, 0, ""), (5.0, 1, "stiffer")])
def test_the_doctor_reports_whether_a_scenes_object_can_be_presented(
    monkeypatch: pytest.MonkeyPatch, scale: float, code: int, words: str
) -> None:
    curve = soft_curve(scale)
    rows = np.column_stack([curve.depths_m, curve.forces_n])
    monkeypatch.setattr("flexsheet.launch.health.compliance.compute_front_curve", lambda *_: rows)
    command = ["doctor", "--scene", str(SCENE_FILE), "--compliance"]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == code, result.output
    reported = json.loads(result.stdout)
    assert words in reported["note"]
    assert (reported["worst_error_ratio"] <= TARGET_ERROR_RATIO) == (code == 0)
    assert reported["rows"][-1]["depth_mm"] == pytest.approx(50.0)
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == code
    assert "stretch" in shown.stdout
    assert "computing the rendered force" in shown.stderr
    assert "rendering error" in shown.stdout
    assert "error of this model relative to the reference" in " ".join(shown.stderr.split())


def test_progress_is_reported_again_when_another_computation_starts() -> None:
    """The force curve needs the soft body and then its table, which takes minutes."""
    reports: list[str] = []
    on_progress = report_time_left("computing", reports.append)
    for total, last in ((2, 2), (500, 60)):
        for done in range(last + 1):
            on_progress(done, total)
    percents = [one.removeprefix("computing: ").split(",")[0] for one in reports]
    assert percents == ["0 %", "50 %", "100 %", "0 %", "10 %"]


@pytest.mark.parametrize(
    ("scale", "delay_s", "risk"),
    [
        (0.8, 0.05, None),
        (0.8, 0.2, LoopRisk.OSCILLATION),
        (5.0, 0.05, LoopRisk.SHEET),
    ],
)
def test_the_risk_of_the_loop_follows_from_object_and_delay(
    scale: float, delay_s: float, risk: LoopRisk | None
) -> None:
    table = make_bounds_60_hz()
    finding = find_loop_risk(
        SCENE, make_force_model(SCENE.sheet), soft_curve(scale), table, delay_s
    )
    assert (None if finding is None else finding.risk) == risk
    if finding is not None:
        assert finding.delay_s == delay_s
        assert "use a" in finding.describe()


def test_the_doctor_names_what_it_cannot_use(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.yaml")
    result = CliRunner().invoke(
        app, ["doctor", "--scene", str(SCENE_FILE), "--compliance", "--calibration", missing]
    )
    assert isinstance(result.exception, CalibrationFileError)
    assert exit_code(result.exception) == BAD_INPUT
    assert "cannot be read" in str(result.exception)
