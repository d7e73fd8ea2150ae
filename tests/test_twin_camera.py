"""Test the simulated rig and its images: boards, clutter, and the bound of the information."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import erf

from flexsheet.messages.calibration import Board
from flexsheet.messages.scene import Lens, Scene, StereoCamera
from flexsheet.nodes.arrays import Image
from flexsheet.nodes.models.rigid import transform, vector_from_rotation
from flexsheet.nodes.twin.board import BoardError, TwinBoard
from flexsheet.nodes.twin.clutter import (
    CLUTTER,
    Clutter,
    FixedPoint,
    Highlight,
    Occluder,
    Oscillation,
    SecondMarker,
    Sheet,
    covered,
    together,
    touching_highlight,
)
from flexsheet.nodes.twin.pixels import MAX_MOTION_STEPS, Sensor, TwinCamera, Window, disjoint
from flexsheet.nodes.twin.rig import make_true_camera, pixels_of, slopes_of
from tests.examples import examples
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]

CHESSBOARD = Board(columns=9, rows=6, square_m=0.025)
CHARUCO = Board(
    kind="charuco", columns=9, rows=6, square_m=0.025, marker_m=0.018, dictionary="DICT_4X4_50"
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


@pytest.fixture(scope="module")
def sheet(scene: Scene) -> StereoCamera:
    """Return the scene of the data sheet: ideal lenses, straight rig."""
    lens = Lens(fx_px=540.0, fy_px=540.0, cx_px=319.5, cy_px=239.5)
    assert scene.camera.left == scene.camera.right == lens
    return scene.camera


@pytest.fixture(scope="module")
def rig(sheet: StereoCamera) -> StereoCamera:
    return make_true_camera(sheet)


def test_a_device_name_is_one_rig_and_another_name_another(sheet: StereoCamera) -> None:
    rig, again = make_true_camera(sheet), make_true_camera(sheet)
    assert rig.model_dump_json() == again.model_dump_json()
    other = make_true_camera(sheet.model_copy(update={"device": "twin-bumblebee-2"}))
    assert other.left != rig.left
    assert not np.allclose(other.right_from_left, rig.right_from_left, atol=1e-5)


@given(device=st.text(min_size=1, max_size=20))
@examples(15)
def test_a_rig_differs_from_its_data_sheet_as_devices_do(sheet: StereoCamera, device: str) -> None:
    rig = make_true_camera(sheet.model_copy(update={"device": device}))
    for lens in (rig.left, rig.right):
        assert abs(lens.fx_px / 540.0 - 1.0) < 0.0101
        assert abs(lens.fy_px / lens.fx_px - 1.0) < 0.0011
        assert abs(lens.cx_px - 319.5) < 8.01
        assert -0.331 < lens.distortion[0] < -0.269
    assert rig.left != rig.right
    turn = np.linalg.norm(vector_from_rotation(rig.right_from_left[:3, :3]))
    assert 0.0 < turn < np.deg2rad(0.9)
    assert abs(np.linalg.norm(rig.right_from_left[:3, 3]) - 0.1205) < 0.00021
    assert rig.world_from_left == sheet.world_from_left


@given(u=st.floats(-0.85, 0.85), v=st.floats(-0.6, 0.6))
@examples(50)
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
    """Return the misfit of two blurred edges that cross at p[:2] to the image in a round window.

    Oblique edges are blurred differently than in this model, but symmetrically about the corner. A
    window centred on the corner therefore has no bias.
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
    """Return the crossing (2,) of the edges along the board's axes near a pixel."""
    angles = [np.arctan2(along[1], along[0]), np.arctan2(down[1], down[0])]
    guess = np.array([*near, *angles, 1.0, 80.0, 60.0, 0.0, 0.0])
    for _ in range(2):
        guess = least_squares(crossing_misfit, guess, args=(image, guess[:2])).x
    return np.asarray(guess[:2])


def test_corners_lie_where_the_optics_put_them(chessboard: TwinBoard) -> None:
    for pose in chessboard.poses(1):
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


def test_a_chessboard_is_found_whole_in_both_noisy_images(chessboard: TwinBoard) -> None:
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
    for pose in board.poses(1):
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


def test_a_boards_images_come_from_the_seed(rig: StereoCamera) -> None:
    pose = TwinBoard(rig, CHESSBOARD, seed=1).poses(1)[0]
    pictures = [TwinBoard(rig, CHESSBOARD, seed=seed).pair(pose)[0] for seed in (1, 1, 2)]
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


