"""Check and refine triangle meshes, and compute their normals and nearest points.

A mesh consists of vertices (v, 3), m, and triangles (t, 3). A triangle contains the indices of its
vertices, counter-clockwise when seen from outside.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats

Indices = NDArray[np.int64]
Indices32 = NDArray[np.int32]

MAX_TRIANGLES = 100_000
MIN_HEIGHT_RATIO = 1e-6
"""The minimum ratio of a triangle's height to its longest edge. Flatter triangles count as
degenerate."""
MAX_DIHEDRAL_RAD = np.radians(175.0)
"""The angle (rad) between the normals of adjacent triangles above which the mesh counts as folded.
"""


class MeshError(FlexsheetError, ValueError):
    """Raised if a mesh is not the surface of a solid."""

    remedy = (
        "Repair the mesh: it must be closed, with outward triangles and without inverted elements; "
        "see docs/soft-body-reference.md."
    )


def check_mesh(vertices: Floats, triangles: Indices) -> None:
    """Raise MeshError unless a mesh is the closed, consistently wound surface of a solid.

    vertices (v, 3): positions, m.
    triangles (t, 3): indices of vertices.

    The check covers array shapes, size and vertex indices. It finds degenerate and repeated
    triangles, holes, edges of more than two triangles, and parts that share only a single vertex.
    It also finds inconsistent winding, folds and wrong orientation. Intersections of triangles are
    not checked; see `count_intersections`.
    """
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise MeshError(
            f"the arrays of the mesh have the shapes {vertices.shape} and {triangles.shape}, "
            "expected vertices (v, 3) and triangles (t, 3)"
        )
    if len(triangles) < 4:
        raise MeshError(
            f"the mesh has {len(triangles)} triangles, but a closed surface needs at least 4; "
            "add the missing triangles"
        )
    if len(triangles) > MAX_TRIANGLES:
        raise MeshError(
            f"the mesh has {len(triangles)} triangles, but the maximum is {MAX_TRIANGLES}; "
            "simplify the mesh"
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MeshError(
            f"a triangle of the mesh has a vertex index outside 0..{len(vertices) - 1}; "
            "export the mesh again"
        )
    if not np.isfinite(vertices).all():
        raise MeshError("a vertex of the mesh is NaN or infinite; export the mesh again")
    flat = int(find_degenerate(vertices, triangles).sum())
    if flat:
        raise MeshError(f"{flat} triangles of the mesh are degenerate (no area); remove them")
    _check_edges(triangles)
    _check_fans(triangles)
    folded = int((dihedrals_rad(vertices, triangles)[1] > MAX_DIHEDRAL_RAD).sum())
    if folded:
        raise MeshError(
            f"{folded} pairs of neighbouring triangles of the mesh are folded onto each other; "
            "repair them"
        )
    if volume_m3(vertices, triangles) <= 0.0:
        raise MeshError(
            "the mesh is inside out: its triangles are clockwise seen from outside; reverse them"
        )


def triangulate_grid(rows: int, columns: int) -> Indices32:
    """Return triangles (t, 3) that connect grid points, which are numbered row by row.

    The triangles are counter-clockwise if the column number increases along +x and the row number
    along +y.
    """
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    both = [np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)]
    return np.concatenate(both).astype(np.int32)


def find_degenerate(vertices: Floats, triangles: Indices) -> NDArray[np.bool_]:
    """Return whether each triangle (t,) has repeated or collinear vertices."""
    corners = vertices[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    longest = np.square(sides).sum(-1).max(-1)
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
    return np.asarray(doubled <= MIN_HEIGHT_RATIO * longest)


def half_edges(triangles: Indices) -> Indices:
    """Return the directed edges (3 t, 2) of triangles (t, 3), as pairs of vertex indices.

    The array contains the first edges of all triangles, then the second and then the third edges.
    """
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def _check_edges(triangles: Indices) -> None:
    """Raise MeshError unless each edge has two triangles that contain it in opposite directions."""
    run = half_edges(triangles)
    edges, uses = np.unique(np.sort(run, axis=1), axis=0, return_counts=True)
    open_edges, crowded = int((uses == 1).sum()), int((uses > 2).sum())
    if open_edges:
        raise MeshError(
            f"the mesh is not closed: {open_edges} edges have only one triangle; fill the holes"
        )
    if crowded:
        raise MeshError(
            f"{crowded} edges of the mesh have more than two triangles; separate the parts there"
        )
    twice = len(run) - len(np.unique(run, axis=0))
    if twice:
        raise MeshError(
            f"the triangle winding is inconsistent along {twice} of {len(edges)} edges of the "
            "mesh; reverse triangles until neighbours agree"
        )


def _check_fans(triangles: Indices) -> None:
    """Raise MeshError unless the triangles around each vertex form a single closed fan.

    If they form several fans, parts of the surface touch each other only at that vertex.
    """
    count = len(triangles)
    first, second = _neighbours(triangles)
    # Corner c of triangle t has the index c * count + t. Build a graph of corners: at each end of
    # an edge, the corners of the two adjacent triangles are connected.
    ends = [(first, (second + count) % (3 * count)), ((first + count) % (3 * count), second)]
    rows, columns = (np.concatenate(side) for side in zip(*ends, strict=True))
    from scipy.sparse import coo_array  # imported late: scipy is slow to import
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(rows)), (rows, columns)), shape=(3 * count, 3 * count))
    fans = connected_components(joined, directed=False)[0]
    pinched = fans - len(np.unique(triangles))
    if pinched:
        raise MeshError(
            f"parts of the mesh touch in {pinched} single vertices, without a common edge; "
            "separate them"
        )


def unify_winding(triangles: Indices) -> Indices:
    """Reverse triangles (t, 3) where necessary so that adjacent triangles have the same winding.

    In each connected part, the result has the winding of the majority of the triangles. If no
    consistent winding exists, as on a Möbius strip, `check_mesh` fails afterwards.
    """
    count = len(triangles)
    run = half_edges(triangles)
    _, which, uses = np.unique(
        np.sort(run, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(which.ravel(), kind="stable")
    first = np.cumsum(uses) - uses
    shared = first[uses == 2]
    one, other = order[shared], order[shared + 1]
    against = (run[one] == run[other]).all(axis=1)
    # Build a graph with two nodes for each triangle t: t as given, and t + count reversed. Nodes
    # with the same winding are connected, so that each part of the mesh has two components.
    a, b = one % count, other % count
    from scipy.sparse import coo_array  # imported late: scipy is slow to import
    from scipy.sparse.csgraph import connected_components

    ends = (
        np.concatenate([a, a + count]),
        np.concatenate([b + count * against, b + count * ~against]),
    )
    joined = coo_array((np.ones(len(ends[0])), ends), shape=(2 * count, 2 * count))
    label = connected_components(joined, directed=False)[1].reshape(2, count)
    flipped, part = label[0] > label[1], label.min(axis=0)
    mostly_flipped = np.bincount(part, flipped) > 0.5 * np.bincount(part)
    flipped ^= mostly_flipped[part]
    return np.where(flipped[:, None], triangles[:, ::-1], triangles)


def _neighbours(triangles: Indices) -> tuple[Indices, Indices]:
    """Return the two half-edges (directed edges) of each of e edges, as two arrays (e,).

    The arrays contain row indices of the result of `half_edges`.
    """
    run = half_edges(triangles)
    span = int(triangles.max()) + 1
    forward, backward = run[:, 0] * span + run[:, 1], run[:, 1] * span + run[:, 0]
    order = np.argsort(forward)
    partner = order[np.searchsorted(forward, backward, sorter=order)]
    first = np.flatnonzero(run[:, 0] < run[:, 1])
    return first, partner[first]


def triangle_normals(vertices: Floats, triangles: Indices) -> Floats:
    """Return the unit normals (t, 3) of triangles (t, 3) with vertices (v, 3)."""
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def vertex_normals(vertices: Floats, triangles: Indices) -> Floats:
    """Return unit normals (v, 3) at the vertices, as if the mesh were a smooth surface.

    A normal is the mean of the adjacent triangles' normals, weighted by the triangles' angles at
    the vertex (Thürmer and Wüthrich, 1998).
    """
    corners, normal = vertices[triangles], triangle_normals(vertices, triangles)
    total = np.zeros_like(vertices)
    for i in range(3):
        ahead = corners[:, (i + 1) % 3] - corners[:, i]
        back = corners[:, (i + 2) % 3] - corners[:, i]
        sine = np.linalg.norm(np.cross(ahead, back), axis=1)
        angle = np.arctan2(sine, (ahead * back).sum(1))
        np.add.at(total, triangles[:, i], angle[:, None] * normal)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def dihedrals_rad(vertices: Floats, triangles: Indices) -> tuple[Indices, Floats]:
    """Return the edges (e, 2) of a closed mesh, and the angles (e,), in rad, at these edges.

    The angle at an edge is the angle between the normals of its two triangles.
    """
    normal, count = triangle_normals(vertices, triangles), len(triangles)
    first, second = _neighbours(triangles)
    one, other = normal[first % count], normal[second % count]
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    return half_edges(triangles)[first], np.arctan2(sine, (one * other).sum(1))


def volume_m3(vertices: Floats, triangles: Indices) -> float:
    """Return the volume (m^3) that a closed mesh encloses.

    The result is negative if the triangles are clockwise when seen from outside.
    """
    corners = vertices[triangles] - vertices[triangles].mean(axis=(0, 1))
    return float((corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def refine_facets(vertices: Floats, triangles: Indices, longest_m: float) -> tuple[Floats, Indices]:
    """Divide triangles (t, 3) until no edge is longer than `longest_m`, and return the new mesh.

    A long edge is halved in both adjacent triangles, so a closed mesh remains closed. Raises
    MeshError if the result has more than `MAX_TRIANGLES` triangles.
    """
    while True:
        run = np.sort(half_edges(triangles), axis=1)
        edges, which = np.unique(run, axis=0, return_inverse=True)
        which = which.reshape(3, -1).T
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        # Halve only the longest edge of a triangle, which keeps the triangles well shaped.
        longest = which[np.arange(len(which)), length[which].argmax(axis=1)]
        halved = np.zeros(len(edges), dtype=bool)
        halved[longest[length[longest] > longest_m]] = True
        if not halved.any():
            return vertices, triangles
        middle = np.full(len(edges), -1)
        middle[halved] = len(vertices) + np.arange(int(halved.sum()))
        vertices = np.concatenate([vertices, vertices[edges[halved]].mean(axis=1)])
        triangles = np.concatenate(list(_split(triangles, middle[which])))
        if len(triangles) > MAX_TRIANGLES:
            raise MeshError(
                f"the mesh has edges of up to {length.max():.3g} m; dividing them to at most "
                f"{longest_m:.3g} m needs more than {MAX_TRIANGLES} triangles; increase the "
                "permitted edge length (smoothing_m of the mesh in a scene) or use a smaller object"
            )


def _split(triangles: Indices, middle: Indices) -> Iterator[Indices]:
    """Split triangles (t, 3) at the midpoints of some of their edges, and yield the parts.

    middle (t, 3): vertex index of the midpoint of each edge; -1 if the edge is not split.
    """
    cuts = (middle >= 0).sum(axis=1)
    yield triangles[cuts == 0]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        a, b, c = triangles[:, i], triangles[:, j], triangles[:, k]
        ab, bc, ca = middle[:, i], middle[:, j], middle[:, k]
        only = (cuts == 1) & (ab >= 0)
        yield np.stack([a, ab, c], axis=1)[only]
        yield np.stack([ab, b, c], axis=1)[only]
        both = (cuts == 2) & (bc < 0)
        yield np.stack([a, ab, ca], axis=1)[both]
        yield np.stack([ab, b, ca], axis=1)[both]
        yield np.stack([b, c, ca], axis=1)[both]
    whole = cuts == 3
    a, b, c = triangles[whole].T
    ab, bc, ca = middle[whole].T
    for one in ((a, ab, ca), (ab, b, bc), (bc, c, ca), (ab, bc, ca)):
        yield np.stack(one, axis=1)


def count_intersections(vertices: Floats, triangles: Indices) -> int:
    """Count the pairs of triangles that intersect.

    A pair intersects if an edge of one triangle passes through the interior of the other triangle.
    An edge is not considered if one of its ends is a vertex of the other triangle. Two triangles
    are not counted if they only touch, or if they overlap in the same plane.
    """
    corners = vertices[triangles]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    found = set()
    for rows, columns in _close_pairs(centre, radius):
        for one, other in ((rows, columns), (columns, rows)):
            for i in range(3):
                start, end = triangles[one, i], triangles[one, (i + 1) % 3]
                target = triangles[other]
                apart = ~((target == start[:, None]) | (target == end[:, None])).any(axis=1)
                hit = np.flatnonzero(apart)[
                    _passes(vertices[start[apart]], vertices[end[apart]], corners[other[apart]])
                ]
                found |= {
                    (min(a, b), max(a, b))
                    for a, b in zip(one[hit].tolist(), other[hit].tolist(), strict=True)
                }
    return len(found)


def _close_pairs(centre: Floats, radius: Floats) -> Iterator[tuple[Indices, Indices]]:
    """Yield the pairs of overlapping spheres in batches, as two arrays of sphere indices.

    centre (n, 3), radius (n,): centres and radii of the spheres, m.

    Spheres of similar size are searched together, because the largest sphere determines the search
    radius.
    """
    from scipy.spatial import cKDTree

    octave = np.floor(np.log2(radius)).astype(int)
    classes = [np.flatnonzero(octave == size) for size in np.unique(octave)]
    for i, large in enumerate(classes):
        for members in np.array_split(large, len(large) // 4096 + 1):
            for small in classes[: i + 1]:
                reach = radius[members] + radius[small].max()
                lists = cKDTree(centre[small]).query_ball_point(centre[members], reach)
                rows = np.repeat(members, [len(one) for one in lists])
                columns = small[np.concatenate([np.array(one, dtype=int) for one in lists])]
                keep = np.linalg.norm(centre[rows] - centre[columns], axis=1) <= (
                    radius[rows] + radius[columns]
                )
                keep &= (rows < columns) if small is large else (rows != columns)
                yield rows[keep], columns[keep]


def _passes(start: Floats, end: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Return for each of n line segments whether it passes through the interior of its triangle.

    start, end (n, 3): end points of the segments.
    corners (n, 3, 3): one triangle for each segment.

    Source: Möller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997.
    """
    along = end - start
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(along, second)
    determinant = (first * across).sum(1)
    scale = np.linalg.norm(along, axis=1) * np.linalg.norm(np.cross(first, second), axis=1)
    slanted = np.abs(determinant) > 1e-9 * scale
    inverse = 1.0 / np.where(slanted, determinant, 1.0)
    offset = start - corners[:, 0]
    u = (offset * across).sum(1) * inverse
    normal_cross = np.cross(offset, first)
    v = (along * normal_cross).sum(1) * inverse
    t = (second * normal_cross).sum(1) * inverse
    inside = (u > 1e-9) & (v > 1e-9) & (u + v < 1.0 - 1e-9)
    return np.asarray(slanted & inside & (t > 1e-9) & (t < 1.0 - 1e-9))


