"""Compute the kinematics of any arm with six rotary joints numerically.

Joint angles are arrays (6,) or (n, 6), in radians. Poses are 4x4 matrices `base_from_flange`, in
metres. The inverse kinematics use a damped Newton method, which starts at known joint angles. A
distant pose is solved through intermediate poses, so the arm does not switch to another solution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees, pi
from typing import NamedTuple

import numpy as np
import scipy

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import JointChain
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import pose_matrix

MAX_STEPS = 12
"""The maximum number of Newton steps from known joint angles. A control cycle needs 2 or 3 steps.
"""

WAYPOINTS, STEPS_PER_WAYPOINT = 8, 5
"""The number of intermediate poses between a known and a distant pose, and the number of Newton
steps for each intermediate pose."""

MAX_STEP_RAD = 0.3
"""The maximum change of a joint in one Newton step."""

TOLERANCE = 1e-8
"""The pose error (m and rad) at which the Newton iteration ends."""

MAX_ERROR = 1e-6
"""The maximum pose error (m and rad) of an accepted solution."""

DAMPING = 1e-9
"""The damping term of the normal equations, which limits the steps at a singularity."""

SINGULAR_LENGTH_M = 0.25
"""The length by which linear velocities in the Jacobian are divided, so that all its rows have the
same unit."""

MIN_SINGULAR_VALUE, NEAR_SINGULAR_VALUE = 0.01, 0.05
"""The minimum values of the Jacobian's smallest singular value. The first value applies to single
poses, and the second value to paths. At the second value, a flange speed of 0.25 m/s requires joint
speeds of at most 20 rad/s."""

SEEDS = 256
"""The number of random sets of joint angles from which `solve_all` searches for solutions."""

SEED_STEPS = 40

MIN_DIFFERENCE = 0.02
"""The value of |sin(d / 2)| above which two solutions are distinct. The angle d is the difference
between the solutions for the joint at which |sin(d / 2)| is largest."""


class UnreachableError(FlexsheetError, ValueError):
    """The error raised if no permitted joint angles reach a flange pose.

    limit: "reach", "singularity", or the joint ("J1" to "J6") that is out of range in the nearest
        solution.
    """

    remedy = "Run `flexsheet doctor --scene SCENE`, which lists the limits."

    def __init__(self, text: str, limit: str) -> None:
        super().__init__(text)
        self.limit = limit


class SeedBranch(NamedTuple):
    """A branch of the inverse kinematics, represented by joint angles on this branch.

    A branch is one of the discrete solutions for a flange pose. This class is used for arms without
    closed-form kinematics.
    """

    seed_rad: tuple[float, ...]


class SerialChain:
    """The forward kinematics and the Jacobian of a chain of six rotary joints."""

    def __init__(self, model: JointChain) -> None:
        # The transform of a joint at angle q is constant + sin(q) sine + cos(q) cosine.
        constant, sine, cosine = np.zeros((3, 6, 4, 4))
        self._axes = np.array(model.axes)
        for joint, (origin, axis) in enumerate(zip(model.origins, self._axes, strict=True)):
            x, y, z = axis.tolist()
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            placed = pose_matrix(origin)
            along = np.outer(axis, axis)
            constant[joint] = placed
            constant[joint, :3, :3] = placed[:3, :3] @ along
            sine[joint, :3, :3] = placed[:3, :3] @ cross
            cosine[joint, :3, :3] = placed[:3, :3] @ (np.eye(3) - along)
        self._constant, self._sine, self._cosine = constant, sine, cosine
        self._flange = pose_matrix(model.flange)
        self.offsets_m = np.array([np.linalg.norm(one.position_m) for one in model.origins])
        self.flange_m = float(np.linalg.norm(model.flange.position_m))

    def _frames(self, joints_rad: Floats) -> list[Floats]:
        """Return the poses (..., 4, 4) of all joints and of the flange in the base frame.

        joints_rad: joint angles (..., 6).
        """
        angles = joints_rad[..., None, None]
        links = self._constant + np.sin(angles) * self._sine + np.cos(angles) * self._cosine
        frames = [links[..., 0, :, :]]
        for joint in range(1, 6):
            frames.append(frames[-1] @ links[..., joint, :, :])
        return [*frames, frames[-1] @ self._flange]

    def forward(self, joints_rad: Floats) -> Floats:
        """Return the flange poses base_from_flange (..., 4, 4) at joint angles (..., 6) rad."""
        return self._frames(joints_rad)[-1]

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return the Jacobian (..., 6, 6) in the base frame at joint angles (..., 6), rad.

        The Jacobian maps joint speeds to the linear and then the angular velocity of the flange.
        """
        return self.pose_and_jacobian(joints_rad)[1]

    def pose_and_jacobian(self, joints_rad: Floats) -> tuple[Floats, Floats]:
        """Return the flange poses (..., 4, 4) and the Jacobian (..., 6, 6) in the base frame.

        joints_rad: joint angles (..., 6).
        """
        *frames, flange = self._frames(joints_rad)
        placed = np.stack(frames, axis=-3)
        x, y, z = np.moveaxis((placed[..., :3, :3] @ self._axes[:, :, None])[..., 0], -1, 0)
        dx, dy, dz = np.moveaxis(flange[..., None, :3, 3] - placed[..., :3, 3], -1, 0)
        rows = (y * dz - z * dy, z * dx - x * dz, x * dy - y * dx, x, y, z)
        return flange, np.stack(rows, axis=-2)

    def levers_m(self, beyond_flange_m: float) -> Floats:
        """Return upper bounds (6,), in m, of a tool point's distance from each joint axis.

        beyond_flange_m: distance of the tool point from the flange.
        """
        after = np.append(self.offsets_m[1:], self.flange_m + beyond_flange_m)
        return np.asarray(np.cumsum(after[::-1])[::-1])


