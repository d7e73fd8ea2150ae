"""Test both kinds of boards, live capture, and their commands."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML

from flexsheet.launch.calibration.bundle import pose_vector
from flexsheet.launch.calibration.capture import (
    TILTS,
    Bin,
    BinGroup,
    Capture,
    classify_tilt,
    compute_required_counts,
    describe_requirement,
)
from flexsheet.launch.calibration.check import check_stereo
from flexsheet.launch.calibration.corners import (
    BoardPair,
    CalibrationError,
    CornerFinder,
    board_points,
    match_views,
)
from flexsheet.launch.calibration.stereo import calibrate_stereo
from flexsheet.launch.commands.capture import write_pairs
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.calibration import Board, StereoCalibration
from flexsheet.messages.scene import Scene, StereoCamera
from flexsheet.nodes.models import rigid
from flexsheet.nodes.twin.board import TwinBoard
from flexsheet.nodes.twin.rig import make_true_camera
from tests.commands import Command

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
ROOT = Path(__file__).resolve().parent.parent
CHESSBOARD = Board(columns=7, rows=5, square_m=0.03)
CHARUCO = Board(
    kind="charuco", columns=6, rows=4, square_m=0.04, marker_m=0.025, dictionary="DICT_4X4_50"
)
BOARDS = [CHESSBOARD, CHARUCO]


def small_scene() -> dict[str, Any]:
    """Return the paper's scene with a camera of a quarter of the pixels."""
    scene: dict[str, Any] = YAML(typ="safe").load(
        (ROOT / "launch" / "scenes" / "cylinder.yaml").read_text()
    )
    camera = scene["camera"]
    camera["width_px"], camera["height_px"] = 400, 300
    for side in ("left", "right"):
        for key in ("fx_px", "fy_px", "cx_px", "cy_px"):
            camera[side][key] *= 400 / 640
    return scene


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.yaml"
    with path.open("w") as file:
        YAML(typ="safe").dump(small_scene(), file)
    return path


@pytest.fixture(scope="module")
def camera() -> StereoCamera:
    return Scene.model_validate(small_scene()).camera


@pytest.mark.parametrize(
    ("change", "printed"),
    [
        ({"marker_m": 0.04}, "markers of 40 mm do not fit into squares of 40 mm"),
        ({"dictionary": "DICT_9X9"}, "an OpenCV dictionary, such as DICT_4X4_50"),
        ({"marker_m": None}, "give the marker size"),
        ({"columns": 14, "rows": 10}, "needs 82 markers, but DICT_4X4_50 contains only 50"),
    ],
)
def test_impossible_charuco_boards_are_rejected(change: dict[str, Any], printed: str) -> None:
    with pytest.raises(CalibrationError, match=printed):
        CornerFinder(CHARUCO.model_copy(update=change))


def shown(
    board: Board, camera: StereoCamera, count: int, *, seed: int
) -> list[tuple[Image, Image]]:
    twin = TwinBoard(make_true_camera(camera), board, seed=seed)
    return [twin.pair(pose) for pose in twin.poses(count)]


def written(pictures: list[tuple[Image, Image]], folder: Path) -> tuple[list[Path], list[Path]]:
    paths: tuple[list[Path], list[Path]] = ([], [])
    for number, views in enumerate(pictures):
        for side, name, picture in zip(paths, ("left", "right"), views, strict=True):
            side.append(folder / f"{name}{number:02}.png")
            cv2.imwrite(str(side[-1]), picture)
    return paths


def test_charuco_boards_seen_in_part_calibrate_a_rig(camera: StereoCamera, tmp_path: Path) -> None:
    left, right = written(shown(CHARUCO, camera, 12, seed=4), tmp_path)
    calibrated = calibrate_stereo(left[:9], right[:9], board=CHARUCO, device="made")
    seen = [len(pair.left.ids) for pair in calibrated.pairs.values()]
    assert min(seen) < 24
    true = make_true_camera(camera)
    calibration = calibrated.calibration
    assert calibration.left.fx_px == pytest.approx(true.left.fx_px, rel=4e-3)
    assert calibration.right_from_left[:3, 3] == pytest.approx(
        true.right_from_left[:3, 3], abs=3e-4
    )
    result = check_stereo(calibration, left[9:], right[9:], board=CHARUCO)
    assert result["pairs"] == 3
    assert isinstance(result["rigid_fit_rms_mm"], float)
    assert result["rigid_fit_rms_mm"] < 0.5


