"""Estimate the pose of an arm's base in the world from images of a board on its flange.

This is robot-world/hand-eye calibration. Each of several poses of the arm satisfies the equation

world_from_base base_from_flange(joints) flange_from_board = world_from_left left_from_board

where the transforms world_from_base and flange_from_board are unknown. A closed form gives initial
values (Shah, Solving the robot-world/hand-eye calibration problem using the Kronecker product, J.
Mechanisms Robotics 5(3), 2013). Then all unknowns are fitted to all corners of all images.

The real flange deviates from the forward kinematics by some tenths of a millimetre. In a pair of
images, all corners are affected by the same deviation. Therefore, the model contains a small random
error of each flange pose. The standard deviations of this mixed model are estimated by restricted
maximum likelihood (REML; Patterson and Thompson, Biometrika 58(3), 1971). If all corners were
treated as independent, the uncertainty would be underestimated several times.

In this module, a pose correction (6,) is a rotation vector (rad) followed by a translation (m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import RV_1A, ClosedFormArm, JointChain
from flexsheet.nodes.arm_bridge.geometry import make_kinematics
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.camera import project
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_vector,
    skew,
    transform,
    vector_from_rotation,
)

MIN_POSES = 6
"""The minimum number of poses for a calibration. From 15 to 20 poses are recommended."""

MIN_ROTATION_RAD = float(np.radians(5.0))
"""The minimum rms rotation (rad) of the flange about each of two axes.

If the rotations are smaller, the poses do not determine all unknowns.
"""

RANDOM_STARTS = 60
SUBSET_POSES = 5
"""The number of poses in each random subset from which initial values are computed.

Some subsets then contain no wrong poses, even if a few poses are wrong.
"""

LENGTH_M = 0.3
"""The translation (m) that has the same weight as a rotation of 1 rad in the error of a pose."""

MAX_MEDIAN_RATIO = 6.0
"""A pose is excluded from the first fit if its error exceeds this multiple of the median error."""

MAX_CHI_SQUARE, MEDIAN_CHI_SQUARE = 60.0, 5.348
"""The limit of the outlier test, and the median of chi-square with six degrees of freedom.

A pose is an outlier if its scaled squared deviation exceeds the limit. The scale makes the median
of all poses equal to the median of chi-square. In 75 simulated sets of 15 poses without outliers,
the largest scaled value was 43. The limit is higher, because the error of an arm varies over its
workspace.
"""

ROUNDING_PX, ROUNDING_RAD, ROUNDING_M = 1e-4, 1e-8, 1e-8
MIN_SCALE = 0.01
"""The minimum scale of squared deviations in the outlier test.

The scale is the median squared deviation divided by the median of chi-square. The minimum has an
effect only if all poses agree up to rounding errors.
"""

MAX_READMISSIONS = 5

MAX_PLAUSIBLE_ARM_M, MAX_PLAUSIBLE_ARM_RAD = 0.01, 0.05
"""The maximum plausible standard deviations of the flange's position (m) and rotation (rad).

Larger values indicate that joint angles are assigned to the wrong joints.
"""

MAX_OUTLIER_RATIO = 1.0 / 3.0
"""The maximum fraction of outliers among the poses.

A larger fraction indicates another mistake, such as a wrong board.
"""

MIN_ARM_RAD, MIN_ARM_M = 1e-6, 1e-6
"""The minimum estimated standard deviations of the flange's rotation (rad) and position (m)."""

MAX_ARM_RAD, MAX_ARM_M = 0.1, 0.1

ADVICE = (
    "check that the joint angles are measured at the exposure, that the board is fixed to the "
    "flange, and that stereo calibration and board are correct"
)

INITIAL_SIMPLEX = np.array([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]])
"""The three corners of the initial simplex of the optimization, relative to the initial values.

The variables are the logarithms of the standard deviations of the flange's rotation and position.
"""

MAX_ITERATIONS = 30
CONVERGED_STEP = 1e-10
"""The fit has converged if each unknown (rad or m) changes by less than this value in a step."""

INITIAL_STEP = 1e-6
"""The fit of a board pose has converged if each unknown (rad or m) changes by less than this value.

The result is an initial value for the fit of all unknowns.
"""


class HandEyeError(FlexsheetError, ValueError):
    """Raised if the measured poses do not determine the pose of the arm's base."""

    remedy = "Measure more poses, with the board rotated about at least two axes."


