"""Draw the figures of the demo and of the experiments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flexsheet.launch.experiments.image import EyeImage
from flexsheet.launch.experiments.stroke import PAPER_TABLE_1, StrokeErrors, StrokeRecording

EVENTS = (
    "fingertip",
    "sheet target",
    "soft body",
    "left arm command",
    "right arm command",
    "frame begun",
    "frame drawn",
)

BLACK = 8
SHOWN = (0.18, 0.82)
"""Part of the eye's image that is drawn; around it is only dark sheet."""

CORRECTION_NAMES = {
    "none": "not corrected",
    "one_plane": "corrected for one plane",
    "four_triangles": "corrected for 4 triangles",
    "two_pass": "projected onto the sheet's shape",
}


def draw_eye_views(rows: Sequence[tuple[str, Sequence[EyeImage]]], path: Path) -> None:
    """Draw one row per case: each image as the eye sees it, and last the expected image."""
    columns = max(len(pictures) for _, pictures in rows) + 1
    figure = Figure(figsize=(3.2 * columns, 3.4 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for row, (title, pictures) in zip(axes, rows, strict=True):
        shown: list[tuple[str, np.ndarray, EyeImage]] = [
            (CORRECTION_NAMES[picture.correction], picture.seen, picture) for picture in pictures
        ]
        shown.append(("expected", pictures[0].expected, pictures[0]))
        for axis in row:
            axis.set_axis_off()
        for axis, (name, pixels, picture) in zip(row, shown, strict=False):
            axis.imshow(pixels)
            outline = outline_box(picture.expected)
            if outline is not None:
                left, top, width, height = outline
                axis.add_patch(
                    Rectangle((left, top), width, height, fill=False, color="C1", linewidth=0.8)
                )
            axis.set_title(f"{title}\n{name}", fontsize=9)
            rows_px, columns_px, _ = pixels.shape
            axis.set_xlim(SHOWN[0] * columns_px, SHOWN[1] * columns_px)
            axis.set_ylim(SHOWN[1] * rows_px, SHOWN[0] * rows_px)
    figure.suptitle("What the user's eye sees (orange: the box around the expected image)")
    figure.savefig(path, dpi=110)


def outline_box(picture: np.ndarray) -> tuple[float, float, float, float] | None:
    """Return left, top, width and height of the non-black part; None if all is black."""
    ys, xs = np.nonzero(picture.max(axis=2) > BLACK)
    if len(xs) == 0:
        return None
    return (
        float(xs.min()),
        float(ys.min()),
        float(np.ptp(xs)),
        float(np.ptp(ys)),
    )


def draw_stroke(errors: dict[float, StrokeErrors], path: Path) -> None:
    """Draw position and angle error over time, one column per stroke, the paper's mean dashed."""
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
        lower.set_xlabel("time since the stroke began, s")
        upper.legend(fontsize=8)
        for axis in (upper, lower):
            axis.set_ylim(bottom=0)
            axis.grid(visible=True, alpha=0.2)
    figure.suptitle("Error of the sheet during strokes")
    figure.savefig(path, dpi=110)


def draw_latency(recording: StrokeRecording, path: Path) -> None:
    """Draw the latency from exposure to each event: median and 1-99 %."""
    events = [event for event in EVENTS if len(recording.delays_s.get(event, ()))]
    figure = Figure(figsize=(8, 0.7 * len(events) + 1.6), layout="constrained")
    axes = figure.subplots()
    for row, event in enumerate(events):
        delays_ms = recording.delays_s[event] * 1e3
        low, median, high = np.quantile(delays_ms, [0.01, 0.5, 0.99])
        axes.barh(row, high - low, left=low, height=0.5, color="C0", alpha=0.4)
        axes.plot([median, median], [row - 0.3, row + 0.3], color="C0", linewidth=2)
        axes.text(high, row, f"  {median:.1f} / {high:.1f} ms", va="center", fontsize=8)
    axes.set_yticks(range(len(events)), events)
    axes.invert_yaxis()
    longest_ms = max(np.quantile(recording.delays_s[event], 0.99) for event in events) * 1e3
    axes.set_xlim(0, 1.25 * longest_ms)
    axes.set_xlabel("ms since the middle of the exposure: 1-99 % (bar), median (line)")
    axes.set_title("Latency")
    axes.grid(visible=True, axis="x", alpha=0.2)
    figure.savefig(path, dpi=110)


def draw_compliance(result: dict[str, Any], path: Path) -> None:
    """Draw force over depth, desired and presented, one panel per position, with people's JND."""
    places = list(dict.fromkeys(row["place"] for row in result["rows"]))
    figure = Figure(figsize=(4.2 * len(places), 4.4), layout="constrained")
    panels = figure.subplots(1, len(places), squeeze=False, sharey=True)[0]
    sure, surer = (0.01 * percent for percent in result["noticed_percent"])
    moving = result["moving"]["rows"]
    for panel, place in zip(panels, places, strict=True):
        rows = [row for row in result["rows"] if row["place"] == place]
        depths = np.array([0.0, *(row["depth_mm"] for row in rows)])
        wanted = np.array([0.0, *(row["wanted_n"] for row in rows)])
        for ratio, strength in ((surer, 0.12), (sure, 0.18)):
            panel.fill_between(
                depths,
                (1.0 - ratio) * wanted,
                (1.0 + ratio) * wanted,
                color="C0",
                alpha=strength,
                linewidth=0,
                label=f"within {100 * ratio:.0f} %: below the JND",
            )
        panel.plot(depths, wanted, color="C0", label="the object")
        if place == places[0]:
            panel.plot(
                [row["depth_mm"] for row in moving],
                [row["presented_n"] for row in moving],
                ".",
                color="0.5",
                markersize=3,
                label=f"presented at {result['moving']['speed_mm_per_s']:.0f} mm/s, in and out",
            )
        presented = [row["presented_n"] for row in rows]
        panel.plot(depths[1:], presented, "o", color="C1", label="presented, at rest")
        panel.set_title(place)
        panel.set_xlabel("depth of the finger, mm")
        panel.grid(visible=True, alpha=0.2)
    panels[0].set_ylabel("force, N")
    panels[0].legend(fontsize=8)
    figure.suptitle("Presented force of the object, by the simulated sheet")
    figure.savefig(path, dpi=110)
