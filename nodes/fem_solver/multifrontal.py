"""Factor a mesh's stiffness matrix, given as element matrices, by a multifrontal Cholesky method.

Nested dissection bisects the set of elements recursively (George 1973). The degrees of freedom that
two halves share are eliminated after the degrees of freedom inside the halves. The elimination of a
half leaves a dense Schur complement on its boundary, which is added to the matrix of its parent
(Duff & Reid 1983). Nearly all work is dense linear algebra. The elimination order is computed once
per mesh and reused for every stiffness matrix of a Newton iteration.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import scipy

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Bools, Floats, Ints
from flexsheet.nodes.fem_solver.elasticity import degrees_of_freedom, scatter_add

LEAF_ELEMENTS = 48
MAX_RUNS = 40
NO_CHILDREN: tuple[int, ...] = ()


class IndefiniteError(FlexsheetError, ArithmeticError):
    """Raised if a stiffness matrix is not positive definite."""

    remedy = "Fix the body at its base. Check that Poisson's ratio is below 0.5."


@dataclass(frozen=True, slots=True)
class Front:
    """A node of the elimination tree, with a dense matrix over its degrees of freedom.

    pivots: degrees of freedom that are eliminated in this front. boundary: degrees of freedom that
    the parent eliminates. elements: indices of the elements; empty unless the front is a leaf.
    scatter: position in the dense matrix for each entry of the element matrices. Entries of fixed
    nodes have a position past the end of the matrix. children: for each child front, its index and
    the positions of its boundary in this front.
    """

    pivots: Ints
    boundary: Ints
    elements: Ints
    scatter: Ints
    children: tuple[tuple[int, Ints], ...]


@dataclass(frozen=True, slots=True)
class Factors:
    """The Cholesky factors L of a stiffness matrix K = L L^T, in the number format of K."""

    fronts: list[Front]
    diagonal: list[Floats]
    off_diagonal: list[Floats]

    def solve(self, loads: Floats) -> Floats:
        """Return the displacements of n nodes for one load vector (3n,) or k load vectors (3n, k).

        The result has the shape of the loads and is 0 at fixed nodes.
        """
        (trsm,) = scipy.linalg.get_blas_funcs(("trsm",), dtype=self.diagonal[0].dtype)
        work = loads.reshape(len(loads), -1).astype(self.diagonal[0].dtype)
        for front, diagonal_block, off_block in zip(
            self.fronts, self.diagonal, self.off_diagonal, strict=True
        ):
            part = trsm(1.0, diagonal_block, work[front.pivots], lower=1)
            work[front.pivots] = part
            if len(front.boundary):
                work[front.boundary] -= off_block @ part
        result = np.zeros_like(work)
        for front, diagonal_block, off_block in zip(
            reversed(self.fronts), reversed(self.diagonal), reversed(self.off_diagonal), strict=True
        ):
            part = work[front.pivots]
            if len(front.boundary):
                part = part - off_block.T @ result[front.boundary]
            result[front.pivots] = trsm(1.0, diagonal_block, part, lower=1, trans_a=1)
        return result.reshape(loads.shape).astype(np.float64, copy=False)


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of the mesh in the nested dissection.

    pivots: nodes that are eliminated with this part. boundary: nodes that the parent eliminates.
    members: indices of the elements; empty unless the part is a leaf. halves: indices of the two
    halves; empty for a leaf.
    """

    pivots: Ints
    boundary: Ints
    members: Ints
    halves: tuple[int, ...]


