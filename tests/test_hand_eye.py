"""Test the poses of the arms' bases, measured from a board on the flange, and their uncertainty."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from flexsheet.launch.calibration.arm_poses import (
    MIN_STILL_S,
    TABLE,
    ArmPosesError,
    PoseRecorder,
    add_row,
    draw_true_base,
    make_lens_rig,
    read_detections,
    read_pose_table,
)
from flexsheet.launch.calibration.hand_eye import (
    BaseFit,
    BoardDetection,
    CornerView,
    HandEyeError,
    calibrate_base,
)
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.arms_calibration import ArmsCalibration
from flexsheet.messages.calibration import Board
from flexsheet.messages.calibration_file import CalibrationFileError
from flexsheet.messages.types import Side
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_rpy,
    rotation_from_vector,
    rpy_from_rotation,
    transform,
    vector_from_rotation,
)
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import pixels_of
from tests.commands import Command
from tests.examples import examples
from tests.rv_1a import (
    solve_inverse_kinematics,
    twin_forward,
)

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SCENE_FILE = ROOT / "launch" / "scenes" / "cylinder.yaml"
OPTICS_FILE = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"
SCENE = load_scene(SCENE_FILE)
RIG = make_lens_rig(SCENE, None)
BOARD = Board(columns=7, rows=5, square_m=0.015)
CORNERS = np.concatenate([np.mgrid[:7, :5].T.reshape(-1, 2) * 0.015, np.zeros((35, 1))], axis=1)
READY = np.radians([0.0, 25.0, 119.0, 0.0, -54.0, 0.0])
SIZE = (SCENE.camera.width_px, SCENE.camera.height_px)


def seen(left_from_board: Floats, noise: Floats) -> list[CornerView]:
    """Project the corners with the simulator; noise (2, 35, 2) px."""
    views = []
    for lens, eye_from_left, off in zip(
        (SCENE.camera.left, SCENE.camera.right),
        (np.eye(4), SCENE.camera.right_from_left),
        noise,
        strict=True,
    ):
        in_eye = apply(eye_from_left @ left_from_board, CORNERS)
        views.append(CornerView(CORNERS, pixels_of(lens, in_eye[:, :2] / in_eye[:, 2:]) + off))
    return views


class Workplace:
    """Simulated arm with a board on its flange, in front of the camera."""

    def __init__(self, seed: int, side: Side = "left") -> None:
        self.random = np.random.default_rng(seed)
        self.base = draw_true_base(SCENE, side, seed=seed)
        flange = self.base @ twin_forward(READY)
        self.held = flange[:3, 3] + 0.06 * flange[:3, 2]
        facing = RIG.world_from_left[:3, :3]
        middle = CORNERS.mean(axis=0)
        board = transform(facing, self.held - facing @ middle)
        self.flange_from_board = inverse(flange) @ board

    def joints(self, rotation_rad: Floats, shift_m: Floats) -> Floats:
        """Return joints that rotate the board (rotation vector, in the camera's axes) and shift
        it."""
        rotation = RIG.world_from_left[:3, :3] @ rotation_from_vector(rotation_rad)
        board = transform(rotation, self.held + shift_m - rotation @ CORNERS.mean(axis=0))
        return solve_inverse_kinematics(
            inverse(self.base) @ board @ inverse(self.flange_from_board), READY
        )

    def detection(
        self, name: str, joints: Floats, *, noise_px: float = 0.0, joint_noise_rad: float = 0.0
    ) -> BoardDetection:
        true = joints + self.random.normal(0.0, 1.0, 6) * joint_noise_rad
        left_from_board = (
            inverse(RIG.world_from_left) @ self.base @ twin_forward(true) @ self.flange_from_board
        )
        left, right = seen(left_from_board, self.random.normal(0.0, 1.0, (2, 35, 2)) * noise_px)
        return BoardDetection(name, joints, left, right)

    def detections(
        self,
        count: int,
        *,
        noise_px: float = 0.0,
        joint_noise_rad: float = 0.0,
        rotation_rad: Any = 0.3,
    ) -> list[BoardDetection]:
        """Simulate detections; rotation_rad: standard deviation of the rotations, for all
        axes or for each."""
        found: list[BoardDetection] = []
        while len(found) < count:
            turn = self.random.normal(0.0, 1.0, 3) * rotation_rad
            try:
                joints = self.joints(turn, self.random.uniform(-0.06, 0.06, 3))
            except ValueError:
                continue
            name = f"place {len(found)}"
            found.append(
                self.detection(name, joints, noise_px=noise_px, joint_noise_rad=joint_noise_rad)
            )
        return found

    def error(self, fit: BaseFit) -> Floats:
        """Return the motion (6,) from the estimated base to the true one."""
        turn = self.base[:3, :3] @ fit.world_from_base[:3, :3].T
        shift = self.base[:3, 3] - fit.world_from_base[:3, 3]
        return np.concatenate([vector_from_rotation(turn), shift])


@pytest.mark.parametrize("side", ["left", "right"])
def test_without_noise_the_base_is_found_exactly(side: Side) -> None:
    place = Workplace(1, side)
    fit = calibrate_base(place.detections(10), RIG)
    assert place.error(fit) == pytest.approx(np.zeros(6), abs=1e-7)
    assert fit.flange_from_board == pytest.approx(place.flange_from_board, abs=1e-7)
    assert all(one.reason == "" for one in fit.residuals)


@pytest.mark.long
@pytest.mark.parametrize(
    ("noise_px", "joint_noise_rad"),
    [
        pytest.param(0.1, 0.0, marks=pytest.mark.long, id="camera's noise"),
        pytest.param(0.1, 2e-4, id="both"),
        pytest.param(0.02, 1e-3, marks=pytest.mark.long, id="arm's noise"),
    ],
)
def test_the_errors_are_within_the_stated_uncertainty(
    noise_px: float, joint_noise_rad: float
) -> None:
    squares = []
    for seed in range(6):
        place = Workplace(100 + seed)
        fit = calibrate_base(
            place.detections(15, noise_px=noise_px, joint_noise_rad=joint_noise_rad), RIG
        )
        error = place.error(fit)
        squares.append(float(error @ np.linalg.solve(fit.covariance, error)))
        assert all(one.reason == "" for one in fit.residuals)
        assert fit.corner_sigma_px == pytest.approx(noise_px, rel=0.15)
    # Chi-square with six degrees of freedom each: neither boasting nor over-cautious.
    assert max(squares) < chi2.ppf(0.9999, 6)
    assert chi2.ppf(1e-4, 36) < sum(squares) < chi2.ppf(0.999, 36)


def test_the_arms_error_is_separated_from_the_cameras() -> None:
    place = Workplace(7)
    fit = calibrate_base(place.detections(25, noise_px=0.05, joint_noise_rad=1e-3), RIG)
    # Three wrist joints and what the others add: somewhat more than one joint's deviation.
    assert 0.8e-3 < fit.arm_sigma_rad < 2.5e-3
    assert 1e-4 < fit.arm_sigma_m < 1e-3
    assert fit.corner_sigma_px == pytest.approx(0.05, rel=0.1)
    quiet = calibrate_base(Workplace(7).detections(25, noise_px=0.05), RIG)
    assert quiet.arm_sigma_rad < 1e-4
    assert quiet.compute_std(np.zeros(3))[0] < 0.2 * fit.compute_std(np.zeros(3))[0]


def test_more_poses_reduce_the_uncertainty() -> None:
    few, many = (
        calibrate_base(Workplace(3).detections(n, noise_px=0.1, joint_noise_rad=5e-4), RIG)
        for n in (8, 30)
    )
    assert many.compute_std(np.zeros(3))[0] < 0.6 * few.compute_std(np.zeros(3))[0]


@pytest.mark.parametrize("strays", [1, 3])
def test_poses_with_wrong_joints_are_excluded(strays: int) -> None:
    place = Workplace(5)
    detections = place.detections(14, noise_px=0.1, joint_noise_rad=2e-4)
    for index in range(strays):
        one = detections[index]
        wrong = one.joints_rad + place.random.normal(0.0, 0.05, 6)
        detections[index] = BoardDetection(one.name, wrong, one.left, one.right)
    fit = calibrate_base(detections, RIG)
    left_out = [one.name for one in fit.residuals if one.reason]
    assert left_out == [f"place {index}" for index in range(strays)]
    error = place.error(fit)
    assert float(error @ np.linalg.solve(fit.covariance, error)) < chi2.ppf(0.9999, 6)
    assert len(fit.leave_one_out) == 14 - strays


def test_a_board_read_from_its_other_end_is_left_out() -> None:
    place = Workplace(15)
    detections = place.detections(10, noise_px=0.1)
    one = detections[3]
    left, right = (
        CornerView(view.points_board, view.pixels[::-1].copy()) for view in (one.left, one.right)
    )
    detections[3] = BoardDetection(one.name, one.joints_rad, left, right)
    fit = calibrate_base(detections, RIG)
    assert [each.name for each in fit.residuals if each.reason] == ["place 3"]


def test_inconsistent_poses_are_an_error() -> None:
    place = Workplace(6)
    detections = place.detections(12, noise_px=0.1)
    shuffled = [
        BoardDetection(one.name, other.joints_rad, one.left, one.right) if index % 2 else one
        for index, (one, other) in enumerate(
            zip(detections, [*detections[5:], *detections[:5]], strict=True)
        )
    ]
    with pytest.raises(
        HandEyeError, match=r"contradict .*check that the joint angles are measured"
    ):
        calibrate_base(shuffled, RIG)


@pytest.mark.parametrize(
    ("rotation_rad", "words"),
    [
        (0.0, "rotates by only 0.0 degrees rms"),
        (0.02, "rotates by only"),
        ([0.0, 0.0, 0.4], "rotates about one axis only"),
        ([0.4, 0.0, 0.0], "rotates about one axis only"),
        ([0.4, 0.03, 0.03], "rotates about one axis only"),
    ],
)
def test_motions_that_leave_it_open_are_rejected(rotation_rad: Any, words: str) -> None:
    detections = Workplace(8).detections(12, noise_px=0.1, rotation_rad=rotation_rad)
    with pytest.raises(HandEyeError, match=words):
        calibrate_base(detections, RIG)


def test_too_few_poses_are_rejected() -> None:
    with pytest.raises(HandEyeError, match="there are 5 arm poses, but at least 6 are required"):
        calibrate_base(Workplace(9).detections(5), RIG)


@pytest.mark.parametrize("joints", [np.full(6, np.nan), np.zeros(5)])
def test_joints_that_are_none_are_named(joints: Floats) -> None:
    detections = Workplace(9).detections(6)
    one = detections[2]
    detections[2] = BoardDetection(one.name, joints, one.left, one.right)
    with pytest.raises(HandEyeError, match="place 2: expected six finite joint angles"):
        calibrate_base(detections, RIG)


def test_the_same_poses_give_the_same_result() -> None:
    detections = Workplace(4).detections(8, noise_px=0.1, joint_noise_rad=2e-4)
    first, second = (calibrate_base(detections, RIG) for _ in range(2))
    assert (first.world_from_base == second.world_from_base).all()
    assert (first.covariance == second.covariance).all()


@examples(50)
@given(st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3))
def test_roll_pitch_yaw_there_and_back(rpy: list[float]) -> None:
    rotation = rotation_from_rpy(rpy)
    assert rotation_from_rpy(rpy_from_rotation(rotation)) == pytest.approx(rotation, abs=1e-8)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_roll_pitch_yaw_of_straight_up_and_down(pitch: float) -> None:
    rotation = rotation_from_rpy([0.3, pitch, 0.5])
    assert rotation_from_rpy(rpy_from_rotation(rotation)) == pytest.approx(rotation, abs=1e-9)


def write_poses(
    folder: Path, detections: list[BoardDetection], place: Workplace, unit: str
) -> None:
    """Write a table with the board's poses instead of images."""
    names = ("board_x_m", "board_y_m", "board_z_m", "board_rx_rad", "board_ry_rad", "board_rz_rad")
    with (folder / TABLE).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*(f"j{n}_{unit}" for n in range(1, 7)), *names])
        for one in detections:
            pose = (
                inverse(RIG.world_from_left)
                @ place.base
                @ twin_forward(one.joints_rad)
                @ place.flange_from_board
            )
            joints = np.degrees(one.joints_rad) if unit == "deg" else one.joints_rad
            turn = vector_from_rotation(pose[:3, :3])
            writer.writerow([repr(float(v)) for v in (*joints, *pose[:3, 3], *turn)])


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_table_of_board_poses_will_do(tmp_path: Path, unit: str) -> None:
    place = Workplace(11)
    write_poses(tmp_path, place.detections(8), place, unit)
    detections, blind = read_detections(tmp_path, BOARD, RIG, SIZE, lambda *_: None)
    assert blind == []
    assert place.error(calibrate_base(detections, RIG)) == pytest.approx(np.zeros(6), abs=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("", "is empty; start with"),
        ("left,right\na,b\n", r"has no joint angles \(columns: left, right\); add the columns j1"),
        ("left,right,j1_deg\na,b,0\n", "add the columns j1_deg to j6_deg"),
        (
            "j1_deg,j2_deg,j3_deg,j4_deg,j5_deg,j6_deg\n0,0,0,0,0,0\n",
            "neither images nor board poses; add the columns left and right",
        ),
        ("left,right,j1_deg,j2_deg,j3_deg,j4_deg,j5_deg,j6_deg\n", "the table has no rows"),
        (
            "left,right,j1_deg,j2_deg,j3_deg,j4_deg,j5_deg,j6_deg\na,b,0,0,x,0,0,0\n",
            'joints.csv:2: j3_deg: expected a number, found "x"; write a number',
        ),
        (
            "left,right,j1_deg,j2_deg,j3_deg,j4_deg,j5_deg,j6_deg\na,b,0,0,0,0,0,nan\n",
            "joints.csv:2: j6_deg",
        ),
        (
            "left,right,j1_deg,j2_deg,j3_deg,j4_deg,j5_deg,j6_deg\na,b,0,0\n",
            "csv:2: expected 8 values, found 4",
        ),
        ("\x00\xff", "the table has no rows"),
    ],
)
def test_a_bad_table_is_named_to_the_cell(tmp_path: Path, text: str | None, words: str) -> None:
    if text is not None:
        (tmp_path / TABLE).write_text(text)
    with pytest.raises((ArmPosesError, BadInputError), match=words):
        read_pose_table(tmp_path)


