"""Test simulated gestures of a user's finger on any object, within the scene's limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, PathJoin
from flexsheet.nodes.twin.finger import (
    FingerMotion,
    FingerPathError,
    join_points,
    minimum_jerk_profile,
)
from flexsheet.nodes.twin.gestures import (
    GESTURES,
    SAMPLE_S,
    TREMOR_ARM_M,
    WANDER_M,
    Gesture,
    integrate_speed_profile,
    minimum_jerk,
    tap,
    tap_fast,
)
from flexsheet.nodes.twin.paths import map_to_surface, place_recording
from tests.examples import examples, long_except
from tests.scenes import load_values

Floats = NDArray[np.float64]


def values() -> dict[str, Any]:
    return load_values()


SCENE = Scene.model_validate(values())


@st.composite
def scenes(draw: Callable[..., float]) -> Scene:
    """Return scenes with other objects, positions, finger speeds and volumes."""
    changed = values()
    radius = draw(st.floats(0.015, 0.06))
    place = [draw(st.floats(-0.03, 0.03)), draw(st.floats(-0.03, 0.03)), -radius]
    roll = draw(st.floats(-0.7, 0.7))
    changed["object"] |= {
        "geometry": {
            "shape": "cylinder",
            "radius_m": radius,
            "length_m": draw(st.floats(0.03, 0.2)),
        },
        "world_from_object": {"position_m": place, "rpy_rad": [roll, 0.0, 0.0]},
    }
    changed["finger"] = {
        "radius_m": 0.007,
        "max_speed_m_per_s": draw(st.floats(0.05, 2.0)),
        "volume_min_m": [-draw(st.floats(0.04, 0.2)), -draw(st.floats(0.04, 0.2)), -0.05],
        "volume_max_m": [draw(st.floats(0.04, 0.2)), draw(st.floats(0.04, 0.2)), 0.1],
    }
    return Scene.model_validate(changed)


def motion_on(
    path: FingerPath, scene: Scene, *, steady: bool = False, seed: int = 1
) -> FingerMotion:
    """Return the motion of a finger that was resting at the path's first point."""
    return FingerMotion.resting(path.positions_world_m[0], seed=seed).followed_by(
        0.0,
        times_s=path.times_s,
        points=path.positions_world_m,
        wander_m=0.0 if steady else path.wander_m,
        tremor_m=0.0 if steady else path.tremor_m,
        max_speed_m_per_s=scene.finger.max_speed_m_per_s,
        joined_by=path.joined_by,
    )


def heights(points: Floats, scene: Scene) -> Floats:
    """Return distances (n,) of world points from a cylinder along x."""
    radius_m = scene.object.geometry.radius_m
    local = points - scene.object.world_from_object.position_m
    return np.asarray(np.hypot(local[:, 1], local[:, 2]) - radius_m)


gestures = pytest.mark.parametrize("gesture", GESTURES.values(), ids=GESTURES)


@gestures
@given(scene=scenes(), seed=st.integers(0, 99))
@examples(2)
def test_a_gesture_keeps_to_the_scenes_speed_and_volume(
    gesture: Gesture, scene: Scene, seed: int
) -> None:
    path = gesture(scene, seed=seed)
    motion = motion_on(path, scene, seed=seed)
    states = [motion.at(time) for time in np.linspace(0.0, path.times_s[-1] + 1.0, 400)]
    positions = np.array([state.position for state in states])
    assert (positions >= scene.finger.volume_min_m).all()
    assert (positions <= scene.finger.volume_max_m).all()
    steady = join_points(path.times_s, path.positions_world_m, path.joined_by)
    assert steady.speeds().max() <= 0.8 * scene.finger.max_speed_m_per_s * (1.0 + 1e-9)


