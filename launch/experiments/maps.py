"""Draw maps of the image error at all visible points, by simulated case and correction method."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from flexsheet.launch.experiments.image import (
    CORRECTIONS,
    EyeImage,
    Series,
    make_error_map,
    summarize_map,
)
from flexsheet.launch.experiments.offline import CrossErrors
from flexsheet.launch.experiments.pictures import CORRECTION_NAMES
from flexsheet.nodes.twin.error_map import ErrorMap

MIN_MM, MAX_MM = 0.01, 10.0
"""The limits of the logarithmic colour scale, in mm."""

CROSS_MAGNIFICATION = 20.0
"""The magnification of the error arrows in `draw_cross_errors`."""


def draw_error_maps(images: dict[str, EyeImage], series: Series, path: Path) -> None:
    """Draw error maps with one row per value of the series and one column per correction method.

    Raises ExperimentError if an image of a simulated case is missing.
    """
    cases = [
        (series.name.format(value), [series.label(value, name) for name in CORRECTIONS])
        for value in series.values
    ]
    maps = [(title, [make_error_map(images, label) for label in labels]) for title, labels in cases]
    figure = Figure(figsize=(2.9 * len(CORRECTIONS) + 0.9, 2.3 * len(maps)), layout="constrained")
    panels = figure.subplots(len(maps), len(CORRECTIONS), squeeze=False)
    shown = None
    for row, (title, errors) in zip(panels, maps, strict=True):
        box = _find_box(errors)
        for panel, correction, error_map in zip(row, CORRECTIONS, errors, strict=True):
            panel.set_xticks([])
            panel.set_yticks([])
            sizes_mm = 1e3 * np.linalg.norm(error_map.errors_m[box], axis=2)
            shown = panel.imshow(sizes_mm, norm=LogNorm(MIN_MM, MAX_MM), cmap="viridis")
            figures = [one for one in summarize_map(error_map).values() if one is not None]
            text = ", ".join(f"{one:.2f}" for one in figures) + " mm" if figures else "not visible"
            panel.set_title(f"{title}\n{CORRECTION_NAMES[correction]}\n{text}", fontsize=8)
    if shown is not None:
        figure.colorbar(shown, ax=panels, shrink=0.6, label="error, mm", extend="both")
    figure.suptitle("Error of the image at each visible point: mean, 95 %, maximum")
    figure.savefig(path, dpi=90)


def _find_box(maps: list[ErrorMap]) -> tuple[slice, slice]:
    valid = np.any([np.isfinite(each.errors_m).all(axis=2) for each in maps], axis=0)
    if not valid.any():
        return slice(None), slice(None)
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def draw_cross_errors(errors: CrossErrors, path: Path) -> None:
    """Draw arrows from touched points to the positions at which each eye sees the drawn crosses.

    The arrows are magnified by CROSS_MAGNIFICATION.
    """
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    places_mm, errors_mm = 1e3 * errors.places_m, 1e3 * errors.errors_m
    axes.plot(*places_mm.T, "+", color="0.3", label="touched point")
    for number, (eye, colour) in enumerate((("left", "tab:blue"), ("right", "tab:orange"))):
        axes.quiver(
            *places_mm.T,
            *errors_mm[:, number].T,
            angles="xy",
            scale_units="xy",
            scale=1.0 / CROSS_MAGNIFICATION,
            width=0.004,
            color=colour,
            label=f"{eye} eye",
        )
    axes.set_aspect("equal")
    axes.margins(0.15)
    axes.set_xlabel("x on the screen, mm")
    axes.set_ylabel("y on the screen, mm")
    axes.legend(fontsize=8)
    found = errors.figures()
    axes.set_title(
        f"Seen crosses minus touched points, x {CROSS_MAGNIFICATION:g}: mean "
        f"{found['mean_mm']:.2f} mm, disparity {found['disparity_mm']:.2f} mm"
    )
    figure.savefig(path, dpi=110)
