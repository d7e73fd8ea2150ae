"""Measure the limits of the soft body's methods.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.soft_body_limits [CASE ...]

The bodies are small and coarse, so that the benchmark takes minutes. The maximum depth of Newton's
method depends on the mesh, and is printed with it. The nonlinear table consists of such pushes, and
ends `END_SPAN_M` before them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.fem_solver.body import SceneBody, build_scene_body, make_soft_body_spec
from flexsheet.nodes.fem_solver.closest_contact import ContactAnchor, ContactQuery
from flexsheet.nodes.fem_solver.contact import LinearSoftBody
from flexsheet.nodes.fem_solver.elasticity import element_stiffness
from flexsheet.nodes.fem_solver.hyperelastic import NeoHookeanSolid
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.mesh.quality import min_jacobian_ratios
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.fem_solver.multifrontal import NestedDissection
from flexsheet.nodes.fem_solver.precompute import SoftBodyModel, compute
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, Snapshot, SnapshotJob, solve_snapshot
from flexsheet.nodes.fem_solver.table import END_SPAN_M
from flexsheet.nodes.models import rigid

Floats = NDArray[np.float64]

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
SPACING_M = 0.005
RADIUS_M = 0.02
CYLINDER = {"shape": "cylinder", "radius_m": RADIUS_M, "length_m": 0.05}
STRIP = {"kind": "strip", "angle_rad": 1.57}
DEPTHS_M = tuple(1e-3 * d for d in range(1, 36))
STEP_M = 2e-5
LINEAR_DEPTH_M, MAX_DEPTH_M = 0.006, 0.010


@dataclass(frozen=True, slots=True)
class Body:
    """The soft body of a scene by the linear method, and its mesh."""

    scene: Scene
    soft: SceneBody
    model: SoftBodyModel
    mesh: SolidMesh


def make_scene(
    geometry: dict[str, Any],
    support: dict[str, Any],
    *,
    height_m: float,
    nu: float = 0.45,
    finger_m: float = 0.007,
) -> Scene:
    """Return the demo's scene with another object whose front is at the world's origin."""
    content = load_scene(SCENE_FILE).model_dump()
    content["object"] = {
        "geometry": geometry,
        "support": support,
        "material": content["object"]["material"] | {"poisson_ratio": nu},
        "world_from_object": {"position_m": [0.0, 0.0, -height_m], "rpy_rad": [0.0, 0.0, 0.0]},
    }
    content["finger"]["radius_m"] = finger_m
    return Scene.model_validate(content)


def cylinder(**changes: float) -> Scene:
    return make_scene(CYLINDER, STRIP, height_m=0.02, **changes)


def make_body(
    scene: Scene, spacing_m: float = SPACING_M, *, meshed_for: Scene | None = None
) -> Body:
    """Make the scene's body; meshed_for: scene whose finger's size determines the mesh."""
    spec = make_soft_body_spec(meshed_for or scene, spacing_m)
    model = compute(spec, lambda *_: None)
    soft = build_scene_body(
        scene, spec, model, linear_depth_m=LINEAR_DEPTH_M, max_depth_m=MAX_DEPTH_M
    )
    return Body(scene, soft, model, build_mesh(spec.mesh))


def make_sample(body: Body, x: float = 0.002, y: float = 0.0015) -> SamplePoint:
    found = body.soft.shape.closest(body.soft.front + np.array([x, y, 0.0]))
    return SamplePoint(found.point, found.normal)


def newton(body: Body, sample: SamplePoint, depths_m: tuple[float, ...] = DEPTHS_M) -> Snapshot:
    """Solve for the forces at several depths with Newton's method on the mesh of the body."""
    return solve_snapshot(
        SnapshotJob(
            nodes=body.mesh.nodes,
            elements=body.mesh.elements,
            fixed=body.mesh.fixed,
            faces=body.mesh.contact_nodes[body.mesh.contact_faces],
            sample=sample,
            poisson_ratio=body.soft.spec.poisson_ratio,
            finger_radius_m=body.scene.finger.radius_m,
            depths_m=depths_m,
        )
    )


def deepest_mm(answer: Snapshot) -> float:
    return 1e3 * float(answer.depths_m[answer.reached - 1]) if answer.reached else 0.0


def table_mm(newton_mm: float) -> float:
    return max(0.0, newton_mm - 1e3 * END_SPAN_M)


