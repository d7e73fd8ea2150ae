"""Select image pairs of a board for a stereo calibration while the camera is running.

A pair is accepted if the board is at rest in a new pose and if the pair improves the coverage. The
coverage is complete if there are enough pairs in total, and enough pairs that meet each condition.
A condition is that the board is in a certain cell of the images, has a certain tilt, or is at a
certain distance.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from flexsheet.launch.calibration.bundle import board_pose, pose_transform
from flexsheet.launch.calibration.corners import (
    BoardPair,
    CornerFinder,
    board_points,
    match_views,
    measure_shift_px,
)
from flexsheet.messages.calibration import Board
from flexsheet.messages.scene import Lens
from flexsheet.nodes.arrays import Floats, Image

COLUMNS, ROWS = 4, 3
"""The numbers of columns and rows in the grid of cells that divides an image."""

MIN_CELL_CORNERS = 2
UPRIGHT_RAD = np.radians(12.0)
STILL_PX = 0.5
"""The board is at rest if its corners move by less than this distance (px) between two images."""

NEW_POSE_PX = 12.0
"""The minimum median displacement (px) of the board's corners between two accepted image pairs."""

TILTS = ("upright", "left side back", "right side back", "top back", "bottom back")
DISTANCES = ("near", "middle", "far")
NEAR, FAR = 0.55, 0.35
"""The relative sizes above which a board is near, and below which it is far.

The relative size is the length of the board's diagonal in the image, divided by the length of the
image's diagonal.
"""


class BinGroup(StrEnum):
    """The types of conditions that the image pairs of a calibration must meet (`Bin`).

    The user is asked to meet the conditions in the order of these types.
    """

    TILT = "tilt"
    DISTANCE = "distance"
    LEFT_CELL = "cell of the left image"
    RIGHT_CELL = "cell of the right image"
    PAIRS = "pairs"


@dataclass(frozen=True, slots=True)
class Bin:
    """A condition on an image pair, such as a certain tilt of the calibration board.

    A calibration needs a minimum number of image pairs that meet each condition.

    name: required tilt (from `TILTS`) or distance (from `DISTANCES`) of the board; empty for other
        conditions.
    cell: column and row of the image cell that must contain the board; None for other conditions.
    """

    group: BinGroup
    name: str = ""
    cell: tuple[int, int] | None = None


def compute_required_counts(pairs: int) -> dict[Bin, int]:
    """Return how many of `pairs` image pairs must meet each condition (`Bin`).

    Each image is divided into a grid of cells, in which the board must appear. The first column of
    the left image and the last column of the right image are exempt. At most distances, only one
    camera sees the board in these columns.
    """
    count = max(1, round(0.1 * pairs))
    required = {Bin(BinGroup.PAIRS): pairs}
    for row in range(ROWS):
        for column in range(COLUMNS):
            if column > 0:
                required[Bin(BinGroup.LEFT_CELL, cell=(column, row))] = count
            if column < COLUMNS - 1:
                required[Bin(BinGroup.RIGHT_CELL, cell=(column, row))] = count
    required.update({Bin(BinGroup.TILT, name): count for name in TILTS})
    required.update({Bin(BinGroup.DISTANCE, name): count for name in DISTANCES})
    return required


@dataclass(frozen=True, slots=True)
class PairAssessment:
    """The decision whether an image pair is used for the calibration.

    hint: instruction to the user for the next pose of the board.
    """

    accepted: bool
    hint: str


