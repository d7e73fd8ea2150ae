"""`flexsheet calibrate edges`, `marker` and `sheet`: calibrate from rows of measurements.

The rows are read from a CSV file or simulated.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.calibrate import (
    CalibrationOption,
    app,
    command_line,
    load_optics,
    load_true_devices,
    make_provenance,
    pose_values,
    require_twin,
    round_digits,
    write_scene_values,
)
from flexsheet.launch.commands.output import CommandError, examples, print_result, progress_bar

if TYPE_CHECKING:
    from flexsheet.launch.calibration.edge_fit import EdgeFit
    from flexsheet.launch.calibration.marker_fit import Touch
    from flexsheet.launch.calibration.sheet_fit import MeasuredPush
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.marker_calibration import MarkerCalibration
    from flexsheet.messages.scene import Scene
    from flexsheet.messages.sheet_calibration import SheetCalibration
    from flexsheet.messages.types import Side

GAUGE_N = 0.005
"""The standard deviation of the noise of the simulated force gauge, in newtons."""

TwinSceneOption = Annotated[
    Path | None,
    typer.Option("--twin", metavar="SCENE", help="Simulate the rows with this scene."),
]


def _load_source(
    kind: str, rows: Path | None, scene_file: Path, twin: Path | None, apparatus: str | None
) -> tuple[Scene, Apparatus | None, str]:
    """Return the scene, the true parameters of the simulated hardware, and the source's name.

    The parameters are None if rows are read, or if the option --apparatus is not given.

    kind: noun for the measurements in the error text.

    Raises CommandError unless exactly one of --rows and --twin is given.
    """
    from flexsheet.launch.plans.plan import load_scene

    if (rows is None) == (twin is None):
        raise CommandError(f"give exactly one source of {kind}: --rows CSV or --twin SCENE")
    require_twin(apparatus, simulated=twin is not None)
    if twin is None:
        return load_scene(scene_file), None, str(rows)
    scene = load_scene(twin)
    return scene, load_true_devices(apparatus, scene), f"twin of {scene.name}"


@app.command(
    epilog=examples(
        "flexsheet calibrate edges --rows marks.csv --scene lab.yaml -o measured.yaml",
        "flexsheet calibrate edges --twin --apparatus seed:3 "
        "--calibration launch/calibrations/twin-bumblebee.yaml -o measured.yaml",
    ),
)
def edges(
    *,
    output: Annotated[
        Path,
        options.result_file("Output file: a copy of the scene with the measured arm parameters."),
    ],
    rows: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV", help="CSV file of measured marks, from `calibrate capture edges`."
        ),
    ] = None,
    scene_file: options.SceneOption = options.CYLINDER,
    twin: Annotated[
        bool, typer.Option("--twin", help="Simulate the marks instead of reading a file.")
    ] = False,
    apparatus: options.TwinApparatusOption = None,
    calibration: CalibrationOption = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Measure where the arms hold the sheet, from camera images of marks on the clamps.

    For both arms, the command fits the poses of the base and of the sheet's edge on the flange. It
    also fits joint offsets and flange compliance, and writes all results into a copy of the scene.
    """
    from flexsheet.launch.calibration.edge_fit import EdgeFitError, fit_edges
    from flexsheet.launch.calibration.edge_marks import read_edge_marks, simulate_edge_marks
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.apparatus import nominal_apparatus

    if twin == (rows is not None):
        raise CommandError("give exactly one source of marks: --rows CSV or --twin")
    require_twin(apparatus, simulated=twin)
    scene = load_scene(scene_file)
    if rows is not None:
        poses = read_edge_marks(rows)
    else:
        true = load_true_devices(apparatus, scene) or nominal_apparatus(scene)
        optics = load_optics(calibration, scene)
        poses = simulate_edge_marks(scene, true, calibration=optics, seed=seed)
    try:
        fits = fit_edges(poses, scene)
    except EdgeFitError as error:
        raise CommandError(f"{rows or scene_file}: {error}; {error.remedy}") from error
    write_scene_values(scene_file, list_arm_values(fits), output)
    found = {
        side: {
            "marks": fit.marks,
            "poses": fit.poses,
            "residual_rms_m": fit.residual_rms_m,
            "edge_std_m": fit.edge_std_m,
            "joint_offsets_rad": fit.arm.joint_offsets_rad,
            "flange_compliance_m_per_n": fit.arm.flange_compliance_m_per_n,
            "compliance_std_m_per_n": fit.compliance_std_m_per_n,
        }
        for side, fit in fits.items()
    }
    print_result({"scene": str(output), "arms": found}, as_json=as_json)


