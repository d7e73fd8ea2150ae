"""Measure the speed and accuracy of all methods of a method family for a scene, and draw charts.

A method family contains interchangeable methods for one task. The results are valid only for the
computer on which they were measured.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from importlib import import_module
from itertools import cycle
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from flexsheet.launch.methods.results import machine_name, replace_non_finite
from flexsheet.launch.methods.svg import COLOURS, INK, page_style, save_svg
from flexsheet.launch.plans.documents import did_you_mean
from flexsheet.launch.running.commit import read_commit
from flexsheet.launch.running.precompute import report_time_left
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.nodes.methods import Family, Point, Trial, measure, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAMILIES: dict[str, str] = {
    "correction": "flexsheet.launch.methods.benchmarks:CORRECTION",
    "sheet-shape": "flexsheet.launch.methods.benchmarks:SHEET_SHAPE",
    "soft-body": "flexsheet.nodes.fem_solver.benchmarks:SOFT_BODY",
}
"""The location `module:NAME` of each method family, by the family's name on the command line."""

REPEATS = 30
PROGRESS_PERIOD_S = 1.0
TITLE_WIDTH = 95


class UnknownFamilyError(FlexsheetError, KeyError):
    """Raised if the user names a method family that does not exist."""

    exit_code = 2


def find_family(name: str) -> Family:
    """Return the method family with the given name.

    Raises UnknownFamilyError if the family does not exist.
    """
    if name not in FAMILIES:
        hint = did_you_mean(name, list(FAMILIES))
        raise UnknownFamilyError(f'unknown method family "{name}"; {hint}')
    module_name, _, attribute = FAMILIES[name].partition(":")
    family: Family = getattr(import_module(module_name), attribute)
    return family


def measure_family(
    family: Family,
    scene: Scene,
    *,
    repeats: int = REPEATS,
    progress: Callable[[str], None] = lambda text: None,
    select: Callable[[Trial], bool] = lambda trial: True,
) -> list[Point]:
    """Measure the methods of a method family in a scene, and report the progress.

    A trial measures one method in one case. The family generates the next trial only after a trial
    is finished, so that data of finished trials can be released.

    select: function that returns whether to measure a given trial.
    """
    on_progress = report_time_left(f"{family.name}: computing what the methods need", progress)
    family.prepare(scene, on_progress)
    points: list[Point] = []
    last_s = -math.inf
    for trial in filter(select, family.trials(scene)):
        if time.monotonic() - last_s >= PROGRESS_PERIOD_S:
            last_s = time.monotonic()
            progress(f"{family.name}: measuring {trial.method}, {len(points)} done")
        points.append(measure(trial, repeats=repeats))
    return points


def make_chart_result(family: Family, scene: Scene, points: Sequence[Point]) -> dict[str, Any]:
    """Return the measurements of a method family in the format of `flexsheet chart --json`."""
    return {
        "family": family.name,
        "unit": family.unit,
        "reference": family.reference,
        "scene": scene.name,
        "tolerance": family.tolerance(scene),
        "sweep_key": family.sweep_key,
        "machine": machine_name(),
        "load": os.getloadavg()[0],
        "code": {"commit": read_commit()},
        "points": [asdict(point) for point in points],
        "front": pareto_front(points),
    }


def draw_chart(result: dict[str, Any], path: Path) -> None:
    """Draw error against time on logarithmic axes.

    If the family has a `sweep_key`, which is a property that varies between its cases, a second
    diagram shows the error against this property.
    """
    from matplotlib.figure import Figure

    with page_style():
        if result["sweep_key"] is None:
            figure = Figure(figsize=(8, 5.5), layout="constrained")
            _draw_time(figure.subplots(), result)
        else:
            figure = Figure(figsize=(14, 5.5), layout="constrained")
            left, right = figure.subplots(1, 2)
            _draw_time(left, result)
            _draw_sweep(right, result)
        save_svg(figure, path)


def _draw_time(axes: Axes, result: dict[str, Any]) -> None:
    """Draw error against time, with the tolerance as a dashed line.

    Horizontal bars extend to the 99 % quantile of the time. Errors below 1e-4 of the tolerance are
    rounding errors, and are drawn at 1e-4 of the tolerance. Crosses are out of range.
    """
    min_error = 1e-4 * result["tolerance"]
    for colour, method in zip(cycle(COLOURS), _list_methods(result)):
        for in_range, marker in ((True, "o"), (False, "x")):
            shown = [
                point
                for point in result["points"]
                if point["method"] == method
                and point["in_range"] == in_range
                and _has_reference(point)
            ]
            if not shown:
                continue
            front = ", on the front" if method in result["front"] else ""
            late_us = [1e6 * max(0.0, point["p99_s"] - point["median_s"]) for point in shown]
            axes.errorbar(
                [1e6 * point["median_s"] for point in shown],
                [max(point["error"], min_error) for point in shown],
                xerr=[[0.0] * len(shown), late_us],
                fmt=marker,
                elinewidth=0.6,
                color=colour,
                alpha=0.7,
                label=f"{method}{front if in_range else ' (out of range)'}",
            )
    axes.axhline(result["tolerance"], linestyle="--", color=INK, label="tolerance of the scene")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time per call, µs (median)")
    axes.set_ylabel(f"error, {result['unit']}")
    title = f"{result['family']} — scene {result['scene']}, against {result['reference']}"
    axes.set_title("\n".join(wrap(title, TITLE_WIDTH)), fontsize=10)
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(fontsize=8)