class NumericKinematics:
    """The numerical kinematics of one arm, which use Newton's method."""

    def __init__(self, model: JointChain) -> None:
        self.model = model
        self._chain = SerialChain(model)
        self._lowest, self._highest = np.array(model.min_rad), np.array(model.max_rad)
        self._start = np.array(model.start_rad)

    def forward(self, joints_rad: Floats) -> Floats:
        """Return the flange pose base_from_flange (4, 4) at joint angles (6,) rad."""
        return self._chain.forward(np.asarray(joints_rad, dtype=np.float64))

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return the Jacobians (n, 6, 6) in the base frame for joint angles (n, 6) rad."""
        return self._chain.jacobian(joints_rad)

    def _refine(self, poses: Floats, joints_rad: Floats, steps: int) -> tuple[Floats, Floats]:
        """Improve joint angles (n, 6), rad, for n flange poses (n, 4, 4) by Newton steps.

        Returns the joint angles (n, 6) and the remaining pose errors (n,), m or rad.
        """
        joints = joints_rad
        for left in reversed(range(steps + 1)):
            flanges, slopes = self._chain.pose_and_jacobian(joints)
            errors = _pose_errors(poses, flanges)
            largest = np.abs(errors).max(axis=1)
            if left == 0 or float(largest.max()) <= TOLERANCE:
                break
            transposed = np.swapaxes(slopes, 1, 2)
            normal = transposed @ slopes + DAMPING * np.eye(6)
            change = np.linalg.solve(normal, transposed @ errors[..., None])[..., 0]
            fastest = np.abs(change).max(axis=1, keepdims=True)
            joints = joints + change * np.minimum(1.0, MAX_STEP_RAD / np.maximum(fastest, 1e-12))
        return joints, largest

    def _continue(self, poses: Floats, joints_rad: Floats) -> tuple[Floats, Floats]:
        """Solve the inverse kinematics for n flange poses (n, 4, 4) iteratively.

        The iteration starts at given joint angles. It follows poses that are interpolated between
        the flange pose at the start and each goal. It therefore stays near the initial solution.

        joints_rad: joint angles (6,) at the start.

        Returns the joint angles (n, 6), rad, and the pose errors (n,), m or rad.
        """
        start = self.forward(joints_rad)
        rotation = scipy.spatial.transform.Rotation
        turns = rotation.from_matrix(poses[:, :3, :3] @ start[:3, :3].T).as_rotvec()
        joints = np.tile(joints_rad, (len(poses), 1))
        between = np.tile(np.eye(4), (len(poses), 1, 1))
        for number in range(1, WAYPOINTS + 1):
            part = number / WAYPOINTS
            between[:, :3, :3] = rotation.from_rotvec(part * turns).as_matrix() @ start[:3, :3]
            between[:, :3, 3] = start[:3, 3] + part * (poses[:, :3, 3] - start[:3, 3])
            joints, _ = self._refine(between, joints, STEPS_PER_WAYPOINT)
        return self._refine(poses, joints, STEPS_PER_WAYPOINT)

    def solve_next_joints(self, base_from_flange: Floats, present_rad: Floats) -> Floats:
        """Return the joint angles (6,) rad for a flange pose (4, 4) near the present angles (6,).

        Raises UnreachableError if there is no solution, if a joint is out of its range, or if the
        pose is too near to a singularity.
        """
        poses, present = base_from_flange[None], np.asarray(present_rad, dtype=np.float64)
        if not (np.isfinite(poses).all() and np.isfinite(present).all()):
            raise UnreachableError(
                "the pose of the flange or the present joint angles are not finite", "reach"
            )
        joints, errors = self._refine(poses, present[None], MAX_STEPS)
        if not errors[0] <= MAX_ERROR:
            joints, errors = self._continue(poses, present)
        x, y, z = np.round(base_from_flange[:3, 3] * 1e3) + 0.0
        where = f"flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm from the base"
        if not errors[0] <= MAX_ERROR:
            if self.reach_margins_m(poses)[0] < 0.0:
                away_mm = 1e3 * float(np.linalg.norm(base_from_flange[:3, 3]))
                raise UnreachableError(
                    f"{where}: out of the arm's reach; its distance is {away_mm:.0f} mm, maximum "
                    f"{1e3 * self._max_distance_m:.0f} mm",
                    "reach",
                )
            raise UnreachableError(
                f"{where}: no solution found near the present joint angles; the remaining error is "
                f"{1e3 * errors[0]:.2g} mm or mrad",
                "reach",
            )
        found = joints[0]
        beyond = np.maximum(self._lowest - found, found - self._highest)
        if (worst := int(beyond.argmax())) >= 0 and beyond[worst] > 0.0:
            raise UnreachableError(
                f"{where}: J{worst + 1} would be at {degrees(found[worst]):.1f} degrees, but "
                f"its range is {degrees(self._lowest[worst]):.0f} to "
                f"{degrees(self._highest[worst]):.0f}",
                f"J{worst + 1}",
            )
        smallest = float(self._singular_values(joints)[0])
        if not smallest >= MIN_SINGULAR_VALUE:
            raise UnreachableError(
                f"{where}: too near to a singularity; the smallest singular value is "
                f"{smallest:.2g}, minimum {MIN_SINGULAR_VALUE}",
                "singularity",
            )
        return np.asarray(found)

    def solve_all(self, base_from_flange: Floats) -> Sequence[Floats]:
        """Return the solutions (6,), rad, of the inverse kinematics found for a flange pose (4, 4).

        The solutions are within the joint ranges. They are sorted by their distance from the start
        angles of the arm. The search starts from random joint angles, and may miss a solution.
        """
        random = np.random.default_rng(1)
        low, high = np.maximum(self._lowest, -pi), np.minimum(self._highest, pi)
        seeds = np.vstack([self._start, random.uniform(low, high, (SEEDS, 6))])
        poses = np.broadcast_to(base_from_flange, (len(seeds), 4, 4))
        joints, errors = self._refine(poses, seeds, SEED_STEPS)
        turned = self._start + np.remainder(joints - self._start + pi, 2.0 * pi) - pi
        turned += 2.0 * pi * (1.0 * (turned < self._lowest) - 1.0 * (turned > self._highest))
        found: list[Floats] = []
        for one in turned[np.flatnonzero(np.less_equal(errors, MAX_ERROR))]:
            in_range = (np.maximum(self._lowest - one, one - self._highest) <= 0.0).all()
            # Joints that differ by whole revolutions count as the same solution.
            apart = [np.abs(np.sin(0.5 * (one - old))).max() for old in found]
            if in_range and min(apart, default=1.0) > MIN_DIFFERENCE:
                found.append(one)
        return sorted(found, key=lambda one: float(np.abs(one - self._start).max()))

    def find_branch(self, joints_rad: Floats) -> SeedBranch:
        """Return the branch (discrete inverse-kinematics solution) of the joint angles (6,) rad."""
        return SeedBranch(tuple(float(angle) for angle in joints_rad))

    def list_branches(self, base_from_flange: Floats) -> Sequence[SeedBranch]:
        """Return the branches (discrete inverse-kinematics solutions) that reach a flange pose.

        base_from_flange: n flange poses (n, 4, 4); the first pose that the arm can reach is used.
        """
        for pose in base_from_flange:
            if found := self.solve_all(pose):
                return [self.find_branch(joints) for joints in found]
        return [self.find_branch(self._start)]

    def solve_joints_on_branch(
        self, base_from_flange: Floats, branch: SeedBranch, near_rad: Floats
    ) -> Floats:
        """Return joint angles (n, 6), rad, for n flange poses (n, 4, 4) on one branch.

        branch: one of the discrete solutions of the inverse kinematics.
        near_rad: not used, because the branch determines the joint angles.

        The angles are NaN if a pose is out of reach.
        """
        joints, errors = self._continue(base_from_flange, np.array(branch.seed_rad))
        return np.where(errors[:, None] <= MAX_ERROR, joints, np.nan)

    @property
    def _max_distance_m(self) -> float:
        return float(self._chain.offsets_m.sum() + self._chain.flange_m)

    def reach_margins_m(self, base_from_flange: Floats) -> Floats:
        """Return the reach margins (n,), m, for n flange poses (n, 4, 4).

        A margin is the sum of all link lengths minus the distance of the flange from the base. It
        is negative if the pose is out of reach.
        """
        away = np.linalg.norm(base_from_flange[:, :3, 3], axis=1)
        return np.asarray(self._max_distance_m - away)

    def singularity_margins(self, joints_rad: Floats) -> Mapping[str, Floats]:
        """Return the margins (n,) to the nearest singularities at joint angles (n, 6) rad.

        A margin is the smallest singular value of the Jacobian minus NEAR_SINGULAR_VALUE.
        """
        return {"singularity": self._singular_values(joints_rad) - NEAR_SINGULAR_VALUE}

    def _singular_values(self, joints_rad: Floats) -> Floats:
        finite = np.asarray(np.isfinite(joints_rad).all(axis=1))
        slopes = self._chain.jacobian(np.where(finite[:, None], joints_rad, self._start))
        slopes[:, :3] /= SINGULAR_LENGTH_M
        smallest = np.linalg.svd(slopes, compute_uv=False)[:, -1]
        return np.where(finite, smallest, np.nan)


def _pose_errors(wanted: Floats, present: Floats) -> Floats:
    """Return the pose errors (n, 6): translations (m) and rotation vectors (rad).

    A pose error is the motion from the present pose to the wanted pose (both (n, 4, 4)). The
    directions of the rotation vectors are exact. Their lengths are exact for small angles only.
    """
    turn = wanted[:, :3, :3] @ np.swapaxes(present[:, :3, :3], 1, 2)
    spin = 0.5 * np.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ],
        axis=1,
    )
    # Beyond 90 degrees the sine decreases again. Keep its direction, with a length of 90 degrees.
    cosine = 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0)
    sine = np.linalg.norm(spin, axis=1)
    factor = np.where(cosine < 0.0, 1.0 / np.maximum(sine, 1e-6), 1.0)
    return np.concatenate([wanted[:, :3, 3] - present[:, :3, 3], spin * factor[:, None]], axis=1)
