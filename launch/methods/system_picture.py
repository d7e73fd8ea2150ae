"""Draw the chart of `flexsheet chart system`: error against latency, and the error budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flexsheet.launch.methods.configurations import CONTROL, CONTROL_AGAIN
from flexsheet.launch.methods.svg import COLOURS, INK, page_style, save_svg
from flexsheet.launch.methods.system_chart import ERRORS, worst_ratio
from flexsheet.nodes.methods import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {
    "sheet_mm": "sheet",
    "image_mm": "image",
    "force_percent": "force",
    "fingertip_mm": "fingertip",
}
MIN_RATIO = 0.03
"""The minimum ratio of error to tolerance on the axis of the chart."""

ROW_HEIGHT = 4.2


def draw_system_chart(result: Mapping[str, Any], path: Path) -> None:
    """Draw one row of two diagrams per scene, and save the figure as SVG.

    The left diagram shows the worst error against the latency. The right diagram shows all errors
    of each configuration. A circle represents a configuration that meets all tolerances, and a
    cross represents a configuration that exceeds a tolerance. The markers of configurations on the
    Pareto front are filled. Bars are 95 % confidence intervals.
    """
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(point["scene"] for point in result["points"]))
    front = {(one["scene"], one["configuration"]) for one in result["front"]}
    with page_style():
        figure = Figure(figsize=(13, ROW_HEIGHT * len(scenes) + 0.6), layout="constrained")
        rows = figure.subplots(len(scenes), 2, squeeze=False, width_ratios=(3, 4))
        for (left, right), scene in zip(rows, scenes, strict=True):
            points = [
                one
                for one in result["points"]
                if one["scene"] == scene and one["configuration"] != CONTROL_AGAIN
            ]
            names = {name for of, name in front if of == scene}
            _draw_front(left, scene, points, names)
            _draw_errors(right, points)
        save_svg(figure, path)


def _draw_front(
    axes: Axes, scene: str, points: Sequence[Mapping[str, Any]], front: set[str]
) -> None:
    """Draw a point for each configuration of the system: its worst error against its latency.

    The error is divided by its tolerance. The latency is the time from a camera exposure to the arm
    command.

    points: results of each configuration.
    front: names of the configurations on the Pareto front.
    """
    corners = []
    for colour, point in zip(COLOURS, points, strict=False):
        name, latency = point["configuration"], point["exposure_to_arm_ms"]
        worst = worst_ratio(point)
        x, y = latency["p50"], max(worst.value, MIN_RATIO)
        axes.errorbar(
            x,
            y,
            xerr=[[0.0], [latency["p99"] - x]],
            yerr=_bars(worst, y),
            color=colour,
            marker="o" if point["meets_tolerances"] else "X",
            markersize=9 if name in front else 6,
            markerfacecolor=colour if name in front else "none",
            linewidth=1,
            capsize=2,
        )
        label = name if point["meets_tolerances"] else f"{name}\nexceeds: {_failing(point)}"
        axes.annotate(
            label,
            (x, y),
            # The tuned and the most exact methods can be the same, so that their points coincide.
            (6, -20 if name == CONTROL else 6),
            textcoords="offset points",
            fontsize=7,
            color=colour,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )
        if name in front:
            corners.append((x, y))
    if len(corners) > 1:
        axes.step(*zip(*sorted(corners), strict=True), where="post", color=INK, alpha=0.4)
    axes.axhline(1.0, color=INK, linestyle="--", linewidth=1)
    allowed_ms = _allowed_ms(points)
    if allowed_ms is not None:
        axes.axvline(allowed_ms, color=INK, linestyle="--", linewidth=1)
        axes.axvspan(0.0, allowed_ms, ymax=1.0, color=COLOURS[2], alpha=0.06)
    axes.set_yscale("log")
    axes.set_xlim(left=0.0)
    axes.margins(x=0.25, y=0.2)
    axes.set_xlabel("exposure to arm command, ms (point: median, bar: to 99 %)")
    axes.set_ylabel("worst error / its tolerance")
    axes.set_title(f"{scene}: dashed lines are the tolerances", fontsize=10)
    axes.grid(visible=True, which="both", alpha=0.15)


def _allowed_ms(points: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the tolerance (ms) of the latency from a camera exposure to the arm command.

    The tolerance is computed from the results of the first configuration with a measured latency.
    Return None if there is no such configuration.
    """
    key = "exposure_to_arm_ms.p95"
    for point in points:
        if key in point["spread"] and point["tolerance_ratios"][key]["value"] > 0.0:
            ratio = point["tolerance_ratios"][key]["value"]
            return float(point["spread"][key]["value"] / ratio)
    return None


