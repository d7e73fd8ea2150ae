"""How smooth and how quick the soft body is: slides a fingertip over meshes of several spacings.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.soft_body

The fingertip goes 6 mm in each of three directions at constant depth, 0.02 mm a step.  Prints for
every mesh and depth the force (beside Hertz's), its ripple, the largest jump of any skin node in a
step, the stiffness, and the time of a step.  About a minute, 1.5 GiB.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from launch.plan import load_scene
from messages.scene import Scene, cylinder_of
from nodes.fem_solver import body, precompute
from nodes.fem_solver.place import locate

Floats = NDArray[np.float64]

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
SPACINGS_M = (0.006, 0.0045, 0.003, 0.0022)
DEPTHS_M = (0.0005, 0.001, 0.002, 0.003, 0.006, 0.010, 0.020)
HEADINGS_RAD = np.radians([0.0, 37.0, 90.0])
STEP_M, STEPS = 2e-5, 300
FROM_M = (0.004, 0.003)
FINEST_TOUCH_ANGLE_RAD = 0.7
"""The finest mesh is touchable over less of the front, so that its table fits into memory."""


@dataclass(frozen=True, slots=True)
class Slides:
    """What came of sliding at one depth: per step, but for the largest jump (m)."""

    force_n: Floats
    stiffness_n_per_m: Floats
    step_s: Floats
    jump_m: float


def places(heading_rad: float) -> Iterator[tuple[float, float]]:
    """Places of the fingertip on the skin: along the axis, and around it (m)."""
    for i in range(STEPS):
        way = STEP_M * i
        yield FROM_M[0] + way * np.cos(heading_rad), FROM_M[1] + way * np.sin(heading_rad)


def slide(built: body.SceneBody, radius_m: float, depth_m: float) -> Slides:
    """Slide in every direction at one depth."""
    forces, stiffness, took, jump = [], [], [], 0.0
    for heading in HEADINGS_RAD:
        before: NDArray[np.float32] | None = None
        for along, around in places(float(heading)):
            angle = around / radius_m
            normal = np.array([0.0, np.sin(angle), np.cos(angle)])
            point = (radius_m - depth_m) * normal + np.array([along, 0.0, 0.0])
            start = time.perf_counter()
            push, _ = locate(built.shape, point, None)
            answer = built.method.respond(push)
            took.append(time.perf_counter() - start)
            forces.append(answer.force_n @ normal)
            stiffness.append(answer.stiffness_n_per_m)
            if before is not None:
                moved = np.linalg.norm(answer.displacement - before, axis=1).max()
                jump = max(jump, float(moved))
            before = answer.displacement
    return Slides(np.array(forces), np.array(stiffness), np.array(took), jump)


def hertz_force_n(scene: Scene, depth_m: float) -> float:
    """Hertz's force of a sphere on a half-space bent like the cylinder, its patch taken round."""
    modulus, nu = scene.object.material.young_modulus_pa, scene.object.material.poisson_ratio
    finger, cylinder = 1.0 / scene.finger.radius_m, 1.0 / cylinder_of(scene).radius_m
    radius = 1.0 / np.sqrt(finger * (finger + cylinder))
    return float(4.0 / 3.0 * modulus / (1.0 - nu**2) * np.sqrt(radius) * depth_m**1.5)


def measure(scene: Scene, spacing_m: float) -> None:
    """Precompute one mesh, cold and warm, slide over it, print."""
    spec = body.spec_of(scene, spacing_m)
    if spacing_m == min(SPACINGS_M):
        mesh = replace(spec.mesh, touch_angle_rad=FINEST_TOUCH_ANGLE_RAD)
        spec = replace(spec, mesh=mesh)
    with tempfile.TemporaryDirectory() as folder:
        times = [time.perf_counter()]
        for _ in range(2):
            model = precompute.load_or_compute(spec, Path(folder), lambda *_: None)
            times.append(time.perf_counter())
    cold_s, warm_s = np.diff(times)
    built = body.scene_body(scene, spec, model, linear_depth_m=0.006, largest_depth_m=0.010)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(
        f"\n{1e3 * spacing_m:g} mm: {len(model.response.rest)} skin nodes,"
        f" {len(model.response.touch)} loads, cold {cold_s:.1f} s, warm {warm_s:.2f} s,"
        f" peak {peak_mib:.0f} MiB",
        flush=True,
    )
    for depth_m in DEPTHS_M:
        slides = slide(built, cylinder_of(scene).radius_m, depth_m)
        mean_n, stiffness = slides.force_n.mean(), slides.stiffness_n_per_m
        median_s, p99_s = np.quantile(slides.step_s, [0.5, 0.99])
        print(
            f"{1e3 * depth_m:5.1f} mm: force {1e3 * mean_n:7.1f} mN"
            f" (Hertz {1e3 * hertz_force_n(scene, depth_m):6.1f}),"
            f" ripple +-{50 * np.ptp(slides.force_n) / mean_n:4.1f} %,"
            f" jump {1e3 * slides.jump_m:.3f} mm, stiffness {stiffness.mean():.1f} N/m,"
            f" step {1e6 * median_s:.0f} / {1e6 * p99_s:.0f} us",
            flush=True,
        )


def main() -> None:
    scene = load_scene(SCENE_FILE)
    for spacing_m in SPACINGS_M:
        measure(scene, spacing_m)


if __name__ == "__main__":
    main()
