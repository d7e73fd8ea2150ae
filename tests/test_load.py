"""Test the measurement against load with simulated levels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import load
from benchmarks.load import FACTORS, State
from flexsheet.launch.experiments import (
    ArmsNotReadyError,
    ExperimentError,
    ExperimentInterruptedError,
)
from flexsheet.launch.plans.plan import load_scene

ROWS: dict[float, dict[str, Any]] = {
    0.035: {"sheet_mm": {"p95": 0.2}, "modes": {"follow": 1.0}},
    0.1: {"sheet_mm": {"p95": 0.9}, "modes": {"follow": 1.0}},
    0.2: {"sheet_mm": {"p95": 0.2}, "modes": {"follow": 0.9, "hold": 0.1}},
    0.4: {"hold_mm": {"p95": 2.0}, "modes": {"follow": 0.5, "stopping": 0.1, "idle": 0.4}},
}
STATES = [State.WITHIN, State.OUT, State.HOLDS, State.STOPS, State.FAILED, State.HOLDS]
NOT_READY = 1.0
"""The level at which the arms never follow."""


class SimulatedLevels:
    """Simulated levels of the finger's speed; the run of one level is interrupted once."""

    def __init__(self, interrupted_at: float) -> None:
        self.ran: list[float] = []
        self._interrupted_at: float | None = interrupted_at

    def __call__(self, name: str, level: float, seconds: float) -> dict[str, Any]:
        self.ran.append(level)
        if level == self._interrupted_at:
            self._interrupted_at = None
            raise ExperimentInterruptedError("interrupted")
        if level == NOT_READY:
            raise ArmsNotReadyError("timeout")
        if level not in ROWS:
            raise ExperimentError("a node failed")
        return {"followed": 1.0, "violations": [], **ROWS[level]}


def test_an_interrupted_measurement_continues_and_each_level_gets_its_state(
    tmp_path: Path,
) -> None:
    run, levels = SimulatedLevels(interrupted_at=0.2), (*ROWS, 0.7, NOT_READY)
    with pytest.raises(ExperimentInterruptedError):
        load.measure_factor("speed", levels, 5.0, tmp_path, run)
    rows = load.measure_factor("speed", levels, 5.0, tmp_path, run)
    assert run.ran == [0.035, 0.1, 0.2, 0.2, 0.4, 0.7, NOT_READY]
    assert [row["state"] for row in rows] == STATES
    assert rows[1]["tolerance_ratios"] == pytest.approx({"sheet": 0.9 / 0.5})
    with pytest.raises(ExperimentError, match="seconds"):
        load.measure_factor("speed", levels, 6.0, tmp_path, run)
    rows[0]["violations"] = ["joint speed"]
    load.draw_rows(rows, tmp_path / "load.svg")
    assert "</svg>" in (tmp_path / "load.svg").read_text()
    record = {"machine": "m", "command": "c", "results": {"rows": rows}}
    path = tmp_path / "record.json"
    path.write_text(json.dumps(record))
    states = load.render(path)
    assert (
        "| speed, m/s | 0.035 | 0.1 | 0.2, 1 | 0.4 | 0.7 | sheet, sheet to its target |" in states
    )
    assert "Violated limits: joint speed." in states


@pytest.mark.parametrize("name", [name for name, one in FACTORS.items() if one.key is not None])
def test_each_level_of_a_scene_is_a_valid_scene(name: str, tmp_path: Path) -> None:
    key = FACTORS[name].key or ()
    for level in FACTORS[name].levels:
        value: Any = load_scene(load.write_scene(name, level, tmp_path / "scene.yaml"))
        for part in key:
            value = getattr(value, part)
        assert value == level


def test_cables_have_one_fault_at_a_time() -> None:
    assert load.make_cable("delay", 20.0) == {"delay_s": 0.02}
    assert load.make_cable("jitter", 10.0) == {"delay_s": 0.02, "jitter_s": 0.01}
    assert load.make_cable("loss", 1.0) == {"loss": 0.01}
