"""What the chart of the soft body is judged by, and a table that is filled just where it looks.

All of it comes from Newton's pushes at one place, and around it: they are solved in processes of
their own, as a table's are, and kept in the cache.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messages.scene import Cylinder, Scene
from nodes.cache import Parts, load_arrays, save_arrays
from nodes.fem_solver import pushes
from nodes.fem_solver.body import SceneBody, table_spec_of, with_table
from nodes.fem_solver.carried import NEIGHBOURS, Carrier, Hull, Solved
from nodes.fem_solver.contact import LinearSoftBody
from nodes.fem_solver.mesh import build_mesh
from nodes.fem_solver.precompute import SoftBodyModel
from nodes.fem_solver.precompute_table import load_table, local_processes, solve_all
from nodes.fem_solver.pushes import PushAnswer, PushJob, Site
from nodes.fem_solver.table import END_SPAN_M, FACES_TRIED, Table, fill
from nodes.methods import Progress

Floats = NDArray[np.float64]

VERSION = 1


@dataclass(frozen=True, slots=True)
class Judge:
    """A push solved on one mesh, and the mesh's hull; name: for people."""

    name: str
    site: Site
    answer: PushAnswer
    hull: Hull

    def reaches(self, depth_m: float) -> bool:
        depths = self.answer.depths_m[: self.answer.reached]
        return bool((np.abs(depths - depth_m) < 1e-9).any())

    def at(self, depth_m: float, points: Floats) -> tuple[Floats, float]:
        """How skin at its points (q, 3) moves, and the force along the normal for 1 Pa."""
        level = int(np.abs(self.answer.depths_m - depth_m).argmin())
        nodes, weights = self.hull.weights(points)
        moved: Floats = np.einsum("qa,qai->qi", weights, self.answer.moved[level][nodes])
        return moved, float(self.answer.force_n[level] @ self.site.normal)


def judges_at(judges: Sequence[Judge], depth_m: float) -> list[Judge]:
    """Those that reach a depth, the best first: the first judges, the second tells its doubt."""
    return [judge for judge in judges if judge.reaches(depth_m)]


def focused_job(
    body: SceneBody, scene: Scene, site: Site, ratio: float, depths_m: Sequence[float]
) -> PushJob:
    """A push on a mesh with `ratio` finger radii between skin nodes, about the finger only where
    the shape has such meshes."""
    spacing = ratio * scene.finger.radius_m
    spec = replace(body.spec.mesh, skin_spacing_m=spacing)
    job = pushes.job_of(
        spec,
        build_mesh(spec),
        site,
        poisson_ratio=body.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        spacing_m=spacing,
    )
    return replace(job, depths_m=tuple(depths_m))


def even_job(
    body: SceneBody, scene: Scene, site: Site, spacing_m: float, depths_m: Sequence[float]
) -> PushJob:
    """The same push on a mesh that is as fine wherever fingers go."""
    mesh = build_mesh(replace(body.spec.mesh, skin_spacing_m=spacing_m))
    return PushJob(
        nodes=mesh.nodes,
        elements=mesh.elements,
        fixed=mesh.fixed,
        faces=mesh.touch[mesh.touch_faces],
        site=site,
        poisson_ratio=body.spec.poisson_ratio,
        finger_radius_m=scene.finger.radius_m,
        depths_m=tuple(depths_m),
    )


def solved_jobs(jobs: Sequence[PushJob], cache_dir: Path, told: Progress) -> list[PushAnswer]:
    """The pushes' answers, kept one by one under what they are computed from."""
    parts = Parts(cache_dir)
    names = [f"soft-body-push-{_digest(job)}" for job in jobs]
    missing = [number for number, name in enumerate(names) if parts.load(name) is None]
    if missing:
        folder = Parts(cache_dir / "soft-body-pushes.parts")
        with local_processes(min(os.cpu_count() or 1, len(missing))) as executor:
            answers = solve_all(
                [jobs[number] for number in missing],
                executor,
                Parts(folder.folder / _digest(*[jobs[number] for number in missing])),
                lambda count: told(len(jobs) - len(missing) + count, len(jobs)),
            )
        for number, answer in zip(missing, answers, strict=True):
            content = {one.name: np.asarray(getattr(answer, one.name)) for one in fields(answer)}
            save_arrays(cache_dir / f"{names[number]}.npz", content)
        folder.remove()
    return [_kept(cache_dir / f"{name}.npz") for name in names]


