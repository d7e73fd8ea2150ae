"""Choose poses of a calibration board, and render its images in the simulated stereo camera.

The rays of each pixel are intersected with the plane of the board. Edges of squares are antialiased
over the distance between rays. Therefore corners are accurate to a few thousandths of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.calibration import Board
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Lens, StereoCamera
from flexsheet.nodes.arrays import Floats, Image, Singles
from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.twin.pixels import Sensor, quantize
from flexsheet.nodes.twin.rig import pixels_of, slopes_of

RAYS = 3
"""The number of rays per pixel along each image axis."""

PAPER_LEVEL = 175.0
INK_LEVEL = 22.0
ROOM_LEVEL = 45.0
BORDER_SQUARES = 0.6
"""The width of the white border around the squares, divided by the side of a square."""

TILTS_RAD = (0.0, 0.35, 0.6, 0.45, 0.25)
HEIGHT_FRACTIONS = (0.95, 0.5, 0.75, 0.35, 0.6)
"""The fractions of the image height that the board would fill in successive poses if it were not
tilted. `TILTS_RAD` contains the tilts of the same poses."""

MARGIN_PX = 6.0
MIN_CHARUCO_FRACTION = 0.6
"""The minimum fraction of the corners of a ChArUco board that must be visible in both images."""

CHARUCO_NEARER = 1.2
"""The factor by which a ChArUco board appears larger in the image than a chessboard. Only a part of
a ChArUco board must be visible."""


class BoardError(FlexsheetError, ValueError):
    """Raised if a board cannot be rendered."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Light:
    """The uneven illumination of an image, and the background behind the board.

    gain: brightness factor at the image centre.
    slope_x, slope_y: relative change of the brightness from the centre to the right and lower
        edges.
    background: grey levels (height, width).
    """

    gain: float
    slope_x: float
    slope_y: float
    background: Singles


