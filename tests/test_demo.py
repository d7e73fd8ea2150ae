"""Test that the demo reports each experiment when it is finished, also if a later one fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from flexsheet.launch.experiments import (
    ExperimentError,
    OverloadedError,
    demo,
    image,
    run,
)
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import Run
from tests.commands import Command
from tests.test_followed import LABEL, write_hand
from tests.test_planner import SCENE

DRIVER = Driver(load_graph(run.DEMO_FILE), Run("unused", Path("unused")))
ERRORS = {"mean": 0.0625, "std": 0.04}
STROKE = {
    "seconds": 10.0,
    "delta_d_mm": ERRORS,
    "delta_theta_deg": ERRORS,
    "true_delta_d_mm": ERRORS,
    "true_delta_theta_deg": ERRORS,
}


def test_a_path_is_recorded_only_after_its_end(tmp_path: Path) -> None:
    bag = write_hand(tmp_path / "a.mcap")  # ends 0.2 s after the path
    assert not run.is_path_recorded(bag, LABEL)
    assert not run.is_path_recorded(bag, "another")


async def test_an_evaluation_waits_while_the_recorder_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "FLUSH_PERIOD_S", 0.0)
    monkeypatch.setattr(run, "RECORD_WAIT_S", -1.0)
    bag, reported = tmp_path / "a.mcap", list[str]()
    bag.touch()

    def evaluate_growing_bag() -> str | None:
        bag.write_text(bag.read_text() + "more")
        return "result" if len(bag.read_text()) >= 12 else None

    await run.make_evaluation(bag, evaluate_growing_bag, reported.append, "a path")(DRIVER, SCENE)
    assert reported == ["result"]
    with pytest.raises(ExperimentError, match=r"has written nothing for .* a path is not in"):
        await run.make_evaluation(bag, lambda: None, reported.append, "a path")(DRIVER, SCENE)


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_results_before_an_error_are_printed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    flexsheet: Command,
    options: tuple[str, ...],
) -> None:
    def fail_at_image(
        file: Path, given: object, bag: Path, progress: Any, report: demo.Report, **_: object
    ) -> NoReturn:
        bag.touch()
        figure = demo.DemoFigure(tmp_path / "stroke.png", demo.STROKE_FIGURE)
        report(demo.DemoResult(strokes=[STROKE], figures=[figure]))
        raise OverloadedError("timeout: waited 40 s for the eye's image")

    monkeypatch.setattr(demo, "run_demo", fail_at_image)
    code, out, err = flexsheet("demo", "--output", tmp_path, *options)
    assert code == 1
    assert "waited 40 s" in err
    if options:
        assert json.loads(out)["strokes"] == [STROKE]
    else:
        assert "10 s" in out
        assert "0.062" in out
        assert "stroke.png" in err
        assert OverloadedError.remedy in " ".join(err.split())


def test_the_demo_ends_with_the_files_and_what_they_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flexsheet: Command
) -> None:
    def run_short(
        file: Path, given: object, bag: Path, progress: Any, report: demo.Report, **_: object
    ) -> None:
        report(demo.DemoResult(figures=[demo.DemoFigure(bag.parent / "stroke.png", "errors")]))
        sizes = {"sheet": "tilted", "correction": "two_pass", "mean_mm": 0.125, "max_mm": 4.25}
        report(demo.DemoResult([], [sizes], [demo.DemoFigure(bag.parent / "eye.png", "images")]))

    monkeypatch.setattr(demo, "run_demo", run_short)
    code, out, err = flexsheet("demo", "--output", tmp_path)
    assert code == 0
    assert all(text in out for text in ("two_pass", "0.12", "4.25"))
    assert err.splitlines()[-5:] == [
        f"files to look at, in {tmp_path}:",
        "  eye.png: images",
        "  stroke.png: errors",
        "  demo.mcap: recording of all topics",
        f"all figures and faults of the recording: flexsheet bag report {tmp_path}/demo.mcap",
    ]


def test_the_demo_reports_the_sizes_that_the_eye_sees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    white = np.zeros((400, 400, 3), np.uint8)
    white[150:250, 100:300] = 255
    wider = np.zeros_like(white)
    wider[150:250, 95:305] = 255
    pictures = {
        label: image.EyeImage(label, correction, 0.001, wider, white)
        for series, value, corrections in demo.IMAGES
        for correction in corrections
        for label in [series.label(value, correction)]
    }
    monkeypatch.setattr(image, "read_images", lambda bag: pictures)
    result = demo.evaluate_images(tmp_path / "demo.mcap", 2)
    assert result is not None
    assert [one["correction"] for one in result.images] == list(demo.IMAGES[1][2])
    assert {one["sheet"] for one in result.images} == {"pushed 30 mm"}
    assert result.images[0]["mean_mm"] == pytest.approx(5.0, abs=0.1)
    assert result.images[0]["max_mm"] == pytest.approx(10.0, abs=0.1)
    assert [one.path.exists() for one in result.figures] == [True]


def test_an_error_names_the_bag_and_the_command_that_evaluates_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = tmp_path / "a bag.mcap"

    async def fail(*_: object) -> None:
        bag.touch()
        raise OverloadedError("timeout")

    monkeypatch.setattr(run, "precompute_graph", lambda plan, progress, **_: None)
    monkeypatch.setattr(run, "drive", fail)
    with pytest.raises(OverloadedError) as failed:
        run.run_experiment(run.DEMO_FILE, (), bag, run.chain_procedures(), print)
    assert str(failed.value).splitlines() == [
        "timeout",
        f"recording until the error: {bag}",
        f"to evaluate it: flexsheet bag report '{bag}'",
    ]
