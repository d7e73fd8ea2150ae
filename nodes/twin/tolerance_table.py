"""List the tolerances of real hardware, and generate random apparatuses from them.

An apparatus contains the true parameters of the simulated hardware, as deviations from the
parameters in the scene. The nodes assume the parameters in the scene. The option `--apparatus
seed:N` generates a random apparatus from the table in `tolerances.yaml`. Each row has its own
stream of random numbers, so a new row changes no other value. Seeds 0 to 99 are for development. No
method may be tuned on other seeds. A calibrated apparatus describes a laboratory that has
calibrated its devices. Its deviations are the residual errors of the calibrations.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict
from ruamel.yaml import YAML

from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.scene import Scene

MAX_DEVIATION_SIGMAS = 3.0
"""The maximum deviation of a random sample, in standard deviations. A real laboratory would notice
and correct a larger deviation."""


class Profile(StrEnum):
    """The two kinds of laboratory equipment for which the tolerance table contains data.

    MODERN: a 60 Hz camera with a short read-out, and robot controllers with a short period.
    PAPER: equipment as in Furukawa et al. 2007. The camera rate is 15 to 48 Hz, and its read-out
        takes most of a frame period. The controller period is 7.1 ms.
    """

    MODERN = "modern"
    PAPER = "paper"


@runtime_checkable
class Distribution(Protocol):
    """The interface of a probability distribution of one quantity."""

    def draw(self, random: np.random.Generator) -> Any:
        """Return a random value of the quantity."""
        ...

    def at(self, sigmas: float) -> Any:
        """Return the quantile at `sigmas` standard deviations of a normal distribution.

        Example: 0 gives the median, and 1 gives the quantile of 84 %.
        """
        ...


@dataclass(frozen=True, slots=True)
class Normal:
    """A normal distribution, clipped at MAX_DEVIATION_SIGMAS and at `low` and `high`."""

    mean: float
    sigma: float
    low: float = -math.inf
    high: float = math.inf

    def draw(self, random: np.random.Generator) -> float:
        return self.at(float(random.standard_normal()))

    def at(self, sigmas: float) -> float:
        return min(max(self.mean + self.sigma * _limit(sigmas), self.low), self.high)


@dataclass(frozen=True, slots=True)
class LogNormal:
    """A log-normal distribution, clipped at MAX_DEVIATION_SIGMAS."""

    median: float
    sigma_ln: float

    def draw(self, random: np.random.Generator) -> float:
        return self.at(float(random.standard_normal()))

    def at(self, sigmas: float) -> float:
        return self.median * math.exp(self.sigma_ln * _limit(sigmas))


@dataclass(frozen=True, slots=True)
class HalfNormal:
    """The distribution of a normal variable's absolute value, clipped at MAX_DEVIATION_SIGMAS."""

    sigma: float

    def draw(self, random: np.random.Generator) -> float:
        return self.at(abs(float(random.standard_normal())))

    def at(self, sigmas: float) -> float:
        return self.sigma * max(_limit(sigmas), 0.0)


@dataclass(frozen=True, slots=True)
class Uniform:
    """A uniform distribution from `low` to `high`."""

    low: float
    high: float

    def draw(self, random: np.random.Generator) -> float:
        return self.low + (self.high - self.low) * float(random.random())

    def at(self, sigmas: float) -> float:
        return self.low + (self.high - self.low) * _normal_cdf(sigmas)


@dataclass(frozen=True, slots=True)
class LogUniform:
    """A log-uniform distribution from `low` to `high`."""

    low: float
    high: float

    def draw(self, random: np.random.Generator) -> float:
        return float(self.low * (self.high / self.low) ** float(random.random()))

    def at(self, sigmas: float) -> float:
        return float(self.low * (self.high / self.low) ** _normal_cdf(sigmas))


@dataclass(frozen=True, slots=True)
class OneOf:
    """A discrete distribution over values in ascending order, with equal probabilities."""

    values: tuple[float | str, ...]

    def draw(self, random: np.random.Generator) -> float | str:
        return self.values[int(random.integers(len(self.values)))]

    def at(self, sigmas: float) -> float | str:
        return self.values[min(int(_normal_cdf(sigmas) * len(self.values)), len(self.values) - 1)]


