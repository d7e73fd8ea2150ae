"""Full Newton for a neo-Hookean body that a fingertip sphere presses: the reference method.

The finger is a sphere that no skin may enter.  At contact points spread over the skin's faces a
pressure acts that grows with how far the point is inside the sphere: at first with the square of
that, so that the forces are C1 in the finger's position, then in proportion to it, on a bed so
stiff that the skin enters by a hundredth of the radius at most where the material is pressed with
its own modulus.  All is the minimum of one energy, which a Newton iteration descends; an element
that is turned inside out has infinite energy and is never accepted.

Without friction the answer depends on the finger's place alone.  A sticking finger holds every
point where it first touched it, by springs as stiff as the bed along the skin, so that the answer
depends on the way there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nodes.fem_solver.contact import POINT_SPACING_RATIO, triangle_points
from nodes.fem_solver.elasticity import degrees_of_freedom, scattered
from nodes.fem_solver.hyperelastic import NeoHookeanSolid
from nodes.fem_solver.mesh import FACES, SUBTRIANGLES, boundary_faces
from nodes.fem_solver.multifrontal import Dissection, Factors, IndefiniteError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Friction = Literal["none", "stick"]

BED_RATIO = 200.0
"""Stiffness of the contact bed (Pa/m) in units of E / finger radius."""
ROUNDING_RATIO = 0.005
"""Depth over which the bed's pressure rises from nothing, in finger radii."""
POINTS_PER_EDGE = 4
LARGEST_STEP_RATIO = 0.35
"""The finger moves by this much of its radius per load step, or less."""
SMALLEST_SHARE = 1.0 / 16.0
"""Load steps that do not settle are halved down to this; then the finger is as deep as it goes."""
MAX_ITERATIONS = 25
SAFEGUARDS = ((1.0, 0.0), (0.0, 0.0), (0.0, 0.3), (0.0, 2.0), (0.0, 15.0))
"""How a tangent is made definite, should it not be: without the turning aside of the contact, then
stiffened by so many times the shear modulus."""
TOLERANCE = 1e-8
"""Residual forces, as a share of the largest force in the body."""


