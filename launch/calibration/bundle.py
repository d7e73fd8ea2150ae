"""Fit a stereo rig to all corners of all board poses by least squares, with its covariance.

Unknown are the rig (22 numbers, `PARAMETERS`) and the board's pose in each pair (6 numbers).  A
pair's corners depend on the rig and on that pose only.  The poses are therefore eliminated one by
one, and a system of 22 equations remains (Schur complement; Triggs et al., Bundle Adjustment: A
Modern Synthesis, 1999, section 6).  Lens model: pinhole with k1, k2, p1, p2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.corners import BoardPair, BoardView
from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.models import rigid

Floats = NDArray[np.float64]

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
PARAMETERS = (
    *(f"left.{name}" for name in LENS),
    *(f"right.{name}" for name in LENS),
    *(f"right_from_left.{name}" for name in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")),
)
"""The rig's numbers in order; rx, ry, rz: rotation vector."""

LEFT, RIGHT, STAND = slice(0, 8), slice(8, 16), slice(16, 22)

STEPS = 50
CONVERGED_COST_CHANGE = 1e-9
"""Relative change of the cost that ends the iteration."""


class NotDeterminedError(FlexsheetError, ValueError):
    """Raised when the pairs do not determine all of the rig's numbers."""

    code = "not-determined"
    remedy = "Add image pairs that differ in tilt and distance."


@dataclass(frozen=True, slots=True)
class RigFit:
    """Hold a fitted rig and its residuals.

    rig: (22,).
    poses: of the board, (pairs, 6), rotation vector and position in the left camera's frame.

    The other fields are each pair's residuals left and right (n, 2) px, detected minus projected,
    the standard deviation of one coordinate px, and the rig's covariance (22, 22).
    """

    rig: Floats
    poses: Floats
    residuals: tuple[tuple[Floats, Floats], ...]
    sigma_px: float
    covariance: Floats

    def pair_rms_px(self) -> Floats:
        """Root mean square distance (pairs, 2) px between detected and projected corners, left and
        right."""
        return np.array([[rms_distance(view) for view in views] for views in self.residuals])

    def rms_px(self) -> float:
        """Root mean square distance over all corners of both views."""
        return rms_distance(np.concatenate([view for views in self.residuals for view in views]))


def floats(array: object) -> Floats:
    """Convert OpenCV's result to an array in double precision."""
    return np.asarray(array, dtype=np.float64)


def rms_distance(shifts: Floats) -> float:
    """Return the root mean square length of shifts (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(shifts * shifts, axis=1))))


def lens_arrays(lens: Floats) -> tuple[Floats, Floats]:
    """Return the camera matrix (3, 3) and OpenCV's distortion (5,) of a lens's eight numbers."""
    fx, fy, cx, cy, k1, k2, p1, p2 = lens
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, np.array([k1, k2, p1, p2, 0.0])


def pose_transform(pose: Floats) -> Floats:
    """Return the transform (4, 4) of a rotation vector and a position (6,)."""
    return rigid.transform(rigid.rotation_from_vector(pose[:3]), pose[3:])


def pose_vector(transform: Floats) -> Floats:
    """Return rotation vector and position (6,) of a transform (4, 4)."""
    return np.concatenate([rigid.vector_from_rotation(transform[:3, :3]), transform[:3, 3]])


def _project(points: Floats, pose: Floats, lens: Floats) -> tuple[Floats, Floats, Floats]:
    """Return pixels (n, 2) of points, and their Jacobians (2n, 6) by the pose and (2n, 8) by the
    lens."""
    matrix, distortion = lens_arrays(lens)
    pixels, slope = cv2.projectPoints(points, pose[:3], pose[3:], matrix, distortion)
    slopes = floats(slope)
    return floats(pixels)[:, 0], slopes[:, :6], slopes[:, 6:14]


def _compose(pose: Floats, stand: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the pose (6,) in the right camera's frame, and its Jacobians (6, 6) by both poses."""
    rotation, position, *slopes = cv2.composeRT(pose[:3], pose[3:], stand[:3], stand[3:])
    rr1, rt1, rr2, rt2, tr1, tt1, tr2, tt2 = slopes
    by_pose = np.block([[rr1, rt1], [tr1, tt1]])
    by_stand = np.block([[rr2, rt2], [tr2, tt2]])
    return np.concatenate([rotation.ravel(), position.ravel()]), by_pose, by_stand


@dataclass(frozen=True, slots=True)
class Linearized:
    """Hold a pair at the present estimate: shifts (m,) px, Jacobians (m, 22) by rig, (m, 6) by
    pose."""

    shifts: Floats
    by_rig: Floats
    by_pose: Floats


