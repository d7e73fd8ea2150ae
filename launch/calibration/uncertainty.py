"""Compute the error of a measured fingertip that follows from the uncertainty of the rig.

It follows to first order from the covariance of the rig's numbers.  A jackknife, which leaves pairs
out, also covers common errors of corners, a board that is not flat, and a lens that differs from
the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.bundle import (
    LEFT,
    PARAMETERS,
    RIGHT,
    STAND,
    RigFit,
    fit_rig,
    floats,
    lens_arrays,
    pose_transform,
)
from flexsheet.launch.calibration.corners import BoardPair, Progress, ignore_progress
from flexsheet.nodes.models import rigid

Floats = NDArray[np.float64]

GROUPS = 20
"""Maximum number of refits of the jackknife; with more pairs, several are left out at a time."""


def view_of_work(
    rig: Floats, size: tuple[int, int], distance_m: float, *, across: int = 5
) -> Floats:
    """Return points (n, 3) in the left camera's frame, `distance_m` deep, where a fingertip is
    measured.

    They are a grid over the middle half, in both directions, of the left image, as far as the right
    image shows it.
    """
    matrix, distortion = lens_arrays(rig[LEFT])
    width, height = size
    fractions = np.linspace(0.25, 0.75, across)
    pixels = np.stack(np.meshgrid(fractions * (width - 1), fractions * (height - 1)), axis=-1)
    slopes = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, distortion)[:, 0]
    points = distance_m * np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    seen, _ = cv2.projectPoints(points, rig[STAND][:3], rig[STAND][3:], *lens_arrays(rig[RIGHT]))
    inside = ((seen[:, 0] >= 0) & (seen[:, 0] <= np.array([width, height]) - 1)).all(axis=1)
    return points[inside] if inside.any() else points


def position_slopes(rig: Floats, points: Floats) -> Floats:
    """Return the Jacobian (n, 3, 22) of triangulate_corners positions (n, 3) by the rig's numbers.

    A fingertip's pixels p = f(x, rig) are given.  The point of least squared image error then obeys
    A dx + B drig = 0 in the least-squares sense, with A = df/dx and B = df/drig, hence dx/drig =
    -(A'A)^-1 A'B.
    """
    count = len(points)
    by_point, by_rig = np.empty((count, 4, 3)), np.zeros((count, 4, len(PARAMETERS)))
    still = np.zeros(3)
    _, slope = cv2.projectPoints(points, still, still, *lens_arrays(rig[LEFT]))
    slope = slope.reshape(count, 2, -1)
    by_point[:, :2] = slope[..., 3:6]
    by_rig[:, :2, LEFT] = slope[..., 6:14]
    stand = rig[STAND]
    _, slope = cv2.projectPoints(points, stand[:3], stand[3:], *lens_arrays(rig[RIGHT]))
    slope = slope.reshape(count, 2, -1)
    by_point[:, 2:] = slope[..., 3:6] @ pose_transform(stand)[:3, :3]
    by_rig[:, 2:, RIGHT] = slope[..., 6:14]
    by_rig[:, 2:, STAND] = slope[..., :6]
    across = by_point.transpose(0, 2, 1)
    return floats(-np.linalg.solve(across @ by_point, across @ by_rig))


def position_spread(slopes: Floats, covariance: Floats) -> tuple[float, float]:
    """Return standard deviations (depth, lateral) m, root mean square over the points of `slopes`.

    covariance: of the rig (22, 22).

    Lateral means x and y together.
    """
    variances = np.einsum("nip,pq,niq->ni", slopes, covariance, slopes).mean(axis=0)
    return float(np.sqrt(variances[2])), float(np.sqrt(variances[0] + variances[1]))


def jackknife_covariance(
    fit: RigFit,
    pairs: Sequence[BoardPair],
    board: Floats,
    progress: Progress = ignore_progress,
) -> Floats:
    """Return the covariance (22, 22) of the rig from refits without some of the pairs each.

    The delete-a-group jackknife (Shao and Tu, The Jackknife and Bootstrap, 1995, section 5.5): (G -
    1)/G times the scatter of the G refits about their mean.
    """
    groups = min(GROUPS, len(pairs))
    rigs = []
    for group in range(groups):
        kept = [i for i in range(len(pairs)) if i % groups != group]
        refit = fit_rig([pairs[i] for i in kept], board, rig=fit.rig, poses=fit.poses[kept])
        rigs.append(refit.rig)
        progress(group + 1, groups, "leaving pairs out")
    scatter = np.array(rigs) - np.mean(rigs, axis=0)
    return np.asarray((groups - 1) / groups * scatter.T @ scatter)


def compute_right_from_left(rig: Floats) -> Floats:
    """Return the transform (4, 4) between the cameras of a rig (22,)."""
    return rigid.transform(pose_transform(rig[STAND])[:3, :3], rig[STAND][3:])
