"""Generate the mesh of a synthetic organ: two lobes, a wedge between them, and a shallow groove.

python -m benchmarks.organ launch/scenes/organ.obj

Lengths in the file are millimetres; the front is towards +z.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints

SUBDIVISIONS = 3
HALF_MM = (62.0, 42.0, 30.0)
TAPER_Y, TAPER_Z = 0.2, 0.25
"""The relative decrease of the organ's size from its middle to its thin end."""
FURROW_AT, FURROW_WIDTH, FURROW_MM = 0.2, 0.3, 4.0


def organ_mesh() -> tuple[Floats, Ints]:
    """Return vertices (v, 3) in mm and triangles (t, 3), counter-clockwise seen from outside."""
    # Imported late: only the generator needs it.
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS, radius=1.0)
    u, v, w = np.asarray(ball.vertices).T
    front = (0.5 * (1.0 + w)) ** 2
    furrow = FURROW_MM * np.exp(-(((u - FURROW_AT) / FURROW_WIDTH) ** 2)) * front
    vertices = np.column_stack(
        [
            HALF_MM[0] * u,
            HALF_MM[1] * v * (1.0 - TAPER_Y * u),
            HALF_MM[2] * w * (1.0 - TAPER_Z * u) - furrow,
        ]
    )
    return vertices, np.asarray(ball.faces, dtype=np.int64)


def obj_text(vertices: Floats, triangles: Ints) -> str:
    """Format the mesh as a Wavefront OBJ file, with a resolution of 0.01 units."""
    lines = ["# made by python -m benchmarks.organ; millimetres"]
    lines += [f"v {x:.2f} {y:.2f} {z:.2f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    return "\n".join(lines) + "\n"


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python -m benchmarks.organ FILE.obj")
    Path(sys.argv[1]).write_text(obj_text(*organ_mesh()), encoding="utf-8")


if __name__ == "__main__":
    main()