@dataclass(frozen=True, slots=True)
class CameraLens:
    """The intrinsics of a camera: matrix (3, 3), px, and Brown's distortion coefficients (5,)."""

    matrix: Floats
    distortion: Floats


@dataclass(frozen=True, slots=True)
class LensRig:
    """The intrinsics and extrinsics of the stereo camera.

    right_from_left: transform (4, 4) from the left to the right camera's frame.
    world_from_left: transform (4, 4) from the left camera's frame to the world.
    """

    left: CameraLens
    right: CameraLens
    right_from_left: Floats
    world_from_left: Floats


@dataclass(frozen=True, slots=True)
class CornerView:
    """The k board corners that were detected in one image.

    points_board: positions (k, 3), in m, in the board's frame.
    pixels: positions (k, 2) in the image, px.
    """

    points_board: Floats
    pixels: Floats


@dataclass(frozen=True, slots=True)
class BoardDetection:
    """A pose of the arm, with the corners of the board in both images.

    joints_rad: joint angles (6,).
    """

    name: str
    joints_rad: Floats
    left: CornerView
    right: CornerView


@dataclass(frozen=True, slots=True)
class PoseResidual:
    """The residual of one pose of the arm.

    shift_m, rotation_rad: difference between two flange poses, one from the images and one from the
        joint angles.
    rms_px: rms distance between the detected corners and the corners that the joint angles predict.
    reason: reason why the pose was excluded; empty if it was used.
    """

    name: str
    shift_m: float
    rotation_rad: float
    rms_px: float
    reason: str


@dataclass(frozen=True, slots=True)
class BaseFit:
    """The estimated pose of the arm's base, with its uncertainty and residuals.

    covariance: covariance (6, 6) of the correction from the estimated to the true base pose. The
        correction is a rotation (rad) about the base's origin in world axes, then a translation
        (m). If `jackknife_ratio` is above 1, the covariance is multiplied by this ratio squared.
    corner_sigma_px: standard deviation of the error of one pixel coordinate of a corner.
    arm_sigma_rad, arm_sigma_m: standard deviations of one component of the flange's pose error.
    jackknife_ratio: ratio of the jackknife's standard deviation to the standard deviation of the
        fit. It is an rms over the six components of the correction.
    leave_one_out: changes (n, 6) of the base pose if each of the n poses in turn is excluded from
        the fit.
    """

    world_from_base: Floats
    flange_from_board: Floats
    covariance: Floats
    corner_sigma_px: float
    arm_sigma_rad: float
    arm_sigma_m: float
    jackknife_ratio: float
    leave_one_out: Floats
    residuals: tuple[PoseResidual, ...]

    def compute_std(self, world_m: Floats) -> tuple[float, float]:
        """Return the standard deviations of the position (m) and rotation (rad) of a flange pose.

        Only the uncertainty of the fitted base pose is considered. Each value combines all three
        axes.

        world_m: position (3,) of the flange in the world.
        """
        lever = np.hstack([-skew(world_m - self.world_from_base[:3, 3]), np.eye(3)])
        shift = float(np.sqrt(np.trace(lever @ self.covariance @ lever.T)))
        return shift, float(np.sqrt(np.trace(self.covariance[:3, :3])))


@dataclass(frozen=True, slots=True)
class _Unknowns:
    """The current estimates (4, 4) of the transforms world_from_base and flange_from_board."""

    world_from_base: Floats
    flange_from_board: Floats

    def apply_step(self, step: Floats) -> _Unknowns:
        """Correct both poses, each by a rotation about its own origin and a translation.

        step: correction (6,) of the base pose, then correction (6,) of the board pose.
        """
        return _Unknowns(
            apply_motion(self.world_from_base, step[:6]),
            apply_motion(self.flange_from_board, step[6:]),
        )


@dataclass(frozen=True, slots=True)
class _LinearizedPose:
    """The measurements of the board corners in one arm pose, linearized at the current estimates.

    measured: correction (6,) of the flange pose that minimises the residuals of the corners, in the
        flange's frame. It consists of a rotation (rad) and a translation (m).
    spread: covariance (6, 6) of `measured` if the corner noise is 1 px.
    by_unknowns: derivatives (6, 12) of `measured` with respect to corrections of the base pose and
        the board pose.
    inner_px2: sum of the squared residuals that remain after the correction.
    count: number of corner coordinates.
    rms_px: rms residual of the corners before the correction.
    """

    measured: Floats
    spread: Floats
    by_unknowns: Floats
    inner_px2: float
    count: int
    rms_px: float


