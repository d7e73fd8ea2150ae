"""Select the skin nodes that are fixed by the support in a scene."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.scene import (
    BaseSupport,
    BoxPatchSupport,
    SpherePatchSupport,
    StripSupport,
    Support,
)
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.fem_solver.mesh.solid import UnfitMeshError

TOLERANCE_M = 1e-9


def select_fixed(
    support: Support, points: Floats, normals: Floats, *, towards_user: Floats, down: Floats
) -> Bools:
    """Return whether the support fixes each skin point, as an array (n,).

    All vectors are in the object frame. points (n, 3): skin points, m. normals (n, 3): outward unit
    normals at the points. towards_user (3,): unit vector to the user. down (3,): downward vector of
    any length, for a base support. Raises UnfitMeshError if all fixed points are collinear.
    """
    chosen: Bools
    match support:
        case StripSupport():
            if support.angle_rad >= 2.0 * np.pi:
                raise UnfitMeshError(
                    f"object.support.angle_rad: {support.angle_rad:g} must be less than 2 pi, "
                    "because a full strip leaves no touchable skin; reduce the angle"
                )
            away = np.arccos(np.clip(-(normals @ towards_user), -1.0, 1.0))
            chosen = np.asarray(away <= 0.5 * support.angle_rad + 1e-9)
        case BaseSupport():
            height = points @ (-down / np.linalg.norm(down))
            chosen = np.asarray(height <= height.min() + support.height_m + TOLERANCE_M)
        case SpherePatchSupport():
            away = np.linalg.norm(points - support.centre_m, axis=1)
            chosen = np.asarray(away <= support.radius_m + TOLERANCE_M)
        case BoxPatchSupport():
            inside = (points >= support.min_m - TOLERANCE_M) & (
                points <= support.max_m + TOLERANCE_M
            )
            chosen = np.asarray(inside.all(axis=1))
    require_fixation(support.kind, points, chosen)
    return chosen


def require_fixation(kind: str, points: Floats, chosen: Bools) -> None:
    """Raise UnfitMeshError if all fixed points are collinear, because the body could rotate freely.

    kind: kind of the support. points (n, 3): skin points, m. chosen (n,): whether each point is
    fixed.
    """
    some = points[chosen]
    extent = float(np.ptp(points, axis=0).max())
    if len(some) >= 3:
        spread = np.linalg.svd(some - some.mean(axis=0), compute_uv=False)
        if spread[1] > 1e-3 * extent:
            return
    raise UnfitMeshError(
        f"object.support: the support of the kind {kind} fixes {len(some)} of {len(points)} skin "
        "nodes, but at least three nodes that are not collinear are required; enlarge the support "
        "or reduce skin_spacing_m"
    )