def _limit(sigmas: float) -> float:
    return min(max(sigmas, -MAX_DEVIATION_SIGMAS), MAX_DEVIATION_SIGMAS)


def _normal_cdf(sigmas: float) -> float:
    return 0.5 * (1.0 + math.erf(sigmas / math.sqrt(2.0)))


KINDS: dict[str, Callable[..., Distribution]] = {
    "normal": Normal,
    "log_normal": LogNormal,
    "half_normal": HalfNormal,
    "uniform": Uniform,
    "log_uniform": LogUniform,
    "one_of": lambda *values: OneOf(values),
}
"""The distributions by their names in the table."""


def _make_distribution(given: Any) -> Any:
    """Make the distribution that one entry of the table describes, or a tuple from a list."""
    if isinstance(given, list):
        return tuple(map(_make_distribution, given))
    if not isinstance(given, dict):
        return given
    ((kind, numbers),) = given.items()
    return KINDS[kind](*numbers)


Drawn = Annotated[Distribution | tuple[Distribution, ...], BeforeValidator(_make_distribution)]


class Tolerance(BaseModel):
    """A row of the tolerance table: the distribution of one parameter of the simulated hardware.

    key: dotted path of the parameter; "*" stands for both arms or both lenses.
    source, calibrated_source: literature or data sheet from which the numbers are taken.

    The file `tolerances.yaml` describes the other fields. A distribution applies to every component
    of a vector, unless it is a tuple with one distribution per component.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    key: str
    unit: str
    modern: Drawn
    source: str
    paper: Drawn | None = None
    calibrated: Drawn | None = None
    calibrated_source: str = ""
    pair: Annotated[Distribution, BeforeValidator(_make_distribution)] | None = None
    frame_periods: tuple[Profile, ...] = ()

    @property
    def scale(self) -> float:
        """Return the factor from SI units to the unit of the table."""
        return SCALES.get(self.unit.partition(" ")[0], 1.0)

    def of(self, profile: Profile, *, calibrated: bool) -> Distribution | tuple[Distribution, ...]:
        if calibrated and self.calibrated is not None:
            return self.calibrated
        return self.paper if profile is Profile.PAPER and self.paper is not None else self.modern


SCALES = {
    "mm": 1e3,
    "µm": 1e6,
    "µm/N": 1e6,
    "mrad": 1e3,
    "°": math.degrees(1.0),
    "ms": 1e3,
    "%": 1e2,
}
"""The number of each unit in one SI unit; 1 for other units."""


@cache
def load_tolerances() -> dict[str, Tolerance]:
    """Return the rows of the tolerance table by their keys."""
    rows = YAML(typ="safe").load(Path(__file__).with_name("tolerances.yaml"))
    return {key: Tolerance(key=key, **row) for key, row in rows.items()}


_ONLY_COUPLED = "has an effect only with the finger simulator's parameter hand: coupled"

NOT_SIMULATED: dict[str, str] = {
    "finger.hand_mass_kg": _ONLY_COUPLED,
    "finger.hand_damping_ratio": _ONLY_COUPLED,
    "finger.hand_stiffness_n_per_m": _ONLY_COUPLED,
}
"""The keys of an apparatus (true hardware parameters) that have no effect in the launch files of
this package, with the reason for each key."""


def expand_key(key: str) -> tuple[str, ...]:
    """Return the dotted paths of a key. A key that contains "*" has one path for each side."""
    return tuple(key.replace("*", side) for side in ("left", "right")) if "*" in key else (key,)


def sample_apparatus(
    scene: Scene, seed: int, *, profile: Profile = Profile.MODERN, calibrated: bool = False
) -> Apparatus:
    """Generate random true parameters of the simulated hardware for a scene.

    profile: kind of laboratory equipment.
    calibrated: whether the laboratory has calibrated its devices.

    Equal arguments give equal results. All profiles use the same random numbers for one seed, with
    and without calibration. Therefore results for one seed can be compared.
    """
    values = nominal_apparatus(scene).model_dump(mode="json")
    for row in load_tolerances().values():
        _draw_row(values, row, seed, profile, calibrated=calibrated)
    suffix = ",calibrated" if calibrated else ""
    values["origin"] = f"seed:{seed},{profile}{suffix}"
    return Apparatus.model_validate(values)


def deviate_apparatus(
    scene: Scene,
    key: str,
    sigmas: float,
    *,
    profile: Profile = Profile.MODERN,
    calibrated: bool = False,
) -> Apparatus:
    """Make an apparatus (true hardware parameters) in which only one parameter deviates.

    key: row of the tolerance table; other keys raise KeyError.
    sigmas: size of the deviation, in standard deviations of a normal distribution. All components
        of a vector deviate equally. Both arms or lenses also deviate equally.
    """
    row = load_tolerances()[key]
    given = row.of(profile, calibrated=calibrated)
    values = nominal_apparatus(scene).model_dump(mode="json")
    values["origin"] = f"{key} at {sigmas:+g} sigma, {profile}"
    period_s = 1.0 / scene.camera.rate_hz if profile in row.frame_periods else 1.0
    for path in expand_key(key):
        like = value_at(values, path)
        count = len(like) if isinstance(like, list) else 1
        each = given if isinstance(given, tuple) else (given,) * count
        found = [one.at(sigmas) for one in each]
        set_value(values, path, found if isinstance(like, list) else _timed(found[0], period_s))
    return Apparatus.model_validate(values)


def _timed(value: Any, period_s: float) -> Any:
    return value if period_s == 1.0 else value * period_s


def _draw_row(
    values: dict[str, Any], row: Tolerance, seed: int, profile: Profile, *, calibrated: bool
) -> None:
    given = row.of(profile, calibrated=calibrated)
    common = None if row.pair is None else _draw(given, None, _stream(seed, row.key))
    period_s = 1.0
    if profile in row.frame_periods:
        period_s = 1.0 / float(value_at(values, "camera.rate_hz"))
    for path in expand_key(row.key):
        random = _stream(seed, path)
        if row.pair is not None:
            drawn = max(common + row.pair.draw(random), 0.0)
        else:
            drawn = _draw(given, value_at(values, path), random)
        set_value(values, path, _timed(drawn, period_s))


def _stream(seed: int, name: str) -> np.random.Generator:
    """Return a random generator for one parameter, which does not depend on other parameters."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))