def list_arm_values(fits: dict[Side, EdgeFit]) -> dict[str, Any]:
    """Return the fitted parameters of both arms as new values for a scene file.

    Each key is a dotted path, such as `arms.left.world_from_base.rpy_rad`.
    """
    values: dict[str, Any] = {}
    for side, fit in fits.items():
        arm, key = fit.arm, f"arms.{side}"
        values |= pose_values(f"{key}.world_from_base", arm.world_from_base)
        values |= pose_values(f"{key}.flange_from_edge", arm.flange_from_edge)
        values[f"{key}.joint_offsets_rad"] = [round_digits(one) for one in arm.joint_offsets_rad]
        values[f"{key}.flange_compliance_m_per_n"] = round_digits(arm.flange_compliance_m_per_n)
    return values


@app.command(
    epilog=examples(
        "flexsheet calibrate marker --rows touches.csv --scene lab.yaml -o marker.yaml",
        "flexsheet calibrate marker --twin launch/scenes/cylinder.yaml --apparatus seed:3 "
        "-o marker.yaml",
    ),
)
def marker(
    *,
    output: Annotated[Path, options.result_file("Marker calibration file to write.")],
    rows: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="CSV file of touches of known points; docs/set-up-marker.md lists its columns.",
        ),
    ] = None,
    scene_file: options.SceneOption = options.CYLINDER,
    twin: TwinSceneOption = None,
    apparatus: options.TwinApparatusOption = None,
    calibration_file: CalibrationOption = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Determine the position of the marker relative to the finger pad, which touches the sheet.

    The finger touches points whose positions are known. The touches are rows of a CSV file (--rows,
    --scene) or are simulated (--twin).
    """
    from flexsheet.launch.calibration.touches import read_touches, simulate_touches
    from flexsheet.messages.apparatus import nominal_apparatus

    scene, true, source = _load_source("touches", rows, scene_file, twin, apparatus)
    if rows is not None:
        if calibration_file is not None:
            raise CommandError(
                f"--calibration {calibration_file}: the option is for --twin SCENE only; remove it"
            )
        touches = read_touches(rows, scene)
    else:
        optics = load_optics(calibration_file, scene)
        true = true or nominal_apparatus(scene)
        touches = simulate_touches(scene, true, calibration=optics, seed=seed)
    calibration = make_marker_calibration(touches, scene, source)
    calibration.save(output, comment=command_line())
    values = calibration.model_dump(mode="json")
    print_result({"calibration": str(output), **values}, as_json=as_json)


def make_marker_calibration(touches: list[Touch], scene: Scene, source: str) -> MarkerCalibration:
    """Fit the position of the marker on the finger to touches of known points.

    touches: measurements in which the finger touches a point whose position is known.
    source: text that names the origin of the data in the calibration.

    Raises CommandError if the touches do not determine the position.
    """
    from flexsheet.launch.calibration.marker_fit import MarkerFitError, fit_marker
    from flexsheet.messages.marker_calibration import MarkerCalibration

    try:
        fit = fit_marker(touches)
    except MarkerFitError as error:
        raise CommandError(f"{source}: {error}; {error.remedy}") from error
    return MarkerCalibration(
        **make_provenance(),
        source=source,
        scene=scene.name,
        marker_from_pad_m=tuple(fit.marker_from_pad_m.tolist()),
        standard_deviations_m=tuple(fit.standard_deviations_m.tolist()),
        covariance_m2=tuple((x, y, z) for x, y, z in fit.covariance_m2.tolist()),
        point_offset_m=tuple(fit.point_offset_m.tolist()),
        residual_rms_m=fit.residual_rms_m,
        max_residual_m=float(fit.residuals_m.max()),
        touches=len(touches),
        points=fit.points,
        orientations=fit.orientations,
    )


@app.command(
    epilog=examples(
        "flexsheet calibrate sheet --rows pushes.csv --scene lab.yaml -o sheet.yaml",
        "flexsheet calibrate sheet --twin launch/scenes/cylinder.yaml -o sheet.yaml",
    ),
)
def sheet(
    *,
    output: Annotated[Path, options.result_file("Sheet calibration file to write.")],
    rows: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="CSV file of measured pushes; columns: depth_mm, force_n, edge_distance_mm or "
            "stretch_ratio. docs/sheet.md lists optional columns.",
        ),
    ] = None,
    scene_file: options.SceneOption = options.CYLINDER,
    twin: TwinSceneOption = None,
    apparatus: options.TwinApparatusOption = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Fit the force model of a sheet to the forces on a finger that pushes the sheet.

    The command fits the product of Young's modulus and thickness, the width of the sheet without
    tension, and a cubic term of the force. The pushes are rows of a CSV file (--rows, --scene) or
    are simulated (--twin).
    """
    from flexsheet.launch.calibration.sheet_fit import SheetModelFitError
    from flexsheet.launch.calibration.sheet_rows import read_rows

    scene, true, source = _load_source("pushes", rows, scene_file, twin, apparatus)
    if rows is not None:
        pushes, lines = read_rows(rows, scene.sheet, scene.finger.radius_m)
    else:
        pushes = simulate_pushes(scene, true, seed=seed)
        lines = list(range(1, len(pushes) + 1))
    try:
        calibration = make_sheet_calibration(scene, pushes, lines, source=source)
    except SheetModelFitError as error:
        raise CommandError(f"{source}: {error}") from error
    calibration.save(output, comment=command_line())
    names = {"modulus_thickness_n_per_m", "slack_width_m", "cubic_ratio", "hysteresis_ratio"}
    fitted = calibration.model_dump(include=names)
    excluded = {f"line {one.line}": one.residual_ratio for one in calibration.left_out}
    result = {
        "calibration": str(output),
        "rows": calibration.rows,
        "left_out": [one.model_dump() for one in calibration.left_out] if as_json else excluded,
        "residual_rms_ratio": calibration.residual_rms_ratio,
        "max_residual_ratio": calibration.max_residual_ratio,
        "residual_rms_sigmas": calibration.residual_rms_sigmas,
        **{name: one for name, one in fitted.items() if one is not None},
    }
    print_result(result, as_json=as_json)