class TwinBoard:
    """A simulated stereo camera that views a calibration board.

    camera: true lenses and poses.
    seed: random seed of the noise, the illumination and the poses.
    """

    def __init__(self, camera: StereoCamera, board: Board, *, seed: int) -> None:
        self.camera = camera
        self.board = board
        self.sensor = Sensor()
        self._random = np.random.default_rng(seed)
        self._markers = _markers(board) if board.kind == "charuco" else None
        self._rays = tuple(self._cast(lens) for lens in (camera.left, camera.right))

    def _cast(self, lens: Lens) -> Singles:
        """Return the directions of RAYS x RAYS rays through each pixel of the camera image.

        The result contains x/z and y/z, shape (RAYS * height, RAYS * width, 2). The distortion
        varies little within a pixel. Directions within a pixel are therefore extrapolated linearly
        from its centre.
        """
        height, width = self.camera.height_px, self.camera.width_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        centre_rays = slopes_of(lens, pixels.astype(np.float64))
        down, right = np.gradient(centre_rays, axis=(0, 1))
        offsets = (np.arange(RAYS) + 0.5) / RAYS - 0.5
        rays = np.empty((RAYS * height, RAYS * width, 2), np.float32)
        for row, y in enumerate(offsets):
            for column, x in enumerate(offsets):
                rays[row::RAYS, column::RAYS] = centre_rays + x * right + y * down
        return rays

    def corners(self, left_from_board: Floats) -> tuple[Floats, Floats]:
        """Return the true pixel positions (rows * columns, 2) of the inner corners in both images.

        The corners are ordered row by row. Raises BoardError unless all corners lie in front of
        both cameras.
        """
        board = self.board
        grid = np.mgrid[: board.columns, : board.rows].T.reshape(-1, 2) * board.square_m
        points = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)
        left, right = self._views(left_from_board, points)
        return left, right

    def _views(self, left_from_board: Floats, points: Floats) -> list[Floats]:
        """Return the pixel positions (n, 2) of board points (n, 3), m, in each image.

        Raises BoardError unless all points lie in front of both cameras.
        """
        seen = []
        for lens, eye_from_left in (
            (self.camera.left, np.eye(4)),
            (self.camera.right, self.camera.right_from_left),
        ):
            in_eye = apply(eye_from_left @ left_from_board, points)
            if in_eye[:, 2].min() <= 0:
                raise BoardError(
                    "a part of the board is behind a camera; hold the board farther away"
                )
            seen.append(pixels_of(lens, in_eye[:, :2] / in_eye[:, 2:]))
        return seen

    def pair(self, left_from_board: Floats) -> tuple[Image, Image]:
        """Render the left and right image, with noise, of the board at a pose (4, 4)."""
        left, right = self.levels(left_from_board)
        return self._exposed(left), self._exposed(right)

    def _exposed(self, levels: Singles) -> Image:
        noise = self._random.standard_normal(levels.shape, dtype=np.float32)
        return quantize(levels + self.sensor.noise(levels) * noise)

    def levels(self, left_from_board: Floats) -> tuple[Singles, Singles]:
        """Render both images (height, width) of the board at a pose (4, 4), without noise."""
        self._views(left_from_board, self._outline())
        light = self._light()
        left, right = (
            self._drawn(rays, eye_from_left @ left_from_board, light)
            for rays, eye_from_left in zip(
                self._rays, (np.eye(4), self.camera.right_from_left), strict=True
            )
        )
        return left, right

    def _light(self) -> Light:
        gain, slope_x, slope_y = self._random.uniform([0.85, -0.2, -0.2], [1.1, 0.2, 0.2])
        coarse = self._random.standard_normal((12, 16), dtype=np.float32)
        size = (self.camera.width_px, self.camera.height_px)
        background = ROOM_LEVEL + 12.0 * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
        return Light(gain, slope_x, slope_y, np.clip(background, 5.0, 90.0).astype(np.float32))

    def _outline(self) -> Floats:
        """Return points (n, 3), m, on the outer edge of the white border, in the board's frame."""
        board = self.board
        low = -(1.0 + BORDER_SQUARES) * board.square_m
        high = np.array([board.columns, board.rows]) * board.square_m + BORDER_SQUARES * (
            board.square_m
        )
        shares = np.linspace(0.0, 1.0, 9)
        x, y = low + shares * (high[0] - low), low + shares * (high[1] - low)
        sides = [
            np.stack([x, np.full_like(x, low)], axis=1),
            np.stack([x, np.full_like(x, high[1])], axis=1),
            np.stack([np.full_like(y, low), y], axis=1),
            np.stack([np.full_like(y, high[0]), y], axis=1),
        ]
        flat = np.concatenate(sides)
        return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)

    def _drawn(self, rays: Singles, eye_from_board: Floats, light: Light) -> Singles:
        height, width = self.camera.height_px, self.camera.width_px
        levels = light.background.copy()
        in_eye = apply(eye_from_board, self._outline())
        lens = self.camera.left if rays is self._rays[0] else self.camera.right
        outline = pixels_of(lens, in_eye[:, :2] / in_eye[:, 2:])
        reach = 1 + int(np.ceil(4.0 * self.sensor.blur_px))
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - reach, 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + reach + 1, (width, height))
        if (low < high).all():
            window = slice(low[1], high[1]), slice(low[0], high[0])
            fine = rays[RAYS * low[1] : RAYS * high[1], RAYS * low[0] : RAYS * high[0]]
            paper, inside = self._seen(fine, eye_from_board)
            paper, inside = self._through_lens(paper), self._through_lens(inside)
            levels[window] += paper - inside * levels[window]
        x = np.linspace(-1.0, 1.0, width, dtype=np.float32)
        y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        falling = 1.0 - 0.12 * (x * x + y * y)
        lit = light.gain * (1.0 + light.slope_x * x + light.slope_y * y) * falling
        return np.asarray(levels * lit, dtype=np.float32)

    def _through_lens(self, fine: Singles) -> Singles:
        spread = RAYS * self.sensor.blur_px
        smooth = cv2.GaussianBlur(fine, (0, 0), spread, borderType=cv2.BORDER_REPLICATE)
        size = fine.shape[1] // RAYS, fine.shape[0] // RAYS
        # This interpolation method averages the rays of each pixel.
        return np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_AREA), np.float32)

    def _seen(self, rays: Singles, eye_from_board: Floats) -> tuple[Singles, Singles]:
        board = self.board
        plane_from_ray = np.linalg.inv(eye_from_board[:3, [0, 1, 3]]).astype(np.float32)
        on_plane = rays @ plane_from_ray[:, :2].T + plane_from_ray[:, 2]
        in_squares = on_plane[..., :2] / (on_plane[..., 2:] * np.float32(board.square_m))
        squares = np.asarray(in_squares + np.float32(1.0), dtype=np.float32)
        counts = (board.columns + 1, board.rows + 1)
        signs = []
        inside = printed = np.ones(rays.shape[:2], dtype=np.float32)
        for axis, count in enumerate(counts):
            place = squares[..., axis]
            width = _measure_rise(place)
            line = np.clip(np.rint(place), 1, count - 1)
            flip = 1.0 - 2.0 * (line.astype(np.int8) & 1).astype(np.float32)
            signs.append(flip * np.clip(2.0 * (place - line) / width, -1.0, 1.0))
            edge = np.minimum(place, count - place)
            printed = printed * np.clip(0.5 + edge / width, 0.0, 1.0)
            inside = inside * np.clip(0.5 + (edge + BORDER_SQUARES) / width, 0.0, 1.0)
        ink = 0.5 * (1.0 + signs[0] * signs[1])
        if self._markers is not None:
            ink = np.maximum(ink, _marker_ink(squares, self._markers, self._marker_share()))
        level = PAPER_LEVEL + (INK_LEVEL - PAPER_LEVEL) * ink * printed
        return np.asarray(level * inside, np.float32), np.asarray(inside, np.float32)

    def _marker_share(self) -> float:
        assert self.board.marker_m is not None
        return self.board.marker_m / self.board.square_m

    def poses(self, count: int) -> list[Floats]:
        """Return `count` poses left_from_board (4, 4) that are suitable for a calibration.

        The board appears at the centre, corners and edges of the image, at several distances, with
        tilts in all directions. At corners and edges, it is as far from the image centre as
        possible while both images show the whole board, or most of a ChArUco board.
        """
        board = self.board
        board_centre = 0.5 * board.square_m * np.array([board.columns - 1, board.rows - 1])
        height_m = (board.rows + 1 + 2 * BORDER_SQUARES) * board.square_m
        directions = [(0, 0), (-1, -1), (1, -1), (1, 1), (-1, 1), (-1, 0), (1, 0), (0, -1), (0, 1)]
        nearer = 1.0 if board.kind == "chessboard" else CHARUCO_NEARER
        poses: list[Floats] = []
        for number in range(count):
            share = nearer * HEIGHT_FRACTIONS[number % len(HEIGHT_FRACTIONS)]
            tilt_rad = TILTS_RAD[number % len(TILTS_RAD)] + self._random.uniform(0.0, 0.1)
            # Multiples of the golden angle: no two poses are tilted in the same direction.
            towards = 2.399963 * number
            turn = rotation_from_vector(
                tilt_rad * np.array([np.cos(towards), np.sin(towards), 0.0])
            ) @ rotation_from_vector([0.0, 0.0, self._random.uniform(-0.15, 0.15)])
            depth_m = self.camera.left.fy_px * height_m / (share * self.camera.height_px)
            direction = np.array(directions[number % len(directions)], dtype=np.float64)
            poses.append(self._place_board(turn, depth_m, direction, board_centre))
        return poses

    def _place_board(
        self, turn: Floats, depth_m: float, direction: Floats, board_centre: Floats
    ) -> Floats:
        """Return the pose left_from_board (4, 4) of a rotated board near the edge of the image.

        The board is moved in `direction` from the image centre as far as possible while it remains
        visible. A board that is too large at the distance `depth_m` is moved farther away.
        """
        between_m = -0.5 * float(self.camera.right_from_left[0, 3])
        half = 0.5 * np.array([self.camera.width_px, self.camera.height_px])
        reach = half / np.array([self.camera.left.fx_px, self.camera.left.fy_px])

        def posed(shares: Floats) -> Floats:
            centre = np.array([between_m, 0.0, depth_m])
            centre[:2] += 1.2 * shares * depth_m * reach * direction
            return transform(turn, centre - turn @ np.array([*board_centre, 0.0]))

        out = np.zeros(2)
        while not self._shown(posed(out)):
            depth_m *= 1.1
        for axis in range(2):
            tries = [np.where(np.arange(2) == axis, share, out) for share in np.linspace(1, 0, 41)]
            out = next(shares for shares in tries if self._shown(posed(shares)))
        return posed(out)

    def _shown(self, left_from_board: Floats) -> bool:
        whole = self.board.kind == "chessboard"
        try:
            views = self._views(left_from_board, self._outline())
        except BoardError:
            return False
        if not whole:
            views = list(self.corners(left_from_board))
        size = np.array([self.camera.width_px, self.camera.height_px])
        needed = 1.0 if whole else MIN_CHARUCO_FRACTION
        return all(
            np.mean(((view >= MARGIN_PX) & (view <= size - 1 - MARGIN_PX)).all(axis=1)) >= needed
            for view in views
        )