class NestedDissection:
    """The elimination order that makes the factorization of a mesh's stiffness matrix fast."""

    def __init__(self, nodes: Floats, elements: Ints, fixed: Bools) -> None:
        """Compute the elimination order.

        nodes (n, 3): positions of the n nodes, m. elements (e, k): indices of the k nodes of each
        element. fixed (n,): whether each node is fixed.
        """
        self._elements, self._fixed = elements, fixed
        self._centres = nodes[elements].mean(axis=1)
        self._uses = np.bincount(elements.ravel(), minlength=len(nodes))
        self._parts: list[_Part] = []
        self._split(np.arange(len(elements)))
        # Boundaries are sorted by elimination order. The nodes of a boundary then have the same
        # order in the parent, so only lower triangles need to be added. Nodes of one leaf are
        # adjacent, so that large blocks are added at once.
        self._rank = np.empty(len(nodes), dtype=np.int64)
        leaf = np.zeros(len(nodes), dtype=np.int64)
        for number, part in enumerate(self._parts):
            leaf[elements[part.members]] = number
        parts = [
            replace(part, pivots=part.pivots[np.argsort(leaf[part.pivots])]) for part in self._parts
        ]
        self._parts = parts
        order = np.concatenate([part.pivots for part in parts])
        self._rank[order] = np.arange(len(order))
        self._position = np.full(len(nodes), -1)
        self.fronts = [self._front(part) for part in self._parts]

    def factor(self, matrices: Floats) -> Factors:
        """Factor the stiffness matrix, the sum of e symmetric element matrices (e, 3k, 3k).

        float32 matrices need half of the time and memory of float64 matrices, but their solutions
        have only about four digits. Raises IndefiniteError if the sum is not positive definite.
        """
        dtype = matrices.dtype
        trsm, syrk = scipy.linalg.get_blas_funcs(("trsm", "syrk"), dtype=dtype)
        (potrf,) = scipy.linalg.get_lapack_funcs(("potrf",), dtype=dtype)
        left: dict[int, Floats] = {}
        diagonal, off_diagonal = [], []
        for number, front in enumerate(self.fronts):
            pivot_count, size = len(front.pivots), len(front.pivots) + len(front.boundary)
            if front.children:
                dense = np.zeros((size, size), dtype, order="F")
                for child, positions in front.children:
                    _add_block(dense, left.pop(child), positions)
            else:
                entries = matrices[front.elements].ravel()
                summed = scatter_add(front.scatter, entries, size * size + 1)
                dense = summed[:-1].reshape(size, size).astype(dtype, copy=False).T
            diagonal_block, failed_pivot = potrf(
                dense[:pivot_count, :pivot_count], lower=1, clean=0
            )
            if failed_pivot:
                raise IndefiniteError(
                    "the stiffness matrix is not positive definite: "
                    f"pivot {failed_pivot} of front {number} is not positive"
                )
            off_block = trsm(
                1.0, diagonal_block, dense[pivot_count:, :pivot_count], side=1, lower=1, trans_a=1
            )
            diagonal.append(diagonal_block)
            off_diagonal.append(off_block)
            if size > pivot_count:
                left[number] = syrk(
                    -1.0, off_block, beta=1.0, c=dense[pivot_count:, pivot_count:], lower=1
                )
        return Factors(self.fronts, diagonal, off_diagonal)

    def _split(self, members: Ints) -> tuple[int, Ints, Ints]:
        """Divide elements recursively into a binary tree of parts.

        The parts are appended to a list, the two children before their parent.

        members: indices of the elements.

        Returns the list index of the tree's root, and the indices (k,) of the k free nodes of the
        elements. Also returns the number (k,) of these elements that contain each node.
        """
        if len(members) <= LEAF_ELEMENTS:
            present, counts = np.unique(self._elements[members], return_counts=True)
            free = ~self._fixed[present]
            present, counts = present[free], counts[free]
            candidates, halves = present, NO_CHILDREN
        else:
            first, second = self._bisect(members)
            a, present_a, counts_a = self._split(first)
            b, present_b, counts_b = self._split(second)
            present, where = np.unique(np.append(present_a, present_b), return_inverse=True)
            counts = np.bincount(where, np.append(counts_a, counts_b)).astype(np.int64)
            candidates = np.union1d(self._parts[a].boundary, self._parts[b].boundary)
            members, halves = np.empty(0, dtype=np.int64), (a, b)
        done = counts[np.searchsorted(present, candidates)] == self._uses[candidates]
        self._parts.append(_Part(candidates[done], candidates[~done], members, halves))
        return len(self._parts) - 1, present, counts

    def _bisect(self, members: Ints) -> tuple[Ints, Ints]:
        """Divide elements along the axis for which the two halves share the fewest nodes."""
        cuts = []
        for axis in range(3):
            order = members[np.argsort(self._centres[members, axis], kind="stable")]
            first, second = order[: len(order) // 2], order[len(order) // 2 :]
            shared = np.intersect1d(self._elements[first], self._elements[second])
            cuts.append((len(shared), first, second))
        _, first, second = min(cuts, key=lambda cut: cut[0])
        return first, second

    def _sorted_boundary(self, part: _Part) -> Ints:
        return part.boundary[np.argsort(self._rank[part.boundary])]

    def _front(self, part: _Part) -> Front:
        boundary = self._sorted_boundary(part)
        nodes = np.append(part.pivots, boundary)
        position, size = self._position, 3 * len(nodes)
        position[nodes] = np.arange(len(nodes))
        children = tuple(
            (half, degrees_of_freedom(position[self._sorted_boundary(self._parts[half])]))
            for half in part.halves
        )
        dofs = degrees_of_freedom(position[self._elements[part.members]].ravel())
        dofs = dofs.reshape(len(part.members), 3 * self._elements.shape[1])
        scatter = dofs[:, :, None] * size + dofs[:, None, :]
        scatter[(dofs < 0)[:, :, None] | (dofs < 0)[:, None, :]] = size * size
        position[nodes] = -1
        return Front(
            pivots=degrees_of_freedom(part.pivots),
            boundary=degrees_of_freedom(boundary),
            elements=part.members,
            scatter=scatter.ravel(),
            children=children,
        )


def _add_block(dense: Floats, part: Floats, positions: Ints) -> None:
    """Add the lower triangle of a matrix to the lower triangle of a larger matrix.

    dense: larger matrix, which is changed. part (k, k): added matrix. positions (k,): rows and
    columns in `dense`, in increasing order. Entries of the result above the diagonal are undefined.
    """
    starts = np.concatenate([[0], np.flatnonzero(np.diff(positions) != 1) + 1, [len(positions)]])
    if len(starts) > MAX_RUNS:
        dense[np.ix_(positions, positions)] += part
        return
    runs = [
        (a, b, positions[a], positions[b - 1] + 1) for a, b in itertools.pairwise(starts.tolist())
    ]
    for number, (c, d, left, right) in enumerate(runs):
        for a, b, top, bottom in runs[number:]:
            dense[top:bottom, left:right] += part[a:b, c:d]
