"""`flexsheet calibrate arms`: measure the arms' base poses with a board on the flange."""

from __future__ import annotations

import math
import shlex
import shutil
import sys
import tempfile
from datetime import UTC, datetime
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands.calibrate import (
    FOUR_BITS,
    BoardOption,
    DictionaryOption,
    MarkerOption,
    SquareOption,
    _board,
    _progress,
)
from flexsheet.launch.commands.graph import JsonOption, RunOption, run_interruptible
from flexsheet.launch.commands.output import (
    BAD_INPUT,
    CommandError,
    examples,
    print_fields,
    print_json,
    words,
)
from flexsheet.messages.files import write_file

if TYPE_CHECKING:
    from flexsheet.launch.calibration.arm_poses import PoseRecorder
    from flexsheet.launch.calibration.hand_eye import BaseFit, BoardDetection
    from flexsheet.messages.arms_calibration import ArmBase, ArmsCalibration
    from flexsheet.messages.calibration import Board, StereoCalibration
    from flexsheet.messages.scene import Scene
    from flexsheet.messages.types import Side

SceneOption = Annotated[
    Path, typer.Option("--scene", metavar="SCENE", help="Scene with the camera's pose.")
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        metavar="FILE",
        help="Stereo calibration file; default: the optics of the scene.",
    ),
]
SIDES: tuple[Side, Side] = ("left", "right")


def register(app: typer.Typer) -> None:
    """Add the commands to `flexsheet calibrate`."""
    app.command(
        "arms",
        epilog=examples(
            "flexsheet calibrate arms --scene lab.yaml --left-arm places-left --right-arm "
            "places-right --board 9x6 --square-mm 10 -o arms.yaml",
            "flexsheet calibrate arms --scene launch/scenes/cylinder.yaml --twin --board 9x6 "
            "--square-mm 10 -o arms.yaml",
        ),
    )(arms)
    app.command(
        "arms-capture",
        epilog=examples(
            "flexsheet calibrate arms-capture --arm left --scene lab.yaml --board 9x6 "
            "--square-mm 10 -o places-left"
        ),
    )(capture)
    app.command(
        "arms-scene",
        epilog=examples("flexsheet calibrate arms-scene arms.yaml lab.yaml -o lab-measured.yaml"),
    )(write_scene)


def arms(
    *,
    scene_file: SceneOption,
    board: BoardOption,
    square_mm: SquareOption,
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration file to write.")],
    left_arm: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder of the left arm's poses: joints.csv and images."
        ),
    ] = None,
    right_arm: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of the right arm's poses.")
    ] = None,
    twin: Annotated[bool, typer.Option("--twin", help="Simulate the poses of both arms.")] = False,
    places: Annotated[int, typer.Option(help="Simulated poses per arm.", min=6)] = 16,
    seed: Annotated[int, typer.Option(help="Seed of the simulated bases, poses and noise.")] = 1,
    calibration: CalibrationOption = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    copy: Annotated[
        Path | None,
        typer.Option(
            "--write-scene",
            metavar="FILE",
            help="Write a copy of the scene with the measured bases.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the poses of the arms' bases in the world frame of the stereo camera.

    The board is fast on the flange; the arm stands still at 15 to 20 places, its flange turned to
    all sides.  Give a folder for each arm (see docs/arms.md), or --twin.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.arms_calibration import save_arms_calibration

    if not output.resolve().parent.is_dir():
        raise CommandError(f"-o {output}: the folder {output.parent} does not exist", BAD_INPUT)
    if twin == (left_arm is not None or right_arm is not None):
        raise CommandError("give --left-arm, --right-arm or both; or else --twin", BAD_INPUT)
    if copy is not None:
        _refuse_overwriting(copy, "--write-scene")
    scene = load_scene(scene_file)
    described = _board(board, square_mm, marker_mm, dictionary)
    optics = _optics(calibration, scene)
    folders: dict[Side, Path | None] = {"left": left_arm, "right": right_arm}
    fits: dict[Side, BaseFit] = {}
    blind: dict[Side, list[tuple[str, str]]] = {}
    made_up = Path(tempfile.mkdtemp(prefix="flexsheet-arms-")) if twin else None
    try:
        for side in SIDES:
            if made_up is not None:
                folders[side] = _made_up(
                    scene, described, side, folder=made_up, places=places, seed=seed
                )
            folder = folders[side]
            if folder is not None:
                fits[side], blind[side] = _fit(folder, described, scene, optics, side)
    finally:
        if made_up is not None:
            shutil.rmtree(made_up)
    found = _calibration(fits, scene, described)
    save_arms_calibration(found, output, comment=shlex.join(["flexsheet", *sys.argv[1:]]))
    if copy is not None:
        _write_copy(scene_file, found, copy)
    truth = {side: _true_errors(scene, side, fits[side], seed) for side in fits} if twin else {}
    _tell(found, scene, blind=blind, truth=truth, output=output, copy=copy, as_json=as_json)


def write_scene(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="Calibration file of the arms.")
    ],
    scene_file: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene to copy.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write.")],
    as_json: JsonOption = False,
) -> None:
    """Copy a scene and insert the bases of an arm calibration."""
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.arms_calibration import load_arms_calibration
    from flexsheet.messages.calibration_file import CalibrationFileError

    _refuse_overwriting(output, "-o")
    load_scene(scene_file)
    try:
        _write_copy(scene_file, load_arms_calibration(calibration), output)
    except CalibrationFileError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    if as_json:
        print_json({"scene": str(output)})
    else:
        words.print(f"scene: {output}", markup=False)


