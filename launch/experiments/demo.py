"""Run the system on one computer as a demo, and create tables and figures of the errors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexsheet.launch.bags.report.strokes import read_followed
from flexsheet.launch.experiments import find_recorded, image, stroke
from flexsheet.launch.experiments.pictures import draw_eye_views, draw_latency, draw_stroke
from flexsheet.launch.experiments.run import (
    Progress,
    chain_procedures,
    make_image_procedure,
    make_settings,
    make_stroke_procedure,
    run_experiment,
)
from flexsheet.messages.files import write_file
from flexsheet.messages.types import Correction, FingerPath

METRES_PER_PX = 0.0007
"""The image resolution in Furukawa et al. 2007.

It is sufficient for figures, and images take a quarter of the time of the default resolution.
"""

SECONDS = (10.0, 30.0)
TILT_DEG = -40
TILT_CORRECTIONS: tuple[Correction, ...] = ("none", "one_plane", "two_pass")
DEPTH_MM = 30
PUSH_CORRECTIONS: tuple[Correction, ...] = ("none", "four_triangles", "two_pass")


@dataclass(frozen=True, slots=True)
class DemoResult:
    """The results of the demo.

    strokes: one result per stroke. followed: errors of the sheet along the given finger path; None
    if no path was given.
    """

    folder: Path
    bag: Path
    strokes: list[dict[str, Any]]
    followed: dict[str, Any] | None
    images: list[Path]


def run_demo(
    launch_file: Path,
    settings: Sequence[str],
    folder: Path,
    progress: Progress,
    *,
    path: FingerPath | None = None,
    apparatus: str | None = None,
) -> DemoResult:
    """Run the demo on a graph, and return its results.

    The finger makes strokes of 10 s and 30 s, or follows `path`. Images of a tilted and of a pushed
    sheet are captured. The bag and the figures are written to `folder`.
    """
    bag = folder / "demo.mcap"
    procedure = chain_procedures(
        make_stroke_procedure(SECONDS, progress, path=path),
        make_image_procedure(image.TILT, [TILT_DEG], TILT_CORRECTIONS, progress, shading="soft"),
        make_image_procedure(image.PUSH, [DEPTH_MM], PUSH_CORRECTIONS, progress, shading="soft"),
    )
    coarse = make_settings(launch_file, "twin_eye", f"metres_per_px={METRES_PER_PX}")
    given = [*coarse, *settings]
    run_experiment(
        launch_file, given, bag, procedure, progress, apparatus=apparatus, needed=["twin/eye"]
    )
    if path is None:
        return summarize(bag, folder, strokes=SECONDS)
    return summarize(bag, folder, strokes=(), path_label=path.label)


def read_followed_path(bag: Path, label: str) -> dict[str, Any]:
    """Return the errors with which the sheet followed the finger path that has the given label.

    Raises ExperimentError if the bag does not contain the path.
    """
    runs = {run["path"]: run for run in read_followed(bag)}
    return find_recorded(runs, "finger path", label)


def summarize(
    bag: Path, folder: Path, *, strokes: tuple[float, ...], path_label: str | None = None
) -> DemoResult:
    """Compute the results of the demo from its bag, and draw its figures into `folder`.

    strokes: durations of the recorded strokes, s. path_label: label of a recorded finger path.
    """
    recording = stroke.read_recording(bag)
    eye_images = image.read_images(bag)
    views, plot, latency = (folder / f"{name}.png" for name in ("eye", "stroke", "latency"))
    tilted, pushed = (
        [find_recorded(eye_images, "image", series.label(value, name)) for name in corrections]
        for series, value, corrections in (
            (image.TILT, TILT_DEG, TILT_CORRECTIONS),
            (image.PUSH, DEPTH_MM, PUSH_CORRECTIONS),
        )
    )
    draw_eye_views(
        [(f"sheet tilted {TILT_DEG}°", tilted), (f"sheet pushed {DEPTH_MM} mm", pushed)], views
    )
    draw_latency(recording, latency)
    images = [views, latency]
    errors = {seconds: stroke.stroke_errors(recording, seconds) for seconds in strokes}
    if errors:
        draw_stroke(errors, plot)
        images.append(plot)
    results = [
        stroke.stroke_result(recording, one, seconds, bag) for seconds, one in errors.items()
    ]
    write_file(folder / "stroke.json", json.dumps(results, indent=1) + "\n")
    followed = None
    if path_label is not None:
        followed = read_followed_path(bag, path_label)
        write_file(folder / "followed.json", json.dumps(followed, indent=1) + "\n")
    return DemoResult(folder=folder, bag=bag, strokes=results, followed=followed, images=images)