class StuckError(ArithmeticError):
    """A load step did not settle."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """The fingertip: centre (3,) and radius, m."""

    centre: Floats
    radius_m: float


@dataclass(frozen=True, slots=True)
class Solved:
    """The body in balance with the finger.

    displacement (n, 3); force_n (3,) of the body on the finger; centre (3,): where the finger is,
    short of where it was sent if `reached` is false.
    """

    displacement: Floats
    force_n: Floats
    centre: Floats
    least_volume_ratio: float
    iterations: int
    reached: bool


@dataclass(frozen=True, slots=True)
class _Held:
    """Contact points (q,) held by a sticking finger: where from its centre (k, 3), their skin's
    normals (k, 3)."""

    points: Ints
    offsets: Floats
    normals: Floats


NOTHING_HELD = _Held(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)))


class SphereObstacle:
    """The bed that keeps the skin out of the finger."""

    def __init__(
        self, nodes: Floats, elements: Ints, faces: Ints, *, modulus_pa: float, radius_m: float
    ) -> None:
        """faces (f, 6): the six-node triangles that a finger can touch."""
        self.radius_m = radius_m
        self._count, self._faces = len(nodes), faces
        corners = nodes[faces[:, :3]]
        # no finger, however small, falls between the points
        longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
        divisions = int(np.ceil(longest / (POINT_SPACING_RATIO * radius_m)))
        self._shape, _ = triangle_points(max(POINTS_PER_EDGE, divisions))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = 0.5 * np.linalg.norm(normals, axis=1)
        points = len(self._shape)
        self._bed = np.repeat(BED_RATIO * modulus_pa / radius_m * areas / points, points)
        self._rounding = ROUNDING_RATIO * radius_m
        self.parents, self._local = _parents(elements, faces)

    def points(self, positions: Floats) -> Floats:
        """Contact points (q, 3) of the deformed skin, from node positions (n, 3)."""
        result: Floats = (self._shape @ positions[self._faces]).reshape(-1, 3)
        return result

    def inside(self, positions: Floats, centre: Floats) -> tuple[Ints, Floats, Floats, Floats]:
        """Points within the sphere: their numbers (k,), depth (k,), normals (k, 3) out of the
        sphere, distance from its centre (k,)."""
        offset = self.points(positions) - centre
        distance = np.linalg.norm(offset, axis=1)
        inner = np.flatnonzero(distance < self.radius_m)
        away = distance[inner]
        return inner, self.radius_m - away, offset[inner] / away[:, None], away

    def energy(self, positions: Floats, centre: Floats, held: _Held) -> float:
        """Energy of the bed and of the springs along the skin, J."""
        inner, depth, _, _ = self.inside(positions, centre)
        d = self._rounding
        low = depth < d
        density = np.where(low, depth**3 / (6 * d), 0.5 * depth * (depth - d) + d * d / 6)
        total = float(self._bed[inner] @ density)
        if len(held.points):
            slip = self._slip(positions, centre, held)
            total += 0.5 * float(self._bed[held.points] @ np.square(slip).sum(axis=1))
        return total

    def forces(self, positions: Floats, centre: Floats, held: _Held) -> Floats:
        """The energy's gradient by node (n, 3): what the skin presses into the finger, N."""
        inner, depth, normals, _ = self.inside(positions, centre)
        per_point = np.zeros((len(self._bed), 3))
        per_point[inner] = -(self._bed[inner] * self._pressure(depth))[:, None] * normals
        if len(held.points):
            per_point[held.points] += self._bed[held.points][:, None] * self._slip(
                positions, centre, held
            )
        pressed = np.flatnonzero(per_point.any(axis=1))
        faces = np.unique(pressed // len(self._shape))
        blocks = per_point.reshape(len(self._faces), -1, 3)[faces]
        per_node = self._shape.T @ blocks
        rows = degrees_of_freedom(self._faces[faces].ravel())
        return scattered(rows, per_node.ravel(), 3 * self._count).reshape(-1, 3)

    def add_tangents(
        self, matrices: Floats, positions: Floats, centre: Floats, held: _Held, *, turned: float
    ) -> None:
        """Add the energy's second derivative to the element matrices (e, 30, 30).

        turned: 1; less leaves out of it what makes it indefinite: that a sphere, being round,
        pushes points aside.
        """
        inner, depth, normals, away = self.inside(positions, centre)
        slope = np.where(depth < self._rounding, depth / self._rounding, 1.0)
        outer = normals[:, :, None] * normals[:, None, :]
        turning = (self._pressure(depth) / away)[:, None, None] * turned
        inner_blocks = slope[:, None, None] * outer - turning * (np.eye(3) - outer)
        numbers = np.append(inner, held.points)
        along = np.eye(3) - held.normals[:, :, None] * held.normals[:, None, :]
        blocks = np.concatenate([inner_blocks, along]) * self._bed[numbers][:, None, None]
        face, point = numbers // len(self._shape), numbers % len(self._shape)
        faces, where = np.unique(face, return_inverse=True)
        shape = self._shape[point]
        weights = shape[:, :, None] * shape[:, None, :]
        per_point = weights[:, :, None, :, None] * blocks[:, None, :, None, :]
        summed = np.zeros((len(faces), 18, 18))
        np.add.at(summed, where, per_point.reshape(-1, 18, 18))
        local = self._local[faces]
        rows = (3 * local[:, :, None] + np.arange(3)).reshape(-1, 18)
        target = self.parents[faces]
        np.add.at(matrices, (target[:, None, None], rows[:, :, None], rows[:, None, :]), summed)

    def hold(self, positions: Floats, centre: Floats, held: _Held) -> _Held:
        """What a sticking finger holds once the body has settled: points that it presses stay held
        where they were first touched, others are let go."""
        inner, _, normals, _ = self.inside(positions, centre)
        offsets = self.points(positions)[inner] - centre
        kept = np.isin(inner, held.points)
        offsets[kept] = held.offsets[np.searchsorted(held.points, inner[kept])]
        return _Held(inner, offsets, normals)

    def _pressure(self, depth: Floats) -> Floats:
        d = self._rounding
        result: Floats = np.where(depth < d, depth * depth / (2 * d), depth - 0.5 * d)
        return result

    def _slip(self, positions: Floats, centre: Floats, held: _Held) -> Floats:
        slip = self.points(positions)[held.points] - centre - held.offsets
        result: Floats = slip - (slip * held.normals).sum(axis=1)[:, None] * held.normals
        return result


class NeoHookeanBody:
    """A body of a mesh with its supports, to be pressed by a finger."""

    def __init__(
        self,
        nodes: Floats,
        elements: Ints,
        fixed: NDArray[np.bool_],
        faces: Ints,
        *,
        young_modulus_pa: float,
        poisson_ratio: float,
        finger_radius_m: float,
        friction: Friction = "none",
        tolerance: float = TOLERANCE,
        smallest_share: float = SMALLEST_SHARE,
        factored_in: type[np.floating[Any]] = np.float64,
    ) -> None:
        """faces (f, 6): six-node triangles that a finger can touch, node indices, outward.
        tolerance, smallest_share: as `TOLERANCE` and `SMALLEST_SHARE`.
        factored_in: precision of the tangents' factors, which only say where to look next; forces
        and energies are always of double precision.

        Errors as `NeoHookeanSolid`.
        """
        self.solid = NeoHookeanSolid(
            nodes, elements, young_modulus_pa=young_modulus_pa, poisson_ratio=poisson_ratio
        )
        self.obstacle = SphereObstacle(
            nodes, elements, faces, modulus_pa=young_modulus_pa, radius_m=finger_radius_m
        )
        self.fixed, self.friction = fixed, friction
        self.tolerance, self.smallest_share = tolerance, smallest_share
        self.factored_in = factored_in
        self._order = Dissection(nodes, elements, fixed)
        self._hull = boundary_faces(elements)[:, SUBTRIANGLES].reshape(-1, 3)

    def follow(
        self, centres: Iterable[Floats], *, start: tuple[Floats, Floats] | None = None
    ) -> Iterator[Solved]:
        """The body as the sphere's centre goes from place to place (3,), in straight lines.

        start: a displacement and the centre that it is in balance with, without friction; None:
        the first centre, which must not touch the body.  Where the body cannot follow any farther,
        all answers from there on are the last that it could, with `reached` false: so does a body
        of which an element turned over, or into which the finger slipped through the skin.
        ValueError for a centre that is not finite.
        """
        displacement, at = start or (np.zeros_like(self.solid.nodes), None)
        factors: Factors | None = None
        held, stuck = NOTHING_HELD, False
        for centre in centres:
            if not np.isfinite(centre).all():
                raise ValueError(f"the finger's centre {centre} is not finite")
            iterations = 0
            if at is None:
                at = centre
            done, share = 0.0, 1.0
            begin, way = at, centre - at
            longest = LARGEST_STEP_RATIO * self.obstacle.radius_m
            pieces = max(1, int(np.ceil(np.linalg.norm(way) / longest)))
            while done < 1.0 - 1e-12 and not stuck:
                step = min(share / pieces, 1.0 - done)
                target = begin + (done + step) * way
                try:
                    guess = self._predicted(displacement, at, target, held, factors)
                    settled, count, factors = self.settle(displacement, target, held, guess=guess)
                    self._require_sound(settled, target)
                except StuckError:
                    share *= 0.5
                    stuck = share < self.smallest_share
                    continue
                displacement, at = settled, target
                iterations, done = iterations + count, done + step
                share = min(1.0, 2.0 * share)
                if self.friction == "stick":
                    held = self.obstacle.hold(self.solid.nodes + displacement, at, held)
            yield Solved(
                displacement=displacement,
                force_n=self.obstacle.forces(self.solid.nodes + displacement, at, held).sum(axis=0),
                centre=at,
                least_volume_ratio=self.solid.smallest_volume_ratio(displacement),
                iterations=iterations,
                reached=not stuck,
            )

    def settle(
        self, displacement: Floats, centre: Floats, held: _Held, *, guess: Floats
    ) -> tuple[Floats, int, Factors | None]:
        """The balance (n, 3) with the sphere at `centre`, how many iterations it took, and the
        factors of the last.

        Starts at `guess` if that has less energy than `displacement`.  StuckError where it does
        not settle.
        """
        nodes = self.solid.nodes
        if self._energy(guess, centre, held) < self._energy(displacement, centre, held):
            displacement = guess
        energy = self._energy(displacement, centre, held)
        factors: Factors | None = None
        for iteration in range(MAX_ITERATIONS):
            inner = self.solid.forces(displacement)
            pressed = self.obstacle.forces(nodes + displacement, centre, held)
            residual = np.where(self.fixed[:, None], 0.0, inner + pressed)
            scale = max(np.abs(inner).max(), np.abs(pressed).max())
            if np.abs(residual).max() <= self.tolerance * scale:
                return displacement, iteration, factors
            factors = self._factors(displacement, centre, held)
            step = -factors.solve(residual.ravel()).reshape(-1, 3)
            slope = float((residual * step).sum())
            share = 1.0
            while True:
                trial = displacement + share * step
                now = self._energy(trial, centre, held)
                if now <= energy + 1e-4 * share * slope + 1e-14 * abs(energy):
                    break
                share *= 0.5
                if share < 1e-4:
                    raise StuckError(f"no descent after {iteration} iterations")
            displacement, energy = trial, now
        raise StuckError(f"not settled after {MAX_ITERATIONS} iterations")

    def _require_sound(self, displacement: Floats, centre: Floats) -> None:
        """StuckError where an element is turned over, or the finger's centre is inside the body:
        nothing keeps it from where no skin is, so that it has slipped through."""
        ratio = self.solid.smallest_volume_ratio(displacement)
        if ratio <= 0.0:
            raise StuckError(f"an element is turned over (volume ratio {ratio:.3g})")
        triangles = (self.solid.nodes + displacement)[self._hull] - centre
        if winding_number(triangles) > 0.5:
            raise StuckError("the finger is inside the body")

    def _energy(self, displacement: Floats, centre: Floats, held: _Held) -> float:
        elastic = self.solid.energy(displacement)
        if not np.isfinite(elastic):
            return elastic
        return elastic + self.obstacle.energy(self.solid.nodes + displacement, centre, held)

    def _predicted(
        self,
        displacement: Floats,
        at: Floats,
        target: Floats,
        held: _Held,
        factors: Factors | None,
    ) -> Floats:
        """Where the body goes, to first order, when the finger goes from `at` to `target`."""
        if factors is None:
            return displacement
        positions, share = self.solid.nodes + displacement, 1e-3 * (target - at)
        change = self.obstacle.forces(positions, at + share, held)
        change -= self.obstacle.forces(positions, at - share, held)
        change[self.fixed] = 0.0
        return displacement - factors.solve(500.0 * change.ravel()).reshape(-1, 3)

    def _factors(self, displacement: Floats, centre: Floats, held: _Held) -> Factors:
        """Of the tangent, stiffened as far as it has a direction that does not resist.

        StuckError if that does not help.
        """
        positions = self.solid.nodes + displacement
        elastic = self.solid.tangents(displacement)
        for turned, stiffening in SAFEGUARDS:
            matrices = elastic.copy()
            self.obstacle.add_tangents(matrices, positions, centre, held, turned=turned)
            self.solid.stiffen(matrices, stiffening)
            try:
                return self._order.factor(matrices.astype(self.factored_in, copy=False))
            except IndefiniteError:
                continue
        raise StuckError("the stiffness cannot be made definite")


def winding_number(triangles: Floats) -> float:
    """How often a closed surface of triangles (t, 3, 3), outward, goes around the origin: 1 where
    that is inside.

    The sum of solid angles over a full one (van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30,
    1983).
    """
    a, b, c = triangles.transpose(1, 0, 2)
    x, y, z = np.linalg.norm(triangles, axis=2).T
    spanned = (a * np.cross(b, c)).sum(axis=1)
    total = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    return float(np.arctan2(spanned, total).sum() / (2.0 * np.pi))


def _parents(elements: Ints, faces: Ints) -> tuple[Ints, Ints]:
    """The element that each face (f, 6) belongs to (f,), and the face's nodes in it (f, 6)."""
    sides = elements[:, FACES]
    keys = np.sort(sides[..., :3], axis=2).reshape(-1, 3)
    base = int(elements.max()) + 1
    weights = np.array([base * base, base, 1])
    known, wanted = keys @ weights, np.sort(faces[:, :3], axis=1) @ weights
    order = np.argsort(known)
    parents = order[np.searchsorted(known, wanted, sorter=order)] // len(FACES)
    return parents, (elements[parents][:, None, :] == faces[:, :, None]).argmax(axis=2)
