"""Test the hysteresis and creep of the simulated sheet."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.apparatus import Apparatus
from flexsheet.nodes.twin.force_history import ForceHistory, apply_history

Floats = NDArray[np.float64]


def apparatus(**sheet: float) -> Apparatus:
    return Apparatus.model_validate({"scene": "cylinder", "sheet": sheet})


def cycle(hysteresis: float, creep: float, period_s: float = 2.0) -> tuple[Floats, Floats]:
    """Return displacement and force of the fifth loading cycle from zero to one newton."""
    times = np.linspace(0.0, 5.0 * period_s, 5001)
    elastic = 0.5 - 0.5 * np.cos(2.0 * np.pi * times / period_s)
    force = apply_history(ForceHistory(hysteresis, creep), times, elastic)
    return elastic[4000:], force[4000:]


def lost_ratio(displacement: Floats, force: Floats) -> float:
    """Return the energy loss of a cycle divided by the loading energy."""
    peak = int(np.argmax(displacement))
    loading = np.trapezoid(force[: peak + 1], displacement[: peak + 1])
    return float(np.trapezoid(force, displacement) / loading)


@pytest.mark.parametrize("period_s", [0.5, 2.0, 10.0])
@pytest.mark.parametrize(("hysteresis", "creep"), [(0.05, 0.0), (0.2, 0.0), (0.2, 0.08)])
def test_a_cycle_loses_the_stated_share(hysteresis: float, creep: float, period_s: float) -> None:
    assert lost_ratio(*cycle(hysteresis, creep, period_s)) == pytest.approx(hysteresis, rel=0.15)


def test_force_relaxes_by_the_stated_share_per_decade() -> None:
    times = np.array([0.0, 0.001, 0.1, 1.0, 10.0, 100.0])
    force = apply_history(ForceHistory(0.0, 0.05), times, np.array([0.0, 2.0, 2.0, 2.0, 2.0, 2.0]))
    assert -np.diff(force[2:]) / 2.0 == pytest.approx([0.05] * 3, rel=0.1)
    assert force[3] == pytest.approx(2.0, rel=2e-3), "the modulus is measured after a second"


def test_the_result_does_not_depend_on_the_steps() -> None:
    coarse = apply_history(
        ForceHistory(0.1, 0.05), np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0, 1.5])
    )
    times = np.linspace(0.0, 3.0, 3001)
    elastic = np.interp(times, [0.0, 1.0, 3.0], [0.0, 2.0, 1.5])
    fine = apply_history(ForceHistory(0.1, 0.05), times, elastic)
    assert fine[-1] == pytest.approx(coarse[-1], rel=1e-9)


def test_elastic_rubber_has_no_history() -> None:
    assert ForceHistory.of(None) is None
    assert ForceHistory.of(apparatus()) is None
    made = ForceHistory.of(apparatus(hysteresis_ratio=0.1))
    assert made is not None
    assert made.update(0.0, 1.0) == 1.0, "no direction is known yet"


def test_time_must_not_decrease() -> None:
    history = ForceHistory(0.1, 0.05)
    history.update(2.0, 1.0)
    with pytest.raises(ValueError, match=r"time 1\.0 s is before 2\.0 s"):
        history.update(1.0, 1.0)
