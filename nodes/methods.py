"""Describe method families: interchangeable functions, one reference, errors in the scene's units.

A node's folder holds its methods as plain functions and describes them in `FAMILY = Family(...)`.
`launch.methods.charts` times every method, measures its error against the reference over the
scene's working range, and draws speed against accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexsheet.messages.scene import Scene

MAX_TRIAL_S, MIN_REPEATS = 3.0, 3
"""A trial is repeated until this total time has passed, but at least this often."""

Progress = Callable[[int, int], None]
Case = dict[str, float | int | str]
"""The conditions of a measurement, in the scene's units: {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One measurable use of one method: `run` is timed, `error` evaluates its result.

    case: the conditions; methods are compared at equal cases.
    error: takes the result of `run`, returns the error in the family's unit.
    in_range: whether the method's stated range covers this case.
    in_scene: whether the scene's working range includes this case; others show where methods end.
    size: the size of the method's problem ({"skin_nodes": 1210}), reported with the case.
    extra_metrics: further figures of the result of `run`, with units in their names.
    reference_uncertainty: of the reference itself, for the error ("error") and for extra metrics.
    """

    method: str
    case: Case
    run: Callable[[], Any]
    error: Callable[[Any], float]
    in_range: bool
    in_scene: bool = True
    size: Case = field(default_factory=dict)
    extra_metrics: Callable[[Any], Mapping[str, float]] = lambda result: {}
    reference_uncertainty: Mapping[str, float] = field(default_factory=dict)


def prepare_nothing(scene: Scene, on_progress: Progress) -> None:
    """Do nothing, for a family whose trials need no long computation."""


@dataclass(frozen=True, slots=True)
class Family:
    """A set of interchangeable methods.

    trials: yields the trials of every method over a scene's working range. A trial may be run until
        the next one is requested.
    tolerance: the scene's tolerance, in `unit`.
    sweep_key: the key of the case over which errors are drawn in a diagram of their own, if any.
    prepare: computes and caches what takes long and `trials` needs; reports done and total steps.
    """

    name: str
    unit: str
    reference: str
    methods: Sequence[str]
    trials: Callable[[Scene], Iterable[Trial]]
    tolerance: Callable[[Scene], float]
    sweep_key: str | None = None
    prepare: Callable[[Scene, Progress], None] = prepare_nothing


@dataclass(frozen=True, slots=True)
class Point:
    """The measured time and error of one method at one case.

    params: the case and the method's size together. in_scene, extra_metrics,
    reference_uncertainty: as of its trial.
    """

    method: str
    case: Case
    params: Case
    median_s: float
    p99_s: float
    error: float
    in_range: bool
    in_scene: bool = True
    extra_metrics: Mapping[str, float] = field(default_factory=dict)
    reference_uncertainty: Mapping[str, float] = field(default_factory=dict)


def measure(trial: Trial, *, repeats: int) -> Point:
    """Time `trial.run` `repeats` times after one warm-up run, and evaluate its result.

    Slow trials are repeated less often, see `MAX_TRIAL_S`.
    """
    result = trial.run()
    durations: list[float] = []
    while len(durations) < repeats:
        start = time.perf_counter()
        result = trial.run()
        durations.append(time.perf_counter() - start)
        if len(durations) >= MIN_REPEATS and sum(durations) > MAX_TRIAL_S:
            break
    return Point(
        method=trial.method,
        case=trial.case,
        params={**trial.case, **trial.size},
        median_s=float(np.median(durations)),
        p99_s=float(np.quantile(durations, 0.99)),
        error=float(trial.error(result)),
        in_range=bool(trial.in_range),
        in_scene=bool(trial.in_scene),
        extra_metrics=dict(trial.extra_metrics(result)),
        reference_uncertainty=dict(trial.reference_uncertainty),
    )


def clip_range(largest: float, usual: Sequence[float]) -> tuple[float, ...]:
    """Return the usual values within a working range, and the end of the range."""
    within = [value for value in usual if value < largest * (1.0 - 1e-6)]
    return (*within, largest)


def pareto_front(points: Sequence[Point]) -> list[str]:
    """Return the methods that no other method dominates in at least one case of their range.

    Cases are compared one by one: a cheap method is often exact for small cases and useless for
    others. The fastest method is first, by the slowest median of each.
    """
    usable = [point for point in points if point.in_range]
    front = {
        point.method: max(one.median_s for one in usable if one.method == point.method)
        for point in usable
        if not any(dominates(other, point) for other in usable if other.case == point.case)
    }
    return sorted(front, key=lambda method: front[method])


def dominates(one: Point, other: Point) -> bool:
    """Return whether a method is as fast and as exact as another, and better in one of the two."""
    return (
        one.median_s <= other.median_s
        and one.error <= other.error
        and (one.median_s, one.error) != (other.median_s, other.error)
    )
