"""Measure the time of one step of the planner for every shape, and the maximum finger speed.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.planner [--mesh FILE METRES_PER_UNIT] [--json]

A finger hovers, touches, strokes while it pushes, lifts, and moves behind the object, where the
sheet stops. Each step of `SheetTrajectoryPlanner.follow_finger` is timed by phase, as the minimum
over several repeats of the path. The first table also contains the ratio of p99 to the target, a
tenth of the arms' 7.1 ms cycle. The second table contains the maximum stroke speed along the
object's smallest radius of curvature at which the sheet's normal stays within half a degree. Takes
under three minutes.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.messaging import print_report
from flexsheet.launch.objects.meshes import read_mesh
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Mesh, Pose, Scene
from flexsheet.messages.types import SoftBody
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.models.rigid import angle_between
from flexsheet.nodes.models.shapes import Shape, make_shape
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.planner.trajectory import PlannedStep, SheetTrajectoryPlanner

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
CYCLE_S = 7.1e-3
STEP_S = 1.0 / 60.0
REPEATS = 7
PHASES = ("approach", "contact", "hold")
SPEEDS_M_PER_S = np.geomspace(0.004, 0.2, 24)
WAY_M = 0.016
SEMI_AXES_M = (0.05, 0.03, 0.02)
FRONT = np.array([0.0, 0.0, 1.0])
GOOD_DEG = 0.5
AROUND, ALONG = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def ellipsoid_mesh(subdivisions: int) -> tuple[Floats, Ints]:
    """Return vertices (v, 3) on the ellipsoid, and triangles (t, 3), of a scaled icosphere."""
    # Imported late: only benchmarks need it.
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return np.asarray(ball.vertices) * SEMI_AXES_M, np.asarray(ball.faces, dtype=np.int64)


def sample_geodesic(
    shape: Shape, heading: Floats, step_m: float, steps: int
) -> tuple[Floats, Floats]:
    """Return points and normals (n, 3) along a geodesic from the front of a shape."""
    found = shape.closest(10.0 * FRONT)
    path = [(found.point, found.normal)]
    for _ in range(steps):
        heading = heading - found.normal * (found.normal @ heading)
        heading = heading / np.linalg.norm(heading)
        found = shape.closest(found.point + step_m * heading, previous=found.point)
        path.append((found.point, found.normal))
    points, normals = (np.array(part) for part in zip(*path, strict=True))
    return points, normals


def geometries(mesh: Sequence[str] | None) -> dict[str, Mapping[str, Any]]:
    """Return geometries by name.

    mesh: file and unit (m) of a further mesh, or None.
    """
    named: dict[str, Mapping[str, Any]] = {
        "cylinder": {"shape": "cylinder", "radius_m": 0.0353553, "length_m": 0.12},
        "sphere": {"shape": "sphere", "radius_m": 0.05},
        "ellipsoid": {"shape": "ellipsoid", "semi_axes_m": (0.06, 0.04, 0.05)},
        "plane": {"shape": "plane", "width_m": 0.2, "height_m": 0.16},
        "rounded_box": {
            "shape": "rounded_box",
            "size_m": (0.1, 0.08, 0.06),
            "edge_radius_m": 0.02,
        },
    }
    vertices, triangles = ellipsoid_mesh(4)
    named["ellipsoid_mesh"] = dict(
        Mesh(
            vertices_m=vertices,
            triangles=triangles.astype(np.int32),
            smoothing_m=0.0035,
            origin="benchmark",
        )
    )
    organ = load_scene(SCENE_FILE.with_name("organ.yaml")).object.geometry
    named["organ"] = dict(organ)
    if mesh is not None:
        path, metres_per_unit = Path(mesh[0]), float(mesh[1])
        named[path.stem] = dict(read_mesh(path, metres_per_unit, None))
    return named


def make_planner(scene: Scene, geometry: Mapping[str, Any]) -> SheetTrajectoryPlanner:
    """Make the planner's model with its default parameters for an object in the world frame."""
    here = Pose(position_m=np.zeros(3), rpy_rad=np.zeros(3))
    body = scene.object.model_validate(
        {**dict(scene.object), "geometry": dict(geometry), "world_from_object": here}
    )
    return SheetTrajectoryPlanner(scene.model_copy(update={"object": body}), PlannerParameters())


def make_compliance(scene: Scene) -> ComplianceController:
    """Make the compliance for an object of 60 N/m that stiffens by 30 % per 10 mm."""
    depths = np.linspace(0.0, scene.working_range.push_depth_m, 20)
    reported = SoftBody(
        mesh_id="benchmark",
        method="benchmark",
        in_range=True,
        push_depth_m=0.0,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=60.0,
        force_curve=np.column_stack([depths, 60.0 * depths * (1.0 + 30.0 * depths)]),
        displacement_world_m=np.zeros((0, 3), dtype=np.float32),
    )
    compliance = ComplianceController(scene, make_force_model(scene.sheet), "force_curve")
    compliance.update(reported, in_contact=False)
    return compliance


