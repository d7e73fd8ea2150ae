"""Fit the sheet's force model to measured pushes.

In a push, a finger is pressed into the sheet to a known depth, and its force is measured. The fit
determines the stiffness of the rubber and the unstretched width of the sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.sheet.force_models import (
    ScaledSheetModel,
    SheetForceModel,
    SheetPush,
    make_model,
)
from flexsheet.nodes.models.sheet.rubber import Rubber

FORCE_NOISE_N = 0.01
EDGE_NOISE_N = 0.1
MODEL_ERROR_RATIO = 0.03
"""The assumed error of the force model, as a fraction of the force.

Each residual of the fit is divided by a standard deviation, which combines this error and the
measurement noise.
"""

OUTLIER_SIGMAS = 5.0
"""The residual, in standard deviations, above which a push is an outlier.

The fit is repeated without the outliers.
"""

MAX_RMS_SIGMAS = 1.0
"""The maximum rms residual of a valid fit, in units of the assumed standard deviation.

If the rms residual is larger, the noise and the model error are larger than assumed, and the
predicted force error is too small. Residuals relative to the force are not limited, because they
are large for small forces, which a user does not feel.
"""

MAX_RELATIVE_DEVIATION = 0.5
"""The maximum relative standard deviation of a fitted parameter in a valid fit."""


class SheetModelFitError(FlexsheetError, ValueError):
    """Raised if measured pushes do not determine the parameters of the sheet's force model."""

    remedy = "Add pushes at other stretches and depths."


@dataclass(frozen=True, slots=True)
class MeasuredPush:
    """A measured push of a finger into the sheet.

    edge_distance_m: distance between the clamped edges.
    depth_m: depth of the finger behind the plane of the sheet.
    force_n: normal force of the finger on the sheet.
    position_m: contact point (x, y) on the stretched sheet, relative to the sheet's centre.
    edge_force_n: force on a clamped edge; None if it was not measured.
    unloading: whether the finger was deeper before; None if unknown.
    """

    edge_distance_m: float
    depth_m: float
    force_n: float
    finger_radius_m: float
    position_m: tuple[float, float] = (0.0, 0.0)
    edge_force_n: float | None = None
    unloading: bool | None = None


@dataclass(frozen=True, slots=True)
class SheetModelFit:
    """A force model of the sheet, fitted to n pushes, with its uncertainty.

    law: fitted force model, whose stretch ratios refer to the nominal width of the sheet.
    names, values, standard_deviations: names, values and standard deviations of the fitted
        parameters.
    used: mask (n,) of the pushes that are not outliers.
    residual_ratio: measured force divided by fitted force, minus one (n,).
    rms_ratio, worst_ratio: rms and largest magnitude of `residual_ratio`. Outliers and pushes with
        forces as small as the measurement noise are excluded.
    rms_sigmas: rms residual in units of the assumed standard deviation. Contact forces and edge
        forces are evaluated separately, and the larger value is used. The residual of an outlier is
        limited to OUTLIER_SIGMAS.
    """

    law: ScaledSheetModel
    names: tuple[str, ...]
    values: tuple[float, ...]
    standard_deviations: tuple[float, ...]
    used: Bools
    residual_ratio: Floats
    rms_ratio: float
    worst_ratio: float
    rms_sigmas: float
    nominal_width_m: float


MIN_HYSTERESIS_ROWS = 3
"""The hysteresis is estimated only if loading and unloading each have this number of pushes."""


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """A fitted hysteresis of the sheet.

    ratio: fraction of the loading energy that is lost in a cycle of loading and unloading.
    """

    ratio: float
    standard_deviation: float

    @property
    def amplitude(self) -> float:
        """Return the relative amplitude h of the hysteresis.

        During loading, the force is 1 + h times the elastic force. During unloading, it is 1 - h
        times the elastic force.
        """
        return self.ratio / (2.0 - self.ratio)


