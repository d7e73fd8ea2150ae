"""The skin's response to every load that a finger can put on it: computed once, kept on disk.

A file is named by a digest of all that it depends on.  Young's modulus is not among that: the
response scales with 1/E, so it is stored for 1 Pa.  A file is written beside its place and renamed
into it when whole, and it is read only if every checksum in it holds.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from nodes.fem_solver.contact import SkinResponse
from nodes.fem_solver.mesh import SolidMesh, cylinder_mesh

VERSION = 1
"""Counts up whenever the same specification gives other numbers."""
CHUNK_LOADS = 128
DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading a file that is cut, changed or of another kind may raise."""

Progress = Callable[[int, int, "Budget"], None]
"""Called with (done, total) steps of the work and what it needs, first before it starts; may raise
`Interrupted` to stop it."""


class Interrupted(Exception):
    """The computation was asked to stop; nothing was written."""


@dataclass(frozen=True, slots=True)
class SoftBodySpec:
    """All that a precomputation depends on; see `mesh.cylinder_mesh`."""

    radius_m: float
    length_m: float
    support_angle_rad: float
    touch_angle_rad: float
    skin_spacing_m: float
    poisson_ratio: float

    def key(self) -> str:
        """Digest of the specification and of the code's version."""
        text = json.dumps({"version": VERSION, **asdict(self)}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class SoftBodyModel:
    """The precomputed response and the triangles of its skin (t, 3), outward."""

    response: SkinResponse
    triangles: NDArray[np.int32]


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


def mesh_of(spec: SoftBodySpec) -> SolidMesh:
    """The mesh of a specification; ValueError as `cylinder_mesh`."""
    return cylinder_mesh(
        radius_m=spec.radius_m,
        length_m=spec.length_m,
        support_angle_rad=spec.support_angle_rad,
        touch_angle_rad=spec.touch_angle_rad,
        skin_spacing_m=spec.skin_spacing_m,
    )


def budget(mesh: SolidMesh) -> Budget:
    """Memory that `compute` takes on this mesh: factors and one chunk of loads, and the result."""
    slabs = 3 * np.bincount(mesh.slab).astype(np.int64)
    factors = int((slabs**2).sum() + (slabs[:-1] * slabs[1:]).sum()) * 8
    chunk = 3 * len(mesh.nodes) * CHUNK_LOADS * 8 * 4
    table = len(mesh.touch) * len(mesh.skin) * 3 * 4 + len(mesh.touch) ** 2 * 8
    return Budget(len(mesh.skin), len(mesh.touch), factors + chunk, table)


def compute(spec: SoftBodySpec, progress: Progress) -> SoftBodyModel:
    """Mesh, factor, and solve for one unit load per touchable skin node.

    MeshError for a body that nothing holds, ValueError for a material or size out of bounds,
    MemoryError, before anything is allocated, if the machine has too little.
    """
    from nodes.fem_solver.elasticity import require_support, stiffness_matrix
    from nodes.fem_solver.factor import SlabCholesky

    mesh = mesh_of(spec)
    require_support(mesh.nodes, mesh.fixed)
    need = budget(mesh)
    require_memory(need, spec)
    loads, slabs = len(mesh.touch), int(mesh.slab.max()) + 1
    done, total = 0, slabs + loads

    def advance(steps: int = 1) -> None:
        nonlocal done
        done += steps
        progress(done, total, need)

    advance(0)
    stiffness = stiffness_matrix(
        mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=spec.poisson_ratio
    )
    factor = SlabCholesky(stiffness, mesh.slab, mesh.fixed, on_slab=advance)
    table = np.empty((loads, 3 * len(mesh.skin)), dtype=np.float32)
    compliance = np.empty((loads, loads))
    for start in range(0, loads, CHUNK_LOADS):
        part = slice(start, min(start + CHUNK_LOADS, loads))
        count = part.stop - start
        right = np.zeros((3 * len(mesh.nodes), count))
        for axis in range(3):
            right[3 * mesh.touch[part] + axis, np.arange(count)] = -mesh.touch_normals[part, axis]
        moved = factor.solve(right).reshape(-1, 3, count)
        table[part] = moved[mesh.skin].reshape(-1, count).T
        compliance[part] = -np.einsum("mik,mi->km", moved[mesh.touch], mesh.touch_normals)
        advance(count)
    response = SkinResponse(
        rest=mesh.nodes[mesh.skin],
        touch=np.searchsorted(mesh.skin, mesh.touch),
        normals=mesh.touch_normals,
        faces=mesh.touch_faces,
        compliance=0.5 * (compliance + compliance.T),
        table=table,
    )
    return SoftBodyModel(response, mesh.skin_triangles)


def require_memory(need: Budget, spec: SoftBodySpec) -> None:
    """MemoryError if the machine has less memory free than the computation takes."""
    import psutil

    free = psutil.virtual_memory().available
    wanted = need.working_bytes + need.table_bytes
    if wanted > free:
        raise MemoryError(
            f"precomputing {need.loads} loads on {need.skin_nodes} skin nodes takes "
            f"{wanted / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free; raise "
            f"skin_spacing_m above {spec.skin_spacing_m:g}"
        )


def default_cache_dir() -> Path:
    """$XDG_CACHE_HOME/flexsheet, or ~/.cache/flexsheet."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "flexsheet"


def cache_path(spec: SoftBodySpec, cache_dir: Path) -> Path:
    return cache_dir / f"soft-body-{spec.key()}.npz"


def load(spec: SoftBodySpec, cache_dir: Path) -> SoftBodyModel | None:
    """The model kept for this specification; None if there is none, or (logged) it is damaged."""
    path = cache_path(spec, cache_dir)
    try:
        # reading a member of the archive to its end verifies its CRC-32
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        return SoftBodyModel(triangles=content.pop("triangles"), response=SkinResponse(**content))
    except FileNotFoundError:
        return None
    except DAMAGE as error:
        structlog.get_logger().warning(
            "damaged cache file is computed anew", path=str(path), error=repr(error)
        )
        return None


def save(model: SoftBodyModel, spec: SoftBodySpec, cache_dir: Path) -> Path:
    """Keep a model; a reader sees the whole file or none.  OSError if it cannot be written."""
    cache_dir.mkdir(parents=True, exist_ok=True)
    path = cache_path(spec, cache_dir)
    _remove_leftovers(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp")
    response = model.response
    try:
        with temporary.open("wb") as file:
            np.savez(
                file,
                triangles=model.triangles,
                rest=response.rest,
                touch=response.touch,
                normals=response.normals,
                faces=response.faces,
                compliance=response.compliance,
                table=response.table,
            )
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _remove_leftovers(path: Path) -> None:
    """Delete temporary files of processes that are gone (killed while they wrote)."""
    import psutil

    for leftover in path.parent.glob(f".{path.stem}.*.tmp"):
        owner = leftover.name.split(".")[-2]
        if owner.isdigit() and not psutil.pid_exists(int(owner)):
            leftover.unlink(missing_ok=True)


def load_or_compute(spec: SoftBodySpec, cache_dir: Path, progress: Progress) -> SoftBodyModel:
    """The kept model, or a new one that is then kept; errors as `compute` and `save`."""
    model = load(spec, cache_dir)
    if model is None:
        model = compute(spec, progress)
        save(model, spec, cache_dir)
    return model
