"""The twin's rig and what it sees: boards, clutter, and how much the pixels can tell at best."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.optimize import least_squares
from scipy.special import erf

from messages.calibration import Board
from messages.scene import Lens, Scene, StereoCamera
from nodes.models.rigid import transform, vector_from_rotation
from nodes.twin.board import BoardError, TwinBoard
from nodes.twin.rig import pixels_of, slopes_of, true_camera

ROOT = Path(__file__).resolve().parent.parent
Floats = NDArray[np.float64]

CHESSBOARD = Board(columns=9, rows=6, square_m=0.025)
CHARUCO = Board(
    kind="charuco", columns=9, rows=6, square_m=0.025, marker_m=0.018, dictionary="DICT_4X4_50"
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    text = (ROOT / "launch" / "scenes" / "cylinder.yaml").read_text()
    return Scene.model_validate(YAML(typ="safe").load(text))


@pytest.fixture(scope="module")
def sheet(scene: Scene) -> StereoCamera:
    """A data sheet: ideal lenses, straight rig."""
    lens = Lens(fx_px=540.0, fy_px=540.0, cx_px=319.5, cy_px=239.5)
    return scene.camera.model_copy(update={"left": lens, "right": lens})


@pytest.fixture(scope="module")
def rig(sheet: StereoCamera) -> StereoCamera:
    return true_camera(sheet)


def test_a_device_name_is_one_rig_and_another_name_another(sheet: StereoCamera) -> None:
    rig, again = true_camera(sheet), true_camera(sheet)
    assert rig.model_dump_json() == again.model_dump_json()
    other = true_camera(sheet.model_copy(update={"device": "twin-bumblebee-2"}))
    assert other.left != rig.left
    assert not np.allclose(other.right_from_left, rig.right_from_left, atol=1e-5)


@given(device=st.text(min_size=1, max_size=20))
@settings(max_examples=60, deadline=None)
def test_a_rig_differs_from_its_data_sheet_as_devices_do(sheet: StereoCamera, device: str) -> None:
    rig = true_camera(sheet.model_copy(update={"device": device}))
    for lens in (rig.left, rig.right):
        assert abs(lens.fx_px / 540.0 - 1.0) < 0.0101
        assert abs(lens.fy_px / lens.fx_px - 1.0) < 0.00101
        assert abs(lens.cx_px - 319.5) < 8.01
        assert -0.331 < lens.distortion[0] < -0.269
    assert rig.left != rig.right
    turn = np.linalg.norm(vector_from_rotation(rig.right_from_left[:3, :3]))
    assert 0.0 < turn < np.deg2rad(0.9)
    assert abs(np.linalg.norm(rig.right_from_left[:3, 3]) - 0.1205) < 0.00021
    assert rig.world_from_left == sheet.world_from_left


@given(u=st.floats(-0.85, 0.85), v=st.floats(-0.6, 0.6))
@settings(max_examples=100, deadline=None)
def test_rays_lead_back_to_their_pixels_and_opencv_agrees(
    rig: StereoCamera, u: float, v: float
) -> None:
    for lens in (rig.left, rig.right):
        pixel = pixels_of(lens, np.array([u, v]))
        assert np.allclose(slopes_of(lens, pixel), [u, v], atol=1e-11)
        matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
        expected, _ = cv2.projectPoints(
            np.array([[[u, v, 1.0]]]), np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion)
        )
        assert np.allclose(expected.reshape(2), pixel, atol=1e-9)


@pytest.fixture(scope="module")
def chessboard(rig: StereoCamera) -> TwinBoard:
    return TwinBoard(rig, CHESSBOARD, seed=1)


def crossing_misfit(p: Floats, image: NDArray[np.float32], middle: Floats) -> Floats:
    """Two smeared edges that cross at p[:2], against the picture in a round window.

    Slanting edges smear otherwise than this has it, alike on both sides of the corner: a window
    that lies round the corner keeps that from shifting it.
    """
    rows, columns = (slice(round(at) - 5, round(at) + 6) for at in (middle[1], middle[0]))
    y, x = np.mgrid[rows, columns]
    weight = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2.0 * 2.0**2))
    dx, dy = x - p[0], y - p[1]
    first = (dx * np.sin(p[2]) - dy * np.cos(p[2])) / p[4]
    second = (dx * np.sin(p[3]) - dy * np.cos(p[3])) / p[4]
    level = (p[5] + p[6] * erf(first) * erf(second)) * (1.0 + p[7] * dx + p[8] * dy)
    return np.asarray((weight * (level - image[rows, columns])).ravel())


def fitted_corner(image: NDArray[np.float32], near: Floats, along: Floats, down: Floats) -> Floats:
    """The crossing (2,) of the two edges that run `along` and `down` the board, near a pixel."""
    angles = [np.arctan2(along[1], along[0]), np.arctan2(down[1], down[0])]
    guess = np.array([*near, *angles, 1.0, 80.0, 60.0, 0.0, 0.0])
    for _ in range(2):
        guess = least_squares(crossing_misfit, guess, args=(image, guess[:2])).x
    return np.asarray(guess[:2])


def test_corners_lie_where_the_optics_put_them(chessboard: TwinBoard) -> None:
    for pose in chessboard.poses(3):
        for image, corners in zip(chessboard.levels(pose), chessboard.corners(pose), strict=True):
            grid = corners.reshape(6, 9, 2)
            along = np.gradient(grid, axis=1).reshape(-1, 2)
            down = np.gradient(grid, axis=0).reshape(-1, 2)
            found = [
                fitted_corner(image, near + 0.2, x, y)
                for near, x, y in zip(corners, along, down, strict=True)
            ]
            off = np.abs(np.array(found) - corners)
            assert off.max() < 0.01


def test_a_chessboard_is_found_whole_in_both_noisy_pictures(chessboard: TwinBoard) -> None:
    for pose in chessboard.poses(6):
        for image, corners in zip(chessboard.pair(pose), chessboard.corners(pose), strict=True):
            found, seen = cv2.findChessboardCorners(image, (9, 6))
            assert found
            off = seen.reshape(-1, 1, 2) - corners
            assert np.linalg.norm(off, axis=2).min(axis=1).max() < 1.0


def test_a_charuco_board_has_the_markers_that_opencv_expects(rig: StereoCamera) -> None:
    board = TwinBoard(rig, CHARUCO, seed=2)
    detector = cv2.aruco.CharucoDetector(
        cv2.aruco.CharucoBoard(
            (10, 7), 0.025, 0.018, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        )
    )
    for pose in board.poses(4):
        for image, corners in zip(board.pair(pose), board.corners(pose), strict=True):
            seen, numbers, _, _ = detector.detectBoard(image)
            assert numbers is not None
            assert len(numbers) >= 15
            assert np.median(np.abs(seen.reshape(-1, 2) - corners[numbers.ravel()])) < 0.1


def test_poses_are_near_and_far_tilted_to_all_sides_and_reach_every_edge(
    chessboard: TwinBoard,
) -> None:
    poses = chessboard.poses(36)
    leaning = np.array([pose[:2, 2] for pose in poses])
    tilts = np.arcsin(np.linalg.norm(leaning, axis=1))
    assert tilts.max() > 0.6
    for way in np.eye(2):
        assert (leaning @ way > 0.2).sum() >= 4
        assert (leaning @ way < -0.2).sum() >= 4
    depths = np.array([pose[2, 3] for pose in poses])
    assert depths.max() > 1.7 * depths.min()
    views = [chessboard.corners(pose) for pose in poses]
    for eye in (0, 1):
        pixels = np.concatenate([view[eye] for view in views])
        assert ((pixels > 5) & (pixels < [634, 474])).all()
        # The other view's edge is where a board that both see whole comes to its end.
        for corner in ([0, 0], [639, 0], [0, 479], [639, 479]):
            shared = (corner[0] > 0) == (eye == 0)
            nearest = np.linalg.norm(pixels - corner, axis=1).min()
            assert nearest < (110 if shared else 210)


def test_a_boards_pictures_come_from_the_seed(rig: StereoCamera) -> None:
    pose = TwinBoard(rig, CHESSBOARD, seed=1).poses(1)[0]
    pictures = [TwinBoard(rig, CHESSBOARD, seed=seed).pair(pose)[0] for seed in (1, 1, 2)]
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


def test_boards_that_cannot_be_drawn_are_refused(rig: StereoCamera, chessboard: TwinBoard) -> None:
    for change, said in (
        ({"marker_m": None}, "needs marker_m"),
        ({"marker_m": 0.03}, "does not fit"),
        ({"dictionary": "DICT_9X9"}, "OpenCV has none"),
        ({"columns": 30}, "larger dictionary"),
    ):
        with pytest.raises(BoardError, match=said):
            TwinBoard(rig, CHARUCO.model_copy(update=change), seed=1)
    with pytest.raises(BoardError, match="further away"):
        chessboard.pair(transform(np.eye(3), [0.0, 0.0, -0.3]))
