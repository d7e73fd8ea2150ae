"""Measure how smooth and how fast the soft body is, by a fingertip that slides over its skin.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.soft_body [--table [--cold] [--spacing M]] [--json]

Without --table, linear bodies with several spacings of the skin are measured. With --table, the
nonlinear table of the demo's cylinder is measured: the errors of its force and of the forces of the
other methods against the stored force of an independent solver; its errors and those of the linear
method against Newton solutions on finer meshes, at points that it was not computed from; and the
same slides. With --cold, the table is first computed without a cache, which takes minutes, and then
read from the cache, to measure both times. --spacing is the distance of its skin nodes.

The fingertip moves 6 mm in each of three directions at constant depth, 0.02 mm per step. The result
contains for every mesh and depth the mean force (beside Hertz's), its range, the largest jump of
any skin node in a step, the stiffness, and the time of a step. Takes about a minute and 1.5 GiB.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.messaging import print_report
from flexsheet.launch.experiments.compliance import POSITIONS_M
from flexsheet.launch.experiments.force_reference import find_reference_curve
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.methods import SoftBodyChoice
from flexsheet.messages.scene import Scene, require_cylinder, require_material
from flexsheet.nodes.arrays import Floats, Singles
from flexsheet.nodes.cache import default_cache_dir
from flexsheet.nodes.fem_solver import body, precompute, snapshots
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery, locate
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.fem_solver.snapshot_interpolator import SurfaceLocator
from flexsheet.nodes.fem_solver.soft_body_factory import load_body, prepare_body
from flexsheet.nodes.fem_solver.table import TableSoftBody

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
DEMO_SPACING_M = 0.0045
REFERENCE_POSITIONS = ((0.004, 0.1), (0.021, 0.55))
"""The positions along the axis (m) and angles (rad) of points that are no samples of a table."""
REFERENCE_DEPTHS_M = (0.0005, 0.001, 0.0015, 0.002, 0.003, 0.004, 0.005, 0.007, 0.010)
"""The depths at which forces are compared with those of the independent solver."""
RANDOM_POINTS, RANDOM_WITHIN_M = 300, (0.03, 0.025)
"""The number of random points, and their maximum distances from the front along and around the
axis."""
REFERENCE_SPACING_RATIO = 0.3
"""The spacing of the reference mesh at the push in finger radii, finer than that of the table."""
SPACINGS_M = (0.006, 0.0045, 0.003, 0.0022)
DEPTHS_M = (0.0005, 0.001, 0.002, 0.003, 0.006, 0.010, 0.020)
HEADINGS_RAD = np.radians([0.0, 37.0, 90.0])
STEP_M, STEPS = 2e-5, 300
FROM_M = (0.004, 0.003)
MIN_TOUCH_ANGLE_RAD = 0.7
"""The touchable angle of the finest mesh in radians, which limits the size of the table."""


@dataclass(frozen=True, slots=True)
class Slides:
    """The results of a slide at one depth: values per step, and the maximum jump (m)."""

    force_n: Floats
    stiffness_n_per_m: Floats
    step_s: Floats
    jump_m: float


def places(heading_rad: float) -> Iterator[tuple[float, float]]:
    """Yield positions of the fingertip on the skin: along the axis, and around it (m)."""
    for i in range(STEPS):
        way = STEP_M * i
        yield FROM_M[0] + way * np.cos(heading_rad), FROM_M[1] + way * np.sin(heading_rad)


def evaluate_table(scene: Scene, spacing_m: float, *, cold: bool) -> dict[str, Any]:
    """Return the errors of a table, and results of slides.

    cold: whether the table is computed in a new folder first, without a cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        cache_dir = Path(folder) if cold else default_cache_dir()
        times_s = []
        for _ in range(2 if cold else 1):
            start = time.perf_counter()
            best, linear = load_bodies(scene, spacing_m, cache_dir)
            times_s.append(time.perf_counter() - start)
    report: dict[str, Any] = {"skin_nodes": len(best.rest)}
    if cold:
        report["ready_s"] = dict(zip(("cold", "warm"), times_s, strict=True))
    if isinstance(best.method, TableSoftBody):
        levels = np.quantile(best.method.reach_m, [0.0, 0.1, 0.5])
        names = ("all", "nine_in_ten", "half")
        report["reach_mm"] = dict(zip(names, (1e3 * levels).tolist(), strict=True))
    report["force_errors"] = find_force_errors(
        scene, {"linear": linear, "coarse": make_coarse(scene, spacing_m), "table": best}
    )
    mesh, radius_m = build_mesh(best.spec.mesh), require_cylinder(scene).radius_m
    report["pushes"] = []
    for along, angle in REFERENCE_POSITIONS:
        normal = np.array([0.0, np.sin(angle), np.cos(angle)])
        sample = snapshots.SamplePoint(radius_m * normal + np.array([along, 0.0, 0.0]), normal)
        report["pushes"] += evaluate_push(scene, mesh, sample, best, linear)
    report["worst_by_depth"] = find_worst(report["pushes"])
    report["slides"] = [evaluate_slides(scene, best, radius_m, depth_m) for depth_m in DEPTHS_M]
    report["max_step_p99_us"] = max(one["step_p99_us"] for one in report["slides"])
    return report


