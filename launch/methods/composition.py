"""Find the cheapest combination of one method per method family that meets all tolerances.

The error of each system metric is predicted from the measured errors of the stages. Independent
random errors (spreads) add as squares: marker noise, tracking error at the time of use, and errors
that no measurement of a method contains (planner, servo, calibration). Signed errors of force
models and delays (biases) add linearly. The prediction decides which combination is run next in the
graph. The errors in this run decide whether it is accepted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from itertools import product
from typing import Any

MAX_RUNS = 4
"""The maximum number of configurations that are run through the graph."""

P95_OVER_RMS = 1.614
"""The ratio of the 95 % quantile to the root mean square of the length of a 3D Gaussian error."""


class SystemMetric(StrEnum):
    """The 95 % errors and latencies of the system that have a tolerance; the values are result
    keys.
    """

    SHEET = "sheet_mm"
    IMAGE = "image_mm"
    FORCE = "force_percent"
    FINGERTIP = "fingertip_mm"
    SKIN = "skin_mm"
    TO_ARM = "exposure_to_arm_ms"
    TO_LIGHT = "exposure_to_light_ms"


DELAYS = frozenset({SystemMetric.TO_ARM, SystemMetric.TO_LIGHT})


@dataclass(frozen=True, slots=True)
class StageOption:
    """A method that can be chosen for a stage.

    cores: processor time per second. spreads, biases: 95 % errors or delays (ms) that it adds to
    metrics. given: methods of other stages for which these values were measured. in_range: whether
    the method's stated range contains the scene's working range.
    """

    method: str
    cores: float
    spreads: Mapping[SystemMetric, float] = field(default_factory=dict)
    biases: Mapping[SystemMetric, float] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    in_range: bool = True


Combination = Mapping[str, StageOption]
Figures = Mapping[SystemMetric, float]


@dataclass(frozen=True, slots=True)
class Unexplained:
    """The excess of measured over predicted system metrics, learned from runs of the graph.

    The excess is added to later predictions.
    """

    parts: Figures = field(default_factory=dict)

    def learn(self, predicted: Figures, measured: Figures) -> Unexplained:
        """Return the excess updated with a run.

        predicted: metrics predicted for the run, excluding any excess.
        """
        parts = dict(self.parts)
        for metric, value in measured.items():
            known = predicted.get(metric, 0.0)
            if value > known:
                rest = value - known if metric in DELAYS else math.sqrt(value**2 - known**2)
                parts[metric] = max(parts.get(metric, 0.0), rest)
        return Unexplained(parts)


def predict(combination: Combination, unexplained: Unexplained | None = None) -> Figures:
    """Predict the system metrics of a combination: spreads add as squares, biases linearly."""
    squares: dict[SystemMetric, float] = {}
    sums: dict[SystemMetric, float] = {}
    for option in combination.values():
        for metric, value in option.spreads.items():
            squares[metric] = squares.get(metric, 0.0) + value**2
        for metric, value in option.biases.items():
            sums[metric] = sums.get(metric, 0.0) + abs(value)
    for metric, value in (unexplained or Unexplained()).parts.items():
        if metric in DELAYS:
            sums[metric] = sums.get(metric, 0.0) + value
        else:
            squares[metric] = squares.get(metric, 0.0) + value**2
    metrics = dict.fromkeys((*squares, *sums))
    return {one: math.sqrt(squares.get(one, 0.0)) + sums.get(one, 0.0) for one in metrics}


def budget(combination: Combination, metric: SystemMetric) -> dict[str, float]:
    """Return the error that each stage adds to a metric; stages that add none are left out."""
    parts = {
        stage: option.spreads.get(metric, 0.0) + abs(option.biases.get(metric, 0.0))
        for stage, option in combination.items()
    }
    return {stage: part for stage, part in parts.items() if part > 0.0}


def list_combinations(stages: Mapping[str, Sequence[StageOption]]) -> list[Combination]:
    """Return all combinations of one option per stage, sorted by their cost.

    Combinations are omitted if an option was measured with another method of a stage (`given`).
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
    """Return the processor cores that a combination uses."""
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
    """A run of one combination in the graph.

    predicted, measured: 95 % values by metric. exceeded: ratio of value to tolerance of each metric
    that exceeds its tolerance.
    """

    methods: Mapping[str, str]
    cores: float
    predicted: Figures
    measured: Figures
    exceeded: Mapping[SystemMetric, float]


