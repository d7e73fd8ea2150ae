"""Simulate the hand behind the finger as a mass with a spring and a damper.

Without contact, the finger follows its voluntary path exactly. The force F of the sheet causes a
deviation e from this path. The hand at the fingertip has the mass m, damping b and stiffness k:

    m e'' + b e' + k e = F(path + e)

F acts along the sheet's normal. Friction forces along the sheet are neglected. In each step, F is
constant and is evaluated at the centre of the step. The linear equation is solved exactly.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.force_history import ForceHistory
from flexsheet.nodes.twin.membrane import make_edge_plane
from flexsheet.nodes.twin.sheet_reaction import SheetReaction
from flexsheet.nodes.twin.sheet_surface import SheetPlanes, SheetSurface

VoluntaryPath = Callable[[float], tuple[Floats, Floats]]
"""A function that returns the voluntary position (3,), m, and velocity (3,), m/s, at a time (s)."""

Edges = Callable[[float], tuple[Floats, Floats]]
"""A function that returns the poses (4, 4) of the sheet's left and right edges at a time (s)."""

STEP_S = 0.0005
"""The maximum time step of the motion along the sheet's normal. The fastest oscillation advances by
a tenth of a radian in this time."""

INTERVAL_S = 0.004
"""The maximum interval (s) over which the voluntary path and the sheet's force curves are
interpolated."""

NEAR_M = 0.005
"""The maximum distance (m) of the finger from the sheet at which a force is computed."""

MAX_EXTRAPOLATION_S = 0.02
"""The maximum time (s) over which poses of the edges are extrapolated at constant velocity."""

MAX_PREDICTION_S = 0.1

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True)
class HandImpedance:
    """The mechanical impedance of a hand at the fingertip, equal in all directions.

    The default values describe a finger that moves together with the wrist. Its natural frequency
    without contact is 5 Hz (Lakie et al. 2015: 6 to 12 Hz with less mass).
    """

    mass_kg: float = 0.15
    stiffness_n_per_m: float = 150.0
    damping_ratio: float = 0.3

    @classmethod
    def of(cls, apparatus: Apparatus | None) -> Self:
        """Return the hand impedance from an apparatus (true parameters of the simulated hardware).

        Returns the default values if the apparatus contains no impedance.
        """
        finger = None if apparatus is None else apparatus.finger
        if finger is None or finger.hand_mass_kg is None:
            return cls()
        assert finger.hand_stiffness_n_per_m is not None
        assert finger.hand_damping_ratio is not None
        return cls(finger.hand_mass_kg, finger.hand_stiffness_n_per_m, finger.hand_damping_ratio)

    def transition(self, step_s: float) -> tuple[float, float, float, float]:
        """Return the transition matrix (2, 2) of the free motion over `step_s`, row by row.

        The matrix maps the deviation (m) from the voluntary path, and its rate (m/s), to the values
        after the step.
        """
        pace = math.sqrt(self.stiffness_n_per_m / self.mass_kg)
        decay = self.damping_ratio * pace
        split = pace * cmath.sqrt(self.damping_ratio**2 - 1.0)
        if abs(split) * step_s < 1e-6:
            split = 1e-6 / step_s
        fade = math.exp(-decay * step_s)
        cosine = (fade * cmath.cosh(split * step_s)).real
        sine = (fade * cmath.sinh(split * step_s) / split).real
        return cosine + decay * sine, sine, -pace * pace * sine, cosine - decay * sine


@dataclass(frozen=True, slots=True)
class Touch:
    """The local state of the sheet below the finger at one time.

    origin (3,): point on the tangent plane of the unloaded sheet, m.
    normal (3,): unit normal of this plane, towards the user.
    curve_n (d,): normal forces at the d depths in the force table `SheetReaction`.
    """

    origin: Floats
    normal: Floats
    curve_n: Floats


class TrueSheet:
    """A model of the force of the simulated sheet on the finger, for given poses of its edges."""

    def __init__(self, scene: Scene, apparatus: Apparatus | None, reaction: SheetReaction) -> None:
        self.step_m = float(reaction.depths_m[1])
        self.history = ForceHistory.of(apparatus)
        self._reaction, self._surface = reaction, SheetSurface.of(scene, apparatus)

    def find_touch(self, edges: tuple[Floats, Floats], tip: Floats) -> Touch:
        """Return the sheet's tangent plane and force curve at the point nearest to the fingertip.

        edges: poses (4, 4) of the left and right edges.
        tip: world position (3,), m.
        """
        left, right = edges
        distance_m = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
        x_axis, y_axis, normal, middle = make_edge_plane(left, right)[:3].T
        if float((tip - middle) @ normal) > NEAR_M:
            return Touch(middle, normal, np.zeros(2))
        plane = SheetPlanes.through(left, right)
        surface = self._surface.find_tangent_planes(plane, tip[None], UP)
        x_m = float((tip - middle) @ x_axis)
        y_m = float((tip - middle) @ y_axis)
        sag_m = 0.0
        if surface is not plane:
            sag_m = float((surface.points[0] - middle) @ normal)
        curve_n = self._reaction.curve_n(distance_m, x_m, y_m)
        return Touch(middle + sag_m * normal, normal, curve_n)


