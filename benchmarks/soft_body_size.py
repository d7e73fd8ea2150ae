"""Measure time and memory of a soft body response, by numbers of skin and contact nodes.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.soft_body_size [--output docs/charts]

Bodies of 500 to 20,000 skin nodes respond to fingers at random points and to slowly moving ones.
The geometry is the demo's cylinder with a suitable mesh, and the steps are those of the node. The
tables contain random numbers, and rows for as many nodes as fit into `TABLE_BYTES`. Solving for
20,000 nodes would take hours, and 10,000 contact nodes some 100 GB with the nonlinear table. The
memory of a full table is printed as well. The reference is this machine's current time to read the
same number of bytes, by a dot product.

Writes soft-body-size.svg and soft-body-size.json. Takes a minute and 3 GB. With --redraw, only the
plot is drawn again from the numbers in the folder.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.commands.output import print_rows
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.methods.svg import COLOURS, page_style, save_svg
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.running.commit import read_commit
from flexsheet.messages.scene import Scene, require_cylinder, require_material
from flexsheet.nodes.arrays import Floats, Ints
from flexsheet.nodes.fem_solver.body import make_soft_body_spec
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import LinearSoftBody, SkinResponse
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh
from flexsheet.nodes.fem_solver.mesh.solid import SolidMesh
from flexsheet.nodes.fem_solver.snapshots import DEPTHS_M
from flexsheet.nodes.fem_solver.table import LINEAR_DEPTHS_M, Table, TableSoftBody, table_bytes
from flexsheet.nodes.models.shapes import Shape, make_shape

NAME, BY_SIZE, BY_CONTACT = "soft-body-size", "by_skin_nodes", "by_contact_nodes"
SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
SPACINGS_M = (0.007, 0.006, 0.0045, 0.003, 0.0024, 0.0022, 0.0016, 0.00106)
DEPTH_M = 0.005
CONTACT_SPACING_M = 0.0022
CONTACT_DEPTHS_M = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.012)
LINEAR_RANGE_M = (0.012, 0.018)
"""The finger radius, larger than the method's range so that the contact grows with the depth."""
TABLE_BYTES, MAX_PLACES = 400_000_000, 800
REFERENCE_BYTES = 400_000_000
STEPS = 600
SLOW_STEP_M = 2e-5
ROWS_PER_ANSWER = 6 * 4
"""The rows of the nonlinear table per response: six nodes at four depths each."""


@dataclass(frozen=True, slots=True)
class Point:
    """A measurement with median and 99th percentile of times, s, at random points and on a slide.

    memory_read_s: time to read `read_bytes` from random positions in memory.
    """

    method: str
    skin_nodes: int
    contact_nodes: float
    depth_m: float
    read_bytes: float
    random_s: float
    random_p99_s: float
    slow_s: float
    slow_p99_s: float
    memory_read_s: float
    whole_table_bytes: int


@dataclass(frozen=True, slots=True)
class Synthetic:
    """A body of a given size with random rows at the contact nodes of a patch."""

    mesh: SolidMesh
    response: SkinResponse
    shape: Shape
    centre: Floats
    half_m: float


