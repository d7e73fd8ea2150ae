"""Evaluate the force that a simulated hand feels: `experiment stability --gestures`.

The gestures are voluntary motions of a simulated hand. The force of the sheet deflects the finger
from these motions. The force of the sheet is compared with the force of the virtual object at the
finger's true depth. The simulation runs in simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import (
    Progress,
    make_settings,
    require_scene,
    run_experiment,
)
from flexsheet.launch.experiments.simulated_time import (
    SETTLING_S,
    TouchRecording,
    touch_in_simulated_time,
)
from flexsheet.launch.experiments.stability import draw_hands
from flexsheet.launch.experiments.stroke import object_pose
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, Phase, SheetTarget, TwinFinger
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.hand_loop import Hand
from flexsheet.nodes.models.rigid import apply, inverse
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.planner.compliance import FORCE_JND_FLOOR_N
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds
from flexsheet.nodes.twin.gestures import HOVER_M, SAMPLE_S, minimum_jerk
from flexsheet.nodes.twin.hand import CoupledFinger, HandImpedance, TrueSheet, VoluntaryPath
from flexsheet.nodes.twin.paths import inside, limit_path_speed, map_to_surface, touchable
from flexsheet.nodes.twin.sheet_reaction import load_or_compute_reaction

DEPTH_FRACTION = 0.3
"""The push depth that the hand intends, as a fraction of the scene's maximum push depth."""

TAPS, TAP_M, TAP_LIFT_M = 6, 0.004, 0.012
STROKE_M_PER_S, MODULATION_HZ = 0.035, 1.0
SLIP_FRACTION = 0.375
"""The distance that the finger slips along the object, as a fraction of the sheet's width."""

TRANSIENT_S = 0.1
"""The duration (s) of the force transient after the start of a touch."""

MIN_CONTACT_N = 2e-3
"""The force above which the finger is considered to touch the sheet, in newtons.

It is a tenth of the smallest force that a fingertip can perceive.
"""


def _press(depth_m: float, hold_s: float, lift_s: float) -> tuple[Floats, Floats]:
    """Return the finger motion of one press: push in, hold, lift off.

    Return n times (s) and n positions (n, 3), m, relative to the object's surface.

    hold_s, lift_s: durations of the hold and of the lift.
    """
    return minimum_jerk(
        (0.0, 0.0, HOVER_M),
        [
            (0.6, (0.0, 0.0, -depth_m)),
            (hold_s, (0.0, 0.0, -depth_m)),
            (lift_s, (0.0, 0.0, HOVER_M)),
        ],
    )


def _make_path(scene: Scene, label: str, motion: tuple[Floats, Floats]) -> FingerPath:
    times_s, places = motion
    return _place(scene, label, times_s, map_to_surface(scene, places))