def calibrate_base(
    detections: Sequence[BoardDetection],
    rig: LensRig,
    arm: ClosedFormArm | JointChain = RV_1A,
) -> BaseFit:
    """Estimate the pose of the base of an arm in the world.

    The stereo camera is assumed to be exact. The same camera measures the base and the fingertip,
    so errors of the camera shift both equally.

    detections: at least MIN_POSES poses of the arm.
    rig: stereo camera with its pose in the world.
    arm: kinematic model of the arm.

    Raises HandEyeError if the poses do not determine the pose of the base.
    """
    _check_count(detections)
    forward = make_kinematics(arm).forward
    flanges = [forward(one.joints_rad) for one in detections]
    _check_rotations(flanges)
    boards = [_fit_board_pose(one, rig) for one in detections]
    unknowns = _find_initial(flanges, boards, rig)
    used = _find_rough_inliers(_compute_discrepancies(unknowns, flanges, boards, rig))
    for attempt in range(2 * MAX_READMISSIONS):
        _check_outliers(detections, used)
        kept = np.flatnonzero(used).tolist()
        _check_rotations([flanges[i] for i in kept])
        unknowns, model = _fit_unknowns(
            unknowns, [detections[i] for i in kept], [flanges[i] for i in kept], rig
        )
        _check_plausible(model)
        inliers = _find_inliers(_linearize(unknowns, detections, flanges, rig), model)
        if (inliers == used).all():
            break
        # Readmit excluded poses only in the first iterations, so that the loop ends.
        used = inliers if attempt < MAX_READMISSIONS else inliers & used
    return _make_result(detections, flanges, rig, unknowns=unknowns, model=model, used=used)


def _check_count(detections: Sequence[BoardDetection]) -> None:
    if len(detections) < MIN_POSES:
        raise HandEyeError(
            f"there are {len(detections)} arm poses, but at least {MIN_POSES} are required; record "
            "15 to 20 poses"
        )
    for one in detections:
        if not np.isfinite(one.joints_rad).all() or one.joints_rad.shape != (6,):
            raise HandEyeError(
                f"{one.name}: expected six finite joint angles; correct or remove the pose"
            )


def _check_outliers(detections: Sequence[BoardDetection], used: Bools) -> None:
    outliers = int((~used).sum())
    if outliers > MAX_OUTLIER_RATIO * len(used):
        names = ", ".join(one.name for one, good in zip(detections, used, strict=True) if not good)
        raise HandEyeError(
            f"{outliers} of {len(used)} poses contradict the others ({names}): {ADVICE}"
        )


def _check_plausible(model: _NoiseModel) -> None:
    if model.arm_m > MAX_PLAUSIBLE_ARM_M or model.arm_rad > MAX_PLAUSIBLE_ARM_RAD:
        raise HandEyeError(
            f"the poses contradict one another (estimated arm error "
            f"{1e3 * model.arm_m:.1f} mm, {np.degrees(model.arm_rad):.1f} degrees): {ADVICE}"
        )


def _check_rotations(flanges: Sequence[Floats]) -> None:
    """Raise HandEyeError if the flange does not rotate about at least two axes.

    Rotations about only one axis do not determine the translation along this axis.

    flanges: poses base_from_flange (4, 4).
    """
    mean = _mean_rotation([flange[:3, :3] for flange in flanges])
    rotations = np.array([vector_from_rotation(mean.T @ flange[:3, :3]) for flange in flanges])
    values, axes = np.linalg.eigh(rotations.T @ rotations / len(rotations))
    spread = np.sqrt(np.maximum(values, 0.0))
    if spread[2] < MIN_ROTATION_RAD:
        raise HandEyeError(
            f"the flange rotates by only {np.degrees(spread[2]):.1f} degrees rms between the "
            f"poses, but at least {np.degrees(MIN_ROTATION_RAD):.0f} about two axes are required; "
            "rotate it by 20 to 40 degrees in both directions"
        )
    if spread[1] < MIN_ROTATION_RAD:
        x, y, z = axes[:, 2]
        raise HandEyeError(
            f"the flange rotates about one axis only, ({x:.2f}, {y:.2f}, {z:.2f}) in its own "
            f"frame; it rotates by {np.degrees(spread[1]):.1f} degrees rms about other axes, but "
            f"at least {np.degrees(MIN_ROTATION_RAD):.0f} are required; rotate it about another "
            "axis as well"
        )


