"""Compare methods of finding corners and of fitting the rig, for docs/camera.md.

python -m benchmarks.calibration [--left GLOB --right GLOB --board 9x6 --square-mm 24.23]

Prints one line of JSON per method. For corner finders: their errors in simulated images of a board
(rms px, and the relative error of the board's size). With images given, for fitting methods: the
errors of the rigid fit on left-out pairs, by 4-fold cross-validation.
"""

from __future__ import annotations

import argparse
import glob
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flexsheet.launch.calibration.bundle import fit_rig, linearize, pose_transform
from flexsheet.launch.calibration.check import (
    StereoRig,
    calibrate_plain_opencv,
    find_plain_corners,
    measure_board,
    triangulate_corners,
)
from flexsheet.launch.calibration.corners import BoardPair, CornerFinder, board_points, find_pairs
from flexsheet.launch.calibration.selection import fit_pairs
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.calibration import Board
from flexsheet.nodes.models import rigid
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import make_true_camera

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Finder = Callable[[Image, Board], Floats | None]
Fitter = Callable[[Sequence[BoardPair], Floats, tuple[int, int]], StereoRig]
SCENE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
POSES, SEED = 20, 2
GROUPS = 4
WRONG_PX = 1.0
"""The maximum error of a corner, in px; corners with larger errors are counted but not averaged.
"""

CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-6)


def by_window(half_px: float | None, smoothing_px: float) -> Finder:
    """Make a finder that refines corners in a window with OpenCV.

    half_px: half the side of the window; None: 0.4 times the smallest distance of two corners.
    """

    def find(image: Image, board: Board) -> Floats | None:
        found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
        if not found:
            return None
        start = corners.reshape(-1, 2).astype(np.float64)
        apart = np.linalg.norm(start[:, None] - start, axis=-1)
        nearest = np.sort(apart, axis=1)[:, 1].min()
        smooth = cv2.GaussianBlur(image, (0, 0), smoothing_px) if smoothing_px > 0 else image
        half = int(min(15.0, 0.4 * nearest if half_px is None else half_px))
        begun = corners.reshape(-1, 1, 2).copy()
        refined = cv2.cornerSubPix(smooth, begun, (half, half), (-1, -1), CRITERIA)
        return np.asarray(refined[:, 0], dtype=np.float64)

    return find


def by_sectors(image: Image, board: Board) -> Floats | None:
    """Find corners with OpenCV's sector-based detector, which needs no refinement."""
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners.reshape(-1, 2), dtype=np.float64) if found else None


def as_shipped(image: Image, board: Board) -> Floats | None:
    view = CornerFinder(board).find(image)
    return None if view is None else view.pixels


FINDERS = {
    "window of 11 px": by_window(5, 0.0),
    "window by the board's size": by_window(None, 0.0),
    "the same, smoothed": by_window(None, 1.0),
    "sectors": by_sectors,
    "as shipped: smoothed, enlarged, window by corner": as_shipped,
}


def compare_finders() -> None:
    board = Board(columns=9, rows=6, square_m=0.025)
    twin = TwinBoard(make_true_camera(load_scene(SCENE).camera), board, seed=SEED)
    pictures = []
    for pose in twin.poses(POSES):
        pictures += list(zip(twin.pair(pose), twin.corners(pose), strict=True))
    for name, find in FINDERS.items():
        errors, places, wrong = [], [], 0
        for image, true in pictures:
            found = find(image, board)
            if found is None:
                wrong += len(true)
                continue
            if np.linalg.norm(found[0] - true[0]) > np.linalg.norm(found[0] - true[-1]):
                found = found[::-1]
            good = np.linalg.norm(found - true, axis=1) < WRONG_PX
            wrong += int((~good).sum())
            errors.append((found - true)[good])
            places.append((true - true.mean(axis=0))[good])
        off, place = np.concatenate(errors), np.concatenate(places)
        print(
            json.dumps(
                {
                    "corners": name,
                    "rms_px": round(float(np.sqrt(np.mean(off**2))), 4),
                    "size_error": round(float(np.sum(off * place) / np.sum(place**2)), 6),
                    "wrong_or_missing": wrong,
                    "of": sum(len(true) for _, true in pictures),
                }
            )
        )


def joint(pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]) -> StereoRig:
    return StereoRig.from_fit(fit_pairs(pairs, points, size).rig)


