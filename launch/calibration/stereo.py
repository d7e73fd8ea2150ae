"""Calibrate a stereo camera (rig) from images of a calibration board.

The lens model is a pinhole with the distortion coefficients k1, k2, p1, p2. The coefficient k3 is
fixed to 0, because images of boards that do not fill the image do not determine k2 and k3
separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from flexsheet.launch.calibration.bundle import (
    LEFT,
    PARAMETERS,
    RIGHT,
    NotDeterminedError,
    RigFit,
    pose_transform,
)
from flexsheet.launch.calibration.corners import (
    BoardPair,
    Progress,
    board_points,
    compute_digest,
    find_pairs,
    ignore_progress,
)
from flexsheet.launch.calibration.selection import (
    PairSelection,
    fit_selection,
    make_undetermined_error,
)
from flexsheet.launch.calibration.uncertainty import (
    compute_jackknife_covariance,
    compute_position_jacobian,
    compute_position_std,
    compute_right_from_left,
    sample_working_plane,
)
from flexsheet.messages.calibration import Board, PairResidual, StereoCalibration, Uncertainty
from flexsheet.messages.scene import Lens
from flexsheet.nodes.arrays import Floats

MAX_DEPTH_ERROR_FRACTION = 0.05
"""The maximum standard deviation of depth in a valid calibration.

The value is a fraction of the working distance.
"""


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A stereo calibration with the data that its report shows.

    pairs: board corners of each used pair, by the index of the pair among all pairs.
    size: width and height of the images, px.
    """

    calibration: StereoCalibration
    fit: RigFit
    pairs: dict[int, BoardPair]
    size: tuple[int, int]


def calibrate_stereo(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: Board,
    device: str,
    working_distance_m: float | None = None,
    progress: Progress = ignore_progress,
) -> CalibrationResult:
    """Calibrate a stereo camera from pairs of images of a board.

    A pair is excluded if it does not show the board, or if it repeats the board pose of another
    pair. It is also excluded if it contradicts the other pairs (`compute_misfits`), or if its
    residual exceeds both half a pixel and three times the median. A corner is excluded if its
    residual exceeds six standard deviations. The result contains the reason for each excluded pair.

    working_distance_m: distance from the camera for which the uncertainty is computed. If None, the
        median distance of the boards is used.

    Raises CalibrationError if images cannot be used, if fewer than MIN_PAIRS pairs remain, or if
    the pairs do not determine the rig.
    """
    found, size = find_pairs(left_paths, right_paths, board, progress)
    selection = PairSelection(found, [path.name for path in left_paths])
    points = board_points(board)
    fit = fit_selection(selection, points, size)
    try:
        uncertainty = compute_uncertainty(
            fit,
            selection.pairs(),
            points,
            size=size,
            distance_m=working_distance_m,
            progress=progress,
        )
    except NotDeterminedError as error:
        raise make_undetermined_error(len(selection.good), str(error)) from error
    if uncertainty.depth_std_m > MAX_DEPTH_ERROR_FRACTION * uncertainty.working_distance_m:
        reason = (
            f"depth at {1e3 * uncertainty.working_distance_m:.0f} mm is uncertain by "
            f"{1e3 * uncertainty.depth_std_m:.0f} mm"
        )
        raise make_undetermined_error(len(selection.good), reason)
    residuals = selection.residuals
    calibration = StereoCalibration(
        device=device,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        code_version=version("flexsheet"),
        opencv_version=cv2.__version__,
        width_px=size[0],
        height_px=size[1],
        left=make_lens(fit.rig[LEFT]),
        right=make_lens(fit.rig[RIGHT]),
        right_from_left=compute_right_from_left(fit.rig),
        board=board,
        reprojection_rms_px=fit.rms_px(),
        uncertainty=uncertainty,
        pairs=tuple(
            PairResidual(
                left=left_path.name,
                right=right_path.name,
                used=i in selection.good,
                reason=selection.reasons.get(i, ""),
                left_rms_px=float(residuals[i][0]) if i in residuals else None,
                right_rms_px=float(residuals[i][1]) if i in residuals else None,
                stray_corners=selection.stray_corners(i),
                digest=compute_digest(left_path, right_path),
            )
            for i, (left_path, right_path) in enumerate(zip(left_paths, right_paths, strict=True))
        ),
    )
    return CalibrationResult(calibration, fit, selection.good, size)


def compute_uncertainty(
    fit: RigFit,
    pairs: Sequence[BoardPair],
    points: Floats,
    *,
    size: tuple[int, int],
    distance_m: float | None,
    progress: Progress = ignore_progress,
) -> Uncertainty:
    """Compute the covariance of a rig's parameters, and the uncertainty of a measured fingertip.

    If the results of jackknife refits scatter more than the covariance of the fit predicts, the
    covariance is increased accordingly.

    points: corners of the board (n, 3), m.
    size: width and height of the images, px.
    distance_m: distance of the fingertip from the camera. If None, the median distance of the
        boards is used.
    """
    if distance_m is None:
        middles = [pose_transform(pose) @ [*points.mean(axis=0), 1.0] for pose in fit.poses]
        distance_m = float(np.median([middle[2] for middle in middles]))
    slopes = compute_position_jacobian(fit.rig, sample_working_plane(fit.rig, size, distance_m))
    refits = compute_jackknife_covariance(fit, pairs, points, progress)
    stated = float(np.hypot(*compute_position_std(slopes, fit.covariance)))
    ratio = float(np.hypot(*compute_position_std(slopes, refits))) / stated
    covariance = fit.covariance * max(1.0, ratio) ** 2
    depth_m, lateral_m = compute_position_std(slopes, covariance)
    return Uncertainty(
        corner_sigma_px=fit.sigma_px,
        jackknife_ratio=ratio,
        working_distance_m=distance_m,
        depth_std_m=depth_m,
        lateral_std_m=lateral_m,
        parameters=PARAMETERS,
        covariance=covariance,
    )


def make_lens(numbers: Floats) -> Lens:
    """Make a lens from the numbers fx, fy, cx, cy (px), k1, k2, p1 and p2."""
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(number) for number in numbers)
    return Lens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=(k1, k2, p1, p2, 0.0))
