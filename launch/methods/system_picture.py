"""Draw the chart of `flexsheet chart system`: error against latency, and all errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexsheet.launch.methods.svg import COLOURS, INK, page_style, save_svg
from flexsheet.launch.methods.system_chart import ERRORS, worst_ratio

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {
    "sheet_mm": "sheet",
    "image_mm": "image",
    "force_percent": "force",
    "fingertip_mm": "fingertip",
}
ROW_HEIGHT = 4.2


def draw_system_chart(result: Mapping[str, Any], path: Path) -> None:
    """Draw one row of two diagrams per scene, and save the figure as SVG.

    The left diagram shows the worst error against the latency. A circle represents a configuration
    that meets all tolerances, and a cross one that exceeds a tolerance. The markers of
    configurations on the Pareto front are filled. The right diagram shows all errors.
    """
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(point["scene"] for point in result["points"]))
    front = {(one["scene"], one["configuration"]) for one in result["front"]}
    with page_style():
        figure = Figure(figsize=(13, ROW_HEIGHT * len(scenes) + 0.6), layout="constrained")
        rows = figure.subplots(len(scenes), 2, squeeze=False)
        for (left, right), scene in zip(rows, scenes, strict=True):
            points = [one for one in result["points"] if one["scene"] == scene]
            _draw_front(left, points, {name for of, name in front if of == scene})
            left.set_title(scene, fontsize=10)
            _draw_errors(right, points)
        save_svg(figure, path)


def _draw_front(axes: Axes, points: Sequence[Mapping[str, Any]], front: set[str]) -> None:
    """Draw the worst ratio of error to tolerance against the latency of each configuration.

    The latency is the time from a camera exposure to the arm command. A bar extends to its 99 %
    quantile.

    front: names of the configurations on the Pareto front.
    """
    for colour, point in zip(COLOURS, points, strict=False):
        name, latency = point["configuration"], point["exposure_to_arm_ms"]
        at = latency["p50"], worst_ratio(point).value
        axes.errorbar(
            *at,
            xerr=[[0.0], [latency["p99"] - latency["p50"]]],
            color=colour,
            marker="o" if point["meets_tolerances"] else "X",
            markersize=9,
            markerfacecolor=colour if name in front else "none",
            label=name,
        )
    axes.axhline(1.0, color=INK, linestyle="--", linewidth=1, label="tolerance")
    axes.set_yscale("log")
    axes.set_xlim(left=0.0)
    axes.set_xlabel("exposure to arm command, ms (point: median, bar: to 99 %)")
    axes.set_ylabel("worst error / its tolerance")
    axes.grid(visible=True, which="both", alpha=0.15)
    axes.legend(fontsize=7)


def _draw_errors(axes: Axes, points: Sequence[Mapping[str, Any]]) -> None:
    """Draw a bar for each error as a ratio to its tolerance, with its largest random value."""
    width = 0.8 / max(len(points), 1)
    for number, (colour, point) in enumerate(zip(COLOURS, points, strict=False)):
        for column, key in enumerate(ERRORS):
            ratio = point["tolerance_ratios"].get(f"{key}.p95")
            if ratio is None:
                continue
            at = column + (number - 0.5 * (len(points) - 1)) * width
            axes.bar(at, ratio["value"], 0.9 * width, color=colour, alpha=0.8)
            random = point["random_apparatuses"].get(key)
            if random is not None and point[key]:
                axes.plot(at, random["max"] * ratio["value"] / point[key], "_", color=INK)
    axes.axhline(1.0, color=INK, linestyle="--", linewidth=1)
    axes.set_xticks(range(len(ERRORS)), [NAMES[key] for key in ERRORS])
    axes.set_ylabel("95 % error / tolerance")
    axes.set_title("dash: maximum over random apparatuses", fontsize=9)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, axis="y", alpha=0.2)
