"""Compute reference solutions for the soft-body benchmark.

They are solutions of Newton's method for pushes at one surface point. Worker processes compute
these solutions, and the cache stores them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.cache import CheckpointStore
from flexsheet.nodes.fem_solver import snapshots
from flexsheet.nodes.fem_solver.body import SceneBody
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute_table import solve_all
from flexsheet.nodes.fem_solver.snapshot_interpolator import SurfaceLocator
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, Snapshot, SnapshotJob
from flexsheet.nodes.methods import Progress
from flexsheet.nodes.worker_processes import local_processes

VERSION = 3


@dataclass(frozen=True, slots=True)
class ReferenceSolution:
    """A reference solution for pushes at one surface point, computed on one mesh.

    name: description of the mesh. locator: search structure for points on the mesh's surface.
    """

    name: str
    sample: SamplePoint
    snapshot: Snapshot
    locator: SurfaceLocator

    def reaches(self, depth_m: float) -> bool:
        """Return whether the solution converged at a push depth."""
        depths = self.snapshot.depths_m[: self.snapshot.reached]
        return bool((np.abs(depths - depth_m) < 1e-9).any())

    def evaluate(self, depth_m: float, points: Floats) -> tuple[Floats, float]:
        """Return the displacement (q, 3), m, of q skin points, and the normal force on the finger.

        depth_m: push depth; only the depths of the precomputed solution are permitted.
        points (q, 3): undeformed positions, m.

        The force (N) is valid for a Young's modulus of 1 Pa. It must be multiplied by the true
        modulus.
        """
        level = int(np.abs(self.snapshot.depths_m - depth_m).argmin())
        nodes, weights = self.locator.weights(points)
        displacement: Floats = np.einsum("qa,qai->qi", weights, self.snapshot.moved[level][nodes])
        return displacement, float(self.snapshot.force_n[level] @ self.sample.normal)


def make_focused_job(
    body: SceneBody, scene: Scene, sample: SamplePoint, ratio: float, depths_m: Sequence[float]
) -> SnapshotJob:
    """Return the inputs of a Newton solution for pushes at a point, on a locally refined mesh.

    ratio: distance between skin nodes near this point, in finger radii. If the shape does not
        support locally refined meshes, all touchable skin has this spacing.
    depths_m: push depths.
    """
    spacing = ratio * scene.finger.radius_m
    spec = body.spec.mesh
    if not snapshots.has_focused_meshes(spec):
        spec = replace(spec, skin_spacing_m=spacing)
    job = snapshots.make_snapshot_job(
        spec,
        build_mesh(spec),
        sample,
        poisson_ratio=body.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        spacing_m=spacing,
    )
    return replace(job, depths_m=tuple(depths_m))


def solve_cached_jobs(
    jobs: Sequence[SnapshotJob], cache_dir: Path, on_progress: Progress
) -> list[Snapshot]:
    """Load push solutions (snapshots) from the cache; compute and cache the missing solutions.

    jobs: inputs of each solution.
    on_progress: function that receives the number of finished jobs and the total number.
    """
    names = [_digest(job) for job in jobs]
    with local_processes(min(os.cpu_count() or 1, len(jobs))) as executor:
        solved = solve_all(
            {
                name: partial(snapshots.solve_snapshot, job)
                for name, job in zip(names, jobs, strict=True)
            },
            executor,
            CheckpointStore(cache_dir / "soft-body-pushes"),
            lambda count: on_progress(count, len(jobs)),
        )
    return [solved[name] for name in names]


def _digest(job: SnapshotJob) -> str:
    given = (VERSION, job.poisson_ratio, job.finger_radius_m, job.depths_m, job.mirror_axes)
    digest = hashlib.sha256(repr(given).encode())
    sample = job.sample
    arrays = (job.nodes, job.elements, job.fixed, job.faces, sample.point, sample.normal)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]