def find_patch(mesh: SolidMesh, row_bytes: int) -> tuple[Ints, Ints]:
    """Return the contact nodes around the front that fit into `TABLE_BYTES`, and their faces."""
    touched = mesh.nodes[mesh.contact_nodes]
    front = touched[int(touched[:, 2].argmax())]
    order = np.argsort(np.abs(touched - front).max(axis=1), kind="stable")
    kept = np.zeros(len(touched), dtype=bool)
    kept[order[: min(MAX_PLACES, TABLE_BYTES // row_bytes)]] = True
    faces = mesh.contact_faces[kept[mesh.contact_faces].all(axis=1)]
    return np.unique(faces), faces


def make_synthetic_body(
    scene: Scene, mesh: SolidMesh, shape: Shape, rows_per_place: int
) -> Synthetic:
    """Make a synthetic body.

    rows_per_place: 1 for the linear table, more for the nonlinear table.
    """
    numbers, faces = find_patch(mesh, rows_per_place * 12 * len(mesh.skin))
    rest = mesh.nodes[mesh.skin]
    contact_nodes = np.searchsorted(mesh.skin, mesh.contact_nodes[numbers])
    places = rest[contact_nodes]
    # the half-space under a load, blunt below the spacing: positive definite, right in size
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    blunt = 0.5 * float(np.median(np.partition(apart, 1, axis=1)[:, 1]))
    nu = require_material(scene).poisson_ratio
    compliance = (1.0 - nu**2) / (np.pi * np.sqrt(apart**2 + blunt**2))
    made_up = np.random.default_rng(0).random(3 * len(rest), dtype=np.float32)
    linear_rows = len(contact_nodes) if rows_per_place == 1 else 1
    response = SkinResponse(
        rest=rest,
        contact_nodes=contact_nodes,
        normals=mesh.contact_normals[numbers],
        faces=np.searchsorted(numbers, faces),
        compliance=compliance,
        influence=np.tile(made_up, (linear_rows, 1)),
    )
    centre = places.mean(axis=0)
    half = 0.7 * float(np.abs(places - centre)[:, :2].max(axis=0).min())
    return Synthetic(mesh, response, shape, centre, half)


def memory_read_s(read_bytes: float) -> float:
    """Return the median time to read this many bytes from random positions in memory, s."""
    source, rng = np.ones(REFERENCE_BYTES // 4, dtype=np.float32), np.random.default_rng(1)
    count = max(16, int(read_bytes / 4))
    durations = []
    for start in rng.integers(0, len(source) - count, 60):
        piece = source[start : start + count]
        begun = time.perf_counter()
        piece.dot(piece)
        durations.append(time.perf_counter() - begun)
    return float(np.median(durations))


def make_pushes(body: Synthetic, depth_m: float, *, slow: bool) -> list[ContactQuery]:
    """Return contacts at random points of the patch, or on a line in steps of 0.02 mm."""
    rng = np.random.default_rng(2)
    ways = rng.uniform(-body.half_m, body.half_m, (STEPS, 2))
    if slow:
        gone = SLOW_STEP_M * np.arange(STEPS)
        to_and_fro = np.abs((gone + body.half_m) % (4.0 * body.half_m) - 2.0 * body.half_m)
        ways = np.outer(to_and_fro - body.half_m, [1.0, 0.7])
    found = body.shape.closest(body.centre + np.column_stack([ways, np.zeros(STEPS)]))
    return [
        ContactQuery(at, way, depth_m) for at, way in zip(found.point, found.normal, strict=True)
    ]


def timed(respond: Callable[[ContactQuery], Any], queries: Sequence[ContactQuery]) -> Floats:
    durations = np.empty(len(queries))
    for number, push in enumerate(queries):
        begun = time.perf_counter()
        respond(push)
        durations[number] = time.perf_counter() - begun
    return durations


def linear_point(scene: Scene, mesh: SolidMesh, shape: Shape, depth_m: float) -> Point:
    body = make_synthetic_body(scene, mesh, shape, rows_per_place=1)
    method = LinearSoftBody(
        body.response,
        shape,
        np.empty((0, 3)),
        young_modulus_pa=require_material(scene).young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        linear_depth_m=LINEAR_RANGE_M[0],
        max_depth_m=LINEAR_RANGE_M[1],
    )
    queries = make_pushes(body, depth_m, slow=False)
    contacts = [method.contact.solve(push, depth_m) for push in queries]
    count = float(np.median([0 if one is None else len(one.nodes) for one in contacts]))
    whole = len(mesh.contact_nodes) * (12 * len(mesh.skin) + 8 * len(mesh.contact_nodes))
    return measured(
        method,
        body,
        queries,
        depth_m=depth_m,
        contact_nodes=count,
        rows=count,
        whole_table_bytes=whole,
    )


def table_point(scene: Scene, mesh: SolidMesh, shape: Shape, depth_m: float) -> Point:
    levels = len(DEPTHS_M) + len(LINEAR_DEPTHS_M)
    body = make_synthetic_body(scene, mesh, shape, rows_per_place=levels)
    places = len(body.response.contact_nodes)
    row = np.tile(body.response.influence[0], levels).reshape(1, levels, -1)
    depths = np.array([0.0, *LINEAR_DEPTHS_M, *DEPTHS_M])
    table = Table(
        depths_m=depths,
        fields=np.tile(row, (places, 1, 1)),
        force_n=body.response.normals[:, None] * depths[:, None],
        reach_m=np.full(places, depths[-1]),
    )
    method = TableSoftBody(
        body.response,
        np.empty((0, 3)),
        table,
        young_modulus_pa=require_material(scene).young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        push_depth_m=LINEAR_RANGE_M[1],
        linear_depth_m=0.006,
    )
    whole = table_bytes(len(mesh.contact_nodes), len(mesh.skin), len(DEPTHS_M))
    queries = make_pushes(body, depth_m, slow=False)
    return measured(
        method,
        body,
        queries,
        depth_m=depth_m,
        contact_nodes=6.0,
        rows=ROWS_PER_ANSWER,
        whole_table_bytes=whole,
    )


def measured(
    method: LinearSoftBody | TableSoftBody,
    body: Synthetic,
    queries: Sequence[ContactQuery],
    *,
    depth_m: float,
    contact_nodes: float,
    rows: float,
    whole_table_bytes: int,
) -> Point:
    read = rows * 12.0 * len(body.response.rest)
    slow = make_pushes(body, depth_m, slow=True)
    timed(method.respond, queries[:20])
    at_random, slowly = timed(method.respond, queries), timed(method.respond, slow)
    return Point(
        method=method.name,
        skin_nodes=len(body.response.rest),
        contact_nodes=contact_nodes,
        depth_m=depth_m,
        read_bytes=read,
        random_s=float(np.median(at_random)),
        random_p99_s=float(np.quantile(at_random, 0.99)),
        slow_s=float(np.median(slowly)),
        slow_p99_s=float(np.quantile(slowly, 0.99)),
        memory_read_s=memory_read_s(read),
        whole_table_bytes=whole_table_bytes,
    )


def draw(by_size: Sequence[Point], by_contact: Sequence[Point], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 5), layout="constrained")
    size, contact, memory = figure.subplots(1, 3)
    for number, method in enumerate(dict.fromkeys(point.method for point in by_size)):
        color = COLOURS[number]
        for axes, points, across in (
            (size, by_size, "skin_nodes"),
            (contact, by_contact, "contact_nodes"),
        ):
            mine = [point for point in points if point.method == method]
            if not mine:
                continue
            at = [getattr(point, across) for point in mine]
            for name, what, style in (
                ("random_s", "random places", "o-"),
                ("random_p99_s", "random places, p99", "v:"),
                ("slow_s", "slow slide", "s--"),
                ("slow_p99_s", "slow slide, p99", "^:"),
                ("memory_read_s", "reading as much memory", "_-."),
            ):
                shown = [1e6 * getattr(point, name) for point in mine]
                light = 0.5 if name == "memory_read_s" else 1.0
                axes.plot(at, shown, style, color=color, alpha=light, label=f"{method}, {what}")
        mine = [point for point in by_size if point.method == method]
        at = [point.skin_nodes for point in mine]
        memory.plot(at, [p.whole_table_bytes / 1e6 for p in mine], "o-", color=color, label=method)
    for axes, across, up in (
        (size, f"skin nodes (push of {1e3 * DEPTH_M:g} mm)", "time of an answer, µs"),
        (contact, "contact nodes", "time of an answer, µs"),
        (memory, "skin nodes", "whole table, MB"),
    ):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        axes.grid(visible=True, which="both", alpha=0.2)
        axes.legend(fontsize=7)
    contact.set_title(f"{by_contact[0].skin_nodes} skin nodes", fontsize=10)
    save_svg(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("runs/charts"))
    parser.add_argument("--redraw", action="store_true")
    arguments = parser.parse_args()
    if not arguments.redraw:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / f"{NAME}.json").write_text(json.dumps(measure_all(), indent=1) + "\n")
    redraw(arguments.output)


def redraw(folder: Path) -> None:
    """Draw the chart from the results in a folder."""
    results = json.loads((folder / f"{NAME}.json").read_text())
    with page_style():
        draw(
            make_points(results[BY_SIZE]),
            make_points(results[BY_CONTACT]),
            folder / f"{NAME}.svg",
        )


def make_points(kept: Sequence[dict[str, Any]]) -> list[Point]:
    return [Point(**one) for one in kept]


def measure_all() -> dict[str, Any]:
    """Measure all sizes and contacts."""
    scene = load_scene(SCENE_FILE)
    shape = make_shape(dict(require_cylinder(scene)))
    by_size, by_contact = [], []
    for spacing in SPACINGS_M:
        mesh = build_mesh(make_soft_body_spec(scene, spacing).mesh)
        for measure in (linear_point, table_point):
            by_size.append(measure(scene, mesh, shape, DEPTH_M))
        if spacing == CONTACT_SPACING_M:
            for depth in CONTACT_DEPTHS_M:
                by_contact.append(linear_point(scene, mesh, shape, depth))
    print_rows([asdict(point) for point in (*by_size, *by_contact)], as_json=False)
    return {
        "machine": machine_name(),
        "code": {"commit": read_commit()},
        "tables": "of made-up numbers and of the right size, at some of the places",
        BY_SIZE: [asdict(point) for point in by_size],
        BY_CONTACT: [asdict(point) for point in by_contact],
    }


if __name__ == "__main__":
    main()