@gestures
def test_position_and_velocity_are_continuous_and_acceleration_is_a_hands(gesture: Gesture) -> None:
    path = gesture(SCENE)
    motion = motion_on(path, SCENE)
    step = 1e-4
    times = np.arange(0.0, path.times_s[-1] + 0.6, 1e-2)
    here, there = ([motion.at(time + after) for time in times] for after in (0.0, step))
    positions, velocities = (
        [np.array([getattr(state, name) for state in states]) for states in (here, there)]
        for name in ("position", "velocity")
    )
    mean = 0.5 * (velocities[0] + velocities[1])
    np.testing.assert_allclose((positions[1] - positions[0]) / step, mean, atol=2e-5)
    accelerations = np.linalg.norm(velocities[1] - velocities[0], axis=1) / step
    # A hand in a hurry does 1 g, unsteadiness on top; a step of the velocity would be 100 times it.
    assert accelerations.max() < 16.0


@gestures
def test_the_same_seed_gives_the_same_gesture(gesture: Gesture) -> None:
    one, same = gesture(SCENE, seed=4), gesture(SCENE, seed=4)
    assert np.array_equal(one.times_s, same.times_s)
    assert np.array_equal(one.positions_world_m, same.positions_world_m)


@pytest.mark.parametrize("name", ["reach", "reach-fast", "tap", "tap-fast", "stop", "reverse"])
def test_another_seed_gives_another_gesture(name: str) -> None:
    one, other = (GESTURES[name](SCENE, seed=seed).positions_world_m for seed in (1, 2))
    assert one.shape != other.shape or not np.allclose(one, other)


@gestures
def test_a_gesture_goes_by_its_name_in_the_table(gesture: Gesture) -> None:
    assert GESTURES[gesture(SCENE).label] is gesture


@pytest.mark.parametrize(
    ("name", "deepest_mm", "highest_mm"),
    [
        ("hold", -1.0, 40.0),
        ("hover", 20.0, 20.0),
        ("tap", -2.0, 12.0),
        ("tap-fast", -2.0, 6.0),
        ("stroke-push", -5.0, 40.0),
        ("circle", -1.0, 40.0),
    ],
)
def test_a_gesture_touches_as_deep_and_lifts_as_high_as_meant(
    name: str, deepest_mm: float, highest_mm: float
) -> None:
    height_mm = 1e3 * heights(GESTURES[name](SCENE).positions_world_m, SCENE)
    assert height_mm.min() == pytest.approx(deepest_mm, abs=0.01)
    assert height_mm.max() == pytest.approx(highest_mm, abs=0.01)


@pytest.mark.parametrize(
    ("gesture", "interval_s", "contact_s"), [(tap, 0.333, 0.12), (tap_fast, 0.185, 0.085)]
)
def test_taps_touch_as_long_and_as_often_as_people_do(
    gesture: Gesture, interval_s: float, contact_s: float
) -> None:
    path = gesture(SCENE)
    motion = join_points(path.times_s, path.positions_world_m, path.joined_by)
    times = np.arange(0.0, motion.duration_s, 2e-4)
    below = heights(np.array([motion.at(time)[0] for time in times]), SCENE) < 0.0
    touches = times[1:][below[1:] & ~below[:-1]]
    leaves = times[1:][~below[1:] & below[:-1]]
    assert np.diff(touches).mean() == pytest.approx(interval_s, rel=0.04)
    assert (leaves - touches).mean() == pytest.approx(contact_s, rel=0.05)
    assert 0.01 < np.diff(touches).std() / interval_s < 0.1


def test_a_stop_stops_in_50_ms_and_the_finger_then_rests() -> None:
    path = GESTURES["stop"](SCENE)
    motion = join_points(path.times_s, path.positions_world_m, path.joined_by)
    times = np.arange(1.2, motion.duration_s - 1.2, 1e-3)
    speeds = np.array([np.linalg.norm(motion.at(time)[1]) for time in times])
    going = speeds > 0.95 * speeds.max()
    ends = np.flatnonzero(going[:-1] & ~going[1:])
    # 12 stops; only they end at rest within 60 ms.
    assert sum(speeds[end + 60] < 1e-4 for end in ends) == 12


