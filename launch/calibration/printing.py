"""Draw calibration boards as SVG, to be printed at true size.

The first square is black. The white squares of a ChArUco board contain the markers. As OpenCV's
detector requires, the marker numbers increase row by row.
"""

from __future__ import annotations

import cv2
import numpy as np

from flexsheet.launch.calibration.corners import describe, make_charuco_board
from flexsheet.messages.calibration import Board
from flexsheet.nodes.arrays import Bools, Floats

BORDER_SQUARES = 1.0
"""The width of the white border around the board, in squares. Detectors need this border."""

CAPTION_MM = 8.0
RULER_MM = 100.0


def find_black_rectangles(board: Board) -> Floats:
    """Return the n black rectangles of a board as an array (n, 4) of x, y, width and height, in m.

    The origin is the outer corner of the first square. Raises CalibrationError if the markers do
    not fit the board.
    """
    columns, rows, side = board.columns + 1, board.rows + 1, board.square_m
    squares = [
        (column * side, row * side, side, side)
        for row in range(rows)
        for column in range(columns)
        if (row + column) % 2 == 0
    ]
    if board.kind == "chessboard":
        return np.array(squares)
    dictionary = make_charuco_board(board).getDictionary()
    assert board.marker_m is not None
    cells = dictionary.markerSize + 2
    cell_m = board.marker_m / cells
    rim_m = 0.5 * (side - board.marker_m)
    white = [
        (row, column) for row in range(rows) for column in range(columns) if (row + column) % 2
    ]
    for marker, (row, column) in enumerate(white):
        image = cv2.aruco.generateImageMarker(dictionary, marker, cells)
        for y, x, width in _find_runs(np.asarray(image) == 0):
            left, top = column * side + rim_m + x * cell_m, row * side + rim_m + y * cell_m
            squares.append((left, top, width * cell_m, cell_m))
    return np.array(squares)


def _find_runs(black: Bools) -> list[tuple[int, int, int]]:
    """Return (row, first column, length) for each horizontal run of black cells in a marker image.

    black: marker image (rows, columns); true for black cells.
    """
    runs = []
    for y, row in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
        runs += [(y, int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return runs


def make_caption(board: Board) -> str:
    """Return the text that is printed below the board.

    The text describes the board and the print scale.
    """
    text = f"{describe(board)}, squares of {1e3 * board.square_m:g} mm"
    if board.marker_m is not None:
        text += f", markers of {1e3 * board.marker_m:g} mm, {board.dictionary}"
    return f"{text}. Print at 100 %; the line is {RULER_MM:g} mm long."


def make_svg(board: Board) -> str:
    """Return the board as SVG in millimetres, with a caption and a ruler."""
    border = 1e3 * BORDER_SQUARES * board.square_m
    width = 1e3 * (board.columns + 1) * board.square_m + 2 * border
    height = 1e3 * (board.rows + 1) * board.square_m + 2 * border
    parts = [
        f'<rect x="{border + 1e3 * x:.6g}" y="{border + 1e3 * y:.6g}" width="{1e3 * w:.6g}" '
        f'height="{1e3 * h:.6g}"/>'
        for x, y, w, h in find_black_rectangles(board)
    ]
    whole = height + 2 * CAPTION_MM
    ruler_y = height + 1.4 * CAPTION_MM
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{whole:g}mm" '
            f'viewBox="0 0 {width:g} {whole:g}">',
            f'<rect width="{width:g}" height="{whole:g}" fill="white"/>',
            *parts,
            f'<text x="{border:g}" y="{height + 0.8 * CAPTION_MM:g}" font-size="4" '
            f'font-family="sans-serif">{make_caption(board)}</text>',
            f'<path d="M {border:g} {ruler_y:g} h {RULER_MM:g}" stroke="black" '
            'stroke-width="0.3"/>',
            "</svg>\n",
        ]
    )
