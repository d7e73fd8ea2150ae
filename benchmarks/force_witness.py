"""Compare the stored force reference with the finite-element program CalculiX.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.force_witness [SCENE_FILE] [--json]

CalculiX solves the push of the reference's first position with its own 20-node hexahedra, contact
(surface to surface) and equation solver, on two meshes. The force is extrapolated from both with
the order of convergence of the reference. The neo-Hookean law of CalculiX separates the change of
volume from the change of shape; the law of the reference does not. Therefore felupe solves one mesh
with both laws, and the ratio of these forces converts the force of CalculiX. Lengths are in finger
radii, forces in Young's modulus times squared finger radius.

CalculiX (the program `ccx`, Debian package `calculix-ccx`, GPL), felupe and pypardiso are tools for
development, not dependencies. A run takes about 10 minutes of one core.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.force_reference import (
    DEPTHS,
    ORDER,
    SCALES,
    SCENE_FILE,
    FelupeBody,
    Push,
    make_mesh,
    reference_pushes,
)
from benchmarks.hexahedra import HexMesh
from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.experiments.force_reference import find_reference_curve
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.arrays import Floats, Ints

MAX_DEPTH = 1.5
"""Maximum depth, in finger radii, at which the programs are compared."""
SUMMARY_DEPTH_MM = 2.0
"""Minimum depth of the summary. At smaller depths, the two meshes are too coarse."""
MESHES = SCALES[:2]
"""Scales of the two meshes."""
SUBDIVISIONS = 4
"""Subdivisions of the icosahedron that represents the finger."""
SHELL_RATIO = 0.9
"""Inner radius of the shell of wedges that represents the finger, divided by the outer radius."""
INCREMENT = 0.1
"""First increment of each load step, as a fraction of the step."""


class WitnessError(RuntimeError):
    """Raised if a solver is missing or does not converge."""


def make_finger(subdivisions: int) -> tuple[Floats, Ints]:
    """Return points (n, 3) and triangles (m, 3) of a sphere with the volume of the unit sphere."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    ball.apply_scale((4.0 * np.pi / 3.0 / ball.volume) ** (1.0 / 3.0))
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def write_deck(mesh: HexMesh, push: Push, centre: Floats, depths: Sequence[float]) -> str:
    """Return the input of CalculiX for pushes to the depths, one load step each.

    centre (3,): centre of the finger at depth 0.
    """
    normal = centre / np.linalg.norm(centre[1:])
    normal[0] = 0.0
    cells = mesh.cells[:, :20]
    used = np.unique(cells)
    skin = set(mesh.faces.ravel().tolist())
    touched = [
        number for number, cell in enumerate(cells, 1) if skin.issuperset(cell[4:8].tolist())
    ]
    sphere, triangles = make_finger(SUBDIVISIONS)
    triangles = triangles[(sphere[triangles] @ normal).min(axis=1) < 0.1]
    kept, triangles = np.unique(triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    first = len(mesh.points) + 1
    outer = first + np.arange(len(kept))
    inner = outer + len(kept)
    shear = 0.5 / (1.0 + push.poisson_ratio)
    bulk = 1.0 / (3.0 * (1.0 - 2.0 * push.poisson_ratio))
    wedges = np.hstack([inner[triangles], outer[triangles]])
    shell = [centre + ratio * sphere[kept] for ratio in (1.0, SHELL_RATIO)]
    lines = [
        "*NODE, NSET=NBODY", *_rows(used + 1, mesh.points[used]),
        "*NODE, NSET=NBALL", *_rows(np.concatenate([outer, inner]), np.vstack(shell)),
        "*ELEMENT, TYPE=C3D20, ELSET=BODY", *_elements(1, cells + 1),
        "*ELEMENT, TYPE=C3D6, ELSET=BALL", *_elements(len(cells) + 1, wedges),
        "*MATERIAL, NAME=SOFT", "*HYPERELASTIC, NEO HOOKE",
        f"{0.5 * shear:.12g}, {2.0 / bulk:.12g}",
        "*SOLID SECTION, ELSET=BODY, MATERIAL=SOFT",
        "*SOLID SECTION, ELSET=BALL, MATERIAL=SOFT",
        "*SURFACE, NAME=SKIN, TYPE=ELEMENT", *(f"{number}, S2" for number in touched),
        "*SURFACE, NAME=FINGER, TYPE=ELEMENT",
        *(f"{len(cells) + 1 + number}, S2" for number in range(len(wedges))),
        "*SURFACE INTERACTION, NAME=TOUCH", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR",
        f"{push.penalty:.12g}",
        "*CONTACT PAIR, INTERACTION=TOUCH, TYPE=SURFACE TO SURFACE", "SKIN, FINGER",
        "*BOUNDARY",
        *(f"{node + 1}, {axis + 1}" for node in used for axis in np.flatnonzero(mesh.held[node])),
    ]  # fmt: skip
    for depth in depths:
        shift = -depth * normal
        lines += [
            "*STEP, NLGEOM, INC=400", "*STATIC", f"{INCREMENT}, 1., 1e-5, 1.", "*BOUNDARY",
            *(f"NBALL, {axis}, {axis}, {value:.12g}" for axis, value in enumerate(shift, 1)),
            "*NODE PRINT, NSET=NBALL, TOTALS=ONLY, FREQUENCY=1000", "RF", "*END STEP",
        ]  # fmt: skip
    return "\n".join([*lines, ""])


def _rows(numbers: Ints, values: Floats) -> Iterable[str]:
    for number, (x, y, z) in zip(numbers, values, strict=True):
        yield f"{number}, {x:.12g}, {y:.12g}, {z:.12g}"


def _elements(first: int, nodes: Ints) -> Iterable[str]:
    """Yield the lines of elements, each with at most 16 numbers."""
    for number, row in enumerate(nodes.tolist(), first):
        names = [str(one) for one in (number, *row)]
        yield ", ".join(names[:15]) + ("," if len(names) > 15 else "")
        if len(names) > 15:
            yield ", ".join(names[15:])


def solve_with_calculix(push: Push, depths: Sequence[float]) -> list[float]:
    """Return the normal forces at the depths.

    Raises WitnessError if CalculiX is not installed or does not converge.
    """
    program = shutil.which("ccx")
    if program is None:
        raise WitnessError("`ccx` is not installed; install the package `calculix-ccx`")
    mesh = make_mesh(push)
    normal = np.array([0.0, np.sin(push.angle_rad), np.cos(push.angle_rad)])
    centre = (push.radius + 1.0) * normal + np.array([push.along, 0.0, 0.0])
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "push.inp").write_text(write_deck(mesh, push, centre, depths))
        done = subprocess.run(
            [program, "push"], cwd=folder, check=False, capture_output=True, text=True
        )
        results = Path(folder, "push.dat")
        forces = read_forces(results.read_text() if results.exists() else "")
    if len(forces) < len(depths):
        raise WitnessError(
            f"CalculiX solved {len(forces)} of {len(depths)} depths of {push}; its last lines: "
            f"{done.stdout[-600:]}"
        )
    return [mesh.copies * float(-force @ normal) for force in forces]


