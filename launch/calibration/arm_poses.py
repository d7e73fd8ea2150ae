"""Places of an arm with a board on its flange: the folders that `flexsheet calibrate arms` reads.

A folder holds `joints.csv` and the pictures that it names.  A row is a place where the arm stood
still: the six joints (`j1_deg` ... `j6_deg`, or `j1_rad` ...), and either the two pictures (`left`,
`right`: file names in the folder) or where the board was seen by other means, in the left camera's
frame (`board_x_m`, `board_y_m`, `board_z_m`, `board_rx_rad`, `board_ry_rad`, `board_rz_rad`: its
first corner, and its turn as a rotation vector).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.corners import (
    BoardPair,
    CornerFinder,
    Progress,
    board_points,
    find_pairs,
    match_views,
)
from flexsheet.launch.calibration.hand_eye import Lens, Rig, Sighting, View
from flexsheet.messages.calibration import Board, StereoCalibration
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Lens as SceneLens
from flexsheet.messages.scene import Pose, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.camera.image_pair import encode_png
from flexsheet.nodes.models.camera import camera_matrix, project
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_vector,
    transform,
    transform_from_rpy,
    vector_from_rotation,
)
from flexsheet.nodes.twin.arms import RANGE_RAD, solve_inverse_kinematics
from flexsheet.nodes.twin.arms import forward as twin_forward
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import make_true_camera

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

TABLE = "joints.csv"
JOINTS = tuple(f"j{number}" for number in range(1, 7))
BOARD_COLUMNS = (
    "board_x_m",
    "board_y_m",
    "board_z_m",
    "board_rx_rad",
    "board_ry_rad",
    "board_rz_rad",
)

STILL_RAD, STILL_S = 0.0005, 0.7
"""Joints that have stayed within the first for the second are at rest."""

OTHER_TURN_RAD, OTHER_M = 0.05, 0.01
"""A place is another one if the board is turned, or moved, by so much from all before."""

TWIN_BASE_M, TWIN_BASE_RAD, TWIN_JOINT_RAD = 0.005, 0.01, 2e-4
"""How far the twin's bases stand off the scene's, and its joints off what they say (deviations)."""


class PlacesError(FlexsheetError, ValueError):
    """A folder of places that cannot be used; the message names file, row and column."""

    code = "arm-poses"
    remedy = "Correct the row of joints.csv that the text names, or measure that pose again."


def rig_of(scene: Scene, calibration: StereoCalibration | None) -> Rig:
    """The stereo camera where the scene has it, with the calibration's optics or the scene's."""
    measured = scene.camera if calibration is None else calibration
    place = scene.camera.world_from_left
    return Rig(
        _lens(measured.left),
        _lens(measured.right),
        measured.right_from_left,
        transform_from_rpy(place.position_m, place.rpy_rad),
    )


def _lens(lens: SceneLens) -> Lens:
    return Lens(
        camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px), np.array(lens.distortion)
    )


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: joints (6,) rad, and pictures or the board's pose (4, 4)."""

    name: str
    joints_rad: Floats
    pictures: tuple[Path, Path] | None
    left_from_board: Floats | None


def read_table(folder: Path) -> list[Row]:
    """The rows of a folder's table; PlacesError says which cell is wrong."""
    path = folder / TABLE
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = tuple(reader.fieldnames or ())
            lines = list(reader)
    except OSError as error:
        raise PlacesError(f"{path}: cannot be read: {error.strerror}; see docs/arms.md") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise PlacesError(f"{path}: not a table of comma-separated values: {error}") from error
    unit = next(
        (one for one in ("deg", "rad") if all(f"{j}_{one}" in columns for j in JOINTS)), None
    )
    if unit is None:
        raise PlacesError(
            f"{path}: columns {', '.join(columns) or 'none'}; it needs j1_deg to j6_deg, or j1_rad "
            "to j6_rad"
        )
    by_pose = all(name in columns for name in BOARD_COLUMNS)
    if not by_pose and not {"left", "right"} <= set(columns):
        raise PlacesError(
            f"{path}: it needs the columns left and right (pictures), or {', '.join(BOARD_COLUMNS)}"
        )
    rows = []
    for number, line in enumerate(lines, start=2):
        joints = _numbers(path, number, line, [f"{joint}_{unit}" for joint in JOINTS])
        joints_rad = np.radians(joints) if unit == "deg" else joints
        if by_pose:
            pose = _numbers(path, number, line, BOARD_COLUMNS)
            board = transform(rotation_from_vector(pose[3:]), pose[:3])
            rows.append(Row(f"row {number}", joints_rad, None, board))
        else:
            pictures = (folder / (line["left"] or ""), folder / (line["right"] or ""))
            rows.append(Row(line["left"] or f"row {number}", joints_rad, pictures, None))
    if not rows:
        raise PlacesError(f"{path}: holds no rows; one for each place of the arm")
    return rows