def find_worst(pushes: Sequence[Mapping[str, Any]]) -> list[dict[str, float]]:
    """Return the table's largest skin error at each depth, and its largest force error up to it."""
    of_table = [one for one in pushes if one["method"] == "table"]
    return [
        {
            "depth_mm": depth_mm,
            "skin_error_mm": max(
                one["skin_error_mm"] for one in of_table if one["depth_mm"] == depth_mm
            ),
            "force_error_to_here_percent": max(
                abs(one["force_error_percent"]) for one in of_table if one["depth_mm"] <= depth_mm
            ),
        }
        for depth_mm in sorted({one["depth_mm"] for one in of_table})
    ]


def load_bodies(
    scene: Scene, spacing_m: float, cache_dir: Path, *, complete_table: bool = True
) -> tuple[body.SceneBody, body.SceneBody]:
    """Return the nonlinear and the linear body, computed or read from a cache."""
    linear, table = (
        SoftBodyChoice(method=method, skin_spacing_m=spacing_m)
        for method in ("linear", "nonlinear_table")
    )
    prepare_body(scene, table, cache_dir, print_progress, complete_table=complete_table)
    best, other = (load_body(scene, one, cache_dir, print_progress) for one in (table, linear))
    return best, other


def make_coarse(scene: Scene, spacing_m: float) -> body.SceneBody:
    """Compute the coarse table of a scene, without the complete one."""
    with tempfile.TemporaryDirectory() as folder:
        return load_bodies(scene, spacing_m, Path(folder), complete_table=False)[0]


def find_force_errors(scene: Scene, bodies: Mapping[str, body.SceneBody]) -> list[dict[str, Any]]:
    """Return the relative error of the force of each method by depth, in percent.

    The reference is the stored force of an independent solver at three positions. At random points,
    the references are the force at the first position, and the force by the last method.
    """
    curves = [find_reference_curve(scene, *position) for position in POSITIONS_M]
    stored = np.array(
        [
            [
                force.force_n if curve and (force := curve.force(depth)) else np.nan
                for depth in REFERENCE_DEPTHS_M
            ]
            for curve in curves
        ]
    )
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_POINTS, 2)) * RANDOM_WITHIN_M
    forces = {
        name: (normal_forces(scene, one, POSITIONS_M), normal_forces(scene, one, points))
        for name, one in bodies.items()
    }
    best_n = [*forces.values()][-1][1]
    rows = []
    for name, (at_positions, at_points) in forces.items():
        ratios = {
            "min_percent": (at_positions / stored - 1.0).min(axis=0),
            "max_percent": (at_positions / stored - 1.0).max(axis=0),
            "random_p95_percent": np.quantile(np.abs(at_points / stored[0] - 1.0), 0.95, axis=0),
            "from_table_p95_percent": np.quantile(np.abs(at_points / best_n - 1.0), 0.95, axis=0),
        }
        rows += [
            {"method": name, "depth_mm": round(1e3 * depth, 3)}
            | {label: 100.0 * float(values[at]) for label, values in ratios.items()}
            for at, depth in enumerate(REFERENCE_DEPTHS_M)
        ]
    return rows


