"""Compute the tables of the shipped scenes that are shipped with the program.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.ship_tables [SCENE_FILE ...]

These are the pushes of the soft body's coarse table, the deflection shapes and the force table of
the sheet. With them, the first start with a shipped scene computes none of them. The program uses
the files only for the same inputs and version of the computation; tests fail if they are outdated.
Existing files are kept. Takes about ten minutes without them.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes.cache import CheckpointStore, load_cached, save_cached
from flexsheet.nodes.fem_solver import body, precompute_table, shipped_pushes
from flexsheet.nodes.fem_solver.soft_body_factory import choose_method
from flexsheet.nodes.planner import force_table
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.worker_processes import local_processes

SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=sorted(SCENES.glob("*.yaml")))
    for file in parser.parse_args().scenes:
        scene = load_scene(file)
        table = force_table.make_table_cache(scene)
        if not table.path(force_table.FOLDER).exists():
            print(save_cached(table, force_table.FOLDER, force_table.compute_table(scene)))
        if scene.methods.sheet_shape != "four_triangles":
            ship_shapes(scene)
        if scene.object.material is not None:
            ship_pushes(scene)


def ship_shapes(scene: Scene) -> None:
    """Compute the deflection shapes of a scene's sheet, and write them with single precision."""
    for _, stored in deflection_cache.list_stored(scene):
        entry = deflection_cache.shapes_cache(stored)
        path = entry.path(deflection_cache.FOLDER)
        if path.exists():
            continue
        deflection_cache.load_or_compute(stored, None)
        shapes = load_cached(entry, None)
        assert shapes is not None
        arrays = dict(entry.encode(shapes))
        for name in ("modes", "coefficients"):
            arrays[name] = arrays[name].astype(np.float32)
        path.parent.mkdir(exist_ok=True)
        np.savez_compressed(path, allow_pickle=False, **arrays)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def ship_pushes(scene: Scene) -> None:
    """Compute the pushes of the coarse table of a scene's soft body, and write them."""
    choice = choose_method(scene)
    spec = body.make_table_spec(
        scene, body.make_soft_body_spec(scene, choice.skin_spacing_m), coarse=True
    )
    path = shipped_pushes.shipped_path(precompute_table.make_table_cache(spec))
    if choice.method == "linear" or path.exists():
        return
    with tempfile.TemporaryDirectory() as folder, local_processes(os.cpu_count() or 1) as workers:
        solved = precompute_table.solve_all(
            precompute_table.plan_pushes(spec).tasks,
            workers,
            CheckpointStore(Path(folder)),
            lambda count: None,
        )
    fine = solved.get(precompute_table.FINE_NAME)
    if fine is not None:
        # The fine push only corrects forces.
        solved[precompute_table.FINE_NAME] = replace(
            fine, rest=fine.rest[:0], faces=fine.faces[:0], moved=fine.moved[:, :0]
        )
    shipped_pushes.save_shipped(path, solved)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