def capture(
    *,
    side: Annotated[str, typer.Option("--arm", metavar="left|right", help="Side of the arm.")],
    board: BoardOption,
    square_mm: SquareOption,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="New folder for the poses.")
    ],
    scene_file: SceneOption,
    places: Annotated[int, typer.Option(help="Stop after this number of poses.", min=1)] = 20,
    calibration: CalibrationOption = None,
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = FOUR_BITS,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Capture poses from the running graph, from the topics of the arm and `stereo`.

    Move the arm by its teach pendant.  A place is taken when the arm rests and the board is seen
    somewhere new; Ctrl-C ends.
    """
    from flexsheet.launch.calibration.arm_poses import PoseRecorder, make_lens_rig
    from flexsheet.launch.plans.plan import load_scene

    if side not in SIDES:
        raise CommandError(f"--arm {side}: left or right", BAD_INPUT)
    scene = load_scene(scene_file)
    described = _board(board, square_mm, marker_mm, dictionary)
    try:
        output.mkdir(parents=True)
    except OSError as error:
        raise CommandError(
            f"-o {output}: cannot be made: {error.strerror}; name a new folder", BAD_INPUT
        ) from error
    taker = PoseRecorder(output, described, make_lens_rig(scene, _optics(calibration, scene)))
    size = (scene.camera.width_px, scene.camera.height_px)
    run_interruptible(_watch(f"arm_{side}", taker, size, places, run))
    if as_json:
        print_json({"folder": str(output), "places": taker.taken})
    else:
        words.print(f"{taker.taken} places in {output}", markup=False)


async def _watch(
    arm: str, taker: PoseRecorder, size: tuple[int, int], places: int, run: Path | None
) -> int:
    import asyncio
    import time

    from flexsheet.launch.commands.topic import listener
    from flexsheet.messages.topics import TOPICS

    pictures: asyncio.Queue[tuple[Any, float]] = asyncio.Queue(maxsize=1)

    def on_stereo(pair: Any, _: Any) -> None:
        # A pair that comes while the last one is looked at is left out: the next will do.
        if pictures.empty():
            pictures.put_nowait((pair, time.monotonic()))

    def on_arm(state: Any, _: Any) -> None:
        taker.update_joints(state.joints_rad, time.monotonic())

    subscribers = [
        listener(TOPICS[name], run, handler)
        for name, handler in ((arm, on_arm), ("stereo", on_stereo))
    ]
    said = ""
    try:
        for subscriber in subscribers:
            subscriber.start()
        while taker.taken < places:
            pair, time_s = await pictures.get()
            if (pair.left.shape[1], pair.left.shape[0]) != size or any(pair.left_origin_px):
                hint = "the camera sends parts of its pictures only; let it send them whole"
            else:
                hint = await asyncio.to_thread(taker.update_images, pair.left, pair.right, time_s)
            if hint != said:
                words.print(hint, markup=False)
            said = hint
    finally:
        for subscriber in subscribers:
            subscriber.close()
    return 0


def _refuse_overwriting(path: Path, option: str) -> None:
    if path.exists():
        raise CommandError(f"{option} {path}: exists already; name a new file", BAD_INPUT)
    if not path.resolve().parent.is_dir():
        raise CommandError(f"{option} {path}: the folder {path.parent} does not exist", BAD_INPUT)


def _optics(path: Path | None, scene: Scene) -> StereoCalibration | None:
    from flexsheet.messages.calibration import load_calibration, refuse_other_camera
    from flexsheet.messages.calibration_file import CalibrationFileError, CalibrationMismatchError

    if path is None:
        return None
    try:
        calibration = load_calibration(path)
        refuse_other_camera(calibration, scene.camera)
    except CalibrationFileError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    except CalibrationMismatchError as error:
        raise CommandError(f"{path}: {error}", BAD_INPUT) from error
    return calibration


def _made_up(
    scene: Scene, board: Board, side: Side, *, folder: Path, places: int, seed: int
) -> Path:
    """Make a folder with simulated poses."""
    from flexsheet.launch.calibration.arm_poses import simulate_poses
    from flexsheet.nodes.twin.board import BoardError

    mine = folder / side
    mine.mkdir()
    try:
        with _progress(f"the twin's {side} arm") as progress:
            for done in simulate_poses(scene, board, side, mine, places=places, seed=seed):
                progress(done, places, f"the twin's {side} arm")
    except BoardError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    return mine


def _fit(
    folder: Path, board: Board, scene: Scene, optics: StereoCalibration | None, side: Side
) -> tuple[BaseFit, list[tuple[str, str]]]:
    from flexsheet.launch.calibration.arm_poses import ArmPosesError, make_lens_rig, read_detections
    from flexsheet.launch.calibration.corners import CalibrationError
    from flexsheet.launch.calibration.hand_eye import HandEyeError, calibrate_base

    rig = make_lens_rig(scene, optics)
    size = (scene.camera.width_px, scene.camera.height_px)
    detections: list[BoardDetection]
    try:
        with _progress(f"{side} arm: looking for the board") as progress:
            detections, blind = read_detections(folder, board, rig, size, progress)
        with words.status(f"{side} arm: fitting"):
            return calibrate_base(detections, rig), blind
    except (ArmPosesError, CalibrationError) as error:
        raise CommandError(str(error), BAD_INPUT) from error
    except HandEyeError as error:
        raise CommandError(f"{side} arm, {folder}: {error}", BAD_INPUT) from error


def _calibration(fits: dict[Side, BaseFit], scene: Scene, board: Board) -> ArmsCalibration:
    from flexsheet.messages.arms_calibration import ArmsCalibration

    return ArmsCalibration(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        code_version=version("flexsheet"),
        scene=scene.name,
        device=scene.camera.device,
        board=board,
        left=_arm_base(fits["left"]) if "left" in fits else None,
        right=_arm_base(fits["right"]) if "right" in fits else None,
    )


def _arm_base(fit: BaseFit) -> ArmBase:
    import numpy as np

    from flexsheet.messages.arms_calibration import ArmBase, ArmPoseFit
    from flexsheet.messages.scene import Pose
    from flexsheet.nodes.models.rigid import rpy_from_rotation

    def pose(transform: Any) -> Pose:
        return Pose(
            position_m=np.ascontiguousarray(transform[:3, 3]),
            rpy_rad=rpy_from_rotation(transform[:3, :3]),
        )

    position_std_m, rotation_std_rad = fit.std_at(np.zeros(3))
    return ArmBase(
        world_from_base=pose(fit.world_from_base),
        flange_from_board=pose(fit.flange_from_board),
        position_std_m=position_std_m,
        rotation_std_rad=rotation_std_rad,
        covariance=fit.covariance,
        jackknife_ratio=fit.jackknife_ratio,
        largest_change_m=float(np.linalg.norm(fit.leave_one_out[:, 3:], axis=1).max()),
        largest_change_rad=float(np.linalg.norm(fit.leave_one_out[:, :3], axis=1).max()),
        corner_sigma_px=fit.corner_sigma_px,
        arm_sigma_m=fit.arm_sigma_m,
        arm_sigma_rad=fit.arm_sigma_rad,
        places=tuple(
            ArmPoseFit(
                name=one.name,
                used=not one.reason,
                reason=one.reason,
                shift_m=one.shift_m,
                turn_rad=one.turn_rad,
                rms_px=one.rms_px,
            )
            for one in fit.residuals
        ),
    )


def _write_copy(scene_file: Path, found: ArmsCalibration, copy: Path) -> None:
    """Write the scene with the measured bases; keep comments and layout."""
    from ruamel.yaml import YAML

    from flexsheet.launch.plans.plan import load_scene

    yaml = YAML(typ="rt", pure=True)
    yaml.width = 4096
    yaml.preserve_quotes = True
    yaml.indent(sequence=4, offset=2)
    tree = yaml.load(scene_file.read_text(encoding="utf-8"))
    for side in SIDES:
        base: ArmBase | None = getattr(found, side)
        if base is None:
            continue
        given = tree["arms"][side]["world_from_base"]
        for key in ("position_m", "rpy_rad"):
            for index, value in enumerate(getattr(base.world_from_base, key)):
                given[key][index] = _rounded(value)
    text = StringIO()
    yaml.dump(tree, text)
    write_file(copy, text.getvalue())
    load_scene(copy)


def _rounded(value: float) -> float:
    """Round to a nanometre or nanoradian; further digits are noise."""
    return round(float(value), 9) + 0.0


def _true_errors(scene: Scene, side: Side, fit: BaseFit, seed: int) -> dict[str, float]:
    """Return the error of the simulated base at the world's origin."""
    import numpy as np

    from flexsheet.launch.calibration.arm_poses import true_base
    from flexsheet.nodes.models.rigid import inverse, vector_from_rotation

    off = true_base(scene, side, seed=seed) @ inverse(fit.world_from_base)
    return {
        "true_error_m": float(np.linalg.norm(off[:3, 3])),
        "true_error_rad": float(np.linalg.norm(vector_from_rotation(off[:3, :3]))),
    }


