"""`flexsheet calibrate sheet`: fit the force model of the sheet to measured or simulated pushes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.calibrate import (
    app,
    command_line,
    load_true_devices,
    make_provenance,
    require_twin,
)
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_result,
    progress_bar,
)

if TYPE_CHECKING:
    from flexsheet.launch.calibration.sheet_fit import MeasuredPush
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.scene import Scene
    from flexsheet.messages.sheet_calibration import SheetCalibration

GAUGE_N = 0.005
"""The standard deviation of the noise of the simulated force gauge, in newtons."""


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
    twin: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE",
            help="Simulate the pushes with the sheet of this scene file.",
        ),
    ] = None,
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
    from flexsheet.launch.plans.plan import load_scene

    if (rows is None) == (twin is None):
        raise CommandError("give exactly one source of pushes: --rows CSV or --twin SCENE")
    require_twin(apparatus, simulated=twin is not None)
    if rows is not None:
        scene = load_scene(scene_file)
        pushes, lines = read_rows(rows, scene.sheet, scene.finger.radius_m)
        source = str(rows)
    else:
        assert twin is not None
        scene = load_scene(twin)
        true = load_true_devices(apparatus, scene)
        pushes = simulate_pushes(scene, true, seed=seed)
        lines = list(range(1, len(pushes) + 1))
        source = f"twin of {scene.name}"
    try:
        calibration = make_calibration(scene, pushes, lines, source=source)
    except SheetModelFitError as error:
        raise CommandError(f"{source}: {error}") from error
    calibration.save(output, comment=command_line())
    _print_result(calibration, output, as_json)


def make_calibration(
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
    from flexsheet.messages.sheet_calibration import (
        Fitted,
        LeftOutRow,
        SheetCalibration,
    )
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


def _print_result(calibration: SheetCalibration, output: Path, as_json: bool) -> None:
    names = {"modulus_thickness_n_per_m", "slack_width_m", "cubic_ratio"}
    fitted = calibration.model_dump(include=names | {"hysteresis_ratio"})
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
