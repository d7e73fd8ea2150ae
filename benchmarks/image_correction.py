"""Measure the renderer's images against the simulator, without the graph.

python -m benchmarks.image_correction [sizes] [tilts] [depths] [places] [stretches]

sizes: figures 11 and 13 of the paper; error of each size as the eye sees it on the true sheet (mm).
    The tilted sheet either rolls on the cylinder (tangent, with a fixed contact line) or rotates
    about its centre. A positive tilt rotates the sheet's front upwards, as in a stroke upwards.
rolled-sizes-json: mean and largest error of these sizes by two_pass for the rolling sheet, as JSON.
tilts, depths, places, stretches: errors at all points that the eye sees (mean, 95 %, maximum, mm),
    and the visible fraction of the object. They vary the tilt up to 80 degrees, the depth up to 70
    mm, the contact point on upright and tilted sheets, and the stretch.
Without a name, all are measured.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from flexsheet.launch.calibration.simulated_sheet import solve_sheet
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Correction, Display
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.benchmarks import (
    draw_coordinate_ramps,
    roll_sheet,
)
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet
from flexsheet.nodes.twin.error_map import ErrorMap, error_map
from flexsheet.nodes.twin.eye import METRES_PER_PX, push_sizes, render_expected, seen, tilt_sizes
from flexsheet.nodes.twin.membrane import DeformedSheet, NotConvergedError
from flexsheet.nodes.twin.true_object import TrueBody

ROOT = Path(__file__).resolve().parents[1]
CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
TILT_CORRECTIONS: tuple[Correction, ...] = ("none", "one_plane", "two_pass")
"""The corrections for a flat sheet, for which `one_plane` equals the method of four triangles."""
EYE_CORRECTIONS: tuple[Correction, ...] = ("none", "two_pass")


class CorrectionBench:
    """The renderer, the true sheet and the viewer's eye of one scene."""

    def __init__(self, scene: Scene, *, stretch: float) -> None:
        self.scene, self.stretch = scene, stretch
        basis = deflection_cache.load_or_compute(scene, None)
        self.stage = SceneRenderer(scene, headless_context(), spacing_m=0.0025, basis=basis)
        self._eye = scene.eyes.centre_world_m
        self._expected = render_expected(TrueBody(scene).at_rest(), eye=self._eye, flat=True)
        unmoved = self.situation(np.eye(4), None)
        self._whole = len(self.errors("none", *unmoved).sizes_m)

    def situation(
        self, world_from_sheet: Floats, tip: Floats | None, *, stretch: float | None = None
    ) -> tuple[SheetPose, DeformedSheet]:
        """Return the predicted sheet and the true sheet."""
        sheet = self.scene.sheet
        edges = edge_poses(world_from_sheet, sheet.width_m * (stretch or self.stretch))
        predicted = estimate_sheet(*edges, height_m=sheet.height_m, finger_tip=tip)
        assert predicted is not None
        return predicted, solve_sheet(self.scene, *edges, tip)

    def pushed(
        self, depth_m: float, *, tilt_deg: float = 0.0, place_m: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Floats, Floats | None]:
        """Return world_from_sheet in contact with the cylinder at that point, and the fingertip."""
        pose = roll_sheet(self.scene, -np.radians(tilt_deg), place_m)
        touched = pose[:3, 3] + pose[:3, :3] @ [*place_m, 0.0]
        return pose, touched - depth_m * pose[:3, 2] if depth_m else None

    def size_errors(
        self,
        correction: Correction,
        predicted: SheetPose,
        truth: DeformedSheet,
        sizes: Callable[[Image, float], Sequence[float]],
    ) -> Floats:
        """Return the error of each size, m, relative to the image of the undeformed object."""
        shown = Display(correction=correction, stereo="mono", shading="flat", marks=False)
        projected = self.stage.draw(shown, predicted, DrawStyle(True, "object"), read=True)
        assert projected is not None
        picture = seen(projected, truth, self.scene, eye=self._eye)
        wanted = np.array(sizes(self._expected, METRES_PER_PX))
        return np.asarray(np.abs(np.array(sizes(picture, METRES_PER_PX)) - wanted))

    def errors(self, method: str, predicted: SheetPose, truth: DeformedSheet) -> ErrorMap:
        """Return the image errors at all points that the eye sees."""
        pictures = draw_coordinate_ramps(self.stage, method, predicted)
        x, y = (seen(each, truth, self.scene, eye=self._eye) for each in pictures)
        return error_map(x, y, METRES_PER_PX)

    def cell(self, method: str, predicted: SheetPose, truth: DeformedSheet) -> str:
        """Format mean / 95 % / maximum of the errors, mm, and the object's visible fraction."""
        sizes = 1e3 * self.errors(method, predicted, truth).sizes_m
        if len(sizes) == 0:
            return "dark"
        figures = f"{sizes.mean():.2f} / {np.quantile(sizes, 0.95):.2f} / {sizes.max():.2f}"
        return f"{figures} ({100 * len(sizes) / self._whole:.0f} %)"


