"""Compute and cache the deflection shapes of the pushed sheet.

The computation takes a minute on two cores. Shapes are stored for a few finger radii and sheet
widths. For other radii, the stored shapes are interpolated. For other widths, they are scaled. The
folder `shapes` of the package contains the shapes of the shipped scenes. The file names contain the
key of the cache, so outdated shapes are not used. The command `python -m benchmarks.ship_tables`
writes them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.cache import Specification, cached, load_cached
from flexsheet.nodes.models.sheet.indentation import (
    IndentationBasis,
    IndentationCase,
    IndentationRange,
    solve_indentation,
    solve_indentation_basis,
)
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.worker_processes import local_processes

VERSION = 2
"""The version of the computation, which is part of the cache key. Increase it when results for the
same inputs change."""

STRETCH_SLACK = 0.01
"""The margin of the computed stretch ratios beyond each limit of the scene."""

FIELDS = ("stretches", "xs_m", "ys_m", "roots", "modes", "coefficients")
"""The names of the fields of `IndentationBasis` that the cache file contains."""

FOLDER = Path(__file__).with_name("shapes")

MAX_DEPTH_RATIO = 1.2
"""The maximum push depth that is computed, divided by the maximum push depth of the scene."""

RADIUS_STEP_M, FIRST_RADIUS_M = 0.002, 0.003
"""The difference between successive stored radii of the finger, and the minimum stored radius."""

WIDTH_STEP_M = 0.005
"""The difference between successive stored widths of the sheet."""

Progress = Callable[[int, int], None]


def required_shapes(scene: Scene) -> tuple[Rubber, IndentationRange]:
    """Return the rubber of a scene's sheet, and the range of pushes that the scene requires.

    The range contains stretch ratios and depths. For this range, the deflections of the pushed
    sheet are precomputed.
    """
    sheet = scene.sheet
    rubber = Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)
    within = IndentationRange(
        min_stretch=max(1.005, sheet.min_stretch_ratio - STRETCH_SLACK),
        max_stretch=sheet.max_stretch_ratio + STRETCH_SLACK,
        deepest_m=MAX_DEPTH_RATIO * scene.working_range.push_depth_m,
    )
    return rubber, within


def shapes_cache(scene: Scene) -> Specification[IndentationBasis]:
    """Define how a scene's deflection shapes are stored in the cache.

    The result consists of the cache key, and of functions that encode and decode the shapes. The
    shapes do not depend on the thickness and Young's modulus of the sheet.
    """
    rubber, within = required_shapes(scene)
    depends_on = {
        "version": VERSION,
        "width_m": rubber.width_m,
        "height_m": rubber.height_m,
        "finger_radius_m": scene.finger.radius_m,
        **asdict(within),
    }

    def decode(content: dict[str, Floats]) -> IndentationBasis:
        return IndentationBasis(
            rubber,
            scene.finger.radius_m,
            within.deepest_m,
            *(content[name].astype(np.float64) for name in FIELDS),
        )

    return Specification(
        "dents",
        depends_on,
        lambda shapes: {name: getattr(shapes, name) for name in FIELDS},
        decode,
    )


def list_stored(scene: Scene) -> list[tuple[float, Scene]]:
    """Return the scenes whose stored deflection shapes are interpolated for a given scene.

    The result is pairs of a weight and a scene. Each scene is a copy of the given one with another
    finger radius and sheet width. The weighted sum of the stored deflection shapes approximates the
    shapes of the given scene.
    """
    width_m = WIDTH_STEP_M * max(round(scene.sheet.width_m / WIDTH_STEP_M), 1)
    sheet = scene.sheet.model_copy(update={"width_m": round(width_m, 6)})
    steps = max(scene.finger.radius_m - FIRST_RADIUS_M, 0.0) / RADIUS_STEP_M
    below = int(np.floor(steps + 1e-6))
    above = steps - below
    weights = [(below, 1.0 - above), (below + 1, above)] if above > 1e-6 else [(below, 1.0)]
    found = []
    for number, weight in weights:
        radius_m = round(FIRST_RADIUS_M + number * RADIUS_STEP_M, 6)
        finger = scene.finger.model_copy(update={"radius_m": radius_m})
        found.append((weight, scene.model_copy(update={"sheet": sheet, "finger": finger})))
    return found


def _combine(scene: Scene, parts: Sequence[tuple[float, IndentationBasis]]) -> IndentationBasis:
    """Interpolate a scene's deflection shapes from stored shapes of similar scenes.

    parts: pairs of a weight and stored shapes.

    The stored shapes are added with their weights. They are scaled along x to the width of the
    scene's sheet.
    """
    rubber, _ = required_shapes(scene)
    stored = parts[0][1]
    wider = rubber.width_m / stored.rubber.width_m
    modes = np.concatenate([basis.modes for _, basis in parts])
    return replace(
        stored,
        rubber=rubber,
        finger_radius_m=scene.finger.radius_m,
        xs_m=wider * stored.xs_m,
        modes=modes * np.array([wider, 1.0, 1.0]),
        coefficients=np.concatenate(
            [weight * basis.coefficients for weight, basis in parts], axis=-1
        ),
    )


def load(scene: Scene, cache_dir: Path | None) -> IndentationBasis | None:
    """Load the deflection shapes of a scene from the cache, or return None if some are missing.

    cache_dir: folder of the cache; None selects the cache of the user.
    """
    parts = []
    for weight, stored in list_stored(scene):
        entry = shapes_cache(stored)
        basis = load_cached(entry, cache_dir) or load_cached(entry, FOLDER)
        if basis is None:
            return None
        parts.append((weight, basis))
    return _combine(scene, parts)


def load_or_compute(
    scene: Scene, cache_dir: Path | None, progress: Progress = lambda done, total: None
) -> IndentationBasis:
    """Load the scene's deflection shapes from the cache, or compute and store them.

    The computation uses all cores. cache_dir: folder of the cache. If it is None, the cache of the
    user is used. progress: function that receives the number of solved pushes and the total number.
    """
    return _combine(
        scene,
        [
            (weight, _load_or_solve(stored, cache_dir, progress))
            for weight, stored in list_stored(scene)
        ],
    )


def _load_or_solve(scene: Scene, cache_dir: Path | None, progress: Progress) -> IndentationBasis:
    rubber, within = required_shapes(scene)

    def solve_all(pushes: Sequence[IndentationCase]) -> Iterator[Floats]:
        with local_processes(os.cpu_count() or 1) as workers:
            for done, solved in enumerate(workers.map(solve_indentation, pushes), start=1):
                progress(done, len(pushes))
                yield solved

    entry = shapes_cache(scene)
    return cached(
        entry,
        cache_dir,
        lambda: (
            load_cached(entry, FOLDER)
            or solve_indentation_basis(
                rubber, within=within, finger_radius_m=scene.finger.radius_m, solve_all=solve_all
            )
        ),
    )
