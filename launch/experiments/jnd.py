"""Measure the Weber fraction of stiffness with an adaptive staircase, and store its trials.

In each trial, the participant pushes two objects in succession, and names the stiffer one. One
object is the reference, and the other one is stiffer by the relative increment d. The probability
of a correct answer is

    p(d) = lapse / 2 + (1 - lapse) * Phi(ln(1 + d) / sigma +- bias),

with the normal distribution function Phi (Green & Swets, Signal detection theory, 1966). The lapse
rate is the fraction of trials that are answered at random. Sigma is the standard deviation of the
perceived difference of two log stiffnesses. The bias is a preference for the second object of a
trial. The bias is added if the second object is stiffer, and subtracted if the first object is
stiffer. The Weber fraction w is the increment at which 75 % of the answers would be correct if
there were no lapses and no bias. Therefore ln(1 + w) = 0.674 sigma.

Each trial uses the increment that gives the least expected entropy of the posterior of w. This is
the psi method (Kontsevich & Tyler, Vision Research 39:2729, 1999). The posterior is marginalised
over the unknown lapse rate and bias (Prins, Journal of Vision 13(7):3, 2013). The standard
deviation of ln w is inversely proportional to the square root of the number of trials;
`docs/jnd.md` states the measured error.

The trials are stored in a CSV file. An interrupted session is continued from the answers in this
file.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from flexsheet.launch.experiments import ExperimentError
from flexsheet.messages.files import make_write_error
from flexsheet.nodes.arrays import Floats

CRITERION = 0.75
"""The fraction of correct answers at the Weber fraction if there are no lapses."""

INCREMENTS = np.geomspace(0.02, 1.0, 25)
WEBER_FRACTIONS = np.geomspace(0.02, 1.0, 81)
LAPSE_RATES = np.array([0.0, 0.01, 0.03, 0.06, 0.12])
LAPSE_SCALE = 0.03
"""The mean of the lapse rate in its exponential prior distribution."""

BIASES = np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
BIAS_SCALE = 0.25
"""The standard deviation of the bias in its normal prior distribution, in units of sigma.

