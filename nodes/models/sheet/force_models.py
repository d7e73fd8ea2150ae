"""Compute the force of the pushed sheet with interchangeable models.

The inputs of a model are depths of a fingertip below the flat sheet, and a `SheetPush`. A
`SheetPush` contains the stretch ratio, the fingertip's radius, and the position on the stretched
sheet (x and y from the sheet's centre, m). The outputs are the normal force, its derivative with
respect to depth, and the force on each clamp.

`nodes.models.sheet.tabulated.TabulatedSheetModel` is exact. It multiplies the closed form
`ScaledSheetModel` by ratios of a table, which is computed by finite elements, or measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tension import edge_force_n, strain_measure

SheetPosition = tuple[float, float]

CENTRE: SheetPosition = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SheetPush:
    """The conditions of a push on the sheet, apart from its depth.

    position_m: (x, y) of the fingertip on the stretched sheet, from its centre.

    Raises ValueError if a value is not finite, or if the stretch ratio or the radius is not
    positive.
    """

    stretch_ratio: float
    finger_radius_m: float
    position_m: SheetPosition = CENTRE

    def __post_init__(self) -> None:
        if not np.isfinite((self.stretch_ratio, *self.position_m, self.finger_radius_m)).all():
            raise ValueError(f"{self}: every value must be a finite number")
        if self.stretch_ratio <= 0.0 or self.finger_radius_m <= 0.0:
            raise ValueError(f"{self}: stretch ratio and finger radius must be above 0")


@dataclass(frozen=True, slots=True)
class SheetForce:
    """The result of a force model for n push depths.

    force_n (n,): normal force.
    stiffness_n_per_m (n,): derivative of the normal force with respect to depth.
    edge_force_n (n,): force on each clamp.
    """

    force_n: Floats
    stiffness_n_per_m: Floats
    edge_force_n: Floats


class SheetForceModel(Protocol):
    """The interface of models that compute the force of the sheet on a fingertip that pushes it."""

    @property
    def name(self) -> str: ...

    @property
    def rubber(self) -> Rubber: ...

    def evaluate(self, push: SheetPush, depths_m: Floats) -> SheetForce:
        """Return the forces at depths (n,), m. The normal force is zero if the depth is at most 0.

        Raises ValueError if a depth is not finite.
        """
        ...

    def invalid_reason(self, push: SheetPush, depth_m: float) -> str:
        """Return why the model is inaccurate for a push, or "" if the model is valid for it."""
        ...


def flat_edge_force_n(rubber: Rubber, stretch_ratio: float) -> float:
    """Return the force (N) on each clamp of a stretched sheet that nothing touches."""
    return edge_force_n(stretch_ratio, rubber, mooney_ratio=rubber.mooney_ratio)


def _check_depths(depths_m: Floats) -> Floats:
    """Return the depths (n,), m, with negative depths set to 0.

    Raises ValueError if a depth is NaN or infinite.
    """
    depths = np.asarray(depths_m, dtype=np.float64)
    if not np.isfinite(depths).all():
        raise ValueError(f"the depths of a push are {depths} m; all of them must be finite")
    return np.maximum(depths, 0.0)


def relative_position(
    rubber: Rubber, stretch_ratio: float, position_m: SheetPosition
) -> tuple[float, float]:
    """Return (|x|, |y|) of a sheet position (m), scaled to 0 at the centre and 1 at the edges."""
    half_width = 0.5 * rubber.width_m * max(stretch_ratio, 1.0)
    return abs(position_m[0]) / half_width, abs(position_m[1]) / (0.5 * rubber.height_m)


MAX_RELATIVE_X = 0.98
"""The maximum relative position x that closed-form models use. At x = 1 (the clamp), the force
would be infinite."""


MAX_STRETCH_RATIO = 1.13
"""The maximum stretch ratio at which the closed-form models are valid."""


def _invalid_sizes(rubber: Rubber, finger_radius_m: float) -> str:
    if not 0.9 <= rubber.height_m / rubber.width_m <= 1.1:
        return "the sheet is not approximately square"
    if not 0.02 <= finger_radius_m / rubber.width_m <= 0.043:
        return "the fingertip's radius is not 2 to 4.3 % of the sheet's width"
    return ""


CUBIC_FACTOR = 2.43
"""The factor c in the force F = c E t W (d/W)^3 of a slack square sheet. The radius of the
fingertip is 7 mm.

