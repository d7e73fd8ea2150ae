"""Interpolate between two values, and between the points of predicted paths.

The points of a path are at equal time intervals. The first point is at the time 0.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from flexsheet.nodes.arrays import Floats

Real = TypeVar("Real", float, Floats)


def smoothstep(t: Real) -> Real:
    """Return 3 t^2 - 2 t^3 for t from 0 to 1.

    The function rises from 0 to 1 and has zero slope at both ends.
    """
    return t * t * (3.0 - 2.0 * t)


def interpolate_path(path: Floats, step_s: float, time_s: float) -> tuple[Floats, Floats]:
    """Return the position (3,), m, and velocity (3,), m/s, of a path at `time_s` after its start.

    path (n, 3): positions, m, at intervals of `step_s`.

    The interpolation is cubic with central differences as slopes (Catmull and Rom 1974). The
    extrapolation beyond both ends is linear. Raises ValueError if the path has fewer than two
    points.
    """
    count = len(path)
    if count < 2:
        raise ValueError(
            f"the predicted path has {count} points; at least two are required; send a longer path"
        )
    steps = time_s / step_s
    i = min(max(int(np.floor(steps)), 0), count - 2)
    t = steps - i
    begin, end = path[i], path[i + 1]
    begin_slope, end_slope = _slope(path, i), _slope(path, i + 1)
    if t < 0.0:
        return begin + t * begin_slope, begin_slope / step_s
    if t > 1.0:
        return end + (t - 1.0) * end_slope, end_slope / step_s
    chord = end - begin
    square, cube = t * t, t * t * t
    position = (
        begin
        + (3.0 * square - 2.0 * cube) * chord
        + (cube - 2.0 * square + t) * begin_slope
        + (cube - square) * end_slope
    )
    velocity = (
        6.0 * (t - square) * chord
        + (3.0 * square - 4.0 * t + 1.0) * begin_slope
        + (3.0 * square - 2.0 * t) * end_slope
    ) / step_s
    return position, velocity


def _slope(path: Floats, i: int) -> Floats:
    """Return the slope (3,) of a path at point `i`, in m per step, by second-order differences."""
    last = len(path) - 1
    if last == 1:
        return np.asarray(path[1] - path[0])
    if i == 0:
        return np.asarray(-1.5 * path[0] + 2.0 * path[1] - 0.5 * path[2])
    if i == last:
        return np.asarray(1.5 * path[last] - 2.0 * path[last - 1] + 0.5 * path[last - 2])
    return np.asarray(0.5 * (path[i + 1] - path[i - 1]))
