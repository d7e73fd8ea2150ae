"""`flexsheet chart system`: measure latency, load and errors of whole graph configurations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flexsheet.launch.commands.output import print_json, print_table, progress_words, words

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def measure_system(
    scene_files: Sequence[Path],
    output: Path,
    *,
    blocks: int,
    seconds: float,
    apparatuses: int,
    configurations: Sequence[str],
    as_json: bool,
) -> None:
    """Measure latency, load and errors of graph configurations, and draw a chart of the results.

    If the output folder contains an earlier measurement, continue that measurement. blocks: number
    of repetitions. seconds: duration of each stroke. apparatuses: number of samples of inaccurate
    hardware.
    """
    import json

    from flexsheet.launch.methods.results import describe_load, replace_non_finite
    from flexsheet.launch.methods.system_chart import run_system_chart
    from flexsheet.launch.methods.system_picture import draw_system_chart
    from flexsheet.messages.files import write_file

    files = list(scene_files) or sorted(SCENES.glob("*.yaml"))
    if busy := describe_load():
        words.print(busy, style="yellow")
    with progress_words() as progress:
        result = run_system_chart(
            files,
            output,
            progress,
            blocks=blocks,
            seconds=seconds,
            apparatuses=apparatuses,
            configurations=configurations,
        )
    image = output / "system.svg"
    draw_system_chart(result, image)
    result = replace_non_finite({**result, "picture": str(image)})
    write_file(output / "system.json", json.dumps(result, indent=1) + "\n")
    if as_json:
        print_json(result)
        return
    _print_points(result)
    for one in result["failed"]:
        words.print(f"{one['scene']}: {one['trial']} failed: {one['error']}")
    words.print(f"chart: {image}")


def _print_points(result: dict[str, Any]) -> None:
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
            *(_error(point, key) for key in ERRORS),
            "front" if (point["scene"], point["configuration"]) in front else "",
            "" if point["meets_tolerances"] else "fails: " + ", ".join(point["failing"]),
        )
        for point in result["points"]
    ]
    print_table((*columns, "", ""), rows)


def _latency(found: dict[str, float] | None) -> str:
    return "-" if found is None else f"{found['p50']:.1f} / {found['p99']:.1f}"


def _error(point: dict[str, Any], key: str) -> str:
    spread = point["spread"].get(f"{key}.p95")
    if spread is None:
        return "-"
    if spread["low"] is None:
        return f"{spread['value']:.3g}"
    return f"{spread['value']:.3g} ({spread['low']:.3g}-{spread['high']:.3g})"
