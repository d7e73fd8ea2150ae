"""Compute the error of a measured fingertip that results from the uncertainty of the stereo rig.

To first order, the error follows from the covariance of the rig's parameters. A delete-a-group
jackknife repeats the fit several times, each time with some pairs omitted. The jackknife also
includes the effects of errors that several corners have in common, of a warped board, and of
deviations from the lens model.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flexsheet.launch.calibration.bundle import (
    LEFT,
    PARAMETERS,
    RIGHT,
    STAND,
    RigFit,
    fit_rig,
    lens_arrays,
    pose_transform,
    to_floats,
)
from flexsheet.launch.calibration.corners import BoardPair, Progress, ignore_progress
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import rigid

GROUPS = 20
"""The maximum number of jackknife refits.

If there are more pairs, each refit leaves out several pairs.
"""


def sample_working_plane(rig: Floats, size: tuple[int, int], distance_m: float) -> Floats:
    """Return points (n, 3), in m, at the depth `distance_m` in the left camera's frame.

    The points are a grid of 5 x 5 over the central half of the left image's width and height.
    Points outside the right image are omitted, unless all points are outside.

    rig: parameters of the stereo rig (22,).
    size: width and height of the images, px.
    """
    matrix, distortion = lens_arrays(rig[LEFT])
    width, height = size
    fractions = np.linspace(0.25, 0.75, 5)
    pixels = np.stack(np.meshgrid(fractions * (width - 1), fractions * (height - 1)), axis=-1)
    slopes = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, distortion)[:, 0]
    points = distance_m * np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    right_px, _ = cv2.projectPoints(
        points, rig[STAND][:3], rig[STAND][3:], *lens_arrays(rig[RIGHT])
    )
    inside = ((right_px[:, 0] >= 0) & (right_px[:, 0] <= np.array([width, height]) - 1)).all(axis=1)
    return points[inside] if inside.any() else points


def compute_position_jacobian(rig: Floats, points: Floats) -> Floats:
    """Return the derivatives of triangulated points with respect to the rig's parameters.

    The pixels p = f(x, rig) are fixed, and the position x has the least squared image error.
    Therefore, A dx + B drig = 0 in the least-squares sense, with A = df/dx and B = df/drig. The
    derivative is dx/drig = -(A'A)^-1 A'B, with the shape (n, 3, 22) for n points.

    rig: parameters of the stereo rig (22,).
    points: triangulated points (n, 3), m.
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
    return to_floats(-np.linalg.solve(across @ by_point, across @ by_rig))


def compute_position_std(slopes: Floats, covariance: Floats) -> tuple[float, float]:
    """Return the standard deviations (depth, lateral), in m, of triangulated points.

    Each value is a root mean square over n points. The lateral value combines x and y.

    slopes: derivatives (n, 3, 22) of the positions with respect to the rig's parameters.
    covariance: covariance matrix (22, 22) of the rig's parameters.
    """
    variances = np.einsum("nip,pq,niq->ni", slopes, covariance, slopes).mean(axis=0)
    return float(np.sqrt(variances[2])), float(np.sqrt(variances[0] + variances[1]))


def compute_jackknife_covariance(
    fit: RigFit,
    pairs: Sequence[BoardPair],
    board: Floats,
    progress: Progress = ignore_progress,
) -> Floats:
    """Return the covariance (22, 22) of the rig's parameters from refits that leave out some pairs.

    This is the delete-a-group jackknife (Shao and Tu, The Jackknife and Bootstrap, 1995, section
    5.5). The covariance is (G - 1)/G times the scatter of the G refits about their mean.

    board: corners of the board (n, 3), m.
    """
    groups = min(GROUPS, len(pairs))
    rigs = []
    for group in range(groups):
        used = [i for i in range(len(pairs)) if i % groups != group]
        refit = fit_rig([pairs[i] for i in used], board, rig=fit.rig, poses=fit.poses[used])
        rigs.append(refit.rig)
        progress(group + 1, groups, "jackknife refits")
    scatter = np.array(rigs) - np.mean(rigs, axis=0)
    return np.asarray((groups - 1) / groups * scatter.T @ scatter)


def compute_right_from_left(rig: Floats) -> Floats:
    """Return the transform (4, 4) from the left to the right camera frame.

    rig: parameters of the stereo rig (22,).
    """
    return rigid.transform(pose_transform(rig[STAND])[:3, :3], rig[STAND][3:])
