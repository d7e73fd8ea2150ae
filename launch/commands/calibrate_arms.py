"""`flexsheet calibrate arms`: measure the poses of the arm bases with a board on each flange."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.calibrate import (
    FOUR_BITS,
    BoardOption,
    CalibrationOption,
    DictionaryOption,
    MarkerOption,
    SquareOption,
    app,
    command_line,
    load_optics,
    load_true_devices,
    make_provenance,
    parse_board,
    pose_values,
    require_twin,
    write_scene_values,
)
from flexsheet.launch.commands.graph import receiving, run_interruptible
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_outcome,
    print_result,
    progress_bar,
    words,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from flexsheet.launch.calibration.arm_poses import PoseRecorder
    from flexsheet.launch.calibration.edge_marks import EdgeMarkRecorder
    from flexsheet.launch.calibration.hand_eye import BaseFit, BoardDetection
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.arms_calibration import ArmBase, ArmsCalibration
    from flexsheet.messages.calibration import Board, StereoCalibration
    from flexsheet.messages.scene import Scene
    from flexsheet.messages.types import Side

SIDES: tuple[Side, Side] = ("left", "right")


@app.command(
    epilog=examples(
        "flexsheet calibrate arms --scene lab.yaml --left-arm places-left --right-arm "
        "places-right --board 9x6 --square-mm 10 -o arms.yaml",
        "flexsheet calibrate arms --scene launch/scenes/cylinder.yaml --twin --board 9x6 "
        "--square-mm 10 -o arms.yaml",
    ),
)
def arms(
    *,
    scene_file: options.SceneOption,
    board: BoardOption,
    square_mm: SquareOption,
    output: Annotated[Path, options.result_file("Arm calibration file to write.")],
    left_arm: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder with joints.csv and board images of the left arm."
        ),
    ] = None,
    right_arm: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder with joints.csv and board images of the right arm."
        ),
    ] = None,
    twin: Annotated[
        bool, typer.Option("--twin", help="Calibrate simulated arms; do not read recorded poses.")
    ] = False,
    places: Annotated[int, typer.Option(help="Number of simulated poses per arm.", min=6)] = 16,
    apparatus: options.TwinApparatusOption = None,
    seed: options.SeedOption = 1,
    calibration: CalibrationOption = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    copy: Annotated[
        Path | None,
        typer.Option(
            "--write-scene",
            help="Output file: a copy of the scene with the measured base poses.",
            callback=options.check_folder,
        ),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure the poses of the arm bases in the world frame of the stereo camera.

    Mount the board rigidly on the flange of an arm, and record 15 to 20 poses at rest with
    different flange orientations (docs/arms.md). Give the recorded folder of each arm, or use
    --twin to simulate the arms.
    """
    from flexsheet.launch.plans.plan import load_scene

    if twin == (left_arm is not None or right_arm is not None):
        raise CommandError("give either --twin, or --left-arm, --right-arm or both")
    require_twin(apparatus, simulated=twin)
    if copy is not None and copy.exists():
        raise CommandError(f"--write-scene {copy}: the file exists; name a new file")
    scene = load_scene(scene_file)
    true = load_true_devices(apparatus, scene)
    described = parse_board(board, square_mm, marker_mm, dictionary)
    optics = load_optics(calibration, scene)
    folders: dict[Side, Path | None] = {"left": left_arm, "right": right_arm}
    fits: dict[Side, BaseFit] = {}
    blind: dict[Side, list[tuple[str, str]]] = {}
    with tempfile.TemporaryDirectory(prefix="flexsheet-arms-") as simulated:
        for side in SIDES:
            if twin:
                folders[side] = simulate_folder(
                    scene, described, side, true, folder=Path(simulated), places=places, seed=seed
                )
            folder = folders[side]
            if folder is not None:
                fits[side], blind[side] = fit_folder(folder, described, scene, optics, side)
    measured = make_calibration(fits, scene, described)
    measured.save(output, comment=command_line())
    if copy is not None:
        write_scene_values(scene_file, list_scene_values(measured), copy)
    result: dict[str, Any] = {
        "calibration": str(output),
        "scene": None if copy is None else str(copy),
        "arms": {},
    }
    for side, without_board in blind.items():
        base: ArmBase = getattr(measured, side)
        outliers = [(one.name, one.reason) for one in base.poses if not one.used]
        moved_m, turned_rad = _compute_shift(base, scene, side)
        result["arms"][side] = {
            **base.model_dump(mode="json", exclude={"flange_from_board", "covariance", "poses"}),
            "moved_from_scene_m": moved_m,
            "rotation_from_scene_rad": turned_rad,
            "poses_used": sum(one.used for one in base.poses),
            "poses": len(base.poses) + len(without_board),
            "left_out": dict([*without_board, *outliers]),
            **(_true_errors(scene, side, fits[side], true, seed) if twin else {}),
        }
    print_result(result, as_json=as_json)


