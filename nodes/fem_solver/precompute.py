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
from nodes.cache import Parts, load_arrays, save_arrays, say_damaged
from nodes.fem_solver.contact import DragResponse, SkinResponse
from nodes.fem_solver.mesh import MeshSpec, SolidMesh, build_mesh, mesh_budget

if TYPE_CHECKING:
    from nodes.fem_solver.multifrontal import Dissection, Factors

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

VERSION = 3
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
    """All that a precomputation depends on; equal where their keys are.

    sticking: whether forces along the skin are answered too, for three times the memory.
    """

    mesh: MeshSpec
    poisson_ratio: float
    sticking: bool = False

    @property
    def loads_per_node(self) -> int:
        return 3 if self.sticking else 1

    def key(self) -> str:
        """Digest of the specification and of the code's version."""
        text = json.dumps([VERSION, self.mesh.key(), self.poisson_ratio, self.sticking])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class SoftBodyModel:
    """The precomputed response, and the skin: triangles (t, 3), outward; which of its nodes are
    bounds (s,), neither touchable nor past an end of what can be touched; drag, if asked for."""

    response: SkinResponse
    triangles: NDArray[np.int32]
    bounds: NDArray[np.bool_]
    drag: DragResponse | None = None


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


def budget(mesh: SolidMesh, order: Dissection, loads_per_node: int = 1) -> Budget:
    """Memory that `compute` takes on this mesh: stiffness, factors, some loads, the result."""
    factors = sum(len(f.own) * (len(f.own) + len(f.border)) for f in order.fronts) * 8
    stiffness = len(mesh.elements) * ELEMENT_BYTES * 3
    chunk = 3 * len(mesh.nodes) * CHUNK_LOADS * 8 * 4
    loads = len(mesh.touch) * loads_per_node
    table = loads * (len(mesh.skin) * 3 * 4 + loads * 8)
    return Budget(len(mesh.skin), loads, factors + stiffness + chunk, table)


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
    loads *= spec.loads_per_node
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
    need = budget(mesh, order, spec.loads_per_node)
    require_memory(need, spec)
    done, total = MESH_STEPS, need.loads + MESH_STEPS + FACTOR_STEPS
    progress(done, total, need)
    matrices = element_stiffness(
        mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=spec.poisson_ratio
    )
    factors = order.factor(matrices)
    del matrices
    done += FACTOR_STEPS
    progress(done, total, need)

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total, need)

    table, compliance = _unit_loads(
        mesh, factors, -mesh.touch_normals[:, None], KeptParts("loads", parts), advance
    )
    drag = None
    if spec.sticking:
        tangents = tangents_of(mesh.touch_normals)
        drag_table, drag_compliance = _unit_loads(
            mesh, factors, tangents, KeptParts("drags", parts), advance
        )
        drag = DragResponse(tangents, drag_compliance, drag_table)
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
        compliance=compliance,
        table=table,
    )
    return SoftBodyModel(response, mesh.skin_triangles, bounds, drag)


@dataclass(frozen=True, slots=True)
class KeptParts:
    """Parts under one name; None: nothing is kept."""

    name: str
    parts: Parts | None

    def get(self, number: int, make: Callable[[], dict[str, Floats]]) -> dict[str, Floats]:
        """A part kept before, or made and kept now."""
        if self.parts is None:
            return make()
        name = f"{self.name}-{number:06d}"
        kept = self.parts.load(name)
        if kept is None:
            kept = make()
            self.parts.save(name, kept)
        return kept


def _unit_loads(
    mesh: SolidMesh,
    factors: Factors,
    directions: Floats,
    kept: KeptParts,
    advance: Callable[[int], None],
) -> tuple[Floats32, Floats]:
    """Table (m p, 3 s) and compliance (m p, m p) for unit forces along p directions (m, p, 3) at
    each of the m touch nodes."""
    each = directions.shape[1]
    loads = len(mesh.touch) * each
    table = np.empty((loads, 3 * len(mesh.skin)), dtype=np.float32)
    compliance = np.empty((loads, loads))
    for start in range(0, loads, CHUNK_LOADS):
        numbers = np.arange(start, min(start + CHUNK_LOADS, loads))
        node, which, count = numbers // each, numbers % each, len(numbers)

        def solved(node: Ints = node, which: Ints = which, count: int = count) -> dict[str, Floats]:
            right = np.zeros((3 * len(mesh.nodes), count))
            for axis in range(3):
                right[3 * mesh.touch[node] + axis, np.arange(count)] = directions[node, which, axis]
            moved = factors.solve(right).reshape(-1, 3, count)
            along = np.einsum("mik,mpi->kmp", moved[mesh.touch], directions)
            return {
                "table": moved[mesh.skin].reshape(-1, count).T.astype(np.float32),
                "compliance": along.reshape(count, loads),
            }

        part = kept.get(start, solved)
        table[numbers], compliance[numbers] = part["table"], part["compliance"]
        advance(count)
    return table, 0.5 * (compliance + compliance.T)


def tangents_of(normals: Floats) -> Floats:
    """Two directions (m, 2, 3) at right angles to unit normals (m, 3) and to one another."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)


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
        drag = {name[5:]: content.pop(name) for name in list(content) if name.startswith("drag_")}
        return SoftBodyModel(
            triangles=content.pop("triangles"),
            bounds=content.pop("bounds"),
            drag=DragResponse(**drag) if spec.sticking else None,
            response=SkinResponse(**content),
        )
    except (KeyError, TypeError) as error:
        say_damaged(path, error)
        return None


def save(model: SoftBodyModel, spec: SoftBodySpec, cache_dir: Path) -> Path:
    """Keep a model; a reader sees the whole file or none.  OSError if it cannot be written."""
    path = cache_path(spec, cache_dir)
    response = {one.name: getattr(model.response, one.name) for one in fields(model.response)}
    content = {"triangles": model.triangles, "bounds": model.bounds, **response}
    if model.drag is not None:
        content |= {f"drag_{one.name}": getattr(model.drag, one.name) for one in fields(model.drag)}
    save_arrays(path, content)
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