def intersect_rays(
    origin: Floats, rays: Floats, corners: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Intersect lines through a point with triangles.

    origin (3,): common point of the lines.
    rays (n, 3): directions.
    corners (m, 3, 3): corners of m triangles.

    Return the index (n,) of the triangle that each line intersects, and the barycentric weights (n,
    3) of its corners. The weights are NaN if the line misses all triangles. Source: Möller and
    Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997.
    """
    first, along, up = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(along, up)
    from_first = origin - first
    # Each matrix product computes a scalar triple product for all rays and triangles.
    volume = -rays @ normal.T
    v = rays @ np.cross(up, from_first).T
    w = rays @ np.cross(from_first, along).T
    volume = np.where(np.abs(volume) < 1e-15, np.nan, volume)
    v, w = v / volume, w / volume
    inside = np.minimum(np.minimum(v, w), 1.0 - v - w)
    hit = np.nanargmax(inside, axis=1)
    rows = np.arange(len(rays))
    v, w = v[rows, hit], w[rows, hit]
    weights = np.column_stack([1.0 - v - w, v, w])
    return hit, np.where(inside[rows, hit][:, None] >= -1e-9, weights, np.nan)


def nearest_in_triangles(points: Floats, corners: Floats) -> Floats:
    """Return barycentric coordinates (n, 3) of the points of triangles nearest to `points` (n, 3).

    corners (n, 3, 3): corners of one triangle for each point.

    Source: Ericson, Real-Time Collision Detection, sec. 5.1.5.
    """
    a = corners[:, 0]
    first, second = corners[:, 1] - a, corners[:, 2] - a
    offset = points - a
    d11, d12, d22 = ((x * y).sum(1) for x, y in ((first, first), (first, second), (second, second)))
    p1, p2 = (offset * first).sum(1), (offset * second).sum(1)
    determinant = np.maximum(d11 * d22 - d12 * d12, 1e-300)
    v, w = (d22 * p1 - d12 * p2) / determinant, (d11 * p2 - d12 * p1) / determinant
    best = np.stack([1.0 - v - w, v, w], axis=1)
    outside = np.asarray((best < 0.0).any(axis=1))
    if np.any(outside):
        candidates = []
        for i in range(3):
            j = (i + 1) % 3
            edge = corners[:, j] - corners[:, i]
            t = ((points - corners[:, i]) * edge).sum(1) / (edge * edge).sum(1)
            t = np.clip(t, 0.0, 1.0)
            weights = np.zeros((len(points), 3))
            weights[:, i], weights[:, j] = 1.0 - t, t
            candidates.append(weights)
        every = np.stack(candidates, axis=1)
        points_on_edges = every @ corners
        closest = np.square(points_on_edges - points[:, None]).sum(2).argmin(axis=1)
        chosen = every[np.arange(len(points)), closest]
        best = np.where(outside[:, None], chosen, best)
    return best
