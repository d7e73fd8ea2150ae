"""`flexsheet calibrate`: calibrate a stereo camera with images of a calibration board.

The module also contains functions that the calibrations of other devices use.
"""

from __future__ import annotations

import glob
import math
import shlex
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_result,
    progress_bar,
    words,
)

if TYPE_CHECKING:
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.calibration import Board, StereoCalibration
    from flexsheet.messages.scene import Pose, Scene

app = options.make_app("Calibrate cameras, arms, projector and sheet.")

LeftOption = Annotated[
    str,
    typer.Option(
        metavar="GLOB",
        help="File pattern of the left images. Left and right images are paired in the order of "
        "their names.",
    ),
]
RightOption = Annotated[
    str,
    typer.Option(
        metavar="GLOB",
        help="File pattern of the right images. Left and right images are paired in the order of "
        "their names.",
    ),
]
BoardOption = Annotated[
    str,
    typer.Option(metavar="COLUMNSxROWS", help="Number of inner corners of the board, such as 9x6."),
]
SquareOption = Annotated[
    float, typer.Option(metavar="MM", help="Side length of a board square, mm.", min=1e-3)
]
MarkerOption = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        help="Side length of a ChArUco marker, mm; default: the board is a chessboard.",
        min=1e-3,
    ),
]
DictionaryOption = Annotated[str, typer.Option(help="OpenCV dictionary of the ChArUco markers.")]
FOUR_BITS = "DICT_4X4_50"
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Stereo calibration file; default: the camera parameters of the scene are used.",
    ),
]


