"""The benchmark of regret: its truth, its bound, and what the default method owes to both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.hand_motion import (
    GRID_HZ,
    draw_tremor,
    sample_strokes,
    sample_tremor,
    sample_wander,
)
from benchmarks.tracking_regret import (
    HORIZONS_S,
    RECORDING,
    compare_predictions,
    draw_hands,
    measure_all,
    read_recording,
)
from tests.examples import long_except

SEED = 20  # a development seed


@pytest.mark.parametrize("band_hz", [(5.0, 7.0), (8.0, 12.0)])
def test_a_tremor_has_its_size_and_its_band(band_hz: tuple[float, float]) -> None:
    random = np.random.default_rng(1)
    tremor = sample_tremor(draw_tremor(band_hz, SEED), 120.0, random)
    assert np.mean(tremor**2) == pytest.approx(1.0, rel=0.2)
    power = np.mean(np.abs(np.fft.rfft(tremor, axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(tremor), 1.0 / GRID_HZ)
    inside = (frequencies > band_hz[0] - 2.0) & (frequencies < band_hz[1] + 2.0)
    assert power[inside].sum() > 0.9 * power.sum()


@pytest.mark.parametrize("bandwidth_hz", [1.0, 3.0])
def test_wander_keeps_its_bandwidth(bandwidth_hz: float) -> None:
    wander = sample_wander(bandwidth_hz, 120.0, np.random.default_rng(2))
    power = np.mean(np.abs(np.fft.rfft(wander, axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(wander), 1.0 / GRID_HZ)
    assert power[frequencies <= bandwidth_hz].sum() == pytest.approx(0.9 * power.sum(), rel=0.05)


def test_strokes_are_as_fast_as_a_hand_that_explores() -> None:
    strokes = sample_strokes(60.0, np.random.default_rng(3))
    speeds = np.linalg.norm(np.diff(strokes, axis=0), axis=1) * GRID_HZ
    assert 40.0 < speeds.max() < 200.0
    assert np.abs(strokes).max() < 20.0


def test_the_tracking_does_not_beat_the_predictor_that_knows_the_spectrum_by_much() -> None:
    """Hands that are Gaussian: what is left to win is chance and the limited bound's window."""
    hand = next(one for one in draw_hands(SEED) if one.motion == "2 Hz")
    for regret in compare_predictions(hand, 0.01, 30, SEED, {}):
        assert regret.wiener_mm is not None
        assert min(regret.error_mm.values()) > 0.85 * regret.wiener_mm


@pytest.mark.parametrize(
    ("motion", "band"),
    long_except([("1 Hz", "5-7 Hz"), ("strokes", "8-12 Hz")], ("strokes", "8-12 Hz")),
)
def test_the_tracking_is_near_the_best_model_and_the_least_error(motion: str, band: str) -> None:
    hand = next(
        one
        for one in draw_hands(SEED)
        if (one.motion, one.band, one.tremor_mm) == (motion, band, 0.05)
    )
    step_s: dict[str, list[float]] = {}
    for regret in compare_predictions(hand, 0.01, 60, SEED, step_s):
        assert regret.wiener_mm is not None
        assert regret.error_mm["adaptive"] < 1.1 * regret.bank_mm
        assert regret.error_mm["adaptive"] < 1.4 * regret.wiener_mm
    assert set(step_s) == set(regret.error_mm)


def test_a_file_without_the_columns_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "hand.csv"
    file.write_text("t_s,x_mm,y_mm\n0,1,2\n1,2,3\n", encoding="utf-8")
    with pytest.raises(ValueError, match="z_mm are needed"):
        read_recording(file)


@pytest.mark.skipif(not RECORDING.is_file(), reason="../shared/data is not here")
def test_a_recorded_finger_is_predicted_as_well_as_by_the_best_model() -> None:
    hand = read_recording(RECORDING)
    regrets = list(compare_predictions(hand, 0.01, 60, SEED, {}))
    assert [regret.horizon_ms for regret in regrets] == [round(1e3 * h) for h in HORIZONS_S]
    for regret in regrets:
        assert regret.wiener_mm is None
        assert regret.error_mm["adaptive"] < 1.1 * regret.bank_mm


def test_the_result_names_machine_seeds_and_every_case(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks import tracking_regret

    monkeypatch.setattr(tracking_regret, "DURATION_S", 2.0)
    monkeypatch.setattr(tracking_regret, "SPECTRUM_S", 10.0)
    for name, values in (("VOLUNTARY", ("1 Hz",)), ("RATES_HZ", (15,)), ("TREMOR_MM", (0.05,))):
        monkeypatch.setattr(tracking_regret, name, values)
    result = measure_all([SEED], None)
    assert result["seeds"] == [SEED]
    assert len(result["cases"]) == 3 * 2 * len(HORIZONS_S)
    assert result["machine"]
