"""Test whether the fingertip jumps or follows another object, over 100,000 adverse frames.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.tracking_endurance [--frames 100000]

A finger makes slow and fast gestures in front of the sheet. After half a second it is surrounded by
clutter, which changes every 2000 frames: beads like the marker that swing or rest, reflections of
lamps in one view or both, and cables in front. The marker is randomly hidden for up to a second,
and frames are lost. The triangulator has the shipped calibration. Prints

- jumps: motion between two valid fingertips minus the finger's, over the standard deviation by both
  published covariances; for the whole vector (root of the trace of their sum), and along the motion
- wrong frames: valid, and more than 5 mm from the finger
- re-acquisition: time from the first frame with the marker in full view to the next valid one

Takes some 10 minutes on two cores.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from benchmarks.tracking_bench import (
    WRONG_MARKER_M,
    Frame,
    ObservedFrame,
    Observer,
    TruePathCase,
    bench_scene,
    paths_motion,
    twin_camera,
)
from flexsheet.launch.methods.results import machine_name
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.twin.clutter import (
    CLAMPS,
    CLUTTER,
    HAND,
    MARKER_RADIUS_M,
    NAIL,
    Clutter,
    FixedPoint,
    Highlight,
    Occluder,
    Oscillation,
    SecondMarker,
    Sheet,
    Trajectory,
    together,
)
from flexsheet.nodes.twin.gestures import GESTURES
from flexsheet.nodes.twin.pixels import CameraView, TwinCamera

SEQUENCE_FRAMES = 2000
MIDDLE_M, SPREAD_M = (0.0, 0.01, 0.02), (0.05, 0.04, 0.03)
"""The mean and the standard deviation (3,) of the centres of the clutter, in metres."""

SOLE_CANDIDATE_TIME_S = 0.5
BLINKS_PER_S = 0.4
MAX_BLINK_FRAMES = 60
LOST_FRAMES_SHARE = 0.01
SIGMAS = (3, 4, 5, 6)
BEYOND_MM = (0.3, 1.0, 5.0)
SHOWN = 30
CLEAR_PX = 3.0
"""The minimum image distance (px) from the marker to objects in front of the finger."""


def make_clutter(random: np.random.Generator) -> Clutter:
    """Make the lab with random clutter similar to the marker or in front of it."""

    def place() -> tuple[float, float, float]:
        x, y, z = random.normal(MIDDLE_M, SPREAD_M).tolist()
        return x, y, z

    def swinging(least_m: float, most_m: float, fastest_s: float, slowest_s: float) -> Oscillation:
        way = random.normal(0.0, 1.0, 3) * (1.0, 1.0, 0.3)
        x, y, z = (random.uniform(least_m, most_m) * way / np.linalg.norm(way)).tolist()
        period_s, phase = random.uniform(fastest_s, slowest_s), random.uniform(0.0, 2.0 * np.pi)
        return Oscillation(place(), (x, y, z), float(period_s), float(phase))

    markers = [
        SecondMarker(swinging(0.06, 0.2, 2.0, 8.0), level=float(random.uniform(150.0, 235.0)))
        for _ in range(int(random.integers(1, 3)))
    ]
    if random.random() < 0.5:
        markers.append(SecondMarker(FixedPoint(place()), level=float(random.uniform(150.0, 235.0))))
    highlights = [
        Highlight(
            swinging(0.06, 0.2, 2.0, 6.0),
            float(random.uniform(0.0008, 0.0035)),
            float(random.uniform(120.0, 400.0)),
            views=("both", "left", "right")[int(random.integers(3))],
        )
        for _ in range(int(random.integers(1, 4)))
    ]
    top_x, reach_x, period_s = random.normal(0.0, 0.05), random.uniform(0.2, 0.4), 6.0
    phase = float(random.uniform(0.0, 2.0 * np.pi))
    ends = [
        Oscillation((float(top_x), y, z), (float(reach_x), 0.0, 0.0), period_s, phase)
        for y, z in ((0.35, -0.05), (-0.35, 0.35))
    ]
    cable = Occluder(
        ends[0],
        ends[1],
        float(random.uniform(0.004, 0.012)),
        views=("both", "left", "right")[int(random.integers(3))],
    )
    return together(
        Clutter(sheet=Sheet()),
        HAND,
        NAIL,
        CLAMPS,
        Clutter(markers=tuple(markers), highlights=tuple(highlights), occluders=(cable,)),
    )


def gestures(scene: Scene, random: np.random.Generator) -> Iterator[FingerPath]:
    """Yield random gestures endlessly."""
    names = list(GESTURES)
    while True:
        name = names[int(random.integers(len(names)))]
        yield GESTURES[name](scene, seed=int(random.integers(2**31)))


def exposures(
    scene: Scene, alone: TwinCamera, crowded: TwinCamera, count: int, random: np.random.Generator
) -> Iterator[Frame]:
    """Make frames at the rate of the camera.

    Some frames are lost, and in some frames the marker is hidden.
    """
    period_s = 1.0 / scene.camera.rate_hz
    hidden_until = -1
    tick = taken = 0
    while taken < count:
        tick += 1
        camera = alone if tick * period_s < SOLE_CANDIDATE_TIME_S else crowded
        if camera is crowded and tick > hidden_until and random.random() < BLINKS_PER_S * period_s:
            length = MAX_BLINK_FRAMES ** random.random()
            hidden_until = tick + int(length)
        if random.random() >= LOST_FRAMES_SHARE:
            taken += 1
            yield Frame(tick * period_s, camera, marker=tick > hidden_until)


def in_full_view(camera: TwinCamera, frame: Frame, tip: Floats) -> bool:
    """Return whether no object overlaps or touches the marker in either view."""
    clutter = camera.clutter
    blobs: list[SecondMarker | Highlight] = [*clutter.markers, *clutter.highlights]
    things: list[tuple[str, Trajectory, Trajectory, float]] = [
        (blob.views, blob.path, blob.path, blob.radius_m) for blob in blobs if not blob.carried
    ]
    things += [(one.views, one.start, one.end, one.radius_m) for one in clutter.occluders]
    return frame.marker and all(
        _gap_px(eye, tip, start.at(frame.time_s), end.at(frame.time_s), radius_m) > CLEAR_PX
        for views, start, end, radius_m in things
        for eye in camera.eyes
        if views in ("both", eye.side)
    )


def _gap_px(eye: CameraView, tip: Floats, start: Floats, end: Floats, radius_m: float) -> float:
    """Return the undistorted image distance between the edges of marker and object, px."""
    in_camera = apply(eye.camera_from_world, np.stack([tip, start, end]))
    slopes = in_camera[:, :2] / in_camera[:, 2:]
    way = slopes[2] - slopes[1]
    share = float((slopes[0] - slopes[1]) @ way / max(way @ way, 1e-12))
    share = min(max(share, 0.0), 1.0)
    depth_m = in_camera[1, 2] + share * (in_camera[2, 2] - in_camera[1, 2])
    gap = float(np.linalg.norm(slopes[1] + share * way - slopes[0]))
    return float(eye.lens.fx_px * (gap - radius_m / depth_m - MARKER_RADIUS_M / in_camera[0, 2]))


@dataclass
class Tally:
    """Counts and errors over frames."""

    frames: int = 0
    valid: int = 0
    steps: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    jump_sigmas: list[float] = field(default_factory=list)
    jump_sigmas_along: list[float] = field(default_factory=list)
    jumps_mm: list[float] = field(default_factory=list)
    errors_mm: list[float] = field(default_factory=list)
    jumps: list[dict[str, Any]] = field(default_factory=list)
    wrong_markers: list[dict[str, Any]] = field(default_factory=list)
    outages: int = 0
    reacquired_ms: list[float] = field(default_factory=list)
    refused_in_full_view: int = 0

    def add(self, other: Tally) -> None:
        for one in fields(self):
            setattr(self, one.name, getattr(self, one.name) + getattr(other, one.name))

    def report(self) -> dict[str, Any]:
        jump_sigmas, jumps_mm = np.array(self.jump_sigmas), np.array(self.jumps_mm)
        along = np.array(self.jump_sigmas_along)
        errors_mm, again_ms = np.array(self.errors_mm), np.array(self.reacquired_ms or [0.0])
        return {
            "frames": self.frames,
            "valid_share": self.valid / self.frames,
            "reasons": dict(self.reasons.most_common()),
            "steps": self.steps,
            "jumps_beyond_sigmas": {
                str(limit): int((jump_sigmas > limit).sum()) for limit in SIGMAS
            },
            "jumps_beyond_sigmas_along": {
                str(limit): int((along > limit).sum()) for limit in SIGMAS
            },
            "jumps_beyond_mm": {str(mm): int((jumps_mm > mm).sum()) for mm in BEYOND_MM},
            "largest_jump_sigmas": float(jump_sigmas.max(initial=0.0)),
            "largest_jump_beyond_the_finger_mm": float(jumps_mm.max(initial=0.0)),
            "jumps": sorted(self.jumps, key=lambda jump: -jump["sigmas"])[:SHOWN],
            "error_mm": {
                "rms": float(np.sqrt(np.mean(errors_mm**2))),
                "p99": float(np.quantile(errors_mm, 0.99)),
                "max": float(errors_mm.max()),
            },
            "wrong_marker_frames": len(self.wrong_markers),
            "wrong_markers": self.wrong_markers[:SHOWN],
            "outages": self.outages,
            "reacquired_ms": {
                "median": float(np.median(again_ms)),
                "p99": float(np.quantile(again_ms, 0.99)),
                "max": float(again_ms.max()),
            },
            "refused_in_full_view_share": self.refused_in_full_view / self.frames,
        }


def evaluate_sequence(seen: list[ObservedFrame], scene: Scene, seed: int) -> Tally:
    """Evaluate one sequence, from its first valid fingertip."""
    tally = Tally(frames=len(seen))
    before: ObservedFrame | None = None
    clear_since_s: float | None = None
    out = False
    for one in seen:
        tally.reasons[one.reason] += 1
        clear = in_full_view(one.frame.camera, one.frame, one.truth)
        if not clear:
            clear_since_s = None
        elif clear_since_s is None:
            clear_since_s = one.frame.time_s
        if not one.valid:
            tally.refused_in_full_view += clear
            if before is not None and not out:
                out, tally.outages = True, tally.outages + 1
            continue
        tally.valid += 1
        error_m = float(np.linalg.norm(one.error_m))
        tally.errors_mm.append(1e3 * error_m)
        if error_m > WRONG_MARKER_M:
            tally.wrong_markers.append(
                {
                    "seed": seed,
                    "time_s": round(one.frame.time_s, 3),
                    "error_mm": round(1e3 * error_m, 3),
                }
            )
        if out and clear_since_s is not None:
            tally.reacquired_ms.append(1e3 * (one.frame.time_s - clear_since_s))
        out = False
        if before is not None:
            tally.steps += 1
            beyond_m, sigma_m, sigma_along_m = _jump(before, one)
            tally.jump_sigmas_along.append(beyond_m / sigma_along_m)
            tally.jumps_mm.append(1e3 * beyond_m)
            tally.jump_sigmas.append(beyond_m / sigma_m)
            if beyond_m > SIGMAS[0] * sigma_m:
                tally.jumps.append(
                    {
                        "seed": seed,
                        "time_s": round(one.frame.time_s, 3),
                        "sigmas": round(beyond_m / sigma_m, 1),
                        "beyond_mm": round(1e3 * beyond_m, 3),
                        "after_s": round(one.frame.time_s - before.frame.time_s, 3),
                    }
                )
        before = one
    return tally


def _jump(before: ObservedFrame, after: ObservedFrame) -> tuple[float, float, float]:
    """Return the error (m) of the fingertip's motion between two frames, and standard deviations.

    The first standard deviation is the root of the trace of the sum of both covariances. The second
    one is along the motion.
    """
    assert before.fingertip is not None
    assert after.fingertip is not None
    step = after.fingertip.position_world_m - before.fingertip.position_world_m
    way_m = float(np.linalg.norm(step))
    along = step / max(way_m, 1e-12)
    both = before.covariance + after.covariance
    beyond_m = way_m - float(np.linalg.norm(after.truth - before.truth))
    return beyond_m, float(np.sqrt(np.trace(both))), float(np.sqrt(along @ both @ along))


async def follow(seed: int, count: int) -> tuple[list[ObservedFrame], TruePathCase]:
    """Simulate one sequence of frames from its seed."""
    scene, random = bench_scene(), np.random.default_rng(seed)
    alone = twin_camera(scene, CLUTTER["lab"], seed=seed)
    crowded = twin_camera(scene, make_clutter(random), seed=seed)
    length_s = 1.1 * count / scene.camera.rate_hz
    paths = []
    for path in gestures(scene, random):
        paths.append(path)
        if sum(float(one.times_s[-1]) for one in paths) > length_s:
            break
    motion, _ = paths_motion(paths, scene, seed=seed)
    observer = await Observer(scene).start()
    return await observer.follow(exposures(scene, alone, crowded, count, random), motion), motion


def run(seed: int, count: int) -> Tally:
    seen, _ = asyncio.run(follow(seed, count))
    return evaluate_sequence(seen, bench_scene(), seed)


def endure(frames: int, *, processes: int) -> Tally:
    """Simulate sequences of SEQUENCE_FRAMES in a pool of processes."""
    counts = [SEQUENCE_FRAMES] * (frames // SEQUENCE_FRAMES)
    if frames % SEQUENCE_FRAMES:
        counts.append(frames % SEQUENCE_FRAMES)
    seeds = range(1, 1 + len(counts))
    total, began_s = Tally(), time.monotonic()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for tally in pool.map(run, seeds, counts):
            total.add(tally)
            print(
                f"\r{total.frames} of {frames} frames, {time.monotonic() - began_s:.0f} s, "
                f"{len(total.wrong_markers)} on a wrong marker",
                end="",
                file=sys.stderr,
                flush=True,
            )
    print(file=sys.stderr)
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    report = endure(given.frames, processes=given.processes).report()
    print(json.dumps({"machine": machine_name(), **report}, indent=1))


if __name__ == "__main__":
    main()
