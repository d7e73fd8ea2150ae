"""Compute the tables of a scene that are shipped with the program.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.ship_tables [SCENE_FILE]

These are the pushes of the soft body's coarse table, and the force table of the sheet. With them,
the first start with the scene computes neither. The program uses the files only for the same inputs
and version of the computation; tests fail if the files of the demo's scene are outdated. Takes
about three minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks.soft_body import SCENE_FILE
from flexsheet.launch.plans.plan import load_scene
from flexsheet.nodes.cache import save_cached
from flexsheet.nodes.fem_solver import body, precompute_table, shipped_pushes, snapshots
from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory, choose_method
from flexsheet.nodes.planner import force_table


class _QuickTableReady(Exception):
    """An exception that ends the computation after the coarse table."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, default=SCENE_FILE)
    scene = load_scene(parser.parse_args().scene)
    _, spacing_m = choose_method(scene, "auto", "auto")
    table = force_table.make_table_cache(scene)
    print(save_cached(table, force_table.FOLDER, force_table.compute_table(scene)))
    spec = body.make_soft_body_spec(scene, spacing_m)
    entry = precompute_table.make_table_cache(body.make_table_spec(scene, spec))
    path = shipped_pushes.shipped_path(entry)
    path.unlink(missing_ok=True)

    def stop(_: body.SceneBody) -> None:
        raise _QuickTableReady

    with tempfile.TemporaryDirectory() as folder:
        factory = SoftBodyFactory(spacing_m, Path(folder))
        linear = factory.bodies(scene, "linear", lambda *_: None)[0]
        try:
            factory.build_table(scene, linear, lambda *_: None, stop)
        except _QuickTableReady:
            checkpoints = entry.checkpoints(Path(folder))
        names = ["fine", *(f"quick-{number:04d}" for number in range(snapshots.QUICK_COUNT))]
        solved = {}
        for name in names:
            part = checkpoints.load(name)
            if part is not None:
                solved[name] = snapshots.decode_snapshot(part)
    if "fine" in solved:
        # The fine push only corrects forces.
        fine = solved["fine"]
        solved["fine"] = replace(
            fine, rest=fine.rest[:0], faces=fine.faces[:0], moved=fine.moved[:, :0]
        )
    shipped_pushes.save_shipped(path, solved)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