def normal_forces(
    scene: Scene, one: body.SceneBody, points: Sequence[tuple[float, float]] | Floats
) -> Floats:
    """Return the normal forces (n, k) at points (along and around the axis, m) and depths."""
    radius_m = require_cylinder(scene).radius_m
    forces = []
    for along, around in points:
        normal = np.array([0.0, np.sin(around / radius_m), np.cos(around / radius_m)])
        point = radius_m * normal + np.array([along, 0.0, 0.0])
        queries = [ContactQuery(point, normal, depth) for depth in REFERENCE_DEPTHS_M]
        forces.append([float(one.method.respond(query).force_n @ normal) for query in queries])
    return np.array(forces)


def print_progress(done: int, total: int, need: str) -> None:
    """Print progress on one line."""
    print(f"\r{100 * done // total:3d} % of {need}", end="", file=sys.stderr, flush=True)


def evaluate_push(
    scene: Scene,
    mesh: SolidMesh,
    sample: snapshots.SamplePoint,
    best: body.SceneBody,
    linear: body.SceneBody,
) -> Iterator[dict[str, Any]]:
    """Yield the maximum error away from the finger and the force error, by depth and method."""
    job = snapshots.make_snapshot_job(
        best.spec.mesh,
        mesh,
        sample,
        poisson_ratio=best.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        spacing_m=REFERENCE_SPACING_RATIO * scene.finger.radius_m,
    )
    solved = snapshots.solve_snapshot(job)
    nodes, weights = SurfaceLocator(solved.rest, solved.faces).weights(best.rest)
    away = np.linalg.norm(best.rest - sample.point, axis=1) > 1.5 * scene.finger.radius_m
    for level in range(solved.reached):
        depth_m = float(solved.depths_m[level])
        wanted = np.einsum("qa,qai->qi", weights, solved.moved[level][nodes])
        modulus = require_material(scene).young_modulus_pa
        force_n = modulus * float(solved.force_n[level] @ sample.normal)
        for name, one in (("table", best), ("linear", linear)):
            answer = one.method.respond(ContactQuery(sample.point, sample.normal, depth_m))
            error = np.linalg.norm(answer.displacement - wanted, axis=1)
            yield {
                "x_mm": round(1e3 * float(sample.point[0])),
                "depth_mm": round(1e3 * depth_m, 3),
                "method": name,
                "skin_error_mm": 1e3 * float(error[away].max()),
                "force_error_percent": 100.0
                * float(answer.force_n @ sample.normal / force_n - 1.0),
            }


def slide(built: body.SceneBody, radius_m: float, depth_m: float) -> Slides:
    """Slide in each direction at one depth."""
    forces, stiffness, durations, jump = [], [], [], 0.0
    for heading in HEADINGS_RAD:
        before: Singles | None = None
        for along, around in places(float(heading)):
            angle = around / radius_m
            normal = np.array([0.0, np.sin(angle), np.cos(angle)])
            point = (radius_m - depth_m) * normal + np.array([along, 0.0, 0.0])
            start = time.perf_counter()
            push, _ = locate(built.shape, point, None)
            answer = built.method.respond(push)
            durations.append(time.perf_counter() - start)
            forces.append(answer.force_n @ normal)
            stiffness.append(answer.stiffness_n_per_m)
            if before is not None:
                moved = np.linalg.norm(answer.displacement - before, axis=1).max()
                jump = max(jump, float(moved))
            before = answer.displacement
    return Slides(np.array(forces), np.array(stiffness), np.array(durations), jump)


