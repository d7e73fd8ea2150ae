"""Evaluate a calibration by measuring a board of known size.

Pairs that made the calibration give too small errors.  `check_stereo` is therefore for other pairs,
and `cross_check` leaves each pair out in turn and measures it with the calibration of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.bundle import (
    LEFT,
    RIGHT,
    STAND,
    floats,
    lens_arrays,
    pose_transform,
)
from flexsheet.launch.calibration.corners import (
    BoardPair,
    BoardView,
    CalibrationError,
    Progress,
    board_points,
    compute_digest,
    find_pairs,
    ignore_progress,
    read_gray,
    same_order,
)
from flexsheet.launch.calibration.selection import MIN_PAIRS, PairSelection, fit_selection
from flexsheet.messages.calibration import Board, StereoCalibration

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StereoRig:
    """Hold a rig in OpenCV's form: matrices (3, 3), distortions (5,), a transform (4, 4)."""

    matrices: tuple[Floats, Floats]
    distortions: tuple[Floats, Floats]
    right_from_left: Floats

    @staticmethod
    def of(numbers: Floats) -> StereoRig:
        """Make it from the 22 numbers of a fit."""
        left, right = lens_arrays(numbers[LEFT]), lens_arrays(numbers[RIGHT])
        return StereoRig((left[0], right[0]), (left[1], right[1]), pose_transform(numbers[STAND]))

    @staticmethod
    def calibrated(calibration: StereoCalibration) -> StereoRig:
        """Make it from a calibration file."""
        left, right = (
            np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
            for lens in (calibration.left, calibration.right)
        )
        distortions = np.array(calibration.left.distortion), np.array(calibration.right.distortion)
        return StereoRig((left, right), distortions, calibration.right_from_left)


@dataclass(frozen=True, slots=True)
class BoardMeasurement:
    """Hold a board as measured by a rig: errors in m and px, each array of any length."""

    squares_m: Floats
    diagonals_m: Floats
    rigid_fit_m: Floats
    reprojection_px: Floats
    distance_m: float


def triangulate_corners(rig: StereoRig, left: Floats, right: Floats) -> Floats:
    """Triangulate pixels (n, 2) into points (n, 3) in the left camera's frame, m: undistorted,
    linear."""
    normalized = [
        cv2.undistortPoints(pixels[:, None], matrix, distortion)[:, 0].T
        for pixels, matrix, distortion in zip(
            (left, right), rig.matrices, rig.distortions, strict=True
        )
    ]
    points = cv2.triangulatePoints(np.eye(3, 4), rig.right_from_left[:3], *normalized)
    return np.asarray((points[:3] / points[3]).T, dtype=np.float64)


def rigid_fit_residuals(points: Floats, model: Floats) -> Floats:
    """Return distances (n,) left after the best rigid motion of `model` (n, 3) onto `points` (n,
    3).

    Source: Kabsch, A solution for the best rotation to relate two sets of vectors (1976).
    """
    centred, reference = points - points.mean(axis=0), model - model.mean(axis=0)
    u, _, vt = np.linalg.svd(reference.T @ centred)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(np.linalg.norm(reference @ (u @ handed @ vt) - centred, axis=1))


def measure_board(rig: StereoRig, pair: BoardPair, board: Board) -> BoardMeasurement:
    """Measure the corners that both views of a pair show."""
    ids, left, right = pair.common()
    points = triangulate_corners(rig, left, right)
    place = {int(corner): number for number, corner in enumerate(ids)}
    squares, diagonals = [], []
    for corner, here in place.items():
        column = corner % board.columns
        for step, within in ((1, column + 1 < board.columns), (board.columns, True)):
            there = place.get(corner + step)
            if within and there is not None:
                squares.append(np.linalg.norm(points[there] - points[here]) - board.square_m)
    last = board.columns * board.rows - 1
    length_m = board.square_m * float(np.hypot(board.columns - 1, board.rows - 1))
    for ends in ((0, last), (board.columns - 1, last - board.columns + 1)):
        if ends[0] in place and ends[1] in place:
            span = points[place[ends[1]]] - points[place[ends[0]]]
            diagonals.append(np.linalg.norm(span) - length_m)
    return BoardMeasurement(
        squares_m=np.array(squares),
        diagonals_m=np.array(diagonals),
        rigid_fit_m=rigid_fit_residuals(points, board_points(board)[ids]),
        reprojection_px=_reprojection(rig, left, right, points),
        distance_m=float(np.median(points[:, 2])),
    )