def linearize(pair: BoardPair, board: Floats, rig: Floats, pose: Floats) -> Linearized:
    """Linearize a pair's corners at a rig (22,) and a pose (6,); board: its corners (n, 3) m."""
    left_points, right_points = board[pair.left.ids], board[pair.right.ids]
    left, left_by_pose, left_by_lens = _project(left_points, pose, rig[LEFT])
    in_right, by_pose, by_stand = _compose(pose, rig[STAND])
    right, right_by_pose, right_by_lens = _project(right_points, in_right, rig[RIGHT])
    split = 2 * len(left)
    by_rig = np.zeros((split + 2 * len(right), len(PARAMETERS)))
    by_rig[:split, LEFT] = left_by_lens
    by_rig[split:, RIGHT] = right_by_lens
    by_rig[split:, STAND] = right_by_pose @ by_stand
    return Linearized(
        shifts=np.concatenate(
            [(pair.left.pixels - left).ravel(), (pair.right.pixels - right).ravel()]
        ),
        by_rig=by_rig,
        by_pose=np.concatenate([left_by_pose, right_by_pose @ by_pose]),
    )


@dataclass(frozen=True, slots=True)
class _Reduced:
    """Hold the normal equations with the poses eliminated.

    matrix: (22, 22).
    side: (22,).

    For each pose it also holds the inverse of its block (6, 6), its gradient (6,) and its coupling
    (22, 6).
    """

    matrix: Floats
    side: Floats
    poses: list[tuple[Floats, Floats, Floats]]


def _eliminate_poses(pairs: Sequence[Linearized], damping: float) -> _Reduced:
    """Make the Levenberg-Marquardt equations: the diagonal is raised by the fraction `damping`."""
    matrix, side = np.zeros((22, 22)), np.zeros(22)
    poses = []
    for pair in pairs:
        own = pair.by_pose.T @ pair.by_pose
        inverse = floats(np.linalg.inv(own + damping * np.diag(np.diag(own))))
        coupling = pair.by_rig.T @ pair.by_pose
        slope = pair.by_pose.T @ pair.shifts
        whole = pair.by_rig.T @ pair.by_rig
        matrix += whole + damping * np.diag(np.diag(whole)) - coupling @ inverse @ coupling.T
        side += pair.by_rig.T @ pair.shifts - coupling @ inverse @ slope
        poses.append((inverse, slope, coupling))
    return _Reduced(matrix, side, poses)


def _scaled_inverse(matrix: Floats) -> Floats:
    """Invert a symmetric positive matrix whose rows have very different units.

    Raises NotDeterminedError for one that is not positive, or is nearly singular.
    """
    scale = np.sqrt(np.diag(matrix))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise NotDeterminedError("a number of the rig changes no corner")
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    if values[0] < 1e-12:
        weakest = PARAMETERS[int(np.argmax(np.abs(vectors[:, 0] / scale) * scale))]
        raise NotDeterminedError(f"{weakest} cannot be told from the others")
    inverse = (vectors / values) @ vectors.T
    return np.asarray(inverse / np.outer(scale, scale), dtype=np.float64)


def fit_rig(pairs: Sequence[BoardPair], board: Floats, *, rig: Floats, poses: Floats) -> RigFit:
    """Fit the rig and the poses to all corners, from a start; board: its corners (n, 3) m.

    Levenberg-Marquardt.  Raises NotDeterminedError where the pairs do not determine the rig.
    """
    rig, poses = rig.copy(), poses.copy()

    def at(rig: Floats, poses: Floats) -> list[Linearized]:
        return [linearize(one, board, rig, pose) for one, pose in zip(pairs, poses, strict=True)]

    present = at(rig, poses)
    cost = sum(float(pair.shifts @ pair.shifts) for pair in present)
    damping = 1e-4
    for _ in range(STEPS):
        reduced = _eliminate_poses(present, damping)
        step = _scaled_inverse(reduced.matrix) @ reduced.side
        moves = np.array([i @ (slope - c.T @ step) for i, slope, c in reduced.poses])
        tried = at(rig + step, poses + moves)
        tried_cost = sum(float(pair.shifts @ pair.shifts) for pair in tried)
        if not tried_cost < cost:
            if damping > 1e6 or tried_cost - cost < CONVERGED_COST_CHANGE * cost:
                break
            damping *= 10.0
            continue
        gained = cost - tried_cost
        rig, poses, present, cost = rig + step, poses + moves, tried, tried_cost
        damping = max(0.1 * damping, 1e-12)
        if gained < CONVERGED_COST_CHANGE * cost:
            break
    numbers = sum(len(pair.shifts) for pair in present)
    freedom = numbers - len(PARAMETERS) - poses.size
    if freedom < 1:
        raise NotDeterminedError(f"{numbers} coordinates for {numbers - freedom} unknowns")
    variance = cost / freedom
    return RigFit(
        rig=rig,
        poses=poses,
        residuals=tuple(_by_view(one, pair) for one, pair in zip(present, pairs, strict=True)),
        sigma_px=float(np.sqrt(variance)),
        covariance=variance * _scaled_inverse(_eliminate_poses(present, 0.0).matrix),
    )


def _by_view(present: Linearized, pair: BoardPair) -> tuple[Floats, Floats]:
    shifts = present.shifts.reshape(-1, 2)
    split = len(pair.left.ids)
    return shifts[:split], shifts[split:]


def board_pose(view: BoardView, board: Floats, lens: Floats) -> Floats:
    """Estimate the pose (6,) of the board in a camera's frame from one view."""
    points = board[view.ids]
    _, rotation, position = cv2.solvePnP(points, view.pixels, *lens_arrays(lens))
    return np.concatenate([rotation.ravel(), position.ravel()])
