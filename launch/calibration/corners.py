"""Detect the corners of calibration boards: complete chessboards and partly visible ChArUco boards.

The id of a corner is its index in the array that `board_points` returns. A corner has the same id
in every image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flexsheet.messages.calibration import Board
from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats, Image, Ints

Progress = Callable[[int, int, str], None]
"""A function that is called to report progress.

Its arguments are the number of finished steps, the number of all steps, and a description of the
last step.
"""

SCALE = 2
"""The factor by which images are enlarged before corners are refined.

OpenCV's refinement interpolates linearly between pixels. If images were not enlarged, this would
shift corners by 0.015 px and change the measured size of the board by 0.003 %. Also, more markers
are detected in enlarged images.
"""

MIN_CORNERS = 8
"""The minimum number of ChArUco corners in an image.

If there are fewer corners, the board's pose is inaccurate.
"""

MIN_HALF_WINDOW_PX, MAX_HALF_WINDOW_PX = 3, 15
"""The minimum and maximum of half the side length of the refinement window.

The unit is a pixel of the enlarged image.
"""

MAX_REFINEMENT_PX = 1.0
"""A ChArUco corner is rejected if the refinement moves it by this distance (px) or more.

The refinement has then found another edge.
"""

CHESSBOARD_SMOOTHING_PX = 1.0
CHARUCO_SMOOTHING_PX = 0.7
"""The standard deviation (px) of the Gaussian filter for ChArUco images.

The filter is narrow, because markers are close to the corners.
"""

REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-6)


class CalibrationError(FlexsheetError, ValueError):
    """Raised if images cannot be used for a calibration."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class BoardView:
    """The n board corners that were detected in one image.

    ids: ids (n,) of the corners, in ascending order.
    pixels: positions (n, 2) of the corners in the image, px.
    """

    ids: Ints
    pixels: Floats


@dataclass(frozen=True, slots=True)
class BoardPair:
    """The board corners in the two images of one board pose.

    The two images of a ChArUco board can show different corners.
    """

    left: BoardView
    right: BoardView

    def common(self) -> tuple[Ints, Floats, Floats]:
        """Return the corners that both images show.

        The result contains the ids (n,) of n corners, and their pixel positions (n, 2) in the left
        and in the right image.
        """
        ids, in_left, in_right = np.intersect1d(
            self.left.ids, self.right.ids, assume_unique=True, return_indices=True
        )
        return ids, self.left.pixels[in_left], self.right.pixels[in_right]


def measure_shift_px(view: BoardView, other: BoardView) -> float:
    """Return the median displacement (px) of the corners that two images have in common.

    The result is infinite if the images have no corners in common.
    """
    _, here, there = np.intersect1d(view.ids, other.ids, assume_unique=True, return_indices=True)
    if not len(here):
        return float("inf")
    return float(np.median(np.linalg.norm(view.pixels[here] - other.pixels[there], axis=1)))


def ignore_progress(done: int, total: int, what: str) -> None:
    """Do nothing. This is the progress callback for callers that do not display progress."""


def board_points(board: Board) -> Floats:
    """Return the positions (n, 3), in m, of the n corners in the board's frame.

    The corners are listed row by row.
    """
    points = np.zeros((board.rows * board.columns, 3))
    grid = np.mgrid[: board.columns, : board.rows].T.reshape(-1, 2)
    points[:, :2] = grid * board.square_m
    return points


def describe(board: Board) -> str:
    """Return a description of a board, such as "chessboard of 9x6 inner corners"."""
    name = {"chessboard": "chessboard", "charuco": "ChArUco board"}[board.kind]
    return f"{name} of {board.columns}x{board.rows} inner corners"


