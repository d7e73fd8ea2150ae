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
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from flexsheet.launch.methods.results import machine_name, replace_non_finite
from flexsheet.launch.methods.svg import COLOURS, INK, page_style, save_svg
from flexsheet.launch.plans.documents import did_you_mean
from flexsheet.launch.running.commit import read_commit
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.nodes.cache import EtaEstimator
from flexsheet.nodes.methods import Family, Point, Trial, measure, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAMILIES: dict[str, str] = {
    "marker": "flexsheet.nodes.triangulator.benchmarks:MARKER",
    "tracking": "flexsheet.launch.methods.benchmarks:TRACKING",
    "soft-body": "flexsheet.nodes.fem_solver.benchmarks:SOFT_BODY",
    "correction": "flexsheet.launch.methods.benchmarks:CORRECTION",
    "sheet-force": "flexsheet.launch.methods.benchmarks:SHEET_FORCE",
    "sheet-shape": "flexsheet.launch.methods.benchmarks:SHEET_SHAPE",
}
"""The location `module:NAME` of each method family, by the family's name on the command line."""

REPEATS = 30
PROGRESS_PERIOD_S = 1.0
ROOT = Path(__file__).resolve().parents[2]
OVERVIEW = "README.md"
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
    return load_family(FAMILIES[name])


def load_family(path: str) -> Family:
    """Import the method family at the location `module:NAME`."""
    module_name, _, attribute = path.partition(":")
    family = getattr(import_module(module_name), attribute)
    assert isinstance(family, Family)
    return family


def git_commit() -> str | None:
    """Return the git commit of this code, or None if it is unknown."""
    return read_commit()


def measure_family(
    family: Family,
    scene: Scene,
    *,
    repeats: int = REPEATS,
    progress: Callable[[str], None] = lambda text: None,
    select: Callable[[Trial], bool] = lambda trial: True,
) -> list[Point]:
    """Measure the methods of a method family in a scene, and report the progress.

    A method family contains interchangeable methods for one task. A trial measures one method in
    one case. The family generates the next trial only after a trial is finished, so that data of
    finished trials can be released.

    select: function that returns whether to measure a given trial.
    """
    family.prepare(scene, _make_reporter("computing the reference:", progress))
    points: list[Point] = []
    last_s = -math.inf
    for trial in filter(select, family.trials(scene)):
        if time.monotonic() - last_s >= PROGRESS_PERIOD_S:
            last_s = time.monotonic()
            progress(f"measuring {trial.method}, {len(points)} done")
        points.append(measure(trial, repeats=repeats))
    return points


def _make_reporter(prefix: str, progress: Callable[[str], None]) -> Callable[[int, int], None]:
    """Return a function that reports the progress and the remaining time at regular intervals.

    The arguments of the returned function are the numbers of finished steps and of all steps.
    """
    eta, last_s = EtaEstimator(), -math.inf

    def report(done: int, total: int) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        left = f": {eta.text(done, total, now_s)}" if total else ""
        if now_s - last_s >= PROGRESS_PERIOD_S:
            last_s = now_s
            progress(f"{prefix} {done} of {total}{left}")

    return report


def make_chart_result(family: Family, scene: Scene, points: Sequence[Point]) -> dict[str, Any]:
    """Return the measurements of a method family in the format of `flexsheet chart --json`.

    A method family contains interchangeable methods for one task.
    """
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
    """Draw error against time on logarithmic axes, with a line along the Pareto front of each case.

    The `sweep_key` of a method family is a property that varies between its cases. If the family
    has a `sweep_key`, errors and extra metrics are also drawn against this property. In these
    diagrams, a band shows the uncertainty of the reference.
    """
    from matplotlib.figure import Figure

    metrics = (
        []
        if result["sweep_key"] is None
        else sorted({k for p in result["points"] for k in p["extra_metrics"]})
    )
    panels = 1 if result["sweep_key"] is None else 2 + len(metrics)
    with page_style():
        columns = min(panels, 2)
        rows = math.ceil(panels / columns)
        figure = Figure(figsize=(8, 5.5) if rows == 1 else (14, 5.5 * rows), layout="constrained")
        first, *others = figure.subplots(rows, columns, squeeze=False).flat
        for unused in others[panels - 1 :]:
            unused.remove()
        _draw_time(first, result)
        for axes, name in zip(others, ["error", *metrics], strict=False):
            _draw_sweep(axes, result, name)
        save_svg(figure, path)


