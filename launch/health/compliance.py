"""Whether a scene's sheet can present its object: the object's force over depth, and what fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.nodes import cache
from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory
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

Floats = NDArray[np.float64]

SKIN_SPACING_M = 0.0045
LINEAR_DEPTH_M, MAX_DEPTH_M = 0.006, 0.010
SHOWN_SHARES = (0.04, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Reported depths, as fractions of the maximum push depth."""


def front_curve(scene: Scene, cache_dir: Path | None = None) -> Floats:
    """The object's force over depth (n, 2), m and N, where it faces the user: by the nonlinear
    table if that is kept for this object, else by the linear method, which is worked out if it is
    not kept.  cache_dir: None: the user's."""
    maker = SoftBodyFactory(
        skin_spacing_m=SKIN_SPACING_M,
        linear_depth_m=LINEAR_DEPTH_M,
        max_depth_m=MAX_DEPTH_M,
        friction_ratio=0.0,
        cache_dir=cache_dir or cache.default_cache_dir(),
        workers=0,
    )
    best, *_ = maker.bodies(scene, "auto", lambda done, total, need: None)
    return best.at_rest().force_curve


def scene_compliance(
    scene: Scene, law: SheetForceModel, curve: ObjectCurve, *, max_depth_m: float | None = None
) -> Compliance:
    """What the planner presents; max_depth_m: of the push, else the scene's."""
    return fit_compliance(
        curve,
        law,
        make_stretch_limits(scene.sheet, law),
        max_depth_m=scene.working_range.push_depth_m if max_depth_m is None else max_depth_m,
        finger_radius_m=scene.finger.radius_m,
        usable_half_height_m=scene.sheet.usable_half_height_m,
        position_error_m=scene.tolerances.sheet_position_m,
    )


def compliance_result(scene: Scene, law: SheetForceModel, curve: ObjectCurve) -> dict[str, Any]:
    """What `flexsheet doctor compliance --json` prints."""
    shown = scene_compliance(scene, law, curve)
    depths = shown.max_depth_m * np.array(SHOWN_SHARES)
    wanted, presented = curve.force_n(depths), shown.rendered_force_n(depths)
    retreat = shown.normal_offset_m(depths)
    rows = [
        {
            "depth_mm": 1e3 * float(depth),
            "wanted_n": float(want),
            "presented_n": float(force),
            "retreat_mm": 1e3 * float(back),
        }
        for depth, want, force, back in zip(depths, wanted, presented, retreat, strict=True)
    ]
    return {
        "scene": scene.name,
        "law": law.name,
        "stretch_ratio": shown.stretch_ratio,
        "largest_edge_force_n": float(shown.centre.edge_force_n.max()),
        "advance_per_depth": shown.centre.advance_per_depth,
        "worst_error_ratio": float(np.abs(shown.centre.error_ratio).max()),
        "aimed_ratio": TARGET_ERROR_RATIO,
        "weber_ratio": [WEBER_RATIO, WEBER_RATIO_BARE],
        "force_change_by_place_ratio": compute_force_uncertainty_ratio(
            shown.centre, scene.tolerances.sheet_position_m
        ),
        "note": shown.note,
        "rows": rows,
    }