def make_charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Make the OpenCV object that describes a ChArUco board.

    Raises CalibrationError if the marker size or the dictionary is unsuitable.
    """
    name = board.dictionary or ""
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if board.marker_m is None or number is None:
        raise CalibrationError(
            f"the ChArUco board has the marker size {board.marker_m} m and the dictionary "
            f"{board.dictionary!r}: give the marker size and an OpenCV dictionary, such as "
            "DICT_4X4_50"
        )
    if board.marker_m >= board.square_m:
        raise CalibrationError(
            f"markers of {1e3 * board.marker_m:g} mm do not fit into squares of "
            f"{1e3 * board.square_m:g} mm: check both sizes"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    squares = (board.columns + 1, board.rows + 1)
    needed, available = squares[0] * squares[1] // 2, len(dictionary.bytesList)
    if needed > available:
        raise CalibrationError(
            f"a board of {squares[0]}x{squares[1]} squares needs {needed} markers, but {name} "
            f"contains only {available}; choose a larger dictionary"
        )
    return cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, dictionary)


def _charuco_detector(board: Board) -> cv2.aruco.CharucoDetector:
    """Make a ChArUco detector that accepts a corner even if only one adjacent marker is detected.

    By default, OpenCV requires two markers. A quarter of the corners would then be lost, mostly at
    the image's edge. Later steps correct or exclude wrong corners.
    """
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1
    return cv2.aruco.CharucoDetector(make_charuco_board(board), parameters)


class CornerFinder:
    """A detector of the corners of one calibration board.

    quick: whether to use OpenCV's fast check, which rejects images that show no chessboard.
    """

    def __init__(self, board: Board, *, quick: bool = False) -> None:
        self.board = board
        self._detector = _charuco_detector(board) if board.kind == "charuco" else None
        self._flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        if quick:
            self._flags |= cv2.CALIB_CB_FAST_CHECK

    def find(self, image: Image) -> BoardView | None:
        """Find the board corners in a grey image (h, w) with subpixel accuracy.

        Return None if too few corners are visible.
        """
        if self._detector is not None:
            return self._find_charuco(image)
        return self._find_chessboard(image)

    def _find_chessboard(self, image: Image) -> BoardView | None:
        board = self.board
        found, corners = cv2.findChessboardCorners(
            image, (board.columns, board.rows), flags=self._flags
        )
        if not found:
            return None
        start = np.asarray(corners.reshape(-1, 2), dtype=np.float64)
        half_px = 0.4 * _measure_spacing(start)
        pixels = _refine_corners(
            _enlarge(image), start, half_px, smoothing_px=CHESSBOARD_SMOOTHING_PX
        )
        return BoardView(np.arange(board.rows * board.columns), pixels)

    def _find_charuco(self, image: Image) -> BoardView | None:
        assert self._detector is not None
        assert self.board.marker_m is not None
        larger = _enlarge(image)
        corners, found, _, _ = self._detector.detectBoard(larger)
        if found is None or len(found) < MIN_CORNERS:
            return None
        order = np.argsort(found.ravel())
        ids = found.ravel()[order].astype(np.int64)
        in_larger = np.asarray(corners.reshape(-1, 2)[order], dtype=np.float64)
        start = (in_larger + 0.5) / SCALE - 0.5
        rim = 0.5 * (1.0 - self.board.marker_m / self.board.square_m)
        half_px = min(0.4, 0.7 * rim) * _measure_spacing(start)
        pixels = _refine_corners(larger, start, half_px, smoothing_px=CHARUCO_SMOOTHING_PX)
        last = np.array([image.shape[1], image.shape[0]]) - 1.0
        clear = np.minimum(start, last - start).min(axis=1) > half_px + 2.0
        sound = clear & (np.linalg.norm(pixels - start, axis=1) < MAX_REFINEMENT_PX)
        ids, pixels = ids[sound], pixels[sound]
        columns, rows = np.unique(ids % self.board.columns), np.unique(ids // self.board.columns)
        if len(ids) < MIN_CORNERS or min(len(columns), len(rows)) < 2:
            return None  # Corners in one line do not determine a pose.
        return BoardView(ids, pixels)


def _measure_spacing(pixels: Floats) -> Floats:
    """Return the distance (n,), in px, from each corner (n, 2) to the nearest other corner."""
    distances = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return np.asarray(distances.min(axis=1))


def _enlarge(image: Image) -> Image:
    """Enlarge an image by the factor SCALE.

    The pixel coordinate x becomes SCALE * (x + 1/2) - 1/2.
    """
    larger = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_CUBIC)
    return np.asarray(larger, dtype=np.uint8)


def _refine_corners(
    larger: Image, start: Floats, half_px: Floats, *, smoothing_px: float
) -> Floats:
    """Move corners to the nearby saddle points of the grey levels.

    Return the refined positions (n, 2). The window of a corner must not contain edges of a
    neighbouring corner or marker, because they would shift the corner by several pixels. Smoothing
    reduces noise and JPEG artefacts in the gradients.

    larger: image, enlarged by the factor SCALE.
    start: initial corners (n, 2).
    half_px: half side lengths (n,) of the windows.
    smoothing_px: standard deviation of the Gaussian filter.

    All lengths and positions are in pixels of the original image.
    """
    smooth = cv2.GaussianBlur(larger, (0, 0), SCALE * smoothing_px)
    halves = np.clip(SCALE * half_px, MIN_HALF_WINDOW_PX, MAX_HALF_WINDOW_PX).astype(int)
    refined = np.empty_like(start)
    for half in np.unique(halves):
        these = halves == half
        corners = (SCALE * (start[these] + 0.5) - 0.5).reshape(-1, 1, 2).astype(np.float32)
        window = (int(half), int(half))
        found = cv2.cornerSubPix(smooth, corners, window, (-1, -1), REFINEMENT)[:, 0]
        refined[these] = (found + 0.5) / SCALE - 0.5
    return refined


def align_numbering(left: Floats, right: Floats, board: Board) -> Floats:
    """Renumber the corners (n, 2) of the right image to match the left image.

    A detector can start its numbering at either end of the board, or at any corner of a square
    board. The cameras of a stereo rig are nearly parallel. Therefore, the rows and columns of the
    matching numbering have the same directions in both images.
    """
    grid = right.reshape(board.rows, board.columns, 2)
    turns = (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    numberings = [np.rot90(grid, turn, axes=(0, 1)).reshape(-1, 2) for turn in turns]

    def axes(corners: Floats) -> Floats:
        square = corners.reshape(board.rows, board.columns, 2)
        directions = np.stack([square[0, -1] - square[0, 0], square[-1, 0] - square[0, 0]])
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    target = axes(left)
    return max(numberings, key=lambda corners: float(np.sum(axes(corners) * target)))


def match_views(
    left: BoardView | None, right: BoardView | None, board: Board, names: tuple[str, str]
) -> BoardPair | str:
    """Combine the detected corners of two images of one board pose.

    If this is impossible, return the reason as text.

    names: names of the two images in this text.
    """
    if left is None or right is None:
        missing = [name for name, seen in zip(names, (left, right), strict=True) if seen is None]
        return f"no {describe(board)} found in {' and '.join(missing)}"
    if board.kind == "charuco":
        pair = BoardPair(left, right)
        shared = len(pair.common()[0])
        if shared < MIN_CORNERS:
            return f"{shared} common corners in both views, at least {MIN_CORNERS} are required"
        return pair
    return BoardPair(left, BoardView(right.ids, align_numbering(left.pixels, right.pixels, board)))


def read_gray(path: Path) -> Image:
    """Read an image file as grey levels (h, w). Raises CalibrationError if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise CalibrationError(f"{path}: the image cannot be read; check the path and the format")
    return np.asarray(image, dtype=np.uint8)