class Capture:
    """A selector of image pairs for a calibration.

    It counts the accepted pairs that meet each condition (`Bin`).
    """

    def __init__(
        self,
        board: Board,
        *,
        lens: Lens,
        size: tuple[int, int],
        pairs: int = 20,
        still_images: int = 4,
    ) -> None:
        """Create a selector of image pairs.

        lens: approximate intrinsics of the left camera.
        size: width and height of the images, px.
        pairs: number of image pairs to accept.
        still_images: number of consecutive images in which the board must be at rest.
        """
        self.board = board
        self.needed = compute_required_counts(pairs)
        self.counts: Counter[Bin] = Counter()
        self._lens = np.array(
            [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion[:4]]
        )
        self._size, self._still_images = size, still_images
        self._finder = CornerFinder(board, quick=True)
        self._points = board_points(board)
        self._middle = self._points.mean(axis=0)
        self._before: BoardPair | None = None
        self._still = 0
        self._accepted: list[BoardPair] = []

    @property
    def complete(self) -> bool:
        return not self.missing()

    def missing(self) -> list[Bin]:
        """Return the conditions that too few image pairs have met so far."""
        return [one for one, count in self.needed.items() if self.counts[one] < count]

    def add_pair(self, left: Image, right: Image) -> PairAssessment:
        """Decide whether to accept a pair of grey images (h, w), and count an accepted pair."""
        views = self._finder.find(left), self._finder.find(right)
        pair = match_views(*views, self.board, ("the left image", "the right image"))
        if isinstance(pair, str):
            self._before, self._still = None, 0
            return PairAssessment(False, pair)
        moved_px = (
            np.inf if self._before is None else measure_shift_px(pair.left, self._before.left)
        )
        self._before = pair
        self._still = self._still + 1 if moved_px < STILL_PX else 1
        if any(measure_shift_px(pair.left, one.left) < NEW_POSE_PX for one in self._accepted):
            return PairAssessment(False, self._make_hint("pose already captured; "))
        bins = self._find_bins(pair)
        adds = [one for one in bins if self.counts[one] < self.needed.get(one, 0)]
        if not adds:
            return PairAssessment(False, self._make_hint("enough pairs show this pose; "))
        if self._still < self._still_images:
            return PairAssessment(False, "keep the board still")
        self.counts.update(bins)
        self._accepted.append(pair)
        return PairAssessment(True, self._make_hint("accepted; "))

    def _find_bins(self, pair: BoardPair) -> list[Bin]:
        pose = board_pose(pair.left, self._points, self._lens)
        bins = [Bin(BinGroup.PAIRS), Bin(BinGroup.TILT, classify_tilt(pose, self._middle))]
        bins.append(Bin(BinGroup.DISTANCE, self._classify_distance(pose)))
        for group, view in ((BinGroup.LEFT_CELL, pair.left), (BinGroup.RIGHT_CELL, pair.right)):
            cells = np.floor(view.pixels / self._size * [COLUMNS, ROWS]).astype(int)
            cells = np.clip(cells, 0, [COLUMNS - 1, ROWS - 1])
            counts = Counter((int(column), int(row)) for column, row in cells)
            bins += [
                Bin(group, cell=cell)
                for cell, corners in counts.items()
                if corners >= MIN_CELL_CORNERS
            ]
        return bins

    def _classify_distance(self, pose: Floats) -> str:
        middle = pose_transform(pose) @ [*self._middle, 1.0]
        diagonal_m = self.board.square_m * np.hypot(self.board.columns + 1, self.board.rows + 1)
        fraction = self._lens[0] * diagonal_m / middle[2] / np.hypot(*self._size)
        return "near" if fraction > NEAR else "far" if fraction < FAR else "middle"

    def _make_hint(self, prefix: str) -> str:
        missing = self.missing()
        if not missing:
            return prefix + "all required poses of the board are captured"
        first = min(missing, key=lambda one: list(BinGroup).index(one.group))
        return f"{prefix}show the board {describe_requirement(first)}"


POSES = {
    "upright": "facing the camera",
    "left side back": "with its left side tilted back",
    "right side back": "with its right side tilted back",
    "top back": "with its top tilted back",
    "bottom back": "with its bottom tilted back",
    "near": "nearer",
    "middle": "at middle distance",
    "far": "further away",
    "": "in another pose",
}


def describe_requirement(one: Bin) -> str:
    """Describe where or how to show the board, such as "at the top left of the left image"."""
    if one.cell is None:
        return POSES[one.name]
    column, row = one.cell
    height = ("top", "middle", "bottom")[row]
    across = ("left", "centre left", "centre right", "right")[column]
    side = "left" if one.group is BinGroup.LEFT_CELL else "right"
    return f"at the {height} {across} of the {side} image"


def classify_tilt(pose: Floats, middle: Floats) -> str:
    """Return the tilt of a board relative to the line of sight, as one of TILTS.

    Only the direction of the board's normal matters. A rotation within the board's plane has no
    effect.

    pose: pose of the board (6,) in the left camera's frame.
    middle: centre of the board (3,), in m, in the board's frame.
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