def hertz_force_n(scene: Scene, depth_m: float) -> float:
    """Return Hertz's force of a sphere on a half-space with the cylinder's curvature, N."""
    modulus, nu = require_material(scene).young_modulus_pa, require_material(scene).poisson_ratio
    finger, cylinder = 1.0 / scene.finger.radius_m, 1.0 / require_cylinder(scene).radius_m
    radius = 1.0 / np.sqrt(finger * (finger + cylinder))
    return float(4.0 / 3.0 * modulus / (1.0 - nu**2) * np.sqrt(radius) * depth_m**1.5)


def measure(scene: Scene, spacing_m: float) -> dict[str, Any]:
    """Return the time to compute one mesh without and with a cache, and results of slides."""
    spec = body.make_soft_body_spec(scene, spacing_m)
    if spacing_m == min(SPACINGS_M):
        mesh = replace(spec.mesh, touch_angle_rad=MIN_TOUCH_ANGLE_RAD)
        spec = replace(spec, mesh=mesh)
    with tempfile.TemporaryDirectory() as folder:
        times = [time.perf_counter()]
        for _ in range(2):
            model = precompute.load_or_compute(spec, Path(folder), lambda *_: None)
            times.append(time.perf_counter())
    cold_s, warm_s = np.diff(times).tolist()
    built = body.build_scene_body(scene, spec, model)
    radius_m = require_cylinder(scene).radius_m
    return {
        "spacing_mm": 1e3 * spacing_m,
        "skin_nodes": len(model.response.rest),
        "contact_nodes": len(model.response.contact_nodes),
        "ready_s": {"cold": cold_s, "warm": warm_s},
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
        "slides": [evaluate_slides(scene, built, radius_m, depth_m) for depth_m in DEPTHS_M],
    }


def evaluate_slides(
    scene: Scene, built: body.SceneBody, radius_m: float, depth_m: float
) -> dict[str, Any]:
    """Slide at one depth in all directions, and return forces, jumps and times."""
    slides = slide(built, radius_m, depth_m)
    mean_n = float(slides.force_n.mean())
    median_s, p99_s = np.quantile(slides.step_s, [0.5, 0.99])
    return {
        "skin_nodes": len(built.rest),
        "depth_mm": round(1e3 * depth_m, 3),
        "force_mn": 1e3 * mean_n,
        "hertz_force_mn": 1e3 * hertz_force_n(scene, depth_m),
        "force_range_percent": 100.0 * float(np.ptp(slides.force_n)) / mean_n,
        "max_jump_mm": 1e3 * slides.jump_m,
        "stiffness_n_per_m": float(slides.stiffness_n_per_m.mean()),
        "step_p50_us": 1e6 * float(median_s),
        "step_p99_us": 1e6 * float(p99_s),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--table", action="store_true", help="measure the nonlinear table")
    parser.add_argument("--cold", action="store_true", help="measure the time without a cache")
    parser.add_argument(
        "--spacing", type=float, default=DEMO_SPACING_M, help="distance of the table's nodes, m"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scene = load_scene(SCENE_FILE)
    if options.table:
        report = evaluate_table(scene, options.spacing, cold=options.cold)
        print_report(
            report, "force_errors", "pushes", "worst_by_depth", "slides", as_json=options.json
        )
        return
    meshes = [measure(scene, spacing_m) for spacing_m in SPACINGS_M]
    slides = [row for mesh in meshes for row in mesh.pop("slides")]
    print_report({"meshes": meshes, "slides": slides}, "meshes", "slides", as_json=options.json)


if __name__ == "__main__":
    main()
