"""`flexsheet calibrate projector`: calibrate the projector's pose and lens distortion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.calibrate import (
    CalibrationOption,
    app,
    load_optics,
    load_true_devices,
    pose_values,
    require_twin,
    round_digits,
    write_scene_values,
)
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    print_result,
    words,
)
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import require_projector

if TYPE_CHECKING:
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.scene import Projector, Scene, StereoCamera
    from flexsheet.nodes.arrays import Image

    Views = tuple[list[Image], list[Image]]

VOLUME_HALF_M = 0.1
TWIN_POSES = 6
"""The number of simulated poses of the sheet."""


@app.command(
    epilog=examples(
        "flexsheet calibrate projector --scene lab.yaml --write-patterns patterns",
        "flexsheet calibrate projector --scene lab.yaml --pictures poses -o lab-measured.yaml",
    ),
)
def projector(
    *,
    scene_file: options.SceneOption,
    output: Annotated[
        Path | None,
        options.result_file("Scene file to write with the result; may be the file of --scene."),
    ] = None,
    calibration: CalibrationOption = None,
    write_patterns: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Only write the Gray-code patterns for --pictures to this folder.",
        ),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder with one subfolder per sheet pose, which contains one image per pattern "
            "and camera: left00.png, right00.png, ...",
        ),
    ] = None,
    twin: Annotated[
        bool,
        typer.Option(
            "--twin", help="Calibrate a simulated projector that deviates from the scene."
        ),
    ] = False,
    apparatus: options.TwinApparatusOption = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate the pose and the lens of the projector, and write the result into a scene.

    The data are stereo images of Gray-code patterns that are projected onto the sheet, in three or
    more poses of the sheet (--pictures). With --twin, the images are simulated.
    """
    from flexsheet.launch.calibration import gray_code
    from flexsheet.launch.calibration.projector import calibrate_projector, measure_points
    from flexsheet.launch.plans.plan import load_scene

    scene = load_scene(scene_file)
    size = require_projector(scene).width_px, require_projector(scene).height_px
    if write_patterns is not None:
        shown = gray_code.make_patterns(*size)
        _write_patterns(shown, write_patterns)
        if as_json:
            print_json({"folder": str(write_patterns), "patterns": len(shown)})
        return
    if (pictures is not None) == twin:
        raise CommandError(
            "give exactly one of --pictures and --twin; to capture images, first write "
            "the patterns with --write-patterns FOLDER"
        )
    require_twin(apparatus, simulated=twin)
    true: Projector | None = None
    if twin:
        from flexsheet.nodes.twin.projector import make_true_projector
        from flexsheet.nodes.twin.truth import apply_apparatus

        devices = load_true_devices(apparatus, scene)
        if devices is None:
            true = make_true_projector(require_projector(scene), seed=seed)
        else:
            true = require_projector(apply_apparatus(scene, devices))
        views = list(simulate_views(scene, true, devices, TWIN_POSES, seed))
    else:
        assert pictures is not None
        views = list(read_views(pictures, len(gray_code.make_patterns(*size))))
    camera = load_camera(scene, calibration)
    fit = calibrate_projector(
        measure_points(views, camera, require_projector(scene)), require_projector(scene)
    )
    if output is not None:
        write_scene_values(scene_file, list_scene_values(fit.projector), output)
    lens, pose = fit.projector.lens, fit.projector.world_from_projector
    result: dict[str, Any] = {
        "scene": None if output is None else str(output),
        "poses": fit.poses,
        "points": fit.points,
        "outliers": fit.outliers,
        "rms_px": fit.rms_px,
        "rms_mm": 1e3 * fit.rms_m,
        "held_out_rms_px": fit.held_out_rms_px,
        "before_rms_px": fit.before_rms_px,
        "coverage_ratio": fit.coverage_ratio,
        "depth_range_mm": 1e3 * fit.depth_range_m,
        "lens": lens.model_dump(),
        **pose.model_dump(mode="json"),
    }
    if true is not None:
        result["eye_error_mm"] = _eye_errors_mm(scene, fit.projector, true)
        named = {"width_px", "height_px", "lens", "world_from_projector"}
        result["true_projector"] = true.model_dump(mode="json", include=named)
    print_result(result, as_json=as_json)