def _mean_rotation(rotations: Sequence[Floats]) -> Floats:
    """Return the rotation matrix (3, 3) that is nearest to all given rotations in least squares."""
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt)


def _fit_board_pose(detection: BoardDetection, rig: LensRig) -> Floats:
    """Fit the board's pose left_from_board (4, 4) to the corners of both images.

    A single image of a flat board has two similar pose solutions. The second image decides between
    them.
    """
    left = detection.left
    count, rotations, shifts, _ = cv2.solvePnPGeneric(
        left.points_board, left.pixels, rig.left.matrix, rig.left.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )  # fmt: skip
    best, min_cost = None, np.inf
    for index in range(count):
        pose = transform(
            rotation_from_vector(np.asarray(rotations[index], np.float64).ravel()),
            np.asarray(shifts[index], np.float64).ravel(),
        )
        for _ in range(MAX_ITERATIONS):
            residuals, slopes = _linearize_pixels(detection, rig, pose, np.eye(4))
            step = np.linalg.lstsq(slopes, residuals, rcond=None)[0]
            pose = pose @ transform(rotation_from_vector(step[:3]), step[3:])
            if np.abs(step).max() < INITIAL_STEP:
                break
        cost = float(residuals @ residuals)
        if np.isfinite(cost) and cost < min_cost:
            best, min_cost = pose, cost
    if best is None:
        raise HandEyeError(f"{detection.name}: no board pose fits the corners; remove this pose")
    return np.asarray(best)


def _linearize_pixels(
    detection: BoardDetection, rig: LensRig, left_from_flange: Floats, flange_from_board: Floats
) -> tuple[Floats, Floats]:
    """Compute the residuals of the corners, and the derivatives of their projections.

    Return residuals (m,), in px, of the m pixel coordinates of all corners. Also return the
    derivatives (m, 6) with respect to a rotation (rad) and a translation (m) of the flange.
    """
    residuals, slopes = [], []
    for view, lens, eye_from_left in (
        (detection.left, rig.left, np.eye(4)),
        (detection.right, rig.right, rig.right_from_left),
    ):
        on_flange = apply(flange_from_board, view.points_board)
        eye_from_flange = eye_from_left @ left_from_flange
        in_eye = apply(eye_from_flange, on_flange)
        residuals.append((view.pixels - project(in_eye, lens.matrix, lens.distortion)).ravel())
        rotation = eye_from_flange[:3, :3]
        by_point = np.empty((len(in_eye), 2, 3))
        for axis in range(3):
            # With a step of half a micrometre, the derivatives are accurate to ten digits.
            nudge = np.zeros(3)
            nudge[axis] = 5e-7
            ahead, behind = (
                project(in_eye + sign * nudge, lens.matrix, lens.distortion) for sign in (1.0, -1.0)
            )
            by_point[:, :, axis] = (ahead - behind) / 1e-6
        x, y, z = on_flange.T
        motion = np.zeros((len(on_flange), 3, 6))
        motion[:, 0, 1], motion[:, 0, 2], motion[:, 1, 2] = z, -y, x
        motion[:, 1, 0], motion[:, 2, 0], motion[:, 2, 1] = -z, y, -x
        motion[:, :, 3:] = np.eye(3)
        slopes.append((by_point @ rotation @ motion).reshape(-1, 6))
    return np.concatenate(residuals), np.concatenate(slopes)


def _find_initial(flanges: Sequence[Floats], boards: Sequence[Floats], rig: LensRig) -> _Unknowns:
    """Return initial values of the unknown transforms world_from_base and flange_from_board.

    The closed-form solution is computed for all poses and for random subsets. The solution that
    fits all poses best is returned.

    flanges: poses base_from_flange (4, 4).
    boards: poses left_from_board (4, 4).
    """
    random = np.random.default_rng(0)
    every = np.arange(len(flanges))
    subsets = [
        every,
        *(random.choice(every, SUBSET_POSES, replace=False) for _ in range(RANDOM_STARTS)),
    ]
    best, min_score = None, np.inf
    for chosen in subsets:
        found = _solve_closed_form([flanges[i] for i in chosen], [boards[i] for i in chosen], rig)
        if found is None:
            continue
        error = _compute_discrepancies(found, flanges, boards, rig)
        score = float(
            np.median(
                np.linalg.norm(error[:, 3:], axis=1)
                + LENGTH_M * np.linalg.norm(error[:, :3], axis=1)
            )
        )
        if score < min_score:
            best, min_score = found, score
    if best is None:
        raise HandEyeError(
            "no initial solution was found for these poses; rotate the flange by larger angles, "
            "about at least two non-parallel axes"
        )
    return best


