"""Compute the force over depth of a pushed cylinder with the finite-element library felupe.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.force_reference [SCENE_FILE] [--output FILE]

The stored result is the independent reference of `flexsheet experiment compliance`. It uses the
material law of the scene's object and a rigid, frictionless sphere, but no code of flexsheet's soft
body. Elements (27-node hexahedra), assembly and material come from felupe, the mesh from
`benchmarks.hexahedra`, and the linear solver is Pardiso. `combine_runs` describes how the meshes
give the force and its uncertainty. All lengths are in finger radii, forces in Young's modulus times
the square of the finger radius.

felupe (GPL) and pypardiso are tools for development, not dependencies: `pip install felupe
pypardiso`. A run takes a few minutes of one core. Curves that FILE already contains are not
solved again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hexahedra import HexMesh, cylinder_hexahedra
from flexsheet.launch.experiments.compliance import POSITIONS_M
from flexsheet.launch.experiments.force_reference import REFERENCE_FILE
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Cylinder, Scene, StripSupport, require_material
from flexsheet.nodes.arrays import Floats

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
PENALTY, STIFFER = 1000.0, 4000.0
"""Stiffness of the contact (pressure per penetration), in Young's modulus per finger radius. The
results for both values give an estimate of the error of the penalty."""
DEPTHS = tuple(depth / 7.0 for depth in (0.5, 1.0, 2.0, 3.5, 6.0, 10.0, 13.0, 16.0))
SCALES = (3.0, 2.0, 1.4)
"""The scales of the element sizes, from the coarsest to the finest mesh."""
ORDER = 2.0
INTERRUPTED = "interrupted"
CURVE_KEYS = (
    "radius",
    "length",
    "support_angle_rad",
    "poisson_ratio",
    "along",
    "angle_rad",
)
POINTS_PER_EDGE = 6
TOLERANCE, MAX_ITERATIONS = 1e-4, 25
MAX_STEP, MIN_FRACTION = 0.3, 1.0 / 16.0
"""The maximum load step (finger radii), and the minimum load step per depth step."""


@dataclass(frozen=True, slots=True)
class Push:
    """The inputs of one force curve (lengths in finger radii).

    along, angle_rad: pushed position along and around the axis. scale: factor of all element sizes.
    penalty: stiffness of the contact, see `PENALTY`.
    """

    radius: float
    length: float
    support_angle_rad: float
    poisson_ratio: float
    along: float
    angle_rad: float
    scale: float
    penalty: float


def make_mesh(push: Push) -> HexMesh:
    """Return the mesh of the cylinder that is fine near the pushed position."""
    return cylinder_hexahedra(
        radius=push.radius,
        length=push.length,
        support_angle_rad=push.support_angle_rad,
        along=push.along,
        angle_rad=push.angle_rad,
        scale=push.scale,
    )


class SphereContact:
    """A penalty contact of a rigid sphere of radius 1 with nine-node faces."""

    def __init__(self, mesh: HexMesh, penalty: float) -> None:
        points, weights = np.polynomial.legendre.leggauss(POINTS_PER_EDGE)
        a, b = (grid.ravel() for grid in np.meshgrid(points, points, indexing="ij"))
        self._shape = _quadratic(a)[:, :, None] * _quadratic(b)[:, None, :]
        slopes = (
            _quadratic_slope(a)[:, :, None] * _quadratic(b)[:, None, :],
            _quadratic(a)[:, :, None] * _quadratic_slope(b)[:, None, :],
        )
        nodes = mesh.points[mesh.faces]
        sides = [np.einsum("qij,fijk->fqk", slope, nodes) for slope in slopes]
        area = np.linalg.norm(np.cross(*sides), axis=2)
        self._stiffness = penalty * area * np.outer(weights, weights).ravel()
        self._faces = mesh.faces.reshape(-1, 9)
        self._shape = self._shape.reshape(-1, 9)
        self._count = mesh.points.size

    def _inside(self, positions: Floats, centre: Floats) -> tuple[Any, ...]:
        offset = np.einsum("qa,fak->fqk", self._shape, positions[self._faces]) - centre
        distance = np.linalg.norm(offset, axis=2)
        face, point = np.nonzero(distance < 1.0)
        away = distance[face, point]
        return face, point, 1.0 - away, offset[face, point] / away[:, None], away

    def energy(self, positions: Floats, centre: Floats) -> float:
        face, point, depth, _, _ = self._inside(positions, centre)
        return 0.5 * float(self._stiffness[face, point] @ depth**2)

    def forces(self, positions: Floats, centre: Floats) -> Floats:
        """Return the gradient (n, 3) of the energy."""
        face, point, depth, normal, _ = self._inside(positions, centre)
        pressure = -(self._stiffness[face, point] * depth)[:, None] * normal
        result = np.zeros_like(positions)
        np.add.at(result, self._faces[face], self._shape[point][:, :, None] * pressure[:, None, :])
        return result

    def tangent(self, positions: Floats, centre: Floats, turning: float) -> Any:
        """Return the second derivative of the energy as a sparse matrix.

        turning: weight of the indefinite part of the matrix.
        """
        from scipy.sparse import coo_matrix

        face, point, depth, normal, away = self._inside(positions, centre)
        outer = normal[:, :, None] * normal[:, None, :]
        block = outer - turning * (depth / away)[:, None, None] * (np.eye(3) - outer)
        block *= self._stiffness[face, point][:, None, None]
        shape = self._shape[point]
        values = np.einsum("qa,qb,qij->qaibj", shape, shape, block)
        rows = (3 * self._faces[face][:, :, None] + np.arange(3)).reshape(len(face), 27)
        i, j = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
        size = (self._count, self._count)
        return coo_matrix((values.ravel(), (i.ravel(), j.ravel())), shape=size).tocsr()


class FelupeBody:
    """A Neo-Hookean cylinder of felupe with the contact of a rigid sphere.

    isochoric: use a law that separates the change of volume from the change of shape.
    """

    def __init__(self, push: Push, *, isochoric: bool = False) -> None:
        import felupe
        from pypardiso import PyPardisoSolver

        self.mesh = make_mesh(push)
        nu = push.poisson_ratio
        shear, bulk = 0.5 / (1.0 + nu), 1.0 / (3.0 * (1.0 - 2.0 * nu))
        self._law = (
            felupe.NeoHooke(mu=shear, bulk=bulk)
            if isochoric
            else felupe.NeoHookeCompressible(mu=shear, lmbda=bulk - 2.0 / 3.0 * shear)
        )
        grid = felupe.Mesh(self.mesh.points, self.mesh.cells, "hexahedron27")
        self._region = felupe.RegionTriQuadraticHexahedron(grid)
        if self._region.dV.min() <= 0.0:
            raise ValueError(f"the hexahedra of {push} are inverted; change the scale")
        self._field = felupe.FieldContainer([felupe.Field(self._region, dim=3)])
        self._solid = felupe.SolidBody(self._law, self._field)
        self._contact = SphereContact(self.mesh, push.penalty)
        self._free = np.flatnonzero(~self.mesh.held.ravel())
        self._pardiso = PyPardisoSolver(mtype=-2)
        normal = np.array([0.0, np.sin(push.angle_rad), np.cos(push.angle_rad)])
        self._surface = push.radius * normal + np.array([push.along, 0.0, 0.0])
        self._normal = normal

    def energy(self, moved: Floats, centre: Floats) -> float:
        self._field[0].values[:] = moved
        gradient = self._field.extract()[0]
        if np.linalg.det(np.moveaxis(gradient, (0, 1), (-2, -1))).min() <= 0.0:
            return np.inf
        elastic = float((self._law.function([gradient])[0] * self._region.dV).sum())
        return elastic + self._contact.energy(self.mesh.points + moved, centre)

    def residual(self, moved: Floats, centre: Floats) -> tuple[Floats, float]:
        """Return the unbalanced forces on the free degrees of freedom and the largest force."""
        self._field[0].values[:] = moved
        inner = self._solid.assemble.vector(self._field).toarray().reshape(-1, 3)
        outer = self._contact.forces(self.mesh.points + moved, centre)
        scale = max(float(np.abs(inner).max()), float(np.abs(outer).max()))
        return (inner + outer).ravel()[self._free], scale

    def step(self, moved: Floats, centre: Floats, right: Floats, turning: float) -> Floats:
        """Return the displacement (n, 3) that the tangent stiffness gives for forces `right`."""
        from scipy.sparse import triu

        self._field[0].values[:] = moved
        matrix = self._solid.assemble.matrix(self._field).tocsr()
        matrix = matrix + self._contact.tangent(self.mesh.points + moved, centre, turning)
        matrix = triu(matrix[self._free][:, self._free], format="csr")
        result = np.zeros(self.mesh.points.size)
        result[self._free] = self._pardiso.solve(matrix, right)
        return result.reshape(-1, 3)

    def equilibrium(self, moved: Floats, centre: Floats) -> Floats | None:
        """Return the displacement (n, 3) for a sphere at `centre`, or None without convergence."""
        energy = self.energy(moved, centre)
        for _ in range(MAX_ITERATIONS):
            right, scale = self.residual(moved, centre)
            if np.abs(right).max() <= TOLERANCE * scale:
                return moved
            for turning in (1.0, 0.0):
                step = self.step(moved, centre, -right, turning)
                slope = float(right @ step.ravel()[self._free])
                if slope < 0.0:
                    break
            fraction = 1.0
            while not (
                now := self.energy(moved + fraction * step, centre)
            ) <= energy + 1e-4 * fraction * slope + 1e-13 * abs(energy):
                fraction *= 0.5
                if fraction < 1e-4:
                    return None
            moved, energy = moved + fraction * step, now
        return None

    def centre(self, depth: float) -> Floats:
        return np.asarray(self._surface + (1.0 - depth) * self._normal)

    def solve(self, depths: Sequence[float]) -> Iterator[float]:
        """Yield the normal forces at the depths, until a solution does not converge."""
        moved, at = np.zeros_like(self.mesh.points), 0.0
        for depth in depths:
            start, done = at, 0.0
            fraction = 1.0 / np.ceil((depth - at) / MAX_STEP)
            while done < 1.0 and fraction >= MIN_FRACTION:
                share = min(fraction, 1.0 - done)
                target = start + (done + share) * (depth - start)
                found = self.equilibrium(self._predict(moved, at, target), self.centre(target))
                if found is None:
                    fraction *= 0.5
                    continue
                moved, at, done = found, target, done + share
            if done < 1.0:
                return
            pressed = self._contact.forces(self.mesh.points + moved, self.centre(at))
            yield self.mesh.copies * float(pressed.sum(axis=0) @ self._normal)

    def _predict(self, moved: Floats, at: float, target: float) -> Floats:
        """Return `moved`, extrapolated linearly to a depth if this lowers the energy."""
        if at == 0.0:
            return moved
        here, there = self.centre(at), self.centre(at + 1e-4)
        change, _ = self.residual(moved, there)
        guess = moved + self.step(moved, here, -change, 1.0) * (target - at) / 1e-4
        centre = self.centre(target)
        return guess if self.energy(guess, centre) < self.energy(moved, centre) else moved


def _quadratic(t: Floats) -> Floats:
    return np.stack([0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)], axis=-1)


def _quadratic_slope(t: Floats) -> Floats:
    return np.stack([t - 0.5, -2.0 * t, t + 0.5], axis=-1)


def reference_pushes(scene: Scene) -> list[Push]:
    """Return the pushes for the reference of a scene with a cylinder."""
    geometry, support = scene.object.geometry, scene.object.support
    if not (isinstance(geometry, Cylinder) and isinstance(support, StripSupport)):
        raise SystemExit("the force reference needs a cylinder on a strip; choose another scene")
    finger = scene.finger.radius_m
    places = [(along / finger, around / geometry.radius_m) for along, around in POSITIONS_M]
    runs = [(places[0], scale, PENALTY) for scale in SCALES]
    runs += [(place, SCALES[0], PENALTY) for place in places[1:]]
    runs += [(places[0], SCALES[1], STIFFER)]
    runs += [(place, SCALES[1], PENALTY) for place in places[1:]]
    return [
        Push(
            radius=geometry.radius_m / finger,
            length=geometry.length_m / finger,
            support_angle_rad=support.angle_rad,
            poisson_ratio=require_material(scene).poisson_ratio,
            along=along,
            angle_rad=angle_rad,
            scale=scale,
            penalty=penalty,
        )
        for (along, angle_rad), scale, penalty in runs
    ]


def solve_runs(pushes: Sequence[Push], output: Path) -> None:
    """Solve the pushes without a complete force curve in the file, and store each depth."""
    runs = json.loads(output.read_text())["runs"] if output.exists() else []
    for push in pushes:
        inputs = asdict(push)
        if any(run["inputs"] == inputs and run["end"] != INTERRUPTED for run in runs):
            continue
        body, start_s = FelupeBody(push), time.process_time()
        run: dict[str, Any] = {
            "inputs": inputs,
            "nodes": len(body.mesh.points),
            "forces": [],
            "end": INTERRUPTED,
        }
        others = [one for one in runs if one["inputs"] != inputs]
        for force in body.solve(DEPTHS):
            run["forces"].append(round(force, 6))
            run["cpu_s"] = round(time.process_time() - start_s)
            if len(run["forces"]) == len(DEPTHS):
                run["end"] = "complete"
            write_result([*others, run], output)
            print(f"{push}, {run['nodes']} nodes: {run['forces']}, {run['cpu_s']} s")
        if len(run["forces"]) < len(DEPTHS):
            run["end"] = "Newton's method did not converge at the next depth"
        runs = [*others, run]
        write_result(runs, output)


def write_result(runs: list[dict[str, Any]], output: Path) -> None:
    """Write the runs, and the force curves computed from the runs."""
    result = {
        "command": "python -m benchmarks.force_reference",
        "method": "NeoHookeCompressible, 27-node hexahedra, penalty contact of a rigid sphere",
        "units": "lengths in finger radii, forces in Young's modulus times squared finger radius",
        "versions": {name: version(name) for name in ("felupe", "pypardiso", "numpy", "scipy")},
        "curves": combine_runs(runs),
        "runs": runs,
    }
    output.write_text(json.dumps(result, indent=1) + "\n")


def combine_runs(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a force curve for each position that was solved.

    At the first position, the force is extrapolated from the two finest meshes with the order
    `ORDER` of convergence. Its uncertainty is the difference from the force of the finest mesh.
    At depths that were not solved on the finest mesh, the force of the second mesh is multiplied
    by the correction at the last common depth; the uncertainty is the whole correction. At other
    positions, the force on a coarser mesh is multiplied by the ratio of the extrapolated force to
    the force on that mesh at the first position, since the elements at the finger are the same. A
    quarter of the correction is added to the uncertainty, and so is the effect of a stiffer
    contact where it was computed (all as squares).
    """

    def find(place: dict[str, Any], scale: float, penalty: float = PENALTY) -> Floats:
        wanted = {**place, "scale": scale, "penalty": penalty}
        found = (run["forces"] for run in runs if run["inputs"] == wanted)
        return np.array(next(found, []))

    places = [{key: run["inputs"][key] for key in CURVE_KEYS} for run in runs]
    first, *others = [place for number, place in enumerate(places) if place not in places[:number]]
    coarse, fine = find(first, SCALES[1]), find(first, SCALES[2])
    common = min(len(coarse), len(fine))
    if not common:
        return []
    step = (coarse[:common] - fine[:common]) / ((SCALES[1] / SCALES[2]) ** ORDER - 1.0)
    ratio = np.full(len(coarse), (fine[common - 1] - step[-1]) / coarse[common - 1])
    ratio[:common] = (fine[:common] - step) / coarse[:common]
    best, spread = coarse * ratio, np.abs(1.0 - ratio)
    spread[:common] = np.abs(step) / fine[:common]
    stiff = find(first, SCALES[1], STIFFER)[: len(coarse)]
    contact = np.append(stiff / coarse[: len(stiff)] - 1.0, np.zeros(len(coarse) - len(stiff)))
    spread = np.hypot(spread, contact)
    curves = [_make_curve(first, best, spread)]
    for place in others:
        scale = max(SCALES, key=lambda scale: (len(find(place, scale)), -scale))
        here, there = find(place, scale), find(first, scale)
        count = min(len(here), len(there), len(best))
        transfer = best[:count] / there[:count]
        doubt = np.hypot(spread[:count], 0.25 * (transfer - 1.0))
        curves.append(_make_curve(place, here[:count] * transfer, doubt))
    return curves


def _make_curve(place: dict[str, Any], forces: Floats, uncertainty: Floats) -> dict[str, Any]:
    return {
        **place,
        "depths": [round(depth, 6) for depth in DEPTHS[: len(forces)]],
        "forces": [round(float(one), 5) for one in forces],
        "uncertainty_ratio": [round(float(one), 4) for one in uncertainty],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, default=SCENE_FILE)
    parser.add_argument("--output", type=Path, default=REFERENCE_FILE)
    arguments = parser.parse_args()
    solve_runs(reference_pushes(load_scene(arguments.scene)), arguments.output)


if __name__ == "__main__":
    main()
