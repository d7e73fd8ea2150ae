"""Test the estimated error of a calibration: derivatives, covariance, jackknife and its truth."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.optimize import least_squares

from flexsheet.launch.calibration import bundle
from flexsheet.launch.calibration.check import StereoRig, triangulate_corners
from flexsheet.launch.calibration.corners import (
    BoardPair,
    BoardView,
    CornerFinder,
    board_points,
    match_views,
)
from flexsheet.launch.calibration.selection import PairSelection, fit_pairs, fit_selection
from flexsheet.launch.calibration.stereo import compute_uncertainty
from flexsheet.launch.calibration.uncertainty import (
    compute_jackknife_covariance,
    compute_position_jacobian,
    compute_position_std,
    sample_working_plane,
)
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.calibration import Board, StereoCalibration, Uncertainty
from flexsheet.messages.scene import Lens, Scene, StereoCamera
from flexsheet.nodes.models import rigid
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import make_true_camera

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
SHIPPED = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"
BOARD = Board(columns=9, rows=6, square_m=0.025)
POINTS = board_points(BOARD)
COARSE = Board(columns=6, rows=4, square_m=0.035)
"""Board for small images."""


@cache
def scene_camera() -> StereoCamera:
    scene_file = ROOT / "launch" / "scenes" / "cylinder.yaml"
    return Scene.model_validate(YAML(typ="safe").load(scene_file.read_text())).camera


def half(lens: Lens) -> Lens:
    return lens.model_copy(
        update={
            "fx_px": 0.5 * lens.fx_px,
            "fy_px": 0.5 * lens.fy_px,
            "cx_px": 0.5 * (lens.cx_px + 0.5) - 0.5,
            "cy_px": 0.5 * (lens.cy_px + 0.5) - 0.5,
        }
    )


@cache
def small_camera() -> StereoCamera:
    """Return the true rig with half the pixels in each direction, for speed."""
    camera = make_true_camera(scene_camera())
    return camera.model_copy(
        update={
            "width_px": 320,
            "height_px": 240,
            "left": half(camera.left),
            "right": half(camera.right),
        }
    )


def numbers_of(camera: StereoCamera | StereoCalibration) -> Floats:
    lenses = [
        [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion[:4]]
        for lens in (camera.left, camera.right)
    ]
    return np.concatenate([*lenses, bundle.pose_vector(camera.right_from_left)])


def calibrated(
    camera: StereoCamera, board: Board, *, seed: int, count: int, distance_m: float
) -> tuple[bundle.RigFit, Uncertainty]:
    """Calibrate from simulated images of a board."""
    twin, finder = TwinBoard(camera, board, seed=seed), CornerFinder(board)
    pairs = []
    for left_from_board in twin.poses(count):
        left, right = twin.pair(left_from_board)
        pairs.append(match_views(finder.find(left), finder.find(right), board, ("left", "right")))
    selection = PairSelection(pairs, [str(number) for number in range(count)])
    size, points = (camera.width_px, camera.height_px), board_points(board)
    fit = fit_selection(selection, points, size)
    assert len(selection.good) >= 0.75 * count
    uncertainty = compute_uncertainty(
        fit, selection.pairs(), points, size=size, distance_m=distance_m
    )
    return fit, uncertainty


@cache
def exact_corners(count: int) -> tuple[tuple[Floats, Floats], ...]:
    """Return corners of the board in many poses, without noise."""
    board = TwinBoard(make_true_camera(scene_camera()), BOARD, seed=5)
    return tuple(board.corners(pose) for pose in board.poses(count))


def noisy(*, seed: int, sigma_px: float, count: int = 12) -> list[BoardPair]:
    random = np.random.default_rng(seed)
    ids = np.arange(len(POINTS))
    return [
        BoardPair(
            BoardView(ids, left + random.normal(0.0, sigma_px, left.shape)),
            BoardView(ids, right + random.normal(0.0, sigma_px, right.shape)),
        )
        for left, right in exact_corners(count)
    ]


def test_derivatives_of_corners_equal_differences() -> None:
    rig = numbers_of(make_true_camera(scene_camera()))
    pose = np.array([0.3, -0.4, 0.1, -0.05, -0.04, 0.45])
    (pair,) = noisy(seed=1, sigma_px=0.1, count=1)
    pair = BoardPair(
        BoardView(pair.left.ids[:40], pair.left.pixels[:40]),
        BoardView(pair.right.ids[9:], pair.right.pixels[9:]),
    )
    here = bundle.linearize(pair, POINTS, rig, pose)
    for slopes, base, of in (
        (here.by_rig, rig, lambda rig: bundle.linearize(pair, POINTS, rig, pose)),
        (here.by_pose, pose, lambda pose: bundle.linearize(pair, POINTS, rig, pose)),
    ):
        for index in range(len(base)):
            step = np.zeros(len(base))
            step[index] = 1e-6 * max(1.0, abs(base[index]))
            change = (of(base - step).shifts - of(base + step).shifts) / (2.0 * step[index])
            assert slopes[:, index] == pytest.approx(change, rel=1e-4, abs=1e-3)


def best_points(rig: Floats, start: Floats, left: Floats, right: Floats) -> Floats:
    """Return the points (n, 3) whose pixels in both views are nearest to the observed ones."""

    def misses(point: Floats, number: int) -> Floats:
        seen = drawn(rig, point[None])
        return np.concatenate([seen[0][0] - left[number], seen[1][0] - right[number]])

    return np.array(
        [
            least_squares(
                misses, point, args=(i,), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15
            ).x
            for i, point in enumerate(start)
        ]
    )


def test_derivatives_of_positions_equal_differences() -> None:
    rig = numbers_of(make_true_camera(scene_camera()))
    grid = sample_working_plane(rig, (640, 480), 0.5)
    assert grid[:, 2] == pytest.approx(0.5)
    points = grid[[0, 12]]
    slopes = compute_position_jacobian(rig, points)
    left, right = drawn(rig, points)
    for index in range(len(rig)):
        step = np.zeros(len(rig))
        step[index] = 1e-5 * max(1.0, abs(rig[index]))
        ends = [best_points(rig + sign * step, points, left, right) for sign in (1.0, -1.0)]
        change = (ends[0] - ends[1]) / (2.0 * step[index])
        scale = np.abs(change).max()
        assert slopes[..., index] == pytest.approx(change, rel=1e-3, abs=1e-4 * scale)


def drawn(rig: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Project points (n, 3) of the left camera's frame to both views."""
    still = np.zeros(3)
    left = cv2.projectPoints(points, still, still, *bundle.lens_arrays(rig[:8]))[0][:, 0]
    right = cv2.projectPoints(points, rig[16:19], rig[19:], *bundle.lens_arrays(rig[8:16]))[0]
    return np.asarray(left), np.asarray(right[:, 0])


