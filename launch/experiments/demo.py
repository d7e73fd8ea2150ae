"""Run the system on one computer as a demo, and create tables and figures of the errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from flexsheet.launch.experiments import image, stroke
from flexsheet.launch.experiments.pictures import draw_eye_views, draw_stroke
from flexsheet.launch.experiments.run import (
    Procedure,
    Progress,
    chain_procedures,
    is_path_recorded,
    make_evaluation,
    make_image_procedure,
    make_path_procedure,
    make_settings,
    run_experiment,
)
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import require_cylinder
from flexsheet.messages.types import Correction

METRES_PER_PX = 0.0007
"""The image resolution in Furukawa et al. 2007.

It is sufficient for figures. An image takes a quarter of the time that the default resolution
needs.
"""

SECONDS = (10.0, 30.0)
IMAGES: tuple[tuple[image.Series, float, tuple[Correction, ...]], ...] = (
    (image.TILT, -40, ("none", "one_plane", "two_pass")),
    (image.PUSH, 30, ("none", "four_triangles", "two_pass")),
)
"""The image experiments.

Each entry contains the varied quantity, its value (tilt in degrees, depth in mm), and the methods
of image correction that are compared.
"""


STROKE_FIGURE = (
    "errors of the sheet's position and angle during the strokes, and those of the paper"
)
EYE_FIGURE = "what the user sees on a tilted and on a pushed sheet, for each image correction"


@dataclass(frozen=True, slots=True)
class DemoFigure:
    """A figure that the demo has drawn.

    shows: description of the figure in words.
    """

    path: Path
    shows: str


@dataclass(slots=True)
class DemoResult:
    """The results of all finished experiments of the demo.

    strokes: one result per stroke of the finger.
    images: errors (mm) of the sizes that the eye sees, for each sheet and image correction.
    """

    strokes: list[dict[str, Any]] = field(default_factory=list)
    images: list[dict[str, Any]] = field(default_factory=list)
    figures: list[DemoFigure] = field(default_factory=list)


Report = Callable[[DemoResult], None]


def run_demo(
    launch_file: Path,
    settings: Sequence[str],
    bag: Path,
    progress: Progress,
    report: Report,
    *,
    apparatus: str | None = None,
) -> None:
    """Run the demo on a graph, and report the result of each experiment when it is finished.

    The finger makes strokes of 10 s and 30 s. Images of a tilted and of a pushed
    sheet are captured. Results and figures are written to the folder of the bag. The function
    `report` receives the new results.
    """
    procedure = chain_procedures(*make_demo_procedures(bag, progress, report))
    coarse = make_settings(launch_file, "twin_eye", f"metres_per_px={METRES_PER_PX}")
    given = [*coarse, *settings]
    run_experiment(
        launch_file,
        given,
        bag,
        procedure,
        progress,
        apparatus=apparatus,
        needed=["twin/eye"],
        check_scene=require_cylinder,
    )


def make_demo_procedures(bag: Path, progress: Progress, report: Report) -> list[Procedure]:
    """Make the procedures (coroutines) that run the experiments of the demo and evaluate them."""
    made: list[Procedure] = []

    def add(procedure: Procedure, evaluate: Callable[[], DemoResult | None], name: str) -> None:
        made.extend((procedure, make_evaluation(bag, evaluate, report, name)))

    for number, seconds in enumerate(SECONDS, 1):
        evaluate = partial(evaluate_strokes, bag, SECONDS[:number])
        make_path = partial(stroke.stroke_path, seconds=seconds)
        add(make_path_procedure(make_path, progress), evaluate, stroke.stroke_label(seconds))
    for number, (series, value, corrections) in enumerate(IMAGES, 1):
        procedure = make_image_procedure(series, [value], corrections, progress, shading="soft")
        add(procedure, partial(evaluate_images, bag, number), series.name.format(value))
    return made


def evaluate_strokes(bag: Path, strokes: Sequence[float]) -> DemoResult | None:
    """Evaluate the recorded strokes of the finger, and return the result of the last stroke.

    The results of all strokes are written to a file and drawn. Return None if the bag does not yet
    contain the last stroke.

    strokes: durations of the strokes up to now, s.
    """
    if not is_path_recorded(bag, stroke.stroke_label(strokes[-1])):
        return None
    recording = stroke.read_recording(bag)
    errors = {seconds: stroke.stroke_errors(recording, seconds) for seconds in strokes}
    results = [
        stroke.stroke_result(recording, one, seconds, bag) for seconds, one in errors.items()
    ]
    write_file(bag.parent / "stroke.json", json.dumps(results, indent=1) + "\n")
    plot = bag.parent / "stroke.png"
    draw_stroke(errors, plot)
    return DemoResult(strokes=results[-1:], figures=[DemoFigure(plot, STROKE_FIGURE)])


def evaluate_images(bag: Path, count: int) -> DemoResult | None:
    """Draw the images of the simulated eye for the first `count` entries of IMAGES.

    The result contains the errors of the last of these entries. Return None if the bag does not yet
    contain the images of all these entries.
    """
    images, rows = image.read_images(bag), []
    for series, value, corrections in IMAGES[:count]:
        labels = [series.label(value, one) for one in corrections]
        if not images.keys() >= set(labels):
            return None
        rows.append((f"sheet {series.name.format(value)}", [images[label] for label in labels]))
    views = bag.parent / "eye.png"
    draw_eye_views(rows, views)
    series, value, corrections = IMAGES[count - 1]
    errors = [
        {
            "sheet": series.name.format(value),
            "correction": correction,
            **_summarize_sizes(images[series.label(value, correction)], series),
        }
        for correction in corrections
    ]
    return DemoResult(images=errors, figures=[DemoFigure(views, EYE_FIGURE)])


def _summarize_sizes(seen: image.EyeImage, series: image.Series) -> dict[str, float]:
    errors_mm = image.size_errors_mm(seen, series.sizes)
    return {"mean_mm": sum(errors_mm) / len(errors_mm), "max_mm": max(errors_mm)}