def test_a_reverse_turns_at_full_speed_within_100_ms() -> None:
    path = GESTURES["reverse"](SCENE)
    motion = join_points(path.times_s, path.positions_world_m, path.joined_by)
    times = np.arange(1.3, motion.duration_s - 1.15, 1e-3)
    around = np.array([motion.at(time)[1][1] for time in times])
    turns = np.flatnonzero(around[:-1] * around[1:] < 0)
    speed = SCENE.working_range.speed_m_per_s
    # Half of it is left of the upright part where the surface falls away at 60 degrees.
    before, after = around[turns - 55], around[turns + 55]
    assert (before * after < 0).all()
    assert (np.minimum(np.abs(before), np.abs(after)) > 0.4 * speed).all()
    assert len(turns) == 14


@given(
    way_m=st.floats(0.001, 0.15),
    duration_s=st.floats(0.05, 2.0),
)
@settings(max_examples=40, deadline=None)
def test_a_reach_of_least_jerk_comes_out_as_it_was_meant(way_m: float, duration_s: float) -> None:
    """Its samples, interpolated by the spline, have an error below 10 um at any acceleration up to
    2 g."""
    duration_s = max(duration_s, float(np.sqrt(5.77 * way_m / 20.0)))
    times, places = minimum_jerk([0.0, 0.0, 0.0], [(duration_s, [way_m, 0.0, 0.0])])
    motion = join_points(times, places, "spline")
    between = np.linspace(0.0, duration_s, 500)
    share, rate = minimum_jerk_profile(between / duration_s)
    found = [motion.at(time) for time in between]
    np.testing.assert_allclose([at[0] for at, _ in found], way_m * share, atol=1e-5)
    peak = 1.875 * way_m / duration_s
    np.testing.assert_allclose(
        [at[0] for _, at in found], way_m * rate / duration_s, atol=0.02 * peak
    )
    assert max(at[0] for _, at in found) == pytest.approx(peak, rel=0.01)


def test_lines_with_rounded_corners_would_miss_that_reach() -> None:
    """Rounded corners instead of a spline would reduce an ordinary reach by 0.3 mm."""
    times, places = minimum_jerk([0.0, 0.0, 0.0], [(0.5, [0.05, 0.0, 0.0])])
    missed = []
    for joined_by in ("rounded_lines", "spline"):
        join: PathJoin = joined_by
        motion = join_points(times, places, join)
        errors = [
            motion.at(time)[0][0] - 0.05 * minimum_jerk_profile(time / 0.5)[0] for time in times
        ]
        missed.append(np.abs(errors).max())
    assert missed[0] > 2.5e-4
    assert missed[1] < 1e-6


@pytest.mark.parametrize("name", long_except(GESTURES, "stroke-push", "tap", "circle"))
def test_halving_the_samples_changes_no_gesture(name: str) -> None:
    """The samples describe the whole motion."""
    path = GESTURES[name](SCENE)
    whole = join_points(path.times_s, path.positions_world_m, "spline")
    keep = np.unique(np.append(np.arange(0, len(path.times_s), 2), len(path.times_s) - 1))
    half = join_points(path.times_s[keep], path.positions_world_m[keep], "spline")
    times = np.arange(0.0, whole.duration_s, 0.5 * SAMPLE_S)
    apart = [np.linalg.norm(whole.at(time)[0] - half.at(time)[0]) for time in times]
    # A spline's error falls with the fourth power of the step, with the third where jerk steps.
    assert max(apart) < 4e-5


@given(
    points=st.lists(st.tuples(*[st.floats(-0.1, 0.1)] * 3), min_size=2, max_size=8),
    step_s=st.floats(0.01, 0.5),
)
@settings(max_examples=60, deadline=None)
def test_no_smooth_path_is_faster_than_its_bound(
    points: list[tuple[float, float, float]], step_s: float
) -> None:
    times = np.linspace(0.0, step_s * (len(points) - 1), len(points))
    path = join_points(times, np.array(points), "spline")
    bounds = path.speeds()
    for piece, bound in enumerate(bounds):
        inside = np.linspace(times[piece], times[piece + 1], 40)
        assert max(np.linalg.norm(path.at(time)[1]) for time in inside) <= bound + 1e-9