def _numbers(
    path: Path, number: int, line: dict[str, str | None], columns: list[str] | tuple[str, ...]
) -> Floats:
    values = []
    for column in columns:
        text = line[column]
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise PlacesError(f"{path}: row {number}, column {column}: {text!r} is not a number")
        values.append(value)
    return np.array(values)


def read_sightings(
    folder: Path, board: Board, rig: Rig, size: tuple[int, int], progress: Progress
) -> tuple[list[Sighting], list[tuple[str, str]]]:
    """A folder's places with what was seen there; and which show nothing, with the reasons.

    size: (width, height) px that the pictures must have.  PlacesError, CalibrationError.
    """
    rows = read_table(folder)
    if rows[0].pictures is None:
        return [_drawn(row, board, rig) for row in rows], []
    pictures = [row.pictures for row in rows if row.pictures is not None]
    pairs, found_size = find_pairs(
        [left for left, _ in pictures], [right for _, right in pictures], board, progress
    )
    if found_size != size:
        raise PlacesError(
            f"{folder}: pictures of {found_size[0]}x{found_size[1]} px, the camera's calibration "
            f"is for {size[0]}x{size[1]}: take them at that size"
        )
    seen, blind = [], []
    for row, pair in zip(rows, pairs, strict=True):
        if isinstance(pair, str):
            blind.append((row.name, pair))
        else:
            seen.append(_sighting(row.name, row.joints_rad, pair, board))
    return seen, blind


def _sighting(name: str, joints_rad: Floats, pair: BoardPair, board: Board) -> Sighting:
    points = board_points(board)
    return Sighting(
        name,
        joints_rad,
        View(points[pair.left.ids], pair.left.pixels),
        View(points[pair.right.ids], pair.right.pixels),
    )


def _drawn(row: Row, board: Board, rig: Rig) -> Sighting:
    """A place known by the board's pose, as pictures without noise would show it."""
    assert row.left_from_board is not None
    points = board_points(board)
    views = []
    for lens, eye_from_left in ((rig.left, np.eye(4)), (rig.right, rig.right_from_left)):
        in_eye = apply(eye_from_left @ row.left_from_board, points)
        if in_eye[:, 2].min() <= 0.0:
            raise PlacesError(f"{row.name}: the board lies behind a camera; check its pose")
        views.append(View(points, project(in_eye, lens.matrix, lens.distortion)))
    return Sighting(row.name, row.joints_rad, views[0], views[1])


class PlaceTaker:
    """Takes a place into a folder whenever the arm rests and the board is seen somewhere new.

    Fed with what comes on the topics, in the order of the times (s, of one clock).
    """

    def __init__(self, folder: Path, board: Board, rig: Rig) -> None:
        self.taken = 0
        self._folder, self._board, self._rig = folder, board, rig
        self._finder = CornerFinder(board, quick=True)
        self._joints: Floats | None = None
        self._still_since_s = math.inf
        self._poses: list[Floats] = []

    def see_joints(self, joints_rad: Floats, time_s: float) -> None:
        """The arm's measured joints (6,)."""
        moved = self._joints is None or np.abs(joints_rad - self._joints).max() > STILL_RAD
        if moved:
            self._joints, self._still_since_s = joints_rad, time_s

    def see_pictures(self, left: Image, right: Image, exposed_s: float) -> str:
        """A pair of pictures (h, w); returns what to do, or that it was taken."""
        joints = self._joints
        if joints is None:
            return "no word from the arm yet"
        if exposed_s - self._still_since_s < STILL_S:
            return "the arm moves"
        pair = match_views(
            self._finder.find(left), self._finder.find(right), self._board, ("left", "right")
        )
        if isinstance(pair, str):
            return pair
        pose = self._pose(pair)
        if any(_alike(pose, other) for other in self._poses):
            return "the board was seen from here already; turn and move the flange"
        self._write(left, right, joints)
        self._poses.append(pose)
        return f"place {self.taken} taken; turn and move the flange"

    def _pose(self, pair: BoardPair) -> Floats:
        """left_from_board (4, 4), from the left picture: to tell places apart."""
        points = board_points(self._board)[pair.left.ids]
        lens = self._rig.left
        _, turn, shift = cv2.solvePnP(points, pair.left.pixels, lens.matrix, lens.distortion)
        return transform(
            rotation_from_vector(np.asarray(turn, np.float64).ravel()),
            np.asarray(shift, np.float64).ravel(),
        )

    def _write(self, left: Image, right: Image, joints_rad: Floats) -> None:
        self.taken += 1
        names = [f"{side}{self.taken:02}.png" for side in ("left", "right")]
        for name, picture in zip(names, (left, right), strict=True):
            write_file(self._folder / name, encode_png(picture))
        add_row(self._folder, names, joints_rad)


