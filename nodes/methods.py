"""Method families: interchangeable functions, one reference, errors in the scene's units.

A node's folder holds its methods as plain functions and describes them in `FAMILY = Family(...)`.
One harness (`launch.methods.charts`) times every method, measures its error against the reference
over the scene's working range, and draws speed against accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from messages.scene import Scene

LONGEST_S, FEWEST_REPEATS = 3.0, 3
"""A trial is not repeated after so long in all, but so often at least."""

Progress = Callable[[int, int], None]
Case = dict[str, float | int | str]
"""What a measurement was taken at, in the scene's units: {"depth_mm": 10}."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One measurable use of one method: `run` is timed, `error` judges what it returned.

    case: what was asked; methods are compared at equal cases.
    error: takes the result of `run`, gives the error in the family's unit.
    in_range: whether the method's stated range covers this case.
    in_scene: whether the scene's working range asks for this case; others show where methods end.
    size: how large the method made its work of it ({"skin_nodes": 1210}), reported with the case.
    also: further figures of what `run` returned, in units that their names tell.
    doubts: how unsure the reference itself is, of the error ("error") and of further figures.
    """

    method: str
    case: Case
    run: Callable[[], Any]
    error: Callable[[Any], float]
    in_range: bool
    in_scene: bool = True
    size: Case = field(default_factory=dict)
    also: Callable[[Any], Mapping[str, float]] = lambda result: {}
    doubts: Mapping[str, float] = field(default_factory=dict)


def nothing_to_prepare(scene: Scene, told: Progress) -> None:
    """Of a family whose trials are at hand at once."""


@dataclass(frozen=True, slots=True)
class Family:
    """A set of interchangeable methods.

    trials: yields the trials of every method over a scene's working range; each may be run until
        the next is asked for.
    tolerance: the scene's tolerance, in `unit`.
    along: the part of the case that errors are drawn over in a picture of their own, if any.
    prepare: works out, and keeps, what takes long and `trials` needs; told of done and total steps.
    """

    name: str
    unit: str
    reference: str
    methods: Sequence[str]
    trials: Callable[[Scene], Iterable[Trial]]
    tolerance: Callable[[Scene], float]
    along: str | None = None
    prepare: Callable[[Scene, Progress], None] = nothing_to_prepare


@dataclass(frozen=True, slots=True)
class Point:
    """One method at one case: how long it takes and how wrong it is.

    params: the case and the method's size together.  in_scene, also, doubts: as of its trial.
    """

    method: str
    case: Case
    params: Case
    median_s: float
    p99_s: float
    error: float
    in_range: bool
    in_scene: bool = True
    also: Mapping[str, float] = field(default_factory=dict)
    doubts: Mapping[str, float] = field(default_factory=dict)


def measure(trial: Trial, *, repeats: int) -> Point:
    """Time `trial.run` `repeats` times (after one run that is not counted) and judge its result.

    What takes long is repeated less often, as `LONGEST_S` says.
    """
    result = trial.run()
    durations: list[float] = []
    while len(durations) < repeats:
        start = time.perf_counter()
        result = trial.run()
        durations.append(time.perf_counter() - start)
        if len(durations) >= FEWEST_REPEATS and sum(durations) > LONGEST_S:
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
        also=dict(trial.also(result)),
        doubts=dict(trial.doubts),
    )


def up_to(largest: float, usual: Sequence[float]) -> tuple[float, ...]:
    """The usual values that a working range holds, and its end."""
    within = [value for value in usual if value < largest * (1.0 - 1e-6)]
    return (*within, largest)


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
