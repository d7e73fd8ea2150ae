"""Draw the figures of the demo and of the experiments into image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flexsheet.launch.experiments.image import EyeImage
from flexsheet.launch.experiments.stroke import (
    PAPER_TABLE_1,
    LatencyEvent,
    StrokeErrors,
    StrokeRecording,
)

EVENTS = tuple(event for event in LatencyEvent if event is not LatencyEvent.LIGHT)

MAX_BLACK = 8
DRAWN_RANGE = (0.18, 0.82)
"""The drawn part of the eye's image, as fractions of its size; the remainder is dark."""

CORRECTION_NAMES = {
    "none": "not corrected",
    "one_plane": "corrected for one plane",
    "four_triangles": "corrected for 4 triangles",
    "two_pass": "corrected for the sheet's shape",
}


def draw_eye_views(rows: Sequence[tuple[str, Sequence[EyeImage]]], path: Path) -> None:
    """Draw the eye's image for each image correction, and the expected image.

    Each row of the figure shows one simulated case.
    """
    columns = max(len(images) for _, images in rows) + 1
    figure = Figure(figsize=(3.2 * columns, 3.4 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for row, (title, images) in zip(axes, rows, strict=True):
        panels: list[tuple[str, np.ndarray, EyeImage]] = [
            (CORRECTION_NAMES[image.correction], image.seen, image) for image in images
        ]
        panels.append(("expected", images[0].expected, images[0]))
        for axis in row:
            axis.set_axis_off()
        for axis, (name, pixels, image) in zip(row, panels, strict=False):
            axis.imshow(pixels)
            outline = compute_outline(image.expected)
            if outline is not None:
                left, top, width, height = outline
                axis.add_patch(
                    Rectangle((left, top), width, height, fill=False, color="C1", linewidth=0.8)
                )
            axis.set_title(f"{title}\n{name}", fontsize=9)
            rows_px, columns_px, _ = pixels.shape
            axis.set_xlim(DRAWN_RANGE[0] * columns_px, DRAWN_RANGE[1] * columns_px)
            axis.set_ylim(DRAWN_RANGE[1] * rows_px, DRAWN_RANGE[0] * rows_px)
    figure.suptitle("Images at the user's eye (orange: bounding box of the expected image)")
    figure.savefig(path, dpi=110)


def compute_outline(image: np.ndarray) -> tuple[float, float, float, float] | None:
    """Return the bounding box (left, top, width, height) of all non-black pixels.

    Return None if all pixels are black.
    """
    ys, xs = np.nonzero(image.max(axis=2) > MAX_BLACK)
    if len(xs) == 0:
        return None
    return float(xs.min()), float(ys.min()), float(np.ptp(xs)), float(np.ptp(ys))


def draw_stroke(errors: dict[float, StrokeErrors], path: Path) -> None:
    """Draw position and angle errors against time, with one column per stroke of the finger.

    The mean error of the same stroke in Furukawa et al. 2007 is included.
    """
    figure = Figure(figsize=(5.5 * len(errors), 6), layout="constrained")
    axes = figure.subplots(2, len(errors), squeeze=False)
    for column, (seconds, stroke) in enumerate(errors.items()):
        upper, lower = axes[0][column], axes[1][column]
        upper.plot(
            stroke.seconds, stroke.delta_d_m * 1e3, linewidth=0.8, label="to the measured finger"
        )
        upper.plot(
            stroke.true_seconds,
            stroke.true_delta_d_m * 1e3,
            linewidth=0.8,
            label="to the true finger",
        )
        lower.plot(stroke.seconds, np.degrees(stroke.delta_theta_rad), linewidth=0.8)
        lower.plot(stroke.true_seconds, np.degrees(stroke.true_delta_theta_rad), linewidth=0.8)
        paper = PAPER_TABLE_1.get(seconds)
        if paper is not None:
            upper.axhline(paper["delta_d_mm"][0], linestyle="--", color="0.3", label="paper, mean")
            lower.axhline(paper["delta_theta_deg"][0], linestyle="--", color="0.3")
        upper.set_title(f"60° in {seconds:g} s")
        upper.set_ylabel("position error Δd, mm")
        lower.set_ylabel("angle error Δθ, degrees")
        lower.set_xlabel("time since the start of the stroke, s")
        upper.legend(fontsize=8)
        for axis in (upper, lower):
            axis.set_ylim(bottom=0)
            axis.grid(visible=True, alpha=0.2)
    figure.suptitle("Error of the sheet during strokes")
    figure.savefig(path, dpi=110)


def draw_latency(recording: StrokeRecording, path: Path) -> None:
    """Draw the median and the 1 % and 99 % quantiles of the latency from exposure to each event."""
    events = [event for event in EVENTS if len(recording.delays_s.get(event, ()))]
    figure = Figure(figsize=(8, 0.7 * len(events) + 1.6), layout="constrained")
    axes = figure.subplots()
    for row, event in enumerate(events):
        delays_ms = recording.delays_s[event] * 1e3
        low, median, high = np.quantile(delays_ms, [0.01, 0.5, 0.99])
        bar = axes.barh(row, high - low, left=low, height=0.5, color="C0", alpha=0.4)
        (line,) = axes.plot([median, median], [row - 0.3, row + 0.3], color="C0", linewidth=2)
        axes.text(
            high, row, f"  median {median:.1f} ms, 99 %: {high:.1f} ms", va="center", fontsize=8
        )
    axes.set_yticks(range(len(events)), events)
    axes.invert_yaxis()
    longest_ms = max(np.quantile(recording.delays_s[event], 0.99) for event in events) * 1e3
    axes.set_xlim(0, 1.45 * longest_ms)
    axes.set_xlabel("time since the centre of the exposure, ms")
    axes.set_title("Latency: time from a camera image to the events that it causes")
    figure.legend(
        [line, bar[0]],
        ["median", "1 % to 99 % of the images"],
        loc="outside lower center",
        ncols=2,
        fontsize=8,
    )
    axes.grid(visible=True, axis="x", alpha=0.2)
    figure.savefig(path, dpi=110)


def draw_compliance(result: dict[str, Any], path: Path) -> None:
    """Draw the force of the object and the felt force against depth, with one panel per position.

    Bands show the just-noticeable difference (JND) of forces.
    """
    positions = list(dict.fromkeys(row["at"] for row in result["rows"]))
    figure = Figure(figsize=(4.2 * len(positions), 4.4), layout="constrained")
    panels = figure.subplots(1, len(positions), squeeze=False, sharey=True)[0]
    jnd, bare_jnd = (0.01 * percent for percent in result["noticed_percent"])
    moving = result["moving"]["rows"]
    for panel, position in zip(panels, positions, strict=True):
        rows = [row for row in result["rows"] if row["at"] == position]
        depths = np.array([0.0, *(row["depth_mm"] for row in rows)])
        forces = np.array([0.0, *(row["wanted_n"] for row in rows)])
        for ratio, alpha in ((bare_jnd, 0.12), (jnd, 0.18)):
            panel.fill_between(
                depths,
                (1.0 - ratio) * forces,
                (1.0 + ratio) * forces,
                color="C0",
                alpha=alpha,
                linewidth=0,
                label=f"within {100 * ratio:.0f} % (JND)",
            )
        panel.plot(depths, forces, color="C0", label="object")
        if position == positions[0]:
            panel.plot(
                [row["depth_mm"] for row in moving],
                [row["felt_n"] for row in moving],
                ".",
                color="0.5",
                markersize=3,
                label=f"felt, moving at {result['moving']['speed_mm_per_s']:.0f} mm/s",
            )
        compared = [row for row in rows if row["reference_n"] is not None]
        panel.plot(
            [row["depth_mm"] for row in compared],
            [row["reference_n"] for row in compared],
            "x",
            color="0.2",
            label="independent reference",
        )
        felt = [row["felt_n"] for row in rows]
        panel.plot(depths[1:], felt, "o", color="C1", label="felt, at rest")
        panel.set_title(position)
        panel.set_xlabel("finger depth, mm")
        panel.grid(visible=True, alpha=0.2)
    panels[0].set_ylabel("force, N")
    panels[0].legend(fontsize=8)
    figure.suptitle("Force of the simulated sheet and of the object")
    figure.savefig(path, dpi=110)


def draw_stability(result: dict[str, Any], path: Path) -> None:
    """Draw in how many simulated cases the control loop of sheet and hand is stable.

    Each panel shows one kind of control loop. Its colours show the fraction of stable cases against
    the stiffness of the object and the delay. The last panel compares simulated and predicted
    stability limits.
    """
    rows = [*result["rows"], *result["without_bounds"]]
    kinds = list(dict.fromkeys((row["kind"], row["jitter_ms"]) for row in rows))
    objects = sorted({row["object_pa"] for row in rows})
    delays = sorted({row["delay_ms"] for row in rows})
    figure = Figure(figsize=(4.0 * len(kinds) + 4.2, 4.0), layout="constrained")
    *panels, compared = figure.subplots(1, len(kinds) + 1)
    for panel, kind in zip(panels, kinds, strict=True):
        grid = [
            [
                np.mean(
                    [
                        row["stable"]
                        for row in rows
                        if ((row["kind"], row["jitter_ms"]), row["object_pa"], row["delay_ms"])
                        == (kind, object_pa, delay_ms)
                    ]
                )
                for object_pa in objects
            ]
            for delay_ms in delays
        ]
        shown = panel.imshow(grid, vmin=0.0, vmax=1.0, cmap="RdYlGn", origin="lower", aspect="auto")
        panel.set_xticks(range(len(objects)), [f"{1e-3 * one:.3g}" for one in objects])
        panel.set_yticks(range(len(delays)), [f"{one:.0f}" for one in delays])
        panel.set_xlabel("Young's modulus of the object, kPa")
        panel.set_title(f"loop: {kind[0]}, jitter {kind[1]:.0f} ms")
    panels[0].set_ylabel("delay, ms")
    figure.colorbar(shown, ax=panels, label="fraction of hands that are stable")
    for towards, colour in ((True, "C3"), (False, "C0")):
        boundary = [row for row in result["boundary"] if row["towards_finger"] == towards]
        compared.loglog(
            [row["simulated_slope"] for row in boundary],
            [row["predicted_slope"] for row in boundary],
            ".",
            color=colour,
            label="advance" if towards else "retreat",
        )
    ends = np.array([0.03, 2.0])
    compared.plot(ends, ends, color="0.5", linewidth=1)
    compared.fill_between(ends, 0.8 * ends, 1.2 * ends, color="0.5", alpha=0.2, label="±20 %")
    compared.set_xlabel("simulated critical slope")
    compared.set_ylabel("predicted critical slope")
    compared.legend(fontsize=8)
    figure.savefig(path, dpi=110)


SHOWN_PARAMETERS = 30
METRIC_COLOURS = {
    "sheet_mm": "C0",
    "image_mm": "C1",
    "force_percent": "C2",
    "fingertip_mm": "C3",
}
MIN_SHOWN_RATIO = 1e-3


def draw_sensitivity(result: dict[str, Any], path: Path) -> None:
    """Draw the effects of the most important parameters relative to the scene's tolerances.

    A dot is the larger of the effects of plus and minus one standard deviation (sigma). The line
    ends at the larger effect of three sigma.
    """
    shown = result["ranking"][:SHOWN_PARAMETERS]
    figure = Figure(figsize=(9, 1.4 + 0.32 * max(len(shown), 3)), layout="constrained")
    axis = figure.subplots()
    step = 0.8 / len(METRIC_COLOURS)
    for number, one in enumerate(shown):
        for line, (metric, colour) in enumerate(METRIC_COLOURS.items()):
            ratios = {
                size: max(
                    (
                        row[metric] / result["tolerances"][metric]
                        for row in result["rows"]
                        if row["parameter"] == one["parameter"]
                        and abs(row["sigma"]) == size
                        and row[metric] is not None
                    ),
                    default=0.0,
                )
                for size in (1.0, 3.0)
            }
            if ratios[3.0] < MIN_SHOWN_RATIO:
                continue
            at = number + (line - 1.5) * step
            axis.plot([max(ratios[1.0], MIN_SHOWN_RATIO), ratios[3.0]], [at, at], color=colour)
            axis.plot([max(ratios[1.0], MIN_SHOWN_RATIO)], [at], "o", color=colour, markersize=3)
    for metric, colour in METRIC_COLOURS.items():
        axis.plot([], [], color=colour, label=metric.rpartition("_")[0])
    axis.axvline(1.0, color="black", linewidth=0.8)
    axis.set_xscale("log")
    axis.set_yticks(range(len(shown)), [one["parameter"] for one in shown], fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("effect / tolerance of the scene: dot 1 σ, end of line 3 σ")
    axis.legend(fontsize=7, loc="lower right")
    figure.savefig(path, dpi=110)
