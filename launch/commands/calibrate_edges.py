"""`flexsheet calibrate edges`: calibrate the poses of the sheet's edges relative to the arms."""

from __future__ import annotations

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
    print_result,
)

if TYPE_CHECKING:
    from flexsheet.launch.calibration.edge_fit import EdgeFit
    from flexsheet.messages.types import Side


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
    write_scene_values(scene_file, list_scene_values(fits), output)
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


def list_scene_values(fits: dict[Side, EdgeFit]) -> dict[str, Any]:
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
