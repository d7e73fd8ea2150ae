"""Check that the sheet can feel as soft as the virtual object of a scene."""

from __future__ import annotations

from pathlib import Path

import typer

from flexsheet.launch.commands.output import (
    FAILED,
    print_columns,
    print_json,
    print_result,
    progress_words,
    words,
)


def check_compliance(
    scene_file: Path, calibration: Path | None, *, delay_ms: float, as_json: bool
) -> None:
    """Compare the force of the object's model with the rendered force, and print the result.

    The pushes are at the centre, up to the maximum depth of the scene. Also check that hand and
    sheet cannot oscillate.

    delay_ms: delay from a measurement of the finger's depth to the sheet's motion.

    Raises typer.Exit with the exit code 1 if a check fails.
    """
    from flexsheet.launch.health.compliance import compliance_result, compute_front_curve
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.sheet_calibration import SheetCalibration
    from flexsheet.nodes.planner.compliance import ObjectCurve
    from flexsheet.nodes.planner.force_table import choose_force_model

    scene = load_scene(scene_file)
    law, _ = choose_force_model(
        scene, None if calibration is None else SheetCalibration.load(calibration)
    )
    with progress_words() as progress:
        curve = ObjectCurve.from_rows(compute_front_curve(scene, None, progress))
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
