"""Simulate a hand that the sheet's force moves, in time steps of a quarter of a millisecond.

The simulation is the reference for the stability bounds of the planner, and shares no code with
them. The finger is a mass on the spring and damper of the hand, with the finger pad in series. The
sheet pushes the finger with a nonlinear force and cannot pull. The camera samples the finger depth
with a finite resolution. After a delay, the sheet moves to the offset that is computed from the
sampled depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.arrays import Floats

Curve = Callable[[Floats], Floats]

STEPS_PER_PERIOD = 64
FILTER_DAMPING_RATIO = 0.5
PAD_STIFFNESS_N_PER_M, PAD_DAMPING_NS_PER_M = 1100.0, 1.0
"""The stiffness (N/m) and damping (N s/m) of the finger pad at a force of 1 N.

The stiffness is that of a Hertz contact with tissue of 0.07 to 0.2 MPa.
"""

JITTER_SEED = 0
CAMERA_RESOLUTION_M = 2e-5
RELEASE_M = 2e-3
"""The distance from the equilibrium at which the simulated finger is released, in metres."""

MAX_AMPLITUDE_M = 5e-5
"""The maximum amplitude (m) of a finger that is considered to be at rest."""

SLOWEST_DECAY_PER_S = 0.5
"""The minimum decay rate (1/s) of an oscillation that is considered stable."""

ENERGY_FRACTION = 0.05
"""The maximum energy that a stable sheet delivers in 2 s, relative to the energy at release."""


@dataclass(frozen=True, slots=True)
class Cases:
    """The n hands and control loops that are simulated together; each field has shape (n,).

    delay_s: time from exposure to the sheet's motion.
    jitter_s: maximum additional delay of a measurement, uniformly distributed. A measurement is
        lost if a newer measurement overtakes it.
    depth_m: finger depth at equilibrium.
    gain: factor by which the sheet's motion around the equilibrium is multiplied.
    bandwidth_rad_per_s: natural frequency of the filter of the measured depth; infinite if there is
        no filter.
    lead_s: time by which the filtered depth is extrapolated.
    """

    mass_kg: Floats
    damping_ns_per_m: Floats
    stiffness_n_per_m: Floats
    delay_s: Floats
    jitter_s: Floats
    depth_m: Floats
    gain: Floats
    bandwidth_rad_per_s: Floats
    lead_s: Floats

    def __len__(self) -> int:
        return len(self.mass_kg)


@dataclass(frozen=True, slots=True)
class Motion:
    """The result of a simulation of n hands, which are released near their equilibrium.

    decay_per_s (n,): decay rate of the oscillation between the second and the last quarter of the
        time; infinite if the oscillation has decayed completely.
    amplitude_m (n,): amplitude in the last quarter.
    energy_ratio (n,): maximum energy that the sheet delivers to the finger in any 2 s. It is
        divided by the elastic energy of the displacement from which the finger is released. The
        energy that a passive elastic sheet would deliver is subtracted. The first eighth of the
        time is ignored.
    """

    decay_per_s: Floats
    amplitude_m: Floats
    energy_ratio: Floats

    @property
    def decays(self) -> NDArray[np.bool_]:
        """Return a mask that is True for simulated cases in which no oscillation is sustained."""
        died_out = self.amplitude_m <= MAX_AMPLITUDE_M
        return np.asarray(died_out | (self.decay_per_s >= SLOWEST_DECAY_PER_S))

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Return a mask that is True for the stable simulated cases.

        A case is stable if its oscillation decays and the sheet delivers no energy.
        """
        return np.asarray(self.decays & (self.energy_ratio <= ENERGY_FRACTION))


class HeldOffset:
    """A simulated control loop that sets the sheet's offset along its normal from the finger depth.

    A filter and a delay are simulated. Until a new offset takes effect, the sheet continues to move
    at its last rate, as the real arms do.
    """

    def __init__(self, cases: Cases, offset: Curve, period_s: float, step_s: float) -> None:
        self._cases, self._offset, self._period_s, self._step_s = cases, offset, period_s, step_s
        # The filter is a difference equation with the poles `pole` and its complex conjugate.
        # Its numerator makes the result exact, except for the lead, for a constant rate.
        angle = period_s * np.minimum(cases.bandwidth_rad_per_s, 1e6)
        pole = np.exp(angle * np.exp(1j * (np.pi - np.arccos(FILTER_DAMPING_RATIO))))
        twice, square = 2.0 * pole.real, np.abs(pole) ** 2
        lead = cases.lead_s / period_s * (1.0 - twice + square)
        self._feedback = np.array([twice, -square])
        self._gains = np.array([1.0 - square + lead, 2.0 * square - twice - lead])
        # These are the last two measured and filtered depths; the newest is first.
        self._seen = np.tile(cases.depth_m, (2, 1))
        self._filtered = np.tile(cases.depth_m, (2, 1))
        self._rest_m = offset(cases.depth_m)
        self._random = np.random.default_rng(JITTER_SEED)
        self._delays = np.round(cases.delay_s / step_s).astype(int)
        self._jitters = np.round(cases.jitter_s / step_s).astype(int)
        self._ring = int((self._delays + self._jitters).max()) + 1
        # The ring buffer contains the queued offsets by the step at which they take effect.
        self._due = np.zeros((self._ring, len(cases)), dtype=bool)
        self._sampled = np.zeros((self._ring, len(cases)), dtype=int)
        self._newest = np.full(len(cases), -1)
        self._queued = np.zeros((self._ring, 2, len(cases)))
        self._last = self._rest_m.copy()
        self._held, self._rate = self._rest_m.copy(), np.zeros(len(cases))
        self._columns = np.arange(len(cases))

    def sample(self, step: int, depths_m: Floats) -> None:
        """Measure the finger depth (n,), in m, in each of the n simulated cases.

        The sheet offsets that are computed from the measured depths are queued.

        step: number of the time step.
        """
        seen = CAMERA_RESOLUTION_M * np.round(depths_m / CAMERA_RESOLUTION_M)
        self._seen = np.array([seen, self._seen[0]])
        filtered = np.sum(self._gains * self._seen + self._feedback * self._filtered, axis=0)
        self._filtered = np.array([filtered, self._filtered[0]])
        offsets_m = self._offset(np.maximum(filtered, 0.0))
        wanted = self._rest_m + self._cases.gain * (offsets_m - self._rest_m)
        rate = (wanted - self._last) / self._period_s
        self._last = wanted
        late = self._random.integers(0, self._jitters, endpoint=True)
        rows = (step + self._delays + late) % self._ring
        self._sampled[rows, self._columns] = step
        self._due[rows, self._columns] = True
        self._queued[rows, 0, self._columns] = wanted
        self._queued[rows, 1, self._columns] = rate

    def advance(self, step: int) -> Floats:
        """Return the sheet's offset (n,), in m, along its normal in each of the n simulated cases.

        step: number of the time step. Call the method for all time steps in increasing order.
        """
        row = step % self._ring
        due = self._due[row] & (self._sampled[row] > self._newest)
        self._newest = np.where(due, self._sampled[row], self._newest)
        self._held = np.where(due, self._queued[row, 0], self._held + self._step_s * self._rate)
        self._rate = np.where(due, self._queued[row, 1], self._rate)
        self._due[row] = False
        return self._held