def read_forces(text: str) -> list[Floats]:
    """Return the reaction forces (3,) of the finger in a result file, one per load step."""
    totals = re.findall(r"total force \(fx,fy,fz\) for set NBALL.*\n\s*\n(.*)", text)
    return [np.array([float(one) for one in row.split()]) for row in totals]


def compare(scene: Scene, depths: Sequence[float]) -> list[dict[str, float]]:
    """Return a row for each depth: forces of CalculiX and of the reference, in N."""
    finger_m = scene.finger.radius_m
    unit_n = require_material(scene).young_modulus_pa * finger_m**2
    curve = find_reference_curve(scene, 0.0, 0.0)
    if curve is None:
        raise WitnessError("no curve is stored for the scene: run benchmarks.force_reference")
    first = reference_pushes(scene)[0]
    coarse, fine = (
        np.array(solve_with_calculix(replace(first, scale=scale), depths)) for scale in MESHES
    )
    extrapolated = fine - (coarse - fine) / ((MESHES[0] / MESHES[1]) ** ORDER - 1.0)
    laws = [
        np.array(list(FelupeBody(replace(first, scale=MESHES[1]), isochoric=law).solve(depths)))
        for law in (False, True)
    ]
    if min(map(len, laws)) < len(depths):
        raise WitnessError("felupe did not converge at all depths; reduce MAX_DEPTH")
    rows = []
    for depth, force, step, factor in zip(
        depths, extrapolated, fine / extrapolated - 1.0, laws[0] / laws[1], strict=True
    ):
        reference = curve.force(depth * finger_m)
        assert reference is not None, "the depths are those of the reference"
        witness_n = unit_n * float(force * factor)
        rows.append({
            "depth_mm": 1e3 * depth * finger_m,
            "calculix_n": witness_n,
            "calculix_uncertainty_percent": 100.0 * abs(float(step)),
            "reference_n": reference.force_n,
            "reference_uncertainty_percent": 100.0 * reference.uncertainty_ratio,
            "difference_percent": 100.0 * (witness_n / reference.force_n - 1.0),
        })  # fmt: skip
    return rows


def summarize(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the largest difference and the largest uncertainty from SUMMARY_DEPTH_MM on, in %."""
    deep = [row for row in rows if row["depth_mm"] > SUMMARY_DEPTH_MM - 0.01]
    return {
        "max_difference_percent": max(abs(row["difference_percent"]) for row in deep),
        "max_uncertainty_percent": max(row["calculix_uncertainty_percent"] for row in deep),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, default=SCENE_FILE)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    given = parser.parse_args()
    rows = compare(load_scene(given.scene), [depth for depth in DEPTHS if depth < MAX_DEPTH])
    if given.json:
        version = subprocess.run(["ccx", "-v"], capture_output=True, text=True, check=False).stdout
        print(json.dumps({"version": version.strip(), **summarize(rows), "rows": rows}))
        return
    print_rows(rows, as_json=False)


if __name__ == "__main__":
    main()
