"""List the tolerances of real hardware, and generate random apparatuses from them.

An apparatus contains the true parameters of the simulated hardware, as deviations from the
parameters in the scene. The nodes assume the parameters in the scene. The option `--apparatus
seed:N` generates a random apparatus from this table. Each row has its own stream of random numbers,
so a new row changes no other value. Seeds 0 to 99 are for development. No method may be tuned on
other seeds. A calibrated apparatus describes a laboratory that has calibrated its devices. Its
deviations are the residual errors of the calibrations.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

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


@dataclass(frozen=True, slots=True)
class Tolerance:
    """A row of the tolerance table: the distribution of one parameter of the simulated hardware.

    key: dotted path of the parameter; "*" stands for both arms or both lenses.
    unit, scale: unit in tables, and the factor from SI units to this unit.
    modern: distribution for modern equipment. It applies to every component of a vector, unless it
        is a tuple with one distribution per component.
    source, calibrated_source: literature or data sheet from which the numbers are taken.
    paper: distribution for the equipment of Furukawa et al. 2007; None if it equals `modern`.
    calibrated: distribution after calibration; None if no calibration affects the parameter.
    pair: None if the values of both arms are independent. Otherwise the arms share a value, to
        which each arm adds a value with this distribution.
    frame_periods: kinds of equipment for which the unit of the distribution is the camera's frame
        period instead of seconds.
    """

    key: str
    unit: str
    scale: float
    modern: Distribution | tuple[Distribution, ...]
    source: str
    paper: Distribution | tuple[Distribution, ...] | None = None
    calibrated: Distribution | tuple[Distribution, ...] | None = None
    calibrated_source: str = ""
    pair: Distribution | None = None
    frame_periods: tuple[Profile, ...] = ()

    def of(self, profile: Profile, *, calibrated: bool) -> Distribution | tuple[Distribution, ...]:
        if calibrated and self.calibrated is not None:
            return self.calibrated
        return self.paper if profile is Profile.PAPER and self.paper is not None else self.modern


J = "judgement"
MM, UM, MRAD, MS, PERCENT = 1e3, 1e6, 1e3, 1e3, 1e2

_ROWS = (
    Tolerance("camera.position_offset_m", "mm", MM, Normal(0.0, 0.3e-3),
              "hand-eye calibrations: sub-millimetre (support.zivid.com)",
              calibrated=Normal(0.0, 0.04e-3),
              calibrated_source="docs/camera.md: 0.042 mm in depth at 504 mm"),
    Tolerance("camera.rotation_offset_rad", "mrad", MRAD, Normal(0.0, 1e-3),
              "hand-eye calibrations: sub-degree (support.zivid.com)",
              calibrated=Normal(0.0, 0.13e-3),
              calibrated_source="docs/camera.md: 0.064 mm across at 504 mm"),
    Tolerance("camera.*.focal_ratio", "", 1.0, Normal(1.0, 1e-3),
              f"{J}: refocused or warm lens", calibrated=Normal(1.0, 8e-5),
              calibrated_source="docs/camera.md: 0.042 mm of 504 mm"),
    Tolerance("camera.*.centre_offset_px", "px", 1.0, Normal(0.0, 0.5),
              f"{J}: warm sensor", calibrated=Normal(0.0, 0.024),
              calibrated_source="docs/camera.md: residual 0.024 px"),
    Tolerance("camera.*.radial_offset", "", 1.0, Normal(0.0, 2e-3),
              f"{J}: refocused lens", calibrated=Normal(0.0, 2e-4),
              calibrated_source="docs/camera.md: 0.024 px at 0.6 of slope"),
    Tolerance("camera.right_position_offset_m", "mm", MM, Normal(0.0, 0.02e-3),
              f"{J}: thermal drift of the baseline", calibrated=Normal(0.0, 0.01e-3),
              calibrated_source="docs/camera.md: 0.042 mm of 504 mm, of 120 mm baseline"),
    Tolerance("camera.right_rotation_offset_rad", "mrad", MRAD, Normal(0.0, 0.2e-3),
              "drift 0.2 mrad, from memory", calibrated=Normal(0.0, 0.045e-3),
              calibrated_source="docs/camera.md: residual 0.024 px of 540"),
    Tolerance("camera.rate_hz", "Hz", 1.0, OneOf((60.0,)), "USB3 cameras: 60 to 120 Hz",
              paper=OneOf((15.0, 30.0, 48.0))),
    Tolerance("camera.read_out_s", "ms (paper: frames)", MS, Uniform(1.5e-3, 4e-3),
              "computed: 614,400 bytes over USB3, or over 1394a at 0.9 frame",
              paper=OneOf((0.9,)), frame_periods=(Profile.PAPER,)),
    Tolerance("camera.skew_s", "ms", MS, Normal(0.0, 0.02e-3),
              "one stream for both sensors (ptgrey.com KB 312); trigger cable"),
    Tolerance("camera.exposure_jitter_s", "ms", MS, Uniform(0.05e-3, 0.2e-3), J),
    Tolerance("camera.stamp_offset_s", "ms", MS, Uniform(-5e-3, 5e-3),
              f"{J}: half an exposure of 2 to 10 ms", calibrated=Normal(0.0, 0.6e-3),
              calibrated_source="launch/experiments/lag.py: standard error in 10 s"),
    Tolerance("arms.*.base_position_offset_m", "mm", MM, Normal(0.0, 0.4e-3),
              f"{J}: measured with a reference tool", calibrated=Normal(0.0, 0.09e-3),
              calibrated_source="docs/arms.md: 0.10 to 0.15 mm at the screen, three axes"),
    Tolerance("arms.*.base_rotation_offset_rad", "mrad", MRAD, Normal(0.0, 2e-3),
              f"{J}: measured with a reference tool", calibrated=Normal(0.0, 0.2e-3),
              calibrated_source="docs/arms.md: 0.020° at the screen, three axes"),
    Tolerance("arms.*.edge_position_offset_m", "mm", MM, Normal(0.0, 0.3e-3), f"{J}: clamp",
              calibrated=Normal(0.0, 0.1e-3), calibrated_source=f"{J}: clamp with dowels"),
    Tolerance("arms.*.edge_rotation_offset_rad", "mrad", MRAD, Normal(0.0, 2e-3), f"{J}: clamp",
              calibrated=Normal(0.0, 1e-3), calibrated_source=f"{J}: clamp with dowels"),
    Tolerance("arms.*.joint_offsets_rad", "mrad", MRAD, Normal(0.0, 0.3e-3),
              f"{J}; uncalibrated arms: 0.65 mm, 2.8 mrad (Slamani 2012)"),
    Tolerance("arms.*.flange_compliance_m_per_n", "µm/N", UM, LogUniform(25e-6, 125e-6),
              "computed: three joints of 3 to 10 kN m/rad at 0.4 m"),
    Tolerance("arms.*.servo_lag_s", "ms", MS, Uniform(20e-3, 60e-3),
              "KR16: response 50 ms, tracking 120 ms (Arbo)", paper=Uniform(30e-3, 80e-3),
              calibrated=Normal(25e-3, 2e-3), pair=Uniform(-2.5e-3, 2.5e-3),
              calibrated_source="launch/experiments/lag.py: standard error 1.9 ms"),
    Tolerance("arms.*.command_latency_s", "ms", MS, Uniform(0.0, 10e-3),
              "KR16: response 50 ms, tracking 120 ms (Arbo)", paper=Uniform(0.0, 40e-3),
              calibrated=HalfNormal(1e-3), pair=Uniform(0.0, 0.5e-3),
              calibrated_source="launch/experiments/lag.py: standard error 0.6 to 1.9 ms"),
    Tolerance("arms.*.controller_period_s", "ms", MS, OneOf((1e-3, 2e-3, 4e-3)),
              "RV-1A: 7.1 ms (docs/mxt.md); newer controllers: 1 to 4 ms",
              paper=OneOf((7.1e-3,))),
    Tolerance("arms.*.controller_jitter_s", "ms", MS, Uniform(0.02e-3, 0.1e-3), J,
              paper=Uniform(0.1e-3, 0.3e-3)),
    Tolerance("arms.*.backlash_rad", "mrad", MRAD, Uniform(0.1e-3, 0.6e-3), "from memory"),
    Tolerance("sheet.modulus_ratio", "", 1.0, LogNormal(1.0, 0.10),
              "hardness ±5 (escoplastics.com) × 3.8 % a point",
              calibrated=LogNormal(1.0, 0.015),
              calibrated_source="docs/sheet.md: 985 N/m of 1000"),
    Tolerance("sheet.thickness_ratio", "", 1.0, Normal(1.0, 0.06), "ISO 3302-1 M1",
              calibrated=Normal(1.0, 0.005), calibrated_source=f"{J}: thickness gauge"),
    Tolerance("sheet.thickness_gradient_ratio", "%", PERCENT, Normal(0.0, 0.03), "ISO 3302-1 M1"),
    Tolerance("sheet.slack_width_offset_m", "mm", MM, Normal(0.0, 0.5e-3), f"{J}: ruler",
              calibrated=Normal(0.0, 0.1e-3),
              calibrated_source="docs/sheet.md: 239.9 ± 0.1 mm of 240"),
    Tolerance("sheet.clamp_slip_m", "mm", MM, HalfNormal(0.5e-3), J,
              calibrated=HalfNormal(0.1e-3), calibrated_source=f"{J}: slip since calibration"),
    Tolerance("sheet.density_kg_per_m3", "kg/m³", 1.0, Uniform(1100.0, 1250.0), "from memory"),
    Tolerance("sheet.friction_coefficient", "", 1.0, LogNormal(1.24, 0.3), "Seo 2009, at 1 N"),
    Tolerance("sheet.hysteresis_ratio", "%", PERCENT, Uniform(0.05, 0.20), "from memory"),
    Tolerance("sheet.creep_ratio_per_decade", "%", PERCENT, Uniform(0.02, 0.08), "from memory"),
    Tolerance("finger.radius_offset_m", "mm", MM, Normal(1.5e-3, 1e-3, -1e-3, 4e-3),
              "breadth 16 to 18 mm, from memory; the scenes assume a radius of 7 mm",
              calibrated=Normal(0.0, 0.3e-3), calibrated_source=f"{J}: calliper"),
    Tolerance("finger.marker_from_pad_m", "mm", MM,
              (Uniform(-2e-3, 2e-3), Uniform(-2e-3, 2e-3), Normal(10e-3, 1.5e-3)),
              "nail to pad 12 mm less 1 to 2 mm of pad yield, from memory",
              calibrated=Normal(0.0, 0.3e-3),
              calibrated_source="[set-up-marker.md](set-up-marker.md): target 0.5 mm"),
    Tolerance("finger.marker_shape", "", 1.0, OneOf(("disc",)), "a sticker on the nail"),
    Tolerance("finger.marker_tilt_rad", "°", math.degrees(1.0), Normal(0.0, math.radians(10.0)),
              J),
    Tolerance("finger.finger_tilt_rad", "°", math.degrees(1.0),
              Uniform(-math.radians(20.0), math.radians(20.0)), J),
    Tolerance("finger.tremor_frequency_hz", "Hz", 1.0, Uniform(5.0, 12.0),
              "11.3 − 0.042 × age (n = 340), 5 to 9 with a free wrist"),
    Tolerance("finger.tremor_width_hz", "Hz", 1.0, Uniform(0.8, 3.0), J),
    Tolerance("finger.tremor_rms_m", "µm", UM, LogNormal(60e-6, 0.5),
              "Growdon 2000: 30 µm supported, twice that with the hand free"),
    Tolerance("finger.voluntary_bandwidth_hz", "Hz", 1.0, Uniform(1.0, 3.0),
              "visual tracking 1 to 2 Hz, submovements to 3 Hz, from memory"),
    Tolerance("finger.hand_mass_kg", "kg", 1.0, LogUniform(0.005, 1.5),
              "finger 4 to 6 g: Hajian and Howe 1997; wrist: resonance of 6 to 12 Hz, Lakie 2015; "
              "arm 0.5 to 1.5 kg: Mussa-Ivaldi 1985"),
    Tolerance("finger.hand_damping_ratio", "", 1.0, Uniform(0.15, 1.2),
              "wrist and arm 0.15 to 0.4, from memory; digits of most young adults above 1: "
              "10.1016/j.clinbiomech.2013.11.022"),
    Tolerance("finger.hand_stiffness_n_per_m", "N/m", 1.0, LogUniform(50.0, 800.0),
              "finger 200 to 800: Hajian and Howe 1997; arm 100 to 800: Mussa-Ivaldi 1985; "
              f"relaxed finger 50 to 200: {J}"),
    Tolerance("eyes.centre_offset_m", "mm", MM,
              (Normal(0.0, 10e-3), Normal(0.0, 10e-3), Normal(0.0, 15e-3)), J,
              calibrated=Normal(0.0, 5e-3), calibrated_source=f"{J}: head tracker"),
    Tolerance("eyes.interocular_offset_m", "mm", MM, Normal(-1e-3, 3.8e-3),
              "Dodgson 2004: 63 mm; the scenes assume 64 mm",
              calibrated=Normal(0.0, 1e-3), calibrated_source=f"{J}: ruler"),
    Tolerance("eyes.sway_m", "mm", MM, Uniform(2e-3, 6e-3), "quiet sitting: 1.0 to 1.4° SD",
              calibrated=Uniform(0.5e-3, 1.5e-3), calibrated_source=f"{J}: chin rest"),
    Tolerance("eyes.sway_frequency_hz", "Hz", 1.0, Uniform(0.2, 0.5), J),
    Tolerance("projector.position_offset_m", "mm", MM, Normal(0.0, 4e-3),
              "docs/renderer.md: tape measure", calibrated=Normal(0.0, 0.02e-3),
              calibrated_source="docs/renderer.md: 0.03 mm at the eye"),
    Tolerance("projector.rotation_offset_rad", "mrad", MRAD, Normal(0.0, 6e-3),
              "docs/renderer.md: tape measure", calibrated=Normal(0.0, 0.02e-3),
              calibrated_source="docs/renderer.md: 0.03 mm at the eye"),
    Tolerance("projector.lens.focal_ratio", "", 1.0, Normal(1.0, 0.01),
              "docs/renderer.md: data sheet", calibrated=Normal(1.0, 5e-5),
              calibrated_source="docs/renderer.md: 0.03 mm at the eye"),
    Tolerance("projector.lens.centre_offset_px", "px", 1.0, Normal(0.0, 6.0),
              "docs/renderer.md: data sheet", calibrated=Normal(0.0, 0.05),
              calibrated_source="docs/renderer.md: 0.03 mm at the eye"),
    Tolerance("projector.lens.radial_offset", "", 1.0,
              (Normal(0.0, 0.04), Normal(0.0, 0.02)), "docs/renderer.md: data sheet",
              calibrated=Normal(0.0, 2e-4),
              calibrated_source="docs/renderer.md: residual 0.25 px"),
    Tolerance("projector.latency_offset_s", "ms", MS, Uniform(0.0, 27e-3),
              "8 to 35 ms; DLP 21 ms (cathoderayblog.com); the renderer assumes 8 ms",
              calibrated=Normal(0.0, 1e-3), calibrated_source=f"{J}: photodiode"),
)  # fmt: skip

TOLERANCES: dict[str, Tolerance] = {row.key: row for row in _ROWS}

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
    for row in TOLERANCES.values():
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
    row = TOLERANCES[key]
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
    rows = {path: row for row in TOLERANCES.values() for path in expand_key(row.key)}
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