def _reprojection(rig: StereoRig, left: Floats, right: Floats, points: Floats) -> Floats:
    """Return distances (2n,) px between detected corners and projected points, left and right."""
    distances = []
    stands = (np.eye(4), rig.right_from_left)
    for seen, matrix, distortion, stand in zip(
        (left, right), rig.matrices, rig.distortions, stands, strict=True
    ):
        rotation, _ = cv2.Rodrigues(stand[:3, :3])
        drawn = cv2.projectPoints(points, rotation, stand[:3, 3], matrix, distortion)[0][:, 0]
        distances.append(np.linalg.norm(drawn - seen, axis=1))
    return np.concatenate(distances)


def _rms(values: Floats) -> float | None:
    """Return the root mean square; None for no values: a partly visible ChArUco board has no
    diagonals."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _in_mm(values: Floats) -> float | None:
    rms = _rms(values)
    return None if rms is None else 1e3 * rms


def summary(boards: Sequence[BoardMeasurement]) -> dict[str, float | int | None]:
    """Return root mean squares over all boards.

    square_rms_mm: error of the distances of neighbouring corners.
    diagonal_rms_mm: error of both diagonals of the board.
    rigid_fit_rms_mm: error of the corners after a rigid fit of the board.
    reprojection_rms_px: error of the triangulate_corners corners.
    """
    return {
        "pairs": len(boards),
        "square_rms_mm": _in_mm(np.concatenate([one.squares_m for one in boards])),
        "diagonal_rms_mm": _in_mm(np.concatenate([one.diagonals_m for one in boards])),
        "rigid_fit_rms_mm": _in_mm(np.concatenate([one.rigid_fit_m for one in boards])),
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
    """Measure a board of known size with a calibration, on images that did not make it.

    The result holds the `summary` of the pairs, and used_to_calibrate: names of left images that
    made the calibration and thus give too small errors.

    Raises CalibrationError for images of another size, or without a board in any pair.
    """
    found, size = find_pairs(left_paths, right_paths, board, progress)
    if size != (calibration.width_px, calibration.height_px):
        raise CalibrationError(
            f"pictures of {size[0]}x{size[1]} px, calibration of {calibration.device} for "
            f"{calibration.width_px}x{calibration.height_px} px"
        )
    pairs = [pair for pair in found if isinstance(pair, BoardPair)]
    if not pairs:
        raise CalibrationError(f"no usable pair of {len(found)}: {found[0]}")
    used = {pair.digest for pair in calibration.pairs if pair.used}
    again = [
        left.name
        for left, right in zip(left_paths, right_paths, strict=True)
        if compute_digest(left, right) in used
    ]
    rig = StereoRig.calibrated(calibration)
    return {
        **summary([measure_board(rig, pair, board) for pair in pairs]),
        "used_to_calibrate": again,
    }


def calibrate_plain_opencv(
    pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]
) -> StereoRig:
    """Calibrate with OpenCV as in its tutorials, for comparison: intrinsics first, then fixed.

    points: the board's corners (n, 3) m.
    """
    model = [points[pair.left.ids].astype(np.float32) for pair in pairs]
    left = [pair.left.pixels.astype(np.float32) for pair in pairs]
    right = [pair.right.pixels.astype(np.float32) for pair in pairs]
    _, left_matrix, left_distortion, *_ = cv2.calibrateCamera(model, left, size, None, None)
    _, right_matrix, right_distortion, *_ = cv2.calibrateCamera(model, right, size, None, None)
    *_, rotation, position, _, _ = cv2.stereoCalibrate(
        model,
        left,
        right,
        left_matrix,
        left_distortion,
        right_matrix,
        right_distortion,
        size,
        flags=cv2.CALIB_FIX_INTRINSIC,
    )
    return StereoRig(
        (floats(left_matrix), floats(right_matrix)),
        (floats(left_distortion).ravel()[:5], floats(right_distortion).ravel()[:5]),
        np.block([[rotation, position], [np.zeros((1, 3)), np.ones((1, 1))]]),
    )


PLAIN_HALF_WINDOW_PX = 5


def find_plain_corners(left: Path, right: Path, board: Board) -> BoardPair | None:
    """Find a chessboard's corners as in OpenCV's tutorials: refined in a window of 11 px
    everywhere."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    window = (PLAIN_HALF_WINDOW_PX, PLAIN_HALF_WINDOW_PX)
    views = []
    for path in (left, right):
        image = read_gray(path)
        found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
        if not found:
            return None
        refined = cv2.cornerSubPix(image, corners.copy(), window, (-1, -1), criteria)
        views.append(refined.reshape(-1, 2).astype(np.float64))
    ids = np.arange(board.columns * board.rows)
    return BoardPair(
        BoardView(ids, views[0]), BoardView(ids, same_order(views[0], views[1], board))
    )


