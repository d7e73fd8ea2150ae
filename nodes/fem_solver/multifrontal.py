"""A direct solver for stiffness that is given element by element: multifrontal Cholesky.

The elements are bisected again and again across their longest sides (nested dissection: George
1973).  What the two halves share is eliminated after both: each half leaves a dense matrix on its
boundary, which is added into its parent's (Duff & Reid 1983).  Nearly all work is in dense
matrices, so that it runs at the processor's speed; the order is found once and serves every
stiffness on the same mesh, as a Newton iteration needs.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from nodes.fem_solver.elasticity import degrees_of_freedom, scattered

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAF_ELEMENTS = 48
MANY_RUNS = 40
NO_HALVES: tuple[int, ...] = ()


class IndefiniteError(ArithmeticError):
    """The stiffness has a direction that does not resist."""


@dataclass(frozen=True, slots=True)
class Front:
    """One node of the elimination tree.

    own, border: degrees of freedom eliminated here, and those left to the parent.  elements: of a
    leaf.  scatter: where the entries of the leaf's element matrices go in its dense matrix, one
    past its end for those of nodes that are held.  children: numbers of earlier fronts, with the
    places of their borders in this front.
    """

    own: Ints
    border: Ints
    elements: Ints
    scatter: Ints
    children: tuple[tuple[int, Ints], ...]


@dataclass(frozen=True, slots=True)
class Factors:
    """K = L L^T, in the precision of its stiffness; solves for one or many right-hand sides."""

    fronts: list[Front]
    pivots: list[Floats]
    ties: list[Floats]

    def solve(self, loads: Floats) -> Floats:
        """Displacements under loads (3n,) or (3n, k); zero where the body is held."""
        (trsm,) = get_blas_funcs(("trsm",), dtype=self.pivots[0].dtype)
        work = loads.reshape(len(loads), -1).astype(self.pivots[0].dtype)
        for front, pivot, tie in zip(self.fronts, self.pivots, self.ties, strict=True):
            part = trsm(1.0, pivot, work[front.own], lower=1)
            work[front.own] = part
            if len(front.border):
                work[front.border] -= tie @ part
        result = np.zeros_like(work)
        for front, pivot, tie in zip(
            reversed(self.fronts), reversed(self.pivots), reversed(self.ties), strict=True
        ):
            part = work[front.own]
            if len(front.border):
                part = part - tie.T @ result[front.border]
            result[front.own] = trsm(1.0, pivot, part, lower=1, trans_a=1)
        return result.reshape(loads.shape).astype(np.float64, copy=False)


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of the mesh: the nodes eliminated with it, those on its border, its halves if any."""

    own: Ints
    border: Ints
    members: Ints
    halves: tuple[int, ...]


