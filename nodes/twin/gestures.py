"""Generate typical finger gestures on an object, as functions of a scene and a random seed.

The gestures follow published measurements of human motion:

- A reach has a bell-shaped speed profile, of the same shape for all distances and durations
    (Atkeson and Hollerbach 1985, J. Neurosci. 5:2318). It is the profile of minimum jerk (Flash and
    Hogan 1985, J. Neurosci. 5:1688). Its peak speed is 1.875 times the mean speed. Its maximum
    acceleration is 5.77 distance / duration^2.
- The peak speed of unhurried reaches is assumed to be 0.2-0.35 m/s. Encountered-type displays were
    tested at these robot speeds (Gonzalez, Abtahi and Follmer 2020, REACH+).
- Hurried elbow flexions of 27-45 degrees take 100-160 ms (Wallace and Wright 1982, J. Motor Behav.
    14:341). The deceleration takes half of this time, 50-80 ms.
- People explore a surface at 77-86 mm/s on average (Smith, Gosselin and Houde 2002, Exp. Brain Res.
    147:209).
- In typing, the interval between taps is 150-500 ms (Angelaki and Soechting 1993, Exp. Brain Res.
    95:319). In hurried tapping, the interval is 170-200 ms, which gives 50-60 taps in ten seconds
    (finger tapping test of the Halstead Reitan battery). The contact is assumed to last 100-200 ms
    of an unhurried tap, and about half of a hurried tap. There is no source for soft objects.
- After a signal to stop a reach, people need 206 ms on average to react (Mirabella, Pani, Pare and
    Ferraina 2006, Exp. Brain Res. 174:240).
- Ellipses and similar figures are drawn more slowly where they are more curved, as in harmonic
    motion (Richardson and Flash 2002, J. Neurosci. 22:8201).
- Physiological tremor peaks at 6-12 Hz (Lakie et al. 2015, J. Physiol. 593:4411). Its amplitude is
    0.03 mm if the hand rests, 0.06 mm if the hand is held out, and 0.12 to 0.15 mm if the arm is
    held out (Growdon et al. 2000, Electromyogr. Clin. Neurophysiol. 40:295).
- Most of the motion of a finger at rest has frequencies of 1-3.5 Hz and below (Carignan, Daneault
    and Duval 2009, Exp. Brain Res. 201:299). This motion is called wander in this package.

Surface positions (along, arc, height) are defined in `paths.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.finger import minimum_jerk_profile
from flexsheet.nodes.twin.paths import map_to_surface, place_path, touchable

Sampled = tuple[Floats, Floats]
"""A sampled motion: times (n,), s, from zero, and surface positions (n, 3) or distances (n,), m."""

SAMPLE_S = 0.004
WANDER_M = 0.0005
TREMOR_HAND_M = 0.00006
TREMOR_ARM_M = 0.00013

HOVER_M = 0.04
APPROACH_S = 0.8
REST_S = 0.3
TOUCH_M = 0.001
"""The depth of a light touch below the surface, m."""

PRESS_M = 0.002
"""The depth of a tap below the surface, m."""

EXPLORE_M_PER_S = 0.086
REACH_PEAK_M_PER_S = 0.35
MIN_REACH_S = 0.3
BRAKE_S = 0.05
PEAK_OF_MEAN = 1.875


class Gesture(Protocol):
    def __call__(self, scene: Scene, *, seed: int = 1) -> FingerPath: ...


def minimum_jerk(start: ArrayLike, moves: Sequence[tuple[float, ArrayLike]]) -> Sampled:
    """Sample a sequence of minimum-jerk motions.

    start: first position (3,), m.
    moves: duration (s) and end position (3,), m, of each motion. A motion to the current position
        is a rest.
    """
    corners = np.array([start, *(place for _, place in moves)])
    ends = np.cumsum([0.0, *(duration for duration, _ in moves)])
    times = _sampled_times(float(ends[-1]))
    move = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(moves) - 1)
    s = (times - ends[move]) / (ends[move + 1] - ends[move])
    share, _ = minimum_jerk_profile(s[:, None])
    return times, corners[move] + share * (corners[move + 1] - corners[move])


def integrate_speed_profile(phases: Sequence[tuple[float, float]]) -> Sampled:
    """Sample the distance (n,), m, that a finger covers while its speed changes in phases.

    The finger starts at rest. In each phase, the speed follows the minimum-jerk profile, so the
    acceleration is continuous.

    phases: duration (s) of each phase, and speed (m/s) at its end.
    """
    durations = np.array([duration for duration, _ in phases])
    speeds = np.array([0.0, *(speed for _, speed in phases)])
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    ways = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * durations)])
    times = _sampled_times(float(ends[-1]))
    phase = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(phases) - 1)
    s = (times - ends[phase]) / durations[phase]
    gained = s**4 * (2.5 - 3.0 * s + s * s)  # integral of the minimum-jerk profile
    change = speeds[phase + 1] - speeds[phase]
    return times, ways[phase] + durations[phase] * (speeds[phase] * s + change * gained)


def _sampled_times(duration_s: float) -> Floats:
    return np.linspace(0.0, duration_s, int(np.ceil(duration_s / SAMPLE_S)) + 1)


def touched(motion: Sampled) -> Sampled:
    """Extend a motion on the surface by an approach and a lift.

    The finger approaches the first point from above and rests briefly. After the motion, it rests
    again and is lifted.
    """
    times, places = motion
    first, last = places[0], places[-1]
    above_first, above_last = (np.array([*place[:2], HOVER_M]) for place in (first, last))
    before, approach = minimum_jerk(above_first, [(APPROACH_S, first), (REST_S, first)])
    after, lift = minimum_jerk(last, [(REST_S, last), (APPROACH_S, above_last)])
    begin = before[-1]
    end = begin + times[-1]
    return (
        np.concatenate([before, begin + times[1:], end + after[1:]]),
        np.concatenate([approach, places[1:], lift[1:]]),
    )


def _on_surface(scene: Scene, label: str, motion: Sampled) -> FingerPath:
    times, places = touched(motion)
    return place_path(scene, label, times, places, wander_m=WANDER_M, tremor_m=TREMOR_HAND_M)


def hold(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path on which the finger touches the object lightly and rests there for 5 s."""
    touch = (0.0, 0.0, -TOUCH_M)
    return _on_surface(scene, "hold", minimum_jerk(touch, [(5.0, touch)]))


