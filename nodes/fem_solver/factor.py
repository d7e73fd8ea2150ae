"""Cholesky factors of a stiffness whose nodes come in slabs, for very many right-hand sides.

A solid cut into successive slabs gives a block tridiagonal matrix.  Its blocks are factored and
solved densely: for the thousands of loads of a precomputation that is several times faster than a
general sparse factor, whose solves run at memory speed, not at the processor's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.sparse import csc_matrix

from nodes.fem_solver.elasticity import MeshError, degrees_of_freedom

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Slab:
    """One diagonal block: its global degrees of freedom, its upper factor, its tie to the next.

    tie = factor^-T K[dofs, next dofs[columns]]; the other columns of the coupling are zero.
    """

    dofs: Ints
    factor: Floats
    tie: Floats
    columns: Ints


class SlabCholesky:
    """K = L L^T of the free degrees of freedom."""

    def __init__(
        self,
        stiffness: csc_matrix,
        slab: Ints,
        fixed: NDArray[np.bool_],
        *,
        on_slab: Callable[[], None] = lambda: None,
    ) -> None:
        """slab (n,): slab of each node, as in `SolidMesh`; fixed (n,): nodes that do not move.

        on_slab is called after each slab; it may raise to stop.  MeshError if the body is not held
        (a pivot vanishes).
        """
        members = [np.flatnonzero((slab == number) & ~fixed) for number in range(slab.max() + 1)]
        dofs = [degrees_of_freedom(nodes) for nodes in members if len(nodes)]
        self.size = stiffness.shape[0]
        self.slabs: list[Slab] = []
        correction: tuple[Ints, Floats] | None = None
        by_row = stiffness.tocsr()
        for number, own in enumerate(dofs):
            rows = by_row[own]
            block = rows[:, own].toarray()
            if correction is not None:
                columns, update = correction
                block[np.ix_(columns, columns)] -= update
            try:
                factor = cholesky(block, overwrite_a=True, check_finite=False)
            except LinAlgError as error:
                raise MeshError(f"the body is free to move: slab {number}: {error}") from error
            columns, tie = np.empty(0, dtype=np.int64), np.empty((len(own), 0))
            if number + 1 < len(dofs):
                coupling = rows[:, dofs[number + 1]]
                columns = np.flatnonzero(np.diff(coupling.tocsc().indptr)).astype(np.int64)
                tie = solve_triangular(
                    factor, coupling[:, columns].toarray(), trans="T", check_finite=False
                )
                correction = (columns, tie.T @ tie)
            self.slabs.append(Slab(own, factor, tie, columns))
            on_slab()

    def solve(self, loads: Floats) -> Floats:
        """Displacements (3n, k) under loads (3n, k); zero where the body is fixed.

        Loads that vanish in the first slabs cost less.
        """
        part: list[Floats | None] = []
        push: Floats | None = None
        for number, slab in enumerate(self.slabs):
            right = loads[slab.dofs]
            if push is not None:
                right[self.slabs[number - 1].columns] -= push
            if push is None and not right.any():
                part.append(None)
                continue
            forward = solve_triangular(
                slab.factor, right, trans="T", overwrite_b=True, check_finite=False
            )
            part.append(forward)
            push = slab.tie.T @ forward
        result = np.zeros_like(loads)
        later: Floats | None = None
        for slab, forward in zip(reversed(self.slabs), reversed(part), strict=True):
            right = np.zeros((len(slab.dofs), loads.shape[1])) if forward is None else forward
            if later is not None:
                right -= slab.tie @ later[slab.columns]
            later = solve_triangular(slab.factor, right, overwrite_b=True, check_finite=False)
            result[slab.dofs] = later
        return result
