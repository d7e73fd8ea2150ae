"""Read, record and simulate poses of an arm with a calibration board on its flange.

The folder for `flexsheet calibrate arms` contains `joints.csv` and images. Each row of the table
describes one pose of the arm at rest. A row contains six joint angles (`j1_deg` ... `j6_deg`, or
`j1_rad` ... `j6_rad`) and the names of two image files (`left`, `right`). Instead of images, a row
can contain the pose of the board in the left camera's frame. The columns are then `board_x_m`,
`board_y_m`, `board_z_m` (position of the board's first corner), and `board_rx_rad`, `board_ry_rad`,
`board_rz_rad` (rotation vector).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flexsheet.launch.calibration.corners import (
    BoardPair,
    CornerFinder,
    Progress,
    board_points,
    find_pairs,
    match_views,
)
from flexsheet.launch.calibration.csv_rows import parse_finite, read_table
from flexsheet.launch.calibration.hand_eye import BoardDetection, CameraLens, CornerView, LensRig
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import Board, StereoCalibration
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Lens as SceneLens
from flexsheet.messages.scene import Pose, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.camera.image_pair import encode_png
from flexsheet.nodes.models.camera import camera_matrix, project
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    pose_matrix,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from flexsheet.nodes.twin.arms import ArmMechanics
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

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

MAX_STILL_RAD, MIN_STILL_S = 0.0005, 0.7
"""An arm is at rest if its joints move by at most this angle (rad) for this duration (s)."""

MIN_NEW_ROTATION_RAD, MIN_NEW_SHIFT_M = 0.05, 0.01
"""The minimum rotation (rad) and translation (m) between a new and a recorded pose of the board.

A pose is new if it differs from each recorded pose by at least one of these two minimums.
"""

SIMULATED_BASE_M, SIMULATED_BASE_RAD, SIMULATED_JOINT_RAD = 0.005, 0.01, 2e-4
"""The standard deviations of the random errors of a simulated arm.

