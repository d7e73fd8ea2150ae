"""Compute and cache the deflection shapes of the pushed sheet.

The computation takes half a minute. Its result depends only on the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.background import enter_background
from flexsheet.nodes.cache import Specification, cached
from flexsheet.nodes.models.sheet.indentation import (
    IndentationBasis,
    IndentationCase,
    IndentationRange,
    solve_indentation,
    solve_indentation_basis,
)
from flexsheet.nodes.models.sheet.rubber import Rubber

VERSION = 2
"""Version of the computation. Increase it when results for the same inputs change."""

STRETCH_SLACK = 0.01
"""Margin by which the range of stretch ratios in the computation exceeds the scene's limits."""

FIELDS = ("stretches", "xs_m", "ys_m", "roots", "modes", "coefficients")
"""Fields of `IndentationBasis` that the cache file contains."""

MAX_DEPTH_RATIO = 1.2
"""Ratio of the maximum push depth in the computation to the scene's push depth."""

Progress = Callable[[int, int], None]


def required_shapes(scene: Scene) -> tuple[Rubber, IndentationRange]:
    """Return the rubber sheet of a scene, and the range of pushes that must be computed for it."""
    sheet = scene.sheet
    rubber = Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)
    within = IndentationRange(
        min_stretch=max(1.005, sheet.min_stretch_ratio - STRETCH_SLACK),
        max_stretch=sheet.max_stretch_ratio + STRETCH_SLACK,
        deepest_m=MAX_DEPTH_RATIO * scene.working_range.push_depth_m,
    )
    return rubber, within


def shapes_cache(scene: Scene) -> Specification[IndentationBasis]:
    """Return how the scene's deflection shapes are cached: key, computation inputs and format.

    The shapes do not depend on the sheet's thickness and Young's modulus.
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
            *(content[name] for name in FIELDS),
        )

    return Specification(
        "dents",
        depends_on,
        lambda shapes: {name: getattr(shapes, name) for name in FIELDS},
        decode,
    )


def load_or_compute(
    scene: Scene, cache_dir: Path | None, progress: Progress = lambda done, total: None
) -> IndentationBasis:
    """Load the scene's deflection shapes from the cache; if absent, compute and store them.

    The computation uses all cores. cache_dir: folder of the cache; None: the user's cache.
    progress: called with the number of solved pushes and their total number.
    """
    rubber, within = required_shapes(scene)

    def solve_all(pushes: Sequence[IndentationCase]) -> Iterator[Floats]:
        with ProcessPoolExecutor(
            mp_context=get_context("spawn"), initializer=enter_background
        ) as workers:
            for done, solved in enumerate(workers.map(solve_indentation, pushes), start=1):
                progress(done, len(pushes))
                yield solved

    return cached(
        shapes_cache(scene),
        cache_dir,
        lambda: solve_indentation_basis(
            rubber, within=within, finger_radius_m=scene.finger.radius_m, solve_all=solve_all
        ),
    )