def test_boards_that_cannot_be_drawn_are_rejected(rig: StereoCamera, chessboard: TwinBoard) -> None:
    for change, printed in (
        ({"marker_m": None}, "needs the keys marker_m and dictionary"),
        ({"marker_m": 0.03}, "does not fit"),
        ({"dictionary": "DICT_9X9"}, "OpenCV has no dictionary DICT_9X9"),
        ({"columns": 30}, "larger dictionary"),
    ):
        with pytest.raises(BoardError, match=printed):
            TwinBoard(rig, CHARUCO.model_copy(update=change), seed=1)
    with pytest.raises(BoardError, match="hold the board farther away"):
        chessboard.pair(transform(np.eye(3), [0.0, 0.0, -0.3]))


TIP = np.array([0.01, 0.02, 0.01])


def still(_: float) -> Floats:
    return TIP


def looking(
    rig: StereoCamera, clutter: Clutter | None = None, sensor: Sensor | None = None, seed: int = 1
) -> TwinCamera:
    return TwinCamera(rig, finger_radius_m=0.007, seed=seed, sensor=sensor, clutter=clutter)


@pytest.fixture(scope="module")
def plain(rig: StereoCamera) -> TwinCamera:
    return looking(rig)


def of_the_mark(camera: TwinCamera, time_s: float = 0.0) -> tuple[Floats, Floats]:
    """Return the light (height, width) that the marker adds to each view."""
    lit, unlit = (
        camera.levels(still, exposure_s=0.004, marker=marker, time_s=time_s)
        for marker in (True, False)
    )
    left, right = (np.asarray(a, float) - b for a, b in zip(lit, unlit, strict=True))
    return left, right


def of_the_clutter(camera: TwinCamera, plain: TwinCamera, time_s: float = 0.0) -> list[Floats]:
    """Return the change of each view by clutter, for a camera with a plain background."""
    return [
        np.asarray(a, float) - b
        for a, b in zip(
            camera.levels(still, exposure_s=0.004, time_s=time_s),
            plain.levels(still, exposure_s=0.004),
            strict=True,
        )
    ]


def centre_and_spread(light: Floats) -> tuple[Floats, Floats]:
    """Return centre (2,) and variance (2,) of a light in pixels."""
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    centre = np.array([(light * x).sum(), (light * y).sum()]) / light.sum()
    off = np.array([(light * (x - centre[0]) ** 2).sum(), (light * (y - centre[1]) ** 2).sum()])
    return centre, off / light.sum()


@given(offset=st.tuples(*[st.floats(-0.06, 0.06)] * 2))
@examples(4)
def test_a_second_marker_is_at_the_requested_position(
    rig: StereoCamera, plain: TwinCamera, offset: tuple[float, float]
) -> None:
    if np.hypot(*offset) < 0.015:
        offset = (offset[0] + 0.03, offset[1])
    camera = looking(
        rig, Clutter(markers=(SecondMarker(FixedPoint((*offset, 0.0)), carried=True),))
    )
    ground = plain.levels(still, exposure_s=0.004)
    changes = of_the_clutter(camera, plain)
    for eye, change, under in zip(camera.eyes, changes, ground, strict=True):
        # Where it lies over the first mark's fringe it changes nothing.
        share = change / np.maximum(camera.sensor.marker_level - under, 5.0)
        place = eye.see(TIP + np.array([*offset, 0.0]))[0]
        assert np.abs(centre_and_spread(share)[0] - place).max() < 0.1


@pytest.mark.parametrize("overlap", [-0.5, 0.0, 0.5])
def test_a_highlight_overlaps_the_marker_as_requested(
    rig: StereoCamera, plain: TwinCamera, overlap: float
) -> None:
    camera = looking(rig, touching_highlight(overlap))
    for eye, light in zip(camera.eyes, of_the_clutter(camera, plain), strict=True):
        centre, _ = centre_and_spread(light)
        beside = TIP + np.array([0.0045 - overlap * 0.006, 0.0, 0.0])
        assert np.abs(centre - eye.see(beside)[0]).max() < 0.02
    left, _ = camera.picture(still, exposure_s=0.004)
    assert left.max() == 255


@given(share=st.floats(0.0, 1.0))
@examples(5)
def test_an_occluder_hides_the_requested_fraction_of_the_marker(
    rig: StereoCamera, plain: TwinCamera, share: float
) -> None:
    camera = looking(rig, covered(share, views="right"))
    whole, seen = of_the_mark(plain), of_the_mark(camera)
    assert seen[0].sum() == pytest.approx(whole[0].sum(), rel=1e-6)
    # What is hidden lies on finger and room, whose levels differ: hence the tolerance.
    assert seen[1].sum() / whole[1].sum() == pytest.approx(1.0 - share, abs=0.06)


