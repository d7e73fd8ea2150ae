"""Calibrates a stereo rig from pictures of a chessboard, and checks a calibration on others.

Zhang's method as OpenCV has it: each camera alone first, then both together with all parameters
free, which fits held-out pictures better than fixed intrinsics do.  Lens model: pinhole with k1,
k2, p1, p2; k3 stays 0, since boards that fill less than the picture cannot tell it from k2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from messages.calibration import (
    Board,
    PairResidual,
    StereoCalibration,
    load_calibration,
    save_calibration,
)
from messages.scene import Lens
from nodes.models import rigid

__all__ = [
    "CalibrationError",
    "calibrate_stereo",
    "check_stereo",
    "load_calibration",
    "save_calibration",
]

Floats = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with (steps done, steps in all, what was just done)."""

MIN_PAIRS = 5
OUTLIER_RATIO = 3.0
OUTLIER_FLOOR_PX = 0.5
MISFIT_RATIO = 5.0
MISFIT_FLOOR_PX = 5.0
MISFIT = "does not go with the other pairs:"
REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-6)


class CalibrationError(ValueError):
    """Pictures that cannot be calibrated with; the message says which and what to do."""


@dataclass(frozen=True, slots=True)
class BoardPair:
    """The corners (rows*columns, 2) px of one pair, in the same order in both pictures."""

    left: Floats
    right: Floats


def _ignore_progress(done: int, total: int, what: str) -> None:
    """For callers that do not care."""


def board_points(board: Board) -> Floats:
    """Corners (rows*columns, 3) in the board's frame, metres: along the columns first."""
    points = np.zeros((board.rows * board.columns, 3))
    grid = np.mgrid[: board.columns, : board.rows].T.reshape(-1, 2)
    points[:, :2] = grid * board.square_m
    return points


def read_gray(path: Path) -> NDArray[np.uint8]:
    """A picture in grey; raises CalibrationError for what is not a readable picture."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise CalibrationError(f"{path}: not a picture that can be read")
    return np.asarray(image, dtype=np.uint8)


def find_corners(image: NDArray[np.uint8], board: Board) -> Floats | None:
    """Sub-pixel inner corners (rows*columns, 2) px, or None where no whole board is seen.

    The refinement window is kept within 0.4 of the nearest corner's distance: a larger one sees the
    neighbours' edges and drags corners by pixels.
    """
    found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
    if not found:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    spacing = min(
        np.linalg.norm(np.diff(grid, axis=0), axis=-1).min(),
        np.linalg.norm(np.diff(grid, axis=1), axis=-1).min(),
    )
    half = int(np.clip(0.4 * spacing, 2, 15))
    refined = cv2.cornerSubPix(image, corners.copy(), (half, half), (-1, -1), REFINEMENT)
    return refined.reshape(-1, 2).astype(np.float64)


def same_order(left: Floats, right: Floats, board: Board) -> Floats:
    """The right picture's corners, renumbered to start at the same board corner as the left's.

    A detector may begin at either end of the board (at any corner of a square one).  The two
    cameras of a rig stand nearly upright to each other, so that the right numbering is the one
    whose axes point as the left's do.
    """
    grid = right.reshape(board.rows, board.columns, 2)
    turns = (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    numberings = [np.rot90(grid, turn, axes=(0, 1)).reshape(-1, 2) for turn in turns]

    def axes(corners: Floats) -> Floats:
        square = corners.reshape(board.rows, board.columns, 2)
        directions = np.stack([square[0, -1] - square[0, 0], square[-1, 0] - square[0, 0]])
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    wanted = axes(left)
    return max(numberings, key=lambda corners: float(np.sum(axes(corners) * wanted)))


def find_pairs(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    board: Board,
    progress: Progress,
) -> tuple[list[BoardPair | str], tuple[int, int]]:
    """The board in each pair, or the reason why not, and the pictures' (width, height).

    Raises CalibrationError for unequal counts, no pictures, unreadable ones, or mixed sizes.
    """
    if len(left_paths) != len(right_paths):
        raise CalibrationError(
            f"{len(left_paths)} left and {len(right_paths)} right pictures; give equally many, in "
            "the same order"
        )
    if not left_paths:
        raise CalibrationError("no pictures: the patterns match no file")
    results: list[BoardPair | str] = []
    size: tuple[int, int] | None = None
    for number, paths in enumerate(zip(left_paths, right_paths, strict=True), start=1):
        corners = []
        for path in paths:
            image = read_gray(path)
            image_size = (image.shape[1], image.shape[0])
            if size is not None and image_size != size:
                raise CalibrationError(
                    f"{path}: {image_size[0]}x{image_size[1]} px, the others {size[0]}x{size[1]}"
                )
            size = image_size
            corners.append(find_corners(image, board))
        left, right = corners
        if left is None or right is None:
            missing = [path.name for path, seen in zip(paths, corners, strict=True) if seen is None]
            results.append(
                f"no board of {board.columns}x{board.rows} inner corners in {' and '.join(missing)}"
            )
        else:
            results.append(BoardPair(left, same_order(left, right, board)))
        progress(number, len(left_paths), f"{paths[0].name}, {paths[1].name}")
    assert size is not None
    return results, size


@dataclass(frozen=True, slots=True)
class _Rig:
    """What is estimated: matrices 3x3, distortions (5,), a transform, residuals (pairs, 2) px."""

    left_matrix: Floats
    left_distortion: Floats
    right_matrix: Floats
    right_distortion: Floats
    right_from_left: Floats
    pair_rms_px: Floats
    rms_px: float


Optics = tuple[Floats, Floats]
"""One camera's matrix 3x3 and distortion (5,)."""


