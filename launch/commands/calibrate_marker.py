"""`flexsheet calibrate marker`: determine the position of the marker on the finger."""

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
)
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_result,
)

if TYPE_CHECKING:
    from flexsheet.launch.calibration.marker_fit import Touch
    from flexsheet.messages.marker_calibration import MarkerCalibration
    from flexsheet.messages.scene import Scene


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
    twin: Annotated[
        Path | None,
        typer.Option(metavar="SCENE", help="Simulate the touches with the finger of this scene."),
    ] = None,
    apparatus: options.TwinApparatusOption = None,
    calibration_file: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="With --twin: stereo calibration file with which the marker's positions are "
            "computed from simulated images. Default: the camera parameters of the scene.",
        ),
    ] = None,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Determine the position of the marker relative to the finger pad, which touches the sheet.

    The finger touches points whose positions are known. The touches are rows of a CSV file (--rows,
    --scene) or are simulated (--twin).
    """
    from flexsheet.launch.calibration.touches import read_touches, simulate_touches
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.apparatus import nominal_apparatus
    from flexsheet.messages.calibration import StereoCalibration

    if (rows is None) == (twin is None):
        raise CommandError("give exactly one source of touches: --rows CSV or --twin SCENE")
    for name, value in (("--apparatus", apparatus), ("--calibration", calibration_file)):
        if value is not None and twin is None:
            raise CommandError(f"{name} {value}: the option is for --twin SCENE only; remove it")
    if rows is not None:
        scene = load_scene(scene_file)
        touches = read_touches(rows, scene)
        source = str(rows)
    else:
        assert twin is not None
        scene = load_scene(twin)
        true = load_true_devices(apparatus, scene) or nominal_apparatus(scene)
        optics = None if calibration_file is None else StereoCalibration.load(calibration_file)
        touches = simulate_touches(scene, true, calibration=optics, seed=seed)
        source = f"twin of {scene.name}"
    calibration = make_calibration(touches, scene, source)
    calibration.save(output, comment=command_line())
    values = calibration.model_dump(mode="json")
    print_result({"calibration": str(output), **values}, as_json=as_json)


def make_calibration(touches: list[Touch], scene: Scene, source: str) -> MarkerCalibration:
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
