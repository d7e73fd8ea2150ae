"""The skin's response to every load that a finger can put on it: computed once, kept on disk.

A file is named by a digest of all that it depends on.  Young's modulus is not among that: the
response scales with 1/E, so it is stored for 1 Pa.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from messages.scene import Plane
from nodes.fem_solver.cache import Parts, load_arrays, save_arrays, say_damaged
from nodes.fem_solver.contact import SkinResponse
from nodes.fem_solver.mesh import MeshSpec, SolidMesh, build_mesh, mesh_budget

if TYPE_CHECKING:
    from nodes.fem_solver.multifrontal import Dissection

VERSION = 2
"""Counts up whenever the same specification gives other numbers."""
CHUNK_LOADS = 128
ELEMENT_BYTES = 30 * 30 * 8
MESH_STEPS, FACTOR_STEPS = 1, 4
"""How many loads' worth of progress meshing and factoring are."""

Progress = Callable[[int, int, "Budget"], None]
"""Called with (done, total) steps of the work and what it needs, first before it starts; may raise
`Interrupted` to stop it."""


class Need(Protocol):
    """What some work needs, said before it starts."""

    def text(self) -> str: ...


class Interrupted(Exception):
    """The computation was asked to stop; what was done so far is kept as parts."""


@dataclass(frozen=True, slots=True, eq=False)
class SoftBodySpec:
    """All that a precomputation depends on; equal where their keys are."""

    mesh: MeshSpec
    poisson_ratio: float

    def key(self) -> str:
        """Digest of the specification and of the code's version."""
        text = json.dumps([VERSION, self.mesh.key(), self.poisson_ratio])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class SoftBodyModel:
    """The precomputed response, and the skin: triangles (t, 3), outward; which of its nodes are
    bounds (s,), neither touchable nor past an end of what can be touched."""

    response: SkinResponse
    triangles: NDArray[np.int32]
    bounds: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Budget:
    """What a precomputation will need, known before it starts."""

    skin_nodes: int
    loads: int
    working_bytes: int
    table_bytes: int

    def text(self) -> str:
        return (
            f"{self.loads} loads on {self.skin_nodes} skin nodes, "
            f"{(self.working_bytes + self.table_bytes) / 1e6:.0f} MB"
        )


def budget(mesh: SolidMesh, order: Dissection) -> Budget:
    """Memory that `compute` takes on this mesh: stiffness, factors, some loads, the result."""
    factors = sum(len(f.own) * (len(f.own) + len(f.border)) for f in order.fronts) * 8
    stiffness = len(mesh.elements) * ELEMENT_BYTES * 3
    chunk = 3 * len(mesh.nodes) * CHUNK_LOADS * 8 * 4
    table = len(mesh.touch) * len(mesh.skin) * 3 * 4 + len(mesh.touch) ** 2 * 8
    return Budget(len(mesh.skin), len(mesh.touch), factors + stiffness + chunk, table)


def foreseen(spec: SoftBodySpec) -> Budget:
    """About what `compute` takes, within a factor of two, before there is a mesh.

    UnfitMeshError as `mesh_budget`.
    """
    nodes = mesh_budget(spec.mesh)
    # a surface's share of a solid's nodes, and the touchable part's of it, as meshes had them
    skin = int(6.0 * nodes.nodes ** (2.0 / 3.0))
    loads, geometry = skin // 2, spec.mesh.geometry
    if isinstance(geometry, Plane):
        loads = int(geometry.width_m * geometry.height_m / spec.mesh.skin_spacing_m**2)
    return Budget(skin, loads, nodes.bytes + 16_000 * nodes.nodes, loads * (skin * 12 + loads * 8))