def estimate_hysteresis(fit: SheetModelFit, pushes: Sequence[MeasuredPush]) -> Hysteresis | None:
    """Estimate the hysteresis from the measured forces during loading and unloading.

    Return None if fewer than MIN_HYSTERESIS_ROWS pushes can be used for loading or for unloading.
    Raises SheetModelFitError if the force is larger during unloading than during loading.
    """
    elastic_n, _ = _predict(fit.law, pushes, fit.nominal_width_m)
    ratios = np.array([push.force_n for push in pushes]) / np.maximum(elastic_n, 1e-6)
    counted = fit.used & (elastic_n > 3.0 * FORCE_NOISE_N)
    falling = np.array([push.unloading is True for push in pushes])
    known = np.array([push.unloading is not None for push in pushes])
    parts = [ratios[counted & known & side] for side in (~falling, falling)]
    if min(len(part) for part in parts) < MIN_HYSTERESIS_ROWS:
        return None
    (loading, falls), errors = (
        [float(np.mean(part)) for part in parts],
        [float(np.std(part, ddof=1) / np.sqrt(len(part))) for part in parts],
    )
    ratio = falls / loading
    deviation = ratio * float(np.hypot(errors[0] / loading, errors[1] / falls))
    if ratio > 1.0 + 3.0 * deviation:
        raise SheetModelFitError(
            f"the force during unloading is {ratio:.2f} times the force during loading, but it "
            "must be smaller; correct the column unloading (1: unloading, 0: loading)"
        )
    # (1 - h) / (1 + h) is the ratio of the forces, and 2 h / (1 + h) the lost fraction of the
    # energy.
    return Hysteresis(max(1.0 - ratio, 0.0), deviation)


def remove_hysteresis(pushes: Sequence[MeasuredPush], hysteresis: Hysteresis) -> list[MeasuredPush]:
    """Return the pushes after removing the effect of hysteresis from their forces."""
    signs = {None: 0.0, False: 1.0, True: -1.0}
    return [
        replace(push, force_n=push.force_n / (1.0 + signs[push.unloading] * hysteresis.amplitude))
        for push in pushes
    ]


NAMES = ("modulus_thickness_n_per_m", "slack_width_m", "cubic_ratio")


def fit_sheet_model(pushes: Sequence[MeasuredPush], nominal: Rubber) -> SheetModelFit:
    """Fit the parameters of the sheet's force model to measured pushes.

    The parameters are the product of modulus and thickness, the unstretched width, and the cubic
    ratio. The cubic ratio is the cubic term of the force divided by the cubic term of ideal rubber.
    The least-squares fit is robust: it first uses a soft-L1 loss, and then omits outliers.

    nominal: material parameters from which the fit starts.

    Raises SheetModelFitError if there are too few pushes, or if they do not determine a parameter.
    """
    size = len(NAMES)
    if len(pushes) < 2 * size:
        raise SheetModelFitError(
            f"there are {len(pushes)} measured pushes, but fitting {', '.join(NAMES)} requires "
            f"{2 * size}; measure more pushes"
        )
    start = np.array([np.log(nominal.young_modulus_pa * nominal.thickness_m), 0.0, 0.0])
    low = np.array([start[0] - 7.0, -0.1, -2.0])
    high = np.array([start[0] + 7.0, 0.1, 2.0])

    def build_model(numbers: Floats) -> ScaledSheetModel:
        return make_model(
            nominal,
            modulus_thickness_n_per_m=float(np.exp(numbers[0])),
            slack_width_m=nominal.width_m * (1.0 + float(numbers[1])),
            cubic_ratio=float(np.exp(numbers[2])),
        )

    def residuals(numbers: Floats, used: Bools) -> Floats:
        contact, edge = _residuals(build_model(numbers), pushes, nominal.width_m)
        return np.concatenate([contact[used], edge[used & np.isfinite(edge)]])

    used = np.ones(len(pushes), dtype=bool)
    for loss in ("soft_l1", "linear"):
        solved = least_squares(
            residuals,
            start,
            args=(used,),
            bounds=(low, high),
            loss=loss,
            x_scale=[1.0, 0.01, 0.3],
        )
        start = solved.x
        if loss == "soft_l1":
            error = np.fmax(*np.abs(_residuals(build_model(solved.x), pushes, nominal.width_m)))
            used = error <= OUTLIER_SIGMAS * max(1.0, 1.4826 * float(np.median(error)))
            if used.sum() < 2 * size:
                raise SheetModelFitError(
                    f"{int((~used).sum())} of {len(pushes)} rows contradict the others; check "
                    "units and signs"
                )
    freedom = max(len(solved.fun) - size, 1)
    spread = max(1.0, float(solved.fun @ solved.fun) / freedom)
    information = solved.jac.T @ solved.jac
    if np.linalg.cond(information) > 1e14:
        raise SheetModelFitError(
            "the rows do not determine all parameters; add rows with other stretches and depths"
        )
    deviations = np.sqrt(np.diag(np.linalg.inv(information)) * spread)
    law = build_model(solved.x)
    values = (
        law.rubber.young_modulus_pa * law.rubber.thickness_m,
        law.rubber.width_m,
        law.cubic_ratio,
    )
    scale = (values[0], nominal.width_m, values[2])
    scaled = tuple(float(d) * one for d, one in zip(deviations, scale, strict=True))
    if deviations[0] > MAX_RELATIVE_DEVIATION or deviations[2] > 2.0 * MAX_RELATIVE_DEVIATION:
        index = 0 if deviations[0] > MAX_RELATIVE_DEVIATION else 2
        raise SheetModelFitError(
            f"{NAMES[index]} has an uncertainty of {100 * deviations[index]:.0f} %; add more "
            "stretches and greater depths"
        )
    ratio = _force_ratios(law, pushes, nominal.width_m)
    force = np.array([push.force_n for push in pushes])
    counted = used & (force > 3.0 * FORCE_NOISE_N)
    counted = counted if counted.any() else used
    groups = np.clip(_residuals(law, pushes, nominal.width_m), -OUTLIER_SIGMAS, OUTLIER_SIGMAS)
    return SheetModelFit(
        law=law,
        names=NAMES,
        values=values,
        standard_deviations=scaled,
        used=used,
        residual_ratio=ratio,
        rms_ratio=float(np.sqrt(np.mean(ratio[counted] ** 2))),
        worst_ratio=float(np.abs(ratio[counted]).max()),
        rms_sigmas=max(
            float(np.sqrt(np.nanmean(one**2))) for one in groups if np.isfinite(one).any()
        ),
        nominal_width_m=nominal.width_m,
    )