def _single(views: Sequence[Floats], board: Board, size: tuple[int, int]) -> Optics:
    """One camera from its own views of the board."""
    points = [board_points(board).astype(np.float32)] * len(views)
    corners = [view.astype(np.float32) for view in views]
    _, matrix, distortion, *_ = cv2.calibrateCamera(
        points, corners, size, None, None, flags=cv2.CALIB_FIX_K3, criteria=REFINEMENT
    )
    return _floats(matrix), _floats(distortion).ravel()[:5]


def _board_poses(views: Sequence[Floats], board: Board, optics: Optics) -> list[Floats]:
    """camera_from_board (4, 4) of each view, from that view alone."""
    poses = []
    for corners in views:
        _, rotation, translation = cv2.solvePnP(board_points(board), corners, *optics)
        poses.append(rigid.transform(_floats(cv2.Rodrigues(rotation)[0]), translation.ravel()))
    return poses


def misfits(pairs: Sequence[BoardPair], board: Board, left: Optics, right: Optics) -> Floats:
    """How far each pair (n,) is from what most pairs say of the rig, px rms in the right view.

    Each pair alone determines how the cameras stand to each other.  The pair whose answer suits the
    others best by their median (least median of squares, Rousseeuw 1984) judges them all.  A pair
    of pictures that do not belong together thus stands out; in a common fit it would bend the rig
    until all pairs looked equally bad.
    """
    left_poses = _board_poses([pair.left for pair in pairs], board, left)
    right_poses = _board_poses([pair.right for pair in pairs], board, right)
    rigs = [b @ rigid.inverse(a) for a, b in zip(left_poses, right_poses, strict=True)]
    errors = np.empty((len(rigs), len(pairs)))
    for i, right_from_left in enumerate(rigs):
        for j, pair in enumerate(pairs):
            drawn = _projected(board_points(board), right_from_left @ left_poses[j], right)
            errors[i, j] = _rms(np.linalg.norm(drawn - pair.right, axis=1))
    return np.asarray(errors[np.argmin(np.median(errors, axis=1))])


def _singles(
    pairs: Sequence[BoardPair], board: Board, size: tuple[int, int]
) -> tuple[Optics, Optics]:
    return (
        _single([pair.left for pair in pairs], board, size),
        _single([pair.right for pair in pairs], board, size),
    )


def _projected(points: Floats, camera_from_points: Floats, optics: Optics) -> Floats:
    """Pixels (n, 2) of points (n, 3)."""
    rotation, _ = cv2.Rodrigues(camera_from_points[:3, :3])
    drawn, _ = cv2.projectPoints(points, rotation, camera_from_points[:3, 3], *optics)
    return _floats(drawn)[:, 0]


