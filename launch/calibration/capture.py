"""Select board pairs during live capture: track the coverage and decide when to take a pair.

A pair is taken when the board is still at a new pose and adds coverage: of the cells of each image,
of tilts, of distances, or of the number of pairs.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.bundle import board_pose, pose_transform
from flexsheet.launch.calibration.corners import BoardPair, CornerFinder, board_points, match_views
from flexsheet.messages.calibration import Board
from flexsheet.messages.scene import Lens

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

COLUMNS, ROWS = 4, 3
"""Number of cells of an image."""

MIN_CELL_CORNERS = 2
UPRIGHT_RAD = np.radians(12.0)
STILL_PX = 0.5
"""The board is still when its corners move by less than this from image to image."""

NEW_POSE_PX = 12.0
"""A board pose is new when its corners are farther than this from those of any taken pair."""

TILTS = ("upright", "left side back", "right side back", "top back", "bottom back")
DISTANCES = ("near", "middle", "far")
NEAR, FAR = 0.55, 0.35
"""Fractions of the image's diagonal that the upright board's diagonal covers."""


@dataclass(frozen=True, slots=True)
class Bin:
    """Hold a quantity to be covered: group ("left cell", "right cell", "tilt", "distance", "pairs")
    and name.

    A cell's name is its column and row.
    """

    group: str
    name: str


def needed(pairs: int) -> dict[Bin, int]:
    """Return how often each bin must be covered for `pairs` pairs.

    Cells that only one camera sees at most distances (the left image's left edge, the right image's
    right edge) are not required.
    """
    often = max(1, round(0.1 * pairs))
    wanted = {Bin("pairs", ""): pairs}
    for row in range(ROWS):
        for column in range(COLUMNS):
            if column > 0:
                wanted[Bin("left cell", f"{column},{row}")] = often
            if column < COLUMNS - 1:
                wanted[Bin("right cell", f"{column},{row}")] = often
    wanted.update({Bin("tilt", name): often for name in TILTS})
    wanted.update({Bin("distance", name): often for name in DISTANCES})
    return wanted


@dataclass(frozen=True, slots=True)
class PairAssessment:
    """Hold the assessment of one image pair.

    hint: what the person should do with the board.
    """

    taken: bool
    hint: str


class Capture:
    """Assess image pairs and select those to take."""

    def __init__(
        self,
        board: Board,
        *,
        lens: Lens,
        size: tuple[int, int],
        pairs: int = 20,
        still_pictures: int = 4,
    ) -> None:
        """lens: of the left camera, approximately.  still_pictures: consecutive still images before
        a pair is taken."""
        self.board = board
        self.needed = needed(pairs)
        self.counts: Counter[Bin] = Counter()
        self._lens = np.array(
            [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion[:4]]
        )
        self._size, self._still_pictures = size, still_pictures
        self._finder = CornerFinder(board, quick=True)
        self._points = board_points(board)
        self._middle = self._points.mean(axis=0)
        self._before: BoardPair | None = None
        self._still = 0
        self._taken: list[BoardPair] = []

    @property
    def complete(self) -> bool:
        return not self.missing()

    def missing(self) -> list[Bin]:
        """Return the bins that lack coverage, in the order in which they are requested."""
        return [one for one, often in self.needed.items() if self.counts[one] < often]

    def see(self, left: Image, right: Image) -> PairAssessment:
        """Assess a pair of grey images (h, w); a taken one is counted."""
        views = self._finder.find(left), self._finder.find(right)
        pair = match_views(*views, self.board, ("the left picture", "the right picture"))
        if isinstance(pair, str):
            self._before, self._still = None, 0
            return PairAssessment(False, pair)
        moved_px = np.inf if self._before is None else _shift(pair, self._before)
        self._before = pair
        self._still = self._still + 1 if moved_px < STILL_PX else 1
        if any(_shift(pair, one) < NEW_POSE_PX for one in self._taken):
            return PairAssessment(False, self.advice("taken from here; "))
        bins = self.bins_of(pair)
        adds = [one for one in bins if self.counts[one] < self.needed.get(one, 0)]
        if not adds:
            return PairAssessment(False, self.advice("nothing new here; "))
        if self._still < self._still_pictures:
            return PairAssessment(False, "hold still")
        self.counts.update(bins)
        self._taken.append(pair)
        return PairAssessment(True, self.advice("taken; "))

    def bins_of(self, pair: BoardPair) -> list[Bin]:
        """Return the bins that a pair covers."""
        pose = board_pose(pair.left, self._points, self._lens)
        bins = [Bin("pairs", ""), Bin("tilt", classify_tilt(pose, self._middle))]
        bins.append(Bin("distance", self._distance(pose)))
        for group, view in (("left cell", pair.left), ("right cell", pair.right)):
            cell = np.floor(view.pixels / self._size * [COLUMNS, ROWS]).astype(int)
            cell = np.clip(cell, 0, [COLUMNS - 1, ROWS - 1])
            counts = Counter((int(column), int(row)) for column, row in cell)
            bins += [
                Bin(group, f"{column},{row}")
                for (column, row), corners in counts.items()
                if corners >= MIN_CELL_CORNERS
            ]
        return bins

    def _distance(self, pose: Floats) -> str:
        middle = pose_transform(pose) @ [*self._middle, 1.0]
        diagonal_m = self.board.square_m * np.hypot(self.board.columns + 1, self.board.rows + 1)
        fraction = self._lens[0] * diagonal_m / middle[2] / np.hypot(*self._size)
        return "near" if fraction > NEAR else "far" if fraction < FAR else "middle"

    def advice(self, before: str) -> str:
        """Return what to do with the board next, after the words `before`."""
        missing = self.missing()
        if not missing:
            return before + "all is covered"
        groups = {one.group: one for one in reversed(missing)}
        for group in ("tilt", "distance"):
            if group in groups:
                return f"{before}show the board {_as_order(groups[group])}"
        for side in ("left", "right"):
            if f"{side} cell" in groups:
                return f"{before}show the board {place(groups[f'{side} cell'])} the {side} picture"
        return before + "show the board somewhere else"


def _as_order(one: Bin) -> str:
    orders = {"upright": "straight on", "near": "nearer", "far": "further away"}
    if one.name == "middle":
        return "at middle distance"
    return orders.get(one.name, f"with its {one.name.replace(' back', ' tilted back')}")


def place(cell: Bin) -> str:
    """Describe the position of a cell: "at the top left of"."""
    column, row = (int(part) for part in cell.name.split(","))
    height = ("top", "middle", "bottom")[row]
    across = ("left", "centre left", "centre right", "right")[column]
    return f"at the {height} {across} of"


def classify_tilt(pose: Floats, middle: Floats) -> str:
    """Classify the tilt of a board pose (6,) in the left camera's frame as one of TILTS.

    It uses the board's normal, pointing towards the camera, so that the rotation of the board
    within its plane has no effect.

    middle: centre of the board (3,), in its own frame.
    """
    transform = pose_transform(pose)
    centre = transform[:3, :3] @ middle + transform[:3, 3]
    normal = transform[:3, 2]
    if normal @ centre > 0:
        normal = -normal
    sight = centre / np.linalg.norm(centre)
    if np.arccos(np.clip(-normal @ sight, -1.0, 1.0)) < UPRIGHT_RAD:
        return "upright"
    aside = normal + (-normal @ sight) * sight
    if abs(aside[0]) > abs(aside[1]):
        return "left side back" if aside[0] < 0 else "right side back"
    return "top back" if aside[1] < 0 else "bottom back"


def _shift(pair: BoardPair, other: BoardPair) -> float:
    """Return the median distance px by which common corners have moved; infinite without any."""
    _, here, there = np.intersect1d(
        pair.left.ids, other.left.ids, assume_unique=True, return_indices=True
    )
    if not len(here):
        return float("inf")
    shifts = pair.left.pixels[here] - other.left.pixels[there]
    return float(np.median(np.linalg.norm(shifts, axis=1)))
