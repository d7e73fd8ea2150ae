"""`flexsheet doctor compliance`: check that the sheet can feel as soft as the virtual object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.doctor import app
from flexsheet.launch.commands.options import JsonOption, SceneArgument
from flexsheet.launch.commands.output import (
    FAILED,
    examples,
    print_columns,
    print_json,
    print_result,
    progress_words,
    words,
)


@app.command(
    epilog=examples("flexsheet doctor compliance launch/scenes/cylinder.yaml"),
)
def compliance(
    scene_file: SceneArgument,
    calibration: Annotated[
        Path | None, typer.Option(help="Sheet calibration file from `flexsheet calibrate sheet`.")
    ] = None,
    delay_ms: Annotated[
        float,
        typer.Option(
            metavar="MS",
            min=0.0,
            max=500.0,
            help="Delay from a measurement of the finger's depth to the sheet's motion, ms.",
        ),
    ] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Check that the sheet can feel as soft as the virtual object of a scene.

    The command compares the force of the object's model with the rendered force, for pushes at the
    centre up to the maximum depth of the scene. It also checks that hand and sheet cannot oscillate
    at the given delay. The first call computes the object's model, which takes minutes. The exit
    code is 1 if a check fails.
    """
    from flexsheet.launch.health.compliance import (
        ForceCurveStage,
        compliance_result,
        compute_front_curve,
        describe_estimate,
    )
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.running.precompute import report_time_left
    from flexsheet.messages.sheet_calibration import SheetCalibration
    from flexsheet.nodes.planner.compliance import ObjectCurve
    from flexsheet.nodes.planner.force_table import choose_force_model

    scene = load_scene(scene_file)
    law, _ = choose_force_model(
        scene, None if calibration is None else SheetCalibration.load(calibration)
    )
    with progress_words() as progress:
        reporters = {stage: report_time_left(stage, progress) for stage in ForceCurveStage}
        rows = compute_front_curve(
            scene,
            on_progress=lambda stage, done, total: reporters[stage](done, total),
            on_linear=lambda linear: words.print(describe_estimate(scene, law, linear)),
        )
        curve = ObjectCurve.from_rows(rows)
        progress("computing the rendered force")
        result = compliance_result(scene, law, curve, delay_s=1e-3 * delay_ms, progress=progress)
    if as_json:
        print_json(result)
    else:
        table = [
            {**row, "error": row["rendered_n"] / max(row["target_n"], 1e-9) - 1}
            for row in result["rows"]
        ]
        print_columns(
            table,
            {
                "depth, mm": ("depth_mm", ".0f"),
                "model, N": ("target_n", ".3f"),
                "rendered, N": ("rendered_n", ".3f"),
                "rendering error": ("error", "+.1%"),
                "normal offset, mm": ("normal_offset_mm", ".2f"),
            },
        )
        figures = {name: one for name, one in result.items() if name not in ("rows", "note")}
        print_result(figures, as_json=False)
        words.print(
            result["note"]
            or "the rendering error relative to the model of the object is within the tolerance"
        )
        words.print(
            "`flexsheet status` states the error of this model relative to the reference (node "
            "fem_solver)"
        )
    if result["note"]:
        raise typer.Exit(FAILED)
