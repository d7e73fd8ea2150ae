"""Compute how accurately the sheet can render the force of the virtual object at each push depth.

The planner renders the force by moving the sheet along its normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.units import format_percent
from flexsheet.nodes import cache
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.fem_solver.soft_body_factory import (
    SoftBodyFactory,
    choose_method,
)
from flexsheet.nodes.models.hand_loop import OffsetBounds, OffsetBoundsTable
from flexsheet.nodes.models.sheet.force_models import SheetForceModel
from flexsheet.nodes.planner.compliance import (
    TARGET_ERROR_RATIO,
    WEBER_RATIO,
    WEBER_RATIO_BARE,
    Compliance,
    ObjectCurve,
    compute_force_uncertainty_ratio,
    fit_compliance,
    make_stretch_limits,
)
from flexsheet.nodes.planner.hand_bounds import load_or_compute_bounds

SKIN_SPACING_M = 0.0045
LINEAR_DEPTH_M, MAX_DEPTH_M = 0.006, 0.010
SHOWN_FRACTIONS = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""The push depths that the report lists, as fractions of the maximum push depth."""


class ForceCurveStage(StrEnum):
    """A stage of the computation of an object's force curve, as a text for the user."""

    LINEAR = "computing the linear model of the soft object (only once)"
    TABLE = "computing the nonlinear table of the soft object from simulated pushes (only once)"


CurveProgress = Callable[[ForceCurveStage, int, int], None]
"""A function that is called with the stage, and the numbers of its finished and of all steps."""


def compute_front_curve(
    scene: Scene,
    cache_dir: Path | None = None,
    *,
    on_progress: CurveProgress = lambda stage, done, total: None,
    on_linear: Callable[[Floats], None] = lambda curve: None,
) -> Floats:
    """Return the force of the object as a function of push depth, on the side that faces the user.

    The result is an array (n, 2). Each of the n rows contains a depth (m) and a force (N). The
    linear soft-body method is used only if the scene chooses it. Otherwise, the nonlinear table of
    the object is used. If this table is not cached, its computation takes minutes.

    cache_dir: folder of the cache. If None, the user's cache folder is used.
    on_linear: function that is called with the force curve of the linear method, (n, 2), before
        the nonlinear table is computed.
    """
    factory = SoftBodyFactory(
        skin_spacing_m=SKIN_SPACING_M,
        linear_depth_m=LINEAR_DEPTH_M,
        max_depth_m=MAX_DEPTH_M,
        friction_ratio=0.0,
        cache_dir=cache_dir or cache.default_cache_dir(),
        workers=0,
    )
    method, _ = choose_method(scene, "auto", SKIN_SPACING_M, compute_table=True)

    def report(stage: ForceCurveStage, done: int, total: int, need: str) -> None:
        on_progress(stage, done, total)

    best, *_ = factory.bodies(scene, method, partial(report, ForceCurveStage.LINEAR))
    if method != "linear" and best.method.name == "linear":
        on_linear(best.at_rest().force_curve)
        best = factory.build_table(scene, best, partial(report, ForceCurveStage.TABLE))
    return best.at_rest().force_curve


def compute_compliance(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    *,
    max_depth_m: float | None = None,
    bounds: OffsetBounds | None = None,
) -> Compliance:
    """Compute the compliance: the offsets along the sheet's normal that render the object's force.

    law: force model of the sheet.
    curve: force of the object as a function of push depth.
    max_depth_m: maximum push depth. If None, the depth in the scene is used.
    bounds: limits of the offset within which the control loop of sheet and hand is stable. If None,
        the offset is not limited.
    """
    limits = make_stretch_limits(scene.sheet, law, bounds)
    return fit_compliance(curve, law, limits, scene, max_depth_m=max_depth_m)


class LoopRisk(StrEnum):
    """The risk that the control loop of sheet and hand is unstable or renders a wrong force.

    OSCILLATION: a hand of low damping can oscillate, because the sheet follows the finger too late.
    DELAY: the sheet cannot render the object's force within the stability limits that result from
        the delay.
    SHEET: the sheet cannot render the object's force, even if there is no delay.
    """

    OSCILLATION = "oscillation"
    DELAY = "delay"
    SHEET = "sheet"


