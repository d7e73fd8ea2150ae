"""Deflection shapes of the sheet for tests, with fewer nodes and a smaller range than in use."""

from __future__ import annotations

from functools import cache

from flexsheet.nodes.models.sheet.indentation import (
    IndentationBasis,
    IndentationRange,
    solve_indentation_basis,
)
from flexsheet.nodes.models.sheet.rubber import Rubber
from tests.shared import compute_once

RUBBER = Rubber(0.24, 0.24, 0.001, 1e6)
RADIUS_M = 0.007
MIN_STRETCH, MAX_STRETCH_RATIO, DEEPEST_M = 1.04, 1.06, 0.03
ELEMENT_CELLS = 20


@cache
def few_dents() -> IndentationBasis:
    within = IndentationRange(
        MIN_STRETCH,
        MAX_STRETCH_RATIO,
        DEEPEST_M,
        stretch_nodes=2,
        place_nodes=2,
        depth_nodes=6,
        element_cells=ELEMENT_CELLS,
    )
    return compute_once(
        "few_dents",
        lambda: solve_indentation_basis(RUBBER, within=within, finger_radius_m=RADIUS_M),
    )
