"""Define method families for benchmarks: interchangeable methods with a common reference.

The folder of a node contains the methods as plain functions, and their `Family`. The module
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
"""The time (s) after which a trial is not repeated further, and the minimum number of repetitions.
"""

NORMAL_95 = 1.96
"""The half-width of the central 95 % interval of a normal distribution, in standard deviations."""

Progress = Callable[[int, int], None]
Case = dict[str, float | int | str]
"""The conditions of a benchmark measurement by name, for instance {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimated value with the limits of its 95 % confidence interval."""

    value: float
    low: float
    high: float


def estimate_median(values: Sequence[float]) -> Interval:
    """Estimate the median of values, with its confidence interval.

    The limits of the interval are order statistics. If there are fewer than 8 values, the limits
    are the minimum and the maximum.

    Source: Conover, Practical Nonparametric Statistics, 1999, section 3.2.
    """
    ordered, half = np.sort(values), 0.5 * len(values)
    margin = 0.5 * NORMAL_95 * np.sqrt(len(values))
    # Conover's ranks begin at 1.
    low, high = (
        min(max(int(np.ceil(rank)) - 1, 0), len(values) - 1)
        for rank in (half - margin, half + margin)
    )
    return Interval(float(np.median(ordered)), float(ordered[low]), float(ordered[high]))


@dataclass(frozen=True, slots=True)
class Trial:
    """A measurement of one method in one benchmark case.

    run: function whose time is measured.
    error: function from the result of `run` to the error in the unit of the method family.
    in_range: whether the method's valid range includes the case.
    in_scene: whether the scene's working range includes the case.
    size: size of the solved problem, such as {"skin_nodes": 1210}.
    extra_metrics: function from the result of `run` to further results, with units in their names.
    reference_uncertainty: uncertainties of the reference. The keys are "error" and the names of
        extra metrics.
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
    """Do nothing. This function is the default of `Family.prepare`."""


@dataclass(frozen=True, slots=True)
class Family:
    """A set of interchangeable methods whose errors are measured against one reference.

    trials: function that yields the trials of all methods over a scene's working range. A trial
        must be run before the next trial is requested.
    tolerance: function that returns the scene's tolerance for the error, in `unit`.
    sweep_key: key of a property of the benchmark cases; a separate plot shows the errors against
        this property. None means that there is no such plot.
    prepare: function that computes and caches the data for `trials`, and reports its progress.
    """

    name: str
    unit: str
    reference: str
    methods: Sequence[str]
    trials: Callable[[Scene], Iterable[Trial]]
    tolerance: Callable[[Scene], float]
    sweep_key: str | None = None
    prepare: Callable[[Scene, Progress], object] = prepare_nothing


@dataclass(frozen=True, slots=True)
class Point:
    """The measured time and error of one method in one benchmark case.

    params: case and size of the solved problem.
    median_s, p99_s: median and 99th percentile of the time.
    in_range: whether the method's valid range includes the case.
    in_scene: whether the scene's working range includes the case.
    extra_metrics: further results, with units in their names.
    reference_uncertainty: uncertainties of the reference. The keys are "error" and the names of
        extra metrics.
    median_range_s: limits of the 95 % confidence interval of the median.
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
    median_range_s: tuple[float, float] | None = None

    def costs(self) -> tuple[Interval, Interval]:
        """Return the method's costs: median time with its confidence interval, and error."""
        return (
            Interval(self.median_s, *(self.median_range_s or (self.median_s, self.median_s))),
            Interval(self.error, self.error, self.error),
        )


def measure(trial: Trial, *, repeats: int) -> Point:
    """Measure the time of `repeats` runs of a trial after a warm-up run, and evaluate the error.

    Slow trials are repeated less often (see `MAX_TRIAL_S`).
    """
    result = trial.run()
    durations: list[float] = []
    while len(durations) < repeats:
        start = time.perf_counter()
        result = trial.run()
        durations.append(time.perf_counter() - start)
        if len(durations) >= MIN_REPEATS and sum(durations) > MAX_TRIAL_S:
            break
    median = estimate_median(durations)
    return Point(
        method=trial.method,
        case=trial.case,
        params={**trial.case, **trial.size},
        median_s=median.value,
        p99_s=float(np.quantile(durations, 0.99)),
        error=float(trial.error(result)),
        in_range=bool(trial.in_range),
        in_scene=bool(trial.in_scene),
        extra_metrics=dict(trial.extra_metrics(result)),
        reference_uncertainty=dict(trial.reference_uncertainty),
        median_range_s=(median.low, median.high),
    )


def clip_range(end: float, values: Sequence[float]) -> tuple[float, ...]:
    """Return the values that are less than `end`, followed by `end`.

    The function limits the cases of a benchmark to the scene's working range.
    """
    return (*(value for value in values if value < end * (1.0 - 1e-6)), end)


def pareto_front(points: Sequence[Point]) -> list[str]:
    """Return the methods that are on the Pareto front of at least one benchmark case.

    Only results within the valid range of their method are compared. The methods are sorted by the
    maximum of their median times over the cases.
    """
    usable = [point for point in points if point.in_range]
    front = {
        point.method: max(one.median_s for one in usable if one.method == point.method)
        for point in usable
        if not any(
            dominates(other.costs(), point.costs()) for other in usable if other.case == point.case
        )
    }
    return sorted(front, key=lambda method: front[method])


def dominates(one: Sequence[Interval], other: Sequence[Interval]) -> bool:
    """Return whether the costs `one` dominate the costs `other`.

    This is the case if at least one cost is lower, and no cost is higher. Costs with overlapping
    confidence intervals count as equal.
    """
    pairs = list(zip(one, other, strict=True))
    better = any(mine.high < theirs.low for mine, theirs in pairs)
    return better and not any(theirs.high < mine.low for mine, theirs in pairs)
