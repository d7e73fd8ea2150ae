"""The family of tracking methods: how well each says where the finger will be when it counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.methods import Case, Family, Trial
from nodes.triangulator.filters import TRACKING_METHODS, Estimate, Filter
from nodes.triangulator.triangulation import StereoGeometry, measure, midpoint

Floats = NDArray[np.float64]
TruePath = Callable[[float], Floats]
"""True fingertip (3,) m in the world at a time (s)."""

MARK_NOISE_PX = 0.01
"""Of a mark's centre by the sub-pixel fit, half a metre away (`flexsheet chart mark`)."""

LEADS_S = (0.0, 0.02, 0.05)
"""At the exposure; for the picture; for the arms, whose servos trail."""

WARM_UP_S = 0.4
SPEED_STEP_S = 0.02
FASTER = 1.5
"""Over the scene's speed: a motion's unsteadiness and its starts come on top of that."""
WITHOUT_VELOCITY = ("none", "exponential")
"""Their range is a finger that rests; what was just measured is also right of one that moves."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A finger's true path, from time 0 on, and whether it rests but for its unsteadiness."""

    path: TruePath
    duration_s: float
    resting: bool

    @property
    def fast(self) -> float:
        """The speed (m/s) that what is judged seldom exceeds: a tenth of the time."""
        times = np.arange(WARM_UP_S, self.duration_s, SPEED_STEP_S)
        points = np.array([self.path(float(time)) for time in times])
        ways = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return float(np.quantile(ways, 0.9)) / SPEED_STEP_S


@dataclass(frozen=True, slots=True)
class Measurements:
    """Times (n,) ns, measured points (n, 3), covariances (n, 3, 3), truth (n, 3) by lead."""

    times_ns: NDArray[np.int64]
    points: Floats
    covariances: Floats
    truth: Mapping[float, Floats]


def measured(scene: Scene, motion: Motion, *, seed: int) -> Measurements:
    """A motion as the scene's rig measures it: marks with noise, triangulated."""
    geometry, random = StereoGeometry.of(scene.camera), np.random.default_rng(seed)
    times = np.arange(0.0, motion.duration_s, 1.0 / scene.camera.rate_hz)
    covariance_px = MARK_NOISE_PX**2 * np.eye(2)
    points, covariances, kept = [], [], []
    for time in times:
        left, right = geometry.project(motion.path(float(time)))
        found = measure(
            geometry,
            left + MARK_NOISE_PX * random.standard_normal(2),
            right + MARK_NOISE_PX * random.standard_normal(2),
            method=midpoint,
            left_covariance=covariance_px,
            right_covariance=covariance_px,
        )
        if found is not None:
            points.append(found.point_world)
            covariances.append(found.covariance)
            kept.append(time)
    at = np.array(kept)
    truth = {lead: np.array([motion.path(float(t) + lead) for t in at]) for lead in LEADS_S}
    return Measurements(
        np.round(at * 1e9).astype(np.int64), np.array(points), np.array(covariances), truth
    )


def predictions(filter_: Filter, seen: Measurements, lead_s: float) -> Floats:
    """Where the filter says, after each measurement, that the finger will be a lead later."""
    leads, places = np.array([lead_s]), np.empty_like(seen.points)
    estimate: Estimate | None = None
    for i, at_ns in enumerate(seen.times_ns.tolist()):
        point, covariance = seen.points[i], seen.covariances[i]
        estimate = (
            filter_.started(at_ns, point, covariance)
            if estimate is None
            else filter_.updated(estimate, at_ns, point, covariance)
        )
        places[i] = filter_.ahead(estimate, leads)[0]
    return places


def tracking_family(motions: Callable[[Scene], Mapping[str, Motion]]) -> Family:
    """The family, judged on true motions by name."""

    def trials(scene: Scene) -> Iterator[Trial]:
        for name, motion in motions(scene).items():
            seen = measured(scene, motion, seed=1)
            in_scene = motion.resting or motion.fast <= FASTER * scene.working_range.speed_m_per_s
            for lead_s in LEADS_S:
                for method in TRACKING_METHODS:
                    just_measured = method == "none" and lead_s == 0.0
                    in_range = method not in WITHOUT_VELOCITY or motion.resting or just_measured
                    case: Case = {"motion": name, "lead_ms": round(1e3 * lead_s)}
                    trial = _trial(scene, method, case, seen, lead_s, in_range=in_range)
                    yield replace(trial, in_scene=in_scene)

    return Family(
        name="tracking",
        unit="mm",
        reference="true finger at the moment of use",
        methods=tuple(TRACKING_METHODS),
        trials=trials,
        tolerance=lambda scene: 1e3 * scene.tolerances.sheet_position_m,
    )


def _trial(
    scene: Scene, method: str, case: Case, seen: Measurements, lead_s: float, *, in_range: bool
) -> Trial:
    """Timed is one update with its prediction; judged is the whole motion but its first moments."""
    filter_ = TRACKING_METHODS[method](scene.finger.max_speed_m_per_s)
    middle = len(seen.times_ns) // 2
    before = filter_.started(
        int(seen.times_ns[middle - 1]), seen.points[middle - 1], seen.covariances[middle - 1]
    )
    leads = np.array([lead_s])

    def run() -> Floats:
        after = filter_.updated(
            before, int(seen.times_ns[middle]), seen.points[middle], seen.covariances[middle]
        )
        return filter_.ahead(after, leads)

    def error_mm(_: Floats) -> float:
        settled = seen.times_ns >= WARM_UP_S * 1e9
        off = (predictions(filter_, seen, lead_s) - seen.truth[lead_s])[settled]
        return 1e3 * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    return Trial(method=method, case=case, run=run, error=error_mm, in_range=in_range)
