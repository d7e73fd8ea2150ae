"""Simple solids of 10-node tetrahedra for tests."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.fem_solver.mesh.solid import EDGES, add_midside_nodes, orient_tetrahedra

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def bricks(x: Sequence[float], y: Sequence[float], z: Sequence[float]) -> tuple[Floats, Ints]:
    """Return nodes and elements of a box cut at the given coordinates, with six tetrahedra per
    brick (Kuhn)."""
    shape = (len(x), len(y), len(z))
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.array(list(itertools.product(*(range(n - 1) for n in shape))))
    tetrahedra = []
    for steps in itertools.permutations(range(3)):
        path = [corner]
        for axis in steps:
            path.append(path[-1] + np.eye(3, dtype=np.int64)[axis])
        tetrahedra.append(
            np.column_stack([np.ravel_multi_index(tuple(part.T), shape) for part in path])
        )
    return add_midside_nodes(grid, orient_tetrahedra(grid, np.concatenate(tetrahedra)))


def box(divisions: tuple[int, int, int], sides: tuple[float, float, float]) -> tuple[Floats, Ints]:
    """Return a box cut into equal bricks."""
    x, y, z = (np.linspace(0, s, n + 1) for s, n in zip(sides, divisions, strict=True))
    return bricks(x, y, z)


def distorted(nodes: Floats, elements: Ints) -> tuple[Floats, Ints]:
    """Displace the inner corners of the unit box, with straight edges."""
    corners = np.unique(elements[:, :4])
    size = np.linalg.norm(nodes[elements[:, 0]] - nodes[elements[:, 1]], axis=1).min()
    moved = nodes.copy()
    inner = ((nodes > 1e-9) & (nodes < 1.0 - 1e-9)).all(axis=1)
    inner[np.setdiff1d(np.arange(len(nodes)), corners)] = False
    moved[inner] += 0.2 * size * np.sin(37.0 * nodes[inner] @ [[1, 2, 3], [3, 1, 2], [2, 3, 1]])
    moved[elements[:, 4:]] = moved[elements[:, EDGES]].mean(axis=2)
    return moved, elements