@pytest.mark.long
def test_the_covariance_of_a_fit_is_that_of_many_fits() -> None:
    """For independent noise, the errors of 40 fits scatter as each fit estimates."""
    true = numbers_of(make_true_camera(scene_camera()))
    slopes = compute_position_jacobian(true, sample_working_plane(true, (640, 480), 0.5))
    scores, shifts, stated = [], [], []
    for seed in range(40):
        pairs = noisy(seed=seed, sigma_px=0.05)
        fit = fit_pairs(pairs, POINTS, (640, 480))
        off = fit.rig - true
        scores.append(off @ np.linalg.solve(fit.covariance, off))
        shifts.append(slopes @ off)
        stated.append(compute_position_std(slopes, fit.covariance))
        assert fit.sigma_px == pytest.approx(0.05, rel=0.1)
    assert np.mean(scores) == pytest.approx(22.0, rel=0.2)
    variances = np.mean(np.square(shifts), axis=(0, 1))
    depth_m, lateral_m = np.mean(stated, axis=0)
    assert np.sqrt(variances[2]) == pytest.approx(depth_m, rel=0.3)
    assert np.sqrt(variances[0] + variances[1]) == pytest.approx(lateral_m, rel=0.3)


def test_the_jackknife_agrees_where_the_noise_is_independent() -> None:
    true = numbers_of(make_true_camera(scene_camera()))
    slopes = compute_position_jacobian(true, sample_working_plane(true, (640, 480), 0.5))
    pairs = noisy(seed=3, sigma_px=0.05, count=20)
    fit = fit_pairs(pairs, POINTS, (640, 480))
    reported: list[tuple[int, int]] = []
    refits = compute_jackknife_covariance(
        fit, pairs, POINTS, lambda done, total, _: reported.append((done, total))
    )
    assert reported == [(number, 20) for number in range(1, 21)]
    ratio = np.hypot(*compute_position_std(slopes, refits)) / np.hypot(
        *compute_position_std(slopes, fit.covariance)
    )
    assert 0.6 < ratio < 1.6


