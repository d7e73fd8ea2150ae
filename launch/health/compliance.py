"""Compute how well the sheet of a scene can render its object's force at each push depth.

The planner does so by moving the sheet along its normal, so that the finger feels the force.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes import cache
from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory
from flexsheet.nodes.models.hand_loop import OffsetBounds
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

Floats = NDArray[np.float64]

SKIN_SPACING_M = 0.0045
LINEAR_DEPTH_M, MAX_DEPTH_M = 0.006, 0.010
SHOWN_FRACTIONS = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Push depths in the report, as fractions of the maximum push depth."""


def compute_front_curve(scene: Scene, cache_dir: Path | None = None) -> Floats:
    """Return the object's force over depth (n, 2), m and N, on the side that faces the user.

    The cached nonlinear table of the object is used if it exists. Otherwise the linear method is
    used, and computed if necessary. cache_dir: None for the user's cache folder.
    """
    factory = SoftBodyFactory(
        skin_spacing_m=SKIN_SPACING_M,
        linear_depth_m=LINEAR_DEPTH_M,
        max_depth_m=MAX_DEPTH_M,
        friction_ratio=0.0,
        cache_dir=cache_dir or cache.default_cache_dir(),
        workers=0,
    )
    best, *_ = factory.bodies(scene, "auto", lambda done, total, need: None)
    return best.at_rest().force_curve


def compute_compliance(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    *,
    max_depth_m: float | None = None,
    bounds: OffsetBounds | None = None,
) -> Compliance:
    """Compute the sheet offsets by which the planner renders the object's force.

    max_depth_m: maximum push depth; None for the scene's. bounds: limits that keep the loop of
    sheet and hand stable.
    """
    return fit_compliance(
        curve,
        law,
        make_stretch_limits(scene.sheet, law, bounds),
        max_depth_m=scene.working_range.push_depth_m if max_depth_m is None else max_depth_m,
        finger_radius_m=scene.finger.radius_m,
        usable_half_height_m=scene.sheet.usable_half_height_m,
        position_error_m=scene.tolerances.sheet_position_m,
    )


def compliance_result(
    scene: Scene,
    law: SheetForceModel,
    curve: ObjectCurve,
    *,
    delay_s: float,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the result of `flexsheet doctor compliance --json`.

    delay_s: time from a measured depth until the sheet has moved accordingly.
    """
    table = load_or_compute_bounds(scene.camera.rate_hz, cache_dir)
    shown = compute_compliance(scene, law, curve, bounds=table.at_delay(delay_s))
    filter_s, stable = shown.choose_filter_s()
    unstable_note = (
        ""
        if stable
        else f"a hand of low damping can oscillate at a delay of {1e3 * delay_s:.0f} ms; reduce "
        "the delay or use a stiffer object"
    )
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
        "filter_ms": 1e3 * filter_s,
        "stable_for_every_hand": stable,
        "note": "; ".join(filter(None, (shown.note, unstable_note))),
        "rows": rows,
    }
