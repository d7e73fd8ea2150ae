"""Draw the figures of the demo and of the experiments into image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from flexsheet.launch.experiments.image import EyeImage
from flexsheet.launch.experiments.stroke import PAPER_TABLE_1, StrokeErrors

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
