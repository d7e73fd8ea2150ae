"""`flexsheet apparatus`: sample and show the true parameters of simulated hardware.

A set of these parameters is called an apparatus.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.output import (
    examples,
    print_json,
    print_outcome,
    print_rows,
    words,
)

app = options.make_app("Sample and show an apparatus: true parameters of the simulated hardware.")


@app.command(
    epilog=examples(
        "flexsheet apparatus sample --seed 7 -o apparatus.yaml",
        "flexsheet apparatus sample --seed 7 --profile paper --calibrated -o apparatus.yaml",
    )
)
def sample(
    *,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            help="Random seed; seeds 0 to 99 are for development, higher seeds for evaluation.",
        ),
    ],
    output: Annotated[Path, options.output_file("Apparatus file to write.")],
    profile: options.ProfileOption = "modern",
    calibrated: options.CalibratedOption = False,
    scene: options.SceneOption = options.CYLINDER,
    as_json: options.JsonOption = False,
) -> None:
    """Write a random apparatus, which is a set of true parameters of simulated hardware.

    The parameters are sampled within the tolerances of the hardware.
    """
    from flexsheet.launch.plans.apparatus import format_apparatus
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.files import write_file
    from flexsheet.nodes.twin.tolerance_table import Profile, sample_apparatus

    drawn = sample_apparatus(
        load_scene(scene), seed, profile=Profile(profile), calibrated=calibrated
    )
    write_file(output, format_apparatus(drawn))
    print_outcome(
        {"file": str(output), "origin": drawn.origin, "scene": drawn.scene},
        f"{drawn.origin}: written to {output}",
        as_json=as_json,
    )


@app.command(
    epilog=examples(
        "flexsheet apparatus show apparatus.yaml",
        "flexsheet apparatus show seed:7,paper --json",
    )
)
def show(
    *,
    apparatus: Annotated[
        str,
        typer.Argument(
            metavar="FILE|seed:N", help="Apparatus file, or seed:N for a random sample."
        ),
    ],
    scene: options.SceneOption = options.CYLINDER,
    as_json: options.JsonOption = False,
) -> None:
    """Check an apparatus, and list its parameters that differ from the scene.

    An apparatus is a set of true parameters of simulated hardware. The exit code is 2 if the file
    has unknown keys or impossible values, or belongs to another scene.
    """
    from flexsheet.launch.plans.apparatus import load_apparatus
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.nodes.twin.tolerance_table import NOT_SIMULATED, list_differences

    loaded = load_apparatus(apparatus, load_scene(scene), scene)
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