def _write_patterns(patterns: Sequence[Image], folder: Path) -> None:
    from flexsheet.nodes.camera.image_pair import encode_png

    folder.mkdir(parents=True, exist_ok=True)
    for number, pattern in enumerate(patterns):
        write_file(folder / f"pattern{number:02}.png", encode_png(pattern))
    words.print(
        f"{len(patterns)} patterns written to {folder}; project each without scaling, and capture "
        "it with both cameras"
    )


def read_views(folder: Path, count: int) -> Iterator[Views]:
    from flexsheet.launch.calibration.corners import read_gray

    poses = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if not poses:
        raise CommandError(
            f"--pictures {folder}: the folder contains no subfolders; make one for each sheet pose"
        )
    for pose in poses:
        sides = []
        for side in ("left", "right"):
            paths = sorted(pose.glob(f"{side}*.png"))
            if len(paths) != count:
                raise CommandError(
                    f"--pictures {pose}: expected {count} files {side}*.png, one per pattern, "
                    f"found {len(paths)}"
                )
            sides.append([read_gray(path) for path in paths])
        yield sides[0], sides[1]


def simulate_views(
    scene: Scene, true: Projector, apparatus: Apparatus | None, poses: int, seed: int
) -> Iterator[Views]:
    """Yield the simulated left and right images of all Gray-code patterns, for each sheet pose.

    true: simulated projector.
    apparatus: true parameters of the other simulated devices, including the arms that hold the
        sheet. If it is None, the sheet is flat and exactly at the commanded poses.
    poses: number of sheet poses.
    """
    from rich.progress import track

    from flexsheet.launch.calibration.gray_code import make_patterns
    from flexsheet.launch.calibration.simulated_sheet import SimulatedSheet
    from flexsheet.nodes.twin.projector import LitSheet, sheet_poses
    from flexsheet.nodes.twin.rig import make_true_camera
    from flexsheet.nodes.twin.truth import apply_apparatus

    shown = make_patterns(require_projector(scene).width_px, require_projector(scene).height_px)
    camera = make_true_camera(apply_apparatus(scene, apparatus).camera)
    lit = LitSheet(scene, camera, true, seed=seed)
    arms = None if apparatus is None else SimulatedSheet(scene, apparatus)
    spec = scene.sheet
    distance_m = 0.5 * (spec.min_stretch_ratio + spec.max_stretch_ratio) * spec.width_m
    tracked = track(sheet_poses(poses), "simulating images", console=words.console, transient=True)
    for world_from_sheet in tracked:
        if arms is None:
            yield lit.pair(shown, world_from_sheet)
        else:
            yield lit.pair(shown, *arms.hold(world_from_sheet, distance_m))


def load_camera(scene: Scene, calibration: Path | None) -> StereoCamera:
    """Return the stereo camera of the scene.

    If a calibration is given, the camera has the calibrated intrinsics and relative pose.
    """
    optics = load_optics(calibration, scene)
    if optics is None:
        return scene.camera
    return scene.camera.model_copy(
        update={
            "left": optics.left,
            "right": optics.right,
            "right_from_left": optics.right_from_left,
        }
    )


def list_scene_values(projector: Projector) -> dict[str, Any]:
    """Return the pose and the lens parameters of a projector as new values for a scene file.

    Each key is a dotted path, such as `projector.world_from_projector.rpy_rad`.
    """
    values = pose_values("projector.world_from_projector", projector.world_from_projector)
    for key in ("fx_px", "fy_px", "cx_px", "cy_px"):
        values[f"projector.lens.{key}"] = round_digits(getattr(projector.lens, key))
    values["projector.lens.distortion"] = [round_digits(k) for k in projector.lens.distortion]
    return values


def _eye_errors_mm(scene: Scene, fitted: Projector, true: Projector) -> dict[str, dict[str, float]]:
    """Return the errors (mm) of the projected image that the user sees.

    The result contains the mean and the maximum error "before" and "after" the calibration.

    fitted: calibrated projector.
    true: simulated projector.
    """
    from flexsheet.nodes.twin.projector import errors_at_eye, sheet_poses

    eye, planes = scene.eyes.centre_world_m, sheet_poses(7)
    result = {}
    for when, predicted in (("before", require_projector(scene)), ("after", fitted)):
        errors = 1e3 * errors_at_eye(predicted, true, eye, planes, VOLUME_HALF_M)
        result[when] = {"mean": float(errors.mean()), "max": float(errors.max())}
    return result