def test_a_board_behind_the_camera_is_rejected(tmp_path: Path) -> None:
    header = ",".join([*(f"j{n}_deg" for n in range(1, 7)), "board_x_m", "board_y_m", "board_z_m"])
    (tmp_path / TABLE).write_text(
        f"{header},board_rx_rad,board_ry_rad,board_rz_rad\n0,25,119,0,-54,0,0,0,-0.5,0,0,0\n"
    )
    with pytest.raises(ArmPosesError, match="row 2: the board would be behind a camera"):
        read_detections(tmp_path, BOARD, RIG, SIZE, lambda *_: None)


class LiveCapture:
    """PoseRecorder with images of the simulated camera and a separate clock."""

    def __init__(self, folder: Path) -> None:
        self.place = Workplace(12)
        self.taker = PoseRecorder(folder, BOARD, RIG)
        self.shown = TwinBoard(SCENE.camera, BOARD, seed=1)
        self.now_s = 0.0

    def show(self, joints: Floats, *, wait_s: float = 2.0 * MIN_STILL_S) -> str:
        self.taker.update_joints(joints, self.now_s)
        self.now_s += wait_s
        pose = (
            inverse(RIG.world_from_left)
            @ self.place.base
            @ twin_forward(joints)
            @ self.place.flange_from_board
        )
        return self.taker.update_images(*self.shown.pair(pose), self.now_s)


