"""Tabulate the force of the simulated sheet on a finger.

The force is needed every millisecond, but the membrane model takes a tenth of a second per push.
The table contains the normal force of pushes along the sheet's normal. The force is the product of
two factors. The first factor is the force at the sheet's centre for several stretch ratios. The
second factor is the ratio of the force at other positions to the force at the centre, for the mean
stretch ratio.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.cache import Specification, cached, encode_fields
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.twin.membrane import NotConvergedError, TrueRubber, solve
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.sheet_surface import lagrange
from flexsheet.nodes.twin.truth import apply_apparatus

VERSION = 1
"""The version of the computation. Cached tables of other versions are computed again."""

CELLS = 16
"""The number of intervals between nodes along each side of the sheet. With 32 intervals, the force
differs by 1 to 4 %."""

DEPTH_FRACTIONS = np.array([0.04, 0.12, 0.25, 0.45, 0.7, 1.0])
"""The depths of the computed pushes, as fractions of the scene's maximum push depth."""

POSITION_FRACTIONS = np.array([0.0, 0.2, 0.375])
"""The distances of the pushes from the sheet's centre, as fractions of its width and height."""

STRETCH_NODES = 3
STRETCH_MARGIN = 0.01
DEPTH_STEPS = 256


@dataclass(frozen=True, slots=True)
class SheetReaction:
    """A table of the normal force (N) of the sheet on a finger.

    The sheet is assumed to be symmetric about its centre lines. Positions are given by p distances
    from the centre, as fractions of the width or height (POSITION_FRACTIONS).

    width_m, height_m: width and height of the sheet at rest, each as an array with one element.
    stretches (s,): stretch ratios.
    depths_m (d,): depths in equal steps from 0.
    centre_n (s, d): force at the centre.
    ratios (p, p, d): force at other positions, divided by the force at the centre. The first index
        is the position along the width, the second along the height.
    """

    width_m: Floats
    height_m: Floats
    stretches: Floats
    depths_m: Floats
    centre_n: Floats
    ratios: Floats

    def curve_n(self, distance_m: float, x_m: float, y_m: float) -> Floats:
        """Return the normal forces (d,), N, at the depths `depths_m`; zero beside the sheet.

        distance_m: distance between the edges.
        x_m, y_m: position relative to the sheet's centre.
        """
        if abs(x_m) >= 0.5 * distance_m or abs(y_m) >= 0.5 * self.height_m[0]:
            return np.zeros(len(self.depths_m))
        stretch = np.clip(distance_m / self.width_m[0], self.stretches[0], self.stretches[-1])
        centre = lagrange(self.stretches, float(stretch)) @ self.centre_n
        last = POSITION_FRACTIONS[-1]
        # The force is an even function of both coordinates.
        across, along = (
            lagrange(POSITION_FRACTIONS**2, min(abs(fraction), last) ** 2)
            for fraction in (x_m / distance_m, y_m / self.height_m[0])
        )
        return np.asarray(centre * np.einsum("i,j,ijd->d", across, along, self.ratios))


def load_or_compute_reaction(
    scene: Scene, apparatus: Apparatus | None, cache_dir: Path | None = None
) -> SheetReaction:
    """Return the force table of a scene's true sheet from the cache, or compute it in 10 s.

    The weight of the sheet and the variation of its thickness are neglected.
    """
    true_scene = apply_apparatus(scene, apparatus)
    sheet = true_scene.sheet
    rubber = replace(
        true_rubber(sheet, apparatus), density_kg_per_m3=0.0, thickness_gradient=(0.0, 0.0)
    )
    low = max(sheet.min_stretch_ratio - STRETCH_MARGIN, 1.005)
    stretches = np.linspace(low, sheet.max_stretch_ratio + STRETCH_MARGIN, STRETCH_NODES)
    depths_m = scene.working_range.push_depth_m * DEPTH_FRACTIONS
    radius_m = true_scene.finger.radius_m
    depends_on = {
        "version": VERSION,
        "rubber": asdict(rubber),
        "stretches": stretches.tolist(),
        "depths_m": depths_m.tolist(),
        "finger_radius_m": radius_m,
    }
    specification: Specification[SheetReaction] = Specification(
        "sheet-reaction", depends_on, encode_fields, lambda content: SheetReaction(**content)
    )
    return cached(
        specification,
        cache_dir,
        lambda: compute_reaction(rubber, stretches, depths_m, finger_radius_m=radius_m),
    )


def compute_reaction(
    rubber: TrueRubber, stretches: Floats, depths_m: Floats, *, finger_radius_m: float
) -> SheetReaction:
    """Compute a table of the sheet's force on the finger with the membrane model.

    stretches: stretch ratios (s,).
    depths_m: push depths (n,) in ascending order.

    If the iteration does not converge, the force is extrapolated. Raises NotConvergedError if it
    does not converge for one of the first two depths.
    """

    def push_n(stretch: float, across: float, along: float) -> Floats:
        """Return the normal forces (n,), N, of a push at all n depths.

        across, along: position relative to the sheet's centre, as fractions of the sheet's width
            and height.
        """
        half_m = 0.5 * stretch * rubber.width_m
        edges = [transform(np.eye(3), [side * half_m, 0.0, 0.0]) for side in (-1.0, 1.0)]
        at = 2.0 * across * half_m, along * rubber.height_m
        forces: list[float] = []
        for depth in depths_m:
            tip = np.array([*at, -depth])
            try:
                pushed = solve(
                    rubber, *edges, finger_tip=tip, finger_radius_m=finger_radius_m, cells=CELLS
                )
            except NotConvergedError:
                # Deep pushes near a clamp have no solution; extrapolate with the last slope.
                if len(forces) < 2:
                    raise
                slope = (forces[-1] - forces[-2]) / np.diff(depths_m)[len(forces) - 2]
                forces.append(forces[-1] + slope * np.diff(depths_m)[len(forces) - 1])
                continue
            forces.append(float(pushed.finger_force_n[2]))
        return np.array(forces)

    fine_m = np.linspace(0.0, depths_m[-1], DEPTH_STEPS)

    def refine(values: Floats) -> Floats:
        return np.asarray(
            scipy.interpolate.PchipInterpolator(depths_m, values)(np.maximum(fine_m, depths_m[0]))
        )

    centre = [push_n(stretch, 0.0, 0.0) for stretch in stretches]
    middle = len(stretches) // 2
    ratios = [
        [
            refine(
                push_n(stretches[middle], x, y) / centre[middle]
                if x or y
                else np.ones(len(depths_m))
            )
            for y in POSITION_FRACTIONS
        ]
        for x in POSITION_FRACTIONS
    ]
    stiffness = np.array([refine(forces / depths_m) for forces in centre])
    return SheetReaction(
        np.array([rubber.width_m]),
        np.array([rubber.height_m]),
        stretches,
        fine_m,
        stiffness * fine_m,
        np.array(ratios),
    )
