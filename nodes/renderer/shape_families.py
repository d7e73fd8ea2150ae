"""The sheet-shape method family: how long the sheet's shape takes, how far it is from the sheet.

What is judged is the height of each method's mesh over the flat sheet against the true sheet's, at
the true sheet's own points; the true sheet is brought along by whoever asks for the family.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from messages.scene import Scene
from nodes.methods import Case, Family, Trial, up_to
from nodes.models.sheet import edge_poses
from nodes.models.sheet.indentation import triangulate_grid
from nodes.models.sheet.membrane import push_path
from nodes.renderer import dent_cache
from nodes.renderer.sheet import Sheet, sheet_between
from nodes.renderer.sheet_mesh import (
    FLAT_TO_M,
    TRIANGLES_TO_M,
    SheetMesh,
    dented_mesh,
    flat_mesh,
    pyramid_mesh,
)

Floats = NDArray[np.float64]

Judge = Callable[[Scene, Floats, Floats, Floats], Floats]
"""Points (n, 3) of the true sheet in the world, between two edges and under a fingertip (3,)."""

UNSOLVED = ("flat", "four_triangles")
METHODS = (*UNSOLVED, "dents", "membrane")
DEPTHS_M = (0.002, 0.01, 0.02, 0.035, 0.05)
PLACES: tuple[tuple[str, float, float], ...] = (
    ("centre", 0.0, 0.0),
    ("off-centre", 0.17, 0.21),
    ("near the clamp", 0.29, 0.0),
    ("near the free edge", 0.0, 0.35),
)
"""Names, and x over the width, y over the height."""


def sheet_shape_family(judge: Judge, *, solved: bool = True) -> Family:
    """Every shape at the scene's stretches, over depths and places; without `solved`, those alone
    that nothing need be solved for."""
    return Family(
        name="sheet-shape",
        unit="mm",
        reference="the twin's membrane, rms height",
        methods=METHODS if solved else UNSOLVED,
        trials=partial(_trials, judge, solved),
        tolerance=lambda scene: 1e3 * scene.tolerances.image_m,
    )


def _trials(judge: Judge, solved: bool, scene: Scene) -> Iterator[Trial]:
    dents = dent_cache.load_or_solve(scene, None) if solved else None
    rubber, _ = dent_cache.wanted(scene)
    spec = scene.sheet
    middle = 0.5 * (spec.min_stretch_ratio + spec.max_stretch_ratio)
    stretches = (spec.min_stretch_ratio, middle, spec.max_stretch_ratio)
    depths_m = up_to(scene.working_range.push_depth_m, DEPTHS_M)
    for stretch, depth, (where, x, y) in product(stretches, depths_m, PLACES):
        if where != "centre" and stretch != middle:
            continue
        tip = np.array([x * spec.width_m, y * spec.height_m, -depth])
        edges = edge_poses(np.eye(4), stretch * spec.width_m)
        sheet = sheet_between(
            *edges,
            height_m=spec.height_m,
            twist_world=np.zeros(6),
            ahead_s=0.0,
            finger_tip=tip,
        )
        assert sheet is not None
        place = (float(tip[0]), float(tip[1]))

        def elements(sheet: Sheet, stretch: float = stretch, depth: float = depth) -> SheetMesh:
            assert sheet.pushed_point is not None
            pushed = push_path(
                rubber,
                stretch_ratio=stretch,
                depths_m=np.array([depth]),
                place_m=(float(sheet.pushed_point[0]), float(sheet.pushed_point[1])),
                finger_radius_m=scene.finger.radius_m,
            )
            rows, columns = pushed.rest_m.shape[:2]
            return SheetMesh(pushed.positions[0].reshape(-1, 3), triangulate_grid(rows, columns))

        shapes: dict[str, Callable[[Sheet], SheetMesh]] = {
            "flat": flat_mesh,
            "four_triangles": pyramid_mesh,
        }
        in_range = {
            "flat": depth <= FLAT_TO_M,
            "four_triangles": depth <= TRIANGLES_TO_M,
        }
        if dents is not None:
            shapes |= {"dents": partial(dented_mesh, dents=dents), "membrane": elements}
            in_range |= {"dents": not dents.invalid_reason(stretch, place, depth), "membrane": True}
        truth = judge(scene, *edges, tip)
        case: Case = {"stretch": stretch, "depth_mm": 1e3 * depth, "place": where}
        for method, shape in shapes.items():
            yield Trial(
                method=method,
                case=case,
                run=partial(shape, sheet),
                error=partial(height_error_mm, truth=truth),
                in_range=in_range[method],
                size={"triangles": len(shape(sheet).triangles)} if method != "membrane" else {},
            )


def height_error_mm(mesh: SheetMesh, *, truth: Floats) -> float:
    """Root mean square of the mesh's height less the truth's, at the truth's points (n, 3), mm.

    Heights are along the world's z, as the sheets of the family lie.
    """
    heights = LinearNDInterpolator(mesh.vertices[:, :2], mesh.vertices[:, 2])(truth[:, :2])
    off = (heights - truth[:, 2])[np.isfinite(heights)]
    return 1e3 * float(np.sqrt(np.mean(off**2)))