class EdgeTrack:
    """The last two poses of the sheet's edges, which are extrapolated linearly."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, Floats]] = []

    def add(self, time_s: float, left: Floats, right: Floats) -> None:
        """Add the poses (4, 4) of the edges at `time_s`.

        Poses that are not newer than the last poses are ignored.
        """
        if not self._samples or time_s > self._samples[-1][0]:
            self._samples = [*self._samples[-1:], (time_s, np.stack([left, right]))]

    def __bool__(self) -> bool:
        return len(self._samples) == 2

    def __call__(self, time_s: float) -> tuple[Floats, Floats]:
        """Return the poses (4, 4) of both edges at a time (s).

        The extrapolation is limited to MAX_EXTRAPOLATION_S.
        """
        (before_s, before), (after_s, after) = self._samples
        at_s = min(max(time_s, before_s), after_s + MAX_EXTRAPOLATION_S)
        left, right = after + (at_s - after_s) / (after_s - before_s) * (after - before)
        return left, right


class CoupledFinger:
    """A simulation of a finger that the sheet's force pushes away from its voluntary path.

    path: voluntary motion; it may be replaced at any time.
    deviation_m, rate_m_per_s (3,): deviation from the path, and its rate of change.
    force_n (3,): force of the sheet on the finger, averaged over the last interval of the
        integration.
    log: rows (time in s, indentation in m, force in N) of all steps; None if they are not recorded.
    """

    def __init__(self, impedance: HandImpedance, sheet: TrueSheet, path: VoluntaryPath) -> None:
        self.path, self.time_s = path, 0.0
        self.deviation_m, self.rate_m_per_s = np.zeros(3), np.zeros(3)
        self.force_n = np.zeros(3)
        self.log: list[tuple[float, float, float]] | None = None
        self._impedance, self._sheet = impedance, sheet
        self._ratio, self._remembers = 1.0, sheet.history is not None

    def predict(self, time_s: float, edges: Edges) -> CoupledFinger:
        """Return a copy of this simulation, advanced to `time_s`.

        The copy predicts at most MAX_PREDICTION_S. If this simulation is further behind `time_s`,
        it is itself advanced first.
        """
        self.advance(time_s - MAX_PREDICTION_S, edges)
        ahead = copy(self)
        ahead._remembers, ahead.log = False, None
        ahead.advance(time_s, edges)
        return ahead

    def position(self) -> tuple[Floats, Floats]:
        """Return the position (3,), m, and velocity (3,), m/s, of the fingertip at `time_s`."""
        position, velocity = self.path(self.time_s)
        return position + self.deviation_m, velocity + self.rate_m_per_s

    def advance(self, until_s: float, edges: Edges) -> None:
        """Integrate the motion until `until_s`.

        If the motion is already computed to this time, nothing changes.
        """
        span_s = until_s - self.time_s
        if span_s <= 0.0:
            return
        times = np.linspace(self.time_s, until_s, math.ceil(span_s / INTERVAL_S) + 1)
        for start_s, end_s in zip(times[:-1].tolist(), times[1:].tolist(), strict=True):
            self._advance_interval(start_s, end_s, edges)
        self.time_s = until_s

    def _advance_interval(self, start_s: float, end_s: float, edges: Edges) -> None:
        (before, speed_before), (after, speed_after) = self.path(start_s), self.path(end_s)
        first, last = edges(start_s), edges(end_s)
        touch = self._sheet.find_touch(last, after + self.deviation_m)
        normal = touch.normal
        moved = 0.5 * sum(now[:3, 3] - old[:3, 3] for now, old in zip(last, first, strict=True))
        span_s = end_s - start_s
        # Gap between the sheet and the voluntary path at both ends, and its rates: a cubic.
        gap_after = float((touch.origin - after) @ normal)
        gap_before = float((touch.origin - moved - before) @ normal)
        rates = [float((moved / span_s - speed) @ normal) for speed in (speed_before, speed_after)]
        along, rate = float(self.deviation_m @ normal), float(self.rate_m_per_s @ normal)
        aside = self.deviation_m - along * normal, self.rate_m_per_s - rate * normal
        steps = math.ceil(span_s / STEP_S)
        step_s = span_s / steps
        a, b, c, d = self._impedance.transition(step_s)
        curve_n, inverse_m = touch.curve_n.tolist(), 1.0 / self._sheet.step_m
        ratio, stiffness = self._ratio, self._impedance.stiffness_n_per_m
        total_n = elastic_n = 0.0
        for number in range(steps):
            t = (number + 0.5) / steps
            gap_m = _hermite(t, span_s, gap_before, gap_after, rates)
            indented_m = gap_m - along - 0.5 * step_s * rate
            elastic_n = _interpolate(curve_n, indented_m * inverse_m)
            force_n = ratio * elastic_n
            total_n += force_n
            shift_m = force_n / stiffness
            along, rate = (
                a * (along - shift_m) + b * rate + shift_m,
                c * (along - shift_m) + d * rate,
            )
            if self.log is not None:
                self.log.append((start_s + t * span_s, indented_m, force_n))
        a, b, c, d = self._impedance.transition(span_s)
        self.deviation_m = a * aside[0] + b * aside[1] + along * normal
        self.rate_m_per_s = c * aside[0] + d * aside[1] + rate * normal
        self.force_n = total_n / steps * normal
        history = self._sheet.history
        if self._remembers and history is not None and elastic_n > 0.0:
            self._ratio = history.update(end_s, elastic_n) / elastic_n


def _hermite(t: float, span_s: float, before: float, after: float, rates: list[float]) -> float:
    s = 1.0 - t
    return (
        s * s * (1.0 + 2.0 * t) * before
        + t * t * (1.0 + 2.0 * s) * after
        + span_s * s * t * (s * rates[0] - t * rates[1])
    )


def _interpolate(curve: list[float], at: float) -> float:
    """Interpolate a curve linearly at a fractional index, and extrapolate beyond the curve's end.

    Returns 0 if the index is below 0.
    """
    if at <= 0.0:
        return 0.0
    index = min(int(at), len(curve) - 2)
    return curve[index] + (at - index) * (curve[index + 1] - curve[index])