def _place(scene: Scene, label: str, times_s: Floats, points: Floats) -> FingerPath:
    return FingerPath(
        label=label,
        times_s=limit_path_speed(scene, times_s, points),
        positions_world_m=points,
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


def make_tap(scene: Scene, depth_m: float) -> FingerPath:
    """Return the path of a finger that taps six times to a depth of 4 mm, three times per second.

    The argument `depth_m` is ignored.
    """
    above, below = (0.0, 0.0, TAP_LIFT_M), (0.0, 0.0, -TAP_M)
    moves = [move for _ in range(TAPS) for move in ((0.11, below), (0.06, below), (0.16, above))]
    return _make_path(scene, "tap", minimum_jerk(above, moves))


def make_hold(scene: Scene, depth_m: float) -> FingerPath:
    """Return the path of a finger that pushes to `depth_m`, holds for 3 s, and lifts off."""
    return _make_path(scene, "hold", _press(depth_m, 3.0, 0.8))


def make_let_go(scene: Scene, depth_m: float) -> FingerPath:
    """Return the path of a finger that pushes to `depth_m` and lifts off as fast as people do."""
    return _make_path(scene, "let-go", _press(depth_m, 1.5, 0.15))


def make_stroke(scene: Scene, depth_m: float) -> FingerPath:
    """Return the path of a finger that strokes around the object and back.

    The depth oscillates between half of `depth_m` and `depth_m` once per second.
    """
    half_m = 0.4 * touchable(scene)[1]
    stroke_s = 2.0 * half_m / STROKE_M_PER_S * 1.875
    _, reach = minimum_jerk(
        (0.0, -half_m, HOVER_M), [(0.8, (0.0, -half_m, -depth_m)), (0.3, (0.0, -half_m, -depth_m))]
    )
    times, places = minimum_jerk(
        (0.0, -half_m, -depth_m),
        [(stroke_s, (0.0, half_m, -depth_m)), (stroke_s, (0.0, -half_m, -depth_m))],
    )
    phase = 2.0 * np.pi * MODULATION_HZ * times
    places[:, 2] += 0.25 * depth_m * (1.0 - np.cos(phase)) * (times < np.floor(times[-1]))
    _, lift = minimum_jerk((0.0, -half_m, -depth_m), [(0.8, (0.0, -half_m, HOVER_M))])
    all_places = np.concatenate([reach, places[1:], lift[1:]])
    return _make_path(
        scene,
        "stroke",
        (np.linspace(0.0, SAMPLE_S * (len(all_places) - 1), len(all_places)), all_places),
    )


def make_slip(scene: Scene, depth_m: float) -> FingerPath:
    """Return the path of a finger that pushes to half of `depth_m` and slides off the object."""
    times, places = _press(0.5 * depth_m, 2.5, 0.8)
    points = map_to_surface(scene, places)
    ends = map_to_surface(scene, np.array([[0.0, 0.0, 0.0], [0.005, 0.0, 0.0]]))
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    slide, moved = minimum_jerk((0.0,), [(0.9, (0.0,)), (2.0, (1.0,)), (10.0, (1.0,))])
    distances_m = np.interp(times, slide, moved[:, 0]) * SLIP_FRACTION * scene.sheet.width_m
    for fraction in np.linspace(1.0, 0.0, 21):
        slipped = points + fraction * distances_m[:, None] * along
        if inside(scene, slipped, 0.0):
            break
    return _place(scene, "slip", times, slipped)


HAND_GESTURES: dict[str, tuple[Callable[[Scene, float], FingerPath], int]] = {
    "tap": (make_tap, TAPS),
    "hold": (make_hold, 1),
    "stroke": (make_stroke, 1),
    "let-go": (make_let_go, 1),
    "slip": (make_slip, 1),
}
"""For each gesture, the function that makes the finger path, and the number of touches."""


@dataclass(frozen=True, slots=True)
class FeltForce:
    """The force that a finger feels, and the force of the virtual object at the same depth.

    Each array has one element per time step.

    felt_n: force of the sheet on the finger.
    wanted_n: force of the virtual object at the depth `depths_m` of the finger.
    """

    times_s: Floats
    depths_m: Floats
    felt_n: Floats
    wanted_n: Floats


def compute_felt_force(scene: Scene, recorded: TouchRecording, curve: Floats) -> FeltForce:
    """Compute the sheet's force on the finger and the virtual object's force during a touch.

    curve: (n, 2), n pairs of depth (m) and force (N) of the object.
    """
    shape = make_shape(dict(scene.object.geometry))
    points = apply(inverse(object_pose(scene)), recorded.positions_m)
    nearest = shape.closest(points)
    # Beyond the object's end there is no contact at any depth.
    depths_m = np.where(nearest.on_edge, 0.0, -nearest.height_m)
    times_s, felt_n = recorded.steps[:, 0], recorded.steps[:, 2]
    at_steps_m = np.interp(times_s, recorded.times_s, depths_m)
    wanted = PchipInterpolator(curve[:, 0], curve[:, 1])
    wanted_n = np.asarray(wanted(np.clip(at_steps_m, 0.0, curve[-1, 0])))
    shown = times_s >= SETTLING_S
    times_s = times_s - SETTLING_S
    return FeltForce(times_s[shown], at_steps_m[shown], felt_n[shown], wanted_n[shown])


def evaluate_touch(recorded: TouchRecording, force: FeltForce, touches: int) -> dict[str, Any]:
    """Return the force errors and the numbers of contacts of one gesture.

    The key `chatter` is the number of detected touches minus `touches`. The key `transient_n` is
    the largest force error within TRANSIENT_S after the start of a touch.

    touches: number of touches that the gesture consists of.
    """
    touching = force.felt_n > MIN_CONTACT_N
    active = touching | (force.wanted_n > MIN_CONTACT_N)
    error_n = np.abs(force.felt_n - force.wanted_n)
    begins = np.flatnonzero(touching & ~np.concatenate([[False], touching[:-1]]))
    since_s = np.full(len(touching), np.inf)
    for at in begins:
        since_s[at:] = force.times_s[at:] - force.times_s[at]
    transient = active & (since_s <= TRANSIENT_S)
    phases = np.array(recorded.phases)
    contact = phases == "contact"
    ratio = error_n / np.maximum(force.wanted_n, FORCE_JND_FLOOR_N)

    def largest(values: Floats) -> float:
        return float(values.max(initial=0.0))

    return {
        "peak_force_n": largest(force.felt_n),
        "peak_error_n": largest(error_n[active]),
        "mean_error_n": float(error_n[active].mean()) if active.any() else 0.0,
        "median_error_percent": 100.0 * float(np.median(ratio[active])) if active.any() else 0.0,
        "transient_n": largest(error_n[transient]),
        "touches": len(begins),
        "chatter": len(begins) - touches,
        "planner_contacts": int(np.count_nonzero(contact[1:] & ~contact[:-1])),
        "phase_changes": int(np.count_nonzero(phases[1:] != phases[:-1])),
        "watchdog_triggers": recorded.watchdog_triggers,
        "delay_ms": 1e3 * recorded.delay_s,
    }


def hand_gestures_result(
    scene: Scene,
    curve: Floats,
    progress: Progress,
    *,
    hands: int,
    seed: int,
) -> tuple[dict[str, Any], dict[tuple[str, str], FeltForce]]:
    """Simulate gestures with random hands; return the results, and the forces for a chart.

    The keys of the forces are (kind of hand, gesture).

    hands: number of hands of each kind (finger, wrist, arm).
    curve: (n, 2), n pairs of depth (m) and force (N) of the object.
    """
    progress("computing the reaction of the sheet (only once)")
    reaction = load_or_compute_reaction(scene, None)
    bounds = load_or_compute_bounds(scene.camera.rate_hz, None)
    depth_m = DEPTH_FRACTION * scene.working_range.push_depth_m

    def make_finger(impedance: HandImpedance, path: VoluntaryPath) -> CoupledFinger:
        return CoupledFinger(impedance, TrueSheet(scene, None, reaction), path)

    rows: list[dict[str, Any]] = []
    forces: dict[tuple[str, str], FeltForce] = {}
    for number, hand in enumerate(draw_hands(hands, seed)):
        ratio = hand.damping_ns_per_m / _critical_damping(hand)
        impedance = HandImpedance(hand.mass_kg, hand.stiffness_n_per_m, ratio)
        kind = _name_hand(impedance)
        progress(f"hand {number + 1} of {3 * hands}: {kind}, {hand.stiffness_n_per_m:.0f} N/m")
        for name, (make_path, _) in HAND_GESTURES.items():
            recorded = touch_in_simulated_time(
                scene,
                make_path(scene, depth_m),
                curve,
                partial(make_finger, impedance),
                bounds=bounds,
            )
            forces[kind, name] = compute_felt_force(scene, recorded, curve)
            rows.append(_make_row(name, impedance, recorded, forces[kind, name]))
    return _make_result(scene, seed, rows), forces


def run_gestures(
    launch_file: Path,
    settings: Sequence[str],
    folder: Path,
    curve: Floats,
    progress: Progress,
    *,
    apparatus: str | None = None,
) -> tuple[dict[str, Any], dict[tuple[str, str], FeltForce]]:
    """Start a graph, perform the gestures in it, and return the results and the felt forces.

    The results have the format of `hand_gestures_result`. The force is sampled only at the camera's
    exposures, so shorter peaks are missed.

    curve: (n, 2), n pairs of depth (m) and force (N) of the object.
    apparatus: file with the true parameters of the simulated hardware and of the hand.
    """
    coupled = [*settings, *make_settings(launch_file, "twin_finger", "hand=coupled")]
    plan = load_graph(launch_file, settings=coupled, apparatus=apparatus)
    scene, truth = require_scene(plan), plan.apparatus_message()
    depth_m = DEPTH_FRACTION * scene.working_range.push_depth_m
    progress("computing the reaction of the sheet (only once)")
    load_or_compute_reaction(scene, truth)

    async def procedure(driver: Driver, _: Scene) -> None:
        await driver.wait_for_table(scene, "quick_table", progress)
        for name, (make_path, _touches) in HAND_GESTURES.items():
            progress(f"performing the gesture {name}")
            await driver.follow(make_path(scene, depth_m))

    bag = folder / "gestures.mcap"
    run_experiment(launch_file, coupled, bag, procedure, progress, apparatus=apparatus)
    hand = HandImpedance.of(truth)
    rows: list[dict[str, Any]] = []
    forces: dict[tuple[str, str], FeltForce] = {}
    for name, recorded in read_touches(bag).items():
        force = forces[_name_hand(hand), name] = compute_felt_force(scene, recorded, curve)
        rows.append(_make_row(name, hand, recorded, force))
    return {**_make_result(scene, None, rows), "bag": str(bag)}, forces


def _critical_damping(hand: Hand | HandImpedance) -> float:
    return 2.0 * math.sqrt(hand.mass_kg * hand.stiffness_n_per_m)


def _name_hand(hand: HandImpedance) -> str:
    return f"{1e3 * hand.mass_kg:.0f} g"


def _make_row(
    gesture: str, hand: HandImpedance, recorded: TouchRecording, force: FeltForce
) -> dict[str, Any]:
    return {
        "gesture": gesture,
        "mass_kg": hand.mass_kg,
        "damping_ns_per_m": hand.damping_ratio * _critical_damping(hand),
        "stiffness_n_per_m": hand.stiffness_n_per_m,
        **evaluate_touch(recorded, force, HAND_GESTURES[gesture][1]),
    }


SUMMARY = ("peak_error_n", "mean_error_n", "median_error_percent", "transient_n", "chatter")


def _make_result(scene: Scene, seed: int | None, rows: list[dict[str, Any]]) -> dict[str, Any]:
    names = dict.fromkeys(row["gesture"] for row in rows)
    summary = {
        name: {key: max(row[key] for row in rows if row["gesture"] == name) for key in SUMMARY}
        for name in names
    }
    return {"scene": scene.name, "seed": seed, "gestures": rows, "summary": summary}


def read_touches(bag: Path) -> dict[str, TouchRecording]:
    """Read the touches of a simulated hand from a bag; the keys are labels of finger paths."""
    fingers: dict[int, TwinFinger] = {}
    phases: dict[int, Phase] = {}
    valid_at: list[int] = []
    for _, message, header, _ in BagReader(bag, topics=["twin/finger", "sheet_target"]):
        match message:
            case TwinFinger() if message.path_label in HAND_GESTURES and message.path_time_s >= 0.0:
                fingers[header.source_ns] = message
            case SheetTarget():
                phases[header.source_ns] = message.phase
                valid_at.append(message.valid_at_ns - header.source_ns)
            case _:
                pass
    runs: dict[str, list[tuple[int, TwinFinger]]] = {}
    for at_ns in sorted(fingers):
        if at_ns in phases:
            runs.setdefault(fingers[at_ns].path_label, []).append((at_ns, fingers[at_ns]))
    return {
        label: TouchRecording(
            np.array([finger.path_time_s + SETTLING_S for _, finger in run]),
            np.array([finger.position_world_m for _, finger in run]),
            [phases[at_ns] for at_ns, _ in run],
            np.array(
                [
                    (finger.path_time_s + SETTLING_S, 0.0, np.linalg.norm(finger.force_world_n))
                    for _, finger in run
                ]
            ),
            None,
            1e-9 * float(np.median(valid_at)),
        )
        for label, run in runs.items()
    }
