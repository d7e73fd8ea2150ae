"""The linear body by what others offer, for the chart: a sparse factor, scikit-fem, MuJoCo.

Each gets the same mesh, and, but for MuJoCo, the same contact forces: what is compared is what it
takes to get the skin from them.  scikit-fem and MuJoCo are not among what flexsheet needs: without
them their rows are left out, and that is logged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.fem_solver.body import SceneBody
from nodes.fem_solver.contact import LinearSoftBody, saturated
from nodes.fem_solver.elasticity import quadrature, stiffness_matrix
from nodes.fem_solver.mesh import EDGES, SolidMesh, build_mesh
from nodes.fem_solver.place import Push

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SPARSE_FACTOR = "one sparse factor (SuperLU), a re-solve"
SCIKIT_FEM = "scikit-fem, factor and solve"
MUJOCO = "MuJoCo flex, a step of 1 ms"
STEP_S, SETTLING_STEPS = 1e-3, 200
DENSITY, DAMPING_RATIO = 1000.0, 0.02


@dataclass(frozen=True, slots=True)
class Moved:
    """A peer's answer: displacement (s, 3) of the skin and the force (3,) on the finger, N."""

    displacement: Floats
    force_n: Floats


Answer = Callable[[Push], Moved]


def peer(name: str) -> Any | None:
    """A module that flexsheet does without, or None, which is logged with what to do."""
    package = {"skfem": "scikit-fem"}.get(name, name)
    try:
        return import_module(name)
    except ImportError:
        structlog.get_logger().warning(
            "peer left out, not installed", to_do=f"pip install {package}"
        )
        return None


class _Loads:
    """Contact forces of the linear method as loads on all degrees of freedom."""

    def __init__(self, body: SceneBody, mesh: SolidMesh) -> None:
        assert isinstance(body.method, LinearSoftBody)
        self.contact, self._mesh, self._body = body.method.contact, mesh, body

    def of(self, push: Push) -> tuple[Floats, Floats]:
        """Loads (3 n,) and the force (3,) on the finger."""
        loads = np.zeros_like(self._mesh.nodes)
        contact = self.contact.solve(push, saturated(push.depth_m, *LINEAR_RANGE_M))
        if contact is None:
            return loads.ravel(), np.zeros(3)
        touched = self._mesh.touch[contact.nodes]
        loads[touched] = -contact.forces[:, None] * self._mesh.touch_normals[contact.nodes]
        return loads.ravel(), contact.force_n


LINEAR_RANGE_M = (0.006, 0.010)
"""Of the linear method: from where it bends, and the largest depth."""


def sparse_factor(body: SceneBody, scene: Scene) -> Answer:
    """A factor made once, one solution for each answer, instead of the precomputed rows."""
    from scipy.sparse.linalg import splu

    mesh = build_mesh(body.spec.mesh)
    loads = _Loads(body, mesh)
    stiffness = _stiffness(mesh, scene)
    free = np.flatnonzero(~np.repeat(mesh.fixed, 3))
    factor = splu(
        stiffness[free][:, free].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def answer(push: Push) -> Moved:
        right, force = loads.of(push)
        moved = np.zeros(len(right))
        moved[free] = factor.solve(right[free])
        return Moved(moved.reshape(-1, 3)[mesh.skin], force)

    return answer


def scikit_fem(body: SceneBody, scene: Scene) -> Answer | None:
    """Assembled once by scikit-fem; condensed, factored and solved by it for each answer."""
    skfem = peer("skfem")
    if skfem is None:
        return None
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = build_mesh(body.spec.mesh)
    loads = _Loads(body, mesh)
    basis, order = _their_basis(skfem, mesh)
    material = scene.object.material
    law = linear_elasticity(*lame_parameters(material.young_modulus_pa, material.poisson_ratio))
    matrix = skfem.asm(law, basis)
    held = np.flatnonzero(np.repeat(mesh.fixed, 3)[order])
    solver = skfem.solver_direct_scipy(permc_spec="MMD_AT_PLUS_A")

    def answer(push: Push) -> Moved:
        right, force = loads.of(push)
        theirs = skfem.solve(*skfem.condense(matrix, right[order], D=held), solver=solver)
        moved = np.empty(len(right))
        moved[order] = theirs
        return Moved(moved.reshape(-1, 3)[mesh.skin], force)

    return answer


def _stiffness(mesh: SolidMesh, scene: Scene) -> Any:
    material = scene.object.material
    return stiffness_matrix(
        mesh.nodes,
        mesh.elements,
        young_modulus_pa=material.young_modulus_pa,
        poisson_ratio=material.poisson_ratio,
    )


def _their_basis(skfem: Any, mesh: SolidMesh) -> tuple[Any, Ints]:
    """scikit-fem's basis on the curved mesh, and our degree of freedom for each of its."""
    from scipy.spatial import cKDTree

    corners = np.unique(mesh.elements[:, :4])
    straight = mesh.nodes.copy()
    straight[mesh.elements[:, 4:]] = mesh.nodes[mesh.elements[:, EDGES]].mean(axis=2)
    tetrahedra = np.searchsorted(corners, mesh.elements[:, :4])
    theirs = skfem.MeshTet2.from_mesh(skfem.MeshTet(straight[corners].T, tetrahedra.T))
    _, ours = cKDTree(straight).query(theirs.doflocs.T)
    theirs = skfem.MeshTet2(mesh.nodes[ours].T, theirs.t)
    points, weights = quadrature()
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis = skfem.Basis(theirs, element, quadrature=(points.T, weights))
    _, node = cKDTree(mesh.nodes).query(basis.doflocs.T)
    axis = np.empty(len(node), dtype=np.int64)
    for names in (basis.nodal_dofs, basis.edge_dofs):
        for number, dofs in enumerate(names):
            axis[dofs] = number
    return basis, 3 * node + axis


def mujoco_flex(
    body: SceneBody, scene: Scene, push: Push
) -> tuple[Callable[[], object], int] | None:
    """A step of MuJoCo's dynamics, the finger pushed into a flex of the mesh's corners (linear
    tetrahedra), and how many nodes that has.  Its contact is untuned: only the time counts."""
    mujoco = peer("mujoco")
    if mujoco is None:
        return None
    mesh, material = build_mesh(body.spec.mesh), scene.object.material
    corners = np.unique(mesh.elements[:, :4])
    points, held = mesh.nodes[corners], np.flatnonzero(mesh.fixed[corners])
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
        <contact selfcollide="none"/><pin id="{text(held)}"/>
        </flexcomp></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    for step in range(SETTLING_STEPS):
        depth = push.depth_m * min(1.0, 2.0 * step / SETTLING_STEPS)
        data.mocap_pos[0] = push.surface + (radius - depth) * push.normal
        mujoco.mj_step(model, data)
    return lambda: mujoco.mj_step(model, data), len(corners)