def _measure_rise(place: Singles) -> Singles:
    """Return the change (rows, columns) of a board coordinate between neighbouring rays.

    Only one ray per pixel is evaluated, because the change hardly varies within a pixel.

    place: board coordinate (rows, columns) of each ray.
    """
    rows, columns = place.shape
    step = RAYS if min(rows, columns) >= 2 * RAYS else 1
    rise = np.gradient(place[::step, ::step])
    width = np.hypot(rise[0], rise[1]) / np.float32(step)
    return np.repeat(np.repeat(width, step, axis=0), step, axis=1)


def _markers(board: Board) -> NDArray[np.bool_]:
    """Return an array (rows + 1, columns + 1, n, n) that is True where a marker's cell is black.

    rows, columns: numbers of inner corners of the ChArUco board.

    A marker has n cells per side, including its black border. Markers are numbered by row over the
    white squares. The first square of the board is black, as in OpenCV. Raises BoardError if the
    board has no valid markers, or more markers than its dictionary contains.
    """
    if board.marker_m is None or board.dictionary is None:
        raise BoardError(
            "board: a ChArUco board needs the keys marker_m and dictionary; give both keys"
        )
    if not 0 < board.marker_m < board.square_m:
        raise BoardError(
            f"board.marker_m: {board.marker_m:g} m does not fit into square_m = "
            f"{board.square_m:g} m; give a smaller, positive size"
        )
    number = getattr(cv2.aruco, board.dictionary, None)
    if not isinstance(number, int) or not board.dictionary.startswith("DICT_"):
        raise BoardError(
            f"board.dictionary: OpenCV has no dictionary {board.dictionary}; "
            "give the name of a dictionary in cv2.aruco,"
            " for instance DICT_4X4_50"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    cells = dictionary.markerSize + 2
    squares = [
        (row, column)
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
        if (row + column) % 2
    ]
    if len(squares) > len(dictionary.bytesList):
        raise BoardError(
            f"board: {len(squares)} white squares need a marker each, but {board.dictionary} has "
            f"only {len(dictionary.bytesList)} markers; choose a larger dictionary"
        )
    black = np.zeros((board.rows + 1, board.columns + 1, cells, cells), dtype=np.bool_)
    for marker, (row, column) in enumerate(squares):
        black[row, column] = cv2.aruco.generateImageMarker(dictionary, marker, cells) == 0
    return black


def _marker_ink(squares: Singles, markers: NDArray[np.bool_], share: float) -> Singles:
    """Return an array (...) that is 1 where a marker is black and 0 elsewhere.

    squares: board positions (..., 2) in units of squares.
    share: side length of a marker as a fraction of its square.
    """
    rows, columns, cells, _ = markers.shape
    column = np.clip(np.floor(squares[..., 0]).astype(np.intp), 0, columns - 1)
    row = np.clip(np.floor(squares[..., 1]).astype(np.intp), 0, rows - 1)
    at = np.stack([squares[..., 0] - column, squares[..., 1] - row], axis=-1)
    cell = np.floor((at - 0.5 * (1.0 - share)) * (cells / share)).astype(np.intp)
    within = ((cell >= 0) & (cell < cells)).all(axis=-1)
    cell = np.clip(cell, 0, cells - 1)
    ink = markers[row, column, cell[..., 1], cell[..., 0]] & within
    return np.asarray(ink, dtype=np.float32)
