"""Compare felupe's force with that of CalculiX, as a second witness of the force reference.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.calculix_witness [--scale 3]

Both push the front of the demo's cylinder with the same isochoric neo-Hookean law, because CalculiX
has no other. CalculiX has 20-node hexahedra, made from the corners and edges of felupe's, its own
contact of surface to surface, and a meshed rigid cap for the finger. Needs the command `ccx` (on
Debian: `apt-get install calculix-ccx`) and felupe. The result is stored in the file of the force
reference.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.force_reference import SCENE_FILE, FelupeBody, Push, reference_pushes
from benchmarks.hexahedra import HexMesh
from flexsheet.launch.experiments.force_reference import REFERENCE_FILE
from flexsheet.launch.plans.plan import load_scene

Floats = NDArray[np.float64]

DEPTHS = (0.25, 0.5, 0.857143)
CAP_RAD, CAP_CELLS, CAP_THICKNESS = 1.2, 40, 0.2
"""Half angle of the rigid cap, number of elements along its sides, and its thickness."""
SLOPE = 1000.0


def make_cap(centre: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return nodes (n, 3) and hexahedra (e, 8) of a cap of the unit sphere; face 1 is outside."""
    angles = np.linspace(-CAP_RAD, CAP_RAD, CAP_CELLS + 1)
    a, b = np.meshgrid(np.tan(angles), np.tan(angles), indexing="ij")
    outward = np.stack([a, b, -np.ones_like(a)], axis=-1)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    layers = np.stack([outward, (1.0 - CAP_THICKNESS) * outward])
    numbers = np.arange(layers[..., 0].size).reshape(layers.shape[:3])
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    cells = np.stack(
        [
            numbers[layer, i : i + CAP_CELLS, j : j + CAP_CELLS].ravel()
            for layer in (0, 1)
            for i, j in corners
        ],
        axis=-1,
    )
    return centre + layers.reshape(-1, 3), cells


def write_input(mesh: HexMesh, push: Push, path: Path) -> None:
    """Write the input file of CalculiX."""
    surface = np.array([push.along, 0.0, push.radius])
    cap, cap_cells = make_cap(surface + np.array([0.0, 0.0, 1.0]))
    count = len(mesh.points)
    reference, rotation = count + len(cap) + 1, count + len(cap) + 2
    shear = 0.5 / (1.0 + push.poisson_ratio)
    bulk = 1.0 / (3.0 * (1.0 - 2.0 * push.poisson_ratio))
    used = np.unique(mesh.cells[:, :20])
    top = np.flatnonzero(np.isin(mesh.cells[:, 25], mesh.faces[:, 1, 1]))

    def rows(values: Iterable[Iterable[object]]) -> list[str]:
        return [", ".join(map(str, row)) for row in values]

    lines = ["*NODE, NSET=BODY", *rows((n + 1, *mesh.points[n]) for n in used)]
    lines += ["*NODE, NSET=CAP", *rows((count + n + 1, *point) for n, point in enumerate(cap))]
    lines += ["*NODE, NSET=REF", f"{reference}, 0, 0, {surface[2] + 1.0}"]
    lines += ["*NODE, NSET=ROT", f"{rotation}, 0, 0, {surface[2] + 1.0}"]
    lines.append("*ELEMENT, TYPE=C3D20R, ELSET=SOFT")
    for number, cell in enumerate(mesh.cells[:, :20] + 1):
        lines.append(", ".join(map(str, (number + 1, *cell[:10]))) + ",")
        lines.append(", ".join(map(str, cell[10:])))
    first = len(mesh.cells) + 1
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=RIGID"]
    lines += rows((first + n, *(cell + count + 1)) for n, cell in enumerate(cap_cells))
    lines += ["*SURFACE, NAME=SKIN", *rows((n + 1, "S2") for n in top)]
    lines += ["*SURFACE, NAME=FINGER", *rows((first + n, "S1") for n in range(len(cap_cells)))]
    lines += ["*MATERIAL, NAME=RUBBER", "*HYPERELASTIC, NEO HOOKE", f"{0.5 * shear}, {2.0 / bulk}"]
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "1000., 0.3"]
    lines += ["*SOLID SECTION, ELSET=SOFT, MATERIAL=RUBBER"]
    lines += ["*SOLID SECTION, ELSET=RIGID, MATERIAL=STEEL"]
    lines += [f"*RIGID BODY, NSET=CAP, REF NODE={reference}, ROT NODE={rotation}"]
    lines += ["*SURFACE INTERACTION, NAME=TOUCH", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"]
    lines += [f"{SLOPE}", "*CONTACT PAIR, INTERACTION=TOUCH, TYPE=SURFACE TO SURFACE"]
    lines += ["SKIN, FINGER", "*BOUNDARY"]
    held = mesh.held[used]
    lines += [
        f"{n + 1}, {axis + 1}"
        for n, row in zip(used, held, strict=True)
        for axis in range(3)
        if row[axis]
    ]
    lines += [f"{reference}, 1, 2", f"{rotation}, 1, 3"]
    for depth in DEPTHS:
        lines += ["*STEP, NLGEOM, INC=200", "*STATIC", "0.25, 1., 1e-4, 0.5"]
        lines += ["*BOUNDARY", f"{reference}, 3, 3, {-depth}"]
        lines += ["*NODE PRINT, NSET=REF", "RF", "*END STEP"]
    path.write_text("\n".join(lines) + "\n")


def solve_with_calculix(mesh: HexMesh, push: Push) -> list[float]:
    """Return the normal forces of the whole cylinder at `DEPTHS`."""
    with tempfile.TemporaryDirectory() as folder:
        write_input(mesh, push, Path(folder) / "push.inp")
        done = subprocess.run(
            ["ccx", "push"], cwd=folder, capture_output=True, text=True, check=False
        )
        path = Path(folder) / "push.dat"
        lines = path.read_text().split("\n") if path.exists() else []
        if not lines or "Job finished" not in done.stdout:
            raise SystemExit(f"CalculiX did not converge:\n{done.stdout[-1500:]}")
    # The last increment of each step has an integer time.
    forces = {}
    for number, line in enumerate(lines):
        if "forces" in line:
            forces[float(line.split()[-1])] = abs(float(lines[number + 2].split()[-1]))
    return [mesh.copies * forces[float(step)] for step in range(1, len(DEPTHS) + 1)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", type=float, default=3.0)
    scale = parser.parse_args().scale
    push = replace(reference_pushes(load_scene(SCENE_FILE))[0], scale=scale, penalty=SLOPE)
    body = FelupeBody(push, isochoric=True)
    first = list(body.solve(DEPTHS))
    second = solve_with_calculix(body.mesh, push)
    content = json.loads(REFERENCE_FILE.read_text())
    content["witness"] = {
        "command": "python -m benchmarks.calculix_witness",
        "law": "isochoric neo-Hookean",
        "scale": scale,
        "depths": DEPTHS,
        "felupe": [round(force, 6) for force in first],
        "calculix": [round(force, 6) for force in second],
        "difference_percent": [
            round(100.0 * (b / a - 1.0), 2) for a, b in zip(first, second, strict=True)
        ],
    }
    REFERENCE_FILE.write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content["witness"]))


if __name__ == "__main__":
    main()
