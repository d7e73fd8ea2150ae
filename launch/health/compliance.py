"""Compute how accurately the sheet can render the force of the virtual object at each push depth.

The planner renders the force by moving the sheet along its normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.running.precompute import Progress, precompute_soft_body
from flexsheet.messages.scene import Scene
from flexsheet.nodes import cache
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.fem_solver.soft_body_factory import choose_method, load_body
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

SHOWN_FRACTIONS = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""The push depths that the report lists, as fractions of the maximum push depth."""


def compute_front_curve(scene: Scene, cache_dir: Path | None, progress: Progress) -> Floats:
    """Return the force of the object as a function of push depth, on the side that faces the user.

    The result is an array (n, 2). Each of the n rows contains a depth (m) and a force (N). The
    soft-body method of the scene is used. If no table is cached, the coarse table is computed in
    about a minute.

    cache_dir: folder of the cache. If None, the user's cache folder is used.
    """
    choice, folder = choose_method(scene), cache_dir or cache.default_cache_dir()
    precompute_soft_body(scene, choice, folder, progress)
    return load_body(scene, choice, folder, lambda *_: None).at_rest().force_curve


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


def compliance_result(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    *,
    delay_s: float,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Return the result of `flexsheet doctor --scene SCENE --json --compliance`.

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