def test_the_same_corner_has_the_same_number_in_both_views(camera: StereoCamera) -> None:
    twin = TwinBoard(make_true_camera(camera), CHARUCO, seed=2)
    finder = CornerFinder(CHARUCO)
    compared = 0
    for pose in twin.poses(4):
        left, right = twin.pair(pose)
        pair = match_views(finder.find(left), finder.find(right), CHARUCO, ("l", "r"))
        if not isinstance(pair, BoardPair):
            continue  # too little of it is seen
        compared += 1
        true_left, true_right = twin.corners(pose)
        assert np.abs(pair.left.pixels - true_left[pair.left.ids]).max() < 0.5
        assert np.abs(pair.right.pixels - true_right[pair.right.ids]).max() < 0.5
        ids, in_left, in_right = pair.common()
        assert len(ids) == len(in_left) == len(in_right) >= 8
    assert compared >= 2


def posed(turn: list[float]) -> Floats:
    """Return the pose (6,) of a rotated board with its middle straight ahead."""
    middle = board_points(CHESSBOARD).mean(axis=0)
    rotation = rigid.rotation_from_vector(turn)
    return pose_vector(rigid.transform(rotation, np.array([0.0, 0.0, 0.5]) - rotation @ middle))


@pytest.mark.parametrize(
    ("turn", "tilt"),
    [
        ([0.0, 0.0, 0.2], "upright"),
        ([0.0, 0.5, 0.0], "left side back"),
        ([0.0, -0.5, 0.0], "right side back"),
        ([0.5, 0.0, 0.0], "bottom back"),
        ([-0.5, 0.0, 0.0], "top back"),
    ],
)
def test_names_of_tilts(turn: list[float], tilt: str) -> None:
    pose = posed(turn)
    middle = board_points(CHESSBOARD).mean(axis=0)
    assert classify_tilt(pose, middle) == tilt
    # A board held upside down leans as it did.
    about = rigid.transform(rigid.rotation_from_vector([0.0, 0.0, np.pi]), 2 * middle)
    flipped = rigid.transform(rigid.rotation_from_vector(pose[:3]), pose[3:]) @ about
    assert classify_tilt(pose_vector(flipped), middle) == tilt
    depths = rigid.apply(
        rigid.transform(rigid.rotation_from_vector(pose[:3]), pose[3:]), board_points(CHESSBOARD)
    )
    furthest = depths[np.argmax(depths[:, 2])]
    if tilt != "upright":
        axis, sign = {"left": (0, -1), "right": (0, 1), "top": (1, -1), "bottom": (1, 1)}[
            tilt.split(" ", maxsplit=1)[0]
        ]
        assert np.sign(furthest[axis]) == sign


def watching(camera: StereoCamera, *, pairs: int, still_images: int) -> Capture:
    return Capture(
        CHESSBOARD,
        lens=camera.left,
        size=(camera.width_px, camera.height_px),
        pairs=pairs,
        still_images=still_images,
    )


def test_pair_is_taken_when_the_board_rests_at_a_new_position(camera: StereoCamera) -> None:
    first, second = shown(CHESSBOARD, camera, 2, seed=6)
    blank = (np.full_like(first[0], 60), np.full_like(first[1], 60))
    capture = watching(camera, pairs=8, still_images=3)
    seen = capture.add_pair(*blank)
    assert not seen.accepted
    assert "no chessboard of 7x5 inner corners found in the left image and the right" in seen.hint
    hints = [capture.add_pair(*picture) for picture in (first, first, second, second, second)]
    assert [one.accepted for one in hints] == [False, False, False, False, True]
    assert hints[0].hint == "keep the board still"
    assert capture.counts[Bin(BinGroup.PAIRS)] == 1
    assert not capture.add_pair(*second).accepted
    assert capture.add_pair(*second).hint.startswith("pose already captured; show the board")
    assert [capture.add_pair(*first).accepted for _ in range(3)] == [False, False, True]
    assert capture.counts[Bin(BinGroup.PAIRS)] == 2
    assert not capture.complete


