"""Compute and cache the response of the skin to a unit force on every touchable node.

The skin is the surface of the soft body. The name of the cache file contains a digest of the
inputs. Young's modulus is not an input. The response is stored for a modulus of 1 Pa, because it is
inversely proportional to Young's modulus.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Plane
from flexsheet.nodes.arrays import Bools, Floats, Singles
from flexsheet.nodes.cache import Specification, cached, encode_fields, make_digest
from flexsheet.nodes.fem_solver.contact import SkinResponse
from flexsheet.nodes.fem_solver.mesh.from_scene import (
    BYTES_PER_NODE,
    MeshSpec,
    build_mesh,
    estimate_node_count,
)
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.models.shapes import make_shape

if TYPE_CHECKING:
    from flexsheet.nodes.fem_solver.multifrontal import Factors

VERSION = 4
"""The version of the computation. Increase it when results for the same specification change."""
CHUNK_LOADS = 128
MESH_STEPS, FACTOR_STEPS = 1, 4
"""The approximate durations of two steps: meshing, and factoring the stiffness matrix. They are
used for progress reports, in units of the time that one unit force needs."""

Progress = Callable[[int, int, str], None]
"""A callback that receives the number of finished steps, the total number of steps, and a text
about the required resources. The first call is before the work starts."""


@dataclass(frozen=True, slots=True, eq=False)
class SoftBodySpec:
    """The inputs of the precomputation of a body's linear response."""

    mesh: MeshSpec
    poisson_ratio: float

    def depends_on(self) -> list[object]:
        """Return all inputs of the linear response as a JSON value."""
        return [VERSION, self.mesh.key(), self.poisson_ratio]

    def key(self) -> str:
        """Return a digest of the inputs and of `VERSION`, which identifies the linear response."""
        return make_digest(self.depends_on())


@dataclass(frozen=True, slots=True)
class SoftBodyModel:
    """The precomputed elastic response of a soft body, and its skin mesh.

    response: response to normal forces.
    triangles (t, 3): skin triangles with outward normals.
    bounds (s,): whether the finger must not touch each skin node, for example because the support
        fixes the node. Nodes on end faces are not marked.
    """

    response: SkinResponse
    triangles: NDArray[np.int32]
    bounds: Bools


@dataclass(frozen=True, slots=True)
class ResponseBudget:
    """An estimate of the resources that a precomputation needs.

    loads: number of unit forces. working_bytes: memory that the computation needs. table_bytes:
    memory that the results need.
    """

    skin_nodes: int
    loads: int
    working_bytes: int
    table_bytes: int

    def text(self) -> str:
        return (
            f"{self.loads} loads on {self.skin_nodes} skin nodes, "
            f"{(self.working_bytes + self.table_bytes) / 1e6:.0f} MB"
        )

    def require_memory(self, skin_spacing_m: float) -> None:
        """Raise MemoryError if the computer has too little free memory for the precomputation."""
        require_memory(
            self.working_bytes + self.table_bytes,
            f"the precomputation of {self.loads} loads on {self.skin_nodes} skin nodes",
            f"increase skin_spacing_m above {skin_spacing_m:g}",
        )


def estimate_budget(spec: SoftBodySpec) -> ResponseBudget:
    """Estimate the resources of a precomputation within a factor of two, without meshing.

    Raises UnfitMeshError if the skin spacing does not fit the object or requires too many nodes.
    """
    nodes = estimate_node_count(spec.mesh, make_shape(dict(spec.mesh.geometry)))
    # Empirical numbers of skin nodes, and of touchable nodes among them.
    skin = int(6.0 * nodes ** (2.0 / 3.0))
    loads, geometry = skin // 2, spec.mesh.geometry
    if isinstance(geometry, Plane):
        loads = int(geometry.width_m * geometry.height_m / spec.mesh.skin_spacing_m**2)
    return ResponseBudget(
        skin, loads, (BYTES_PER_NODE + 16_000) * nodes, loads * (skin * 12 + loads * 8)
    )