def hover(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path on which the finger hovers for 5 s, with the tremor of an extended arm."""
    place = (0.0, 0.0, 0.5 * HOVER_M)
    times, places = minimum_jerk(place, [(5.0, place)])
    return place_path(scene, "hover", times, places, wander_m=WANDER_M, tremor_m=TREMOR_ARM_M)


def _reaches(scene: Scene, label: str, peak_m_per_s: float, rest_s: float, seed: int) -> FingerPath:
    generator = np.random.default_rng(seed)
    along_m, arc_m = touchable(scene)
    half = 0.5 * np.array([along_m, arc_m])
    here = np.array([0.0, 0.0, HOVER_M])
    start = here
    moves: list[tuple[float, ArrayLike]] = []
    for turn in range(10):
        height = -TOUCH_M if turn % 2 == 0 else generator.uniform(0.03, 0.09)
        place = np.array([*generator.uniform(-half, half), height])
        ends = map_to_surface(scene, np.array([here, place]))
        way_m = float(np.linalg.norm(ends[1] - ends[0]))
        moves += [(max(MIN_REACH_S, PEAK_OF_MEAN * way_m / peak_m_per_s), place)]
        moves += [(rest_s, place)]
        here = place
    times, places = minimum_jerk(start, moves)
    return place_path(scene, label, times, places, wander_m=WANDER_M, tremor_m=TREMOR_ARM_M)


def reach(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path to the object and back at normal speed, with rests of 0.4 s."""
    return _reaches(scene, "reach", REACH_PEAK_M_PER_S, 0.4, seed)


def reach_fast(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path to the object and back at high speed, with rests of 0.1 s."""
    return _reaches(scene, "reach-fast", 3.0 * REACH_PEAK_M_PER_S, 0.1, seed)


def _taps(
    scene: Scene,
    label: str,
    *,
    count: int,
    every_s: float,
    contact_s: float,
    lift_m: float,
    seed: int,
) -> FingerPath:
    """Return a path of `count` taps near one position.

    The intervals vary by 5 %, and the positions by 2 mm.

    In a tap, the finger moves from `lift_m` above the surface to PRESS_M below the surface, rests,
    and moves back. It does not brake before contact.

    every_s: mean time between taps.
    contact_s: time below the surface in each tap.
    """
    generator = np.random.default_rng(seed)
    grid = np.linspace(0.0, 1.0, 1001)
    touch = float(np.interp(lift_m / (lift_m + PRESS_M), minimum_jerk_profile(grid)[0], grid))
    reach_s = 0.5 * (every_s - contact_s) / touch
    rest_s = every_s - 2.0 * reach_s
    start = (0.0, 0.0, lift_m)
    moves: list[tuple[float, ArrayLike]] = []
    for _ in range(count):
        pace = float(np.clip(generator.normal(1.0, 0.05), 0.85, 1.15))
        along, arc = generator.normal(0.0, 0.002, 2)
        pressed, above = (along, arc, -PRESS_M), (along, arc, lift_m)
        moves += [(pace * reach_s, pressed), (pace * rest_s, pressed), (pace * reach_s, above)]
    times, places = minimum_jerk(start, moves)
    return place_path(scene, label, times, places, wander_m=WANDER_M, tremor_m=TREMOR_HAND_M)


def tap(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path of three taps a second, with 120 ms of contact per tap."""
    return _taps(scene, "tap", count=15, every_s=0.333, contact_s=0.12, lift_m=0.012, seed=seed)


def tap_fast(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path of taps at the fastest rate of people: 5.4 taps per second.

    In each tap, the finger is in contact for 85 ms.
    """
    return _taps(
        scene, "tap-fast", count=25, every_s=0.185, contact_s=0.085, lift_m=0.006, seed=seed
    )


def _arc_run(scene: Scene) -> tuple[float, float]:
    """Return the amplitude (m) and the speed (m/s) of a stroke of the finger around the object.

    The amplitude is half of the touchable length, which the front of the object divides into two
    halves.
    """
    half = 0.5 * touchable(scene)[1]
    return half, min(scene.working_range.speed_m_per_s, half / 0.3)


def stop(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path of strokes around the surface, with sudden stops.

    The finger stops in the middle and at the end of each stroke. There are three strokes in each
    direction.
    """
    half, speed = _arc_run(scene)
    start_s, lag_s = 0.2, np.random.default_rng(seed).uniform(0.3, 0.6, 12)
    even_s = half / speed - 0.5 * (start_s + BRAKE_S)
    phases: list[tuple[float, float]] = []
    for leg, rest_s in enumerate(lag_s):
        signed = speed if leg % 4 < 2 else -speed
        phases += [(start_s, signed), (even_s, signed), (BRAKE_S, 0.0), (float(rest_s), 0.0)]
    times, travel_m = integrate_speed_profile(phases)
    return _on_surface(scene, "stop", (times, _touch_along(travel_m - half)))


def reverse(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path back and forth around the surface, with sudden reversals at random times."""
    half, speed = _arc_run(scene)
    generator = np.random.default_rng(seed)
    turn_s = 2.0 * BRAKE_S
    phases: list[tuple[float, float]] = [(turn_s, speed)]
    here, signed = -0.5 * half + 0.5 * speed * turn_s, speed
    for _ in range(14):
        end = np.sign(signed) * generator.uniform(0.2, 0.9) * half
        travel_m = max(np.sign(signed) * (end - here), 0.0)
        phases += [(travel_m / speed + 1e-3, signed), (turn_s, -signed)]
        here += signed * (travel_m / speed + 1e-3)
        signed = -signed
    phases += [(turn_s, 0.0)]
    times, travel_m = integrate_speed_profile(phases)
    return _on_surface(scene, "reverse", (times, _touch_along(travel_m - 0.5 * half)))


def stroke_push(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Move the finger around the surface while its depth oscillates at 0.7 Hz.

    The maximum depth is a tenth of `push_depth_m` of the scene's working range.
    """
    half, speed = _arc_run(scene)
    stroke_s = PEAK_OF_MEAN * 2.0 * half / speed
    ends = [(0.0, half if stroke % 2 == 0 else -half, 0.0) for stroke in range(6)]
    times, places = minimum_jerk((0.0, -half, 0.0), [(stroke_s, end) for end in ends])
    pushes = round(0.7 * times[-1])
    depth_m = 0.1 * scene.working_range.push_depth_m
    phase = 2.0 * np.pi * pushes * times / times[-1]
    places[:, 2] = -TOUCH_M - 0.5 * (depth_m - TOUCH_M) * (1.0 - np.cos(phase))
    return _on_surface(scene, "stroke-push", (times, places))


def _rounds(turns: int, turn_s: float) -> Sampled:
    """Sample the angle (n,), rad, of a rotation that starts and ends at rest.

    turns: number of revolutions.
    turn_s: duration of one revolution.
    """
    pace = 2.0 * np.pi / turn_s
    ramp_s = 0.25 * turn_s
    return integrate_speed_profile([(ramp_s, pace), (turns * turn_s - ramp_s, pace), (ramp_s, 0.0)])


def _drawing_m(scene: Scene) -> float:
    """Return the radius (m) of a figure that fits in the touchable part of the surface."""
    return min(0.02, *(0.5 * size for size in touchable(scene)))


def circle(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path of four circles on the surface, at the typical speed of exploration."""
    radius = _drawing_m(scene)
    times, angle = _rounds(4, 2.0 * np.pi * radius / EXPLORE_M_PER_S)
    places = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), -TOUCH_M)], axis=1
    )
    return _on_surface(scene, "circle", (times, places))


def eight(scene: Scene, *, seed: int = 1) -> FingerPath:
    """Return a path of three figures of eight on the surface, slower where they curve strongly."""
    radius = _drawing_m(scene)
    # The length of the figure, integrated numerically, is 6.1 radii.
    times, angle = _rounds(3, 6.1 * radius / EXPLORE_M_PER_S)
    places = np.stack(
        [radius * np.sin(angle), 0.5 * radius * np.sin(2.0 * angle), np.full(len(angle), -TOUCH_M)],
        axis=1,
    )
    return _on_surface(scene, "eight", (times, places))


def _touch_along(arcs: Floats) -> Floats:
    """Return the surface positions (n, 3) of a finger that lightly presses the centre line.

    arcs: distances (n,) along the centre line, m.
    """
    return np.stack([np.zeros(len(arcs)), arcs, np.full(len(arcs), -TOUCH_M)], axis=1)


GESTURES: dict[str, Gesture] = {
    "hold": hold,
    "hover": hover,
    "reach": reach,
    "reach-fast": reach_fast,
    "tap": tap,
    "tap-fast": tap_fast,
    "stop": stop,
    "reverse": reverse,
    "stroke-push": stroke_push,
    "circle": circle,
    "eight": eight,
}
"""The gesture functions, by the label of the path that they generate."""
