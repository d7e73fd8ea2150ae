"""A push solved at one place, carried to another: what a table is filled with between its pushes.

Near the finger the skin moves as at the other place, seen from there: a field is carried along with
the place and its normal.  Far from it, the field belongs to the body, and stays where it is.  So
ends and supports, which do not move with the finger, keep their part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.mesh import SUBTRIANGLES
from nodes.fem_solver.pushes import PushAnswer, Site

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

CARRIED_RATIO, STAYING_RATIO = 2.5, 6.5
"""All is carried within so many finger radii of the place; nothing beyond so many."""
NEIGHBOURS = 7
CANDIDATES = 4
RIDGE = 1e-2
"""How much a slope costs against the spread of the neighbours, where these do not tell it."""


def shape_functions(local: Floats) -> Floats:
    """Of the six-node triangle (..., 6) at local coordinates (..., 2)."""
    a, b = local[..., 0], local[..., 1]
    c = 1.0 - a - b
    result = np.empty((*local.shape[:-1], 6))
    result[..., 0] = c * (2.0 * c - 1.0)
    result[..., 1] = a * (2.0 * a - 1.0)
    result[..., 2] = b * (2.0 * b - 1.0)
    result[..., 3] = 4.0 * c * a
    result[..., 4] = 4.0 * a * b
    result[..., 5] = 4.0 * b * c
    return result


CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
"""Local coordinates of the six nodes."""


class Hull:
    """The skin of a mesh, and where a point is on it."""

    def __init__(self, rest: Floats, faces: Ints) -> None:
        """rest (s, 3) nodes, faces (f, 6)."""
        from scipy.spatial import cKDTree

        self._faces = faces
        triangles = faces[:, SUBTRIANGLES].reshape(-1, 3)
        corners = rest[triangles]
        self._tree = cKDTree(corners.mean(axis=1))
        self._origin = corners[:, 0]
        sides = corners[:, 1:] - corners[:, :1]
        gram = np.linalg.inv(sides @ sides.transpose(0, 2, 1))
        self._sides, self._inverse = sides, gram @ sides

    def weights(self, points: Floats) -> tuple[Ints, Floats]:
        """Nodes (q, 6) and their shape functions (q, 6) at the hull's points next to `points`."""
        _, near = self._tree.query(points, k=CANDIDATES)
        offset = points[:, None] - self._origin[near]
        local = np.einsum("qkij,qkj->qki", self._inverse[near], offset)
        local = np.maximum(local, 0.0)
        local /= np.maximum(local.sum(axis=2, keepdims=True), 1.0)
        left = offset - np.einsum("qki,qkij->qkj", local, self._sides[near])
        best = np.square(left).sum(axis=2).argmin(axis=1)
        rows = np.arange(len(points))
        triangle, local = near[rows, best], local[rows, best]
        part = CORNERS[SUBTRIANGLES[triangle % len(SUBTRIANGLES)]]
        inner = part[:, 0] + np.einsum("qi,qij->qj", local, part[:, 1:] - part[:, :1])
        return self._faces[triangle // len(SUBTRIANGLES)], shape_functions(inner)


def turn(start: Floats, end: Floats) -> Floats:
    """The least rotation (3, 3) that takes one unit vector (3,) into another, not opposite one."""
    axis = np.cross(start, end)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + start @ end))


@dataclass(frozen=True, slots=True)
class Solved:
    """A push, its site and the hull that it was solved on."""

    site: Site
    answer: PushAnswer
    hull: Hull


class Carrier:
    """Answers to pushes at any site, by the solved ones around it."""

    def __init__(self, solved: Sequence[Solved], towards_user: Floats, radius_m: float) -> None:
        """solved: all at the same depths.  towards_user (3,): the direction that all normals are
        less than a half turn from; radius_m: the finger's."""
        self._solved, self._user, self._radius = solved, towards_user, radius_m
        self._places = np.array([one.site.place for one in solved])
        self.depths_m = solved[0].answer.depths_m

    def answer(self, site: Site, rest: Floats) -> tuple[Floats32, Floats, float]:
        """How skin nodes rest (s, 3) move under a push, (k, s, 3); the force (k, 3) for 1 Pa; how
        many of the k depths the neighbours reached."""
        weights = self.neighbours(site)
        moved: Floats32 | None = None
        force = np.zeros(self._solved[0].answer.force_n.shape)
        reached = 0.0
        for number, weight in weights:
            part, push = self._carried(self._solved[number], site, rest)
            moved = (
                np.float32(weight) * part if moved is None else moved + np.float32(weight) * part
            )
            force += weight * push
            reached += weight * self._solved[number].answer.reached
        assert moved is not None
        return moved, force, reached

    def neighbours(self, site: Site) -> list[tuple[int, float]]:
        """Solved pushes around a site with their weights, which sum up to one: a local fit, linear
        over the surface, by moving least squares (Lancaster & Salkauskas 1981)."""
        offset = self._places - site.place
        away = np.linalg.norm(offset, axis=1)
        order = np.argsort(away, kind="stable")[: NEIGHBOURS + 1]
        if away[order[0]] < 1e-9:
            return [(int(order[0]), 1.0)]
        reach = 1.001 * away[order[-1]]
        near = np.flatnonzero(away < reach)
        frame = turn(self._user, site.normal)
        across = (offset[near] @ frame)[:, _tangents(self._user)]
        length = np.linalg.norm(across, axis=1, keepdims=True)
        across *= away[near, None] / np.maximum(length, 1e-12) / reach
        share = away[near] / reach
        kernel = (1.0 - share) ** 4 * (4.0 * share + 1.0) / np.maximum(share, 1e-6)
        basis = np.column_stack([np.ones(len(near)), across])
        normal = (basis * kernel[:, None]).T @ basis
        normal[1:, 1:] += RIDGE * kernel.sum() * np.eye(2)
        weights = kernel * (basis @ np.linalg.solve(normal, np.array([1.0, 0.0, 0.0])))
        return list(zip(near.tolist(), weights.tolist(), strict=True))

    def _carried(self, solved: Solved, site: Site, rest: Floats) -> tuple[Floats32, Floats]:
        turned = turn(self._user, solved.site.normal) @ turn(self._user, site.normal).T
        away = np.linalg.norm(rest - site.place, axis=1) / self._radius
        share = np.clip((STAYING_RATIO - away) / (STAYING_RATIO - CARRIED_RATIO), 0.0, 1.0)
        share = (share * share * (3.0 - 2.0 * share))[:, None]
        there = solved.site.place + (rest - site.place) @ turned.T
        nodes, weights = solved.hull.weights(share * there + (1.0 - share) * rest)
        moved = np.einsum("qa,kqai->kqi", weights.astype(np.float32), solved.answer.moved[:, nodes])
        back = turned.astype(np.float32)
        part = share.astype(np.float32)
        return part * (moved @ back) + (1.0 - part) * moved, solved.answer.force_n @ turned


def _tangents(towards_user: Floats) -> list[int]:
    """The two axes across the direction to the user, or the nearest to that."""
    return [axis for axis in range(3) if axis != int(np.abs(towards_user).argmax())]
