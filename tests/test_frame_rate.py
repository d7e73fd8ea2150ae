"""Test the command that measures frames with a graphics card."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import frame_rate


@pytest.mark.parametrize("driver", ["", "llvmpipe (LLVM 15.0.6, 256 bits)"])
def test_without_a_graphics_card_it_says_so(
    driver: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(frame_rate, "find_driver", lambda: driver)
    monkeypatch.setattr(sys, "argv", ["frame_rate"])
    assert frame_rate.main() == frame_rate.NO_GPU_CODE
    assert "no graphics card" in capsys.readouterr().err


def test_a_machine_is_one_point_of_the_chart(tmp_path: Path) -> None:
    def point(driver: str, frame_ms: float) -> dict[str, object]:
        return {
            "machine": "4 cores",
            "driver": driver,
            "frame_ms_p50": frame_ms,
            "frames_per_s": 60.0,
            "visible_lag_ms": {"object": 2.0},
        }

    for driver, frame_ms in (("A (1)", 2.0), ("B", 3.0), ("A (1)", 1.0)):
        frame_rate.add_point(point(driver, frame_ms), tmp_path)
    points = json.loads((tmp_path / "correction-frames.json").read_text())["points"]
    assert [(each["driver"], each["frame_ms_p50"]) for each in points] == [
        ("B", 3.0),
        ("A (1)", 1.0),
    ]
    assert (tmp_path / "correction-frames.svg").read_text().count("frames per second") == 1
