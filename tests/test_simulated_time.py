"""Test following a finger in simulated time."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.simulated_time import (
    LoopSettings,
    follow_in_simulated_time,
    stroke_in_simulated_time,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.twin.paths import map_to_surface

ROOT = Path(__file__).parent.parent
SCENE = load_scene(ROOT / "launch" / "scenes" / "cylinder.yaml")


def swing(amplitude_m: float, hz: float, seconds: float, hover_s: float = 0.0) -> FingerPath:
    """Return a finger that swings on the object's surface, at first above it."""
    times_s = np.linspace(0.0, seconds, int(50 * seconds))
    around_m = amplitude_m * np.minimum(times_s, 1.0) * np.sin(2.0 * np.pi * hz * times_s)
    heights_m = 0.02 * np.clip(2.0 * (hover_s - times_s), 0.0, 1.0)
    places = np.column_stack([np.zeros_like(times_s), around_m, heights_m])
    return FingerPath(
        label="swing",
        times_s=times_s,
        positions_world_m=map_to_surface(SCENE, places),
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


@cache
def follow(lag_ms: float, *, lag_known: bool = False, hz: float = 0.6) -> dict[str, Any]:
    arms = {side: {"servo_lag_s": 1e-3 * lag_ms} for side in ("left", "right")}
    apparatus = Apparatus.model_validate({"scene": "cylinder", "arms": arms})
    return follow_in_simulated_time(
        SCENE, swing(0.006, hz, 3.0), apparatus, LoopSettings(lag_known=lag_known)
    )


def mean_mm(result: dict[str, Any]) -> float:
    return float(result["contact"]["true_delta_d_mm"]["mean"])


def test_a_slow_finger_is_followed() -> None:
    followed = follow(25.0)
    assert followed["following_ratio"] == 1.0
    assert mean_mm(followed) < 0.15


def test_a_finger_beyond_the_tool_speed_is_not() -> None:
    assert mean_mm(follow(25.0, hz=4.0)) > 10.0 * mean_mm(follow(25.0))


def test_the_bridges_measure_a_lag_that_the_scene_does_not_state() -> None:
    measured = follow(60.0)
    assert measured["servo_lag_ms"] == pytest.approx([60.0, 60.0], abs=4.0)
    assert mean_mm(measured) < 2.0 * mean_mm(follow(60.0, lag_known=True))


def test_a_stroke_shows_the_error_of_the_marker_that_the_devices_do_not_report() -> None:
    """The calibrated camera is exact but for its device; the marker is 0.5 mm beside its place."""
    optics = StereoCalibration.load(ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml")
    settings = LoopSettings(calibrations=NodeCalibrations(stereo=optics))
    nominal = nominal_apparatus(SCENE)
    finger = nominal.finger.model_copy(update={"marker_from_pad_m": (0.0, 5e-4, 0.0)})
    exact, displaced = (
        stroke_in_simulated_time(SCENE, one, settings, 2.0)
        for one in (nominal, nominal.model_copy(update={"finger": finger}))
    )
    assert exact["true_delta_d_mm"]["mean"] < 0.2
    assert exact["delta_d_mm"]["mean"] == pytest.approx(exact["true_delta_d_mm"]["mean"], abs=0.05)
    assert displaced["fingertip_mm"]["mean"] == pytest.approx(0.5, abs=0.15)
    assert displaced["delta_d_mm"]["mean"] < 0.2


@pytest.mark.long
@pytest.mark.parametrize("lag_ms", [10.0, 25.0, 40.0, 60.0, 80.0])
def test_an_unknown_lag_costs_little_more_than_a_known_one(lag_ms: float) -> None:
    path = swing(0.006, 0.6, 14.0, hover_s=8.0)
    arms = {side: {"servo_lag_s": 1e-3 * lag_ms} for side in ("left", "right")}
    apparatus = Apparatus.model_validate({"scene": "cylinder", "arms": arms})
    measured, known = (
        mean_mm(follow_in_simulated_time(SCENE, path, apparatus, LoopSettings(lag_known=one)))
        for one in (False, True)
    )
    assert measured < 1.2 * known
