"""Figures 11 and 13 of the paper, without the graph: the renderer's pictures, judged by the twin.

    python -m benchmarks.image_correction [--scene FILE] [--stretch 1.05]

Prints two tables in mm: the error of each size as the eye sees it on the true sheet.  The tilted
sheet either rolls on the cylinder (its plane tangent, the touched line staying put on it) or turns
about its own centre.  Positive tilts turn the sheet's front upwards, as a finger
does that strokes up.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from messages.scene import Scene
from messages.types import Correction, Display
from nodes.models.rigid import rotation_from_vector, transform
from nodes.models.sheet import edge_poses
from nodes.renderer import dent_cache
from nodes.renderer.families import rolled_on
from nodes.renderer.gl import Look, headless_context
from nodes.renderer.sheet import sheet_between
from nodes.renderer.stage import Stage
from nodes.twin.eye import METRES_PER_PX, proper, push_sizes, seen, tilt_sizes
from nodes.twin.membrane import Rubber, solve
from nodes.twin.true_object import TrueBody

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

ROOT = Path(__file__).resolve().parents[1]
CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
TILT_CORRECTIONS: tuple[Correction, ...] = ("none", "one_plane", "two_pass")
"""Of a flat sheet; four triangles are then one plane."""


class Bench:
    """Renderer, true sheet and eye of one scene."""

    def __init__(self, scene: Scene, *, stretch: float) -> None:
        self.scene, self.stretch = scene, stretch
        dents = dent_cache.load_or_solve(scene, None)
        self._stage = Stage(scene, headless_context(), spacing_m=0.0025, dents=dents)
        self._eye = scene.eyes.centre_world_m
        self._proper = proper(TrueBody(scene).at_rest(), eye=self._eye, flat=True)

    def tilt_errors(self, correction: Correction, world_from_sheet: Floats) -> Floats:
        """|height|, |upside width|, |downside width| (m) against the proper picture."""
        picture = self._seen(correction, world_from_sheet, None)
        wanted = np.array(tilt_sizes(self._proper, METRES_PER_PX))
        return np.asarray(np.abs(np.array(tilt_sizes(picture, METRES_PER_PX)) - wanted))

    def push_errors(self, correction: Correction, depth_m: float) -> Floats:
        """|height|, |width| (m) against the proper picture; the drawn object is not deformed."""
        picture = self._seen(correction, np.eye(4), np.array([0.0, 0.0, -depth_m]))
        wanted = np.array(push_sizes(self._proper, METRES_PER_PX))
        return np.asarray(np.abs(np.array(push_sizes(picture, METRES_PER_PX)) - wanted))

    def _seen(self, correction: Correction, world_from_sheet: Floats, tip: Floats | None) -> Image:
        sheet = self.scene.sheet
        edges = edge_poses(world_from_sheet, sheet.width_m * self.stretch)
        believed = sheet_between(
            *edges,
            height_m=sheet.height_m,
            twist_world=np.zeros(6),
            ahead_s=0.0,
            finger_tip=tip,
        )
        assert believed is not None
        shown = Display(correction=correction, stereo="mono", shading="flat", marks=False)
        projected = self._stage.draw(shown, believed, Look(True, "object"), read=True)
        assert projected is not None
        rubber = Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)
        truth = solve(rubber, *edges, finger_tip=tip, finger_radius_m=self.scene.finger.radius_m)
        return seen(projected, truth, self.scene, eye=self._eye)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default=ROOT / "launch" / "scenes" / "cylinder.yaml", type=Path)
    parser.add_argument("--stretch", default=1.05, type=float)
    options = parser.parse_args()
    scene = Scene.model_validate(YAML(typ="safe").load(options.scene.read_text()))
    bench = Bench(scene, stretch=options.stretch)
    print("| sheet | tilt (deg) | method | height | upside | downside | mean |")
    print("|---|---|---|---|---|---|---|")
    for name in ("rolls", "turns"):
        for degrees in (-50, -40, -30, -20, -10, 10, 20, 30, 40, 50):
            tilt = -np.radians(degrees)
            turned = transform(rotation_from_vector([tilt, 0.0, 0.0]), np.zeros(3))
            pose = rolled_on(scene, tilt) if name == "rolls" else turned
            for correction in TILT_CORRECTIONS:
                errors = 1e3 * bench.tilt_errors(correction, pose)
                cells = " | ".join(f"{value:.3f}" for value in (*errors, errors.mean()))
                print(f"| {name} | {degrees:+d} | {correction} | {cells} |", flush=True)
    print("\n| push (mm) | method | height | width | mean |\n|---|---|---|---|---|")
    for depth_mm in (10, 20, 30, 40, 50):
        for correction in CORRECTIONS:
            errors = 1e3 * bench.push_errors(correction, depth_mm * 1e-3)
            cells = " | ".join(f"{value:.3f}" for value in (*errors, errors.mean()))
            print(f"| {depth_mm} | {correction} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