@app.command(
    epilog=examples(
        "flexsheet calibrate capture left --scene lab.yaml --board 9x6 --square-mm 10 -o left",
        "flexsheet calibrate capture edges --scene lab.yaml -o marks.csv",
    ),
)
def capture(
    *,
    kind: Annotated[
        Literal["left", "right", "edges"],
        typer.Argument(
            metavar="left|right|edges",
            help="left, right: board on the flange of this arm, for `calibrate arms`. edges: marks "
            "on both clamps, for `calibrate edges`.",
        ),
    ],
    output: Annotated[
        Path,
        options.output_file("New folder for joints.csv and images, or new CSV file of marks."),
    ],
    scene_file: options.SceneOption,
    board: Annotated[
        str | None,
        typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the board, such as 9x6."),
    ] = None,
    square_mm: Annotated[
        float | None, typer.Option(help="Side of a square of the board, mm.", min=0.1)
    ] = None,
    places: Annotated[
        int, typer.Option(help="Number of poses to record; then the command stops.", min=1)
    ] = 24,
    calibration: CalibrationOption = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Record poses of the arms with images of the running graph, for a calibration.

    For `left` and `right`, mount the board on the flange of this arm and move the arm with its
    teach pendant.

    For `edges`, fix three bright marks on each clamp: one at the clamp's centre, one above it and
    one below it. The upper and the lower mark are 45 % of the clamp's length away from the centre.
    Move the sheet to poses that differ in position, rotation and stretch.

    The command records a pose when the arms are at rest in a new pose. Ctrl-C ends the recording.
    """
    from flexsheet.launch.calibration.arm_poses import PoseRecorder, make_lens_rig
    from flexsheet.launch.calibration.edge_marks import EdgeMarkRecorder
    from flexsheet.launch.plans.plan import load_scene

    if (kind == "edges") == (board is not None or square_mm is not None):
        raise CommandError("give --board and --square-mm for left and right, and not for edges")
    scene = load_scene(scene_file)
    optics = load_optics(calibration, scene)
    recorder: PoseRecorder | EdgeMarkRecorder
    try:
        if kind == "edges":
            recorder = EdgeMarkRecorder(output, scene, optics)
        else:
            described = parse_board(board or "", square_mm or 0.0, marker_mm, dictionary)
            output.mkdir(parents=True)
            recorder = PoseRecorder(output, described, make_lens_rig(scene, optics))
    except OSError as error:
        raise CommandError(
            f"-o {output}: cannot be created: {error.strerror}; give another name"
        ) from error

    def on_arm(state: Any, time_s: float) -> None:
        if isinstance(recorder, EdgeMarkRecorder):
            recorder.update_joints(state.side, state.joints_rad, time_s)
        else:
            recorder.update_joints(state.joints_rad, time_s)

    size = (scene.camera.width_px, scene.camera.height_px)
    arm_topics = [f"arm_{side}" for side in SIDES if kind in (side, "edges")]
    run_interruptible(record_poses(recorder, on_arm, arm_topics, size=size, places=places, run=run))
    print_outcome(
        {"output": str(output), "poses": recorder.count},
        f"{recorder.count} poses in {output}",
        as_json=as_json,
    )


async def record_poses(
    recorder: PoseRecorder | EdgeMarkRecorder,
    on_arm: Callable[[Any, float], None],
    arms: Sequence[str],
    *,
    size: tuple[int, int],
    places: int,
    run: Path | None,
) -> int:
    """Pass images and arm states of the running graph to a recorder until it has enough poses.

    on_arm: function that is called with each received arm state and its arrival time (s).
    arms: topics of the arm states.
    size: required width and height of the images, px.
    places: number of poses.

    Returns the exit code.
    """
    import asyncio
    import time

    from flexsheet.launch.commands.topic import make_listener
    from flexsheet.messages.topics import TOPICS

    images: asyncio.Queue[tuple[Any, float]] = asyncio.Queue(maxsize=1)

    def on_stereo(pair: Any, _: Any) -> None:
        # Image pairs that arrive while an earlier pair is processed are dropped and not needed.
        if images.empty():
            images.put_nowait((pair, time.monotonic()))

    def on_state(state: Any, _: Any) -> None:
        on_arm(state, time.monotonic())

    subscribers = [make_listener(TOPICS["stereo"], run, on_stereo)]
    subscribers += [make_listener(TOPICS[name], run, on_state) for name in arms]
    printed = ""
    with receiving(subscribers):
        while recorder.count < places:
            pair, time_s = await images.get()
            if (pair.left.shape[1], pair.left.shape[0]) != size or any(pair.left_origin_px):
                hint = "the camera publishes image regions; configure it to publish whole images"
            else:
                hint = await asyncio.to_thread(
                    recorder.update_images, pair.left, pair.right, time_s
                )
            if hint != printed:
                words.print(hint)
            printed = hint
    return 0


def simulate_folder(
    scene: Scene,
    board: Board,
    side: Side,
    apparatus: Apparatus | None,
    *,
    folder: Path,
    places: int,
    seed: int,
) -> Path:
    """Write simulated poses and board images of one arm to a new folder, and return its path."""
    from flexsheet.launch.calibration.arm_poses import simulate_poses

    poses = folder / side
    poses.mkdir()
    with progress_bar(f"simulating the {side} arm") as progress:
        for done in simulate_poses(
            scene, board, side, poses, places=places, seed=seed, apparatus=apparatus
        ):
            progress(done, places)
    return poses


def fit_folder(
    folder: Path, board: Board, scene: Scene, optics: StereoCalibration | None, side: Side
) -> tuple[BaseFit, list[tuple[str, str]]]:
    from flexsheet.launch.calibration.arm_poses import make_lens_rig, read_detections
    from flexsheet.launch.calibration.hand_eye import HandEyeError, calibrate_base

    rig = make_lens_rig(scene, optics)
    size = (scene.camera.width_px, scene.camera.height_px)
    detections: list[BoardDetection]
    try:
        with progress_bar(f"{side} arm: detecting the board") as progress:
            detections, blind = read_detections(folder, board, rig, size, progress)
        with words.status(f"{side} arm: fitting"):
            return calibrate_base(detections, rig, getattr(scene.arms, side).model), blind
    except HandEyeError as error:
        raise CommandError(f"{side} arm, {folder}: {error}") from error


def make_calibration(fits: dict[Side, BaseFit], scene: Scene, board: Board) -> ArmsCalibration:
    from flexsheet.messages.arms_calibration import ArmsCalibration

    return ArmsCalibration(
        **make_provenance(),
        scene=scene.name,
        device=scene.camera.device,
        board=board,
        left=_make_arm_base(fits["left"]) if "left" in fits else None,
        right=_make_arm_base(fits["right"]) if "right" in fits else None,
    )


def _make_arm_base(fit: BaseFit) -> ArmBase:
    import numpy as np

    from flexsheet.messages.arms_calibration import ArmBase, ArmPoseFit
    from flexsheet.messages.scene import Pose
    from flexsheet.nodes.models.rigid import rpy_from_rotation

    def make_pose(transform: Any) -> Pose:
        return Pose(
            position_m=np.ascontiguousarray(transform[:3, 3]),
            rpy_rad=rpy_from_rotation(transform[:3, :3]),
        )

    position_std_m, rotation_std_rad = fit.compute_std(np.zeros(3))
    return ArmBase(
        world_from_base=make_pose(fit.world_from_base),
        flange_from_board=make_pose(fit.flange_from_board),
        position_std_m=position_std_m,
        rotation_std_rad=rotation_std_rad,
        covariance=fit.covariance,
        jackknife_ratio=fit.jackknife_ratio,
        max_change_m=float(np.linalg.norm(fit.leave_one_out[:, 3:], axis=1).max()),
        max_change_rad=float(np.linalg.norm(fit.leave_one_out[:, :3], axis=1).max()),
        corner_sigma_px=fit.corner_sigma_px,
        arm_sigma_m=fit.arm_sigma_m,
        arm_sigma_rad=fit.arm_sigma_rad,
        poses=tuple(ArmPoseFit(used=not one.reason, **asdict(one)) for one in fit.residuals),
    )


def list_scene_values(measured: ArmsCalibration) -> dict[str, Any]:
    """Return the calibrated poses of the arm bases as new values for a scene file.

    Each key is a dotted path, such as `arms.left.world_from_base.rpy_rad`.
    """
    values: dict[str, Any] = {}
    for side, base in (("left", measured.left), ("right", measured.right)):
        if base is not None:
            values |= pose_values(f"arms.{side}.world_from_base", base.world_from_base)
    return values


def _true_errors(
    scene: Scene, side: Side, fit: BaseFit, apparatus: Apparatus | None, seed: int
) -> dict[str, float]:
    """Return the true errors (m, rad) of the flange pose of a simulated arm after calibration.

    The errors are computed at the arm's start position. They do not include backlash.
    """
    import numpy as np

    from flexsheet.launch.calibration.arm_poses import SimulatedArm
    from flexsheet.nodes.arm_bridge.geometry import make_kinematics
    from flexsheet.nodes.models.rigid import inverse, vector_from_rotation

    arm = SimulatedArm(scene, side, apparatus, seed=seed)
    model = getattr(scene.arms, side).model
    ready_rad = np.array(model.start_rad)
    true = arm.place_flange(ready_rad, exact=True)
    error = true @ inverse(fit.world_from_base @ make_kinematics(model).forward(ready_rad))
    return {
        "true_error_m": float(np.linalg.norm(error[:3, 3])),
        "true_error_rad": float(np.linalg.norm(vector_from_rotation(error[:3, :3]))),
    }


def _compute_shift(base: ArmBase, scene: Scene, side: Side) -> tuple[float, float]:
    """Return the shift (m, rad) of a calibrated arm base relative to its pose in the scene."""
    import numpy as np

    from flexsheet.nodes.models.rigid import pose_matrix, vector_from_rotation

    nominal = getattr(scene.arms, side).world_from_base
    before, now = (pose_matrix(one) for one in (nominal, base.world_from_base))
    return (
        float(np.linalg.norm(now[:3, 3] - before[:3, 3])),
        float(np.linalg.norm(vector_from_rotation(now[:3, :3] @ before[:3, :3].T))),
    )
