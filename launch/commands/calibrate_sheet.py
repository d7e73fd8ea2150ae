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
        "flexsheet calibrate sheet --bag pushes.mcap -o sheet.yaml",
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
    bag: Annotated[
        Path | None,
        typer.Option(
            metavar="BAG",
            help="Recording with the topics force, fingertip, arm_left and arm_right, in which a "
            "finger rests at several depths; its scene replaces --scene.",
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
    places: Annotated[
        bool,
        typer.Option("--places", help="With --twin: push the whole sheet, not only its centre."),
    ] = False,
    table: Annotated[
        bool,
        typer.Option(
            "--table", help="Also store a table of factors that correct the fitted model."
        ),
    ] = False,
    mooney: Annotated[
        bool,
        typer.Option(
            "--mooney",
            help="Also fit the weight of the Mooney term of the rubber model; requires stretch "
            "ratios above 1.15.",
        ),
    ] = False,
    apparatus: options.TwinApparatusOption = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Fit the force model of a sheet to the forces on a finger that pushes the sheet.

    The command fits the product of Young's modulus and thickness, the width of the sheet without
    tension, and a cubic term of the force. The pushes are rows of a CSV file (--rows, --scene),
    come from a recording with a force gauge (--bag), or are simulated (--twin).
    """
    from flexsheet.launch.calibration.sheet_bag import read_pushes
    from flexsheet.launch.calibration.sheet_fit import SheetModelFitError
    from flexsheet.launch.calibration.sheet_rows import read_rows
    from flexsheet.launch.plans.plan import load_scene

    if sum(one is not None for one in (rows, bag, twin)) != 1:
        raise CommandError(
            "give exactly one source of pushes: --rows CSV, --bag BAG or --twin SCENE"
        )
    require_twin(apparatus, simulated=twin is not None)
    if rows is not None:
        scene = load_scene(scene_file)
        pushes, lines = read_rows(rows, scene.sheet, scene.finger.radius_m)
        source = str(rows)
    elif bag is not None:
        try:
            scene, pushes = read_pushes(bag)
        except SheetModelFitError as error:
            raise CommandError(f"{bag}: {error}") from error
        lines = list(range(1, len(pushes) + 1))
        source = str(bag)
    else:
        assert twin is not None
        scene = load_scene(twin)
        true = load_true_devices(apparatus, scene)
        pushes = simulate_pushes(scene, true, places=places, seed=seed)
        lines = list(range(1, len(pushes) + 1))
        source = f"twin of {scene.name}"
    try:
        calibration = make_calibration(
            scene,
            pushes,
            lines,
            source=source,
            with_mooney=mooney,
            with_table=table,
            with_prior=bag is not None,
        )
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
    with_mooney: bool,
    with_table: bool,
    with_prior: bool = False,
) -> SheetCalibration:
    """Fit the force model of the sheet to measured pushes, and return the calibration.

    lines: line number of each push in its file.
    with_mooney: whether the weight of the Mooney term of the rubber model is fitted.
    with_table: whether a table of factors that correct the fitted model is added.
    with_prior: whether the scene's sheet width and ideal rubber are used as prior values of the
        fit.

    Raises SheetModelFitError if the pushes do not determine the parameters.
    """
    from functools import partial

    from flexsheet.launch.calibration.sheet_fit import (
        estimate_hysteresis,
        fit_sheet_model,
        remove_hysteresis,
        tabulate_pushes,
    )
    from flexsheet.messages.sheet_calibration import (
        Fitted,
        LeftOutRow,
        SheetCalibration,
        SheetTable,
    )
    from flexsheet.nodes.planner.sheet_force import make_rubber

    fit_model = partial(
        fit_sheet_model,
        nominal=make_rubber(scene.sheet),
        with_mooney=with_mooney,
        with_prior=with_prior,
    )
    fit = fit_model(pushes)
    hysteresis = estimate_hysteresis(fit, pushes)
    if hysteresis is not None:
        pushes = remove_hysteresis(pushes, hysteresis)
        fit = fit_model(pushes)
    numbers = {
        name: Fitted(value=value, standard_deviation=deviation)
        for name, value, deviation in zip(
            fit.names, fit.values, fit.standard_deviations, strict=True
        )
    }
    table = None
    if with_table:
        entries = tabulate_pushes(fit.law, pushes, fit.used, scene.sheet.width_m)
        table = SheetTable(
            stretch_ratios=entries.stretches,
            depths_m=entries.depths_m,
            xs_m=entries.xs_m,
            ys_m=entries.ys_m,
            ratios=entries.ratios,
        )
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
        mooney_ratio=numbers.get("mooney_ratio"),
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
        table=table,
    )


def simulate_pushes(
    scene: Scene, apparatus: Apparatus | None, *, places: bool, seed: int
) -> list[MeasuredPush]:
    """Simulate measurements in which a finger pushes the sheet of a scene.

    places: whether to push at points all over the sheet, not only at its centre.
    """
    from flexsheet.launch.calibration.sheet_rows import simulate_rows

    with progress_bar("simulating pushes") as progress:
        return simulate_rows(
            scene, places=places, noise_n=GAUGE_N, seed=seed, apparatus=apparatus, progress=progress
        )


def _print_result(calibration: SheetCalibration, output: Path, as_json: bool) -> None:
    names = {"modulus_thickness_n_per_m", "slack_width_m", "cubic_ratio"}
    fitted = calibration.model_dump(include=names | {"mooney_ratio", "hysteresis_ratio"})
    excluded = {f"line {one.line}": one.residual_ratio for one in calibration.left_out}
    result = {
        "calibration": str(output),
        "rows": calibration.rows,
        "left_out": [one.model_dump() for one in calibration.left_out] if as_json else excluded,
        "residual_rms_ratio": calibration.residual_rms_ratio,
        "max_residual_ratio": calibration.max_residual_ratio,
        "residual_rms_sigmas": calibration.residual_rms_sigmas,
        "table": calibration.table is not None,
        **{name: one for name, one in fitted.items() if one is not None},
    }
    print_result(result, as_json=as_json)
