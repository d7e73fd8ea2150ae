"""Render the image of a blurred ellipse, such as a flat round marker that is seen at an angle.

The ellipse is uniformly bright and blurred by a Gaussian with standard deviation `blur`. The light
S (0 to 1) at a pixel p is the integral of the Gaussian over the ellipse's area. Green's theorem
converts the area integral to an integral along the edge points q with outward normals n:

    S(p) = closed integral of (q - p) . n (1 - exp(-|q - p|^2 / 2 blur^2)) / (2 pi |q - p|^2).

The derivatives of S are integrals of the Gaussian along the edge. The integrals are computed as
sums over equidistant angles t, which converge exponentially. The result is exact for any ratio of
blur and axes. The faster model of the module `subpixel` requires a small blur relative to the
radius.

The edge is q = centre + A (cos t, sin t) with A = [[r + e, f], [f, r - e]]. The semi-axes are r
plus and minus the length of the elongation vector (e, f).
"""

from __future__ import annotations

import math

import numpy as np

from flexsheet.nodes.arrays import Floats

NODE_SPACING = 1.4
"""The maximum distance between integration nodes on the edge, in standard deviations of the blur.
At this distance, the error of the computed light is below 0.001."""

MIN_NODES, MAX_NODES = 12, 64
"""The bounds on the number of integration nodes. The maximum is sufficient for a sharp marker with
a radius of 11 px, and limits the computing time for a large bright spot."""


def integrate_ellipse(shapes: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the light (n, m) of n ellipses at m pixels, and its derivatives (n, 6, m).

    shapes: parameters (n, 6), px: centre (x, y), mean semi-axis, blur, elongation (e, f). The
        derivatives are with respect to these parameters.
    x, y: coordinates (m,) of the pixels, px.
    """
    radius, blur, elongation = shapes[:, 2], shapes[:, 3], shapes[:, 4:]
    longest = float((radius + np.hypot(*elongation.T)).max())
    wanted = math.ceil(math.tau * longest / (NODE_SPACING * float(blur.min())))
    nodes = min(max(wanted, MIN_NODES), MAX_NODES)
    angle = math.tau * np.arange(nodes) / nodes
    cosine, sine = np.cos(angle), np.sin(angle)
    first, second = (radius + elongation[:, 0])[:, None], (radius - elongation[:, 0])[:, None]
    mixed = elongation[:, 1, None]
    edge_x, edge_y = first * cosine + mixed * sine, mixed * cosine + second * sine
    step = math.tau / nodes
    normal_x = step * (second * cosine - mixed * sine)
    normal_y = step * (first * sine - mixed * cosine)

    dx = (shapes[:, 0, None] + edge_x)[:, :, None] - x
    dy = (shapes[:, 1, None] + edge_y)[:, :, None] - y
    away = dx * dx + dy * dy + 1e-12
    variance = (blur * blur)[:, None, None]
    spread = np.exp(away * (-0.5 / variance))
    flux = dx * normal_x[:, :, None] + dy * normal_y[:, :, None]
    light = np.add.reduce(flux * (1.0 - spread) / away, axis=1) / math.tau
    # For each parameter except the blur: how far the edge moves outwards if it changes.
    moved = np.stack(
        [
            normal_x,
            normal_y,
            normal_x * cosine + normal_y * sine,
            normal_x * cosine - normal_y * sine,
            normal_x * sine + normal_y * cosine,
        ],
        axis=1,
    )
    by_edge = moved @ spread / (math.tau * variance)
    by_blur = -np.add.reduce(flux * spread, axis=1) / (math.tau * (blur**3)[:, None])
    return light, np.concatenate([by_edge[:, :3], by_blur[:, None], by_edge[:, 3:]], axis=1)
