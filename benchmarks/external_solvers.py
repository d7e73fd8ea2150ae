"""Compare the linear soft body with other solvers: a sparse factor, scikit-fem, MuJoCo.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.external_solvers [SCENE_FILE]

Each solver gets the same mesh and, except for MuJoCo, the same contact forces. The comparison is
about the cost of the skin displacement under these forces. scikit-fem and MuJoCo are not
dependencies of flexsheet: without them their rows are omitted, and a log message says so. Prints a
row per solver and depth. The first run takes minutes, because it solves the references.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.benchmarks import (
    LINEAR_DEPTH_M,
    MAX_DEPTH_M,
    ReferenceSet,
    SoftBodyBenchmark,
    make_benchmark,
)
from flexsheet.nodes.fem_solver.body import SceneBody
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import LinearSoftBody, saturate_depth
from flexsheet.nodes.fem_solver.elasticity import quadrature
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.mesh.solid import EDGES, SolidMesh
from flexsheet.nodes.methods import Trial, measure
from tests.linear_elasticity import stiffness_matrix

SPARSE_FACTOR = "one sparse factor (SuperLU), a re-solve"
SCIKIT_FEM = "scikit-fem, factor and solve"
MUJOCO = "MuJoCo flex, a step of 1 ms"
SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
DEPTHS_M = (0.003, 0.010)
REPEATS = 30
STEP_S, SETTLING_STEPS = 1e-3, 200
DENSITY, DAMPING_RATIO = 1000.0, 0.02


@dataclass(frozen=True, slots=True)
class ExternalSolution:
    """The result of an external solver.

    It contains the displacement (s, 3) of the skin, m, and the force (3,) on the finger, N.
    """

    displacement: Floats
    force_n: Floats


ExternalSolver = Callable[[ContactQuery], ExternalSolution]


def import_optional(name: str) -> Any | None:
    """Import an optional module. Log a remedy and return None if the module is not installed."""
    package = {"skfem": "scikit-fem"}.get(name, name)
    try:
        return import_module(name)
    except ImportError:
        structlog.get_logger().warning(
            "external solver omitted, not installed", to_do=f"pip install {package}"
        )
        return None


class ContactLoads:
    """The contact forces of the linear method as loads on all degrees of freedom."""

    def __init__(self, body: SceneBody, mesh: SolidMesh) -> None:
        assert isinstance(body.method, LinearSoftBody)
        self.contact, self._mesh, self._body = body.method.contact, mesh, body

    def compute(self, query: ContactQuery) -> tuple[Floats, Floats]:
        """Return the loads (3 n,) and the force (3,) on the finger."""
        loads = np.zeros_like(self._mesh.nodes)
        contact = self.contact.solve(
            query, saturate_depth(query.depth_m, LINEAR_DEPTH_M, MAX_DEPTH_M)
        )
        if contact is None:
            return loads.ravel(), np.zeros(3)
        loaded = self._mesh.contact_nodes[contact.nodes]
        loads[loaded] = -contact.forces[:, None] * self._mesh.contact_normals[contact.nodes]
        return loads.ravel(), contact.force_n


def sparse_factor(body: SceneBody, scene: Scene) -> ExternalSolver:
    """Factor the stiffness matrix once, and solve for each push."""
    from scipy.sparse.linalg import splu

    mesh = build_mesh(body.spec.mesh)
    loads = ContactLoads(body, mesh)
    stiffness = _stiffness(mesh, scene)
    free = np.flatnonzero(~np.repeat(mesh.fixed, 3))
    factor = splu(
        stiffness[free][:, free].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def solve(query: ContactQuery) -> ExternalSolution:
        right, force = loads.compute(query)
        displacement = np.zeros(len(right))
        displacement[free] = factor.solve(right[free])
        return ExternalSolution(displacement.reshape(-1, 3)[mesh.skin], force)

    return solve


def scikit_fem(body: SceneBody, scene: Scene) -> ExternalSolver | None:
    """Return a solver that assembles once, and condenses, factors and solves for each query.

    Return None if scikit-fem is not installed.
    """
    skfem = import_optional("skfem")
    if skfem is None:
        return None
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = build_mesh(body.spec.mesh)
    loads = ContactLoads(body, mesh)
    basis, order = scikit_basis(skfem, mesh.nodes, mesh.elements)
    material = require_material(scene)
    law = linear_elasticity(*lame_parameters(material.young_modulus_pa, material.poisson_ratio))
    matrix = skfem.asm(law, basis)
    fixed = np.flatnonzero(np.repeat(mesh.fixed, 3)[order])
    solver = skfem.solver_direct_scipy(permc_spec="MMD_AT_PLUS_A")

    def solve(query: ContactQuery) -> ExternalSolution:
        right, force = loads.compute(query)
        external = skfem.solve(*skfem.condense(matrix, right[order], D=fixed), solver=solver)
        displacement = np.empty(len(right))
        displacement[order] = external
        return ExternalSolution(displacement.reshape(-1, 3)[mesh.skin], force)

    return solve


def _stiffness(mesh: SolidMesh, scene: Scene) -> Any:
    material = require_material(scene)
    return stiffness_matrix(
        mesh.nodes,
        mesh.elements,
        young_modulus_pa=material.young_modulus_pa,
        poisson_ratio=material.poisson_ratio,
    )


def scikit_basis(skfem: Any, nodes: Floats, elements: Ints) -> tuple[Any, Ints]:
    """Return scikit-fem's basis on a curved mesh, and the index of each degree of freedom here.

    The quadrature is that of the solver, so that only the assembly differs.
    """
    from scipy.spatial import cKDTree

    corners = np.unique(elements[:, :4])
    straight = nodes.copy()
    straight[elements[:, 4:]] = nodes[elements[:, EDGES]].mean(axis=2)
    tetrahedra = np.searchsorted(corners, elements[:, :4])
    external = skfem.MeshTet2.from_mesh(skfem.MeshTet(straight[corners].T, tetrahedra.T))
    distance, nearest = cKDTree(straight).query(external.doflocs.T)
    assert distance.max() < 1e-12
    external = skfem.MeshTet2(nodes[nearest].T, external.t)
    points, weights = quadrature()
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis = skfem.Basis(external, element, quadrature=(points.T, weights))
    distance, node = cKDTree(nodes).query(basis.doflocs.T)
    assert distance.max() < 1e-9
    axis = np.empty(len(node), dtype=np.int64)
    for names in (basis.nodal_dofs, basis.edge_dofs):
        for number, dofs in enumerate(names):
            axis[dofs] = number
    return basis, 3 * node + axis


def mujoco_flex(
    body: SceneBody, scene: Scene, query: ContactQuery
) -> tuple[Callable[[], object], int] | None:
    """Return one step of MuJoCo's dynamics and the number of nodes of its flex.

    The finger is pushed into linear tetrahedra at the corners of the mesh. Only the time of the
    step is measured, so the contact parameters are not tuned.
    """
    mujoco = import_optional("mujoco")
    if mujoco is None:
        return None
    mesh, material = build_mesh(body.spec.mesh), require_material(scene)
    corners = np.unique(mesh.elements[:, :4])
    points, fixed = mesh.nodes[corners], np.flatnonzero(mesh.fixed[corners])
    elements = np.searchsorted(corners, mesh.elements[:, :4])
    edges = points[elements[:, 1:]] - points[elements[:, :1]]
    mass = DENSITY * float(np.abs(np.linalg.det(edges)).sum()) / 6.0
    radius = scene.finger.radius_m

    def text(values: NDArray[Any]) -> str:
        return " ".join(f"{value:.9g}" for value in values.ravel())

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{STEP_S}" integrator="discrete" gravity="0 0 0"/>
        <size memory="1G"/>
        <worldbody>
        <body name="finger" mocap="true"><geom type="sphere" size="{radius}"/></body>
        <flexcomp name="body" type="direct" dim="3" mass="{mass}" radius="0.0002"
          point="{text(points)}" element="{text(elements)}">
        <elasticity young="{material.young_modulus_pa}" poisson="{material.poisson_ratio}"
          damping="{DAMPING_RATIO}"/>
        <contact selfcollide="none"/><pin id="{text(fixed)}"/>
        </flexcomp></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    for step in range(SETTLING_STEPS):
        depth = query.depth_m * min(1.0, 2.0 * step / SETTLING_STEPS)
        data.mocap_pos[0] = query.surface + (radius - depth) * query.normal
        mujoco.mj_step(model, data)
    return lambda: mujoco.mj_step(model, data), len(corners)


def external_trials(
    benchmark: SoftBodyBenchmark, references: ReferenceSet, depths_m: tuple[float, ...] = DEPTHS_M
) -> Iterator[Trial]:
    """Yield each external solver at each depth, on the linear method's mesh of medium spacing."""
    spacings = sorted(benchmark.linear_m.values())
    body, scene = benchmark.linear(spacings[len(spacings) // 2])[0], benchmark.scene
    sample = references.sample
    queries = {depth: ContactQuery(sample.point, sample.normal, depth) for depth in depths_m}
    solvers: dict[str, ExternalSolver | None] = {
        SPARSE_FACTOR: sparse_factor(body, scene),
        SCIKIT_FEM: scikit_fem(body, scene),
    }
    for name, solver in solvers.items():
        for depth, query in queries.items():
            if solver is not None:
                run = partial(solver, query)
                in_range = depth <= LINEAR_DEPTH_M
                yield references.trial(name, depth, body.rest, run, in_range=in_range)
    for depth, query in queries.items():
        flex = mujoco_flex(body, scene, query)
        if flex is not None:
            step, nodes = flex
            yield Trial(
                method=MUJOCO,
                case={"depth_mm": 1e3 * depth},
                size={"mesh_nodes": nodes},
                run=step,
                error=lambda _: float("nan"),
                in_range=False,
            )


def main() -> None:
    scene = load_scene(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENE_FILE)
    benchmark = make_benchmark(scene)
    for trial in external_trials(benchmark, benchmark.reference_set()):
        point = measure(trial, repeats=REPEATS)
        print(
            f"{point.method}, {point.params}: {1e6 * point.median_s:.0f} / "
            f"{1e6 * point.p99_s:.0f} us, {point.error:.3f} mm",
            flush=True,
        )


if __name__ == "__main__":
    main()