def test_a_wholly_covered_marker_leaves_nothing_in_that_view(rig: StereoCamera) -> None:
    left, right = of_the_mark(looking(rig, covered(1.0, views="right")))
    assert left.max() > 100
    assert np.abs(right).max() < 0.1


@given(defocus_px=st.floats(0.0, 4.0))
@examples(4)
def test_out_of_focus_the_marker_spreads_as_in_optics_and_keeps_its_light(
    rig: StereoCamera, plain: TwinCamera, defocus_px: float
) -> None:
    even = Sensor(finger_level=0.0, background_level=0.0, texture_level=0.0, aperture_m=0.03)
    eye = plain.eyes[0]
    _, depth_m = eye.see(TIP)
    blurred = even.out_of_focus(defocus_px, depth_m, eye.lens.fx_px)
    light = of_the_mark(looking(rig, sensor=blurred))[0]
    sharp = of_the_mark(looking(rig, sensor=even.out_of_focus(0.0, depth_m, eye.lens.fx_px)))[0]
    centre, variance = centre_and_spread(light)
    assert np.abs(centre - eye.see(TIP)[0]).max() < 0.02
    # Room and finger have no light here, but for the least level of the room.
    assert light.sum() == pytest.approx(sharp.sum(), rel=0.02)
    grown = variance - centre_and_spread(sharp)[1]
    assert np.allclose(grown, defocus_px**2, rtol=0.05, atol=0.02)


def test_a_defocus_beyond_infinity_is_rejected() -> None:
    with pytest.raises(ValueError, match="aperture_m above"):
        Sensor(aperture_m=0.001).out_of_focus(3.0, 0.5, 540.0)


def test_a_finger_of_any_speed_is_drawn_at_a_bounded_number_of_positions(
    rig: StereoCamera,
) -> None:
    drawn_at: list[float] = []

    def position(at_s: float) -> NDArray[np.float64]:
        drawn_at.append(at_s)
        return TIP + at_s * np.array([1e9, 0.0, 0.0])

    looking(rig).picture(position, exposure_s=0.004)
    assert len(drawn_at) <= MAX_MOTION_STEPS + 2


def test_over_exposure_brightens_all_and_fills_the_marker(rig: StereoCamera) -> None:
    lab = CLUTTER["lab"]
    once, thrice = (
        looking(rig, lab, Sensor(exposure=factor, background_level=40.0)) for factor in (1.0, 3.0)
    )
    for lit, over in zip(
        once.levels(still, exposure_s=0.004), thrice.levels(still, exposure_s=0.004), strict=True
    ):
        assert np.allclose(3.0 * lit, over, rtol=1e-4)
    counts = [
        int((camera.picture(still, exposure_s=0.004)[0] == 255).sum()) for camera in (once, thrice)
    ]
    assert counts[0] == 0
    assert counts[1] > 25


def test_the_sheets_texture_is_in_its_plane(rig: StereoCamera) -> None:
    camera = looking(rig, Clutter(sheet=Sheet()))
    generator = np.random.default_rng(1)
    seen: list[list[float]] = [[], []]
    for x, y in generator.uniform(-0.11, 0.11, (400, 2)):
        for eye, levels in zip(camera.eyes, seen, strict=True):
            column, row = eye.see(np.array([x, y, 0.0]))[0]
            patch = cv2.getRectSubPix(eye.background, (1, 1), (float(column), float(row)))
            levels.append(float(patch[0, 0]))
    assert np.corrcoef(seen)[0, 1] > 0.9
    assert np.mean(seen[0]) == pytest.approx(Sheet().level, rel=0.1)
    column, row = camera.eyes[0].see(np.array([0.14, 0.0, 0.0]))[0].astype(int)
    assert camera.eyes[0].background[row, column] < 0.8 * Sheet().level


def test_a_lamps_image_may_be_in_one_view_only(rig: StereoCamera, plain: TwinCamera) -> None:
    place = (-0.09, 0.05, 0.0)
    spot = Highlight(FixedPoint(place), 0.0015, 300.0, views="left")
    camera = looking(rig, Clutter(highlights=(spot,)))
    left, right = of_the_clutter(camera, plain)
    assert np.abs(centre_and_spread(left)[0] - camera.eyes[0].see(np.array(place))[0]).max() < 0.02
    assert np.abs(right).max() == 0.0


