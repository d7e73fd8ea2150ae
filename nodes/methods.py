"""Method families: interchangeable functions, one reference, errors in the scene's units.

A node's folder holds its methods as plain functions and describes them in `FAMILY = Family(...)`.
One harness (`launch.charts`) times every method, measures its error against the reference over the
scene's working range, and draws speed against accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from messages.scene import Scene

Case = dict[str, float | int | str]
"""What a measurement was taken at, in the scene's units: {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One measurable use of one method: `run` is timed, `error` judges what it returned.

    error: takes the result of `run`, gives the error in the family's unit.
    in_range: whether the method's stated range covers this case.
    """

    method: str
    case: Case
    run: Callable[[], Any]
    error: Callable[[Any], float]
    in_range: bool


@dataclass(frozen=True, slots=True)
class Family:
    """A set of interchangeable methods.

    trials: yields the trials of every method over a scene's working range.
    tolerance: the scene's tolerance, in `unit`.
    """

    name: str
    unit: str
    reference: str
    methods: Sequence[str]
    trials: Callable[[Scene], Iterable[Trial]]
    tolerance: Callable[[Scene], float]


@dataclass(frozen=True, slots=True)
class Point:
    """One method at one case: how long it takes and how wrong it is."""

    method: str
    params: Case
    median_s: float
    p99_s: float
    error: float
    in_range: bool


def measure(trial: Trial, *, repeats: int) -> Point:
    """Time `trial.run` `repeats` times (after one run that is not counted) and judge its result."""
    result = trial.run()
    durations = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        result = trial.run()
        durations[i] = time.perf_counter() - start
    return Point(
        method=trial.method,
        params=trial.case,
        median_s=float(np.median(durations)),
        p99_s=float(np.quantile(durations, 0.99)),
        error=float(trial.error(result)),
        in_range=trial.in_range,
    )


def pareto_front(points: Sequence[Point]) -> list[str]:
    """Methods that no other beats in both time and worst in-range error, fastest first.

    A method stands for its slowest median and its largest error over the cases in its range.
    """
    summary: dict[str, tuple[float, float]] = {}
    for point in points:
        if point.in_range:
            time_s, error = summary.get(point.method, (0.0, 0.0))
            summary[point.method] = (max(time_s, point.median_s), max(error, point.error))
    front = [
        method
        for method, (time_s, error) in summary.items()
        if not any(
            other_time <= time_s
            and other_error <= error
            and (other_time, other_error) != (time_s, error)
            for other_time, other_error in summary.values()
        )
    ]
    return sorted(front, key=lambda method: summary[method][0])
