"""Fit the scaled force model to measured pushes: the rubber's stiffness and the slack width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.models.sheet.force_models import ScaledSheetModel, SheetForceModel, make_model
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FORCE_NOISE_N = 0.01
EDGE_NOISE_N = 0.1
MODEL_ERROR_RATIO = 0.03
"""Error of the model itself; residuals are weighted by this fraction of the force and by the
noise."""

OUTLIER_SIGMAS = 5.0
"""A row with a larger residual is an outlier; the fit is repeated without it."""

MAX_RELATIVE_DEVIATION = 0.5
"""A parameter with a larger relative standard deviation is undetermined."""


class SheetModelFitError(FlexsheetError, ValueError):
    """Raised for rows that do not determine the model; the message names what is missing."""

    code = "sheet-model-fit"
    remedy = "Add pushes at other stretches and depths."


@dataclass(frozen=True, slots=True)
class MeasuredPush:
    """Hold one measured push.

    position_m: on the stretched sheet.
    edge_force_n: None if not measured.
    """

    edge_distance_m: float
    depth_m: float
    force_n: float
    finger_radius_m: float
    position_m: tuple[float, float] = (0.0, 0.0)
    edge_force_n: float | None = None


@dataclass(frozen=True, slots=True)
class SheetModelFit:
    """Hold the fitted model and its uncertainty.

    law: takes stretch ratios over the nominal width.
    names, values, standard_deviations: the fitted parameters, in the same order.
    used: (n,), which rows.
    residual_ratio: (n,) measured over fitted force, minus one.
    rms_ratio: of the used rows above the noise.
    """

    law: ScaledSheetModel
    names: tuple[str, ...]
    values: tuple[float, ...]
    standard_deviations: tuple[float, ...]
    used: Bools
    residual_ratio: Floats
    rms_ratio: float
    worst_ratio: float


NAMES = ("modulus_thickness_n_per_m", "slack_width_m", "cubic_ratio", "mooney_share")


def fit_sheet_model(
    pushes: Sequence[MeasuredPush], nominal: Rubber, *, with_mooney: bool = False
) -> SheetModelFit:
    """Fit modulus x thickness, slack width, cubic ratio and optionally the Mooney fraction.

    Robust least squares: soft L1, then without outliers.  Raises SheetModelFitError for too few
        rows, or rows that leave a parameter undetermined.
    """
    names = NAMES if with_mooney else NAMES[:3]
    if len(pushes) < 2 * len(names):
        raise SheetModelFitError(
            f"{len(pushes)} rows; {2 * len(names)} or more are needed for {names}"
        )
    start = np.array([np.log(nominal.young_modulus_pa * nominal.thickness_m), 0.0, 0.0, 0.1])
    low = np.array([start[0] - 7.0, -0.1, -2.0, 0.0])
    high = np.array([start[0] + 7.0, 0.1, 2.0, 0.95])
    size = len(names)

    def model_at(numbers: Floats) -> ScaledSheetModel:
        return make_model(
            nominal,
            modulus_thickness_n_per_m=float(np.exp(numbers[0])),
            slack_width_m=nominal.width_m * (1.0 + float(numbers[1])),
            cubic_ratio=float(np.exp(numbers[2])),
            mooney_share=float(numbers[3]) if with_mooney else nominal.mooney_share,
        )

    def residuals(numbers: Floats, used: Bools) -> Floats:
        return _residuals(model_at(numbers), pushes, nominal.width_m, used)

    used = np.ones(len(pushes), dtype=bool)
    for loss in ("soft_l1", "linear"):
        solved = least_squares(
            residuals,
            start[:size],
            args=(used,),
            bounds=(low[:size], high[:size]),
            loss=loss,
            x_scale=[1.0, 0.01, 0.3, 0.3][:size],
        )
        start[:size] = solved.x
        if loss == "soft_l1":
            off = np.abs(_residuals(model_at(solved.x), pushes, nominal.width_m, used, fold=True))
            used = off <= OUTLIER_SIGMAS * max(1.0, 1.4826 * float(np.median(off)))
            if used.sum() < 2 * size:
                raise SheetModelFitError(
                    f"{int((~used).sum())} of {len(pushes)} rows contradict the others: no model "
                    "fits them; check units and signs"
                )
    freedom = max(len(solved.fun) - size, 1)
    spread = max(1.0, float(solved.fun @ solved.fun) / freedom)
    information = solved.jac.T @ solved.jac
    if np.linalg.cond(information) > 1e14:
        raise SheetModelFitError(
            "the rows do not determine all parameters: push at several stretches and depths"
        )
    deviations = np.sqrt(np.diag(np.linalg.inv(information)) * spread)
    law = model_at(solved.x)
    values = (
        law.rubber.young_modulus_pa * law.rubber.thickness_m,
        law.rubber.width_m,
        law.cubic_ratio,
        law.rubber.mooney_share,
    )[:size]
    scale = (values[0], nominal.width_m, values[2], 1.0)[:size]
    stated = tuple(float(d) * one for d, one in zip(deviations, scale, strict=True))
    if deviations[0] > MAX_RELATIVE_DEVIATION or deviations[2] > 2.0 * MAX_RELATIVE_DEVIATION:
        at = 0 if deviations[0] > MAX_RELATIVE_DEVIATION else 2
        raise SheetModelFitError(
            f"{names[at]} is known to {100 * deviations[at]:.0f} % only: push at more stretches, "
            "and to greater depths"
        )
    ratio = _force_ratios(law, pushes, nominal.width_m)
    force = np.array([push.force_n for push in pushes])
    counted = used & (force > 3.0 * FORCE_NOISE_N)
    counted = counted if counted.any() else used
    return SheetModelFit(
        law=law,
        names=names,
        values=values,
        standard_deviations=stated,
        used=used,
        residual_ratio=ratio,
        rms_ratio=float(np.sqrt(np.mean(ratio[counted] ** 2))),
        worst_ratio=float(np.abs(ratio[counted]).max()),
    )


def _predict(
    law: SheetForceModel, pushes: Sequence[MeasuredPush], width_m: float
) -> tuple[Floats, Floats]:
    """Return the model's forces and edge forces (n,), N, with one call for pushes that differ in
    depth only."""
    forces, edges = np.empty(len(pushes)), np.empty(len(pushes))
    groups: dict[tuple[float, tuple[float, float], float], list[int]] = {}
    for number, push in enumerate(pushes):
        key = (push.edge_distance_m, push.position_m, push.finger_radius_m)
        groups.setdefault(key, []).append(number)
    for (distance, position, radius), numbers in groups.items():
        depths = np.array([pushes[number].depth_m for number in numbers])
        pressed = law.evaluate(
            distance / width_m, depths, position_m=position, finger_radius_m=radius
        )
        forces[numbers], edges[numbers] = pressed.force_n, pressed.edge_force_n
    return forces, edges


def _residuals(
    law: SheetForceModel,
    pushes: Sequence[MeasuredPush],
    width_m: float,
    used: Bools,
    *,
    fold: bool = False,
) -> Floats:
    """Return weighted residuals: the used rows' forces, then their edge forces; or, folded, the
    larger of the two for every row (n,)."""
    forces, edges = _predict(law, pushes, width_m)
    measured = np.array([push.force_n for push in pushes])
    pulled = np.array(
        [np.nan if push.edge_force_n is None else push.edge_force_n for push in pushes]
    )
    pressing = (forces - measured) / np.hypot(FORCE_NOISE_N, MODEL_ERROR_RATIO * measured)
    pulling = (edges - pulled) / np.hypot(EDGE_NOISE_N, MODEL_ERROR_RATIO * pulled)
    if fold:
        larger: Floats = np.fmax(np.abs(pressing), np.abs(pulling))
        return larger
    return np.concatenate([pressing[used], pulling[used & np.isfinite(pulled)]])


def _force_ratios(law: SheetForceModel, pushes: Sequence[MeasuredPush], width_m: float) -> Floats:
    """Return measured over fitted force, minus one (n,)."""
    forces, _ = _predict(law, pushes, width_m)
    measured = np.array([push.force_n for push in pushes])
    ratios: Floats = measured / np.maximum(forces, 1e-6) - 1.0
    return ratios


def tabulate_pushes(
    law: ScaledSheetModel, pushes: Sequence[MeasuredPush], used: Bools, nominal_width_m: float
) -> TabulatedSheetModel:
    """Tabulate the used rows over the model; SheetModelFitError unless they form a full grid.

    Stretches, x and y must occur in all combinations (positions by their distance from the centre).
    Depths may differ between them; they are interpolated to common depths that all rows cover.
    """
    cells: dict[tuple[float, float, float], list[tuple[float, float]]] = {}
    ratios = _force_ratios(law, pushes, nominal_width_m) + 1.0
    for push, ratio, good in zip(pushes, ratios, used, strict=True):
        key = (
            round(push.edge_distance_m / nominal_width_m, 4),
            round(abs(push.position_m[0]), 4),
            round(abs(push.position_m[1]), 4),
        )
        if good and push.force_n > 3.0 * FORCE_NOISE_N:
            cells.setdefault(key, []).append((push.depth_m, float(ratio)))
    axes = [sorted({key[number] for key in cells}) for number in range(3)]
    missing = [
        (s, x, y) for s in axes[0] for x in axes[1] for y in axes[2] if (s, x, y) not in cells
    ]
    if not cells or missing:
        what = f"no rows at stretch, x, y {missing[0]}" if missing else "no row is left"
        raise SheetModelFitError(f"{what}: a table needs every combination of stretch and position")
    shallowest = max(min(depth for depth, _ in rows) for rows in cells.values())
    deepest = min(max(depth for depth, _ in rows) for rows in cells.values())
    if not shallowest < deepest:
        raise SheetModelFitError(
            "a table needs depths that all stretches and positions have in common"
        )
    least = min(len({depth for depth, _ in rows}) for rows in cells.values())
    depths = np.geomspace(shallowest, deepest, max(2, min(least, 12)))
    entries = np.empty((len(axes[0]), len(depths), len(axes[1]), len(axes[2])))
    for (s, x, y), rows in cells.items():
        known = np.unique([depth for depth, _ in rows])
        means = [np.mean([r for depth, r in rows if depth == one]) for one in known]
        at = (axes[0].index(s), slice(None), axes[1].index(x), axes[2].index(y))
        entries[at] = np.interp(np.log(depths), np.log(known), means)
    return TabulatedSheetModel(
        law, np.array(axes[0]), depths, np.array(axes[1]), np.array(axes[2]), entries
    )
