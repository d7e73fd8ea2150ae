"""A short path ahead: where a thing will be at even steps from now, and between them.

Whoever predicts says where the thing will be at 0, step, 2 step, ... seconds; whoever uses it asks
for the moment of use.  So the predictor may be as elaborate as it likes without its users knowing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def even_path(position: Floats, velocity: Floats, *, count: int, step_s: float) -> Floats:
    """Path (count, 3) of a thing at `position` (3,) m that keeps its `velocity` (3,) m/s."""
    return position + np.arange(count)[:, None] * step_s * velocity


def path_at(path: Floats, step_s: float, lead_s: float) -> tuple[Floats, Floats]:
    """Position (3,) m and velocity (3,) m/s on a path (n >= 2, 3) `lead_s` after its first point.

    Between the points a cubic through them whose slopes are their differences (Catmull and Rom
    1974): a swing of 10 Hz told every 10 ms is met to a hundredth of its amplitude.  Beyond the
    last point the path goes on as it ended; before the first, as it began.
    Raises ValueError for a path of fewer than two points.
    """
    count = len(path)
    if count < 2:
        raise ValueError(f"a path of {count} points leads nowhere: two are needed")
    place = lead_s / step_s
    i = min(max(int(np.floor(place)), 0), count - 2)
    share = place - i
    begin, end = path[i], path[i + 1]
    begin_slope, end_slope = _slope(path, i), _slope(path, i + 1)
    if share < 0.0:
        return begin + share * begin_slope, begin_slope / step_s
    if share > 1.0:
        return end + (share - 1.0) * end_slope, end_slope / step_s
    way = end - begin
    square, cube = share * share, share * share * share
    position = (
        begin
        + (3.0 * square - 2.0 * cube) * way
        + (cube - 2.0 * square + share) * begin_slope
        + (cube - square) * end_slope
    )
    velocity = (
        6.0 * (share - square) * way
        + (3.0 * square - 4.0 * share + 1.0) * begin_slope
        + (3.0 * square - 2.0 * share) * end_slope
    ) / step_s
    return position, velocity


def _slope(path: Floats, i: int) -> Floats:
    """Slope (3,) per step at a point of a path, of second order at its ends too."""
    last = len(path) - 1
    if last == 1:
        return np.asarray(path[1] - path[0])
    if i == 0:
        return np.asarray(-1.5 * path[0] + 2.0 * path[1] - 0.5 * path[2])
    if i == last:
        return np.asarray(1.5 * path[last] - 2.0 * path[last - 1] + 0.5 * path[last - 2])
    return np.asarray(0.5 * (path[i + 1] - path[i - 1]))