def row(*cells: object) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def heading(*cells: str) -> None:
    print()
    row(*cells)
    row(*("---" for _ in cells))


def with_mean(errors: Floats) -> list[str]:
    return [f"{error:.3f}" for error in (*errors, errors.mean())]


def print_sizes(bench: CorrectionBench) -> None:
    heading("sheet", "tilt, °", "method", "height", "upside", "downside", "mean")
    for name in ("rolls", "turns"):
        for degrees in (-50, -40, -30, -20, -10, 10, 20, 30, 40, 50):
            tilt = -np.radians(degrees)
            turned = transform(rotation_from_vector([tilt, 0.0, 0.0]), np.zeros(3))
            pose = roll_sheet(bench.scene, tilt) if name == "rolls" else turned
            situation = bench.situation(pose, None)
            for correction in TILT_CORRECTIONS:
                errors = 1e3 * bench.size_errors(correction, *situation, tilt_sizes)
                row(
                    name,
                    f"{degrees:+d}",
                    correction,
                    *(f"{e:.3f}" for e in (*errors, errors.mean())),
                )
    heading("push, mm", "method", "height", "width", "mean")
    for depth_mm in (10, 20, 30, 40, 50):
        situation = bench.situation(*bench.pushed(depth_mm * 1e-3))
        for correction in CORRECTIONS:
            errors = 1e3 * bench.size_errors(correction, *situation, push_sizes)
            row(depth_mm, correction, *with_mean(errors))


def print_rolled_sizes_json(bench: CorrectionBench) -> None:
    """Print the mean and the largest size error of the method two_pass for rolling sheets, mm."""
    errors = []
    for degrees in (-50, -30, -10, 10, 30, 50):
        situation = bench.situation(roll_sheet(bench.scene, -np.radians(degrees)), None)
        errors.append(1e3 * np.abs(bench.size_errors("two_pass", *situation, tilt_sizes)))
    print(json.dumps({"mean_mm": float(np.mean(errors)), "max_mm": float(np.max(errors))}))


def print_tilts(bench: CorrectionBench) -> None:
    heading("tilt, °", *TILT_CORRECTIONS)
    for degrees in (*range(-80, -50, 5), *range(-50, 60, 25), *range(55, 85, 5)):
        situation = bench.situation(roll_sheet(bench.scene, -np.radians(degrees)), None)
        usable = bench.stage.usable(situation[0])
        row(
            f"{degrees:+d}{'' if usable else ' (held)'}",
            *(bench.cell(method, *situation) for method in TILT_CORRECTIONS),
        )


def print_depths(bench: CorrectionBench) -> None:
    methods = ("none", "four_triangles", "two_pass_triangles", "two_pass")
    heading("push, mm", *methods)
    for depth_mm in (1, 2, 3.5, 5, 10, 20, 30, 40, 50, 60, 70):
        situation = bench.situation(*bench.pushed(depth_mm * 1e-3))
        row(depth_mm, *(bench.cell(method, *situation) for method in methods))