@app.command(
    epilog=examples(
        "flexsheet calibrate stereo --left 'left*.jpg' --right 'right*.jpg' --board 9x6 "
        "--square-mm 25 -o stereo.yaml",
        "flexsheet calibrate stereo --twin launch/scenes/cylinder.yaml --board 9x6 "
        "--square-mm 25 -o stereo.yaml",
    )
)
def stereo(
    *,
    board: BoardOption,
    square_mm: SquareOption,
    output: Annotated[Path, options.result_file("Stereo calibration file to write.")],
    left: LeftOption = "",
    right: RightOption = "",
    device_source: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="Camera for live capture, in the format of a camera node's parameter source, such "
            "as '{kind: live, left: 0, right: 1}'.",
        ),
    ] = None,
    scene_file: Annotated[
        Path | None,
        typer.Option(
            "--scene",
            help="Scene file with the camera: its device name, image size, exposure time, and "
            "distance from the screen.",
        ),
    ] = None,
    twin: Annotated[
        Path | None, typer.Option(metavar="SCENE", help="Simulate the camera of this scene file.")
    ] = None,
    apparatus: options.TwinApparatusOption = None,
    seed: options.SeedOption = 1,
    pairs: Annotated[int, typer.Option(help="Number of image pairs to capture.", min=5)] = 20,
    pictures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="New folder for captured images.")
    ] = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate both cameras of a stereo camera and their relative pose.

    The board images are read from files (--left, --right), captured live (--device-source, --scene)
    or simulated (--twin).
    """
    from flexsheet.launch.calibration.capture import Capture
    from flexsheet.launch.calibration.stereo import calibrate_stereo
    from flexsheet.launch.commands import capture
    from flexsheet.launch.plans.plan import load_scene

    _check_single_source(left, right, device_source, twin)
    require_twin(apparatus, simulated=twin is not None)
    described = parse_board(board, square_mm, marker_mm, dictionary)
    scene: Scene | None = None
    if left and right:
        left_paths, right_paths = _find_images("--left", left), _find_images("--right", right)
        scene = None if scene_file is None else load_scene(scene_file)
    else:
        camera_scene = twin or scene_file
        if camera_scene is None:
            raise CommandError("--device-source requires --scene FILE; add it")
        scene = load_scene(camera_scene)
        pose_capture = Capture(
            described,
            lens=scene.camera.left,
            size=(scene.camera.width_px, scene.camera.height_px),
            pairs=pairs,
            still_images=1 if device_source is None else 4,
        )
        if device_source is None:
            true = load_true_devices(apparatus, scene)
            views = capture.simulate_views(scene, described, true, pairs=pairs, seed=seed)
        else:
            views = capture.read_device_views(device_source, scene)
        folder = pictures or Path(f"runs/calibration-{datetime.now():%Y%m%d-%H%M%S}")
        capture.write_pairs(views, pose_capture, folder)
        left_paths = sorted(folder.glob("left*.png"))
        right_paths = sorted(folder.glob("right*.png"))
    with progress_bar("detecting the board") as progress:
        calibrated = calibrate_stereo(
            left_paths,
            right_paths,
            board=described,
            device="stereo" if scene is None else scene.camera.device,
            working_distance_m=None if scene is None else measure_distance_m(scene),
            progress=progress,
        )
    calibration = calibrated.calibration
    calibration.save(output, comment=command_line())
    uncertainty = calibration.uncertainty
    assert uncertainty is not None
    result = {
        "calibration": str(output),
        "pairs": sum(pair.used for pair in calibration.pairs),
        "pairs_left_out": {pair.left: pair.reason for pair in calibration.pairs if not pair.used},
        "reprojection_rms_px": calibration.reprojection_rms_px,
        "baseline_mm": 1e3 * math.hypot(*calibration.right_from_left[:3, 3]),
        "left_f_px": calibration.left.fx_px,
        "right_f_px": calibration.right.fx_px,
        "uncertainty": {
            "working_distance_mm": 1e3 * uncertainty.working_distance_m,
            "depth_std_mm": 1e3 * uncertainty.depth_std_m,
            "lateral_std_mm": 1e3 * uncertainty.lateral_std_m,
            "jackknife_ratio": uncertainty.jackknife_ratio,
        },
    }
    print_result(result, as_json=as_json)


@app.command(
    epilog=examples(
        "flexsheet calibrate check --calibration stereo.yaml --left 'left*.jpg' --right "
        "'right*.jpg' --board 9x6 --square-mm 25"
    )
)
def check(
    *,
    calibration: Annotated[Path, typer.Option(help="Stereo calibration file to check.")],
    left: LeftOption,
    right: RightOption,
    board: BoardOption,
    square_mm: SquareOption,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    as_json: options.JsonOption = False,
) -> None:
    """Check a calibration with board images that were not used to compute the calibration."""
    from flexsheet.launch.calibration.check import check_stereo
    from flexsheet.messages.calibration import StereoCalibration

    with progress_bar("measuring the board") as progress:
        result = check_stereo(
            StereoCalibration.load(calibration),
            _find_images("--left", left),
            _find_images("--right", right),
            board=parse_board(board, square_mm, marker_mm, dictionary),
            progress=progress,
        )
    reused = result["used_to_calibrate"]
    if isinstance(reused, list) and reused:
        words.print(
            f"{', '.join(reused)}: these images were used to calibrate, so the errors are "
            "underestimated; use other images"
        )
    print_result(result, as_json=as_json)


def _check_single_source(
    left: str, right: str, device_source: str | None, twin: Path | None
) -> None:
    """Raise CommandError unless the options select exactly one source of images."""
    files = bool(left or right)
    chosen = [files, device_source is not None, twin is not None]
    if sum(chosen) != 1 or (files and not (left and right)):
        raise CommandError(
            "give exactly one source of images: --left with --right, --device-source with --scene, "
            "or --twin"
        )


def _find_images(option: str, pattern: str) -> list[Path]:
    paths = [Path(name) for name in sorted(glob.glob(pattern))]
    if not paths:
        raise CommandError(
            f"{option} {pattern}: no file matches; check the path, and put the pattern in quotes"
        )
    return paths


def parse_board(text: str, square_mm: float, marker_mm: float | None, dictionary: str) -> Board:
    from flexsheet.messages.calibration import Board

    columns, _, rows = text.lower().partition("x")
    if not (columns.isdigit() and rows.isdigit() and min(int(columns), int(rows)) >= 3):
        raise CommandError(
            f"--board {text}: expected COLUMNSxROWS of inner corners, at least 3x3, such as 9x6"
        )
    charuco = marker_mm is not None
    return Board(
        kind="charuco" if charuco else "chessboard",
        columns=int(columns),
        rows=int(rows),
        square_m=1e-3 * square_mm,
        marker_m=None if marker_mm is None else 1e-3 * marker_mm,
        dictionary=dictionary if charuco else None,
    )


def measure_distance_m(scene: Scene) -> float:
    """Return the distance (m) from the left camera to the centre of the screen."""
    return math.hypot(*scene.camera.world_from_left.position_m)


def command_line() -> str:
    """Return the command line of this process, for the comment in a calibration file."""
    return shlex.join(["flexsheet", *sys.argv[1:]])


def make_provenance() -> dict[str, Any]:
    """Return the date and the code version that are written to a calibration file."""
    from importlib.metadata import version

    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"date": now, "code_version": version("flexsheet")}


def write_scene_values(scene_file: Path, values: Mapping[str, Any], copy: Path) -> None:
    """Write a copy of a scene file in which some values are replaced.

    Comments and layout are preserved.

    values: new values. Each key is the dotted path of the value in the scene file.

    Raises BadInputError if the changed scene is invalid.
    """
    from ruamel.yaml.comments import CommentedSeq

    from flexsheet.launch.plans.documents import edit_yaml
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.nodes.twin.tolerance_table import set_value

    with edit_yaml(scene_file, copy) as tree:
        for path, value in values.items():
            if isinstance(value, list):
                row = CommentedSeq(value)
                row.fa.set_flow_style()
                set_value(tree, path, row)
            else:
                set_value(tree, path, value)
    load_scene(copy)


def pose_values(key: str, pose: Pose) -> dict[str, Any]:
    """Return the position and the angles of a pose as new values for a scene file.

    key: dotted path of the pose in the scene file. The keys of the result begin with this path.
    """
    return {
        f"{key}.position_m": [round_digits(one) for one in pose.position_m],
        f"{key}.rpy_rad": [round_digits(one) for one in pose.rpy_rad],
    }


def load_optics(path: Path | None, scene: Scene) -> StereoCalibration | None:
    """Load a stereo calibration of the scene's camera; return None if `path` is None.

    Raises CommandError if the calibration belongs to another camera.
    """
    from flexsheet.messages.calibration import StereoCalibration, refuse_other_camera
    from flexsheet.messages.calibration_file import CalibrationMismatchError

    if path is None:
        return None
    try:
        calibration = StereoCalibration.load(path)
        refuse_other_camera(calibration, scene.camera)
    except CalibrationMismatchError as error:
        raise CommandError(f"{path}: {error}") from error
    return calibration


def require_twin(apparatus: str | None, *, simulated: bool) -> None:
    """Raise CommandError if the option --apparatus is given without --twin.

    Both options concern simulated hardware.
    """
    if apparatus is not None and not simulated:
        raise CommandError(f"--apparatus {apparatus}: the option is for --twin only; remove it")


def load_true_devices(
    text: str | None, scene: Scene, scene_file: Path | None = None
) -> Apparatus | None:
    """Load the true parameters of the simulated hardware (the apparatus).

    The poses refer to the world frame of the stereo camera, as they do in all calibrations.

    text: apparatus file, or a random sample such as "seed:7". If it is None, the result is None.
    """
    from flexsheet.launch.plans.apparatus import load_apparatus
    from flexsheet.nodes.twin.truth import align_world_to_camera

    if text is None:
        return None
    return align_world_to_camera(scene, load_apparatus(text, scene, scene_file))


def round_digits(value: float) -> float:
    """Round a calibrated value (m, rad or px) to nine decimal places, and replace -0.0 by 0.0."""
    return round(float(value), 9) + 0.0
