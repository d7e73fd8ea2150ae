"""Fit the clamped edges of the sheet on the flanges to measured points of the sheet.

Both arms hold the sheet in several poses. The measured joints give the poses of the edges as the
calibration of the arms predicts them. The sheet between them is a ruled surface that its weight
bends. The fit finds, for each arm, the displacement of the edge along the sheet's normal and its
rotation about the sheet's x axis. The points do not determine the other components, which only
displace the sheet in its own plane. The result makes arms and camera consistent at the sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import SheetSpec
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.planner.sheet_force import make_rubber

Floats = NDArray[np.float64]
Edges = tuple[Floats, Floats]

MIN_POSES, MIN_POINTS = 3, 50
"""Minimum number of poses of the sheet, and of points on each."""

MAX_RMS_M = 2e-3
"""Maximum root mean square of the residuals of poses that belong to the same arms."""


class EdgeFitError(FlexsheetError, ValueError):
    """Raised for points that do not determine the edges of the sheet."""

    code = "edge-fit"
    remedy = "Capture the patterns again, and record the joint angles of both arms in each pose."


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """Corrections (4, 4) of flange_from_edge, to be multiplied from the right, for left and right.

    shifts_m, rotations_rad: (left, right) displacement along the normal and rotation about x.
    standard_deviations: of the left and right shift (m), then of both rotations (rad), from the
    jackknife over poses. rms_m: distances of the points from the fitted sheet; held_out_rms_m: mean
    distance of the points of a pose that was excluded from the fit, rms over poses; before_rms_m:
    the same without corrections.
    """

    shifts_m: tuple[float, float]
    rotations_rad: tuple[float, float]
    standard_deviations: tuple[float, float, float, float]
    rms_m: float
    held_out_rms_m: float
    before_rms_m: float

    @property
    def corrections(self) -> Edges:
        left, right = (
            transform(rotation_from_vector([rotation_rad, 0.0, 0.0]), [0.0, 0.0, shift_m])
            for shift_m, rotation_rad in zip(self.shifts_m, self.rotations_rad, strict=True)
        )
        return left, right


def fit_edges(edges: Sequence[Edges], points: Sequence[Floats], sheet: SheetSpec) -> EdgeFit:
    """Fit both edges by linear least squares.

    edges: predicted world_from_edge (4, 4) of the left and right edge, for each pose. points:
    measured points (n, 3) on the sheet in the same poses. Raises EdgeFitError.
    """
    if len(edges) < MIN_POSES or min(len(one) for one in points) < MIN_POINTS:
        counts = ", ".join(str(len(one)) for one in points)
        raise EdgeFitError(
            f"{len(edges)} poses with {counts} points; at least {MIN_POSES} poses with "
            f"{MIN_POINTS} points each are required"
        )
    # All points of a pose share the errors of the arms, so that each pose has the same weight.
    rows = [
        (matrix / np.sqrt(len(heights)), heights / np.sqrt(len(heights)))
        for matrix, heights in (
            _linearize(*pair, one, sheet) for pair, one in zip(edges, points, strict=True)
        )
    ]

    def solve(chosen: Sequence[int]) -> Floats:
        matrix = np.concatenate([rows[i][0] for i in chosen])
        heights = np.concatenate([rows[i][1] for i in chosen])
        return np.asarray(np.linalg.lstsq(matrix, heights, rcond=None)[0])

    count = len(rows)
    solution = solve(range(count))
    without = np.array([solve([j for j in range(count) if j != i]) for i in range(count)])
    deviations = np.sqrt(
        (count - 1) / count * np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    )
    residuals = [heights - matrix @ solution for matrix, heights in rows]
    rms_m = float(np.sqrt(np.mean([one @ one for one in residuals])))
    if rms_m > MAX_RMS_M:
        worst = int(np.argmax([one @ one for one in residuals])) + 1
        raise EdgeFitError(
            f"the points are {1e3 * rms_m:.2f} mm rms from the sheet between the arms, at most "
            f"{1e3 * MAX_RMS_M:g} mm; largest in pose {worst}"
        )
    held_out = [
        np.sum(heights - matrix @ other) / np.sqrt(len(heights))
        for (matrix, heights), other in zip(rows, without, strict=True)
    ]
    before = [np.sum(heights) / np.sqrt(len(heights)) for _, heights in rows]
    left_m, right_m, left_rad, right_rad = solution.tolist()
    return EdgeFit(
        (left_m, right_m),
        (left_rad, right_rad),
        tuple(deviations.tolist()),
        rms_m,
        float(np.sqrt(np.mean(np.square(held_out)))),
        float(np.sqrt(np.mean(np.square(before)))),
    )


def _linearize(
    left: Floats, right: Floats, points: Floats, sheet: SheetSpec
) -> tuple[Floats, Floats]:
    """Return derivatives (n, 4) of the sheet's height at points, and their heights above it (n,).

    The derivatives are by the shifts of the left and right edge and by their rotations.
    """
    span = right[:3, 3] - left[:3, 3]
    distance_m = float(np.linalg.norm(span))
    x_axis = span / distance_m
    normal = np.cross(x_axis, left[:3, 1] + right[:3, 1])
    normal /= np.linalg.norm(normal)
    y_axis = np.cross(normal, x_axis)
    relative = points - left[:3, 3]
    across, along = relative @ x_axis / distance_m, relative @ y_axis
    left_slope, right_slope = (edge[:3, 1] @ normal for edge in (left, right))
    sag_m = compute_sag_m(
        make_rubber(sheet),
        normal,
        density_kg_per_m3=sheet.density_kg_per_m3,
        edge_distance_m=distance_m,
        across=across,
        along=along / sheet.height_m,
    )
    ruled_m = along * ((1.0 - across) * left_slope + across * right_slope)
    weights = np.column_stack([1.0 - across, across])
    return np.hstack([weights, along[:, None] * weights]), relative @ normal - ruled_m - sag_m