def _tell(
    found: ArmsCalibration,
    scene: Scene,
    *,
    blind: dict[Side, list[tuple[str, str]]],
    truth: dict[Side, dict[str, float]],
    output: Path,
    copy: Path | None,
    as_json: bool,
) -> None:
    result: dict[str, Any] = {
        "calibration": str(output),
        "scene": None if copy is None else str(copy),
        "arms": {},
    }
    lines = []
    for side in SIDES:
        base: ArmBase | None = getattr(found, side)
        if base is None:
            continue
        lines += [f"  {side}:", f"    world_from_base: {_scene_line(base)}"]
        strays = [(one.name, one.reason) for one in base.places if not one.used]
        for name, reason in [*blind[side], *strays]:
            words.print(f"{side} arm, left out: {name}: {reason}", markup=False)
        moved_m, turned_rad = _shift(base, scene, side)
        result["arms"][side] = {
            "world_from_base": base.world_from_base.model_dump(mode="json"),
            "position_std_m": base.position_std_m,
            "rotation_std_rad": base.rotation_std_rad,
            "moved_from_scene_m": moved_m,
            "turned_from_scene_rad": turned_rad,
            "places_used": sum(one.used for one in base.places),
            "places": len(base.places) + len(blind[side]),
            "left_out": dict([*blind[side], *strays]),
            "jackknife_ratio": base.jackknife_ratio,
            "largest_change_m": base.largest_change_m,
            "largest_change_rad": base.largest_change_rad,
            "corner_sigma_px": base.corner_sigma_px,
            "arm_sigma_m": base.arm_sigma_m,
            "arm_sigma_rad": base.arm_sigma_rad,
            **truth.get(side, {}),
        }
    if as_json:
        print_json(result)
        return
    print_fields([("calibration", output), *([] if copy is None else [("scene", copy)])])
    for side, one in result["arms"].items():
        print()
        print_fields(_fields(side, one))
    if copy is None:
        print("\narms:\n" + "\n".join(lines))