def test_missing_coverage_is_requested(camera: StereoCamera) -> None:
    capture = watching(camera, pairs=8, still_images=1)
    wanted = compute_required_counts(8)
    assert {one.name for one in wanted if one.group is BinGroup.TILT} == set(TILTS)
    assert Bin(BinGroup.LEFT_CELL, cell=(0, 0)) not in wanted
    capture.counts.update(dict.fromkeys(wanted, 8))
    assert capture.complete
    for one, printed in (
        (Bin(BinGroup.TILT, "left side back"), "with its left side tilted back"),
        (Bin(BinGroup.TILT, "upright"), "facing the camera"),
        (Bin(BinGroup.DISTANCE, "far"), "further away"),
        (Bin(BinGroup.LEFT_CELL, cell=(3, 2)), "at the bottom right of the left image"),
        (Bin(BinGroup.PAIRS), "in another pose"),
    ):
        capture.counts[one] = 0
        assert capture.missing() == [one]
        (picture,) = shown(CHESSBOARD, camera, 1, seed=6)
        assert printed in capture._make_hint("")
        capture.counts[one] = 8
        assert picture[0].shape == (camera.height_px, camera.width_px)
    top_left = Bin(BinGroup.RIGHT_CELL, cell=(0, 0))
    assert describe_requirement(top_left) == "at the top left of the right image"


