"""Find the cheapest combination of one method per method family that meets all tolerances.

The error of each system metric is predicted from the measured errors of the methods. Independent
random errors (spreads) are combined as the root of the sum of their squares. These are the marker
noise and the tracking error at the time of use. Errors that are not measured for single methods
(planner, servo, calibration) are added in the same way. Signed errors of force models and delays
(biases) add linearly.

The prediction decides which combination is run next in the graph. The measured errors of this run
decide whether the combination is accepted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from itertools import product
from typing import Any

from flexsheet.launch.experiments import ExperimentError

MAX_RUNS = 4
"""The maximum number of configurations that are tested in the graph."""

EQUAL_RATIO = 1.05
"""Two errors of the system are considered equal if their ratio is below this value."""

EQUAL_DELAY_RATIO = 1.5
"""Two latencies are considered equal if their ratio is below this value. The 95 % latency of one
configuration varies by about this ratio between the blocks of `flexsheet chart system`."""

P95_OVER_RMS = 1.614
"""The 95 % quantile of the length of a 3D Gaussian vector, divided by the length's rms value."""


class SystemMetric(StrEnum):
    """The errors and latencies of the system that are compared with tolerances.

    Each metric is a 95 % quantile. The values of the enumeration are keys of the results.
    """

    SHEET = "sheet_mm"
    IMAGE = "image_mm"
    FORCE = "force_percent"
    FINGERTIP = "fingertip_mm"
    SKIN = "skin_mm"
    TO_ARM = "exposure_to_arm_ms"
    TO_LIGHT = "exposure_to_light_ms"

    @property
    def label(self) -> str:
        """Return the name of the metric in words, without the unit."""
        return self.value.rpartition("_")[0].replace("_", " ")


DELAYS = frozenset({SystemMetric.TO_ARM, SystemMetric.TO_LIGHT})


@dataclass(frozen=True, slots=True)
class StageOption:
    """A method that can be chosen for a processing stage.

    cores: processor time (s) per second.
    spreads, biases: random errors (spreads) and signed errors (biases) that the method adds to each
        system metric. Random errors are 95 % quantiles. Delays are biases in ms.
    given: methods of other stages with which these errors were measured, by stage.
    outside: fraction of the scene's cases that are outside the range in which the method is valid.
    """

    method: str
    cores: float
    spreads: Mapping[SystemMetric, float] = field(default_factory=dict)
    biases: Mapping[SystemMetric, float] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    outside: float = 0.0

    @property
    def in_range(self) -> bool:
        return self.outside == 0.0


Combination = Mapping[str, StageOption]
Figures = Mapping[SystemMetric, float]


@dataclass(frozen=True, slots=True)
class Unexplained:
    """The errors and latencies that are not explained by the measurements of single methods.

    For each system metric, this is the difference by which the measured value exceeds the predicted
    value. The difference is learned from runs of the graph, and is added to later predictions.
    """

    parts: Figures = field(default_factory=dict)

    def learn(self, combination: Combination, measured: Figures) -> Unexplained:
        """Return the unexplained errors after an update with the measured metrics of a run.

        With the result, `predict` does not underestimate the measured metrics of the combination.

        combination: combination of methods that was run.
        measured: system metrics of the run.
        """
        parts = dict(self.parts)
        squares, sums = _add_up(combination)
        for metric, value in measured.items():
            rest = max(0.0, value - sums.get(metric, 0.0))
            if metric not in DELAYS:
                rest = math.sqrt(max(0.0, rest**2 - squares.get(metric, 0.0)))
            parts[metric] = max(parts.get(metric, 0.0), rest)
        return Unexplained({metric: rest for metric, rest in parts.items() if rest > 0.0})


def predict(combination: Combination, unexplained: Unexplained | None = None) -> Figures:
    """Predict the system metrics of a combination of methods.

    Random errors (spreads) are combined as the root of the sum of their squares. Signed errors
    (biases) add linearly.
    """
    squares, sums = _add_up(combination)
    for metric, value in (unexplained or Unexplained()).parts.items():
        if metric in DELAYS:
            sums[metric] = sums.get(metric, 0.0) + value
        else:
            squares[metric] = squares.get(metric, 0.0) + value**2
    metrics = dict.fromkeys((*squares, *sums))
    return {one: math.sqrt(squares.get(one, 0.0)) + sums.get(one, 0.0) for one in metrics}


