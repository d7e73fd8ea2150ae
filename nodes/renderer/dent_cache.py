"""Keeps the sheet's dent shapes from one run to the next: they take half a minute to solve."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.cache import default_cache_dir, load_arrays, save_arrays
from nodes.models.sheet.indentation import (
    IndentationBasis,
    IndentationCase,
    IndentationRange,
    solve_indentation,
    solve_indentation_basis,
)
from nodes.models.sheet.rubber import Rubber

Floats = NDArray[np.float64]

VERSION = 2
"""Of the shapes' making; another one makes them anew."""

STRETCH_SLACK = 0.01
"""How far past the scene's stretches the arms may be."""

KEPT = ("stretches", "xs_m", "ys_m", "roots", "modes", "coefficients")
"""Fields of `IndentationBasis` that are in the file, in their order."""

WORKERS_NICE = 10
"""A graph may be running meanwhile."""

DEPTH_SHARE = 1.2
"""Deepest dent over the scene's push depth."""

Progress = Callable[[int, int], None]


def wanted(scene: Scene) -> tuple[Rubber, IndentationRange]:
    """The sheet and the pushes for which a scene needs shapes."""
    sheet = scene.sheet
    rubber = Rubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)
    within = IndentationRange(
        min_stretch=max(1.005, sheet.min_stretch_ratio - STRETCH_SLACK),
        max_stretch=sheet.max_stretch_ratio + STRETCH_SLACK,
        deepest_m=DEPTH_SHARE * scene.working_range.push_depth_m,
    )
    return rubber, within


def file_of(scene: Scene, cache_dir: Path | None) -> Path:
    """Where the scene's shapes are kept: the name tells what they are of.  None: the default.

    A sheet's shapes do not depend on its thickness or modulus, so neither does the name.
    """
    rubber, within = wanted(scene)
    told = {
        "version": VERSION,
        "width_m": rubber.width_m,
        "height_m": rubber.height_m,
        "finger_radius_m": scene.finger.radius_m,
        **asdict(within),
    }
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:24]
    return (cache_dir or default_cache_dir()) / f"dents-{digest}.npz"


def load(scene: Scene, cache_dir: Path | None) -> IndentationBasis | None:
    """The scene's shapes, or None where they are not kept, or the file is damaged."""
    kept = load_arrays(file_of(scene, cache_dir))
    if kept is None or not kept.keys() >= set(KEPT):
        return None
    rubber, within = wanted(scene)
    return IndentationBasis(
        rubber, scene.finger.radius_m, within.deepest_m, *(kept[name] for name in KEPT)
    )


def load_or_solve(
    scene: Scene, cache_dir: Path | None, progress: Progress = lambda done, total: None
) -> IndentationBasis:
    """The scene's shapes from the cache; else solved on all cores, and kept once they are whole."""
    shapes = load(scene, cache_dir)
    if shapes is not None:
        return shapes
    rubber, within = wanted(scene)

    def solve_all(pushes: Sequence[IndentationCase]) -> Iterator[Floats]:
        with ProcessPoolExecutor(
            mp_context=get_context("spawn"), initializer=os.nice, initargs=(WORKERS_NICE,)
        ) as workers:
            for done, solved in enumerate(workers.map(solve_indentation, pushes), start=1):
                progress(done, len(pushes))
                yield solved

    shapes = solve_indentation_basis(
        rubber, within=within, finger_radius_m=scene.finger.radius_m, solve_all=solve_all
    )
    save_arrays(file_of(scene, cache_dir), {name: getattr(shapes, name) for name in KEPT})
    return shapes
