"""Test the measurement of camera and projector delays for a commissioning."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from flexsheet.launch.calibration.delays import (
    estimate_stamp_offset,
)
from flexsheet.launch.calibration.edge_marks import MarkDetector
from flexsheet.launch.experiments.stroke import SampledMotion
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.arrays import Floats

SWING_M, BACKLASH_M = 0.02, 1e-4


def swing(times_s: Any) -> Any:
    """Return positions (n, 3), m, of a clamp that swings once per second."""
    return np.outer(SWING_M * np.sin(2.0 * np.pi * np.asarray(times_s)), [0.0, 1.0, 0.0])


class FakeDetector:
    """Detector that returns given positions of the mark in sequence."""

    def __init__(self, positions: Floats) -> None:
        self.positions = iter(positions)

    def find(self, *_: object, **__: object) -> Floats | None:
        return cast(Floats, next(self.positions))


@pytest.mark.parametrize("offset_s", [-0.004, 0.0, 0.005])
@pytest.mark.parametrize("seconds", [10.0, 3.0])
def test_a_stamp_offset_is_separated_from_backlash(offset_s: float, seconds: float) -> None:
    known_s = np.arange(0.0, 12.0, 0.005)
    edge = SampledMotion(np.round(1e9 * known_s).astype(np.int64), swing(known_s))
    stamps_s = np.arange(0.5, 0.5 + seconds, 1.0 / 48.0)
    exposed_s = stamps_s + offset_s
    noise = 5e-5 * np.random.default_rng(1).standard_normal((len(stamps_s), 3))
    seen = swing(exposed_s) + noise
    seen[:, 1] -= BACKLASH_M * np.sign(np.cos(2.0 * np.pi * exposed_s))
    detector = cast(MarkDetector, FakeDetector(seen))
    image = StereoPair.model_construct(left=np.zeros((1, 1)), right=np.zeros((1, 1)))
    pairs = [(round(1e9 * one), image) for one in stamps_s]
    found = estimate_stamp_offset(pairs, (edge,), detector)
    if seconds < 5.0:
        assert found is None, "the recording is too short to state an uncertainty"
        return
    assert found is not None
    assert found.lag_s == pytest.approx(offset_s, abs=3e-4)
    assert found.uncertainty_s < 1e-3
