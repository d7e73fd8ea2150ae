"""Method families: interchangeable functions, one reference, errors in the scene's units.

A node's folder holds its methods as plain functions and describes them in `FAMILY = Family(...)`.
One harness (`launch.charts`) times every method, measures its error against the reference over the
scene's working range, and draws speed against accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from messages.scene import Scene

Case = dict[str, float | int | str]
"""What a measurement was taken at, in the scene's units: {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One measurable use of one method: `run` is timed, `error` judges what it returned.

    case: what was asked; methods are compared at equal cases.
    error: takes the result of `run`, gives the error in the family's unit.
    in_range: whether the method's stated range covers this case.
    size: how large the method made its work of it ({"skin_nodes": 1210}), reported with the case.
    """

    method: str
    case: Case
    run: Callable[[], Any]
    error: Callable[[Any], float]
    in_range: bool
    size: Case = field(default_factory=dict)


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
    """One method at one case: how long it takes and how wrong it is.

    params: the case and the method's size together.
    """

    method: str
    case: Case
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
        case=trial.case,
        params={**trial.case, **trial.size},
        median_s=float(np.median(durations)),
        p99_s=float(np.quantile(durations, 0.99)),
        error=float(trial.error(result)),
        in_range=trial.in_range,
    )


def pareto_front(points: Sequence[Point]) -> list[str]:
    """Methods that are worth having: in some case of its range no other is faster and as exact.

    Cases are compared one by one, since a cheap method is often exact where little happens and of
    no use elsewhere.  Fastest first, by the slowest median of each.
    """
    usable = [point for point in points if point.in_range]
    front = {
        point.method: max(one.median_s for one in usable if one.method == point.method)
        for point in usable
        if not any(beats(other, point) for other in usable if other.case == point.case)
    }
    return sorted(front, key=lambda method: front[method])


def beats(one: Point, other: Point) -> bool:
    """Whether a method is as fast and as exact as another, and better in one of the two."""
    return (
        one.median_s <= other.median_s
        and one.error <= other.error
        and (one.median_s, one.error) != (other.median_s, other.error)
    )