def copy_planner(plan: SheetTrajectoryPlanner) -> SheetTrajectoryPlanner:
    """Copy a planner in its initial state, because making a planner for a mesh takes a second."""
    other = copy.copy(plan)
    other._contact_state = copy.copy(plan._contact_state)  # it changes by assignment only
    return other


def make_session(shape: Shape) -> Floats:
    """Return finger positions (n, 3): hover, touch, push and stroke, lift, go behind."""
    points, normals = sample_geodesic(shape, np.array([0.5, 0.8, 0.1]), 3e-4, 60)
    down = np.linspace(0.04, -0.001, 80)[:, None]
    there = np.concatenate([points, points[::-1]])
    out = np.concatenate([normals, normals[::-1]])
    depth = 0.003 + 0.002 * np.sin(np.linspace(0.0, 12.0, len(there)))
    behind = np.column_stack(
        [np.zeros(60), np.linspace(0.0, 0.16, 60), np.linspace(points[0, 2] + 0.04, -0.16, 60)]
    )
    touch = points[0] + down * normals[0]
    return np.concatenate([touch, there - depth[:, None] * out, touch[::-1], behind])


def follow(
    plan: SheetTrajectoryPlanner, fingers: Floats, compliance: ComplianceController
) -> Iterator[tuple[float, PlannedStep]]:
    """Return the time (s) and the outcome of each step."""
    velocities = np.gradient(fingers, STEP_S, axis=0)
    for finger, velocity in zip(fingers, velocities, strict=True):
        start = time.perf_counter()
        planned = plan.follow_finger(finger, velocity, compliance, STEP_S)
        yield time.perf_counter() - start, planned


def time_steps(
    name: str, plan: SheetTrajectoryPlanner, shape: Shape, compliance: ComplianceController
) -> dict[str, Any]:
    """Return the times of one step in ms, by phase and in total."""
    fingers = make_session(shape)
    times = np.full(len(fingers), np.inf)
    for _ in range(REPEATS):
        steps = list(follow(copy_planner(plan), fingers, compliance))
        times = np.minimum(times, [took for took, _ in steps])
    phases = np.array([planned.command.phase for _, planned in steps])
    row: dict[str, Any] = {"shape": name}
    for phase in PHASES:
        some = 1e3 * times[phases == phase]
        row[f"{phase}_ms"] = {
            f"p{percent}": float(np.percentile(some, percent)) if len(some) else None
            for percent in (50, 99)
        }
    p99 = float(np.quantile(times, 0.99))
    return row | {"p99_ms": 1e3 * p99, "fraction_of_target": p99 / (0.1 * CYCLE_S)}


def normal_error_deg(
    plan: SheetTrajectoryPlanner,
    shape: Shape,
    heading: Floats,
    speed: float,
    compliance: ComplianceController,
) -> float:
    """Return the maximum error of the normal along a stroke with that peak speed, deg."""
    step_m = 2e-4
    points, normals = sample_geodesic(shape, heading, step_m, round(WAY_M / step_m))
    count = max(8, round(1.875 * WAY_M / speed / STEP_S))
    share = np.linspace(0.0, 1.0, count)
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    place = smooth * (len(points) - 1)
    surface = points - 0.001 * normals
    fingers = np.column_stack(
        [np.interp(place, np.arange(len(points)), axis) for axis in surface.T]
    )
    still = np.repeat(fingers[:1], 90, axis=0)
    above = still + 0.02 * normals[0]
    steps = list(follow(copy_planner(plan), np.concatenate([above, still, fingers]), compliance))
    found = shape.closest(fingers, previous=np.repeat(points[:1], count, axis=0))
    return float(
        np.degrees(
            max(
                angle_between(planned.motion.world_from_sheet[:3, 2], normal)
                for (_, planned), normal in zip(steps[180:], found.normal, strict=True)
            )
        )
    )


def find_peak_speed_mm_per_s(
    plan: SheetTrajectoryPlanner, shape: Shape, heading: Floats, compliance: ComplianceController
) -> float:
    """Return the maximum speed of `SPEEDS_M_PER_S` up to which the normal is exact, or 0."""
    good = 0.0
    for speed in SPEEDS_M_PER_S:
        if normal_error_deg(plan, shape, heading, speed, compliance) > GOOD_DEG:
            break
        good = float(speed)
    return 1e3 * good


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mesh", nargs=2, metavar=("FILE", "METRES_PER_UNIT"))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scene = load_scene(SCENE_FILE)
    compliance = make_compliance(scene)
    shapes = {
        name: (make_planner(scene, geometry), make_shape(geometry))
        for name, geometry in geometries(options.mesh).items()
    }
    report = {
        "steps": [time_steps(name, *pair, compliance) for name, pair in shapes.items()],
        "peak_speeds": [
            {
                "shape": name,
                "around_mm_per_s": find_peak_speed_mm_per_s(*pair, AROUND, compliance),
                "along_mm_per_s": find_peak_speed_mm_per_s(*pair, ALONG, compliance),
            }
            for name, pair in shapes.items()
        ],
    }
    print_report(report, "steps", "peak_speeds", as_json=options.json)


if __name__ == "__main__":
    main()