def _draw_sweep(axes: Axes, result: dict[str, Any]) -> None:
    """Draw the error against the property that varies between the cases, with a line per method."""
    key = result["sweep_key"]
    for colour, method in zip(cycle(COLOURS), _list_methods(result)):
        shown = sorted(
            (point["case"][key], point["error"])
            for point in result["points"]
            if point["method"] == method and _has_reference(point)
        )
        if shown:
            axes.plot(
                *zip(*shown, strict=True), marker="o", markersize=4, color=colour, label=method
            )
    axes.axhline(result["tolerance"], linestyle="--", color=INK, linewidth=0.8)
    axes.set_yscale("log")
    axes.set_ylabel(f"error, {result['unit']}")
    axes.set_xlabel(key.replace("_", " "))
    axes.grid(visible=True, alpha=0.2)
    axes.legend(fontsize=8)


def _list_methods(result: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(point["method"] for point in result["points"]))


def _has_reference(point: dict[str, Any]) -> bool:
    return point["error"] is not None and math.isfinite(point["error"])


def write_chart(result: dict[str, Any], folder: Path) -> tuple[Path, Path]:
    """Write the figure and the results of a chart to a folder, and return both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    image, numbers = folder / f"{result['family']}.svg", folder / f"{result['family']}.json"
    draw_chart(result, image)
    write_file(numbers, json.dumps(replace_non_finite(result), indent=1) + "\n")
    return image, numbers


def read_charts(folder: Path) -> list[dict[str, Any]]:
    """Read all chart results in a folder.

    The results of method families are in the order of `FAMILIES`. The results of other benchmarks
    follow.
    """
    order = list(FAMILIES)
    paths = sorted(
        folder.glob("*.json"),
        key=lambda path: (order.index(path.stem) if path.stem in order else len(order), path.stem),
    )
    results = (json.loads(path.read_text()) for path in paths)
    return [result for result in results if "points" in result]


def render_overview(folder: Path, link_prefix: str = "") -> str:
    """Return Markdown text with one section for each chart in the folder.

    link_prefix: path from the page to the folder, with a slash at its end.
    """
    return "\n".join(_overview_lines(folder, link_prefix)) + "\n"


def _overview_lines(folder: Path, link_prefix: str) -> Iterator[str]:
    for result in read_charts(folder):
        name, unit = result["family"], result["unit"]
        commit = (result.get("code") or {}).get("commit") or "unknown"
        yield f"## {name}\n"
        yield (
            f"Against {result['reference']}; scene {result['scene']}, tolerance "
            f"{result['tolerance']:.3g} {unit}. {result['machine']}; code {commit[:10]}. "
            f"[Numbers]({link_prefix}{name}.json).\n"
        )
        yield f"![{name}: time against error of each method]({link_prefix}{name}.svg)\n"
        yield (
            f"| method | time, median | 99 % | largest error in range, {unit} | outside "
            "| cases in range | front |"
        )
        yield "|---|---|---|---|---|---|---|"
        yield from map(_overview_row, summarize_methods(result))
        yield ""


def summarize_methods(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per method, with the largest time and error over the measured cases.

    The time of a case is given as median and 99 % quantile. Each row also contains the number of
    cases inside the range in which the method is valid. Errors outside this range are listed
    separately.
    """
    rows = []
    for method in _list_methods(result):
        own = [point for point in result["points"] if point["method"] == method]
        inside = [point for point in own if point["in_range"] and _has_reference(point)]
        rows.append(
            {
                "method": method,
                "median_s": max(point["median_s"] for point in inside or own),
                "p99_s": max(point["p99_s"] for point in inside or own),
                "error": max((point["error"] for point in inside), default=None),
                "error_outside": max(
                    (
                        point["error"]
                        for point in own
                        if not point["in_range"] and _has_reference(point)
                    ),
                    default=None,
                ),
                "cases": len(own),
                "inside": len(inside),
                "front": method in result["front"],
            }
        )
    return rows


def _overview_row(row: dict[str, Any]) -> str:
    inside, outside = (
        "–" if row[key] is None else f"{row[key]:.3g}" for key in ("error", "error_outside")
    )
    cases = f"{row['inside']} of {row['cases']}"
    front = "yes" if row["front"] else ""
    times = f"{format_duration(row['median_s'])} | {format_duration(row['p99_s'])}"
    return f"| {row['method']} | {times} | {inside} | {outside} | {cases} | {front} |"


def format_duration(seconds: float) -> str:
    """Format a duration with a suitable unit, for example as 12 µs, 3.4 ms or 1.2 s."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"