def _kept(path: Path) -> PushAnswer:
    content = load_arrays(path)
    if content is None:
        raise OSError(f"{path} was written and cannot be read")
    reached = int(content.pop("reached"))
    return PushAnswer(reached=reached, **content)


def _digest(*jobs: PushJob) -> str:
    digest = hashlib.sha256(f"{VERSION}".encode())
    for job in jobs:
        digest.update(f"{job.poisson_ratio} {job.finger_radius_m} {job.depths_m}".encode())
        arrays = (job.nodes, job.elements, job.fixed, job.faces, job.site.place, job.site.normal)
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


class LocalTable:
    """The nonlinear table of a body, filled only near one place: the same numbers there as in the
    whole one, from the few pushes that count there."""

    def __init__(self, body: SceneBody, scene: Scene, model: SoftBodyModel, site: Site) -> None:
        self._body, self._scene, self._model = body, scene, model
        response, spec = model.response, body.spec.mesh
        mesh = build_mesh(spec)
        self._mirrors = pushes.mirrors_of(mesh)
        sites = pushes.sites_of(spec, mesh, self._mirrors, scene.finger.radius_m)
        touched = response.rest[response.touch]
        away = np.linalg.norm(touched[response.faces].mean(axis=1) - site.place, axis=1)
        self._near = np.unique(response.faces[np.argsort(away)[:FACES_TRIED]])
        places = np.array([one.place * signs for one in sites for signs in self._mirrors])
        # a site on a plane of symmetry is its own image: it counts once
        _, first = np.unique(np.round(places, 7), axis=0, return_index=True)
        apart = np.linalg.norm(touched[self._near][:, None] - places[None, first], axis=2)
        closest = np.argsort(apart, axis=1)[:, : NEIGHBOURS + 1]
        self._sites = [sites[k] for k in np.unique(first[closest] // len(self._mirrors))]
        self.jobs = [
            pushes.job_of(
                spec,
                mesh,
                one,
                poisson_ratio=body.spec.poisson_ratio,
                finger_radius_m=scene.finger.radius_m,
            )
            for one in self._sites
        ]

    def body(self, answers: Sequence[PushAnswer]) -> SceneBody:
        """The body by this table, from the answers to `jobs`."""
        response, radius = self._model.response, self._scene.finger.radius_m
        solved, seen = [], set()
        for site, answer in zip(self._sites, answers, strict=True):
            for signs in self._mirrors:
                image, place = pushes.reflected(answer, site, signs)
                name = tuple(np.round(1e7 * place.place).astype(int))
                if name not in seen:
                    seen.add(name)
                    solved.append(Solved(place, image, Hull(image.rest, image.faces)))
        linear = LinearSoftBody(
            response,
            self._body.shape,
            response.rest[self._model.bounds],
            young_modulus_pa=1.0,
            finger_radius_m=radius,
            linear_depth_m=radius,
            largest_depth_m=2.0 * radius,
        )
        near = replace(
            response, touch=response.touch[self._near], normals=response.normals[self._near]
        )
        user = np.array(self._body.spec.mesh.towards_user)
        part = fill(
            near, self._model.triangles, linear, Carrier(solved, user, radius), lambda *_: None
        )
        count = len(response.touch)
        table = Table(
            depths_m=part.depths_m,
            fields=np.zeros((count, *part.fields.shape[1:]), dtype=np.float32),
            force_n=np.zeros((count, *part.force_n.shape[1:])),
            reach_m=np.full(count, 2.0 * END_SPAN_M),
        )
        table.fields[self._near] = part.fields
        table.force_n[self._near] = part.force_n
        table.reach_m[self._near] = part.reach_m
        return with_table(self._body, self._scene, self._model, table)


def whole_table(
    body: SceneBody, scene: Scene, model: SoftBodyModel, cache_dir: Path
) -> SceneBody | None:
    """The body by its whole table, where that is kept."""
    table = load_table(table_spec_of(scene, body.spec), cache_dir)
    return None if table is None else with_table(body, scene, model, table)


def has_focused_meshes(body: SceneBody) -> bool:
    """Whether the shape can be meshed finely about the finger only."""
    return isinstance(body.spec.mesh.geometry, Cylinder)