def compute(spec: SoftBodySpec, progress: Progress) -> SoftBodyModel:
    """Mesh the object, factor its stiffness matrix, and compute the response to a unit force on
    each touchable node.

    Raises UnfitMeshError if the object cannot be meshed, ValueError if the material or a size is
    invalid, and MemoryError if the free memory is insufficient.
    """
    from flexsheet.nodes.fem_solver.elasticity import (
        element_stiffness,
        lame_constants,
    )
    from flexsheet.nodes.fem_solver.multifrontal import NestedDissection

    lame_constants(1.0, spec.poisson_ratio)
    need = estimate_budget(spec)
    progress(0, need.loads + MESH_STEPS + FACTOR_STEPS, need.text())
    need.require_memory(spec.mesh.skin_spacing_m)
    mesh = build_mesh(spec.mesh)
    order = NestedDissection(mesh.nodes, mesh.elements, mesh.fixed)
    done, total = 0, len(mesh.contact_nodes) + MESH_STEPS + FACTOR_STEPS

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total, need.text())

    advance(MESH_STEPS)
    matrices = element_stiffness(
        mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=spec.poisson_ratio
    )
    factors = order.factor(matrices)
    del matrices
    advance(FACTOR_STEPS)

    influence, compliance = _solve_unit_loads(mesh, factors, advance)
    contact_nodes = np.searchsorted(mesh.skin, mesh.contact_nodes)
    skin = mesh.nodes[mesh.skin]
    found = make_shape(dict(spec.mesh.geometry)).closest(skin)
    # Nodes that are not on the touchable shape are on end caps or on the sides of a slab.
    off_surface = np.linalg.norm(found.point - skin, axis=1) > 0.5 * spec.mesh.skin_spacing_m
    bounds = ~(off_surface | found.on_edge)
    bounds[contact_nodes] = False
    response = SkinResponse(
        rest=skin,
        contact_nodes=contact_nodes,
        normals=mesh.contact_normals,
        faces=mesh.contact_faces,
        compliance=compliance,
        influence=influence,
    )
    return SoftBodyModel(response, mesh.skin_triangles, bounds)


def _solve_unit_loads(
    mesh: SolidMesh, factors: Factors, advance: Callable[[int], None]
) -> tuple[Singles, Floats]:
    """Compute the displacements for an inward unit force at each of the m contact nodes.

    advance: function that receives the number of newly finished unit forces.

    Returns two arrays of displacements per force, m/N. The first array (m, 3s) contains the
    displacements of the s skin nodes. The second array (m, m) contains the inward displacements of
    the contact nodes.
    """
    loads, inward = len(mesh.contact_nodes), -mesh.contact_normals
    influence = np.empty((loads, 3 * len(mesh.skin)), dtype=np.float32)
    compliance = np.empty((loads, loads))
    for start in range(0, loads, CHUNK_LOADS):
        numbers = np.arange(start, min(start + CHUNK_LOADS, loads))
        count = len(numbers)
        right = np.zeros((len(mesh.nodes), 3, count))
        right[mesh.contact_nodes[numbers], :, np.arange(count)] = inward[numbers]
        moved = factors.solve(right.reshape(-1, count)).reshape(-1, 3, count)
        influence[numbers] = moved[mesh.skin].reshape(-1, count).T
        compliance[numbers] = np.einsum("mik,mi->km", moved[mesh.contact_nodes], inward)
        advance(count)
    return influence, 0.5 * (compliance + compliance.T)


def require_memory(required_bytes: int, what: str, remedy: str) -> None:
    """Raise MemoryError if the computer has less free memory than required.

    what: name of the computation that needs the memory. remedy: advice to the user. Both are parts
    of the error text.
    """
    import psutil

    free = psutil.virtual_memory().available
    if required_bytes > free:
        raise MemoryError(
            f"{what} needs {required_bytes / 2**30:.1f} GiB of memory, but only "
            f"{free / 2**30:.1f} GiB are free on this computer; {remedy}"
        )


def response_cache(spec: SoftBodySpec) -> Specification[SoftBodyModel]:
    """Return the cache key of a linear response, with functions that encode and decode it."""

    def encode(model: SoftBodyModel) -> dict[str, NDArray[Any]]:
        own = {"triangles": model.triangles, "bounds": model.bounds}
        return own | encode_fields(model.response)

    def decode(content: dict[str, NDArray[Any]]) -> SoftBodyModel:
        triangles, bounds = content.pop("triangles"), content.pop("bounds")
        return SoftBodyModel(SkinResponse(**content), triangles, bounds)

    return Specification("soft-body", spec.depends_on(), encode, decode)


def load_or_compute(spec: SoftBodySpec, cache_dir: Path, progress: Progress) -> SoftBodyModel:
    """Load the cached model, or compute and store it.

    Raises UnfitMeshError if the object cannot be meshed, ValueError if the material or a size is
    invalid, and MemoryError if the free memory is insufficient.
    """
    return cached(response_cache(spec), cache_dir, lambda: compute(spec, progress))