def _fit(
    pairs: Sequence[BoardPair], board: Board, size: tuple[int, int], left: Optics, right: Optics
) -> _Rig:
    """Both cameras together from all pairs, beginning at what each camera alone gave."""
    points = [board_points(board).astype(np.float32)] * len(pairs)
    (rms, left_k, left_d, right_k, right_d, rotation, translation, *_, errors) = (
        cv2.stereoCalibrateExtended(
            points,
            [pair.left.astype(np.float32) for pair in pairs],
            [pair.right.astype(np.float32) for pair in pairs],
            *left,
            *right,
            size,
            np.eye(3),
            np.zeros(3),
            flags=cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS,
            criteria=REFINEMENT,
        )
    )
    return _Rig(
        left_matrix=_floats(left_k),
        left_distortion=_floats(left_d).ravel()[:5],
        right_matrix=_floats(right_k),
        right_distortion=_floats(right_d).ravel()[:5],
        right_from_left=rigid.transform(_floats(rotation), _floats(translation).ravel()),
        pair_rms_px=_floats(errors).reshape(-1, 2),
        rms_px=float(rms),
    )


def _floats(array: object) -> Floats:
    return np.asarray(array, dtype=np.float64)


def _lens(matrix: Floats, distortion: Floats) -> Lens:
    k1, k2, p1, p2, k3 = (float(number) for number in distortion)
    return Lens(
        fx_px=float(matrix[0, 0]),
        fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]),
        cy_px=float(matrix[1, 2]),
        distortion=(k1, k2, p1, p2, k3),
    )


def calibrate_stereo(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: tuple[int, int],
    square_m: float,
    device: str,
    progress: Progress = _ignore_progress,
) -> StereoCalibration:
    """Calibrate a rig from pairs of pictures of a chessboard of `board` (columns, rows) corners.

    Left out, with the reason kept in the result: pairs without the board; pairs that contradict the
    others grossly (`misfits`); pairs whose residual then exceeds three times the median and half a
    pixel.  Raises CalibrationError when the pictures cannot be used or fewer than MIN_PAIRS pairs
    remain.
    """
    chessboard = Board(columns=board[0], rows=board[1], square_m=square_m)
    found, size = find_pairs(left_paths, right_paths, chessboard, progress)
    reasons = {index: pair for index, pair in enumerate(found) if isinstance(pair, str)}
    good = {index: pair for index, pair in enumerate(found) if isinstance(pair, BoardPair)}

    def enough() -> list[BoardPair]:
        if len(good) < MIN_PAIRS:
            listed = "".join(f"\n  {left_paths[i].name}: {text}" for i, text in reasons.items())
            raise CalibrationError(
                f"{len(good)} usable pairs of {len(found)}, at least {MIN_PAIRS} are needed; take "
                f"more pictures with the whole board in both views{listed}"
            )
        return list(good.values())

    def leave_out(errors_px: Floats, ratio: float, floor_px: float, what: str) -> bool:
        """Move pairs with large errors from `good` to `reasons`; whether there were any."""
        limit_px = max(ratio * float(np.median(errors_px)), floor_px)
        bad = [(i, error) for i, error in zip(good, errors_px, strict=True) if error > limit_px]
        for i, error in bad:
            reasons[i] = f"{what} {error:.2f} px, limit {limit_px:.2f} px"
            del good[i]
        return bool(bad)

    residuals: dict[int, Floats] = {}
    try:
        left, right = _singles(enough(), chessboard, size)
        leave_out(misfits(enough(), chessboard, left, right), MISFIT_RATIO, MISFIT_FLOOR_PX, MISFIT)
        left, right = _singles(enough(), chessboard, size)
        while True:
            rig = _fit(enough(), chessboard, size, left, right)
            residuals.update(zip(good, rig.pair_rms_px, strict=True))
            worst = rig.pair_rms_px.max(axis=1)
            if not leave_out(worst, OUTLIER_RATIO, OUTLIER_FLOOR_PX, "residual"):
                break
    except cv2.error as error:
        raise CalibrationError(
            f"the {len(good)} pairs do not determine the rig ({error.err}); tilt the board "
            "differently from picture to picture"
        ) from error
    return StereoCalibration(
        device=device,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        code_version=version("flexsheet"),
        width_px=size[0],
        height_px=size[1],
        left=_lens(rig.left_matrix, rig.left_distortion),
        right=_lens(rig.right_matrix, rig.right_distortion),
        right_from_left=rig.right_from_left,
        board=chessboard,
        reprojection_rms_px=rig.rms_px,
        pairs=tuple(
            PairResidual(
                left=left.name,
                right=right.name,
                used=i in good,
                reason=reasons.get(i, ""),
                left_rms_px=float(residuals[i][0]) if i in residuals else None,
                right_rms_px=float(residuals[i][1]) if i in residuals else None,
            )
            for i, (left, right) in enumerate(zip(left_paths, right_paths, strict=True))
        ),
    )