def cross_check(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: Board,
    leave_out: int = 1,
    progress: Progress = ignore_progress,
) -> dict[str, object]:
    """Leave pairs out in turn, `leave_out` at a time, and measure them with the calibration of the
    rest.

    The i-th, i+G-th, ... pair are left out together, so that similar neighbouring images are not.
    The same is done with plain OpenCV, except for ChArUco boards.

    Raises CalibrationError when the images cannot be used or too few pairs remain.
    """
    found, size = find_pairs(left_paths, right_paths, board, progress)
    whole = {i: pair for i, pair in enumerate(found) if isinstance(pair, BoardPair)}
    if len(whole) - leave_out < MIN_PAIRS or leave_out < 1:
        raise CalibrationError(
            f"{len(whole)} usable pairs of {len(found)}, {leave_out} of them left out at a time: "
            f"at least {MIN_PAIRS} must remain to calibrate with; take more pictures"
        )
    points = board_points(board)
    plain: dict[int, BoardPair] = {}
    if board.kind == "chessboard":
        for i in whole:
            pair = find_plain_corners(left_paths[i], right_paths[i], board)
            if pair is not None:
                plain[i] = pair
    numbers = list(whole)
    groups = -(-len(numbers) // leave_out)
    ours: dict[int, BoardMeasurement] = {}
    theirs: dict[int, BoardMeasurement] = {}
    for group in range(groups):
        out = numbers[group::groups]
        kept = [i for i in numbers if i not in out]
        selection = PairSelection([whole[i] for i in kept], [left_paths[i].name for i in kept])
        rig = StereoRig.of(fit_selection(selection, points, size).rig)
        ours.update({i: measure_board(rig, whole[i], board) for i in out})
        if plain:
            yardstick = calibrate_plain_opencv([plain[i] for i in kept if i in plain], points, size)
            theirs.update({i: measure_board(yardstick, plain[i], board) for i in out if i in plain})
        progress(group + 1, groups, "leaving pairs out")
    return {
        **summary(list(ours.values())),
        "calibrate_plain_opencv": summary(list(theirs.values())) if theirs else None,
        "rows": [
            {
                "left": left_paths[i].name,
                "distance_m": ours[i].distance_m,
                "rigid_fit_rms_mm": _in_mm(ours[i].rigid_fit_m),
                "plain_rigid_fit_rms_mm": _in_mm(theirs[i].rigid_fit_m) if i in theirs else None,
            }
            for i in numbers
        ],
    }
