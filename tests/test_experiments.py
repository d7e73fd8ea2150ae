"""Test the evaluation of experiments: a known error of the sheet is found."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.experiments import ExperimentError, image, stroke
from flexsheet.launch.methods.charts import (
    UnknownFamilyError,
    find_family,
    make_chart_result,
    measure_family,
    render_overview,
    write_chart,
)
from flexsheet.launch.methods.results import replace_non_finite
from flexsheet.launch.methods.svg import INK
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.methods import Correction, SheetShapeMethod, SoftBodyMethod
from flexsheet.messages.scene import Scene, UnfitGeometryError
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import HostStatus
from flexsheet.nodes.methods import (
    Family,
    Point,
    Trial,
    estimate_median,
    measure,
    pareto_front,
)

ROOT = Path(__file__).resolve().parent.parent
CHARTS = ROOT / "docs" / "charts"
SCENE = Scene.model_validate(YAML(typ="safe").load(ROOT / "launch" / "scenes" / "cylinder.yaml"))
RADIUS = SCENE.object.geometry.radius_m
AXIS = SCENE.object.world_from_object.position_m
TIMES = np.arange(0, 10_000_000_000, 10_000_000, dtype=np.int64)


def points_at(angles: np.ndarray, distance: float) -> np.ndarray:
    direction = np.column_stack([np.zeros_like(angles), np.sin(angles), np.cos(angles)])
    return AXIS + distance * direction


def edges_tangent_at(
    angles: np.ndarray, *, lifted_m: float = 0.0
) -> tuple[stroke.SampledMotion, ...]:
    """Return edges of a sheet tangent to the cylinder at `angles`, displaced along its normal."""
    contact = points_at(angles, RADIUS + lifted_m)
    along = np.column_stack([np.zeros_like(angles), np.cos(angles), -np.sin(angles)])
    normal = np.column_stack([np.zeros_like(angles), np.sin(angles), np.cos(angles)])
    half_width = np.array([0.125, 0.0, 0.0])
    return tuple(
        stroke.SampledMotion(TIMES, np.hstack([contact + side * half_width, along, normal]))
        for side in (-1, 1)
    )


def finger_at(angles: np.ndarray, depth_m: float = 0.0) -> stroke.SampledMotion:
    return stroke.SampledMotion(TIMES, points_at(angles, RADIUS - depth_m))


@given(
    lag_rad=st.floats(-0.2, 0.2),
    lifted_m=st.floats(-0.01, 0.01),
    depth_m=st.floats(0.0, 0.03),
)
def test_a_known_lag_and_lift_come_out(lag_rad: float, lifted_m: float, depth_m: float) -> None:
    angles = np.linspace(-1.0, 1.0, len(TIMES))
    left, right = edges_tangent_at(angles - lag_rad, lifted_m=lifted_m)
    delta_d, delta_theta = stroke.sheet_errors(
        SCENE, finger_at(angles, depth_m), (left, right), TIMES
    )
    # The chord between two radii, in the form that stays exact for small ones.
    chord = 2.0 * np.sqrt(RADIUS * (RADIUS + lifted_m)) * np.sin(0.5 * lag_rad)
    expected = np.hypot(lifted_m, chord)
    np.testing.assert_allclose(delta_theta, abs(lag_rad), atol=1e-9)
    np.testing.assert_allclose(delta_d, expected, atol=1e-9)


def test_times_keep_their_digits_on_a_machine_that_is_long_up() -> None:
    start_ns = 300 * 24 * 3600 * 1_000_000_000
    samples = stroke.SampledMotion(
        start_ns + np.array([0, 1_000_000], dtype=np.int64), np.array([[0.0], [1.0]])
    )
    middle = samples.interpolate(np.array([start_ns + 500_000], dtype=np.int64))
    assert middle[0, 0] == 0.5


def test_the_stroke_path_is_the_papers() -> None:
    path = stroke.stroke_path(SCENE, 10.0)
    begin, end = stroke.stroke_window_s(10.0)
    inside = (path.times_s >= begin) & (path.times_s <= end)
    local = path.positions_world_m[inside] - AXIS
    angles = np.degrees(np.arctan2(local[:, 1], local[:, 2]))
    assert angles[0] == pytest.approx(0.0, abs=1e-9)
    assert angles[-1] == pytest.approx(60.0)
    np.testing.assert_allclose(np.hypot(local[:, 1], local[:, 2]), RADIUS)
    assert np.all(np.diff(path.times_s) > 0)


def test_a_track_needs_samples() -> None:
    with pytest.raises(ExperimentError, match="1 samples of fingertip"):
        stroke.make_motion([(0, np.zeros(3))], "fingertip")


def make_recording(
    windows_ns: dict[str, tuple[int, int]], **changes: Any
) -> stroke.StrokeRecording:
    """Return a recording with motions of two samples at the origin."""
    rest = stroke.SampledMotion(TIMES[:2], np.zeros((2, 3)))
    return stroke.StrokeRecording(
        scene=SCENE,
        fingertip=rest,
        finger=rest,
        windows_ns=windows_ns,
        measured_edges=(rest, rest),
        true_edges=(rest, rest),
        delays_s={},
        drops=0,
        **changes,
    )


@pytest.mark.parametrize("command", ["stroke", "tilt", "push"])
def test_a_scene_without_a_cylinder_is_refused_before_the_graph_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str
) -> None:
    def start(*_: object) -> None:
        raise AssertionError("the graph starts")

    monkeypatch.setattr("flexsheet.launch.experiments.run.precompute_graph", start)
    options = ["--launch", "demo", "--scene", "plane", "--output", str(tmp_path)]
    result = CliRunner().invoke(app, ["experiment", command, *options])
    assert isinstance(result.exception, UnfitGeometryError)
    assert 'is "plane", expected "cylinder"' in str(result.exception)


def test_a_missing_stroke_is_named_with_what_there_is() -> None:
    recording = make_recording({"wandering": (0, 1)})
    with pytest.raises(
        ExperimentError, match=r"not contain the finger path .*it contains: wandering"
    ):
        stroke.stroke_errors(recording, 10.0)


@pytest.mark.parametrize(
    ("reports", "fraction"),
    [
        # The first and the last report are outside of the stroke.
        ([(0.0, True), (4.0, True), (6.0, False), (8.0, False), (13.0, True)], 1 / 3),
        ([(0.0, True), (13.0, True)], None),
    ],
)
def test_the_load_of_computers_is_counted_during_the_stroke(
    tmp_path: Path, reports: list[tuple[float, bool]], fraction: float | None
) -> None:
    bag = tmp_path / "stroke.mcap"
    with BagWriter(bag) as writer:
        for number, (seconds, busy) in enumerate(reports, start=1):
            status = HostStatus(
                host="main", run="1", plan_hash="", code="", python="3.11", uptime_s=1.0,
                load_ratio=8.0 if busy else 1.0, disk_free_bytes=0, memory_free_bytes=0, nodes=(),
                missing_devices=(),
            )  # fmt: skip
            at_ns = round(seconds * 1e9)
            header = Header(number, at_ns, at_ns, "test", "launch", 1)
            writer.write(TOPICS["host"], status, header, at_ns)
    recording = make_recording(
        {stroke.stroke_label(10.0): (0, round(12.5e9))}, loads=stroke.read_loads(bag)
    )
    found = stroke.compute_busy_fraction(recording, 10.0)
    assert found == (None if fraction is None else pytest.approx(fraction))


def test_size_errors_are_absolute_differences_in_mm() -> None:
    picture = image.EyeImage(
        "case", "none", 0.001, np.full((2, 2, 3), 10, np.uint8), np.full((2, 2, 3), 12, np.uint8)
    )
    errors = image.size_errors_mm(picture, lambda pixels, scale: (float(pixels[0, 0, 0]) * scale,))
    assert errors == [pytest.approx(2.0)]


def test_tilt_and_push_paths_agree_with_their_labels() -> None:
    hover = image.tilt_path(SCENE, -40.0).positions_world_m[-1] - AXIS
    assert np.degrees(np.arctan2(hover[1], hover[2])) == pytest.approx(-40.0)
    assert np.linalg.norm(hover) == pytest.approx(RADIUS + image.HOVER_M)
    push = image.push_path(SCENE, 30.0)
    np.testing.assert_allclose(push.positions_world_m[0], [0.0, 0.0, image.HOVER_M], atol=1e-7)
    np.testing.assert_allclose(push.positions_world_m[-1], [0.0, 0.0, -0.03], atol=1e-7)


def test_rows_have_the_papers_sizes_and_a_missing_image_is_named() -> None:
    white = np.zeros((400, 400, 3), np.uint8)
    white[150:250, 100:300] = 255
    wider = np.zeros_like(white)
    wider[150:250, 95:305] = 255
    series = replace(image.PUSH, values=(10,))
    pictures = {
        label: image.EyeImage(label, correction, 0.001, wider, white)
        for correction in image.CORRECTIONS
        for label in [series.label(10, correction)]
    }
    rows = image.make_rows(pictures, series)
    assert [row["method"] for row in rows] == list(image.CORRECTIONS)
    assert rows[0]["depth_mm"] == 10
    assert rows[0]["delta_h_mm"] == pytest.approx(0.0, abs=1e-6)
    assert rows[0]["delta_w_mm"] == pytest.approx(10.0, abs=0.1)
    assert rows[0]["mean_mm"] == pytest.approx(5.0, abs=0.1)
    pictures.popitem()
    with pytest.raises(ExperimentError, match="not contain the image"):
        image.make_rows(pictures, series)


def make_family() -> Family:
    def trials(scene: Scene) -> list[Trial]:
        return [
            Trial("good", {"depth_mm": 5}, lambda: 1.0, lambda value: value - 1.0, True),
            Trial("good", {"depth_mm": 20}, lambda: 3.0, lambda value: value - 1.0, False),
        ]

    return Family(
        name="example",
        unit="mm",
        reference="the number one",
        methods=("good",),
        trials=trials,
        tolerance=lambda scene: 0.5,
    )


def test_a_chart_is_measured_drawn_and_written(tmp_path: Path) -> None:
    family = make_family()
    points = [measure(trial, repeats=3) for trial in family.trials(SCENE)]
    result = make_chart_result(family, SCENE, points)
    assert [point["error"] for point in result["points"]] == [0.0, 2.0]
    assert result["front"] == ["good"]
    picture, numbers = write_chart(result, tmp_path / "charts")
    assert '"depth_mm": 20' in numbers.read_text()
    assert result["machine"]
    drawn = picture.read_text()
    assert f"stroke: {INK}" in drawn
    write_chart(result, tmp_path / "charts")
    assert picture.read_text() == drawn, "the same numbers give the same picture"


def test_each_trial_is_measured_before_the_next_is_asked_for() -> None:
    family = make_family()

    def trials(scene: Scene) -> Iterator[Trial]:
        for trial in family.trials(scene):
            opened = [trial]
            yield replace(trial, run=lambda trial=trial, opened=opened: (opened[0], trial.run())[1])
            opened.clear()

    measured = measure_family(replace(family, trials=trials), SCENE, repeats=2)
    assert [point.method for point in measured] == [t.method for t in family.trials(SCENE)]


def test_what_numpy_answers_can_be_written(tmp_path: Path) -> None:
    family = make_family()
    trial = next(iter(family.trials(SCENE)))
    whether = np.array([1.0])[0] > 0.5
    points = [measure(replace(trial, in_range=whether, in_scene=whether), repeats=3)]
    _, numbers = write_chart(make_chart_result(family, SCENE, points), tmp_path)
    assert json.loads(numbers.read_text())["points"][0]["in_range"] is True


CHOICES = {
    "sheet-shape": SheetShapeMethod,
    "correction": Correction,
    "soft-body": SoftBodyMethod,
}


@pytest.mark.parametrize("family", CHOICES)
def test_the_pages_chart_shows_every_method_that_can_be_chosen(family: str) -> None:
    points = json.loads((CHARTS / f"{family}.json").read_text())["points"]
    shown = {point["method"].partition(",")[0].replace(" ", "_") for point in points}
    assert set(get_args(CHOICES[family])) <= shown, f"flexsheet chart {family} -o docs/charts"


def test_charts_are_collected_on_a_page(tmp_path: Path) -> None:
    family = make_family()
    points = [measure(trial, repeats=3) for trial in family.trials(SCENE)]
    write_chart(make_chart_result(replace(family, sweep_key="depth_mm"), SCENE, points), tmp_path)
    page = render_overview(tmp_path)
    assert "## example" in page
    assert "| 0 | 2 | 1 of 2 | yes |" in page
    assert "example.svg" in page


def test_an_unknown_family_gets_a_suggestion() -> None:
    with pytest.raises(UnknownFamilyError, match='did you mean "correction"'):
        find_family("corection")


def test_the_front_holds_what_nothing_beats_and_ignores_what_is_out_of_range() -> None:
    def point(
        method: str, time_s: float, error: float, in_range: bool = True, depth_mm: int = 1
    ) -> Point:
        case: dict[str, float | int | str] = {"depth_mm": depth_mm}
        return Point(method, case, case, time_s, time_s, error, in_range)

    points = [
        point("cheap", 1.0, 9.0),
        point("dear", 9.0, 1.0),
        point("bad", 9.0, 9.0),
        point("cheap", 1.0, 99.0, in_range=False),
        point("shallow", 0.5, 0.0, depth_mm=0),
        point("dear", 9.0, 0.0, depth_mm=0),
    ]
    assert pareto_front(points) == ["shallow", "cheap", "dear"]


def test_a_difference_within_the_spread_does_not_dominate() -> None:
    def point(method: str, time_s: float, error: float, spread: float) -> Point:
        limits = time_s * (1 - spread), time_s * (1 + spread)
        return Point(method, {}, {}, time_s, time_s, error, True, median_range_s=limits)

    assert pareto_front([point("one", 1.0, 1.0, 0.01), point("other", 1.1, 1.0, 0.01)]) == ["one"]
    both = [point("one", 1.0, 1.0, 0.1), point("other", 1.1, 1.0, 0.1)]
    assert pareto_front(both) == ["one", "other"]


def test_intervals_contain_the_truth_as_often_as_stated() -> None:
    random = np.random.default_rng(4)
    medians = [estimate_median(random.standard_normal(30).tolist()) for _ in range(200)]
    assert 0.9 < np.mean([one.low <= 0.0 <= one.high for one in medians]) < 0.995


def test_the_interval_of_a_median_is_symmetric() -> None:
    few, many = estimate_median(range(7)), estimate_median(range(8))
    assert (few.low, few.high) == (0.0, 6.0)
    assert (many.low, many.high) == (1.0, 6.0)


def test_json_never_holds_nan() -> None:
    assert replace_non_finite({"a": [float("nan"), 1.0]}) == {"a": [None, 1.0]}