def _add_up(
    combination: Combination,
) -> tuple[dict[SystemMetric, float], dict[SystemMetric, float]]:
    """Add up the errors of all methods in a combination, for each system metric.

    Return the sums of the squared random errors, and the sums of the absolute signed errors.
    """
    squares: dict[SystemMetric, float] = {}
    sums: dict[SystemMetric, float] = {}
    for option in combination.values():
        for metric, value in option.spreads.items():
            squares[metric] = squares.get(metric, 0.0) + value**2
        for metric, value in option.biases.items():
            sums[metric] = sums.get(metric, 0.0) + abs(value)
    return squares, sums


def budget(combination: Combination, metric: SystemMetric) -> dict[str, float]:
    """Return how much error each processing stage adds to a system metric.

    Stages that add no error are omitted.
    """
    parts = {
        stage: option.spreads.get(metric, 0.0) + abs(option.biases.get(metric, 0.0))
        for stage, option in combination.items()
    }
    return {stage: part for stage, part in parts.items() if part > 0.0}


def list_combinations(stages: Mapping[str, Sequence[StageOption]]) -> list[Combination]:
    """Return all combinations of one method per processing stage, sorted by their cost.

    A combination is omitted if one of its methods was measured together with a method (field
    `given`) that the combination does not contain.
    """
    combinations = [
        dict(zip(stages, options, strict=True)) for options in product(*stages.values())
    ]
    fitting = [
        one
        for one in combinations
        if all(
            one[stage].method == method
            for option in one.values()
            for stage, method in option.given.items()
            if stage in one
        )
    ]
    return sorted(fitting, key=cost)


def cost(combination: Combination) -> float:
    """Return the number of processor cores that a combination of methods uses."""
    return sum(option.cores for option in combination.values())


def excess(figures: Figures, tolerances: Figures) -> dict[SystemMetric, float]:
    """Return the ratio of value to tolerance for each metric that exceeds its tolerance."""
    return {
        metric: figures[metric] / limit
        for metric, limit in tolerances.items()
        if metric in figures and not figures[metric] <= limit
    }


@dataclass(frozen=True, slots=True)
class GraphRun:
    """A run of one combination of methods in the graph.

    methods: names of the methods, by processing stage.
    cores: number of processor cores that the combination is expected to use.
    predicted, measured: predicted system metrics, and metrics measured in the run, as 95 %
        quantiles. If a metric cannot be measured, its predicted value is used for both.
    exceeded: ratio of value to tolerance of each metric that exceeds its tolerance.
    """

    methods: Mapping[str, str]
    cores: float
    predicted: Figures
    measured: Figures
    exceeded: Mapping[SystemMetric, float]


@dataclass(frozen=True, slots=True)
class Composition:
    """The result of the search for a combination of methods.

    chosen: accepted combination, or the combination that exceeds the tolerances least.
    runs: all runs of the graph, in order.
    """

    chosen: Combination
    runs: tuple[GraphRun, ...]
    tolerances: Figures

    @property
    def last(self) -> GraphRun:
        """Return the last run of the graph that used the chosen combination of methods."""
        methods = name_methods(self.chosen)
        return next(run for run in reversed(self.runs) if run.methods == methods)

    @property
    def accepted(self) -> bool:
        return not self.last.exceeded and all(one.in_range for one in self.chosen.values())

    @property
    def unmet(self) -> str:
        """Return a text about exceeded tolerances and unsuitable methods, or "" if there are none.

        A method is unsuitable if the scene is not within the range in which the method is valid.
        """
        exceeded = ", ".join(metric.label for metric in self.last.exceeded)
        stages = ", ".join(stage for stage, option in self.chosen.items() if not option.in_range)
        sentences = []
        if exceeded:
            sentences.append(f"Not met at the 95 % value: {exceeded}.")
        if stages:
            sentences.append(f"The scene exceeds the range of the method: {stages}.")
        return " ".join(sentences)

    def report(self) -> dict[str, Any]:
        """Return the result in the format of `flexsheet tune --json`."""
        return {
            "accepted": self.accepted,
            "tolerances": {metric.value: limit for metric, limit in self.tolerances.items()},
            "budget": {metric.value: budget(self.chosen, metric) for metric in self.tolerances},
            "runs": [asdict(run) for run in self.runs],
            "sentences": self.explain(),
        }

    def explain(self) -> list[str]:
        """Return sentences about the result of the search and its problems.

        A problem is a tolerance that is not met, or a method that is not valid for the scene.
        """
        run = self.last
        names = ", ".join(f"{stage} {method}" for stage, method in run.methods.items())
        if self.accepted:
            return [f"accepted after {len(self.runs)} runs of the graph: {names}"]
        problem = (
            "no tested configuration meets all tolerances"
            if run.exceeded
            else "the methods' ranges do not contain the scene's working range"
        )
        lines = [f"{problem}; the best is: {names}"]
        for metric in run.exceeded:
            stages = ", ".join(
                f"{stage} {part:.3g}" for stage, part in budget(self.chosen, metric).items()
            )
            best = min(self.runs, key=lambda one: one.measured.get(metric, math.inf))
            line = f"{metric}: {run.measured[metric]:.3g}, tolerance {self.tolerances[metric]:.3g}"
            line += f"; methods add {stages or 'nothing'}"
            if best is not run and run.cores:
                line += f"; the run with the smallest value has {best.measured[metric]:.3g} for "
                line += f"{best.cores / run.cores:.2g} times the processor time of the methods"
            lines.append(line)
        lines += [
            f"{stage} {option.method}: {option.outside:.0%} of the scene's cases are out of range"
            for stage, option in self.chosen.items()
            if not option.in_range
        ]
        return lines


