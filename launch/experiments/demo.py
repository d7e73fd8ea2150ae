"""`flexsheet demo`: the whole system once on one machine, with a table and pictures at the end."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from launch.experiments import image, stroke
from launch.experiments.pictures import draw_eye_views, draw_latency, draw_stroke
from launch.experiments.run import (
    Progress,
    in_turn,
    push_procedure,
    run_experiment,
    stroke_procedure,
    tilt_procedure,
)
from messages.types import Correction, FingerPath

SECONDS = (10.0, 30.0)
TILT_DEG = -40
TILT_CORRECTIONS: tuple[Correction, ...] = ("none", "one_plane")
DEPTH_MM = 30
PUSH_CORRECTIONS: tuple[Correction, ...] = ("none", "four_triangles")


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo leaves: its folder and bag, the strokes' figures, the pictures."""

    folder: Path
    bag: Path
    strokes: list[dict[str, Any]]
    pictures: list[Path]


def run_demo(
    launch_file: Path, folder: Path, progress: Progress, *, path: FingerPath | None = None
) -> DemoResult:
    """Stroke in 10 s and in 30 s (or follow `path`), then picture a tilted and a pushed sheet."""
    bag = folder / "demo.mcap"
    procedure = in_turn(
        stroke_procedure(SECONDS, progress, path=path),
        tilt_procedure([TILT_DEG], TILT_CORRECTIONS, progress),
        push_procedure([DEPTH_MM], PUSH_CORRECTIONS, progress),
    )
    run_experiment(launch_file, [], bag, procedure, progress)
    progress("reading the bag and drawing")
    return summarize(bag, folder, strokes=() if path is not None else SECONDS)


def summarize(bag: Path, folder: Path, *, strokes: tuple[float, ...]) -> DemoResult:
    """Compute the demo's figures from its bag and draw its pictures into `folder`."""
    recording = stroke.read_recording(bag)
    photographs = image.read_pictures(bag)
    views, plot, latency = (
        folder / "eye.png",
        folder / "stroke.png",
        folder / "latency.png",
    )
    tilted = [photographs[image.tilt_label(TILT_DEG, name)] for name in TILT_CORRECTIONS]
    pushed = [photographs[image.push_label(DEPTH_MM, name)] for name in PUSH_CORRECTIONS]
    draw_eye_views(
        [(f"sheet tilted {TILT_DEG}°", tilted), (f"sheet pushed {DEPTH_MM} mm", pushed)], views
    )
    draw_latency(recording, latency)
    pictures = [views, latency]
    if strokes:
        draw_stroke({one: stroke.stroke_errors(recording, one) for one in strokes}, plot)
        pictures.append(plot)
    results = [stroke.stroke_result(recording, one, bag) for one in strokes]
    (folder / "stroke.json").write_text(json.dumps(results, indent=1) + "\n")
    return DemoResult(folder=folder, bag=bag, strokes=results, pictures=pictures)


def table_1(strokes: list[dict[str, Any]]) -> Table:
    """Table I of the paper beside ours."""
    table = Table(title="Table I: errors while stroking (mean ± standard deviation)")
    table.add_column("moving time")
    for name in ("Δd paper, mm", "Δd ours, mm", "true Δd, mm"):
        table.add_column(name, justify="right")
    for name in ("Δθ paper, °", "Δθ ours, °", "true Δθ, °"):
        table.add_column(name, justify="right")
    for result in strokes:
        paper = stroke.PAPER_TABLE_1.get(result["seconds"], {})
        cells = [f"{result['seconds']:g} s"]
        for key in ("delta_d_mm", "delta_theta_deg"):
            mean_std = paper.get(key)
            cells.append("-" if mean_std is None else f"{mean_std[0]:.3f} ± {mean_std[1]:.3f}")
            cells.extend(
                f"{result[name]['mean']:.3f} ± {result[name]['std']:.3f}"
                for name in (key, f"true_{key}")
            )
        table.add_row(*cells)
    return table