def _fields(side: str, one: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [
        (f"{side} arm", f"{one['places_used']} of {one['places']} places used"),
        (
            "uncertainty",
            f"{1e3 * one['position_std_m']:.2f} mm at the screen's centre, "
            f"{math.degrees(one['rotation_std_rad']):.3f} degrees",
        ),
        (
            "off the scene",
            f"{1e3 * one['moved_from_scene_m']:.1f} mm, "
            f"{math.degrees(one['turned_from_scene_rad']):.2f} degrees",
        ),
        (
            "one place less",
            f"moves the base by up to {1e3 * one['largest_change_m']:.2f} mm, "
            f"{math.degrees(one['largest_change_rad']):.3f} degrees; scatter over what the fit "
            f"states {one['jackknife_ratio']:.2f}",
        ),
        ("corners", f"{one['corner_sigma_px']:.3f} px"),
        (
            "arm's own error",
            f"{1e3 * one['arm_sigma_m']:.2f} mm, {math.degrees(one['arm_sigma_rad']):.3f} degrees",
        ),
    ]
    if "true_error_m" in one:
        rows.append(
            (
                "error, by the twin",
                f"{1e3 * one['true_error_m']:.2f} mm at the screen's centre, "
                f"{math.degrees(one['true_error_rad']):.3f} degrees",
            )
        )
    return rows


def _scene_line(base: ArmBase) -> str:
    position, rpy = (
        ", ".join(repr(_rounded(value)) for value in values)
        for values in (base.world_from_base.position_m, base.world_from_base.rpy_rad)
    )
    return f"{{position_m: [{position}], rpy_rad: [{rpy}]}}"


def _shift(base: ArmBase, scene: Scene, side: Side) -> tuple[float, float]:
    """Return the distance of the measured base from that of the scene: m and rad."""
    import numpy as np

    from flexsheet.nodes.models.rigid import transform_from_rpy, vector_from_rotation

    given = getattr(scene.arms, side).world_from_base
    before, now = (
        transform_from_rpy(one.position_m, one.rpy_rad) for one in (given, base.world_from_base)
    )
    return (
        float(np.linalg.norm(now[:3, 3] - before[:3, 3])),
        float(np.linalg.norm(vector_from_rotation(now[:3, :3] @ before[:3, :3].T))),
    )