def test_a_smooth_path_that_is_too_fast_between_its_samples_is_rejected() -> None:
    rest = FingerMotion.resting(np.zeros(3), seed=1)
    with pytest.raises(FingerPathError, match=r"speed .* after times_s\[0\]"):
        rest.followed_by(
            0.0,
            times_s=np.array([0.0, 0.1]),
            points=np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
            wander_m=0.0,
            tremor_m=0.0,
            max_speed_m_per_s=1.2,
            joined_by="spline",
        )


def test_one_point_is_a_rest_position_for_any_interpolation() -> None:
    path = join_points(np.zeros(1), np.array([[0.1, 0.0, 0.0]]), "spline")
    assert path.at(3.0)[0][0] == pytest.approx(0.1)


def test_speeds_integrate_to_the_path() -> None:
    times, way = integrate_speed_profile(
        [(0.2, 0.1), (0.5, 0.1), (0.05, 0.0), (0.3, 0.0), (0.1, -0.2)]
    )
    assert way[-1] == pytest.approx(0.1 * (0.1 + 0.5 + 0.025) - 0.2 * 0.05)
    assert np.abs(np.diff(way) / np.diff(times)).max() <= 0.2


def test_a_volume_that_does_not_hold_the_objects_front_is_named() -> None:
    changed = values()
    changed["finger"] |= {"volume_min_m": [0.05, -0.1, -0.1]}
    with pytest.raises(FingerPathError, match=r'path "hold": .* widen the volume'):
        GESTURES["hold"](Scene.model_validate(changed))


def test_a_turned_object_is_touched_from_the_users_side() -> None:
    changed = values()
    changed["object"]["world_from_object"]["rpy_rad"] = [2.0, 0.0, 0.0]
    turned = Scene.model_validate(changed)
    places = np.array([[0.01, 0.0, 0.02], [0.0, 0.02, 0.0]])
    np.testing.assert_allclose(
        map_to_surface(turned, places), map_to_surface(SCENE, places), atol=1e-9
    )
    np.testing.assert_allclose(map_to_surface(SCENE, places)[0], [0.01, 0.0, 0.02], atol=1e-9)


def test_a_recorded_hand_keeps_what_it_did_between_its_samples() -> None:
    """A tremor of 8 Hz that was recorded at 48 Hz keeps its amplitude."""
    t = np.arange(0.0, 6.0, 1.0 / 48.0)
    tremor_mm = 0.2 * np.sin(2.0 * np.pi * 8.0 * t)
    # Depths such that this hand hovers where its tremor shows: along the object.
    rows = np.stack([15.0 * np.sin(t) + tremor_mm, 10.0 * np.cos(t), 20.0 + 20.0 * np.sin(t)])
    path = place_recording("hand", t, 1e-3 * rows.T, SCENE)
    motion = motion_on(path, SCENE, steady=True)
    times = np.arange(1.0, 5.0, 2e-3)
    along = np.array([motion.at(0.3 + time).position[0] for time in times])
    carrier = np.exp(-2j * np.pi * 8.0 * times) * np.hanning(len(times))
    amplitude = 2.0 * np.abs((along - along.mean()) @ carrier) / np.hanning(len(times)).sum()
    assert amplitude == pytest.approx(0.0002, rel=0.1)


def test_what_unsteadiness_adds_is_foreseen_in_the_margins() -> None:
    motion = motion_on(GESTURES["hover"](SCENE), SCENE)
    place = motion.path.points[0]
    away = [np.abs(motion.at(time).position - place).max() for time in np.linspace(0, 30, 9000)]
    assert max(away) < 4.0 * WANDER_M + 3.0 * TREMOR_ARM_M