def _draw_time(axes: Axes, result: dict[str, Any]) -> None:
    """Draw error against time, with the tolerance as a dashed line.

    Horizontal bars extend to the 99 % quantile of the time. Vertical bars show the confidence
    interval of the error. Errors below 1e-4 of the tolerance are rounding errors, and are drawn at
    1e-4 of the tolerance.
    """
    methods = list(dict.fromkeys(point["method"] for point in result["points"]))
    min_error = 1e-4 * result["tolerance"]
    for index, method in enumerate(methods):
        own = [point for point in result["points"] if point["method"] == method]
        for in_range, marker in ((True, "o"), (False, "x")):
            shown = [
                point for point in own if point["in_range"] == in_range and _has_reference(point)
            ]
            if shown:
                front = "" if method not in result["front"] else ", on the front"
                errors = [max(point["error"], min_error) for point in shown]
                ranges = [point.get("error_range") or (point["error"],) * 2 for point in shown]
                lower, upper = (
                    [
                        max(0.0, sign * (error - max(limits[end], min_error)))
                        for error, limits in zip(errors, ranges, strict=True)
                    ]
                    for end, sign in ((0, 1.0), (1, -1.0))
                )
                axes.errorbar(
                    [point["median_s"] * 1e6 for point in shown],
                    errors,
                    xerr=[
                        [0.0] * len(shown),
                        [1e6 * max(0.0, point["p99_s"] - point["median_s"]) for point in shown],
                    ],
                    yerr=[lower, upper],
                    fmt=marker,
                    elinewidth=0.6,
                    color=COLOURS[index % len(COLOURS)],
                    alpha=0.7,
                    label=f"{method}{front if in_range else ' (out of range)'}",
                )
    for case in unique_cases(result["points"]):
        usable = [
            point
            for point in result["points"]
            if point["in_range"] and point["case"] == case and _has_reference(point)
        ]
        steps = sorted(
            (point["median_s"] * 1e6, max(point["error"], min_error)) for point in usable
        )
        best = [
            step
            for i, step in enumerate(steps)
            if all(step[1] < earlier[1] for earlier in steps[:i])
        ]
        if len(best) > 1:
            axes.step(*zip(*best, strict=True), where="post", color=INK, alpha=0.4, linewidth=0.8)
    axes.axhline(result["tolerance"], linestyle="--", color=INK, label="tolerance of the scene")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time per call, µs (median)")
    axes.set_ylabel(f"error, {result['unit']}")
    title = f"{result['family']} — scene {result['scene']}, against {result['reference']}"
    axes.set_title("\n".join(wrap(title, TITLE_WIDTH)), fontsize=10)
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(fontsize=8)


def _draw_sweep(axes: Axes, result: dict[str, Any], name: str) -> None:
    """Draw a metric against the property that varies between the cases, with one line per method.

    If a case is outside the method's range, its marker is hollow. A grey band shows the uncertainty
    of the reference.

    name: "error" or the name of an extra metric.
    """
    key, points = result["sweep_key"], result["points"]

    def value(point: dict[str, Any]) -> float | None:
        found: float | None = (
            point["error"] if name == "error" else point["extra_metrics"].get(name)
        )
        return found

    uncertainties = sorted(
        {
            p["case"][key]: p["reference_uncertainty"][name]
            for p in points
            if name in p["reference_uncertainty"]
        }.items()
    )
    if uncertainties:
        x_values, limits = zip(*uncertainties, strict=True)
        low = [0.0 if name == "error" else -each for each in limits]
        label = "uncertainty of the reference"
        axes.fill_between(x_values, low, limits, color=INK, alpha=0.12, linewidth=0, label=label)
    methods = list(dict.fromkeys(point["method"] for point in points))
    for index, method in enumerate(methods):
        shown = [
            (point["case"][key], value(point), point["in_range"])
            for point in points
            if point["method"] == method and _is_finite(value(point))
        ]
        if not shown:
            continue
        x_values, values, in_range = zip(*sorted(shown), strict=True)
        color = COLOURS[index % len(COLOURS)]
        axes.plot(x_values, values, "-", color=color, alpha=0.6, label=method)
        for x, y, inside in zip(x_values, values, in_range, strict=True):
            axes.plot(x, y, "o", color=color, markerfacecolor=color if inside else "none")
    if name == "error":
        axes.axhline(result["tolerance"], linestyle="--", color=INK)
        axes.set_yscale("symlog", linthresh=result["tolerance"])
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel(f"error, {result['unit']}")
    else:
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.set_ylabel(name.replace("_", " "))
    axes.set_xlabel(f"{key.replace('_', ' ')} (hollow: out of range)")
    axes.grid(visible=True, alpha=0.2)
    axes.legend(fontsize=8)


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _has_reference(point: dict[str, Any]) -> bool:
    return _is_finite(point["error"])


def unique_cases(points: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the different cases of measured points, in the order in which they first occur."""
    cases: list[dict[str, Any]] = []
    for point in points:
        if point["case"] not in cases:
            cases.append(point["case"])
    return cases


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
    return [_add_missing_keys(result) for result in results if "points" in result]


def _add_missing_keys(result: dict[str, Any]) -> dict[str, Any]:
    points = [
        {
            "extra_metrics": {},
            "reference_uncertainty": {},
            "median_range_s": None,
            "error_range": None,
            **point,
        }
        for point in result["points"]
    ]
    return {"sweep_key": None, "code": None, **result, "points": points}


def write_overview(folder: Path) -> Path:
    """Write an overview page of all charts in the folder, and return its path."""
    path = folder / OVERVIEW
    write_file(path, f"# Speed against accuracy\n\n{render_overview(folder)}")
    return path


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
        yield from map(_overview_row, summarize_methods(result["points"]))
        yield ""


def summarize_methods(points: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per method, with the largest time and error over the measured cases.

    The time of a case is given as median and 99 % quantile. Each row also contains the number of
    cases inside the range in which the method is valid. Errors outside this range are listed
    separately.
    """
    rows = []
    front = pareto_front([Point(**point) for point in points if _has_reference(point)])
    for method in dict.fromkeys(point["method"] for point in points):
        own = [point for point in points if point["method"] == method]
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
                "front": method in front,
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
