"""Compute reference solutions for the soft-body benchmark, and nonlinear tables near one point.

Both consist of solutions of Newton's method for pushes at or near one surface point. Worker
processes compute these solutions, and the cache stores them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.cache import (
    CheckpointStore,
    encode_fields,
    load_arrays,
    load_cached,
    save_arrays,
)
from flexsheet.nodes.fem_solver import snapshots
from flexsheet.nodes.fem_solver.body import SceneBody, attach_table, make_table_spec
from flexsheet.nodes.fem_solver.contact import unit_linear_body
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel
from flexsheet.nodes.fem_solver.precompute_table import make_table_cache, solve_all
from flexsheet.nodes.fem_solver.snapshot_interpolator import (
    NEIGHBOURS,
    SnapshotSet,
    SurfaceLocator,
)
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, Snapshot, SnapshotJob
from flexsheet.nodes.fem_solver.table import CANDIDATE_FACES, END_SPAN_M, Table, fill_table
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


def make_even_job(
    body: SceneBody, scene: Scene, sample: SamplePoint, spacing_m: float, depths_m: Sequence[float]
) -> SnapshotJob:
    """Return the inputs of a Newton solution for pushes at a point, on a mesh of uniform spacing.

    spacing_m: distance between skin nodes.
    depths_m: push depths.
    """
    mesh = build_mesh(replace(body.spec.mesh, skin_spacing_m=spacing_m))
    return snapshots.make_job_on_mesh(
        mesh,
        sample,
        poisson_ratio=body.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        depths_m=tuple(depths_m),
    )


def solve_cached_jobs(
    jobs: Sequence[SnapshotJob], cache_dir: Path, on_progress: Progress
) -> list[Snapshot]:
    """Load push solutions (snapshots) from the cache; compute and cache the missing solutions.

    jobs: inputs of each solution.
    on_progress: function that receives the number of finished jobs and the total number.

    Raises OSError if a cache file cannot be read after it was written.
    """
    cache = CheckpointStore(cache_dir)
    names = [f"soft-body-push-{_digest(job)}" for job in jobs]
    missing = [number for number, name in enumerate(names) if cache.load(name) is None]
    if missing:
        folder = CheckpointStore(cache_dir / "soft-body-pushes.parts")
        with local_processes(min(os.cpu_count() or 1, len(missing))) as executor:
            solved = solve_all(
                [jobs[number] for number in missing],
                executor,
                CheckpointStore(folder.folder / _digest(*[jobs[number] for number in missing])),
                lambda count: on_progress(len(jobs) - len(missing) + count, len(jobs)),
            )
        for number, snapshot in zip(missing, solved, strict=True):
            save_arrays(cache_dir / f"{names[number]}.npz", encode_fields(snapshot))
        folder.remove()
    return [_load_snapshot(cache_dir / f"{name}.npz") for name in names]


def _load_snapshot(path: Path) -> Snapshot:
    content = load_arrays(path)
    if content is None:
        raise OSError(f"{path}: the cache file was written but cannot be read; check the disk")
    return snapshots.decode_snapshot(content)


def _digest(*jobs: SnapshotJob) -> str:
    digest = hashlib.sha256(f"{VERSION}".encode())
    for job in jobs:
        given = (job.poisson_ratio, job.finger_radius_m, job.depths_m, job.mirror_axes)
        digest.update(repr(given).encode())
        sample = job.sample
        arrays = (job.nodes, job.elements, job.fixed, job.faces, sample.point, sample.normal)
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


class LocalTable:
    """A nonlinear table of a body that is filled only near one surface point.

    Near this point, its values equal those of the full table. It is built from only a few snapshots
    (precomputed pushes), whose inputs are in the attribute `jobs`.
    """

    def __init__(
        self, body: SceneBody, scene: Scene, model: SoftBodyModel, sample: SamplePoint
    ) -> None:
        self._body, self._scene, self._model = body, scene, model
        response, spec = model.response, body.spec.mesh
        mesh = build_mesh(spec)
        self._mirrors = snapshots.find_mirror_planes(mesh)
        samples = snapshots.choose_sample_points(spec, mesh, self._mirrors, scene.finger.radius_m)
        touchable = response.rest[response.contact_nodes]
        distance = np.linalg.norm(touchable[response.faces].mean(axis=1) - sample.point, axis=1)
        self._near = np.unique(response.faces[np.argsort(distance)[:CANDIDATE_FACES]])
        points = np.array([one.point * signs for one in samples for signs in self._mirrors])
        # Remove duplicates: a sample on a plane of symmetry is its own mirror image.
        _, first = np.unique(np.round(points, 7), axis=0, return_index=True)
        distances = np.linalg.norm(touchable[self._near][:, None] - points[None, first], axis=2)
        closest = np.argsort(distances, axis=1)[:, : NEIGHBOURS + 1]
        near = np.unique(first[closest] // len(self._mirrors))
        # The forces of a table are corrected by a push at its first sample point.
        corrected = snapshots.order_by_spread(samples, self._mirrors, np.array(spec.towards_user))[
            0
        ]
        self._samples = [corrected, *(samples[k] for k in near if samples[k] is not corrected)]
        given: dict[str, Any] = {
            "poisson_ratio": body.spec.poisson_ratio,
            "finger_radius_m": scene.finger.radius_m,
        }
        self.jobs = [snapshots.make_snapshot_job(spec, mesh, one, **given) for one in self._samples]
        fine_job = snapshots.make_fine_job(spec, corrected, **given)
        self.jobs += [] if fine_job is None else [fine_job]

    def body(self, solved: Sequence[Snapshot]) -> SceneBody:
        """Return the soft body with this table, built from the solved snapshots.

        solved: snapshots of the jobs in `jobs`, in the same order.
        """
        response, radius = self._model.response, self._scene.finger.radius_m
        linear = unit_linear_body(
            response, self._body.shape, response.rest[self._model.bounds], radius
        )
        count = len(self._samples)
        fine = (self._samples[0], solved[count]) if len(solved) > count else None
        source = SnapshotSet(
            self._samples,
            solved[:count],
            self._mirrors,
            np.array(self._body.spec.mesh.towards_user),
            radius,
        )
        near = replace(
            response,
            contact_nodes=response.contact_nodes[self._near],
            normals=response.normals[self._near],
        )
        part = fill_table(near, self._model.triangles, linear, source, fine=fine)
        count = len(response.contact_nodes)
        table = Table(
            depths_m=part.depths_m,
            fields=np.zeros((count, *part.fields.shape[1:]), dtype=np.float32),
            force_n=np.zeros((count, *part.force_n.shape[1:])),
            reach_m=np.full(count, 2.0 * END_SPAN_M),
        )
        table.fields[self._near] = part.fields
        table.force_n[self._near] = part.force_n
        table.reach_m[self._near] = part.reach_m
        return attach_table(self._body, self._scene, self._model, table)


def load_full_table(
    body: SceneBody, scene: Scene, model: SoftBodyModel, cache_dir: Path
) -> SceneBody | None:
    """Return the body with its full nonlinear table, or None if the cache does not contain it."""
    table = load_cached(make_table_cache(make_table_spec(scene, body.spec)), cache_dir)
    return None if table is None else attach_table(body, scene, model, table)
