"""Simulate a participant of the stiffness experiment, in order to test the estimator.

The participant perceives the logarithm of each stiffness with normally distributed noise, prefers
the first or the second object, and sometimes answers at random. The estimator does not know these
parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

SEED_STREAM = 75
"""The second element of the random seed, so that the seed differs from the session's seed."""

WEBER_RANGE = (0.08, 0.3)
"""The range of Weber fractions of simulated participants.

Published values for stiffness are 0.07 (force cue) to 0.23.
"""

MAX_LAPSE_RATE = 0.05
BIAS_SIGMAS = 0.2
"""The standard deviation of the interval bias, in standard deviations of a perceived difference."""


@dataclass(frozen=True, slots=True)
class Perception:
    """The parameters of the perception of a simulated participant.

    noise: standard deviation of the perceived logarithm of a stiffness.
    bias: value added to the perceived logarithm of the second object's stiffness.
    lapse_rate: fraction of trials that are answered at random.
    """

    noise: float
    bias: float
    lapse_rate: float

    @property
    def weber_fraction(self) -> float:
        """Return the relative stiffness increment that gives 75 % correct answers.

        Lapses and bias are not included.
        """
        return math.expm1(NormalDist(0.0, math.sqrt(2.0) * self.noise).inv_cdf(0.75))


class SimulatedParticipant:
    """A simulated participant who compares the noisily perceived stiffness of two objects.

    The noise depends only on the seed and the number of the trial. Therefore an interrupted session
    continues with the same answers.
    """

    def __init__(self, seed: int, perception: Perception | None = None) -> None:
        self._seed = seed
        self.perception = perception or draw_perception(seed)

    def answer(self, trial: int, first_pa: float, second_pa: float) -> int:
        """Return the number (1 or 2) of the object that appears stiffer.

        trial: number of the trial.
        first_pa, second_pa: Young's moduli of the objects.
        """
        random = np.random.default_rng((self._seed, SEED_STREAM, trial))
        mind = self.perception
        if random.random() < mind.lapse_rate:
            return int(random.integers(1, 3))
        first = math.log(first_pa) + mind.noise * random.standard_normal()
        second = math.log(second_pa) + mind.noise * random.standard_normal() + mind.bias
        return 2 if second > first else 1


def draw_perception(seed: int) -> Perception:
    """Return random perception parameters for a participant."""
    random = np.random.default_rng((seed, SEED_STREAM))
    low, high = np.log(WEBER_RANGE)
    weber = math.exp(random.uniform(low, high))
    difference = math.log1p(weber) / NormalDist().inv_cdf(0.75)
    return Perception(
        noise=difference / math.sqrt(2.0),
        bias=BIAS_SIGMAS * difference * float(random.standard_normal()),
        lapse_rate=float(random.uniform(0.0, MAX_LAPSE_RATE)),
    )