Sigma is the standard deviation of the perceived difference of two log stiffnesses.
"""

CATCH_PERIOD = 20
"""The number of trials after which the largest increment is used again, to detect inattention."""

INTERVAL_QUANTILES = (0.025, 0.975)


class StaircaseEstimator:
    """The posterior distribution of Weber fraction, lapse rate and bias."""

    def __init__(self) -> None:
        sigmas = np.log1p(WEBER_FRACTIONS) / ndtri(CRITERION)
        steps = np.log1p(INCREMENTS)[:, None] / sigmas
        # The axes are increment, Weber fraction, and all pairs of bias and lapse rate.
        self._correct: dict[int, Floats] = {}
        for stiffer, sign in ((1, -1.0), (2, 1.0)):
            seen = ndtr(steps[:, :, None] + sign * BIASES)[..., None]
            correct = 0.5 * LAPSE_RATES + (1.0 - LAPSE_RATES) * seen
            self._correct[stiffer] = correct.reshape(*steps.shape, -1)
        prior = np.exp(-0.5 * (BIASES[:, None] / BIAS_SCALE) ** 2 - LAPSE_RATES / LAPSE_SCALE)
        prior *= np.gradient(LAPSE_RATES)
        self._posterior: Floats = np.tile(prior.ravel(), (len(sigmas), 1))
        self._posterior /= self._posterior.sum()

    def add(self, increment: int, stiffer: int, correct: bool) -> None:
        """Update the posterior with the answer of one trial.

        increment: index in INCREMENTS.
        stiffer: number (1 or 2) of the stiffer object, in the order of presentation.
        correct: whether the participant named this object.
        """
        likely = self._correct[stiffer][increment]
        self._posterior = self._posterior * (likely if correct else 1.0 - likely)
        self._posterior /= self._posterior.sum()

    def choose(self, stiffer: int) -> int:
        """Return the index of the increment that is most informative about the Weber fraction.

        With this increment, the posterior after the answer has the least expected entropy.

        stiffer: number (1 or 2) of the stiffer object, in the order of presentation.
        """
        right = np.einsum("swn,wn->sw", self._correct[stiffer], self._posterior)
        expected = _expected_entropy(right) + _expected_entropy(self._marginal - right)
        return int(np.argmin(expected))

    @property
    def weber_fraction(self) -> float:
        """Return the geometric mean of the posterior of the Weber fraction."""
        return float(np.exp(self._marginal @ np.log(WEBER_FRACTIONS)))

    @property
    def interval(self) -> tuple[float, float]:
        """Return the central 95 % credible interval of the Weber fraction."""
        cumulative = np.cumsum(self._marginal) - 0.5 * self._marginal
        low, high = np.interp(INTERVAL_QUANTILES, cumulative, np.log(WEBER_FRACTIONS))
        return math.exp(low), math.exp(high)

    @property
    def lapse_rate(self) -> float:
        """Return the mean of the posterior of the lapse rate."""
        rates = np.tile(LAPSE_RATES, len(BIASES))
        return float(self._posterior.sum(axis=0) @ rates)

    @property
    def _marginal(self) -> Floats:
        return np.asarray(self._posterior.sum(axis=1))


def _expected_entropy(joint: Floats) -> Floats:
    """Return the entropy of each normalized row of a matrix, multiplied by the sum of the row."""
    total = joint.sum(axis=1, keepdims=True)
    inner = np.log(np.maximum(joint, 1e-300)) - np.log(np.maximum(total, 1e-300))
    return np.asarray(-(joint * inner).sum(axis=1))


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """The settings of a session. An interrupted session must continue with the same settings.

    participant: random code that identifies the participant, not a name.
    scene: name and hash of the scene's geometry.
    reference_pa: Young's modulus of the reference object.
    """

    participant: str
    seed: int
    trials: int
    reference_pa: float
    scene: str = ""


@dataclass(frozen=True, slots=True)
class PairTrial:
    """A trial in which two objects of different stiffness are presented in succession.

    number: number of the trial, from 1.
    increment: index in INCREMENTS.
    stiffer: number (1 or 2) of the stiffer object, in the order of presentation.
    moduli_pa: Young's moduli of both objects, in the order of presentation.
    catch: whether this is a catch trial, which checks the participant's attention.
    """

    number: int
    increment: int
    stiffer: int
    moduli_pa: tuple[float, float]
    catch: bool


@dataclass(frozen=True, slots=True)
class PairAnswer:
    """The answer of the participant in a trial, with measurements of both pushes.

    stiffer: number (1 or 2) of the object that the participant named.
    response_s: time from the end of the second push to the answer.
    depths_m, forces_n: maximum push depth and maximum measured force for each object; None if there
        is no measurement.
    """

    stiffer: int
    response_s: float | None = None
    depths_m: tuple[float | None, float | None] = (None, None)
    forces_n: tuple[float | None, float | None] = (None, None)


@dataclass(frozen=True, slots=True)
class TrialRow:
    """A line of the CSV file that contains one trial; unmeasured quantities are empty."""

    participant: str
    seed: int
    scene: str
    reference_pa: float
    trial: int
    catch: int
    increment: float
    stiffer: int
    answer: int
    correct: int
    response_s: float | None
    depth_1_mm: float | None
    depth_2_mm: float | None
    force_1_n: float | None
    force_2_n: float | None
    time_utc: str


COLUMNS = tuple(field.name for field in fields(TrialRow))

Present = Callable[[PairTrial], Awaitable[PairAnswer]]


class StaircaseSession:
    """The trials of one participant, stored in a CSV file.

    Raises ExperimentError if an existing file belongs to another session or is damaged.
    """

    def __init__(self, plan: SessionPlan, file: Path, *, now: Callable[[], str]) -> None:
        """Start a new session. If `file` exists, continue the session that the file contains.

        now: function that returns the current date and time as text.
        """
        self.plan, self.file, self._now = plan, file, now
        self.estimator = StaircaseEstimator()
        self.done = self.catches = self.missed_catches = 0
        self._resume()

    def next_trial(self) -> PairTrial | None:
        """Return the next trial of the session, or None after the last trial."""
        if self.done >= self.plan.trials:
            return None
        number = self.done + 1
        catch = number % CATCH_PERIOD == CATCH_PERIOD // 2
        stiffer = int(np.random.default_rng((self.plan.seed, number)).integers(1, 3))
        increment = len(INCREMENTS) - 1 if catch else self.estimator.choose(stiffer)
        reference_pa = self.plan.reference_pa
        comparison_pa = reference_pa * (1.0 + float(INCREMENTS[increment]))
        moduli = (comparison_pa, reference_pa) if stiffer == 1 else (reference_pa, comparison_pa)
        return PairTrial(number, increment, stiffer, moduli, catch)

    def record(self, trial: PairTrial, answer: PairAnswer) -> None:
        """Append a trial and its answer to the file on disk, and update the estimate."""
        correct = answer.stiffer == trial.stiffer
        row = TrialRow(
            participant=self.plan.participant,
            seed=self.plan.seed,
            scene=self.plan.scene,
            reference_pa=self.plan.reference_pa,
            trial=trial.number,
            catch=int(trial.catch),
            increment=round(float(INCREMENTS[trial.increment]), 6),
            stiffer=trial.stiffer,
            answer=answer.stiffer,
            correct=int(correct),
            response_s=_rounded(answer.response_s),
            depth_1_mm=_rounded(answer.depths_m[0], 1e3),
            depth_2_mm=_rounded(answer.depths_m[1], 1e3),
            force_1_n=_rounded(answer.forces_n[0]),
            force_2_n=_rounded(answer.forces_n[1]),
            time_utc=self._now(),
        )
        text = _csv_line(["" if one is None else one for one in asdict(row).values()])
        try:
            with self.file.open("ab") as file:
                if file.tell() == 0:
                    text = _csv_line(COLUMNS) + text
                file.write(text.encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise make_write_error(self.file, error, needed_bytes=len(text)) from error
        self._count(trial, correct)

    def _count(self, trial: PairTrial, correct: bool) -> None:
        self.estimator.add(trial.increment, trial.stiffer, correct)
        self.done += 1
        self.catches += trial.catch
        self.missed_catches += trial.catch and not correct

    def _resume(self) -> None:
        """Replay the trials of an existing file, and remove the last line if it is incomplete."""
        if not self.file.exists():
            return
        data = self.file.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            with self.file.open("r+b") as file:
                file.truncate(len(whole))
        try:
            lines = list(csv.reader(io.StringIO(whole.decode())))
        except (UnicodeDecodeError, csv.Error) as error:
            raise ExperimentError(
                f"{self.file}: is not a CSV file of a session: {error}; give another folder"
            ) from None
        if lines and tuple(lines[0]) != COLUMNS:
            raise ExperimentError(
                f"{self.file}:1: the file has other columns than a session; give another folder"
            )
        for number, cells in enumerate(lines[1:], start=2):
            self._replay(f"{self.file}:{number}", dict(zip(COLUMNS, cells, strict=False)))

    def _replay(self, where: str, cells: dict[str, str]) -> None:
        trial = self.next_trial()
        if trial is None:
            raise ExperimentError(
                f"{where}: the file has more than {self.plan.trials} trials; increase --trials"
            )
        expected = {
            "participant": self.plan.participant,
            "seed": str(self.plan.seed),
            "scene": self.plan.scene,
            "reference_pa": str(self.plan.reference_pa),
            "trial": str(trial.number),
            "increment": str(round(float(INCREMENTS[trial.increment]), 6)),
            "stiffer": str(trial.stiffer),
        }
        for name, value in expected.items():
            if cells.get(name) != value:
                raise ExperimentError(
                    f'{where}: {name} is "{cells.get(name, "")}", but this session has "{value}"; '
                    "continue with the options of the interrupted session, or give another folder"
                )
        if cells.get("answer") not in ("1", "2"):
            raise ExperimentError(
                f'{where}: answer is "{cells.get("answer", "")}", expected 1 or 2; remove this '
                "line and the following ones"
            )
        self._count(trial, int(cells["answer"]) == trial.stiffer)

    def result(self) -> dict[str, Any]:
        """Return the estimated Weber fraction and lapse rate as a row for `jnd --json`."""
        low, high = self.estimator.interval
        return {
            "participant": self.plan.participant,
            "seed": self.plan.seed,
            "trials": self.done,
            "weber_fraction": self.estimator.weber_fraction,
            "interval_95": [low, high],
            "lapse_rate": self.estimator.lapse_rate,
            "missed_catches": [self.missed_catches, self.catches],
            "csv": str(self.file),
        }


def _rounded(value: float | None, scale: float = 1.0) -> float | None:
    return None if value is None else round(scale * value, 4)


def _csv_line(cells: Sequence[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


async def run_session(session: StaircaseSession, present: Present) -> None:
    """Present the remaining trials of a session, and store each answer immediately.

    present: coroutine function that presents a trial and returns the answer.
    """
    while (trial := session.next_trial()) is not None:
        session.record(trial, await present(trial))