class Dissection:
    """The order of elimination for one mesh and its supports."""

    def __init__(self, nodes: Floats, elements: Ints, fixed: NDArray[np.bool_]) -> None:
        """nodes (n, 3), elements (e, k), fixed (n,): nodes that are held."""
        self._elements, self._fixed = elements, fixed
        self._centres = nodes[elements].mean(axis=1)
        self._uses = np.bincount(elements.ravel(), minlength=len(nodes))
        self._parts: list[_Part] = []
        self._split(np.arange(len(elements)))
        # borders are sorted by when their nodes are eliminated: a part's border then lies in its
        # parent in the same order, and lower halves of matrices are added into lower halves
        # within a part, nodes of one leaf stand together, so that they are added in long runs
        self._rank = np.empty(len(nodes), dtype=np.int64)
        leaf = np.zeros(len(nodes), dtype=np.int64)
        for number, part in enumerate(self._parts):
            leaf[elements[part.members]] = number
        parts = [replace(part, own=part.own[np.argsort(leaf[part.own])]) for part in self._parts]
        self._parts = parts
        order = np.concatenate([part.own for part in parts])
        self._rank[order] = np.arange(len(order))
        self._place = np.full(len(nodes), -1)
        self.fronts = [self._front(part) for part in self._parts]

    def factor(self, matrices: Floats) -> Factors:
        """Factor the sum of element matrices (e, 3k, 3k), symmetric, float64 or float32: the latter
        in half the time and memory, to some four digits.

        IndefiniteError unless it is positive definite.
        """
        dtype = matrices.dtype
        trsm, syrk = get_blas_funcs(("trsm", "syrk"), dtype=dtype)
        (potrf,) = get_lapack_funcs(("potrf",), dtype=dtype)
        left: dict[int, Floats] = {}
        pivots, ties = [], []
        for number, front in enumerate(self.fronts):
            own, size = len(front.own), len(front.own) + len(front.border)
            if front.children:
                dense = np.zeros((size, size), dtype, order="F")
                for child, places in front.children:
                    _add(dense, left.pop(child), places)
            else:
                entries = matrices[front.elements].ravel()
                summed = scattered(front.scatter, entries, size * size + 1)
                dense = summed[:-1].reshape(size, size).astype(dtype, copy=False).T
            pivot, trouble = potrf(dense[:own, :own], lower=1, clean=0)
            if trouble:
                raise IndefiniteError(f"pivot {trouble} of front {number} is not positive")
            tie = trsm(1.0, pivot, dense[own:, :own], side=1, lower=1, trans_a=1)
            pivots.append(pivot)
            ties.append(tie)
            if size > own:
                left[number] = syrk(-1.0, tie, beta=1.0, c=dense[own:, own:], lower=1)
        return Factors(self.fronts, pivots, ties)

    def _split(self, members: Ints) -> tuple[int, Ints, Ints]:
        """Add the parts of some elements, halves first.

        Returns the number of the whole, its free nodes, and in how many of its elements each is.
        """
        if len(members) <= LEAF_ELEMENTS:
            present, counts = np.unique(self._elements[members], return_counts=True)
            free = ~self._fixed[present]
            present, counts = present[free], counts[free]
            candidates, halves = present, NO_HALVES
        else:
            first, second = self._halves(members)
            a, present_a, counts_a = self._split(first)
            b, present_b, counts_b = self._split(second)
            present, where = np.unique(np.append(present_a, present_b), return_inverse=True)
            counts = np.bincount(where, np.append(counts_a, counts_b)).astype(np.int64)
            candidates = np.union1d(self._parts[a].border, self._parts[b].border)
            members, halves = np.empty(0, dtype=np.int64), (a, b)
        done = counts[np.searchsorted(present, candidates)] == self._uses[candidates]
        self._parts.append(_Part(candidates[done], candidates[~done], members, halves))
        return len(self._parts) - 1, present, counts

    def _halves(self, members: Ints) -> tuple[Ints, Ints]:
        """Two halves of some elements, cut across the axis along which they share fewest nodes."""
        cuts = []
        for axis in range(3):
            order = members[np.argsort(self._centres[members, axis], kind="stable")]
            first, second = order[: len(order) // 2], order[len(order) // 2 :]
            shared = np.intersect1d(self._elements[first], self._elements[second])
            cuts.append((len(shared), first, second))
        _, first, second = min(cuts, key=lambda cut: cut[0])
        return first, second

    def _border(self, part: _Part) -> Ints:
        return part.border[np.argsort(self._rank[part.border])]

    def _front(self, part: _Part) -> Front:
        border = self._border(part)
        nodes = np.append(part.own, border)
        place, size = self._place, 3 * len(nodes)
        place[nodes] = np.arange(len(nodes))
        children = tuple(
            (half, degrees_of_freedom(place[self._border(self._parts[half])]))
            for half in part.halves
        )
        dofs = degrees_of_freedom(place[self._elements[part.members]].ravel())
        dofs = dofs.reshape(len(part.members), 3 * self._elements.shape[1])
        scatter = dofs[:, :, None] * size + dofs[:, None, :]
        scatter[(dofs < 0)[:, :, None] | (dofs < 0)[:, None, :]] = size * size
        place[nodes] = -1
        return Front(
            own=degrees_of_freedom(part.own),
            border=degrees_of_freedom(border),
            elements=part.members,
            scatter=scatter.ravel(),
            children=children,
        )


def _add(dense: Floats, part: Floats, places: Ints) -> None:
    """Add the lower half of `part` into that of `dense` at `places`, which rise.

    What lies above the diagonals is never read.
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(places) != 1) + 1, [len(places)]])
    if len(starts) > MANY_RUNS:
        dense[np.ix_(places, places)] += part
        return
    runs = [(a, b, places[a], places[b - 1] + 1) for a, b in itertools.pairwise(starts.tolist())]
    for number, (c, d, left, right) in enumerate(runs):
        for a, b, top, bottom in runs[number:]:
            dense[top:bottom, left:right] += part[a:b, c:d]