def compute(spec: SoftBodySpec, progress: Progress, parts: Parts | None = None) -> SoftBodyModel:
    """Mesh, factor, and solve for one unit load per touchable skin node.

    parts: where what is done is kept, and looked for.  MeshError for a body that nothing holds,
    ValueError for a material or size out of bounds, MemoryError, before anything is allocated, if
    the machine has too little.
    """
    from nodes.fem_solver.elasticity import element_stiffness, lame_constants, require_support
    from nodes.fem_solver.multifrontal import Dissection
    from nodes.models.shapes import make_shape

    lame_constants(1.0, spec.poisson_ratio)
    need = foreseen(spec)
    progress(0, need.loads + MESH_STEPS + FACTOR_STEPS, need)
    require_memory(need, spec)
    mesh = build_mesh(spec.mesh)
    require_support(mesh.nodes, mesh.fixed)
    order = Dissection(mesh.nodes, mesh.elements, mesh.fixed)
    need = budget(mesh, order)
    require_memory(need, spec)
    loads = len(mesh.touch)
    done, total = MESH_STEPS, loads + MESH_STEPS + FACTOR_STEPS
    progress(done, total, need)
    matrices = element_stiffness(
        mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=spec.poisson_ratio
    )
    factors = order.factor(matrices)
    del matrices
    done += FACTOR_STEPS
    progress(done, total, need)
    table = np.empty((loads, 3 * len(mesh.skin)), dtype=np.float32)
    compliance = np.empty((loads, loads))
    for start in range(0, loads, CHUNK_LOADS):
        part = slice(start, min(start + CHUNK_LOADS, loads))
        count, name = part.stop - start, f"loads-{start:06d}"
        kept = parts.load(name) if parts else None
        if kept is None:
            right = np.zeros((3 * len(mesh.nodes), count))
            normals = mesh.touch_normals[part]
            for axis in range(3):
                right[3 * mesh.touch[part] + axis, np.arange(count)] = -normals[:, axis]
            moved = factors.solve(right).reshape(-1, 3, count)
            kept = {
                "table": moved[mesh.skin].reshape(-1, count).T.astype(np.float32),
                "compliance": -np.einsum("mik,mi->km", moved[mesh.touch], mesh.touch_normals),
            }
            if parts:
                parts.save(name, kept)
        table[part], compliance[part] = kept["table"], kept["compliance"]
        done += count
        progress(done, total, need)
    touched = np.searchsorted(mesh.skin, mesh.touch)
    skin = mesh.nodes[mesh.skin]
    found = make_shape(dict(spec.mesh.geometry)).closest(skin)
    # nodes off the smooth surface lie on its ends: caps, the sides of a slab
    off = np.linalg.norm(found.point - skin, axis=1) > 0.5 * spec.mesh.skin_spacing_m
    bounds = ~(off | found.on_edge)
    bounds[touched] = False
    response = SkinResponse(
        rest=skin,
        touch=touched,
        normals=mesh.touch_normals,
        faces=mesh.touch_faces,
        compliance=0.5 * (compliance + compliance.T),
        table=table,
    )
    return SoftBodyModel(response, mesh.skin_triangles, bounds)


def require_memory(need: Budget, spec: SoftBodySpec) -> None:
    """MemoryError if the machine has less memory free than the computation takes."""
    import psutil

    free = psutil.virtual_memory().available
    wanted = need.working_bytes + need.table_bytes
    if wanted > free:
        raise MemoryError(
            f"precomputing {need.loads} loads on {need.skin_nodes} skin nodes takes "
            f"{wanted / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free; raise "
            f"skin_spacing_m above {spec.mesh.skin_spacing_m:g}"
        )


def cache_path(spec: SoftBodySpec, cache_dir: Path) -> Path:
    return cache_dir / f"soft-body-{spec.key()}.npz"


def parts_of(spec: SoftBodySpec, cache_dir: Path) -> Parts:
    return Parts(cache_dir / f"soft-body-{spec.key()}.parts")


def load(spec: SoftBodySpec, cache_dir: Path) -> SoftBodyModel | None:
    """The model kept for this specification; None if there is none, or (logged) it is damaged."""
    path = cache_path(spec, cache_dir)
    content = load_arrays(path)
    if content is None:
        return None
    try:
        return SoftBodyModel(
            triangles=content.pop("triangles"),
            bounds=content.pop("bounds"),
            response=SkinResponse(**content),
        )
    except (KeyError, TypeError) as error:
        say_damaged(path, error)
        return None


def save(model: SoftBodyModel, spec: SoftBodySpec, cache_dir: Path) -> Path:
    """Keep a model; a reader sees the whole file or none.  OSError if it cannot be written."""
    path = cache_path(spec, cache_dir)
    response = {one.name: getattr(model.response, one.name) for one in fields(model.response)}
    save_arrays(path, {"triangles": model.triangles, "bounds": model.bounds, **response})
    return path


def load_or_compute(spec: SoftBodySpec, cache_dir: Path, progress: Progress) -> SoftBodyModel:
    """The kept model, or a new one that is then kept; errors as `compute` and `save`."""
    model = load(spec, cache_dir)
    if model is None:
        parts = parts_of(spec, cache_dir)
        model = compute(spec, progress, parts)
        save(model, spec, cache_dir)
        parts.remove()
    return model
