"""Plan measurements of several configurations in randomised blocks, and evaluate them.

A block contains all configurations in random order, so that slow changes of the computer affect all
configurations equally. One configuration, the control, runs twice in each block. The ratio of its
two runs shows which differences are only noise. Runs in a block are not independent, so confidence
intervals are computed by bootstrap over whole blocks (Kalibera and Jones, ISMM 2013).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Interval, dominates

CONFIDENCE = 0.95
RESAMPLES = 2000
SEED = 20261123
"""The fixed random seed of the bootstrap, so that confidence intervals are reproducible."""


def order_blocks(names: Sequence[str], blocks: int, *, seed: int) -> list[list[str]]:
    """Return, for each block, a list of all configuration names in random order."""
    random = np.random.default_rng(seed)
    return [[names[i] for i in random.permutation(len(names))] for _ in range(blocks)]


def bootstrap_median(values: Floats) -> Interval | None:
    """Return the median of n measured values, with its bootstrap confidence interval.

    values: values (n,) of independent runs, one from each block of the measurement. NaN means that
        a run failed.

    Returns None if no value is finite. If only one value is finite, the limits of the interval are
    infinite.
    """
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return None
    median = float(np.median(known))
    if len(known) == 1:
        return Interval(median, -np.inf, np.inf)
    picks = np.random.default_rng(SEED).integers(len(known), size=(RESAMPLES, len(known)))
    tails = (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)
    low, high = np.quantile(np.median(known[picks], axis=1), tails)
    return Interval(median, float(low), float(high))


def compare_paired(values: Floats, control: Floats) -> Interval | None:
    """Return the median ratio of a configuration's values to the control's values.

    Values of the same block are compared. The result contains the confidence interval of the
    median. The median is computed from logarithms, so a ratio and its inverse have the same weight.

    values, control: positive values (n,), one for each of n blocks.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = bootstrap_median(np.log(values / control))
    if found is None:
        return None
    low, high = np.exp([found.low, found.high])
    return Interval(float(np.exp(found.value)), float(low), float(high))


def attribute_error(parts: Floats) -> Floats:
    """Return how much each of k error components contributes to the mean square error.

    The contributions (k,) are fractions that add up to one. A contribution is negative if the
    component partly cancels other components.

    parts: error components (k, n, d), each with n vectors of d dimensions. Their sum is the total
        error.
    """
    whole = parts.sum(axis=0)
    total = float(np.square(whole).sum())
    if total == 0.0:
        return np.zeros(len(parts))
    return np.asarray(np.einsum("knd,nd->k", parts, whole) / total)


def find_front(points: Mapping[str, Sequence[Interval]]) -> list[str]:
    """Return the names of the points that no other point dominates (the Pareto front).

    A point dominates another point if at least one of its costs is lower and none is higher. Costs
    with overlapping confidence intervals are considered equal.

    points: costs of each point, by name. Lower costs are better.
    """
    return [
        name
        for name, costs in points.items()
        if not any(dominates(other, costs) for key, other in points.items() if key != name)
    ]
