"""Test the lag of displayed images, with images of known lag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.experiments import stroke
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.types import Frame

Floats = NDArray[np.float64]

SCENE = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
RADIUS = 0.0353553
SECONDS = 10.0
BEGIN_S = stroke.stroke_window_s(SECONDS)[0]


def angle(times_s: Floats) -> Floats:
    """Return the angle of a wandering stroke about the cylinder's axis."""
    wander = 0.01 * np.sin(2 * np.pi * 0.7 * times_s) + 0.006 * np.sin(2 * np.pi * 1.9 * times_s)
    return np.asarray(np.radians(6.0) * (times_s - BEGIN_S) + wander)


def axes(times_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Return contact point, y and z axis (n, 3) of a sheet that is tangent at the finger."""
    a, zero = angle(times_s), np.zeros(len(times_s))
    normal = np.column_stack([zero, np.sin(a), np.cos(a)])
    return RADIUS * normal - [0, 0, RADIUS], np.column_stack([zero, np.cos(a), -np.sin(a)]), normal


def edge(times_s: Floats, x_m: float) -> stroke.SampledMotion:
    centre, y, z = axes(times_s)
    rows = np.hstack([centre + np.array([x_m, 0.0, 0.0]), y, z])
    return stroke.SampledMotion(np.asarray(times_s * 1e9, np.int64), rows)


def frame(light_s: float, mark_lag_s: float, sheet_lag_s: float, dent_lag_s: float) -> Frame:
    point, _, _ = axes(np.array([light_s - mark_lag_s]))
    centre, y, z = axes(np.array([light_s - sheet_lag_s]))
    pose = np.eye(4)
    pose[:3, 1], pose[:3, 2], pose[:3, 3] = y[0], z[0], centre[0]
    return Frame(
        number=1,
        correction="two_pass",
        stereo="mono",
        label="",
        eyes_world_m=np.zeros((2, 3)),
        world_from_sheet=pose,
        pushed_point_world_m=np.zeros(3),
        predicted_to_ns=0,
        draw_s=0.0,
        late_frames=0,
        light_ns=round(light_s * 1e9),
        shaped_for_ns=round((light_s - dent_lag_s) * 1e9),
        fingertip_world_m=point,
        pixels=(),
    )


def recording(pictures: stroke.DrawnFrames) -> stroke.StrokeRecording:
    times = np.arange(0.0, 13.0, 1 / 120)
    finger = stroke.SampledMotion(np.asarray(times * 1e9, np.int64), axes(times)[0])
    edges = edge(times, -0.125), edge(times, 0.125)
    return stroke.StrokeRecording(
        scene=SCENE,
        fingertip=finger,
        finger=finger,
        windows_ns={stroke.stroke_label(SECONDS): (0, round(12.0 * 1e9))},
        measured_edges=edges,
        true_edges=edges,
        delays_s={},
        drops=0,
        frames=pictures,
    )


@pytest.mark.parametrize("lag_s", [-0.007, 0.0, 0.012])
def test_the_lag_of_marker_sheet_and_indentation_is_reported(lag_s: float) -> None:
    pictures = stroke.DrawnFrames([], [], [])
    for light_s in np.arange(0.1, 12.0, 1 / 15):
        pictures.add(frame(float(light_s), lag_s, 2.0 * lag_s, 0.02))
    reported = stroke.visible_lag_ms(recording(pictures), SECONDS)
    assert reported["fingertip"] == pytest.approx(1e3 * lag_s, abs=0.5)
    assert reported["sheet"] == pytest.approx(2e3 * lag_s, abs=0.5)
    assert reported["object"] == pytest.approx(20.0)


def test_too_few_images_give_no_lag() -> None:
    pictures = stroke.DrawnFrames([], [], [])
    pictures.add(frame(3.0, 0.0, 0.0, 0.0))
    pictures.add(frame(3.1, 0.0, 0.0, 0.0).model_copy(update={"light_ns": 0}))
    reported = stroke.visible_lag_ms(recording(pictures), SECONDS)
    assert reported == {"fingertip": None, "sheet": None, "object": 0.0}
    empty = stroke.visible_lag_ms(recording(stroke.DrawnFrames([], [], [])), SECONDS)
    assert empty["object"] is None