E is Young's modulus, t and W are the thickness and the width of the sheet, and d is the depth of
the push.
"""


# Fitted by least squares of the logarithms to `push_path` of a square neo-Hookean sheet: stretch 1
# to 1.12, fingertips of 5 to 10 mm on 240 mm, depths of 2 to 50 mm, relative positions up to 0.5 in
# x and 0.75 in y; 3.6 % rms. See docs/sheet.md.
_TAUT_FACTOR, _TAUT_POWER, _TAUT_STRETCH, _TAUT_RADIUS = 1.781, 1.414, 0.762, 0.067
_KNEE, _KNEE_SHARPNESS, _KNEE_POWER = 1.149, 5.0, 0.567
_CUBIC_STRETCH, _CUBIC_RADIUS = 5.582, 0.062
_TAUT_X, _SLACK_X = 1.031, 2.847
_TAUT_Y, _TAUT_Y_POWER, _SLACK_Y, _SLACK_Y_POWER = 0.594, 2.289, 0.363, 2.114
_TAUT_HEIGHT, _SLACK_HEIGHT = 0.8, 0.4
_PULL, _PULL_KNEE, _PULL_X, _PULL_Y, _PULL_STRETCH = 0.779, 0.484, 1.093, 0.333, 5.072
_FITTED_RADIUS = 0.007 / 0.24


def _slack_position_factor(x: float, y: float) -> float:
    near = 1.0 - min(x, MAX_RELATIVE_X) ** 2
    sideways = 1.0 - _SLACK_Y * min(y, 1.0) ** _SLACK_Y_POWER
    return float(sideways * near**-_SLACK_X)


def _push_tension(
    rubber: Rubber, stretch_ratio: float, depths: Floats, relative: tuple[float, float]
) -> tuple[Floats, float]:
    """Return the additional force (n,), N, on each clamp due to a push, and the factor E t W (N).

    E is Young's modulus, and t and W are the thickness and the width of the sheet.

    depths (n,): depths of the push, m.
    relative: coordinates (x, y) of the push, from 0 (centre) to 1 (edge).
    """
    modulus = rubber.young_modulus_pa * rubber.thickness_m * rubber.width_m
    depth_ratio = depths / rubber.width_m
    scaled = depth_ratio / max(strain_measure(stretch_ratio, rubber.mooney_ratio), 1e-12) ** 0.5
    near = 1.0 - min(relative[0], MAX_RELATIVE_X) ** 2
    where = near**-_PULL_X * (1.0 - _PULL_Y * min(relative[1], 1.0) ** 2)
    taut = max(stretch_ratio, 1.0) ** -_PULL_STRETCH
    added = (
        _PULL * modulus * taut * where * depth_ratio**2 * np.sqrt(scaled / (scaled + _PULL_KNEE))
    )
    return added, modulus


@dataclass(frozen=True, slots=True)
class ScaledSheetModel:
    """A closed-form model of the sheet's force.

    The force is the sum of a power of the scaled depth, which models the tension, and a cubic term.

    E is Young's modulus, t and W are the thickness and width of the sheet, d is the depth and s is
    the stretch ratio. With e = `strain_measure`(s), w = d/W and u = w/sqrt(e), the force is:

        F = E t W (e^(3/2) s^a A u^p / (1 + (u/b)^q)^(r/q)  +  c s^-g w^3)

    a, b, c, g, p, q, r and A are fitted. A and c depend on the position, the fingertip's radius and
    the sheet's height.

    cubic_ratio: ratio of the calibrated cubic term to the cubic term of ideal rubber.
    stretch_scale: calibrated stretch ratio divided by the nominal stretch ratio. It corrects the
        slack width of the sheet.
    """

    rubber: Rubber
    cubic_ratio: float = 1.0
    stretch_scale: float = 1.0
    name: str = "scaled"

    def evaluate(self, push: SheetPush, depths_m: Floats) -> SheetForce:
        depths = _check_depths(depths_m)
        rubber, s = self.rubber, max(self.stretch_scale * push.stretch_ratio, 1.0)
        x, y = relative_position(rubber, s, push.position_m)
        tension, modulus = _push_tension(rubber, s, depths, (x, y))
        strain = strain_measure(s, rubber.mooney_ratio)
        depth_ratio = depths / rubber.width_m
        radius = push.finger_radius_m / rubber.width_m / _FITTED_RADIUS
        height = rubber.height_m / rubber.width_m
        cubic = (
            self.cubic_ratio
            * CUBIC_FACTOR
            * s**-_CUBIC_STRETCH
            * radius**_CUBIC_RADIUS
            * height**_SLACK_HEIGHT
            * _slack_position_factor(x, y)
        )
        force = cubic * depth_ratio**3
        slope = 3.0 * cubic * depth_ratio**2
        if strain > 0.0:
            near = 1.0 - min(x, MAX_RELATIVE_X) ** 2
            taut = (
                _TAUT_FACTOR
                * s**_TAUT_STRETCH
                * radius**_TAUT_RADIUS
                * height**_TAUT_HEIGHT
                * near**-_TAUT_X
                * (1.0 - _TAUT_Y * min(y, 1.0) ** _TAUT_Y_POWER)
            )
            u = depth_ratio / strain**0.5
            bend = (u / _KNEE) ** _KNEE_SHARPNESS
            curve = u ** (_TAUT_POWER - 1.0) * (1.0 + bend) ** (-_KNEE_POWER / _KNEE_SHARPNESS)
            force = force + taut * strain**1.5 * curve * u
            power = _TAUT_POWER - _KNEE_POWER * bend / (1.0 + bend)
            slope = slope + taut * strain * curve * power
        return SheetForce(
            modulus * force,
            modulus / rubber.width_m * slope,
            flat_edge_force_n(rubber, s) + tension,
        )

    def invalid_reason(self, push: SheetPush, depth_m: float) -> str:
        rubber, stretch_ratio = self.rubber, self.stretch_scale * push.stretch_ratio
        if not 1.0 <= stretch_ratio <= MAX_STRETCH_RATIO:
            return f"the stretch ratio {stretch_ratio:.3f} is not from 1 to {MAX_STRETCH_RATIO:g}"
        if not 0.008 <= depth_m / rubber.width_m <= 0.21:
            return "the depth is not 0.8 to 21 % of the sheet's width"
        x, y = relative_position(rubber, stretch_ratio, push.position_m)
        if x > 0.5 or y > 0.76:
            return "the position is too close to an edge"
        return _invalid_sizes(rubber, push.finger_radius_m)


def depth_for_force(
    model: SheetForceModel, push: SheetPush, forces_n: Floats, *, max_depth_m: float
) -> Floats:
    """Return the depths (n,), m, at which a model gives the forces `forces_n` (n,).

    The depths are at most `max_depth_m`.

    The model is evaluated once on a geometric grid, and the logarithm of the force is interpolated
    linearly over the logarithm of the depth. The relative error is below 1e-3.
    """
    grid = max_depth_m * _INVERSE_GRID
    grid_forces = model.evaluate(push, grid).force_n
    return interpolate_inverse(grid, grid_forces, np.asarray(forces_n, dtype=np.float64))


_INVERSE_GRID = np.geomspace(1e-3, 1.0, 160)


def interpolate_inverse(grid: Floats, values: Floats, targets: Floats) -> Floats:
    """Return the arguments (n,) at which an increasing function has the values `targets` (n,).

    grid, values (k,): arguments, and function values at these k arguments. All are positive.

    The logarithms are interpolated linearly. For targets below all values, the power law of the
    first interval is extrapolated. For targets above all values, the result is the last grid point.
    """
    logs = np.log(np.maximum(np.maximum.accumulate(values), 1e-300))
    keep = np.concatenate([[True], np.diff(logs) > 1e-12])
    logs, log_grid = logs[keep], np.log(grid[keep])
    result = np.zeros(targets.shape)
    some = targets > 0.0
    if len(logs) < 2 or not some.any():
        result[some] = grid[-1]
        return result
    log_targets = np.log(targets[some])
    power = (log_grid[1] - log_grid[0]) / (logs[1] - logs[0])
    below = log_grid[0] + power * (log_targets - logs[0])
    inside = np.interp(log_targets, logs, log_grid)
    result[some] = np.exp(np.where(log_targets < logs[0], below, inside))
    return result


def make_model(
    nominal: Rubber,
    *,
    modulus_thickness_n_per_m: float,
    slack_width_m: float,
    cubic_ratio: float,
) -> ScaledSheetModel:
    """Make the closed-form force model from calibrated parameters.

    nominal: sheet of the scene. The stretch ratios that the model receives refer to the width of
        this sheet.
    """
    rubber = replace(
        nominal,
        width_m=slack_width_m,
        young_modulus_pa=modulus_thickness_n_per_m / nominal.thickness_m,
    )
    return ScaledSheetModel(rubber, cubic_ratio, nominal.width_m / slack_width_m)