def test_a_pose_is_recorded_when_the_arm_rests_at_a_new_one(tmp_path: Path) -> None:
    live = LiveCapture(tmp_path)
    dark = np.zeros((480, 640), np.uint8)
    assert live.taker.update_images(dark, dark, 0.0) == "no message from the arm yet"
    here = live.place.joints(np.array([0.1, 0.2, 0.0]), np.zeros(3))
    there = live.place.joints(np.array([-0.2, 0.1, 0.1]), np.full(3, 0.02))
    assert live.show(here, wait_s=0.1) == "the arm is moving"
    assert live.show(here).startswith("pose 1 recorded")
    assert "a similar pose is already recorded" in live.show(here)
    assert live.show(there).startswith("pose 2 recorded")
    live.taker.update_joints(there, live.now_s)
    assert live.taker.update_images(dark, dark, live.now_s + 5.0).startswith("no chessboard")
    detections, blind = read_detections(tmp_path, BOARD, RIG, SIZE, lambda *_: None)
    assert blind == []
    assert [one.name for one in detections] == ["left01.png", "left02.png"]
    assert detections[1].joints_rad == pytest.approx(there, abs=1e-12)


COMMON = ("--scene", SCENE_FILE, "--board", "7x5", "--square-mm", "15")


def test_the_twins_arms_are_calibrated_from_images(flexsheet: Command, tmp_path: Path) -> None:
    output, copy = tmp_path / "arms.yaml", tmp_path / "copy.yaml"
    code, out, err = flexsheet(
        "calibrate", "arms", *COMMON, "--twin", "--places", 10, "--calibration", OPTICS_FILE,
        "-o", output, "--write-scene", copy, "--json",
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(out)
    for side in ("left", "right"):
        one = result["arms"][side]
        assert one["poses_used"] == 10
        assert one["true_error_m"] < 4.0 * one["position_std_m"] < 0.002
        assert one["true_error_rad"] < 4.0 * one["rotation_std_rad"]
        assert one["moved_from_scene_m"] > 0.001
    found = ArmsCalibration.load(output)
    assert found.left is not None
    # The copy is the scene but for the bases, comments and all.
    before, after = SCENE_FILE.read_text().splitlines(), copy.read_text().splitlines()
    changed = [i for i, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
    assert len(changed) == 2
    assert all("world_from_base" in before[i] for i in changed)
    arms = load_scene(copy).arms
    assert arms.left.world_from_base.position_m == pytest.approx(
        found.left.world_from_base.position_m, abs=1e-9
    )


def test_one_arm_alone_from_a_folder(flexsheet: Command, tmp_path: Path) -> None:
    place = Workplace(13, "right")
    write_poses(tmp_path, place.detections(8), place, "deg")
    code, out, err = flexsheet(
        "calibrate", "arms", *COMMON, "--right-arm", tmp_path, "-o", tmp_path / "arms.yaml",
    )  # fmt: skip
    assert code == 0, err
    assert re.search(r"^arms right poses used +8$", out, re.MULTILINE)
    assert re.search(r"^arms right world from base position +\S+, \S+, \S+ mm$", out, re.MULTILINE)
    assert ArmsCalibration.load(tmp_path / "arms.yaml").left is None


def test_bad_input_to_the_command_is_named(flexsheet: Command, tmp_path: Path) -> None:
    place = Workplace(14)
    poor = tmp_path / "poor"
    poor.mkdir()
    write_poses(poor, place.detections(8, rotation_rad=[0.0, 0.0, 0.4]), place, "rad")
    output = tmp_path / "arms.yaml"
    for arguments, words in (
        ([*COMMON, "-o", output], "give either --twin, or --left-arm, --right-arm or both"),
        ([*COMMON, "--left-arm", tmp_path / "none", "-o", output], "joints.csv: cannot be read"),
        ([*COMMON, "--left-arm", poor, "-o", output], "rotates about one axis only"),
        ([*COMMON, "--left-arm", poor, "-o", tmp_path / "no" / "x"], "does not exist"),
        (
            [*COMMON, "--left-arm", poor, "-o", output, "--write-scene", SCENE_FILE],
            "the file exists",
        ),
        (
            [*COMMON, "--left-arm", poor, "-o", output, "--calibration", SCENE_FILE],
            "cylinder.yaml",
        ),
    ):
        code, _, err = flexsheet("calibrate", "arms", *arguments)
        assert code == 2
        assert words in err.replace("\n", " ")
        assert not output.exists()


def test_images_of_another_size_or_without_a_board(tmp_path: Path) -> None:
    live = LiveCapture(tmp_path)
    live.show(live.place.joints(np.array([0.1, 0.2, 0.0]), np.zeros(3)))
    with pytest.raises(ArmPosesError, match="the images have 640x480 px"):
        read_detections(tmp_path, BOARD, RIG, (800, 600), lambda *_: None)
    add_row(tmp_path, ["left01.png", "left01.png"], READY)
    other = Board(columns=9, rows=6, square_m=0.015)
    _, blind = read_detections(tmp_path, other, RIG, SIZE, lambda *_: None)
    assert [name for name, _ in blind] == ["left01.png", "left01.png"]
    assert "9x6" in blind[0][1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("[1]", "this is not a calibration, because it has no key `version`"),
        ("version: 99", "the key `version` is 99, expected 1"),
        ("version: 1", "date"),
        ("a: [", "not a valid calibration file"),
    ],
)
def test_a_bad_calibration_file_is_named(tmp_path: Path, text: str | None, words: str) -> None:
    path = tmp_path / "arms.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(CalibrationFileError, match=words):
        ArmsCalibration.load(path)