def _draw(
    given: Distribution | tuple[Distribution, ...], like: Any, random: np.random.Generator
) -> Any:
    """Return a random value in the form of `like`: a number, or a list of independent samples."""
    if not isinstance(like, list):
        assert not isinstance(given, tuple)
        return given.draw(random)
    each = given if isinstance(given, tuple) else (given,) * len(like)
    return [one.draw(random) for one in each]


def value_at(values: dict[str, Any], path: str) -> Any:
    """Return the value at a dotted path of nested dictionaries."""
    for part in path.split("."):
        values = values[part]
    return values


def set_value(values: dict[str, Any], path: str, value: Any) -> None:
    """Set the value at a dotted path of nested dictionaries."""
    *outer, last = path.split(".")
    for part in outer:
        values = values[part]
    values[last] = value


def iterate_paths(values: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted paths of all values in nested dictionaries."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from iterate_paths(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


TRUTH_SECTIONS = ("camera", "arms", "sheet", "finger", "eyes", "projector")


def list_differences(apparatus: Apparatus) -> list[tuple[str, Any, Any, str]]:
    """List the true hardware parameters (the apparatus) that differ from the nominal values.

    An entry is (path, value, nominal value, unit), with values in the unit of the tolerance table.
    """
    mine = apparatus.model_dump(mode="json")
    nominal = Apparatus(scene=apparatus.scene).model_dump(mode="json")
    rows = {path: row for row in load_tolerances().values() for path in expand_key(row.key)}
    found = []
    for section in TRUTH_SECTIONS:
        for path in iterate_paths(mine[section], f"{section}."):
            value, usual = value_at(mine, path), value_at(nominal, path)
            if value != usual:
                unit = rows[path].unit.partition(" (")[0] if path in rows else ""
                scale = rows[path].scale if path in rows else 1.0
                found.append((path, _scaled(value, scale), _scaled(usual, scale), unit))
    return found


def _scaled(value: Any, scale: float) -> Any:
    if isinstance(value, list):
        return [_scaled(one, scale) for one in value]
    return value * scale if isinstance(value, float | int) else value
