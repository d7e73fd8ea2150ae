"""Measure the quality of tetrahedra with straight or curved edges."""

from __future__ import annotations

import itertools

import numpy as np

from flexsheet.nodes.arrays import Floats, Ints

MIN_RADIUS_RATIO = 0.1
"""The minimum radius ratio (3 times the inscribed radius over the circumscribed radius) of all
elements of an accepted mesh."""
MIN_JACOBIAN_RATIO = 0.1
"""The minimum Jacobian determinant of a curved element, divided by the determinant of the same
element with straight edges."""

_EDGE_OF = np.array([[-1, 4, 6, 7], [4, -1, 5, 8], [6, 5, -1, 9], [7, 8, 9, -1]])
"""The index of the node at the midpoint of each edge of an element. The row and the column are the
indices of the edge's two corners."""


def signed_volumes(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the signed volumes (e,), m^3, of tetrahedra with straight edges."""
    corners = points[tetrahedra[:, :4]]
    volume: Floats = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    return volume


def radius_ratios(points: Floats, tetrahedra: Ints) -> Floats:
    """Return the radius ratio (e,) of each tetrahedron, a measure of its quality.

    The ratio is 3 r / R, where r is the radius of the inscribed sphere and R the radius of the
    circumscribed sphere. The ratio is 1 if the tetrahedron is regular, 0 if it is flat, and
    negative if it is inverted. Crelle's formula gives R from the volume V: 24 V R = sqrt(p (p - 2
    a) (p - 2 b) (p - 2 c)). In this formula, a, b and c are the products of the lengths of opposite
    edges, and p = a + b + c.
    """
    corners = points[tetrahedra[:, :4]]
    volume = signed_volumes(points, tetrahedra)
    area = np.zeros(len(tetrahedra))
    for triple in itertools.combinations(range(4), 3):
        a, b, c = (corners[:, i] for i in triple)
        area += 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    products = np.stack(
        [
            np.linalg.norm(corners[:, i] - corners[:, j], axis=1)
            * np.linalg.norm(corners[:, k] - corners[:, m], axis=1)
            for i, j, k, m in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2))
        ]
    )
    total = products.sum(axis=0)
    heron = total * (total - 2.0 * products).prod(axis=0)
    # r = 3 V / area and R = sqrt(heron) / (24 V). The lower bound avoids 0 / 0 for flat tetrahedra.
    root = np.sqrt(np.maximum(heron, 1e-300))
    ratio: Floats = 216.0 * volume * np.abs(volume) / (area * root)
    return ratio


def min_jacobian_ratios(nodes: Floats, elements: Ints) -> Floats:
    """Return a lower bound (e,) of the minimum Jacobian ratio of each 10-node tetrahedron.

    The ratio is the Jacobian determinant, divided by that of the tetrahedron with straight edges.
    The determinant is a cubic polynomial in the barycentric coordinates. It is at least as large as
    its smallest Bernstein coefficient. Source: Johnen, Remacle, Geuzaine, "Geometrical validity of
    curvilinear finite elements", 2013.
    """
    points = nodes[elements]
    slopes = np.empty((len(elements), 4, 4, 3))
    for at, along in itertools.product(range(4), repeat=2):
        if at == along:
            slopes[:, at, along] = 3.0 * points[:, along]
        else:
            slopes[:, at, along] = 4.0 * points[:, _EDGE_OF[at, along]] - points[:, along]
    derivative = slopes[:, :, 1:] - slopes[:, :, :1]
    crossed = np.cross(derivative[:, :, None, 0], derivative[:, None, :, 1])
    triple = np.einsum("eijx,ekx->eijk", crossed, derivative[:, :, 2])
    minimum = np.full(len(elements), np.inf)
    for corners in itertools.combinations_with_replacement(range(4), 3):
        orders = list(itertools.permutations(corners))
        minimum = np.minimum(minimum, sum(triple[:, i, j, k] for i, j, k in orders) / len(orders))
    return minimum / (6.0 * signed_volumes(nodes, elements))
