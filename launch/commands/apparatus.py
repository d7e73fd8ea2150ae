"""`flexsheet apparatus`: show and write the true parameters of simulated hardware.

A set of these parameters is called an apparatus.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.output import examples, print_json, print_rows, words

app = options.make_app()


@app.command(
    epilog=examples(
        "flexsheet apparatus apparatus.yaml",
        "flexsheet apparatus seed:7,paper --json",
        "flexsheet apparatus seed:7,paper,calibrated -o apparatus.yaml",
    )
)
def show(
    *,
    apparatus: Annotated[
        str,
        typer.Argument(
            metavar="FILE|seed:N",
            help="Apparatus file, or seed:N for a random sample. Seeds 0 to 99 are for "
            "development, higher seeds for evaluation. seed:7,paper simulates older equipment. "
            "seed:7,calibrated contains only the errors that remain after calibrations.",
        ),
    ],
    output: Annotated[
        Path | None, options.output_file("File to which the apparatus is written.")
    ] = None,
    scene: options.SceneOption = options.CYLINDER,
    as_json: options.JsonOption = False,
) -> None:
    """Check an apparatus, and list its parameters that differ from the scene.

    An apparatus is a set of true parameters of simulated hardware. A sample lies within the
    tolerances of the hardware. The exit code is 2 if a file has unknown keys or impossible values,
    or belongs to another scene.
    """
    from flexsheet.launch.plans.apparatus import format_apparatus, load_apparatus
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.files import write_file
    from flexsheet.nodes.twin.tolerance_table import NOT_SIMULATED, list_differences

    loaded = load_apparatus(apparatus, load_scene(scene), scene)
    if output is not None:
        write_file(output, format_apparatus(loaded))
        words.print(f"{loaded.origin}: written to {output}")
    rows: list[dict[str, Any]] = [
        {
            "parameter": path,
            "value": value,
            "nominal": nominal,
            "unit": unit,
            "simulated": path not in NOT_SIMULATED,
        }
        for path, value, nominal, unit in list_differences(loaded)
    ]
    if as_json:
        print_json({"scene": loaded.scene, "origin": loaded.origin, "differences": rows})
        return
    words.print(f"scene {loaded.scene}, {loaded.origin}: {len(rows)} differences")
    for row in rows:
        if row["nominal"] is None:
            row["nominal"] = "value in scene or node"
    print_rows(rows, as_json=False, digits=6)
