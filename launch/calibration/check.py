"""Evaluate a stereo calibration by measuring a board of known size.

Errors are underestimated on image pairs that were used to calibrate. Therefore, `check_stereo`
names such pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flexsheet.launch.calibration.bundle import LEFT, RIGHT, STAND, lens_arrays, pose_transform
from flexsheet.launch.calibration.corners import (
    BoardPair,
    CalibrationError,
    Progress,
    board_points,
    compute_digest,
    find_pairs,
    ignore_progress,
)
from flexsheet.messages.calibration import Board, StereoCalibration
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.camera import camera_matrix


@dataclass(frozen=True, slots=True)
class StereoRig:
    """The parameters of a stereo camera in the form that OpenCV uses.

    matrices: camera matrices (3, 3), in px, of the left and right camera.
    distortions: distortion coefficients (5,) of the left and right camera.
    right_from_left: transform (4, 4) from the left to the right camera's frame.
    """

    matrices: tuple[Floats, Floats]
    distortions: tuple[Floats, Floats]
    right_from_left: Floats

    @staticmethod
    def from_fit(numbers: Floats) -> StereoRig:
        """Make the stereo rig from the 22 fitted parameters (`PARAMETERS`)."""
        left, right = lens_arrays(numbers[LEFT]), lens_arrays(numbers[RIGHT])
        return StereoRig((left[0], right[0]), (left[1], right[1]), pose_transform(numbers[STAND]))

    @staticmethod
    def from_calibration(calibration: StereoCalibration) -> StereoRig:
        """Make the stereo rig from a stored stereo calibration."""
        left, right = (
            camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
            for lens in (calibration.left, calibration.right)
        )
        distortions = np.array(calibration.left.distortion), np.array(calibration.right.distortion)
        return StereoRig((left, right), distortions, calibration.right_from_left)


@dataclass(frozen=True, slots=True)
class BoardMeasurement:
    """The errors of a calibration board's corners, as measured with a stereo camera.

    squares_m: errors (m) of the distances between neighbouring corners.
    diagonals_m: errors (m) of the lengths of the diagonals.
    rigid_fit_m: distances (m) of the measured corners from the board fitted to them.
    reprojection_px: distances (px) of the detected corners from the projected corners.
    """

    squares_m: Floats
    diagonals_m: Floats
    rigid_fit_m: Floats
    reprojection_px: Floats
    distance_m: float


def triangulate_corners(rig: StereoRig, left: Floats, right: Floats) -> Floats:
    """Triangulate n points from their pixel positions (n, 2) in both images by the linear method.

    Return the points (n, 3), in m, in the left camera's frame.
    """
    normalized = [
        cv2.undistortPoints(pixels[:, None], matrix, distortion)[:, 0].T
        for pixels, matrix, distortion in zip(
            (left, right), rig.matrices, rig.distortions, strict=True
        )
    ]
    points = cv2.triangulatePoints(np.eye(3, 4), rig.right_from_left[:3], *normalized)
    return np.asarray((points[:3] / points[3]).T, dtype=np.float64)


def compute_rigid_residuals(points: Floats, model: Floats) -> Floats:
    """Return the distances (n,) between n measured points and n model points after rigid alignment.

    points, model: measured points and model points (n, 3).

    Source: Kabsch, A solution for the best rotation to relate two sets of vectors (1976).
    """
    centred, reference = points - points.mean(axis=0), model - model.mean(axis=0)
    u, _, vt = np.linalg.svd(reference.T @ centred)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(np.linalg.norm(reference @ (u @ handed @ vt) - centred, axis=1))


def measure_board(rig: StereoRig, pair: BoardPair, board: Board) -> BoardMeasurement:
    """Triangulate the corners that both images show, and compare them with the known board."""
    ids, left, right = pair.common()
    points = triangulate_corners(rig, left, right)
    row = {int(corner): number for number, corner in enumerate(ids)}
    squares, diagonals = [], []
    for corner, here in row.items():
        column = corner % board.columns
        for step, within in ((1, column + 1 < board.columns), (board.columns, True)):
            there = row.get(corner + step)
            if within and there is not None:
                squares.append(np.linalg.norm(points[there] - points[here]) - board.square_m)
    last = board.columns * board.rows - 1
    length_m = board.square_m * float(np.hypot(board.columns - 1, board.rows - 1))
    for ends in ((0, last), (board.columns - 1, last - board.columns + 1)):
        if ends[0] in row and ends[1] in row:
            span = points[row[ends[1]]] - points[row[ends[0]]]
            diagonals.append(np.linalg.norm(span) - length_m)
    return BoardMeasurement(
        squares_m=np.array(squares),
        diagonals_m=np.array(diagonals),
        rigid_fit_m=compute_rigid_residuals(points, board_points(board)[ids]),
        reprojection_px=_measure_reprojection(rig, left, right, points),
        distance_m=float(np.median(points[:, 2])),
    )


def _measure_reprojection(rig: StereoRig, left: Floats, right: Floats, points: Floats) -> Floats:
    """Return the distances (2n,), in px, between n detected corners and their projected points.

    The n distances in the left image precede the n distances in the right image.

    left, right: detected corners (n, 2), px.
    points: triangulated points (n, 3), in m, in the left camera's frame.
    """
    distances = []
    stands = (np.eye(4), rig.right_from_left)
    for pixels, matrix, distortion, stand in zip(
        (left, right), rig.matrices, rig.distortions, stands, strict=True
    ):
        rotation, _ = cv2.Rodrigues(stand[:3, :3])
        projected = cv2.projectPoints(points, rotation, stand[:3, 3], matrix, distortion)[0][:, 0]
        distances.append(np.linalg.norm(projected - pixels, axis=1))
    return np.concatenate(distances)


def _rms(values: Floats) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _rms_mm(values_m: Floats) -> float | None:
    return _rms(1e3 * values_m)


def summarize(boards: Sequence[BoardMeasurement]) -> dict[str, float | int | None]:
    """Return the root mean squares of the errors of all measured boards.

    square_rms_mm: error of the distances between neighbouring corners.
    diagonal_rms_mm: error of the lengths of the board's diagonals.
    rigid_fit_rms_mm: distance of the corners from the board after a rigid fit.
    reprojection_rms_px: distance of the detected corners from the projected corners.
    """
    return {
        "pairs": len(boards),
        "square_rms_mm": _rms_mm(np.concatenate([one.squares_m for one in boards])),
        "diagonal_rms_mm": _rms_mm(np.concatenate([one.diagonals_m for one in boards])),
        "rigid_fit_rms_mm": _rms_mm(np.concatenate([one.rigid_fit_m for one in boards])),
        "reprojection_rms_px": _rms(np.concatenate([one.reprojection_px for one in boards])),
        "distance_m": float(np.median([one.distance_m for one in boards])),
    }


def check_stereo(
    calibration: StereoCalibration,
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: Board,
    progress: Progress = ignore_progress,
) -> dict[str, float | int | list[str] | None]:
    """Evaluate a stereo calibration with images of a board that were not used to calibrate.

    Return the rms errors (see `summarize`) and a list `used_to_calibrate`. The list names each left
    image whose pair was also used to calibrate. The errors of such pairs are underestimated.

    Raises CalibrationError if the images have a wrong size or if no pair shows the board.
    """
    found, size = find_pairs(left_paths, right_paths, board, progress)
    if size != (calibration.width_px, calibration.height_px):
        raise CalibrationError(
            f"the images have {size[0]}x{size[1]} px, but the calibration of {calibration.device} "
            f"is for {calibration.width_px}x{calibration.height_px} px; use images of that size"
        )
    pairs = [pair for pair in found if isinstance(pair, BoardPair)]
    if not pairs:
        raise CalibrationError(
            f"none of the {len(found)} image pairs is usable (first pair: {found[0]}); capture "
            "images with the board in both views"
        )
    used = {pair.digest for pair in calibration.pairs if pair.used}
    reused = [
        left.name
        for left, right in zip(left_paths, right_paths, strict=True)
        if compute_digest(left, right) in used
    ]
    rig = StereoRig.from_calibration(calibration)
    return {
        **summarize([measure_board(rig, pair, board) for pair in pairs]),
        "used_to_calibrate": reused,
    }