@dataclass(frozen=True, slots=True)
class Composition:
    """The result of the search for a combination of methods.

    chosen: accepted combination, or the one that exceeds the tolerances least. runs: all runs.
    """

    chosen: Combination
    runs: tuple[GraphRun, ...]
    tolerances: Figures

    @property
    def last(self) -> GraphRun:
        """Return the run of the chosen combination."""
        methods = name_methods(self.chosen)
        return next(run for run in reversed(self.runs) if run.methods == methods)

    @property
    def accepted(self) -> bool:
        return not self.last.exceeded and all(one.in_range for one in self.chosen.values())

    def report(self) -> dict[str, Any]:
        """Return the result as `flexsheet tune --json` prints it."""
        return {
            "accepted": self.accepted,
            "tolerances": {metric.value: limit for metric, limit in self.tolerances.items()},
            "budget": {metric.value: budget(self.chosen, metric) for metric in self.tolerances},
            "runs": [asdict(run) for run in self.runs],
            "sentences": self.explain(),
        }

    def explain(self) -> list[str]:
        """Return the result in one sentence, and a sentence for each tolerance that is not met."""
        run = self.last
        names = ", ".join(f"{stage} {method}" for stage, method in run.methods.items())
        if self.accepted:
            return [f"accepted after {len(self.runs)} runs of the graph: {names}"]
        lines = [f"no configuration meets all tolerances; the best is: {names}"]
        for metric in run.exceeded:
            stages = ", ".join(
                f"{stage} {part:.3g}" for stage, part in budget(self.chosen, metric).items()
            )
            best = min(self.runs, key=lambda one: one.measured.get(metric, math.inf))
            lines.append(
                f"{metric}: {run.measured[metric]:.3g}, tolerance {self.tolerances[metric]:.3g}; "
                f"methods add {stages or 'nothing'}; the best run has {best.measured[metric]:.3g} "
                f"for {best.cores / run.cores if run.cores else 1.0:.2g} times the processor time"
            )
        lines += [
            f"{stage} {option.method}: its range does not contain the scene's working range"
            for stage, option in self.chosen.items()
            if not option.in_range
        ]
        return lines


def name_methods(combination: Combination) -> dict[str, str]:
    """Return the name of the method of each stage."""
    return {stage: option.method for stage, option in combination.items()}


def compose(
    stages: Mapping[str, Sequence[StageOption]],
    tolerances: Figures,
    run_graph: Callable[[Combination], Figures],
    *,
    margin: float,
    max_runs: int = MAX_RUNS,
) -> Composition:
    """Find the cheapest combination that meets all tolerances in a run of the graph.

    Runs the cheapest combination whose predicted metrics keep the margin. If its run exceeds a
    tolerance, corrects all predictions by the difference, and runs the next combination. If no
    prediction is within the tolerances, runs the combination that exceeds them least.
    """
    combinations = list_combinations(stages)
    allowed = {metric: (1.0 - margin) * limit for metric, limit in tolerances.items()}
    unexplained, runs = Unexplained(), list[GraphRun]()
    tried: list[Combination] = []
    while len(runs) < max_runs:
        left = [one for one in combinations if one not in tried]
        if not left:
            break
        promising = [one for one in left if not _predicted_excess(one, unexplained, allowed)]
        if not promising and runs:
            limits = tolerances  # runs may use the margin that predictions leave
            promising = [one for one in left if not _predicted_excess(one, unexplained, limits)]
        proposed = (
            promising[0]
            if promising
            else min(left, key=lambda one: _miss(one, unexplained, allowed))
        )
        tried.append(proposed)
        measured = run_graph(proposed)
        predicted = predict(proposed)
        exceeded = excess(measured, tolerances)
        runs.append(GraphRun(name_methods(proposed), cost(proposed), predicted, measured, exceeded))
        if (not exceeded and _is_in_range(proposed)) or not promising:
            break
        unexplained = unexplained.learn(predicted, measured)
    best = min(
        range(len(runs)),
        key=lambda i: (
            not _is_in_range(tried[i]),
            max(runs[i].exceeded.values(), default=0.0),
            runs[i].cores,
        ),
    )
    return Composition(tried[best], tuple(runs), tolerances)


def _is_in_range(combination: Combination) -> bool:
    return all(option.in_range for option in combination.values())


def _predicted_excess(one: Combination, unexplained: Unexplained, limits: Figures) -> bool:
    return not _is_in_range(one) or bool(excess(predict(one, unexplained), limits))


def _miss(one: Combination, unexplained: Unexplained, limits: Figures) -> tuple[int, float, float]:
    """Return a key that sorts combinations by methods out of range, then excess, then cost."""
    outside = sum(not option.in_range for option in one.values())
    worst = max(excess(predict(one, unexplained), limits).values(), default=0.0)
    return outside, worst, cost(one)