def _solve_closed_form(
    flanges: Sequence[Floats], boards: Sequence[Floats], rig: LensRig
) -> _Unknowns | None:
    """Return Shah's closed-form solution of B F X = C, or None if the poses have no solution.

    Here, B is world_from_base, F is base_from_flange, X is flange_from_board and C is
    world_from_board. The rotations of each of the n poses satisfy C Y = B F, where Y is the
    transpose of X. Therefore, the matrix sum(kron(F, C)) maps the stacked columns of Y to n times
    the stacked columns of B. Both vectors of stacked columns are first singular vectors of this
    matrix, apart from scale. The translations follow by linear least squares.
    """
    worlds = [rig.world_from_left @ board for board in boards]
    stacked = np.sum(
        [np.kron(f[:3, :3], c[:3, :3]) for f, c in zip(flanges, worlds, strict=True)], axis=0
    )
    u, values, vt = np.linalg.svd(stacked)
    if values[0] - values[1] < 1e-9 * values[0]:
        return None
    base = _unstack_rotation(u[:, 0])
    board = _unstack_rotation(vt[0]).T
    # The translations satisfy R_B (R_F t_X + t_F) + t_B = t_C.
    rows = np.vstack([np.hstack([base @ f[:3, :3], np.eye(3)]) for f in flanges])
    sides = np.concatenate(
        [c[:3, 3] - base @ f[:3, 3] for f, c in zip(flanges, worlds, strict=True)]
    )
    shifts, _, rank, _ = np.linalg.lstsq(rows, sides, rcond=1e-9)
    if rank < 6:
        return None
    return _Unknowns(transform(base, shifts[3:]), transform(board, shifts[:3]))


def _unstack_rotation(stacked: Floats) -> Floats:
    """Return the rotation (3, 3) that is nearest to a matrix of unknown scale and sign.

    stacked: columns of the matrix as one vector (9,).
    """
    matrix = stacked.reshape(3, 3).T
    return _mean_rotation([matrix if np.linalg.det(matrix) > 0.0 else -matrix])


def _compute_discrepancies(
    unknowns: _Unknowns, flanges: Sequence[Floats], boards: Sequence[Floats], rig: LensRig
) -> Floats:
    """Compare the flange poses from the images with the flange poses from the joint angles.

    Return a pose difference (6,) for each of n arm poses, as an array (n, 6). Each difference is a
    rotation vector (rad) and a translation (m) in the flange's frame.
    """
    found = []
    for flange, board in zip(flanges, boards, strict=True):
        measured = rig.world_from_left @ board @ inverse(unknowns.flange_from_board)
        motion = inverse(unknowns.world_from_base @ flange) @ measured
        found.append(np.concatenate([vector_from_rotation(motion[:3, :3]), motion[:3, 3]]))
    return np.array(found)


def _find_rough_inliers(discrepancies: Floats) -> Bools:
    """Return a mask (n,) of the poses that are used in the first fit.

    A pose is excluded if its error exceeds a multiple of the median error.

    discrepancies: differences (n, 6) between flange poses from joint angles and from images.
    """
    good = np.ones(len(discrepancies), dtype=bool)
    for part, min_error in ((slice(0, 3), MIN_ARM_RAD), (slice(3, 6), MIN_ARM_M)):
        error = np.linalg.norm(discrepancies[:, part], axis=1)
        good &= error <= MAX_MEDIAN_RATIO * max(float(np.median(error)), min_error)
    return good


@dataclass(frozen=True, slots=True)
class _NoiseModel:
    """The standard deviations of errors of corner coordinates (px) and flange poses (rad and m)."""

    corner_px: float
    arm_rad: float
    arm_m: float

    def compute_weights(self, poses: Sequence[_LinearizedPose]) -> Floats:
        """Return the weight matrices (n, 6, 6) of n measured flange poses for a least-squares fit.

        Each weight is the inverse of a covariance. The covariance results from the noise of the
        detected corners and the errors of the arm.
        """
        arm = np.diag([self.arm_rad**2] * 3 + [self.arm_m**2] * 3)
        spreads = np.array([one.spread for one in poses])
        return np.asarray(np.linalg.inv(self.corner_px**2 * spreads + arm))


