"""Measure the time and the error of the methods that compute the shape of a pushed sheet.

The error is the difference in height (world z) between the mesh of a method and a reference sheet.
The error is computed at the points of the reference sheet, which the caller provides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.methods import Case, Family, Trial, clip_range
from flexsheet.nodes.models.shapes.triangles import triangulate_grid
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.models.sheet.membrane import push_path
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet
from flexsheet.nodes.renderer.sheet_mesh import (
    MAX_TRIANGLES_DEPTH_M,
    SheetMesh,
    deflected_mesh,
    pyramid_mesh,
)

ReferenceFactory = Callable[[Scene, Floats, Floats, Floats], Floats]
"""A function that returns world points (n, 3), in m, of the reference sheet. Its arguments are the
scene, the poses (4, 4) of the sheet's left and right edges, and the fingertip (3,), m."""

DEPTHS_M = (0.002, 0.01, 0.02, 0.035, 0.05)
SAMPLE_POINTS: tuple[tuple[str, float, float], ...] = (
    ("centre", 0.0, 0.0),
    ("off-centre", 0.17, 0.21),
    ("near the clamp", 0.29, 0.0),
    ("near the free edge", 0.0, 0.35),
)
"""The names and coordinates of the push positions. The coordinates x and y are measured from the
sheet's centre, as fractions of the sheet's width and height."""


def sheet_shape_family(reference: ReferenceFactory) -> Family:
    """Return the benchmark of the sheet shape methods by stretch, depth and position."""
    return Family(
        name="sheet-shape",
        unit="mm",
        reference="the simulated membrane, rms height",
        methods=("four_triangles", "reduced_order", "membrane"),
        trials=partial(_trials, reference),
        prepare=lambda scene, progress: deflection_cache.load_or_compute(scene, None, progress),
        tolerance=lambda scene: 1e3 * scene.tolerances.image_m,
    )


def _trials(reference: ReferenceFactory, scene: Scene) -> Iterator[Trial]:
    basis = deflection_cache.load_or_compute(scene, None)
    rubber, _ = deflection_cache.required_shapes(scene)
    spec = scene.sheet
    middle = 0.5 * (spec.min_stretch_ratio + spec.max_stretch_ratio)
    stretches = (spec.min_stretch_ratio, middle, spec.max_stretch_ratio)
    depths_m = clip_range(scene.working_range.push_depth_m, DEPTHS_M)
    for stretch, depth, (where, x, y) in product(stretches, depths_m, SAMPLE_POINTS):
        if where != "centre" and stretch != middle:
            continue
        tip = np.array([x * spec.width_m, y * spec.height_m, -depth])
        edges = edge_poses(np.eye(4), stretch * spec.width_m)
        sheet = estimate_sheet(*edges, height_m=spec.height_m, finger_tip=tip)
        assert sheet is not None
        position = (float(tip[0]), float(tip[1]))

        def elements(sheet: SheetPose, stretch: float = stretch, depth: float = depth) -> SheetMesh:
            assert sheet.pushed_point is not None
            pushed = push_path(
                rubber,
                stretch_ratio=stretch,
                depths_m=np.array([depth]),
                position_m=(float(sheet.pushed_point[0]), float(sheet.pushed_point[1])),
                finger_radius_m=scene.finger.radius_m,
            )
            rows, columns = pushed.rest_m.shape[:2]
            return SheetMesh(pushed.positions[0].reshape(-1, 3), triangulate_grid(rows, columns))

        shapes: dict[str, tuple[Callable[[SheetPose], SheetMesh], bool]] = {
            "four_triangles": (pyramid_mesh, depth <= MAX_TRIANGLES_DEPTH_M),
            "reduced_order": (
                partial(deflected_mesh, basis=basis),
                not basis.invalid_reason(stretch, position, depth),
            ),
            "membrane": (elements, True),
        }
        truth = reference(scene, *edges, tip)
        case: Case = {"stretch": stretch, "depth_mm": 1e3 * depth, "position": where}
        for method, (shape, in_range) in shapes.items():
            yield Trial(
                method=method,
                case=case,
                run=partial(shape, sheet),
                error=partial(height_error_mm, truth=truth),
                in_range=in_range,
                size={"triangles": len(shape(sheet).triangles)} if method != "membrane" else {},
            )


def height_error_mm(mesh: SheetMesh, *, truth: Floats) -> float:
    """Return the rms error of the height (world z) of a mesh, in mm.

    truth (n, 3): points (m) of the reference sheet.
    """
    heights = LinearNDInterpolator(mesh.vertices[:, :2], mesh.vertices[:, 2])(truth[:, :2])
    errors = (heights - truth[:, 2])[np.isfinite(heights)]
    return 1e3 * float(np.sqrt(np.mean(errors**2)))
