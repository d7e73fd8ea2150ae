"""Render the image of a blurred ellipse, as of a flat round marker that is seen at an angle.

The ellipse is uniform, its point spread is Gaussian with standard deviation `blur`.  The light at a
pixel p is the area integral of the Gaussian over the ellipse.  Green's theorem turns it into an
integral along the edge q with the outward normal n:

    S(p) = closed integral of (q - p) . n (1 - exp(-|q - p|^2 / 2 blur^2)) / (2 pi |q - p|^2).

Its derivatives are edge integrals of the Gaussian.  The sum over equidistant angles converges
exponentially, because the integrand is smooth and periodic.  The result is exact for any ratio of
blur and axes, whereas the error function of the edge distance (`subpixel`) needs a smooth edge.

The edge is q = centre + A (cos t, sin t), A = [[r + e, f], [f, r - e]].  The semi-axes are r plus
and minus the length of the elongation (e, f).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NODE_SPACING = 1.4
"""Maximum distance of nodes on the edge, in standard deviations of the blur; the error of the light
is then less than a thousandth."""

MIN_NODES, MAX_NODES = 12, 64
"""Bounds on the number of nodes.  The maximum is enough for a radius of 11 px in focus, and bounds
the time for a large light."""


def integrate_ellipse(shapes: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return light (n, m) of ellipses at m pixels, and its derivatives (n, 6, m) by the shape.

    shapes: (n, 6) px: centre (x, y), mean semi-axis, blur, elongation (e, f).
    x, y: (m,) px.
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
    # One row of weights per derivative but the blur's: how far its change moves the edge outwards.
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