def robust(loss: str, scale_px: float) -> Fitter:
    """Make a joint fit with a robust loss, which is not quadratic for errors over `scale_px`."""

    def fit(pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]) -> StereoRig:
        start = fit_pairs(pairs, points, size)
        unknown = np.concatenate([start.rig, start.poses.ravel()])

        def parts(x: Floats) -> list[tuple[int, BoardPair, Floats]]:
            return [(i, p, x[22 + 6 * i : 28 + 6 * i]) for i, p in enumerate(pairs)]

        def shifts(x: Floats) -> Floats:
            return np.concatenate([linearize(p, points, x[:22], q).shifts for _, p, q in parts(x)])

        def slopes(x: Floats) -> Floats:
            rows = []
            for i, pair, pose in parts(x):
                here = linearize(pair, points, x[:22], pose)
                row = np.zeros((len(here.shifts), len(x)))
                row[:, :22], row[:, 22 + 6 * i : 28 + 6 * i] = -here.by_rig, -here.by_pose
                rows.append(row)
            return np.concatenate(rows)

        found = least_squares(
            shifts, unknown, jac=slopes, loss=loss, f_scale=scale_px, x_scale="jac"
        )
        return StereoRig.from_fit(found.x[:22])

    return fit


def with_board_shape(
    pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]
) -> StereoRig:
    """Fit the rig and the height of each corner over the board's plane in alternation."""
    fit = fit_pairs(pairs, points, size)
    shape = points.copy()
    for _ in range(6):
        rig, heights = StereoRig.from_fit(fit.rig), np.zeros(len(points))
        for pair, pose in zip(pairs, fit.poses, strict=True):
            ids, left, right = pair.common()
            seen = triangulate_corners(rig, left, right)
            heights[ids] += rigid.apply(rigid.inverse(pose_transform(pose)), seen)[:, 2]
        heights = heights / len(pairs)
        plane = np.column_stack([np.ones(len(points)), points[:, :2]])
        shape[:, 2] = heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
        fit = fit_rig(pairs, shape, rig=fit.rig, poses=fit.poses)
    return StereoRig.from_fit(fit.rig)


FITTERS: dict[str, Fitter] = {
    "joint, as shipped": joint,
    "joint, Huber at 0.2 px": robust("huber", 0.2),
    "joint, soft L1 at 0.2 px": robust("soft_l1", 0.2),
    "joint, Cauchy at 0.2 px": robust("cauchy", 0.2),
    "joint, with the board's shape": with_board_shape,
    "each camera alone, then fixed": calibrate_plain_opencv,
}


def compare_fitters(left: list[Path], right: list[Path], board: Board) -> None:
    found, size = find_pairs(left, right, board)
    pairs = [pair for pair in found if isinstance(pair, BoardPair)]
    tutorial = [find_plain_corners(*paths, board) for paths in zip(left, right, strict=True)]
    plain = [pair for pair in tutorial if pair is not None]
    ways = [(name, fitter, pairs) for name, fitter in FITTERS.items()]
    ways.append(("each camera alone, then fixed, window of 11 px", calibrate_plain_opencv, plain))
    ways.append(("joint, window of 11 px", joint, plain))
    points = board_points(board)
    for name, fitter, given in ways:
        residuals = []
        for group in range(GROUPS):
            kept = [pair for i, pair in enumerate(given) if i % GROUPS != group]
            rig = fitter(kept, points, size)
            residuals += [measure_board(rig, p, board).rigid_fit_m for p in given[group::GROUPS]]
        rms_m = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))
        print(json.dumps({"fit": name, "rigid_fit_rms_mm": round(1e3 * rms_m, 3)}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--left")
    parser.add_argument("--right")
    parser.add_argument("--board", default="9x6")
    parser.add_argument("--square-mm", type=float, default=24.23)
    given = parser.parse_args()
    compare_finders()
    if given.left and given.right:
        columns, rows = (int(part) for part in given.board.split("x"))
        board = Board(columns=columns, rows=rows, square_m=1e-3 * given.square_mm)
        left = [Path(name) for name in sorted(glob.glob(given.left))]
        right = [Path(name) for name in sorted(glob.glob(given.right))]
        compare_fitters(left, right, board)


if __name__ == "__main__":
    main()