def name_methods(combination: Combination) -> dict[str, str]:
    """Return the names of the methods in a combination, by stage."""
    return {stage: option.method for stage, option in combination.items()}


def compose(
    stages: Mapping[str, Sequence[StageOption]],
    tolerances: Figures,
    run_graph: Callable[[Combination], Figures],
    *,
    margin: float,
) -> Composition:
    """Find the cheapest combination of methods that meets all tolerances in a run of the graph.

    A method has a range of cases in which it is valid. Only combinations with the fewest cases
    outside these ranges are considered. The search has three steps:

    1. The cheapest combination is run whose predicted metrics meet the tolerances with the margin.
    2. If a tolerance is exceeded in the run, all predictions are corrected, and the next
       combination is run. This is repeated until no other combination is predicted to improve an
       exceeded metric.
    3. If the predictions for the best run were too pessimistic, cheaper combinations are run.
       Combinations in which the error of a single method exceeds a tolerance are skipped.

    If no combination can meet a tolerance, the result is near the smallest attainable value of this
    metric.

    run_graph: function that runs a combination and returns its metrics.
    margin: fraction of each tolerance that a predicted metric must leave unused.

    Raises ExperimentError if there is no combination.
    """
    combinations = list_combinations(stages)
    if not combinations:
        raise ExperimentError(
            "the tested methods cannot be combined, or a method family has no measured method"
        )
    least_outside = min(map(_outside, combinations))
    combinations = [one for one in combinations if math.isclose(_outside(one), least_outside)]
    allowed = {metric: (1.0 - margin) * limit for metric, limit in tolerances.items()}
    unexplained, runs = Unexplained(), list[GraphRun]()
    tried: list[Combination] = []

    def run(proposed: Combination) -> GraphRun:
        measured = {**predict(proposed), **run_graph(proposed)}
        exceeded = excess(measured, tolerances)
        tried.append(proposed)
        runs.append(
            GraphRun(name_methods(proposed), cost(proposed), predict(proposed), measured, exceeded)
        )
        return runs[-1]

    while len(runs) < MAX_RUNS and len(tried) < len(combinations):
        left = [one for one in combinations if one not in tried]
        proposed = _propose(left, unexplained, allowed)
        if runs and excess(predict(proposed, unexplained), allowed):
            # The margin applies only to predictions; a run may use the whole tolerance.
            proposed = _propose(left, unexplained, tolerances)
        latest = run(proposed)
        unexplained = unexplained.learn(proposed, latest.measured)
        others = [predict(one, unexplained) for one in left if one is not proposed]
        if not any(
            _equal_ratio(metric) * one.get(metric, math.inf) < latest.measured[metric]
            for one in others
            for metric in latest.exceeded
        ):
            break
    best = _find_best(runs, tolerances)
    while len(runs) < MAX_RUNS:
        candidates = [one for one in combinations if not _adds_miss(one, tried[best], tolerances)]
        cheaper = _find_cheaper(candidates, tried, runs[best], tolerances, margin)
        if cheaper is None:
            break
        run(cheaper)
        best = _find_best(runs, tolerances)
        if best != len(runs) - 1:
            break
    return Composition(tried[best], tuple(runs), tolerances)