def make_sheet_calibration(
    scene: Scene,
    pushes: list[MeasuredPush],
    lines: list[int],
    *,
    source: str,
) -> SheetCalibration:
    """Fit the force model of the sheet to measured pushes, and return the calibration.

    lines: line number of each push in its file.

    Raises SheetModelFitError if the pushes do not determine the parameters.
    """
    from flexsheet.launch.calibration.sheet_fit import (
        estimate_hysteresis,
        fit_sheet_model,
        remove_hysteresis,
    )
    from flexsheet.messages.sheet_calibration import Fitted, LeftOutRow, SheetCalibration
    from flexsheet.nodes.planner.sheet_force import make_rubber

    nominal = make_rubber(scene.sheet)
    fit = fit_sheet_model(pushes, nominal)
    hysteresis = estimate_hysteresis(fit, pushes)
    if hysteresis is not None:
        pushes = remove_hysteresis(pushes, hysteresis)
        fit = fit_sheet_model(pushes, nominal)
    numbers = {
        name: Fitted(value=value, standard_deviation=deviation)
        for name, value, deviation in zip(
            fit.names, fit.values, fit.standard_deviations, strict=True
        )
    }
    stretches = [push.edge_distance_m / scene.sheet.width_m for push in pushes]
    return SheetCalibration(
        **make_provenance(),
        source=source,
        nominal_width_m=scene.sheet.width_m,
        height_m=scene.sheet.height_m,
        thickness_m=scene.sheet.thickness_m,
        finger_radius_m=scene.finger.radius_m,
        modulus_thickness_n_per_m=numbers["modulus_thickness_n_per_m"],
        slack_width_m=numbers["slack_width_m"],
        cubic_ratio=numbers["cubic_ratio"],
        hysteresis_ratio=(
            None
            if hysteresis is None
            else Fitted(value=hysteresis.ratio, standard_deviation=hysteresis.standard_deviation)
        ),
        rows=len(pushes),
        left_out=tuple(
            LeftOutRow(line=line, residual_ratio=float(ratio))
            for line, ratio, used in zip(lines, fit.residual_ratio, fit.used, strict=True)
            if not used
        ),
        residual_rms_ratio=fit.rms_ratio,
        max_residual_ratio=fit.worst_ratio,
        residual_rms_sigmas=fit.rms_sigmas,
        min_stretch_ratio=min(stretches),
        max_stretch_ratio=max(stretches),
        max_depth_m=max(push.depth_m for push in pushes),
    )


def simulate_pushes(scene: Scene, apparatus: Apparatus | None, *, seed: int) -> list[MeasuredPush]:
    """Simulate measurements in which a finger pushes the centre of the sheet of a scene."""
    from flexsheet.launch.calibration.sheet_rows import simulate_rows

    with progress_bar("simulating pushes") as progress:
        return simulate_rows(
            scene, noise_n=GAUGE_N, seed=seed, apparatus=apparatus, progress=progress
        )