def _opencv_lens(lens: Lens) -> Optics:
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    return matrix, np.array(lens.distortion)


def triangulate_pair(calibration: StereoCalibration, pair: BoardPair) -> Floats:
    """The corners (corners, 3) in the left camera's frame, metres: undistorted, linear."""
    left, right = (
        cv2.undistortPoints(corners[:, None], *_opencv_lens(lens))[:, 0].T
        for corners, lens in ((pair.left, calibration.left), (pair.right, calibration.right))
    )
    points = cv2.triangulatePoints(np.eye(3, 4), calibration.right_from_left[:3], left, right)
    return np.asarray((points[:3] / points[3]).T, dtype=np.float64)


def reprojection_errors(
    calibration: StereoCalibration, pair: BoardPair, points_left: Floats
) -> Floats:
    """Distances (2, corners) px between what was seen and the projected points, left and right."""
    views = (
        (pair.left, calibration.left, np.eye(4)),
        (pair.right, calibration.right, calibration.right_from_left),
    )
    errors = []
    for seen, lens, camera_from_left in views:
        drawn = _projected(points_left, camera_from_left, _opencv_lens(lens))
        errors.append(np.linalg.norm(drawn - seen, axis=1))
    return np.stack(errors)


def rigid_fit_residuals(points: Floats, model: Floats) -> Floats:
    """Distances (n,) left after the best rigid motion of `model` (n, 3) onto `points` (n, 3).

    Kabsch, A solution for the best rotation to relate two sets of vectors (1976).
    """
    centred, reference = points - points.mean(axis=0), model - model.mean(axis=0)
    u, _, vt = np.linalg.svd(reference.T @ centred)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(np.linalg.norm(reference @ (u @ handed @ vt) - centred, axis=1))


def check_stereo(
    calibration: StereoCalibration,
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: tuple[int, int],
    square_m: float,
    progress: Progress = _ignore_progress,
) -> dict[str, float | int]:
    """Measure a board of known size with a calibration, on pictures not used to calibrate.

    pairs: with the board in both views.  square_rms_mm: error of the distances of neighbouring
    corners.  diagonal_rms_mm: of both diagonals of the board.  rigid_fit_rms_mm: of the corners,
    after the board was laid on them as a rigid body.  reprojection_rms_px: of the triangulated
    corners.  Raises CalibrationError for pictures of another size, or no board in any pair.
    """
    chessboard = Board(columns=board[0], rows=board[1], square_m=square_m)
    found, size = find_pairs(left_paths, right_paths, chessboard, progress)
    if size != (calibration.width_px, calibration.height_px):
        raise CalibrationError(
            f"pictures of {size[0]}x{size[1]} px, calibration of {calibration.device} for "
            f"{calibration.width_px}x{calibration.height_px} px"
        )
    pairs = [pair for pair in found if isinstance(pair, BoardPair)]
    if not pairs:
        raise CalibrationError(f"no usable pair of {len(found)}: {found[0]}")
    model = board_points(chessboard)
    diagonal_m = square_m * float(np.hypot(board[0] - 1, board[1] - 1))
    squares, diagonals, fits, errors = [], [], [], []
    for pair in pairs:
        points = triangulate_pair(calibration, pair)
        grid = points.reshape(chessboard.rows, chessboard.columns, 3)
        for axis in (0, 1):
            squares.append(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() - square_m)
        diagonals.append(np.linalg.norm(grid[0, 0] - grid[-1, -1]) - diagonal_m)
        diagonals.append(np.linalg.norm(grid[0, -1] - grid[-1, 0]) - diagonal_m)
        fits.append(rigid_fit_residuals(points, model))
        errors.append(reprojection_errors(calibration, pair, points).ravel())
    return {
        "pairs": len(pairs),
        "square_rms_mm": 1e3 * _rms(np.concatenate(squares)),
        "diagonal_rms_mm": 1e3 * _rms(np.array(diagonals)),
        "rigid_fit_rms_mm": 1e3 * _rms(np.concatenate(fits)),
        "reprojection_rms_px": _rms(np.concatenate(errors)),
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