The first two apply to the position (m) and the rotation (rad) of the arm's base. The third applies
to each joint angle (rad).
"""


class ArmPosesError(FlexsheetError, ValueError):
    """Raised if a folder of arm poses cannot be used for a calibration."""

    exit_code = 2


def make_lens_rig(scene: Scene, calibration: StereoCalibration | None) -> LensRig:
    """Return the intrinsics and extrinsics of the stereo camera.

    If a calibration is given, it provides the intrinsics and the transform between both cameras.
    Otherwise, the scene provides them. The camera's pose in the world always comes from the scene.
    """
    measured = scene.camera if calibration is None else calibration
    pose = scene.camera.world_from_left
    return LensRig(
        _make_camera_lens(measured.left),
        _make_camera_lens(measured.right),
        measured.right_from_left,
        pose_matrix(pose),
    )


def _make_camera_lens(lens: SceneLens) -> CameraLens:
    return CameraLens(
        camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px), np.array(lens.distortion)
    )


@dataclass(frozen=True, slots=True)
class PoseRow:
    """A row of the table of arm poses. The row contains either two image files or a board pose.

    joints_rad: joint angles (6,).
    images: left and right image file; None if the row contains a board pose.
    left_from_board: board pose (4, 4) in the left camera's frame; None if the row names images.
    """

    name: str
    joints_rad: Floats
    images: tuple[Path, Path] | None
    left_from_board: Floats | None


def read_pose_table(folder: Path) -> list[PoseRow]:
    """Read the table of arm poses from a folder.

    Raises ArmPosesError or BadInputError if the table is missing or invalid.
    """
    path = folder / TABLE
    table = read_table(path, ())
    lines = table.rows
    if not lines and not table.problems:
        raise ArmPosesError(f"{path}: the table has no rows; add one row per pose of the arm")
    columns = [name for name in table.columns if name]
    unit = next(
        (one for one in ("deg", "rad") if all(f"{j}_{one}" in columns for j in JOINTS)), None
    )
    if unit is None:
        raise ArmPosesError(
            f"{path}: the table has no joint angles (columns: {', '.join(columns)}); add "
            "the columns j1_deg to j6_deg, or j1_rad to j6_rad"
        )
    by_pose = all(name in columns for name in BOARD_COLUMNS)
    if not by_pose and not {"left", "right"} <= set(columns):
        raise ArmPosesError(
            f"{path}: the table has neither images nor board poses; add the columns left and "
            f"right, or {', '.join(BOARD_COLUMNS)}"
        )
    rows = []
    for number, line in lines:
        joints, pose = (
            np.array(
                [
                    parse_finite(f"{path}:{number}", name, line[name], table.problems)
                    for name in names
                ]
            )
            for names in ([f"{joint}_{unit}" for joint in JOINTS], BOARD_COLUMNS if by_pose else ())
        )
        joints_rad = np.radians(joints) if unit == "deg" else joints
        if by_pose:
            board = transform(rotation_from_vector(pose[3:]), pose[:3])
            rows.append(PoseRow(f"row {number}", joints_rad, None, board))
        else:
            images = (folder / line["left"], folder / line["right"])
            rows.append(PoseRow(line["left"] or f"row {number}", joints_rad, images, None))
    table.check()
    return rows


def read_detections(
    folder: Path, board: Board, rig: LensRig, size: tuple[int, int], progress: Progress
) -> tuple[list[BoardDetection], list[tuple[str, str]]]:
    """Read the arm poses from a folder, and detect the calibration board in the images.

    If the folder's pose table contains board poses instead of image names, the board corners are
    computed by projection into both cameras.

    Return the detections. Also return (pose name, reason) for each pose in which the board was not
    detected.

    rig: stereo camera.
    size: required (width, height) of the images, px.

    Raises ArmPosesError or BadInputError if the table is invalid, and CalibrationError if images
    cannot be used.
    """
    rows = read_pose_table(folder)
    if rows[0].images is None:
        return [_project_board(row, board, rig) for row in rows], []
    images = [row.images for row in rows if row.images is not None]
    pairs, found_size = find_pairs(
        [left for left, _ in images], [right for _, right in images], board, progress
    )
    if found_size != size:
        raise ArmPosesError(
            f"{folder}: the images have {found_size[0]}x{found_size[1]} px, but the camera's "
            f"calibration is for {size[0]}x{size[1]}; capture images of that size"
        )
    detections, missing = [], []
    for row, pair in zip(rows, pairs, strict=True):
        if isinstance(pair, str):
            missing.append((row.name, pair))
        else:
            detections.append(_make_detection(row.name, row.joints_rad, pair, board))
    return detections, missing


def _make_detection(name: str, joints_rad: Floats, pair: BoardPair, board: Board) -> BoardDetection:
    points = board_points(board)
    return BoardDetection(
        name,
        joints_rad,
        CornerView(points[pair.left.ids], pair.left.pixels),
        CornerView(points[pair.right.ids], pair.right.pixels),
    )


def _project_board(row: PoseRow, board: Board, rig: LensRig) -> BoardDetection:
    """Project the corners of a board with a known pose into both images, without noise.

    Raises ArmPosesError if the board is behind a camera.
    """
    assert row.left_from_board is not None
    points = board_points(board)
    views = []
    for lens, eye_from_left in ((rig.left, np.eye(4)), (rig.right, rig.right_from_left)):
        in_eye = apply(eye_from_left @ row.left_from_board, points)
        if in_eye[:, 2].min() <= 0.0:
            raise ArmPosesError(
                f"{row.name}: the board would be behind a camera; check the joint angles of this "
                "row of joints.csv"
            )
        views.append(CornerView(points, project(in_eye, lens.matrix, lens.distortion)))
    return BoardDetection(row.name, row.joints_rad, views[0], views[1])


class PoseRecorder:
    """A recorder that stores joint angles and images of a calibration board on an arm.

    It stores a pose whenever the arm is at rest and the board has a new pose. Joint angles and
    images must be added in the order of their times. All times (s) must come from the same clock.
    """

    def __init__(self, folder: Path, board: Board, rig: LensRig) -> None:
        self.count = 0
        self._folder, self._board, self._rig = folder, board, rig
        self._finder = CornerFinder(board, quick=True)
        self._joints: Floats | None = None
        self._still_since_s = math.inf
        self._poses: list[Floats] = []

    def update_joints(self, joints_rad: Floats, time_s: float) -> None:
        """Detect motion of the arm from joint angles (6,), in rad, measured at `time_s`."""
        moved = self._joints is None or np.abs(joints_rad - self._joints).max() > MAX_STILL_RAD
        if moved:
            self._joints, self._still_since_s = joints_rad, time_s

    def update_images(self, left: Image, right: Image, exposed_s: float) -> str:
        """Add an image pair, each (h, w), and store it if the pose of the board is new.

        Return an instruction to the user, or the reason why the pair was not stored.

        exposed_s: time of the exposure.
        """
        joints = self._joints
        if joints is None:
            return "no message from the arm yet"
        if exposed_s - self._still_since_s < MIN_STILL_S:
            return "the arm is moving"
        pair = match_views(
            self._finder.find(left), self._finder.find(right), self._board, ("left", "right")
        )
        if isinstance(pair, str):
            return pair
        pose = self._estimate_pose(pair)
        if any(_is_same_pose(pose, other) for other in self._poses):
            return "a similar pose is already recorded; rotate and move the flange"
        self._write(left, right, joints)
        self._poses.append(pose)
        return f"pose {self.count} recorded; rotate and move the flange"

    def _estimate_pose(self, pair: BoardPair) -> Floats:
        """Estimate the board's pose (4, 4) in the left camera's frame from the left image."""
        points = board_points(self._board)[pair.left.ids]
        lens = self._rig.left
        _, rotation, shift = cv2.solvePnP(points, pair.left.pixels, lens.matrix, lens.distortion)
        return transform(
            rotation_from_vector(np.asarray(rotation, np.float64).ravel()),
            np.asarray(shift, np.float64).ravel(),
        )

    def _write(self, left: Image, right: Image, joints_rad: Floats) -> None:
        self.count += 1
        names = [f"{side}{self.count:02}.png" for side in ("left", "right")]
        for name, image in zip(names, (left, right), strict=True):
            write_file(self._folder / name, encode_png(image))
        add_row(self._folder, names, joints_rad)


def add_row(folder: Path, names: list[str], joints_rad: Floats) -> None:
    """Append a pose to the table of joint angles in a folder.

    The table is created if it does not exist.

    names: names of the left and right image file.
    joints_rad: joint angles (6,).
    """
    path = folder / TABLE
    exists = path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        if not exists:
            writer.writerow(["left", "right", *(f"{joint}_rad" for joint in JOINTS)])
        writer.writerow([*names, *(repr(float(angle)) for angle in joints_rad)])


def _is_same_pose(pose: Floats, other: Floats) -> bool:
    rotation = float(np.linalg.norm(vector_from_rotation(pose[:3, :3].T @ other[:3, :3])))
    return (
        rotation < MIN_NEW_ROTATION_RAD
        and float(np.linalg.norm(pose[:3, 3] - other[:3, 3])) < MIN_NEW_SHIFT_M
    )


def draw_true_base(scene: Scene, side: Side, *, seed: int) -> Floats:
    """Draw a random true pose world_from_base (4, 4) of an arm, near its pose in the scene."""
    pose: Pose = getattr(scene.arms, side).world_from_base
    nominal = pose_matrix(pose)
    random = np.random.default_rng([seed, side == "left"])
    rotation = rotation_from_vector(random.normal(0.0, SIMULATED_BASE_RAD, 3))
    return transform(
        rotation @ nominal[:3, :3], nominal[:3, 3] + random.normal(0.0, SIMULATED_BASE_M, 3)
    )


class SimulatedArm:
    """A simulated arm that holds no sheet, and whose base pose and joint angles have errors.

    If an apparatus (true hardware parameters) is given, the arm has the base pose and the joint
    offsets of the apparatus. Each joint then rests at a random angle within its backlash.
    Otherwise, the base pose deviates at random from the scene, and each joint has random errors
    with the standard deviation SIMULATED_JOINT_RAD.
    """

    def __init__(self, scene: Scene, side: Side, apparatus: Apparatus | None, *, seed: int) -> None:
        self._random = np.random.default_rng([seed, side == "left", 2])
        self.mechanics = ArmMechanics(getattr(scene.arms, side).model)
        if apparatus is None:
            self.world_from_base = draw_true_base(scene, side, seed=seed)
            self._offsets_rad, self._backlash_rad = np.zeros(6), None
            return
        pose = getattr(apply_apparatus(scene, apparatus).arms, side).world_from_base
        self.world_from_base = pose_matrix(pose)
        truth = getattr(apparatus.arms, side)
        self._offsets_rad, self._backlash_rad = (
            np.array(truth.joint_offsets_rad),
            truth.backlash_rad,
        )

    def place_flange(self, joints_rad: Floats, *, exact: bool = False) -> Floats:
        """Return the true pose world_from_flange (4, 4) for reported joint angles (6,), in rad.

        exact: whether random joint errors are omitted.
        """
        if exact:
            errors = np.zeros(6)
        elif self._backlash_rad is None:
            errors = self._random.normal(0.0, SIMULATED_JOINT_RAD, 6)
        else:
            errors = 0.5 * self._backlash_rad * self._random.uniform(-1.0, 1.0, 6)
        true_rad = joints_rad + self._offsets_rad + errors
        in_range = np.clip(true_rad, *self.mechanics.range_rad.T)
        return self.world_from_base @ self.mechanics.forward(in_range)


def simulate_poses(
    scene: Scene,
    board: Board,
    side: Side,
    folder: Path,
    *,
    places: int,
    seed: int,
    apparatus: Apparatus | None = None,
) -> Iterator[int]:
    """Simulate images of a board on an arm, and write images and joint angles to a folder.

    The images have blur and noise. Yield the number of finished poses after each pose.

    places: number of poses.
    apparatus: true parameters of the camera and the arms. If None, the arms deviate at random from
        the scene.

    Raises BoardError if the board cannot be rendered.
    """
    random = np.random.default_rng([seed, side == "left", 1])
    true_camera = apply_apparatus(scene, apparatus).camera
    simulated = TwinBoard(make_true_camera(true_camera), board, seed=seed)
    arm = SimulatedArm(scene, side, apparatus, seed=seed)
    base = arm.world_from_base
    camera_pose = true_camera.world_from_left
    world_from_left = pose_matrix(camera_pose)
    middle = 0.5 * board.square_m * np.array([board.columns - 1.0, board.rows - 1.0, 0.0])
    # Put the board 60 mm in front of the flange; it faces the camera while the arm reaches forward.
    ready_rad = arm.mechanics.start_rad
    flange = base @ arm.mechanics.forward(ready_rad)
    position = flange[:3, 3] + 0.06 * flange[:3, 2]
    facing = transform(world_from_left[:3, :3], position - world_from_left[:3, :3] @ middle)
    flange_from_board = inverse(flange) @ facing
    done = 0
    while done < places:
        rotation = world_from_left[:3, :3] @ rotation_from_vector(random.normal(0.0, 0.3, 3))
        centre = position + random.uniform(-0.06, 0.06, 3)
        board_pose = transform(rotation, centre - rotation @ middle)
        try:
            joints = arm.mechanics.solve_inverse_kinematics(
                inverse(base) @ board_pose @ inverse(flange_from_board), ready_rad
            )
        except ValueError:
            continue  # The pose is out of reach: try another random one.
        left_from_board = inverse(world_from_left) @ arm.place_flange(joints) @ flange_from_board
        if not _is_in_both_views(simulated, left_from_board):
            continue
        done += 1
        names = [f"{one}{done:02}.png" for one in ("left", "right")]
        for name, image in zip(names, simulated.pair(left_from_board), strict=True):
            write_file(folder / name, encode_png(image))
        add_row(folder, names, joints)
        yield done


def _is_in_both_views(simulated: TwinBoard, left_from_board: Floats) -> bool:
    size = np.array([simulated.camera.width_px, simulated.camera.height_px])
    views = simulated.corners(left_from_board)
    return all(((view > 40.0) & (view < size - 40.0)).all() for view in views)