def _predict(
    law: SheetForceModel, pushes: Sequence[MeasuredPush], width_m: float
) -> tuple[Floats, Floats]:
    """Compute the contact forces (n,) and the edge forces (n,), in N, of n pushes.

    width_m: nominal width of the sheet, to which stretch ratios refer.
    """
    forces, edges = np.empty(len(pushes)), np.empty(len(pushes))
    groups: dict[tuple[float, tuple[float, float], float], list[int]] = {}
    for number, push in enumerate(pushes):
        key = (push.edge_distance_m, push.position_m, push.finger_radius_m)
        groups.setdefault(key, []).append(number)
    for (distance, position, radius), numbers in groups.items():
        depths = np.array([pushes[number].depth_m for number in numbers])
        pressed = law.evaluate(SheetPush(distance / width_m, radius, position), depths)
        forces[numbers], edges[numbers] = pressed.force_n, pressed.edge_force_n
    return forces, edges


def _residuals(law: SheetForceModel, pushes: Sequence[MeasuredPush], width_m: float) -> Floats:
    """Return the residuals (2, n) of the contact forces and the edge forces of n pushes.

    Each residual is divided by its assumed standard deviation. If an edge force was not measured,
    the residual is NaN.

    width_m: nominal width of the sheet, to which stretch ratios refer.
    """
    forces, edges = _predict(law, pushes, width_m)
    measured = np.array([push.force_n for push in pushes])
    measured_edges = np.array(
        [np.nan if push.edge_force_n is None else push.edge_force_n for push in pushes]
    )
    return np.stack(
        [
            (forces - measured) / np.hypot(FORCE_NOISE_N, MODEL_ERROR_RATIO * measured),
            (edges - measured_edges) / np.hypot(EDGE_NOISE_N, MODEL_ERROR_RATIO * measured_edges),
        ]
    )


def _force_ratios(law: SheetForceModel, pushes: Sequence[MeasuredPush], width_m: float) -> Floats:
    """Return the ratios (n,) of measured to modelled force, minus one, of n pushes."""
    forces, _ = _predict(law, pushes, width_m)
    measured = np.array([push.force_n for push in pushes])
    ratios: Floats = measured / np.maximum(forces, 1e-6) - 1.0
    return ratios