def test_what_moves_is_where_its_path_is_at_that_time(rig: StereoCamera, plain: TwinCamera) -> None:
    path = Oscillation((0.0, 0.06, 0.0), (0.08, 0.0, 0.0), period_s=2.0)
    assert np.allclose(path.at(0.5), [0.08, 0.06, 0.0])
    camera = looking(rig, Clutter(highlights=(Highlight(path, 0.001, 200.0),)))
    for time_s in (0.0, 0.5):
        light = of_the_clutter(camera, plain, time_s)[1]
        place = camera.eyes[1].see(path.at(time_s))[0]
        assert np.abs(centre_and_spread(light)[0] - place).max() < 0.05


def test_an_occluder_passes_before_the_marker_and_away_again(rig: StereoCamera) -> None:
    ends = [
        Oscillation((0.0, y, 0.05), (0.1, 0.0, 0.0), period_s=4.0, phase_rad=-0.5 * np.pi)
        for y in (-0.3, 0.3)
    ]
    camera = looking(rig, Clutter(occluders=(Occluder(ends[0], ends[1], 0.01),)))
    light = [of_the_mark(camera, time_s)[0].max() for time_s in np.arange(0.0, 2.0, 0.1)]
    assert light[0] > 100
    assert light[-1] > 100
    assert min(light) < 1.0


def test_a_long_thing_that_the_lens_bends_is_drawn_whole(rig: StereoCamera) -> None:
    """In its middle it has its full width, with the ground on both sides."""
    ends = FixedPoint((-0.22, 0.35, -0.05)), FixedPoint((-0.22, -0.35, 0.35))
    camera = looking(rig, Clutter(occluders=(Occluder(*ends, radius_m=0.012, level=200.0),)))
    seen = camera.levels(still, exposure_s=0.004)
    for eye, levels in zip(camera.eyes, seen, strict=True):
        flanks = [eye.see(np.array([x, 0.0, 0.15]))[0] for x in (-0.232, -0.208)]
        wide_px = flanks[1][0] - flanks[0][0]
        row = levels[round(float(flanks[0][1]))]
        if flanks[0][0] > 5:
            assert (row > 140).sum() == pytest.approx(wide_px, abs=3)


@given(
    corners=st.lists(
        st.tuples(st.integers(0, 30), st.integers(0, 30), st.integers(1, 9), st.integers(1, 9)),
        max_size=8,
    )
)
def test_joined_windows_cover_each_pixel_once(corners: list[tuple[int, int, int, int]]) -> None:
    windows: list[Window] = [
        (slice(row, row + high), slice(column, column + wide))
        for row, column, high, wide in corners
    ]
    touched, joined = np.zeros((40, 40), int), np.zeros((40, 40), int)
    for window in windows:
        touched[window] = 1
    for window in disjoint(windows):
        joined[window] += 1
    assert joined.max(initial=0) <= 1
    assert (joined >= touched).all()


def test_images_come_from_the_seed_and_leave_nothing_behind(rig: StereoCamera) -> None:
    def film(seed: int) -> list[tuple[Image, Image]]:
        camera = looking(rig, CLUTTER["crowded"], seed=seed)
        before = camera.levels(lambda _: np.array([9.0, 0.0, 0.0]), exposure_s=0.004)
        frames = [camera.picture(still, exposure_s=0.004, time_s=time_s) for time_s in (0.0, 2.0)]
        after = camera.levels(lambda _: np.array([9.0, 0.0, 0.0]), exposure_s=0.004)
        assert np.array_equal(before, after)
        return frames

    assert np.array_equal(film(1), film(1))
    assert not np.array_equal(film(1), film(2))


def test_no_clutter_is_similar_to_a_marker(rig: StereoCamera) -> None:
    """No clutter is as bright over six pixels as half of the marker's height, or as large."""
    camera = looking(rig, CLUTTER["lab"])
    for image in camera.picture(still, exposure_s=0.004, marker=False):
        bright = (image > 140).astype(np.uint8)
        sizes = cv2.connectedComponentsWithStats(bright)[2][1:, cv2.CC_STAT_AREA]
        assert max(sizes.tolist(), default=0) < 6
        assert (image > 60).sum() > 20_000


def test_there_is_one_sheet() -> None:
    with pytest.raises(ValueError, match="2 sheets"):
        together(CLUTTER["lab"], CLUTTER["lab"])