@dataclass(frozen=True, slots=True)
class LoopFinding:
    """A risk in the control loop of sheet and hand, found by `find_loop_risk`.

    delay_s: time from the measurement of a push depth until the sheet has moved.
    error_ratio: maximum relative error of the rendered force if the sheet moves only as far as the
        loop is stable.
    """

    risk: LoopRisk
    delay_s: float
    error_ratio: float

    def describe(self) -> str:
        """Return a text that explains what can go wrong in the control loop, and a remedy."""
        delay_ms, error_percent = 1e3 * self.delay_s, 100.0 * self.error_ratio
        match self.risk:
            case LoopRisk.OSCILLATION:
                return (
                    f"a hand of low damping can oscillate, because the sheet follows the finger "
                    f"with a delay of {delay_ms:.0f} ms; reduce "
                    "the delay or use a stiffer object"
                )
            case LoopRisk.DELAY:
                return (
                    f"at a delay of {delay_ms:.0f} ms, the force of the object is rendered with an "
                    f"error of {error_percent:.0f} %; reduce the delay or use a softer object"
                )
            case LoopRisk.SHEET:
                return (
                    "the sheet cannot render the force of the object: the error is "
                    f"{error_percent:.0f} %; use another sheet or object"
                )


def find_loop_risk(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    table: OffsetBoundsTable,
    delay_s: float,
) -> LoopFinding | None:
    """Return the risk that the sheet oscillates or renders a wrong force at a given delay.

    Return None if there is no risk. Sheet and hand form a control loop, which a delay destabilizes.

    law: force model of the sheet.
    curve: force of the object as a function of push depth.
    table: limits of the sheet's offset, by delay. Within these limits, the control loop is stable.
    delay_s: time from the measurement of a push depth until the sheet has moved.
    """
    bounded = compute_compliance(scene, law, curve, bounds=table.at_delay(delay_s))
    error_ratio = float(np.abs(bounded.centre.error_ratio).max())
    if not bounded.choose_bandwidth_rad_per_s()[1]:
        return LoopFinding(LoopRisk.OSCILLATION, delay_s, error_ratio)
    if error_ratio <= TARGET_ERROR_RATIO:
        return None
    free = compute_compliance(scene, law, curve)
    by_sheet = float(np.abs(free.centre.error_ratio).max()) > TARGET_ERROR_RATIO
    return LoopFinding(LoopRisk.SHEET if by_sheet else LoopRisk.DELAY, delay_s, error_ratio)


def describe_estimate(scene: Scene, law: SheetForceModel, curve: Floats) -> str:
    """Return a text with the rendering error for the linear model of the object, as an estimate.

    law: force model of the sheet.
    curve: force of the linear model as a function of push depth, rows of depth (m) and force (N).
    """
    shown = compute_compliance(scene, law, ObjectCurve.from_rows(curve))
    error = float(np.abs(shown.centre.error_ratio).max())
    return (
        f"estimate by the linear model: maximum rendering error {format_percent(error)} at depths "
        f"to {1e3 * shown.max_depth_m:.0f} mm, without delay; the nonlinear table, which takes "
        "minutes, gives the result"
    )


def compliance_result(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    *,
    delay_s: float,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Return the result of `flexsheet doctor scene --json --compliance`.

    law: force model of the sheet.
    curve: force of the object as a function of push depth.
    delay_s: time from the measurement of a push depth until the sheet has moved.
    progress: function that receives a text before a computation.
    """
    table = load_or_compute_bounds(scene.camera.rate_hz, None, progress)
    shown = compute_compliance(scene, law, curve, bounds=table.at_delay(delay_s))
    bandwidth, stable = shown.choose_bandwidth_rad_per_s()
    finding = find_loop_risk(scene, law, curve, table, delay_s)
    # `shown.note` already describes what the sheet itself cannot render.
    by_loop = finding is not None and finding.risk is not LoopRisk.SHEET
    loop_note = finding.describe() if finding is not None and by_loop else ""
    depths = shown.max_depth_m * np.array(SHOWN_FRACTIONS)
    target, rendered = curve.force_n(depths), shown.rendered_force_n(depths)
    offsets = shown.normal_offset_m(depths)
    rows = [
        {
            "depth_mm": 1e3 * float(depth),
            "target_n": float(target_n),
            "rendered_n": float(rendered_n),
            "normal_offset_mm": 1e3 * float(offset_m),
        }
        for depth, target_n, rendered_n, offset_m in zip(
            depths, target, rendered, offsets, strict=True
        )
    ]
    return {
        "scene": scene.name,
        "force_model": law.name,
        "stretch_ratio": shown.stretch_ratio,
        "max_edge_force_n": float(shown.centre.edge_force_n.max()),
        "advance_per_depth": shown.centre.advance_per_depth,
        "worst_error_ratio": float(np.abs(shown.centre.error_ratio).max()),
        "target_error_ratio": TARGET_ERROR_RATIO,
        "weber_ratio": [WEBER_RATIO, WEBER_RATIO_BARE],
        "force_change_by_position_ratio": compute_force_uncertainty_ratio(
            shown.centre, scene.tolerances.sheet_position_m
        ),
        "delay_ms": 1e3 * delay_s,
        "filter_bandwidth_rad_per_s": bandwidth,
        "stable_for_every_hand": stable,
        "risk": None if finding is None else finding.risk,
        "note": "; ".join(filter(None, (shown.note, loop_note))),
        "rows": rows,
    }