def add_row(folder: Path, names: list[str], joints_rad: Floats) -> None:
    """Add a place to a folder's table, which is begun where there is none."""
    path = folder / TABLE
    begun = path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        if not begun:
            writer.writerow(["left", "right", *(f"{joint}_rad" for joint in JOINTS)])
        writer.writerow([*names, *(repr(float(angle)) for angle in joints_rad)])


def _alike(pose: Floats, other: Floats) -> bool:
    turn = float(np.linalg.norm(vector_from_rotation(pose[:3, :3].T @ other[:3, :3])))
    return turn < OTHER_TURN_RAD and float(np.linalg.norm(pose[:3, 3] - other[:3, 3])) < OTHER_M


def true_base(scene: Scene, side: Side, *, seed: int) -> Floats:
    """world_from_base (4, 4) of the twin's arm, which stands somewhat off the scene's."""
    place: Pose = getattr(scene.arms, side).world_from_base
    given = transform_from_rpy(place.position_m, place.rpy_rad)
    random = np.random.default_rng([seed, side == "left"])
    turn = rotation_from_vector(random.normal(0.0, TWIN_BASE_RAD, 3))
    return transform(turn @ given[:3, :3], given[:3, 3] + random.normal(0.0, TWIN_BASE_M, 3))


def twin_places(
    scene: Scene, board: Board, side: Side, folder: Path, *, places: int, seed: int
) -> Iterator[int]:
    """Write what the twin's camera sees of a board on the twin's arm; yields after each place.

    Joints that do not give their true place by TWIN_JOINT_RAD each, pictures with blur and noise.
    BoardError for a board that cannot be drawn.
    """
    random = np.random.default_rng([seed, side == "left", 1])
    camera = make_true_camera(scene.camera)
    shown = TwinBoard(camera, board, seed=seed)
    base = true_base(scene, side, seed=seed)
    place = scene.camera.world_from_left
    world_from_left = transform_from_rpy(place.position_m, place.rpy_rad)
    middle = 0.5 * board.square_m * np.array([board.columns - 1.0, board.rows - 1.0, 0.0])
    ready = np.radians([0.0, 25.0, 119.0, 0.0, -54.0, 0.0])
    # The board looks at the camera while the arm reaches forward, 60 mm before the flange.
    flange = base @ twin_forward(ready)
    held = flange[:3, 3] + 0.06 * flange[:3, 2]
    facing = transform(world_from_left[:3, :3], held - world_from_left[:3, :3] @ middle)
    flange_from_board = inverse(flange) @ facing
    done = 0
    while done < places:
        turn = world_from_left[:3, :3] @ rotation_from_vector(random.normal(0.0, 0.3, 3))
        centre = held + random.uniform(-0.06, 0.06, 3)
        board_pose = transform(turn, centre - turn @ middle)
        try:
            joints = solve_inverse_kinematics(
                inverse(base) @ board_pose @ inverse(flange_from_board), ready
            )
        except ValueError:
            continue  # out of the arm's reach; another place is tried
        true_joints = np.clip(
            joints + random.normal(0.0, TWIN_JOINT_RAD, 6), RANGE_RAD[:, 0], RANGE_RAD[:, 1]
        )
        left_from_board = (
            inverse(world_from_left) @ base @ twin_forward(true_joints) @ flange_from_board
        )
        if not _in_both(shown, left_from_board):
            continue
        done += 1
        names = [f"{one}{done:02}.png" for one in ("left", "right")]
        for name, picture in zip(names, shown.pair(left_from_board), strict=True):
            write_file(folder / name, encode_png(picture))
        add_row(folder, names, joints)
        yield done


def _in_both(shown: TwinBoard, left_from_board: Floats) -> bool:
    """Whether all corners are well inside both pictures."""
    size = np.array([shown.camera.width_px, shown.camera.height_px])
    views = shown.corners(left_from_board)
    return all(((view > 40.0) & (view < size - 40.0)).all() for view in views)
