"""Test the evaluation of following: known errors, lost contact and interruptions."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.bags.report import make_result, read_session
from flexsheet.launch.commands.experiment import print_followed
from flexsheet.launch.experiments import ExperimentError, stroke
from flexsheet.launch.experiments.followed import read_followed, read_followed_path, summarize_path
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.scene import Plane, Sphere
from flexsheet.messages.types import TwinArms, TwinFinger
from flexsheet.nodes.models.rigid import apply, inverse, rotation_from_vector
from flexsheet.nodes.models.shapes import CylinderShape, make_shape
from flexsheet.nodes.twin.paths import map_to_surface
from tests import sessions
from tests.arm_states import arm_state
from tests.examples import long_except

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SECONDS, RATE_HZ = 2.0, 50
LABEL = "hand"


def write_hand(
    path: Path,
    *,
    height_m: Callable[[float], float] = lambda _: 0.0,
    mode: Callable[[float], str] = lambda _: "follow",
    phase: Callable[[float], str] = lambda _: "contact",
) -> Path:
    """Write a finger on the scene's cylinder for two seconds, with the sheet's error of `sessions`.

    height_m: of the finger above the object. mode: of the left arm. phase: of the target.
    """
    with BagWriter(path, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        desk.write("scene", sessions.SCENE, 0.0)
        for i in range(-10, round((SECONDS + 0.2) * RATE_HZ)):
            seconds = i / RATE_HZ
            _write_step(desk, seconds, height_m(seconds), mode(seconds), phase(seconds))
    return path


def _write_step(desk: Any, seconds: float, height_m: float, mode: str, phase: str) -> None:
    angle_rad = 0.3 * np.clip(seconds / SECONDS, 0.0, 1.0)
    pose = sessions.sheet_at(float(angle_rad))
    out = np.array([0.0, np.sin(angle_rad), np.cos(angle_rad)])
    at_ns = sessions.START_NS + round(seconds * 1e9)
    desk.write("sheet_target", sessions.target(pose, phase, at_ns), seconds)
    for side in ("left", "right"):
        state = arm_state(
            side,
            mode=mode if side == "left" else "follow",
            world_from_flange=sessions.flange(side, pose),
        )
        desk.write(f"arm_{side}", state, seconds)
    arms = TwinArms(
        joints_left_rad=np.zeros(6),
        joints_right_rad=np.zeros(6),
        world_from_flange_left=sessions.flange("left", pose),
        world_from_flange_right=sessions.flange("right", pose),
    )
    desk.write("twin/arms", arms, seconds)
    finger = TwinFinger(
        path_label=LABEL,
        path_done=seconds >= SECONDS,
        path_time_s=seconds,
        position_world_m=sessions.finger_at(float(angle_rad)) + height_m * out,
        velocity_world_m_per_s=np.zeros(3),
    )
    desk.write("twin/finger", finger, seconds)


def test_a_known_error_comes_out_of_the_bag(tmp_path: Path) -> None:
    (row,) = read_followed(write_hand(tmp_path / "a.mcap"))
    radius_m = sessions.SCENE.object.geometry.radius_m  # type: ignore[union-attr]  # it is a cylinder
    off_mm = 1e3 * np.hypot(sessions.OFF_M, radius_m * sessions.TURNED_RAD)
    distance, angle = (row["contact"][f"true_delta_{key}"] for key in ("d_mm", "theta_deg"))
    assert row["path"] == LABEL
    assert row["seconds"] == pytest.approx(SECONDS, abs=1.5 / RATE_HZ)
    assert (row["contact_ratio"], row["following_ratio"], row["drop_outs"]) == (1.0, 1.0, 0)
    for key in ("mean", "p95", "max"):
        assert distance[key] == pytest.approx(off_mm, rel=0.025), key
        assert angle[key] == pytest.approx(np.degrees(sessions.TURNED_RAD), rel=0.025), key


def test_only_contact_counts(tmp_path: Path) -> None:
    """From 0.5 s to 1.5 s the finger is 10 mm above the object, without a required contact."""
    lifted = write_hand(tmp_path / "a.mcap", height_m=lambda s: 0.01 * (0.5 <= s < 1.5))
    (row,) = read_followed(lifted)
    assert row["contact_ratio"] == pytest.approx(0.5, abs=0.02)
    assert row["contact"]["true_delta_d_mm"]["max"] < 1.0
    away = write_hand(tmp_path / "b.mcap", height_m=lambda _: 0.01)
    (row,) = read_followed(away)
    assert row["contact_ratio"] == 0.0
    assert row["following_ratio"] is None
    assert row["contact"] == {"true_delta_d_mm": None, "true_delta_theta_deg": None}


@pytest.mark.parametrize("by", ["arm", "planner"])
def test_drop_outs_are_counted_in_contact(tmp_path: Path, by: str) -> None:
    """Two occur in contact, for 0.3 s and 0.2 s; a third, without the finger, does not count."""

    def out(s: float) -> bool:
        return 0.2 <= s < 0.5 or 0.7 <= s < 0.9 or 1.3 <= s < 1.5

    bag = write_hand(
        tmp_path / "a.mcap",
        height_m=lambda s: 0.02 * (1.2 <= s < 1.6),
        mode=lambda s: "fault" if by == "arm" and out(s) else "follow",
        phase=lambda s: "hold" if by == "planner" and out(s) else "contact",
    )
    (row,) = read_followed(bag)
    assert row["drop_outs"] == 2
    assert row["contact_ratio"] == pytest.approx(0.8, abs=0.02)
    assert row["following_ratio"] == pytest.approx(1.1 / 1.6, abs=0.02)


def test_the_report_agrees(tmp_path: Path) -> None:
    bag = write_hand(tmp_path / "a.mcap", mode=lambda s: "hold" if 1.0 <= s < 1.2 else "follow")
    numbers = make_result(read_session(bag))
    (row,) = numbers["sheet"]["followed"]
    assert [row] == read_followed(bag)
    assert {"gravity": "doubtful", "text": "hand: the arms stopped 1 times in contact."} in numbers[
        "findings"
    ]


def test_the_demo_uses_its_own_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_hand(tmp_path / "a.mcap")
    row = read_followed_path(bag, LABEL)
    json.dumps(row, allow_nan=False)
    print_followed([row])
    assert LABEL in capsys.readouterr().out
    with pytest.raises(
        ExperimentError, match='does not contain the finger path "wave"; it contains: hand'
    ):
        read_followed_path(bag, "wave")


@given(count=st.integers(1, 100), seed=st.integers(0, 2**32 - 1))
def test_figures_of_a_path_are_those_of_its_exposures(count: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    d, theta = generator.uniform(1e-4, 1e-2, (2, count))
    height = generator.uniform(-0.002, 0.003, count)
    following = generator.random(count) < 0.7
    contact = height <= 0.001
    drop_outs, dropped = 0, False
    for touches, follows in zip(contact, following, strict=True):
        dropped = dropped and not follows
        if touches and not follows and not dropped:
            drop_outs, dropped = drop_outs + 1, True
    found = summarize_path(d, theta, height, following)
    assert found["drop_outs"] == drop_outs
    assert found["contact_ratio"] == contact.mean()
    if contact.any():
        sizes = found["contact"]["true_delta_d_mm"]
        assert sizes["mean"] == pytest.approx(1e3 * d[contact].mean())
        assert sizes["p95"] == pytest.approx(1e3 * np.quantile(d[contact], 0.95))
        assert sizes["max"] == pytest.approx(1e3 * d[contact].max())
        assert found["following_ratio"] == following[contact].mean()


# Shapes other than the paper's cylinder.


TIMES = np.arange(5, dtype=np.int64) * 10_000_000


def sheet(centre: Floats, normal: Floats) -> tuple[stroke.SampledMotion, stroke.SampledMotion]:
    """Return both edges of a resting sheet, 240 mm wide."""
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    along = np.cross(normal, across)
    left, right = (
        stroke.SampledMotion(
            TIMES, np.tile(np.concatenate([centre + half * across, along, normal]), (5, 1))
        )
        for half in (-0.12, 0.12)
    )
    return left, right


@given(
    axis=st.sampled_from(["x", "y"]),
    lag_rad=st.floats(-0.05, 0.05),
    lifted_m=st.floats(-0.005, 0.005),
    depth_m=st.floats(0.0, 0.01),
)
def test_a_known_lag_and_lift_on_a_sphere(
    axis: str, lag_rad: float, lifted_m: float, depth_m: float
) -> None:
    radius_m = 0.08
    pose = sessions.SCENE.object.world_from_object
    solid = sessions.SCENE.object.model_copy(update={"geometry": Sphere(radius_m=radius_m)})
    scene = sessions.SCENE.model_copy(update={"object": solid})
    turn = rotation_from_vector(lag_rad * np.eye(3)["xy".index(axis)])
    front = np.array([0.0, 0.0, 1.0])
    normal = turn @ front
    finger = stroke.SampledMotion(
        TIMES, np.tile(pose.position_m + (radius_m - depth_m) * front, (5, 1))
    )
    edges = sheet(pose.position_m + (radius_m + lifted_m) * normal, normal)
    delta_d, delta_theta = stroke.sheet_errors(scene, finger, edges, TIMES)
    chord = 2.0 * np.sqrt(radius_m * (radius_m + lifted_m)) * np.sin(0.5 * lag_rad)
    np.testing.assert_allclose(delta_theta, abs(lag_rad), atol=1e-9)
    np.testing.assert_allclose(delta_d, np.hypot(lifted_m, chord), atol=3e-6)


@given(turned_rad=st.floats(-0.05, 0.05), lifted_m=st.floats(-0.005, 0.005))
def test_a_flat_object_presents_the_foot_itself(turned_rad: float, lifted_m: float) -> None:
    plane = Plane(width_m=0.2, height_m=0.2)
    pose = sessions.SCENE.object.world_from_object
    solid = sessions.SCENE.object.model_copy(update={"geometry": plane})
    scene = sessions.SCENE.model_copy(update={"object": solid})
    normal = np.array([0.0, np.sin(turned_rad), np.cos(turned_rad)])
    finger = stroke.SampledMotion(TIMES, np.tile(pose.position_m, (5, 1)))
    edges = sheet(pose.position_m + lifted_m * normal, normal)
    delta_d, delta_theta = stroke.sheet_errors(scene, finger, edges, TIMES)
    np.testing.assert_allclose(delta_theta, abs(turned_rad), atol=1e-9)
    np.testing.assert_allclose(delta_d, abs(lifted_m), atol=1e-9)


@given(angle_rad=st.floats(-1.0, 1.0), lag_rad=st.floats(-0.05, 0.05))
def test_the_general_definition_is_the_papers_on_a_cylinder(
    angle_rad: float, lag_rad: float
) -> None:
    radius_m = 0.09
    shape = CylinderShape(radius_m=radius_m, length_m=0.2)
    finger = radius_m * np.array([[0.0, np.sin(angle_rad), np.cos(angle_rad)]])
    normal = np.array([[0.0, np.sin(angle_rad + lag_rad), np.cos(angle_rad + lag_rad)]])
    centre = 1.01 * radius_m * normal + [[0.05, 0.0, 0.0]]
    found = stroke.project_presented_point(shape.closest(finger), centre, normal)
    np.testing.assert_allclose(found, 1.01 * radius_m * normal, atol=3e-6)


@pytest.mark.parametrize("name", long_except(["ellipsoid", "organ"], "ellipsoid"))
def test_a_sheet_that_lags_on_a_curved_object_is_off_by_the_chord(name: str) -> None:
    scene = load_scene(ROOT / "launch" / "scenes" / f"{name}.yaml")
    count, lag = 200, 4
    ways = np.column_stack([np.linspace(-0.02, 0.02, count), np.linspace(-0.01, 0.03, count)])
    points = map_to_surface(scene, np.column_stack([ways, np.zeros(count)]))
    world_from_object = stroke.object_pose(scene)
    shape = make_shape(dict(scene.object.geometry))
    foot = shape.closest(apply(inverse(world_from_object), points))
    normals = foot.normal @ world_from_object[:3, :3].T
    across = np.cross([0.0, 1.0, 0.0], normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normals, across)
    times = np.arange(count, dtype=np.int64) * 10_000_000
    late = np.maximum(np.arange(count) - lag, 0)
    left, right = (
        stroke.SampledMotion(times, np.hstack([points + half * across, along, normals])[late])
        for half in (-0.12, 0.12)
    )
    finger = stroke.SampledMotion(times, points)
    delta_d, _ = stroke.sheet_errors(scene, finger, (left, right), times, shape=shape)
    chord = np.linalg.norm(points - points[late], axis=1)
    np.testing.assert_allclose(delta_d[lag:], chord[lag:], rtol=0.1)