PLACES_MM = (
    (0, 0),
    (40, 50),
    (0, 60),
    (0, 84),
    (0, -84),
    (0, 96),
    (0, 110),
    (70, 0),
    (86, 0),
    (105, 0),
)


def print_places(bench: CorrectionBench) -> None:
    tilts = (0, -30, 30)
    heading("pushed 30 mm at, mm", *(f"tilted {tilt:+d}°" for tilt in tilts))
    for place in PLACES_MM:
        cells = []
        for tilt in tilts:
            place_m = (place[0] * 1e-3, place[1] * 1e-3)
            situation = bench.situation(*bench.pushed(0.03, tilt_deg=tilt, place_m=place_m))
            cells.append(bench.cell("two_pass", *situation))
        row(f"{place[0]}, {place[1]}", *cells)


def summarize_eyes(left: ErrorMap, right: ErrorMap) -> list[float]:
    """Return the mean errors (mm) of the left and right image, and of both disparities.

    The disparity error is the error of the right eye minus the error of the left eye, horizontally
    and vertically, where both eyes see the object. A value is NaN if there are no points.
    """
    across, up = np.moveaxis(np.abs(right.errors_m - left.errors_m), -1, 0)
    parts = (left.sizes_m, right.sizes_m, across, up)
    return [1e3 * float(np.nanmean(part)) if np.isfinite(part).any() else np.nan for part in parts]


def print_eyes(bench: CorrectionBench) -> None:
    """Print the error of each eye's image and of the disparity, against the true sheet."""
    scene, half = bench.scene, np.array([0.5 * bench.scene.eyes.interocular_m, 0.0, 0.0])
    cases = [(f"tilted {tilt:+d}°", bench.pushed(0.0, tilt_deg=tilt)) for tilt in (-50, 50)]
    cases += [(f"pushed {depth} mm", bench.pushed(1e-3 * depth)) for depth in (10, 30, 50)]
    maps: dict[tuple[str, Correction], list[ErrorMap]] = {}
    for side in (-1.0, 1.0):  # one after the other, since each has its own graphics context
        centre = scene.eyes.centre_world_m + side * half
        eyes = scene.eyes.model_copy(update={"centre_world_m": centre})
        one = CorrectionBench(scene.model_copy(update={"eyes": eyes}), stretch=bench.stretch)
        for name, case in cases:
            situation = one.situation(*case)
            for correction in EYE_CORRECTIONS:
                maps.setdefault((name, correction), []).append(one.errors(correction, *situation))
    heading("sheet, mm", "method", "left", "right", "disparity", "vertical")
    for (name, correction), (left, right) in maps.items():
        row(name, correction, *(f"{error:.3f}" for error in summarize_eyes(left, right)))


def print_stretches(bench: CorrectionBench) -> None:
    heading("stretch", "pushed 30 mm", "note")
    for stretch in (0.98, 1.0, 1.01, 1.03, 1.05, 1.08, 1.09, 1.12):
        pose, tip = bench.pushed(0.03)
        try:
            situation = bench.situation(pose, tip, stretch=stretch)
        except NotConvergedError as error:
            row(stretch, "no truth", error)
            continue
        cell = bench.cell("two_pass", *situation)
        row(stretch, cell, bench.stage.note)


TABLES: dict[str, Callable[[CorrectionBench], None]] = {
    "sizes": print_sizes,
    "rolled-sizes-json": print_rolled_sizes_json,
    "tilts": print_tilts,
    "depths": print_depths,
    "places": print_places,
    "stretches": print_stretches,
    "eyes": print_eyes,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], metavar="TABLE")
    parser.add_argument("--scene", default=ROOT / "launch" / "scenes" / "cylinder.yaml", type=Path)
    parser.add_argument("--stretch", default=1.05, type=float)
    options = parser.parse_args()
    bench = CorrectionBench(load_scene(options.scene), stretch=options.stretch)
    for name in options.tables or [name for name in TABLES if "json" not in name]:
        TABLES[name](bench)


if __name__ == "__main__":
    main()
