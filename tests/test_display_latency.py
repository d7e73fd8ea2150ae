"""Test the measurement of the projector's latency with the stereo camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.calibration.commission import StepName, list_doubts, summarize
from flexsheet.launch.calibration.commission_steps import open_laboratory
from flexsheet.launch.calibration.delays import MeasuredDelays, MeasuredLag
from flexsheet.launch.calibration.display_latency import (
    MIN_SWITCHES,
    DisplayLatencyError,
    SwitchImage,
    classify_images,
    estimate_display_latency,
    read_switch_images,
    simulate_switch_images,
)
from flexsheet.launch.experiments.run import SWITCH_INTERVAL_S
from flexsheet.launch.plans.documents import edit_yaml
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import NOMINAL_DISPLAY_LATENCY_S, nominal_apparatus
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Frame, Pattern, Side, StereoPair

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(SCENE_FILE)
EXPOSURE_S, JITTER_S = 0.004, 0.001


def switch(
    latency_s: float,
    *,
    count: int = 60,
    wrong_ratio: float = 0.05,
    rate_hz: float = 60.0,
    seed: int = 1,
) -> list[SwitchImage]:
    """Return images of a camera that sees each switch after a latency, with jitter and errors."""
    random = np.random.default_rng(seed)
    switched_s = np.cumsum(random.uniform(*SWITCH_INTERVAL_S, count))
    images = []
    for middle_s in np.arange(switched_s[0], switched_s[-1] + 0.2, 1.0 / rate_hz):
        at_s = switched_s[np.searchsorted(switched_s, middle_s, side="right") - 1]
        is_new = middle_s + JITTER_S * random.standard_normal() > at_s + latency_s
        is_new ^= random.uniform() < wrong_ratio
        begin_s, end_s = middle_s - 0.5 * EXPOSURE_S, middle_s + 0.5 * EXPOSURE_S
        images.append(SwitchImage(float(at_s), begin_s, end_s, bool(is_new)))
    return images


@pytest.mark.parametrize("latency_s", [0.0, 0.020, 0.045, 0.120])
@pytest.mark.parametrize("wrong_ratio", [0.0, 0.05])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_latency_is_found_despite_jitter_and_wrong_images(
    latency_s: float, wrong_ratio: float, seed: int
) -> None:
    found = estimate_display_latency(switch(latency_s, wrong_ratio=wrong_ratio, seed=seed))
    assert found.lag_s == pytest.approx(latency_s, abs=0.002)
    assert abs(found.lag_s - latency_s) < 4.0 * found.uncertainty_s
    assert 5e-5 < found.uncertainty_s < 0.001


def test_images_at_a_constant_phase_leave_the_latency_uncertain() -> None:
    """Images at 5 and 25 ms after each switch only show that the latency is between both."""
    images = [
        SwitchImage(at_s, at_s + age_s, at_s + age_s, age_s > 0.02)
        for at_s in np.arange(0.0, 30.0, 0.3).tolist()
        for age_s in (0.005, 0.025, 0.2)
    ]
    found = estimate_display_latency(images)
    assert 0.005 < found.lag_s < 0.025
    assert found.uncertainty_s > 0.004


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ([], "contain 0 switches of the projected image, but at least 20 are required"),
        (switch(0.02, count=MIN_SWITCHES - 1), "contain 19 switches of the projected image"),
        (
            [replace(one, is_new=False) for one in switch(0.02)],
            "only 0 of .* images that were taken more than 150 ms after a switch",
        ),
        ([one for one in switch(0.02) if one.end_s < one.switched_s + 0.1], "only 0 of 0 images"),
    ],
    ids=["none", "few", "not seen", "too short"],
)
def test_images_that_do_not_show_enough_switches_are_refused(
    images: list[SwitchImage], words: str
) -> None:
    with pytest.raises(DisplayLatencyError, match=words):
        estimate_display_latency(images)


def test_images_without_contrast_are_refused() -> None:
    switches = [(0.3 * number, number % 2 == 0) for number in range(30)]
    exposures = [(at_s, at_s + 0.004, 20.0 + at_s % 2.0) for at_s in np.arange(0.0, 9.0, 0.016)]
    with pytest.raises(
        DisplayLatencyError, match=r"no switch between black and white .* differ by 1\.0"
    ):
        classify_images(switches, exposures)


@pytest.mark.parametrize(("seed", "offset_s"), [(1, 0.0), (2, 0.012), (3, 0.027)])
def test_the_latency_of_a_simulated_projector_is_found_in_images(
    seed: int, offset_s: float
) -> None:
    apparatus = nominal_apparatus(SCENE)
    projector = apparatus.projector.model_copy(update={"latency_offset_s": offset_s})
    camera = apparatus.camera.model_copy(update={"exposure_jitter_s": 0.001})
    apparatus = apparatus.model_copy(update={"projector": projector, "camera": camera})
    found = estimate_display_latency(simulate_switch_images(SCENE, apparatus, seed=seed))
    true_s = NOMINAL_DISPLAY_LATENCY_S + offset_s
    assert found.lag_s == pytest.approx(true_s, abs=min(0.001, 4.0 * found.uncertainty_s))


def test_switches_are_read_from_a_bag(tmp_path: Path) -> None:
    """A frame that a newer one replaced has no display time, and does not count."""
    latency_s, random = 0.03, np.random.default_rng(4)
    switched_s = 1.0 + np.cumsum(random.uniform(*SWITCH_INTERVAL_S, 30))
    rows: list[tuple[float, str, Frame | StereoPair]] = []

    def draw(at_s: float, pattern: Pattern, *, shown: bool = True) -> None:
        at_ns = round(1e9 * at_s)
        frame = Frame(
            number=1,
            correction="two_pass",
            stereo="mono",
            label="",
            pattern=pattern,
            eyes_world_m=np.zeros((2, 3)),
            world_from_sheet=np.eye(4),
            pushed_point_world_m=np.zeros(3),
            predicted_to_ns=at_ns,
            draw_s=0.0,
            drawn_ns=at_ns - 5_000_000,
            swapped_ns=at_ns if shown else 0,
            light_ns=at_ns + 8_000_000 if shown else 0,
            late_frames=0,
            pixels=(),
        )
        rows.append((at_s, "frame", frame))

    draw(0.5, "object")
    draw(0.6, "black")
    for number, at_s in enumerate(switched_s.tolist()):
        pattern: Pattern = "black" if number % 2 else "white"
        draw(at_s - 0.01, pattern, shown=False)
        draw(at_s, pattern)
        draw(at_s + 0.033, pattern)
    for at_s in np.arange(0.5, switched_s[-1] + 1.0, 1.0 / 60.0).tolist():
        is_white = np.searchsorted(switched_s + latency_s, at_s) % 2
        image = np.full((4, 6), 120 if is_white else 20, np.uint8)
        pair = StereoPair(
            device="test", exposure_s=EXPOSURE_S, dropped_frames=0, left=image, right=image
        )
        rows.append((at_s, "stereo", pair))
    bag = tmp_path / "switches.mcap"
    with BagWriter(bag) as writer:
        for number, (at_s, topic, message) in enumerate(sorted(rows, key=lambda row: row[0])):
            at_ns = round(1e9 * at_s)
            header = Header(number, at_ns, at_ns, "test", "node", 1)
            writer.write(TOPICS[topic], message, header, at_ns)
    images = read_switch_images(bag)
    assert sorted({one.switched_s for one in images}) == pytest.approx(switched_s, abs=1e-8)
    found = estimate_display_latency(images)
    assert found.lag_s == pytest.approx(latency_s, abs=0.001)


def test_a_bag_without_switches_has_no_switch_images(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "empty.mcap"):
        pass
    assert read_switch_images(tmp_path / "empty.mcap") == []


@pytest.mark.parametrize(
    ("output", "added_s"), [("headless", 0.0), ("window", 0.0), ("window", 0.003)]
)
def test_the_latency_goes_to_the_renderer_in_a_common_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str, added_s: float
) -> None:
    """A window shows a frame for 1/30 s; the bag already contains a part of the stamp offset."""
    steps = "flexsheet.launch.calibration.commission_steps"
    demo = SCENE_FILE.parent.parent / "demo.yaml"
    with edit_yaml(demo, tmp_path / "launch.yaml") as tree:
        tree["scene"] = str(SCENE_FILE)
        tree["nodes"]["triangulator"].pop("parameters")
        tree["nodes"]["camera"]["parameters"]["stamp_offset_s"] = added_s
        tree["nodes"]["renderer"]["parameters"] = {"rate_hz": 30.0, "output": output}
    (tmp_path / "stroke.mcap").touch()
    servo: dict[Side, MeasuredLag] = {"left": MeasuredLag(0.04, 1e-3)}
    delays = MeasuredDelays(servo, MeasuredLag(0.004, 2e-4))
    monkeypatch.setattr(f"{steps}.read_delays", lambda *_: delays)
    images = switch(0.020)

    def read(_: Path, offset_s: float) -> list[SwitchImage]:
        return [
            replace(one, start_s=one.start_s + offset_s, end_s=one.end_s + offset_s)
            for one in images
        ]

    monkeypatch.setattr(f"{steps}.read_switch_images", read)
    lab, devices = open_laboratory(
        tmp_path / "lab",
        tmp_path / "launch.yaml",
        data={StepName.DELAYS: tmp_path / "stroke.mcap"},
    )
    result = lab.run(StepName.DELAYS, devices.steps[StepName.DELAYS])
    expected_ms = 20.0 + 4.0 - 1e3 * added_s + (0.5e3 / 30.0 if output == "window" else 0.0)
    assert result.figures["display_latency_ms"] == pytest.approx(expected_ms, abs=1.0)
    assert result.uncertainty["display_latency_ms"] > 0.2
    written = load_graph(lab.launch_copy).nodes["renderer"].parameters["display_latency_s"]
    assert written == pytest.approx(1e-3 * expected_ms, abs=1e-3)
    images.clear()
    result = lab.run(StepName.DELAYS, devices.steps[StepName.DELAYS])
    (missing,) = result.missing
    assert missing.quantity == "display_latency"
    assert "0 switches" in missing.reason
    assert "--switches 60" in missing.reason
    assert result.uncertainty.keys() == {"left_lag_ms", "stamp_offset_ms"}
    nodes = load_graph(lab.launch_copy).nodes
    assert nodes["arm_left_bridge"].parameters["servo_lag_s"] == 0.04
    before = load_graph(tmp_path / "launch.yaml").nodes["renderer"].parameters
    assert nodes["renderer"].parameters["display_latency_s"] == before["display_latency_s"]
    figures: dict[str, Any] = {"predicted": {}, "flagged": []}
    doubts = list_doubts(lab.state.steps, figures, (0.2, 0.5))
    assert doubts == [f"step delays: display_latency was not measured: {missing.reason}"]
    (row,) = summarize(lab)["steps"]
    assert row["missing"] == [missing.model_dump()]