def count_inverted(body: Body, moved: NDArray[Any]) -> int:
    """Return the number of skin triangles whose normal is rotated by more than a right angle."""

    def normals(points: Floats) -> Floats:
        a, b, c = points[body.model.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    rest = body.soft.rest
    return int(((normals(rest) * normals(rest + moved)).sum(axis=1) <= 0.0).sum())


def linear_inversion_mm(body: Body, sample: SamplePoint) -> float:
    """Return the depth at which the unlimited linear field first inverts a corner of an element."""
    mesh, nu = body.mesh, body.soft.spec.poisson_ratio
    matrices = element_stiffness(mesh.nodes, mesh.elements, young_modulus_pa=1.0, poisson_ratio=nu)
    factors = NestedDissection(mesh.nodes, mesh.elements, mesh.fixed).factor(matrices)
    method = body.soft.method
    assert isinstance(method, LinearSoftBody)
    for depth in DEPTHS_M:
        contact = method.contact.solve(ContactQuery(sample.point, sample.normal, depth), depth)
        assert contact is not None
        loads = np.zeros_like(mesh.nodes)
        forces = contact.forces / require_material(body.scene).young_modulus_pa
        loads[mesh.contact_nodes[contact.nodes]] = (
            -forces[:, None] * mesh.contact_normals[contact.nodes]
        )
        moved = factors.solve(loads.ravel()).reshape(-1, 3)
        if min_jacobian_ratios(mesh.nodes + moved, mesh.elements).min() <= 0.0:
            return 1e3 * depth
    return np.inf


def row(*cells: object) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def incompressible() -> None:
    """Vary Poisson's ratio towards 0.5."""
    row("ν", "linear: force at 3 mm", "Newton: to", "table: to", "refused")
    for nu in (0.3, 0.45, 0.49, 0.499, 0.4999, 0.49995):
        try:
            body = make_body(cylinder(nu=nu))
        except ValueError as error:
            row(nu, "-", "-", "-", error)
            continue
        sample = make_sample(body)
        force = body.soft.method.respond(ContactQuery(sample.point, sample.normal, 0.003)).force_n
        end = deepest_mm(newton(body, sample))
        newtons = f"{1e3 * float(force @ sample.normal):.1f} mN"
        row(nu, newtons, f"{end:g} mm", f"{table_mm(end):g} mm", "")


def inversion() -> None:
    """Push to increasing depths."""
    row("skin spacing", "linear field inverts at", "Newton: to", "shown at 50 mm", "count_inverted")
    for spacing in (0.005, 0.004, 0.003):
        body = make_body(cylinder(), spacing)
        sample = make_sample(body)
        end = "not run" if spacing <= 0.003 else f"{deepest_mm(newton(body, sample)):g} mm"
        answer = body.soft.method.respond(ContactQuery(sample.point, sample.normal, 0.050))
        largest = 1e3 * float(np.linalg.norm(answer.displacement, axis=1).max())
        flag = "in range" if answer.in_range else "flagged"
        row(
            f"{1e3 * spacing:g} mm",
            f"{linear_inversion_mm(body, sample):g} mm",
            end,
            f"skin moves {largest:.1f} mm, {flag}",
            count_inverted(body, answer.displacement),
        )


def slide(body: Body, depth_m: float, way: Floats, start: Floats) -> tuple[float, float, int]:
    """Slide a finger across a body at constant depth, in steps of 0.02 mm.

    Return the maximum displacement (mm) of a skin node in a step, the fraction of flagged steps,
    and the maximum number of inverted triangles.
    """
    held: ContactAnchor | None = None
    before: NDArray[Any] | None = None
    jump, flagged, most = 0.0, 0, 0
    steps = 1000
    for step in range(steps):
        found = body.soft.shape.closest(start + step * STEP_M * way)
        point = rigid.apply(body.soft.world_from_mesh, found.point - depth_m * found.normal)
        answer, held = body.soft.respond(point, held)
        flagged += not answer.in_range
        if step % 50 == 0:
            most = max(most, count_inverted(body, answer.displacement))
        if before is not None:
            move = float(np.linalg.norm(answer.displacement - before, axis=1).max())
            jump = max(jump, 1e3 * move)
        before = answer.displacement
    return jump, flagged / steps, most


def rim() -> None:
    """Slide a finger over the edge of a box, from its front to its side."""
    row(
        "edge radius",
        "depth",
        "largest jump",
        "flagged",
        "count_inverted",
        "Newton on the edge: to",
    )
    for edge in (0.010, 0.005, 0.0025):
        box = {"shape": "rounded_box", "size_m": [0.06, 0.05, 0.03], "edge_radius_m": edge}
        body = make_body(make_scene(box, STRIP, height_m=0.015))
        start = np.array([0.018, 0.001, 0.03])
        found = body.soft.shape.closest(np.array([0.030, 0.001, 0.015]))
        end = deepest_mm(newton(body, SamplePoint(found.point, found.normal), DEPTHS_M[:15]))
        for depth in (0.002, 0.006):
            jump, flagged, most = slide(body, depth, np.array([1.0, 0.0, -0.6]), start)
            row(
                f"{1e3 * edge:g} mm",
                f"{1e3 * depth:g} mm",
                f"{jump:.3f} mm",
                f"{100 * flagged:.0f} %",
                most,
                f"{end:g} mm",
            )


def two_supports() -> None:
    """Compare a cylinder that is fixed at its ends with a cylinder that is fixed along its back."""
    row("held", "held nodes", "linear: force at 5 mm", "skin moves at most", "Newton: to")
    ends = {"kind": "box_patch", "min_m": [-1, -0.008, -0.008], "max_m": [1, 0.008, 0.008]}
    point = {"kind": "sphere_patch", "centre_m": [0.025, 0.0, 0.0], "radius_m": 0.0005}
    for name, support in (("back", STRIP), ("two ends", ends), ("one point", point)):
        try:
            body = make_body(make_scene(CYLINDER, support, height_m=0.02))
        except ValueError as error:
            row(name, "-", f"refused: {error}", "-", "-")
            continue
        sample = make_sample(body)
        answer = body.soft.method.respond(ContactQuery(sample.point, sample.normal, 0.005))
        row(
            name,
            int(body.mesh.fixed.sum()),
            f"{1e3 * float(answer.force_n @ sample.normal):.0f} mN",
            f"{1e3 * float(np.linalg.norm(answer.displacement, axis=1).max()):.1f} mm",
            f"{deepest_mm(newton(body, sample)):g} mm",
        )


def slivers() -> None:
    """Flatten elements: move the nodes inside the cylinder towards a plane."""
    row("flatten_element to", "least height over edge", "Newton: force at 3 mm", "Newton: to")
    base = make_body(cylinder())
    sample = make_sample(base)
    for share in (1.0, 0.3, 0.1, 0.03, 0.01, 0.001, 0.0):
        nodes = flatten_element(base.mesh, share)
        try:
            NeoHookeanSolid(nodes, base.mesh.elements, young_modulus_pa=1.0, poisson_ratio=0.45)
            force = force_n(base, nodes, sample)
        except ValueError as error:
            row(share, "-", f"refused: {error}", "-")
            continue
        mesh = replace(base.mesh, nodes=nodes)
        end = deepest_mm(newton(replace(base, mesh=mesh), sample))
        row(share, f"{thinnest(nodes, base.mesh):.2g}", f"{1e3 * force:.1f} mN", f"{end:g} mm")


def flatten_element(mesh: SolidMesh, share: float) -> Floats:
    """Return the nodes of a mesh with one inner corner close to the opposite face of an element.

    share: distance as a fraction of the corner's height. Edges remain straight.
    """
    skin = np.zeros(len(mesh.nodes), dtype=bool)
    skin[mesh.skin] = True
    corners = mesh.elements[:, :4]
    front = mesh.nodes[corners].mean(axis=1)[:, 2]
    ready = np.flatnonzero((~skin[corners]).any(axis=1) & ~mesh.fixed[corners].any(axis=1))
    element = mesh.elements[ready[int(front[ready].argmax())]]
    inner = int(next(node for node in element[:4] if not skin[node]))
    others = [int(node) for node in element[:4] if node != inner]
    a, b, c = mesh.nodes[others]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    move = -(1.0 - share) * float((mesh.nodes[inner] - a) @ normal) * normal
    nodes = mesh.nodes.copy()
    nodes[inner] += move
    around = mesh.elements[(corners == inner).any(axis=1)]
    for one in around:
        for middle, (i, j) in zip(one[4:], EDGES_OF, strict=True):
            if inner in (one[i], one[j]) and not skin[middle]:
                nodes[middle] = mesh.nodes[middle] + 0.5 * move
    return nodes


EDGES_OF = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def thinnest(nodes: Floats, mesh: SolidMesh) -> float:
    """Return the minimum ratio of height to longest edge over all elements."""
    corners = nodes[mesh.elements[:, :4]]
    edges = corners[:, [1, 2, 3, 2, 3, 3]] - corners[:, [0, 0, 0, 1, 1, 2]]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    faces = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    a, b, c = corners[:, faces].transpose(2, 0, 1, 3)
    largest = np.linalg.norm(np.cross(b - a, c - a), axis=2).max(axis=1)
    return float((volume / largest / np.linalg.norm(edges, axis=2).max(axis=1)).min())


def force_n(body: Body, nodes: Floats, sample: SamplePoint) -> float:
    """Return the force of a finger 3 mm deep by Newton's method; NaN if it does not converge."""
    mesh = replace(body.mesh, nodes=nodes)
    answer = newton(replace(body, mesh=mesh), sample, (0.003,))
    modulus = require_material(body.scene).young_modulus_pa
    return modulus * float(answer.force_n[0] @ sample.normal) if answer.reached else np.nan


def teleport() -> None:
    """Compare a finger that jumps in every frame with one that moves straight to each point."""
    row("finger", "skin differs from that of a finger fresh from outside by at most")
    body, rng = make_body(cylinder()), np.random.default_rng(4)
    held: ContactAnchor | None = None
    worst, kept = {"near": 0.0, "across": 0.0}, 0
    for _ in range(600):
        x, angle, depth = rng.uniform([-0.02, -1.0, -0.005], [0.02, 1.0, 0.012])
        normal = np.array([0.0, np.sin(angle), np.cos(angle)])
        point = (0.02 - depth) * normal + np.array([x, 0.0, 0.0])
        there = rigid.apply(body.soft.world_from_mesh, point)
        across = held is not None and float(held.normal @ normal) <= 0.0
        answer, held = body.soft.respond(there, held)
        fresh, _ = body.soft.respond(there, None)
        apart = 1e3 * float(np.abs(answer.displacement - fresh.displacement).max())
        name = "across" if across else "near"
        worst[name], kept = max(worst[name], apart), kept + across
    row("linear, random jumps in the body by less than a right angle", f"{worst['near']:.1e} mm")
    row(
        f"by more ({kept} of 600 jumps): the place it entered by stays", f"{worst['across']:.0f} mm"
    )
    sample, forces = make_sample(body), []
    for steps in (1, 40):
        depths = tuple(float(d) for d in np.linspace(0.0, 0.006, steps + 1)[1:])
        forces.append(float(newton(body, sample, depths).force_n[-1] @ sample.normal))
    row("Newton, 6 mm in one step or 40", f"force {100 * abs(forces[1] / forces[0] - 1):.1g} %")


def small_tip() -> None:
    """Push with a fingertip smaller than the mesh under it."""
    row("tip radius", "over spacing", "depth", "linear: force over Hertz", "Newton: over Hertz")
    for radius in (0.007, 0.003, 0.0015, 0.0007, 0.0003):
        body = make_body(cylinder(finger_m=radius), meshed_for=cylinder())
        sample, depth = make_sample(body), 0.5 * radius
        modulus = require_material(body.scene).young_modulus_pa
        bend = np.sqrt(1.0 / radius * (1.0 / radius + 1.0 / RADIUS_M))
        hertz = 4.0 / 3.0 * modulus / (1.0 - 0.45**2) * np.sqrt(1.0 / bend) * depth**1.5
        force = float(
            body.soft.method.respond(ContactQuery(sample.point, sample.normal, depth)).force_n
            @ sample.normal
        )
        answer = newton(body, sample, (depth,))
        pushed = modulus * float(answer.force_n[0] @ sample.normal)
        row(
            f"{1e3 * radius:g} mm",
            f"{radius / SPACING_M:.2g}",
            f"{1e3 * depth:g} mm",
            f"{force / hertz:.2f}",
            f"{pushed / hertz:.2f}" if answer.reached else "not followed",
        )


def beyond() -> None:
    """Move a finger off the touchable skin: past the cylinder's end, and around to its back."""
    row("way", "flagged from", "force half at", "force none at")
    body = make_body(cylinder())
    for name, ways in (
        ("past the end", [(1e-4 * i, 0.0) for i in range(450)]),
        ("around to the support", [(0.0, 0.005 * i) for i in range(620)]),
    ):
        forces, flags = [], []
        for x, angle in ways:
            normal = np.array([0.0, np.sin(angle), np.cos(angle)])
            point = (0.02 - 0.004) * normal + np.array([x, 0.0, 0.0])
            answer, _ = body.soft.respond(rigid.apply(body.soft.world_from_mesh, point), None)
            forces.append(float(np.linalg.norm(answer.force_n)))
            flags.append(not answer.in_range)
        at = [f"{1e3 * x:.1f} mm" if x else f"{np.degrees(angle):.0f}°" for x, angle in ways]
        half = next(i for i, force in enumerate(forces) if force < 0.5 * forces[0])
        none = next((i for i, force in enumerate(forces) if force == 0.0), None)
        gone = at[none] if none is not None else "never"
        row(name, at[flags.index(True)], at[half], gone)


CASES: dict[str, Callable[[], None]] = {
    "incompressible": incompressible,
    "inversion": inversion,
    "rim": rim,
    "two_supports": two_supports,
    "slivers": slivers,
    "teleport": teleport,
    "small_tip": small_tip,
    "beyond": beyond,
}


def main() -> None:
    for name in sys.argv[1:] or CASES:
        print(f"\n{name}: {CASES[name].__doc__}", flush=True)
        CASES[name]()


if __name__ == "__main__":
    main()
