"""Correct the closed-form force model of the sheet by a table of force ratios.

A ratio is the measured or computed force divided by the force of the closed-form model.

The ratio varies slowly, so a coarse table is sufficient. A table for one fingertip radius is also
used for other radii.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.sheet.force_models import (
    ScaledSheetModel,
    SheetForce,
    SheetPosition,
    SheetPush,
)
from flexsheet.nodes.models.sheet.rubber import Rubber

Measure = Callable[[float, Floats, SheetPosition], Floats]
"""A function that returns forces (n,), N. Its arguments are a stretch ratio, n depths (n,), m, and
a position."""


Curve = Callable[[Floats], Floats]
"""A function that returns ratios (n,), or their derivatives, at n depths (n,), m."""

MAX_CURVES = 256
"""The maximum number of stored ratio curves. A planner needs some tens, because all of its fits use
the same pushes."""


@dataclass(frozen=True, slots=True)
class TabulatedSheetModel:
    """A model that multiplies the force of a `ScaledSheetModel` by ratios from a table.

    stretches (a,), depths_m (b,), xs_m (c,), ys_m (d,): ascending axes of the table. Positions are
        in only one quadrant, because the sheet is symmetric.
    ratios (a, b, c, d): entries of the table. The interpolation is linear over stretches and
        positions, and uses monotone cubics over depths. Beyond the ends of an axis, the ratios are
        constant.

    Raises ValueError if an axis is not ascending, or if a ratio is invalid.
    """

    base: ScaledSheetModel
    stretches: Floats
    depths_m: Floats
    xs_m: Floats
    ys_m: Floats
    ratios: Floats
    name: str = "table"
    _curves: dict[SheetPush, tuple[Curve, Curve]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        axes = (self.stretches, self.depths_m, self.xs_m, self.ys_m)
        shape = tuple(len(axis) for axis in axes)
        if 0 in shape or any((np.diff(axis) <= 0.0).any() for axis in axes):
            raise ValueError(
                "the stretches, depths and positions of the force table must be ascending"
            )
        if self.ratios.shape != shape:
            raise ValueError(
                f"the force table has ratios of shape {self.ratios.shape}, expected {shape}"
            )
        if not (np.isfinite(self.ratios).all() and (self.ratios > 0.0).all()):
            raise ValueError("the ratios of the force table must be finite and above 0")

    @property
    def rubber(self) -> Rubber:
        return self.base.rubber

    def evaluate(self, push: SheetPush, depths_m: Floats) -> SheetForce:
        base = self.base.evaluate(push, depths_m)
        if len(self.depths_m) == 1:
            ratio = np.full(base.force_n.shape, self._ratios_of(push)[0])
            slope = np.zeros(1)
        else:
            curve, derivative = self._ratio_curve(push)
            within = np.clip(depths_m, self.depths_m[0], self.depths_m[-1])
            ratio = curve(within)
            slope = np.where(within == depths_m, derivative(within), 0.0)
        return SheetForce(
            base.force_n * ratio,
            base.stiffness_n_per_m * ratio + base.force_n * slope,
            base.edge_force_n,
        )

    def _ratios_of(self, push: SheetPush) -> Floats:
        """Return the table's force ratios (b,) for a push, at the b depths of the table.

        A ratio is the sheet's force divided by the force of the closed-form model `base`. The
        ratios are interpolated between stretch ratios and positions.
        """
        x, y = map(abs, push.position_m)
        ratios = _interpolate_linear(self.stretches, push.stretch_ratio, self.ratios)
        ratios = _interpolate_linear(self.xs_m, x, np.moveaxis(ratios, 1, 0))
        return _interpolate_linear(self.ys_m, y, np.moveaxis(ratios, 1, 0))

    def _ratio_curve(self, push: SheetPush) -> tuple[Curve, Curve]:
        """Return the force ratio of a push as a function of the depth, and its derivative.

        The ratio is the sheet's force divided by the force of the closed-form model `base`.
        """
        if push not in self._curves:
            if len(self._curves) >= MAX_CURVES:
                self._curves.clear()
            curve = scipy.interpolate.PchipInterpolator(self.depths_m, self._ratios_of(push))
            self._curves[push] = curve, curve.derivative()
        return self._curves[push]

    def invalid_reason(self, push: SheetPush, depth_m: float) -> str:
        x, y = map(abs, push.position_m)
        inputs = {
            "stretch ratio": (push.stretch_ratio, self.stretches),
            "depth": (depth_m, self.depths_m),
            "position along x": (x, self.xs_m),
            "position along y": (y, self.ys_m),
        }
        for what, (value, axis) in inputs.items():
            if not axis[0] - 1e-9 <= value <= axis[-1] + 1e-9:
                return (
                    f"the {what} {value:.4g} is outside the table, which contains {axis[0]:.4g} to "
                    f"{axis[-1]:.4g}"
                )
        return ""


def _interpolate_linear(axis: Floats, value: float, entries: Floats) -> Floats:
    """Interpolate entries (n, ...) linearly at `value` along their first axis.

    axis (n,): coordinates of the entries.

    The results are constant beyond the ends of the axis.
    """
    if len(axis) == 1:
        return np.asarray(entries[0])
    value = float(np.clip(value, axis[0], axis[-1]))
    upper = int(np.clip(np.searchsorted(axis, value), 1, len(axis) - 1))
    t = (value - axis[upper - 1]) / (axis[upper] - axis[upper - 1])
    return np.asarray((1.0 - t) * entries[upper - 1] + t * entries[upper])


def make_tabulated_model(
    base: ScaledSheetModel,
    measure: Measure,
    *,
    stretches: Floats,
    depths_m: Floats,
    xs_m: Floats,
    ys_m: Floats,
    finger_radius_m: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TabulatedSheetModel:
    """Make a tabulated model from the forces that `measure` returns.

    progress: function that is called with the number of finished calls of `measure` and the total
        number of calls.
    """
    ratios = np.empty((len(stretches), len(depths_m), len(xs_m), len(ys_m)))
    total, done = len(stretches) * len(xs_m) * len(ys_m), 0
    for a, stretch in enumerate(stretches):
        for c, x in enumerate(xs_m):
            for d, y in enumerate(ys_m):
                position = (float(x), float(y))
                scaled = base.evaluate(
                    SheetPush(float(stretch), finger_radius_m, position), depths_m
                )
                ratios[a, :, c, d] = measure(float(stretch), depths_m, position) / scaled.force_n
                done += 1
                progress(done, total)
    return TabulatedSheetModel(base, stretches, depths_m, xs_m, ys_m, ratios)
