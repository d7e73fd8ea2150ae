"""Test the lower bound of the sheet error that predictions of the finger allow."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import prediction_bound
from benchmarks.hand_motion import GRID_HZ
from benchmarks.prediction_bound import compute_bound_mm
from benchmarks.tracking_regret import autocovariance
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from tests.scenes import load_cylinder

SCENE = load_cylinder()


def make_truth(*, lag_s: float, bandwidth_hz: float) -> Apparatus:
    values = nominal_apparatus(SCENE).model_dump()
    for arm in values["arms"].values():
        arm["servo_lag_s"] = lag_s
    values["finger"] |= {"voluntary_bandwidth_hz": bandwidth_hz, "tremor_rms_m": 2e-5}
    return Apparatus.model_validate(values)


def test_the_autocovariance_of_a_sine_is_a_cosine() -> None:
    times_s = np.arange(0.0, 20.0, 1.0 / GRID_HZ)
    path = np.tile(np.sin(2.0 * np.pi * times_s)[:, None], 3)
    found = autocovariance(path, 1.0)
    expected = 0.5 * np.cos(2.0 * np.pi * np.arange(len(found)) / GRID_HZ)
    assert found == pytest.approx(np.tile(expected[:, None], 3), abs=1e-6)


def test_the_bound_grows_with_lag_and_bandwidth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prediction_bound, "SPECTRUM_S", 60.0)

    def bound(lag_s: float, bandwidth_hz: float) -> float:
        truth = make_truth(lag_s=lag_s, bandwidth_hz=bandwidth_hz)
        return compute_bound_mm(SCENE, truth, np.random.default_rng(1))

    slow, usual, late = bound(0.035, 1.0), bound(0.035, 3.0), bound(0.06, 3.0)
    assert 0.0 < 2.0 * slow < usual < 0.9 * late