def _find_best(runs: Sequence[GraphRun], tolerances: Figures) -> int:
    """Return the index of the run that exceeds the tolerances least.

    A tolerance that no run meets is first raised to about the smallest measured value (`_relax`).
    If several runs are equally good, the index of the cheapest run is returned.
    """
    limits = _relax(tolerances, [run.measured for run in runs])
    return min(
        range(len(runs)), key=lambda i: (_sum_excess(runs[i].measured, limits), runs[i].cores)
    )


def _find_cheaper(
    combinations: Sequence[Combination],
    tried: Sequence[Combination],
    best: GraphRun,
    tolerances: Figures,
    margin: float,
) -> Combination | None:
    """Return the cheapest untested combination of methods that costs less than the best tested one.

    Its predicted errors must meet the tolerances, or at least be as small as those of the best
    tested combination. Returns None if there is no such combination.

    The predicted errors are sums of worst-case errors, which are larger than the errors of the
    system. They are therefore corrected by the ratio of measured to predicted errors of the best
    tested combination.

    best: result of the best tested combination.
    margin: fraction by which the tolerances are reduced.
    """
    allowed = {metric: (1.0 - margin) * limit for metric, limit in tolerances.items()}
    limits = _relax(allowed, [best.measured])
    for one in combinations:
        if cost(one) >= best.cores:
            return None
        expected = {
            metric: value * min(1.0, best.measured[metric] / best.predicted[metric])
            if best.predicted.get(metric)
            else value
            for metric, value in predict(one).items()
        }
        if one not in tried and not excess(expected, limits):
            return one
    return None


def _adds_miss(one: Combination, best: Combination, tolerances: Figures) -> bool:
    """Return whether a single method in a combination already exceeds a tolerance.

    A method is accepted if the method for the same stage in the combination `best` exceeds this
    tolerance too.

    The check is based on measurements of single methods over the whole working range. A run of the
    graph covers only a part of the range, so it cannot prove that the tolerance is met.
    """
    return any(
        _own_error(option, metric) > limit >= _own_error(best[stage], metric)
        for stage, option in one.items()
        for metric, limit in tolerances.items()
    )


def _own_error(option: StageOption, metric: SystemMetric) -> float:
    return option.spreads.get(metric, 0.0) + abs(option.biases.get(metric, 0.0))


def _propose(left: Sequence[Combination], unexplained: Unexplained, limits: Figures) -> Combination:
    """Return the cheapest combination of methods that is predicted to meet all limits.

    A limit that no combination meets is first raised to about the smallest predicted value
    (`_relax`). If no combination meets all limits at the same time, return the combination that
    exceeds them least.

    left: combinations that have not been run.
    limits: maximum of each system metric.
    """
    predicted = [predict(one, unexplained) for one in left]
    attainable = _relax(limits, predicted)

    def key(i: int) -> tuple[float, float]:
        return _sum_excess(predicted[i], attainable), cost(left[i])

    return left[min(range(len(left)), key=key)]


def _outside(combination: Combination) -> float:
    """Return a measure of how far a combination of methods is outside its valid range.

    For each method, the fraction of the scene's cases outside the valid range of the method is
    computed. The result is the sum of these fractions.
    """
    return sum(option.outside for option in combination.values())


def _relax(limits: Figures, found: Sequence[Figures]) -> Figures:
    """Raise each limit that no combination of methods meets to an attainable value.

    The attainable value is the smallest value of the metric in `found`, multiplied by a tolerance
    factor for values that are considered equal.

    found: metrics of each combination.
    """
    return {
        metric: max(
            limit,
            _equal_ratio(metric)
            * min((one[metric] for one in found if metric in one), default=0.0),
        )
        for metric, limit in limits.items()
    }


def _equal_ratio(metric: SystemMetric) -> float:
    return EQUAL_DELAY_RATIO if metric in DELAYS else EQUAL_RATIO


def _sum_excess(figures: Figures, limits: Figures) -> float:
    """Return the sum of log(value / limit) over the metrics that exceed their limit.

    The result is infinite if a value is not a number.
    """
    ratios = excess(figures, limits).values()
    return math.inf if any(map(math.isnan, ratios)) else sum(map(math.log, ratios))
