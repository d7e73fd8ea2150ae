"""Define method families for benchmarks: interchangeable methods and a common reference.

A node's folder contains its methods as plain functions, and their `Family`. The module
`launch.methods.charts` plots the time of each method against its error over the scene's working
range.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flexsheet.messages.scene import Scene

MAX_TRIAL_S, MIN_REPEATS = 3.0, 3
"""Time after which a trial is not repeated further, and minimum number of repetitions."""

Progress = Callable[[int, int], None]
Case = dict[str, float | int | str]
"""Conditions of a measurement by name, for instance {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Measurement of one method at one case: `run` is timed, `error` evaluates its result.

    error: function from the result of `run` to the error in the family's unit.
    in_range: whether the method's valid range includes the case.
    in_scene: whether the scene's working range includes the case.
    size: size of the solved problem ({"skin_nodes": 1210}), reported with the case.
    extra_metrics: function from the result of `run` to further figures, with units in their names.
    reference_uncertainty: uncertainty of the reference by figure: "error" or an extra metric.
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
    """Do nothing; this is the default of `Family.prepare`."""


@dataclass(frozen=True, slots=True)
class Family:
    """Set of interchangeable methods whose errors are measured against one reference.

    trials: function that yields the trials of all methods over a scene's working range; each must
        be run before the next one is requested.
    tolerance: function that returns the scene's tolerance for the error, in `unit`.
    sweep_key: key of the case over which errors are plotted separately; None: no such plot.
    prepare: function that computes and caches the data for `trials`; it reports its progress.
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
    """Measured time and error of one method at one case; see `Trial`.

    params: the case and the size of the solved problem.
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
    """Time `repeats` runs of a trial after a warm-up run, and evaluate the result.

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


def clip_range(end: float, values: Sequence[float]) -> tuple[float, ...]:
    """Return those values that are below the end of a working range, followed by the end."""
    return (*(value for value in values if value < end * (1.0 - 1e-6)), end)


def pareto_front(points: Sequence[Point]) -> list[str]:
    """Return the methods that are Pareto-optimal in at least one case of their valid range.

    They are sorted by the maximum of their median times.
    """
    usable = [point for point in points if point.in_range]
    front = {
        point.method: max(one.median_s for one in usable if one.method == point.method)
        for point in usable
        if not any(dominates(other, point) for other in usable if other.case == point.case)
    }
    return sorted(front, key=lambda method: front[method])


def dominates(one: Point, other: Point) -> bool:
    """Return whether `one` is at least as fast and accurate as `other`, and not equal to it."""
    return (
        one.median_s <= other.median_s
        and one.error <= other.error
        and (one.median_s, one.error) != (other.median_s, other.error)
    )