def test_only_the_jackknife_detects_bent_boards() -> None:
    """For correlated corner errors the jackknife is better than the fit's covariance."""
    camera = make_true_camera(scene_camera())
    true = numbers_of(camera)
    random = np.random.default_rng(8)
    board = TwinBoard(camera, BOARD, seed=5)
    pairs = []
    for pose in board.poses(12):
        bent = POINTS.copy()
        bent[:, 2] = random.normal(0.0, 2e-3) * np.cos(np.pi * POINTS[:, 0] / 0.2)
        left, right = drawn(true, rigid.apply(pose, bent))
        pairs.append(
            BoardPair(
                BoardView(np.arange(len(left)), left + random.normal(0.0, 0.02, left.shape)),
                BoardView(np.arange(len(right)), right + random.normal(0.0, 0.02, right.shape)),
            )
        )
    fit = fit_pairs(pairs, POINTS, (640, 480))
    uncertainty = compute_uncertainty(fit, pairs, POINTS, size=(640, 480), distance_m=0.5)
    assert uncertainty.jackknife_ratio > 1.3
    slopes = compute_position_jacobian(fit.rig, sample_working_plane(fit.rig, (640, 480), 0.5))
    alone = compute_position_std(slopes, fit.covariance)
    stated = (uncertainty.depth_std_m, uncertainty.lateral_std_m)
    assert np.divide(stated, alone) == pytest.approx(uncertainty.jackknife_ratio, rel=1e-6)


@pytest.mark.long
def test_fingertip_errors_agree_with_the_stated_uncertainty() -> None:
    """Six calibrations from images with different poses and noise are compared with the true
    rig."""
    camera = small_camera()
    true = numbers_of(camera)
    points = sample_working_plane(true, (320, 240), 0.5)
    left, right = drawn(true, points)
    errors, stated = [], []
    for seed in range(6):
        fit, uncertainty = calibrated(camera, COARSE, seed=seed, count=12, distance_m=0.5)
        errors.append(triangulate_corners(StereoRig.from_fit(fit.rig), left, right) - points)
        stated.append((uncertainty.depth_std_m, uncertainty.lateral_std_m))
    variances = np.mean(np.square(errors), axis=(0, 1))
    depth_m, lateral_m = np.sqrt(np.mean(np.square(stated), axis=0))
    assert 1 / 1.5 < np.sqrt(variances[2]) / depth_m < 1.5
    assert 1 / 1.5 < np.sqrt(variances[0] + variances[1]) / lateral_m < 1.5


def test_shipped_calibration_is_within_its_stated_uncertainty() -> None:
    shipped = StereoCalibration.load(SHIPPED)
    assert shipped.uncertainty is not None
    true, measured = numbers_of(make_true_camera(scene_camera())), numbers_of(shipped)
    off = measured - true
    score = off @ np.linalg.solve(shipped.uncertainty.covariance, off)
    assert score < 22 + 3 * np.sqrt(2 * 22)
    points = sample_working_plane(true, (640, 480), shipped.uncertainty.working_distance_m)
    errors = triangulate_corners(StereoRig.from_fit(measured), *drawn(true, points)) - points
    assert np.sqrt(np.mean(errors[:, 2] ** 2)) < 2.5 * shipped.uncertainty.depth_std_m
    # And good enough to reach 0.3 mm near the sheet with what marks add.
    assert np.linalg.norm(errors, axis=1).max() < 2.5e-4


@pytest.mark.long
def test_the_twin_calibrated_again_agrees_with_the_shipped_file() -> None:
    """This calibration has fewer pairs, other poses and other noise."""
    shipped = StereoCalibration.load(SHIPPED)
    assert shipped.uncertainty is not None
    distance_m = shipped.uncertainty.working_distance_m
    fit, again = calibrated(
        make_true_camera(scene_camera()), BOARD, seed=77, count=10, distance_m=distance_m
    )
    slopes = compute_position_jacobian(
        fit.rig, sample_working_plane(fit.rig, (640, 480), distance_m)
    )
    shifts = slopes @ (fit.rig - numbers_of(shipped))
    depth_m = np.hypot(again.depth_std_m, shipped.uncertainty.depth_std_m)
    lateral_m = np.hypot(again.lateral_std_m, shipped.uncertainty.lateral_std_m)
    assert np.sqrt(np.mean(shifts[:, 2] ** 2)) < 2.5 * depth_m
    assert np.sqrt(np.mean(np.sum(shifts[:, :2] ** 2, axis=1))) < 2.5 * lateral_m


def test_the_demo_measures_with_the_shipped_file() -> None:
    plan = load_graph(ROOT / "launch" / "demo.yaml")
    assert plan.nodes["triangulator"].parameters["calibration"] == str(SHIPPED)