def _find_inliers(poses: Sequence[_LinearizedPose], model: _NoiseModel) -> Bools:
    """Return a mask (n,) of the poses that are not outliers.

    An outlier deviates too much from the fit in a chi-square test. The squared deviations are first
    divided by their median, to be robust against outliers. Deviations that are as small as rounding
    errors are accepted.
    """
    measured = np.array([one.measured for one in poses])
    bounded = _NoiseModel(
        max(model.corner_px, ROUNDING_PX),
        max(model.arm_rad, ROUNDING_RAD),
        max(model.arm_m, ROUNDING_M),
    )
    squares = np.einsum("nk,nkl,nl->n", measured, bounded.compute_weights(poses), measured)
    scale = max(float(np.median(squares)) / MEDIAN_CHI_SQUARE, MIN_SCALE)
    return np.asarray(squares <= MAX_CHI_SQUARE * scale)


def _fit_unknowns(
    unknowns: _Unknowns,
    detections: Sequence[BoardDetection],
    flanges: Sequence[Floats],
    rig: LensRig,
) -> tuple[_Unknowns, _NoiseModel]:
    """Fit the unknown transforms and the standard deviations of the errors by Gauss-Newton steps.

    unknowns: initial transforms.
    flanges: poses base_from_flange (4, 4).

    Raises HandEyeError if the poses do not determine the base.
    """
    model: _NoiseModel | None = None
    for _ in range(MAX_ITERATIONS):
        poses = _linearize(unknowns, detections, flanges, rig)
        model = _estimate_deviations(poses, model)
        matrix, side = _normal_equations(poses, model)
        try:
            step = np.asarray(np.linalg.solve(matrix, side), np.float64)
        except np.linalg.LinAlgError as error:
            raise HandEyeError(
                "the poses do not determine the base; rotate the flange by larger angles, about "
                "at least two non-parallel axes"
            ) from error
        unknowns = unknowns.apply_step(step)
        if np.abs(step).max() < CONVERGED_STEP:
            break
    assert model is not None
    return unknowns, model


def _linearize(
    unknowns: _Unknowns,
    detections: Sequence[BoardDetection],
    flanges: Sequence[Floats],
    rig: LensRig,
) -> list[_LinearizedPose]:
    board = unknowns.flange_from_board
    by_board = np.block([[np.eye(3), np.zeros((3, 3))], [skew(board[:3, 3]), np.eye(3)]])
    left_from_world = inverse(rig.world_from_left)
    found = []
    for detection, flange in zip(detections, flanges, strict=True):
        world_from_flange = unknowns.world_from_base @ flange
        residuals, slopes = _linearize_pixels(
            detection, rig, left_from_world @ world_from_flange, board
        )
        information = slopes.T @ slopes
        measured = np.asarray(np.linalg.solve(information, slopes.T @ residuals), np.float64)
        back = world_from_flange[:3, :3].T
        lever = world_from_flange[:3, 3] - unknowns.world_from_base[:3, 3]
        by_base = np.block([[back, np.zeros((3, 3))], [-back @ skew(lever), back]])
        found.append(
            _LinearizedPose(
                measured=measured,
                spread=np.asarray(np.linalg.inv(information), np.float64),
                by_unknowns=np.hstack([by_base, by_board]),
                inner_px2=float(residuals @ residuals - measured @ information @ measured),
                count=len(residuals),
                rms_px=float(np.sqrt(2.0 * np.mean(residuals * residuals))),
            )
        )
    return found


def _normal_equations(
    poses: Sequence[_LinearizedPose], model: _NoiseModel
) -> tuple[Floats, Floats]:
    """Return the matrix (12, 12) and vector (12,) of the equations for a Gauss-Newton step."""
    weights = model.compute_weights(poses)
    slopes = np.array([one.by_unknowns for one in poses])
    measured = np.array([one.measured for one in poses])
    matrix = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes)
    side = np.einsum("nki,nkl,nl->i", slopes, weights, measured)
    return matrix, side


