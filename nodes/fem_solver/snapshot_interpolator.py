"""Interpolate snapshots between their sample points, in order to fill a nonlinear table.

A snapshot is the solution for pushes at one sample point to several depths. Near the finger, the
displacement field is transported: shifted and rotated from the sample point to the new point. Far
from the finger, the field is not transported, because the ends and supports of the body do not move
with the finger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints, Singles
from flexsheet.nodes.fem_solver.mesh.solid import SUBTRIANGLES, triangle_shape_functions
from flexsheet.nodes.fem_solver.snapshots import SamplePoint, Snapshot, reflect_snapshot
from flexsheet.nodes.models.interpolation import smoothstep

TRANSPORTED_RATIO, FIXED_RATIO = 2.5, 6.5
"""The distances from the sample point, in finger radii, between which the weight of the transported
displacement field decreases from 1 to 0."""
NEIGHBOURS = 7
CANDIDATES = 4
RIDGE = 1e-2
"""The relative ridge penalty on the slopes of the least-squares fit to nearby snapshots. It is
necessary because there can be too few snapshots to determine the slopes."""
FACE_COORDINATES = np.array(
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]]
)
"""The local coordinates (6, 2) of the nodes of a six-node triangle."""


class SurfaceLocator:
    """A search structure that finds the skin points of a mesh nearest to given points."""

    def __init__(self, rest: Floats, faces: Ints) -> None:
        """Build the search tree for undeformed skin nodes (s, 3) and six-node faces (f, 6)."""
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
        """Find the skin point that is nearest to each of the given points (q, 3), m.

        Return the indices (q, 6) of the nodes of the nearest faces, and the shape functions (q, 6)
        of these nodes at the found points.
        """
        _, near = self._tree.query(points, k=CANDIDATES)
        offset = points[:, None] - self._origin[near]
        local = np.einsum("qkij,qkj->qki", self._inverse[near], offset)
        local = np.maximum(local, 0.0)
        local /= np.maximum(local.sum(axis=2, keepdims=True), 1.0)
        residual = offset - np.einsum("qki,qkij->qkj", local, self._sides[near])
        best = np.square(residual).sum(axis=2).argmin(axis=1)
        rows = np.arange(len(points))
        triangle, local = near[rows, best], local[rows, best]
        part = FACE_COORDINATES[SUBTRIANGLES[triangle % len(SUBTRIANGLES)]]
        inner = part[:, 0] + np.einsum("qi,qij->qj", local, part[:, 1:] - part[:, :1])
        return self._faces[triangle // len(SUBTRIANGLES)], triangle_shape_functions(inner)


def minimal_rotation(start: Floats, end: Floats) -> Floats:
    """Return the rotation (3, 3) of minimum angle from the unit vector `start` to `end` (3,).

    The vectors must not have opposite directions.
    """
    axis = np.cross(start, end)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + start @ end))


@dataclass(frozen=True, slots=True)
class PlacedSnapshot:
    """A push solution (snapshot) with the pushed point and a search structure for its mesh."""

    sample: SamplePoint
    snapshot: Snapshot
    locator: SurfaceLocator


class SnapshotInterpolator:
    """An interpolator of push solutions (snapshots) between surface points.

    The interpolator shifts and rotates the displacement fields, and combines them with weights from
    moving least squares.
    """

    def __init__(
        self, solved: Sequence[PlacedSnapshot], towards_user: Floats, radius_m: float
    ) -> None:
        """Store the push solutions (snapshots), which must all have the same depths.

        towards_user (3,): unit vector towards the user. No surface normal at a pushed point may
            point in the opposite direction.
        radius_m: radius of the finger.
        """
        self._solved, self._user, self._radius = solved, towards_user, radius_m
        self._points = np.array([one.sample.point for one in solved])
        self.depths_m = solved[0].snapshot.depths_m
        self._fixed: dict[int, Singles] = {}
        self._rest: Floats | None = None

    def interpolate(self, sample: SamplePoint, rest: Floats) -> tuple[Singles, Floats, float]:
        """Interpolate the stored push solutions (snapshots) to another surface point.

        sample: this surface point and its normal.
        rest (s, 3): undeformed positions of the s skin nodes, m. Calls with the same array are
            faster.

        Returns the displacement (k, s, 3), m, and the force (k, 3), N, at k depths for a Young's
        modulus of 1 Pa. A third result is the number of depths at which the snapshots converged, as
        a weighted mean over the snapshots.
        """
        if rest is not self._rest:
            self._rest, self._fixed = rest, {}
        weights = self.neighbour_weights(sample)
        moved: Singles | None = None
        force = np.zeros(self._solved[0].snapshot.force_n.shape)
        reached = 0.0
        for number, weight in weights:
            part, force_part = self._transport(number, sample, rest)
            moved = (
                np.float32(weight) * part if moved is None else moved + np.float32(weight) * part
            )
            force += weight * force_part
            reached += weight * self._solved[number].snapshot.reached
        assert moved is not None
        return moved, force, reached

    def neighbour_weights(self, sample: SamplePoint) -> list[tuple[int, float]]:
        """Return the indices and weights of the push solutions (snapshots) near a surface point.

        The weights add up to 1. Source: linear moving least squares over the surface (Lancaster &
        Salkauskas 1981).
        """
        offset = self._points - sample.point
        distances = np.linalg.norm(offset, axis=1)
        order = np.argsort(distances, kind="stable")[: NEIGHBOURS + 1]
        if distances[order[0]] < 1e-9:
            return [(int(order[0]), 1.0)]
        reach = 1.001 * distances[order[-1]]
        near = np.flatnonzero(distances < reach)
        frame = minimal_rotation(self._user, sample.normal)
        across = (offset[near] @ frame)[:, _tangents(self._user)]
        length = np.linalg.norm(across, axis=1, keepdims=True)
        across *= distances[near, None] / np.maximum(length, 1e-12) / reach
        weight = distances[near] / reach
        kernel = (1.0 - weight) ** 4 * (4.0 * weight + 1.0) / np.maximum(weight, 1e-6)
        basis = np.column_stack([np.ones(len(near)), across])
        normal = (basis * kernel[:, None]).T @ basis
        normal[1:, 1:] += RIDGE * kernel.sum() * np.eye(2)
        weights = kernel * (basis @ np.linalg.solve(normal, np.array([1.0, 0.0, 0.0])))
        return list(zip(near.tolist(), weights.tolist(), strict=True))

    def _transport(self, number: int, sample: SamplePoint, rest: Floats) -> tuple[Singles, Floats]:
        solved = self._solved[number]
        if number not in self._fixed:
            self._fixed[number] = _evaluate(solved, rest)
        rotation = (
            minimal_rotation(self._user, solved.sample.normal)
            @ minimal_rotation(self._user, sample.normal).T
        )
        distances = np.linalg.norm(rest - sample.point, axis=1) / self._radius
        weight = np.clip((FIXED_RATIO - distances) / (FIXED_RATIO - TRANSPORTED_RATIO), 0.0, 1.0)
        near = np.flatnonzero(weight)
        weight = smoothstep(weight[near])[:, None]
        there = solved.sample.point + (rest[near] - sample.point) @ rotation.T
        moved = _evaluate(solved, weight * there + (1.0 - weight) * rest[near])
        back = rotation.astype(np.float32)
        part = weight.astype(np.float32)
        result = self._fixed[number].copy()
        result[:, near] = part * (moved @ back) + (1.0 - part) * moved
        return result, solved.snapshot.force_n @ rotation


def _evaluate(solved: PlacedSnapshot, points: Floats) -> Singles:
    """Return the displacement (k, q, 3), m, of a push solution (snapshot) at its k depths.

    The displacement is evaluated at the skin points nearest to `points` (q, 3).
    """
    nodes, weights = solved.locator.weights(points)
    moved = solved.snapshot.moved[:, nodes]
    result: Singles = np.einsum("qa,kqai->kqi", weights.astype(np.float32), moved)
    return result


def _tangents(towards_user: Floats) -> list[int]:
    """Return the indices of the two coordinate axes with the largest angles to a direction (3,)."""
    return [axis for axis in range(3) if axis != int(np.abs(towards_user).argmax())]


@dataclass(frozen=True, slots=True, eq=False)
class SnapshotSet:
    """A set of push solutions (snapshots) that a worker process receives to make an interpolator.

    samples, solved: surface points of the pushes, and the solutions.
    mirrors: vectors (3,) of signs, one for each mirror symmetry of the body.
    towards_user (3,): unit vector towards the user. No surface normal at a sample may point in the
        opposite direction.
    radius_m: radius of the finger.
    """

    samples: Sequence[SamplePoint]
    solved: Sequence[Snapshot]
    mirrors: Sequence[Floats]
    towards_user: Floats
    radius_m: float

    def make_interpolator(self) -> SnapshotInterpolator:
        """Make an interpolator from the push solutions and their mirror images."""
        placed = place_snapshots(self.samples, self.solved, self.mirrors)
        return SnapshotInterpolator(placed, self.towards_user, self.radius_m)


def place_snapshots(
    samples: Sequence[SamplePoint], solved: Sequence[Snapshot], mirrors: Sequence[Floats]
) -> list[PlacedSnapshot]:
    """Return push solutions (snapshots) and their mirror images.

    If a pushed point is in a plane of symmetry, the mirror image in this plane is omitted.

    mirrors: vectors (3,) of signs, one for each mirror symmetry of the body.
    """
    placed: dict[tuple[int, ...], PlacedSnapshot] = {}
    for sample, snapshot in zip(samples, solved, strict=True):
        for signs in mirrors:
            image, at = reflect_snapshot(snapshot, sample, signs)
            key = tuple(np.round(1e7 * at.point).astype(int))
            placed.setdefault(
                key, PlacedSnapshot(at, image, SurfaceLocator(image.rest, image.faces))
            )
    return list(placed.values())