def _failing(point: Mapping[str, Any]) -> str:
    short = {"exposure_to_arm_ms": "latency", "exposure_to_light_ms": "light", **NAMES}
    return ", ".join(short[key.partition(".")[0]] for key in point["failing"])


def _bars(one: Interval, y: float) -> list[list[float]] | None:
    """Return the lengths of the error bars below and above the value y.

    Return None if the interval is not finite.
    """
    if not np.isfinite([one.low, one.high]).all():
        return None
    return [[max(y - max(one.low, MIN_RATIO), 0.0)], [max(one.high - y, 0.0)]]


def _draw_errors(axes: Axes, points: Sequence[Mapping[str, Any]]) -> None:
    """Draw a bar for each error as a ratio to its tolerance.

    The bar of the sheet's error is stacked by the processing stages that contribute to it. A white
    dot is the median of the error over random apparatuses; a line connects it with their maximum.
    """
    width = 0.8 / max(len(points), 1)
    for number, (colour, point) in enumerate(zip(COLOURS, points, strict=False)):
        for column, key in enumerate(ERRORS):
            ratio = point["tolerance_ratios"].get(f"{key}.p95")
            if ratio is None:
                continue
            at = column + (number - 0.5 * (len(points) - 1)) * width
            height = ratio["value"]
            stages = point["budget"] if key == "sheet_mm" else {"": 1.0}
            parts = np.maximum([*stages.values()], 0.0)
            bottom = 0.0
            for shade, part in enumerate(height * parts / (parts.sum() or 1.0)):
                axes.bar(at, part, 0.9 * width, bottom, color=colour, alpha=0.9 * 0.55**shade)
                bottom += part
            interval = Interval(**ratio)
            bars = _bars(interval, height)
            if bars is not None and interval.high > interval.low:
                axes.errorbar(at, height, yerr=bars, color=INK, linewidth=1, capsize=2)
            random = point["random_apparatuses"].get(key)
            if random is not None and point[key]:
                median, most = (random[name] * height / point[key] for name in ("median", "max"))
                axes.errorbar(
                    at,
                    median,
                    yerr=[[0.0], [most - median]],
                    color=INK,
                    linewidth=0.8,
                    capsize=2,
                    marker="o",
                    markersize=3,
                    markerfacecolor="white",
                )
        axes.bar(0.0, 0.0, color=colour, label=_label(point))
    axes.axhline(1.0, color=INK, linestyle="--", linewidth=1)
    axes.set_xticks(range(len(ERRORS)), [NAMES[key] for key in ERRORS])
    axes.set_ylabel("95 % error / tolerance")
    stages = next((point["budget"] for point in points if point["budget"]), {})
    title = "sheet, from dark to light: " + ", ".join(stages)
    if runs := max((point["random_apparatuses"]["runs"] for point in points), default=0):
        title += f"\ndot and line: median and maximum over random apparatuses (n = {runs})"
    axes.set_title(title, fontsize=9)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=True, axis="y", alpha=0.2)
    axes.legend(fontsize=7)


def _label(point: Mapping[str, Any]) -> str:
    light = point["exposure_to_light_ms"]
    shown = "no image" if light is None else f"light {light['p50']:.0f}/{light['p99']:.0f} ms"
    return f"{point['configuration']}: {point['cpu_cores']:.2f} cores, {shown}"
