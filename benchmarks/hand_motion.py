"""Generate synthetic hand motion for the evaluation of predictors.

No code is shared with a predictor or with the simulated finger.  Tremor is noise in narrow
bands around one to three peaks whose frequencies and amplitudes wander.
Voluntary motion is low-pass noise, or minimum-jerk strokes with corrective submovements (Flash and
Hogan 1985; Meyer et al. 1988).  Lengths are in mm, times in s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

GRID_HZ = 1500.0
"""The sampling rate of the true motion, Hz.

Its period divides 44 and 100 ms and the periods of cameras of 15, 30 and 60 Hz.
"""

WANDER_MM = 0.5
"""The standard deviation per axis of low-pass voluntary motion, in millimetres."""

MODULATION = 0.4
"""The standard deviation of the relative change of a tremor's amplitude (Marsden et al. 1969)."""

FREQUENCY_WANDER_HZ = 0.4
"""The standard deviation of the slow change of a peak's frequency, in hertz."""

SLOW_HZ = 0.15
"""The bandwidth of the slow changes of amplitude and frequency, in hertz."""

STROKE_BOX_MM = np.array([15.0, 15.0, 3.0])
"""Half the size of the box that contains the targets of strokes, in millimetres."""


def low_pass_noise(random: np.random.Generator, count: int, cutoff_hz: float) -> Complexes:
    """Return complex noise (count,) of unit variance per part, by a Butterworth filter of order 2.

    The values are samples at GRID_HZ of a periodic signal.
    """
    frequencies = np.fft.fftfreq(count, 1.0 / GRID_HZ)
    return _shaped(random, np.asarray((1.0 + (frequencies / cutoff_hz) ** 4) ** -0.5, float))


def _shaped(random: np.random.Generator, amplitudes: Floats) -> Complexes:
    """Return noise with spectral amplitudes (count,), scaled to unit variance per part."""
    count = len(amplitudes)
    white = random.standard_normal(count) + 1j * random.standard_normal(count)
    return np.asarray(np.fft.ifft(white * amplitudes) * count / np.sqrt(np.sum(amplitudes**2)))


@dataclass(frozen=True, slots=True)
class TremorPeak:
    """One peak of a tremor: frequency, half-power width, power, and gains (3,) by axis."""

    frequency_hz: float
    width_hz: float
    power: float
    gains: Complexes


def draw_tremor(band_hz: tuple[float, float], seed: int) -> tuple[TremorPeak, ...]:
    """Draw a hand's tremor: one to three peaks in the band, of unit power together."""
    random = np.random.default_rng([seed, round(10 * band_hz[0]), round(10 * band_hz[1])])
    count = int(random.choice([1, 2, 3], p=[0.5, 0.3, 0.2]))
    powers = random.dirichlet(np.full(count, 2.0))
    peaks = []
    for power in powers:
        gains = random.standard_normal(3) + 1j * random.standard_normal(3)
        gains *= np.sqrt(3.0) / np.linalg.norm(gains)
        peaks.append(
            TremorPeak(random.uniform(*band_hz), random.uniform(0.8, 3.0), float(power), gains)
        )
    return tuple(peaks)


def sample_tremor(
    peaks: tuple[TremorPeak, ...], duration_s: float, random: np.random.Generator
) -> Floats:
    """Sample a tremor (n, 3) of unit mean square per axis at GRID_HZ."""
    count = round(duration_s * GRID_HZ)
    result = np.zeros((count, 3))
    for peak in peaks:
        envelope = low_pass_noise(random, count, 0.5 * peak.width_hz)
        slow = low_pass_noise(random, count, SLOW_HZ)
        frequency_hz = peak.frequency_hz + FREQUENCY_WANDER_HZ * slow.real
        phase = 2.0 * np.pi * np.cumsum(frequency_hz) / GRID_HZ
        modulation = (1.0 + MODULATION * slow.imag) / np.sqrt(1.0 + MODULATION**2)
        swing = np.sqrt(peak.power) * modulation * envelope * np.exp(1j * phase)
        result += (swing[:, None] * peak.gains).real
    return result


def sample_wander(bandwidth_hz: float, duration_s: float, random: np.random.Generator) -> Floats:
    """Sample low-pass noise (n, 3) mm at GRID_HZ with 90 % of its power within the bandwidth.

    The spectrum is that of white noise after two critically damped filters of second order, which
    model muscles.
    """
    count = round(duration_s * GRID_HZ)
    corner_hz = bandwidth_hz / 0.72
    frequencies = np.fft.fftfreq(count, 1.0 / GRID_HZ)
    amplitudes = np.asarray((1.0 + (frequencies / corner_hz) ** 2) ** -2.0, float)
    return WANDER_MM * np.stack([_shaped(random, amplitudes).real for _ in range(3)], axis=1)


def sample_strokes(duration_s: float, random: np.random.Generator) -> Floats:
    """Sample minimum-jerk strokes (n, 3) mm at GRID_HZ between random targets in a box.

    A stroke peaks at 20 to 90 mm/s.  It ends short of or beyond its target, and a submovement
    corrects it; some strokes are followed by a rest.
    """
    count = round(duration_s * GRID_HZ)
    speed = np.zeros((count, 3))
    here, start_s = np.zeros(3), 0.0
    while start_s < duration_s:
        target = random.uniform(-1.0, 1.0, 3) * STROKE_BOX_MM
        displacement = target - here
        peak_mm_per_s = random.uniform(20.0, 90.0)
        stroke_s = float(np.clip(1.875 * np.linalg.norm(displacement) / peak_mm_per_s, 0.3, 1.5))
        reached = random.uniform(0.85, 1.05)
        correction_s = random.uniform(0.2, 0.4)
        correction_start_s = start_s + random.uniform(0.65, 0.95) * stroke_s
        _add_stroke(speed, start_s, stroke_s, reached * displacement)
        _add_stroke(speed, correction_start_s, correction_s, (1.0 - reached) * displacement)
        here = target
        rest_s = random.uniform(0.05, 0.4) if random.random() < 0.5 else 0.0
        start_s = max(start_s + stroke_s, correction_start_s + correction_s) + rest_s
    return np.cumsum(speed, axis=0) / GRID_HZ


def _add_stroke(speed: Floats, start_s: float, duration_s: float, displacement: Floats) -> None:
    """Add a minimum-jerk stroke's velocity in mm/s to samples (n, 3)."""
    first = round(start_s * GRID_HZ)
    s = np.arange(round(duration_s * GRID_HZ)) / (duration_s * GRID_HZ)
    bell = 30.0 * s * s * (1.0 - s) ** 2 / duration_s
    inside = speed[first : first + len(s)]
    inside += bell[: len(inside), None] * displacement