def simulate_release(
    cases: Cases, *, force: Curve, offset: Curve, period_s: float, seconds: float = 8.0
) -> Motion:
    """Release the fingers at a distance of RELEASE_M from equilibrium, and simulate their motion.

    force: sheet force (N) as a function of the sheet's indentation (m).
    offset: sheet offset (m) as a function of the finger depth (m). The sheet must be indented at
        equilibrium.
    period_s: camera period.
    seconds: simulated duration.
    """
    step_s = period_s / STEPS_PER_PERIOD
    steps = round(seconds / step_s)
    sheet = HeldOffset(cases, offset, period_s, step_s)
    rest_force = force(np.maximum(cases.depth_m - offset(cases.depth_m), 0.0))
    # The bone is deeper than the skin by the compression of the finger pad.
    bone_rest = cases.depth_m + rest_force / PAD_STIFFNESS_N_PER_M
    spring_rest = bone_rest + rest_force / cases.stiffness_n_per_m
    bone, skin = bone_rest - RELEASE_M, cases.depth_m - RELEASE_M
    speed = np.zeros(len(cases))
    stored_every = STEPS_PER_PERIOD // 16
    path = np.empty((-(-steps // stored_every), len(cases)))
    work = np.empty_like(path)
    done = np.zeros(len(cases))
    indented = cases.depth_m - offset(cases.depth_m)
    stiffness = (force(indented + 1e-4) - force(indented - 1e-4)) / 2e-4
    for step in range(steps):
        if step % STEPS_PER_PERIOD == 0:
            # The marker is on the nail, which moves with the bone. Subtracting the pad's
            # compression at rest gives the depth of the skin.
            sheet.sample(step, bone - (bone_rest - cases.depth_m))
        pushed = force(np.maximum(skin - sheet.advance(step), 0.0))
        compression = PAD_STIFFNESS_N_PER_M * (bone - skin)
        skin_speed = speed + (compression - pushed) / PAD_DAMPING_NS_PER_M
        pad_n = compression + PAD_DAMPING_NS_PER_M * (speed - skin_speed)
        spring_n = cases.stiffness_n_per_m * (spring_rest - bone)
        speed = speed + step_s / cases.mass_kg * (spring_n - cases.damping_ns_per_m * speed - pad_n)
        bone, skin = bone + step_s * speed, skin + step_s * skin_speed
        # Bounds keep diverging cases finite. Such a case counts as unstable long before.
        np.clip(bone, -0.5, 0.5, out=bone)
        np.clip(skin, -0.5, 0.5, out=skin)
        np.clip(speed, -50.0, 50.0, out=speed)
        done -= step_s * (pushed - rest_force) * skin_speed
        if step % stored_every == 0:
            stored = 0.5 * stiffness * (skin - cases.depth_m) ** 2
            path[step // stored_every], work[step // stored_every] = bone, done + stored
    released_j = 0.5 * np.maximum(stiffness, 1.0) * RELEASE_M**2
    return _evaluate(path, work, released_j, seconds)


def _evaluate(path: Floats, work: Floats, released_j: Floats, seconds: float) -> Motion:
    quarter = len(path) // 4
    second, last = path[quarter : 2 * quarter], path[3 * quarter :]
    early = 0.5 * np.ptp(second, axis=0)
    late = 0.5 * np.ptp(last, axis=0)
    elapsed_s = 0.5 * seconds
    with np.errstate(divide="ignore"):
        decay = np.log(np.maximum(early, 1e-12) / np.maximum(late, 1e-12)) / elapsed_s
    died_out = late <= 0.5 * MAX_AMPLITUDE_M
    window = round(2.0 / seconds * len(work))
    delivered = (work[window:] - work[:-window])[quarter // 2 :]
    return Motion(
        decay_per_s=np.where(died_out, np.inf, decay),
        amplitude_m=late,
        energy_ratio=delivered.max(axis=0) / released_j,
    )