def compute_digest(left: Path, right: Path) -> str:
    """Return a hash of the contents of two image files, as 16 hexadecimal digits."""
    return hashlib.sha256(left.read_bytes() + right.read_bytes()).hexdigest()[:16]


def find_pairs(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    board: Board,
    progress: Progress = ignore_progress,
) -> tuple[list[BoardPair | str], tuple[int, int]]:
    """Find the board in all image pairs.

    Return a list and the (width, height) of the images, in px. For each pair, the list contains the
    corners, or the reason why they were not found.

    Raises CalibrationError if there are no images, if the numbers of left and right images differ,
    or if images are unreadable or have different sizes.
    """
    if len(left_paths) != len(right_paths):
        raise CalibrationError(
            f"there are {len(left_paths)} left and {len(right_paths)} right images; give the same "
            "number, in the same order"
        )
    if not left_paths:
        raise CalibrationError(
            "there are no images, because the file patterns match no file; check the patterns"
        )
    finder = CornerFinder(board)
    results: list[BoardPair | str] = []
    size: tuple[int, int] | None = None
    for number, paths in enumerate(zip(left_paths, right_paths, strict=True), start=1):
        views = []
        for path in paths:
            image = read_gray(path)
            image_size = (image.shape[1], image.shape[0])
            if size is not None and image_size != size:
                raise CalibrationError(
                    f"{path}: the image has {image_size[0]}x{image_size[1]} px, but the other "
                    f"images have {size[0]}x{size[1]} px; give images of one size"
                )
            size = image_size
            views.append(finder.find(image))
        left, right = views
        results.append(match_views(left, right, board, (paths[0].name, paths[1].name)))
        progress(number, len(left_paths), f"{paths[0].name}, {paths[1].name}")
    assert size is not None
    return results, size
