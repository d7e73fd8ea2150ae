"""Fit a stereo camera and all board poses to the detected board corners by least squares.

The unknowns are the 22 parameters of the stereo rig (`PARAMETERS`) and, for each image pair, the 6
parameters of the board's pose. The corners in an image pair depend only on the rig and on the
board's pose in that pair. The board poses can therefore be eliminated, and a system of 22 equations
remains (Schur complement; Triggs et al., Bundle Adjustment: A Modern Synthesis, 1999, section 6).
The lens model is a pinhole with the distortion coefficients k1, k2, p1, p2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flexsheet.launch.calibration.corners import BoardPair, BoardView
from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import rigid

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
PARAMETERS = (
    *(f"left.{name}" for name in LENS),
    *(f"right.{name}" for name in LENS),
    *(f"right_from_left.{name}" for name in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")),
)
"""The names of the 22 parameters of a stereo rig, in the order of the parameter vector.

The parameters rx_rad, ry_rad and rz_rad are the components of a rotation vector.
"""

LEFT, RIGHT, STAND = slice(0, 8), slice(8, 16), slice(16, 22)

MAX_STEPS = 50
CONVERGED_COST_CHANGE = 1e-9
"""The iteration ends if the sum of squared residuals changes by less than this fraction."""


class NotDeterminedError(FlexsheetError, ValueError):
    """Raised if the image pairs do not determine all parameters of the stereo rig."""

    remedy = "Add image pairs that differ in tilt and distance."


@dataclass(frozen=True, slots=True)
class RigFit:
    """A fitted stereo rig and the residuals of the fit.

    rig: parameters (22,) of the stereo rig, in the order of `PARAMETERS`.
    poses: board poses (number of pairs, 6) in the left camera's frame. Each row is a rotation
        vector (rad) and a position (m).
    residuals: for the left and the right image of each pair, detected minus projected positions (n,
        2), in px, of the n detected corners.
    sigma_px: standard deviation of the error of one pixel coordinate of a corner.
    covariance: covariance matrix (22, 22) of the parameters.
    """

    rig: Floats
    poses: Floats
    residuals: tuple[tuple[Floats, Floats], ...]
    sigma_px: float
    covariance: Floats

    def pair_rms_px(self) -> Floats:
        """Return the rms residual (px) of the corners in each image.

        The result has one row per image pair, and one column each for the left and the right image.
        """
        return np.array([[rms_distance(view) for view in views] for views in self.residuals])

    def rms_px(self) -> float:
        """Return the rms distance (px) between detected and projected corners of all images."""
        return rms_distance(np.concatenate([view for views in self.residuals for view in views]))


def to_floats(array: object) -> Floats:
    """Convert an array of any type, such as an OpenCV result, to double precision."""
    return np.asarray(array, dtype=np.float64)


def rms_distance(shifts: Floats) -> float:
    """Return the root mean square length of two-dimensional vectors (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(shifts * shifts, axis=1))))