def test_ctrl_c_keeps_the_images_taken(camera: StereoCamera, tmp_path: Path) -> None:
    pictures = shown(CHESSBOARD, camera, 3, seed=6)

    def until_interrupted() -> Iterator[tuple[Image, Image]]:
        yield from pictures
        raise KeyboardInterrupt

    folder = tmp_path / "taken"
    capture = watching(camera, pairs=8, still_images=1)
    assert write_pairs(until_interrupted(), capture, folder) == 3
    assert sorted(path.name for path in folder.iterdir()) == [
        f"{side}{number:02}.png" for side in ("left", "right") for number in (1, 2, 3)
    ]
    kept = cv2.imread(str(folder / "right02.png"), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(kept, pictures[1][1])


GIVEN = ("--board", "7x5", "--square-mm", "30")


def test_the_twin_is_calibrated_by_the_command(
    flexsheet: Command, scene_file: Path, camera: StereoCamera, tmp_path: Path
) -> None:
    """The test covers live capture, the file, and a check with other images."""
    taken, output = tmp_path / "taken", tmp_path / "rig.yaml"
    code, out, err = flexsheet(
        "calibrate", "stereo", "--twin", scene_file, *GIVEN, "--pairs", 8, "--pictures", taken,
        "-o", output, "--json",
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(out)
    assert result["pairs"] >= 8
    assert result["uncertainty"]["working_distance_mm"] == pytest.approx(503.6, abs=0.1)
    assert 0.01 < result["uncertainty"]["depth_std_mm"] < 2.0
    calibration = StereoCalibration.load(output)
    assert calibration.device == camera.device
    assert calibration.opencv_version == cv2.__version__
    assert "# flexsheet calibrate stereo --twin" in output.read_text()
    assert calibration.left.fx_px == pytest.approx(make_true_camera(camera).left.fx_px, rel=5e-3)

    left, right = written(shown(CHESSBOARD, camera, 3, seed=91), tmp_path)
    given = ("--left", tmp_path / "left0*.png", "--right", tmp_path / "right0*.png", *GIVEN)
    code, out, err = flexsheet("calibrate", "check", "--calibration", output, *given, "--json")
    assert code == 0, err
    checked = json.loads(out)
    assert checked["pairs"] == len(left) == len(right)
    assert checked["rigid_fit_rms_mm"] < 1.0
    assert checked["used_to_calibrate"] == []  # the same names, but other pictures
    assert "underestimated" not in err

    given = ("--left", taken / "left*.png", "--right", taken / "right*.png", *GIVEN)
    code, out, err = flexsheet("calibrate", "check", "--calibration", output, *given, "--json")
    assert code == 0, err
    again = json.loads(out)["used_to_calibrate"]
    assert {"left01.png", "left02.png"} <= set(again)
    assert "left01.png" in err
    assert "errors are underestimated" in err


def test_images_are_taken_from_the_camera_source(
    flexsheet: Command, scene_file: Path, camera: StereoCamera, tmp_path: Path
) -> None:
    """Image files replace the cameras; each image is repeated four times, as of a resting board."""
    for number, views in enumerate(shown(CHESSBOARD, camera, 6, seed=3)):
        for again in range(4):
            for side, picture in zip(("l", "r"), views, strict=True):
                cv2.imwrite(str(tmp_path / f"{side}{number}{again}.png"), picture)
    source = f"{{kind: images, left: {tmp_path}/l*.png, right: {tmp_path}/r*.png}}"
    code, out, err = flexsheet(
        "calibrate", "stereo", "--device-source", source, "--scene", scene_file, *GIVEN,
        "--pairs", 6, "--pictures", tmp_path / "taken", "-o", tmp_path / "rig.yaml",
    )  # fmt: skip
    assert code == 0, err
    assert "too few image pairs show the board: " in err
    taken = len(list((tmp_path / "taken").glob("left*.png")))
    assert taken >= 5
    assert f"{taken} pairs in" in err
    assert re.search(rf"^pairs +{taken}$", out, re.MULTILINE)


@pytest.mark.parametrize(
    ("given", "printed"),
    [
        ((), "exactly one source of images"),
        (("--left", "a*.png"), "exactly one source of images"),
        (("--twin", "SCENE", "--left", "a", "--right", "b"), "exactly one source of images"),
        (("--device-source", "{kind: live, left: 0}"), "requires --scene"),
        (("--device-source", "{kind: live}", "--scene", "SCENE"), "live.left: Field required"),
        (("--device-source", "twin", "--scene", "SCENE"), "use --twin SCENE"),
        (
            ("--device-source", "[1,", "--scene", "SCENE"),
            "use the format of a camera node's parameter",
        ),
        (("--twin", "SCENE", "--pictures", "."), "name a new folder"),
        (("--twin", "SCENE", "--marker-mm", "40"), "do not fit"),
        (("--twin", "nowhere.yaml"), "does not exist"),
    ],
)
def test_errors_name_a_remedy(
    flexsheet: Command, scene_file: Path, tmp_path: Path, given: tuple[str, ...], printed: str
) -> None:
    words = [str(scene_file) if word == "SCENE" else word for word in given]
    code, _, err = flexsheet("calibrate", "stereo", *words, *GIVEN, "-o", tmp_path / "c.yaml")
    assert code == 2
    assert printed in err


def launch_file(folder: Path, calibration: Path) -> Path:
    path = folder / "graph.yaml"
    path.write_text(
        f"scene: {ROOT}/launch/scenes/cylinder.yaml\n"
        "nodes:\n"
        f"  triangulator: {{type: triangulator, parameters: {{calibration: {calibration}}}}}\n"
        "external_topics: [stereo]\n"
    )
    return path


def test_a_plan_refuses_a_calibration_that_does_not_belong(tmp_path: Path) -> None:
    shipped = (ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml").read_text()
    (tmp_path / "own.yaml").write_text(shipped)
    plan = load_graph(launch_file(tmp_path, Path("own.yaml")))
    assert plan.nodes["triangulator"].parameters["calibration"] == str(tmp_path / "own.yaml")
    for old, new, printed in (
        (
            "device: twin-bumblebee",
            "device: other",
            'is of the camera "other", but the scene\'s camera is "twin-bumblebee"',
        ),
        ("width_px: 640", "width_px: 320", "is for 320x480 px"),
        ("version: 2", "version: 1", "the key `version` is 1, expected 2; calibrate again"),
    ):
        (tmp_path / "foreign.yaml").write_text(shipped.replace(old, new))
        with pytest.raises(BadInputError, match=printed) as refused:
            load_graph(launch_file(tmp_path, Path("foreign.yaml")))
        (problem,) = refused.value.problems
        assert problem.where == f"{tmp_path / 'graph.yaml'}:3"
        assert problem.key == ("nodes", "triangulator", "parameters", "calibration")
        assert str(tmp_path / "foreign.yaml") in problem.what
    with pytest.raises(BadInputError, match=r"absent\.yaml: cannot be read"):
        load_graph(launch_file(tmp_path, Path("absent.yaml")))