def _estimate_deviations(
    poses: Sequence[_LinearizedPose], before: _NoiseModel | None
) -> _NoiseModel:
    """Estimate the standard deviations of the errors of corners and flange poses.

    The corner noise is estimated from the residuals that remain if each pose is fitted alone. The
    errors of flange poses are estimated by restricted maximum likelihood.

    before: result of the previous iteration; None in the first iteration.
    """
    freedom = sum(one.count - 6 for one in poses)
    corner = float(np.sqrt(max(sum(one.inner_px2 for one in poses), 0.0) / max(freedom, 1)))
    corner = max(corner, 1e-6)
    measured = np.array([one.measured for one in poses])
    slopes = np.array([one.by_unknowns for one in poses])

    def neg_log_likelihood(logs: Floats) -> float:
        """Return -2 times the logarithm of the restricted likelihood, up to a constant.

        logs: logarithms (2,) of the standard deviations of the flange's rotation and position.
        """
        logs = np.clip(
            logs,
            [np.log(MIN_ARM_RAD), np.log(MIN_ARM_M)],
            [np.log(MAX_ARM_RAD), np.log(MAX_ARM_M)],
        )
        weights = _NoiseModel(corner, *np.exp(logs).tolist()).compute_weights(poses)
        matrix = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes)
        side = np.einsum("nki,nkl,nl->i", slopes, weights, measured)
        residual = measured - slopes @ np.linalg.lstsq(matrix, side, rcond=None)[0]
        squares = float(np.einsum("nk,nkl,nl->", residual, weights, residual))
        spread = float(np.linalg.slogdet(matrix)[1] - np.linalg.slogdet(weights)[1].sum())
        return squares + spread

    start = np.log([1e-4, 1e-4] if before is None else [before.arm_rad, before.arm_m])
    options = {"xatol": 1e-3, "fatol": 1e-3, "initial_simplex": start + INITIAL_SIMPLEX}
    best = minimize(neg_log_likelihood, start, method="Nelder-Mead", options=options).x
    arm_rad, arm_m = np.exp(best).tolist()
    return _NoiseModel(
        corner,
        min(max(arm_rad, MIN_ARM_RAD), MAX_ARM_RAD),
        min(max(arm_m, MIN_ARM_M), MAX_ARM_M),
    )


def apply_motion(pose: Floats, motion: Floats) -> Floats:
    """Rotate a pose (4, 4) about its own origin, and translate it.

    motion: rotation vector (rad) and translation (m), together (6,), in the axes of the parent
        frame.
    """
    rotation = rotation_from_vector(motion[:3])
    return transform(rotation @ pose[:3, :3], pose[:3, 3] + motion[3:])


def _make_result(
    detections: Sequence[BoardDetection],
    flanges: Sequence[Floats],
    rig: LensRig,
    *,
    unknowns: _Unknowns,
    model: _NoiseModel,
    used: Bools,
) -> BaseFit:
    every = _linearize(unknowns, detections, flanges, rig)
    poses = [one for one, good in zip(every, used, strict=True) if good]
    matrix, _ = _normal_equations(poses, model)
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    left_out = []
    for index in range(len(poses)):
        # At the optimum, the effect of excluding one pose is one step of the remaining normal
        # equations.
        without, side = _normal_equations(poses[:index] + poses[index + 1 :], model)
        left_out.append(np.linalg.solve(without, side)[:6])
    motions = np.array(left_out)
    count = len(motions)
    scatter = motions - motions.mean(axis=0)
    jackknife = (count - 1) / count * scatter.T @ scatter
    stated = covariance[:6, :6]
    ratio = float(np.sqrt(np.mean(np.diag(jackknife) / np.diag(stated))))
    return BaseFit(
        world_from_base=unknowns.world_from_base,
        flange_from_board=unknowns.flange_from_board,
        covariance=stated * max(1.0, ratio) ** 2,
        corner_sigma_px=model.corner_px,
        arm_sigma_rad=model.arm_rad,
        arm_sigma_m=model.arm_m,
        jackknife_ratio=ratio,
        leave_one_out=motions,
        residuals=tuple(
            PoseResidual(
                name=detection.name,
                shift_m=float(np.linalg.norm(one.measured[3:])),
                rotation_rad=float(np.linalg.norm(one.measured[:3])),
                rms_px=one.rms_px,
                reason="" if good else "inconsistent with the other poses",
            )
            for detection, one, good in zip(detections, every, used, strict=True)
        ),
    )