def lens_arrays(lens: Floats) -> tuple[Floats, Floats]:
    """Return the camera matrix (3, 3) and OpenCV's distortion coefficients (5,) of a camera.

    lens: intrinsics (8,): fx, fy, cx, cy (px), k1, k2, p1, p2.
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = lens
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, np.array([k1, k2, p1, p2, 0.0])


def pose_transform(pose: Floats) -> Floats:
    """Convert a pose (6,) to a transform (4, 4).

    The pose contains a rotation vector (rad) and a position (m).
    """
    return rigid.transform(rigid.rotation_from_vector(pose[:3]), pose[3:])


def pose_vector(transform: Floats) -> Floats:
    """Convert a transform (4, 4) to a pose (6,).

    The pose contains a rotation vector (rad) and a position (m).
    """
    return np.concatenate([rigid.vector_from_rotation(transform[:3, :3]), transform[:3, 3]])


def _project(points: Floats, pose: Floats, lens: Floats) -> tuple[Floats, Floats, Floats]:
    """Project n points (n, 3), in m, in the board's frame into an image.

    Return the pixel positions (n, 2), and their derivatives with respect to the board pose (2n, 6)
    and to the intrinsics (2n, 8).
    """
    matrix, distortion = lens_arrays(lens)
    pixels, slope = cv2.projectPoints(points, pose[:3], pose[3:], matrix, distortion)
    slopes = to_floats(slope)
    return to_floats(pixels)[:, 0], slopes[:, :6], slopes[:, 6:14]


def _compose(pose: Floats, stand: Floats) -> tuple[Floats, Floats, Floats]:
    """Transform a board pose (6,) from the left to the right camera's frame.

    Return the pose (6,) in the right camera's frame, and its derivatives (6, 6) with respect to
    `pose` and `stand`.

    stand: pose (6,) of the left camera in the right camera's frame.
    """
    rotation, position, *slopes = cv2.composeRT(pose[:3], pose[3:], stand[:3], stand[3:])
    rr1, rt1, rr2, rt2, tr1, tt1, tr2, tt2 = slopes
    by_pose = np.block([[rr1, rt1], [tr1, tt1]])
    by_stand = np.block([[rr2, rt2], [tr2, tt2]])
    return np.concatenate([rotation.ravel(), position.ravel()]), by_pose, by_stand


@dataclass(frozen=True, slots=True)
class Linearized:
    """The m residuals of one image pair, with their derivatives.

    Each corner in each image has two residuals, one along x and one along y.

    shifts: detected minus projected pixel coordinates (m,), px.
    by_rig: derivatives (m, 22) with respect to the parameters of the rig.
    by_pose: derivatives (m, 6) with respect to the board pose.
    """

    shifts: Floats
    by_rig: Floats
    by_pose: Floats


def linearize(pair: BoardPair, board: Floats, rig: Floats, pose: Floats) -> Linearized:
    """Compute the residuals of an image pair and their derivatives.

    board: corners of the board (n, 3), m.
    rig: parameters of the stereo rig (22,).
    pose: board pose (6,) in the left camera's frame.
    """
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
    """The normal equations of the rig after elimination of the board poses.

    matrix: coefficient matrix (22, 22).
    side: right-hand side (22,).
    poses: for each board pose, the inverse of its diagonal block (6, 6), its right-hand side (6,),
        and its coupling block (22, 6) with the rig.
    """

    matrix: Floats
    side: Floats
    poses: list[tuple[Floats, Floats, Floats]]


def _eliminate_poses(pairs: Sequence[Linearized], damping: float) -> _Reduced:
    """Return the Levenberg-Marquardt equations of the rig, with the board poses eliminated.

    damping: damping factor; the diagonal of the matrix is multiplied by 1 + `damping`.
    """
    matrix, side = np.zeros((22, 22)), np.zeros(22)
    poses = []
    for pair in pairs:
        own = pair.by_pose.T @ pair.by_pose
        inverse = to_floats(np.linalg.inv(own + damping * np.diag(np.diag(own))))
        coupling = pair.by_rig.T @ pair.by_pose
        slope = pair.by_pose.T @ pair.shifts
        whole = pair.by_rig.T @ pair.by_rig
        matrix += whole + damping * np.diag(np.diag(whole)) - coupling @ inverse @ coupling.T
        side += pair.by_rig.T @ pair.shifts - coupling @ inverse @ slope
        poses.append((inverse, slope, coupling))
    return _Reduced(matrix, side, poses)


def _scaled_inverse(matrix: Floats) -> Floats:
    """Invert a symmetric positive definite matrix whose rows have different units.

    Raises NotDeterminedError if the matrix is not positive definite or if it is nearly singular.
    """
    scale = np.sqrt(np.diag(matrix))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise NotDeterminedError(
            "a parameter of the stereo rig has no effect on the corners; add image pairs with a "
            "tilted board"
        )
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    if values[0] < 1e-12:
        weakest = PARAMETERS[int(np.argmax(np.abs(vectors[:, 0] / scale) * scale))]
        raise NotDeterminedError(
            f"the image pairs do not determine {weakest} separately from the other parameters; add "
            "pairs with other tilts and distances"
        )
    inverse = (vectors / values) @ vectors.T
    return np.asarray(inverse / np.outer(scale, scale), dtype=np.float64)


def fit_rig(pairs: Sequence[BoardPair], board: Floats, *, rig: Floats, poses: Floats) -> RigFit:
    """Fit a stereo rig and the board poses to all corners by the Levenberg-Marquardt method.

    board: corners of the board (n, 3), m.
    rig: initial parameters (22,).
    poses: initial board poses (number of pairs, 6) in the left camera's frame.

    Raises NotDeterminedError if the pairs do not determine the rig.
    """
    rig, poses = rig.copy(), poses.copy()

    def linearize_all(rig: Floats, poses: Floats) -> list[Linearized]:
        return [linearize(one, board, rig, pose) for one, pose in zip(pairs, poses, strict=True)]

    current = linearize_all(rig, poses)
    cost = sum(float(pair.shifts @ pair.shifts) for pair in current)
    damping = 1e-4
    for _ in range(MAX_STEPS):
        reduced = _eliminate_poses(current, damping)
        step = _scaled_inverse(reduced.matrix) @ reduced.side
        moves = np.array([i @ (slope - c.T @ step) for i, slope, c in reduced.poses])
        trial = linearize_all(rig + step, poses + moves)
        trial_cost = sum(float(pair.shifts @ pair.shifts) for pair in trial)
        if not trial_cost < cost:
            if damping > 1e6 or trial_cost - cost < CONVERGED_COST_CHANGE * cost:
                break
            damping *= 10.0
            continue
        gained = cost - trial_cost
        rig, poses, current, cost = rig + step, poses + moves, trial, trial_cost
        damping = max(0.1 * damping, 1e-12)
        if gained < CONVERGED_COST_CHANGE * cost:
            break
    numbers = sum(len(pair.shifts) for pair in current)
    freedom = numbers - len(PARAMETERS) - poses.size
    if freedom < 1:
        raise NotDeterminedError(
            f"{numbers} corner coordinates do not determine {numbers - freedom} unknowns; add "
            "image pairs"
        )
    variance = cost / freedom
    return RigFit(
        rig=rig,
        poses=poses,
        residuals=tuple(_split_views(one, pair) for one, pair in zip(current, pairs, strict=True)),
        sigma_px=float(np.sqrt(variance)),
        covariance=variance * _scaled_inverse(_eliminate_poses(current, 0.0).matrix),
    )


def _split_views(linearized: Linearized, pair: BoardPair) -> tuple[Floats, Floats]:
    shifts = linearized.shifts.reshape(-1, 2)
    split = len(pair.left.ids)
    return shifts[:split], shifts[split:]


def board_pose(view: BoardView, board: Floats, lens: Floats) -> Floats:
    """Estimate the board's pose in a camera's frame from one image.

    Return a rotation vector (rad) and a position (m), together (6,).

    board: corners of the board (n, 3), m.
    lens: intrinsics (8,): fx, fy, cx, cy (px), k1, k2, p1, p2.
    """
    points = board[view.ids]
    _, rotation, position = cv2.solvePnP(points, view.pixels, *lens_arrays(lens))
    return np.concatenate([rotation.ravel(), position.ravel()])
