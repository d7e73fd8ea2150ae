"""`flexsheet chart`: measure the computing time and accuracy of alternative methods."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from flexsheet.launch.commands.options import CYLINDER, JsonOption, make_app, output_file
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    logs_on_stderr,
    print_json,
    print_table,
    progress_words,
    shown,
    words,
)
from flexsheet.launch.methods.results import replace_non_finite
from flexsheet.launch.plans.shipped import SCENES, find_file

app = make_app()

SYSTEM = "system"

STROKE_S = 10.0
"""The duration of each simulated stroke of `flexsheet chart system`, in seconds."""


@app.command(
    epilog=examples(
        "flexsheet chart correction",
        "flexsheet chart sheet-shape --scene lab.yaml --json",
        "flexsheet chart system --scene launch/scenes/light-touch.yaml --blocks 6 --json",
    )
)
def chart(
    *,
    family: Annotated[
        str | None,
        typer.Argument(
            help="Method family to measure; default: all families. The name system selects whole "
            "configurations of a graph instead.",
        ),
    ] = None,
    scene_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--scene",
            metavar="SCENE",
            help="Scene to measure in; default: cylinder. For system, repeat the option for "
            "several scenes; the default is all shipped scenes.",
        ),
    ] = None,
    output: Annotated[Path, output_file("Folder for the charts and results.", "FOLDER")] = Path(
        "runs/charts"
    ),
    blocks: Annotated[
        int,
        typer.Option(
            min=1,
            max=1000,
            help="For system: number of repetitions; each runs every configuration once.",
        ),
    ] = 12,
    apparatuses: Annotated[
        int,
        typer.Option(
            min=0,
            max=100,
            help="For system: number of random samples of inaccurate hardware (apparatuses) for "
            "which the errors are computed.",
        ),
    ] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure the computing time and error of the methods in a method family, and draw a chart.

    A method is measured in all cases that it supports. For each method, the command prints the
    largest median time and the largest error of these cases. A method is marked "front" if no other
    method is both faster and more accurate. `system` measures whole graphs instead. To continue an
    interrupted measurement of `system`, repeat the command with the same --output.
    """
    logs_on_stderr()
    from flexsheet.launch.methods.results import describe_load

    chosen = [find_file(one, SCENES) for one in scene_files or ()]
    if busy := describe_load():
        words.print(busy, style="yellow")
    if family == SYSTEM:
        from flexsheet.launch.methods.system_chart import run_system_chart
        from flexsheet.launch.methods.system_picture import draw_system_chart
        from flexsheet.messages.files import write_file

        with progress_words() as progress:
            result = run_system_chart(
                chosen or sorted(SCENES.glob("*.yaml")),
                output,
                progress,
                blocks=blocks,
                seconds=STROKE_S,
                apparatuses=apparatuses,
            )
        image = output / "system.svg"
        draw_system_chart(result, image)
        result = replace_non_finite({**result, "picture": str(image)})
        write_file(image.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
        if as_json:
            print_json(result)
        else:
            _print_configurations(result)
        words.print(f"chart: {image}")
        return
    from flexsheet.launch.methods import charts
    from flexsheet.launch.plans.plan import load_scene

    if len(chosen) > 1:
        raise CommandError("--scene: only `chart system` accepts several scenes")
    scene = load_scene(chosen[0] if chosen else find_file(CYLINDER, SCENES))
    results = []
    for each in [charts.find_family(name) for name in ([family] if family else charts.FAMILIES)]:
        with progress_words() as progress:
            points = charts.measure_family(each, scene, progress=progress)
        result = replace_non_finite(charts.make_chart_result(each, scene, points))
        image, _ = charts.write_chart(result, output)
        words.print(f"chart: {image}")
        results.append(result)
        if not as_json:
            _print_methods(result)
    if as_json:
        print_json(results[0] if family else results)


def _print_configurations(result: dict[str, Any]) -> None:
    from flexsheet.launch.methods.system_chart import ERRORS

    front = {(one["scene"], one["configuration"]) for one in result["front"]}
    columns = ("scene", "configuration", "cores", "to arm, ms", "to image, ms", *ERRORS)
    rows = [
        (
            point["scene"],
            point["configuration"],
            f"{point['cpu_cores']:.2f}",
            _latency(point["exposure_to_arm_ms"]),
            _latency(point["exposure_to_light_ms"]),
            *(shown(point[key]) for key in ERRORS),
            "front" if (point["scene"], point["configuration"]) in front else "",
            "" if point["meets_tolerances"] else "fails: " + ", ".join(point["failing"]),
        )
        for point in result["points"]
    ]
    print_table((*columns, "", ""), rows)
    for one in result["failed"]:
        words.print(f"{one['scene']}: {one['trial']} failed: {one['error']}")


def _latency(found: dict[str, float] | None) -> str:
    return "-" if found is None else f"{found['p50']:.1f} / {found['p99']:.1f}"


def _print_methods(result: dict[str, Any]) -> None:
    from flexsheet.launch.methods.charts import format_duration, summarize_methods

    rows = [
        (
            one["method"],
            format_duration(one["median_s"]),
            format_duration(one["p99_s"]),
            *(shown(one[key]) for key in ("error", "error_outside")),
            f"{one['inside']} of {one['cases']}",
            "front" if one["front"] else "",
        )
        for one in summarize_methods(result)
    ]
    error = f"error, {result['unit']}"
    print_table(("method", "median", "p99", error, "outside", "cases in range", ""), rows)
