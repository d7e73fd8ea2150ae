"""Simulate a sheet that follows a recorded finger, and compute a lower bound for its error.

The bound is the optimum of a linear program over the whole recording, for the same arms and their
limits. The linear program makes these assumptions:

- The future of the finger is known. Therefore delays, tracking and prediction cause no error.
- The sheet rolls on the undeformed object without slip, with a constant stretch.
- Limits apply to the positions, speeds and accelerations of the joints, and to the speed of the
    ends of the clamped edges. The limits are those of the nodes that control the arms. There is
    no servo lag and no limit on the jerk.
- While there is no contact, the sheet can move freely.
- Joint angles change linearly with small deviations of the contact point.

Three simplifications only make the bound smaller. The limits apply to differences between time
steps. The length of a deviation is replaced by its largest component along fixed directions.
Windows of the recording are solved independently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import linprog
from scipy.sparse import csr_array, diags_array, hstack, kron, vstack

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.followed import MAX_CONTACT_HEIGHT_M, read_followed_path
from flexsheet.launch.experiments.run import (
    Progress,
    make_path_procedure,
    require_scene,
    run_experiment,
)
from flexsheet.launch.experiments.simulated_time import follow_in_simulated_time
from flexsheet.launch.experiments.true_geometry import place_edges
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import FingerPath, TwinFinger
from flexsheet.nodes.arrays import Bools, Floats
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    pose_matrix,
    rotation_from_vector,
    transform,
)
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.twin.arms import PlacedArm
from flexsheet.nodes.twin.finger import join_points
from flexsheet.nodes.twin.paths import map_to_surface
from flexsheet.nodes.twin.truth import apply_apparatus

STEP_S = 1.0 / 30.0
"""The time step of the linear program, in seconds."""

WINDOW_STEPS = 60
"""The number of time steps in a window.

The solution time grows faster than linearly with this number.
"""

MAX_DEVIATION_M = 0.05
DEVIATION_M = 1e-4
"""The displacement (m) of the contact for numerical derivatives of the joint angles."""

ROLL_STEPS = 40

DIRECTIONS = np.array(
    [one for one in product((-1.0, 0.0, 1.0), repeat=3) if any(one)], dtype=np.float64
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
"""Unit vectors (26, 3). A vector's largest component along them is at least 91 % of its length."""

SPEED_DIRECTIONS = DIRECTIONS[(np.abs(DIRECTIONS) > 0.0).sum(axis=1) != 2]
SPEED_DIRECTIONS = SPEED_DIRECTIONS[SPEED_DIRECTIONS.sum(axis=1) > 0.0]
"""The 7 unit vectors along which the tool speed is limited, both forwards and backwards."""


@dataclass(frozen=True, slots=True)
class LimitedMotion:
    """A linear model of m limited quantities of a mechanism, such as joint angles.

    The quantities depend linearly on k deviations from a nominal motion of n time steps.

    values: (n, m), quantities in the nominal motion.
    slopes: (n, m, k), derivatives with respect to the deviations.
    max_rate, max_acceleration, low, high: (m,), limits of the quantities; infinite if there is no
        limit.
    """

    values: Floats
    slopes: Floats
    max_rate: Floats
    max_acceleration: Floats
    low: Floats
    high: Floats


def find_least_deviation(
    motion: LimitedMotion, weights: Floats, step_s: float, *, max_deviation: float
) -> Floats | None:
    """Find the motion within the limits that deviates least from a nominal motion.

    Return the length (n,) of the deviation at each of n time steps. The weighted mean of these
    lengths is a lower bound for the mean deviation of every motion within the limits. Return None
    if no motion is within the limits.

    weights: (n,), weights of the n time steps.
    step_s: time step.
    max_deviation: limit of each component of a deviation.
    """
    steps, _, deviations = motion.slopes.shape
    scale = max_deviation
    rows: list[Any] = []
    limits: list[Floats] = []

    def add(operator: Any, nominal: Floats, bound: Floats) -> None:
        """Add |nominal + operator e| <= bound to the constraints for the scaled deviations e."""
        known = np.isfinite(bound)
        kept = operator[known]
        rows.extend((kept, -kept))
        limits.extend((bound[known] - nominal[known], bound[known] + nominal[known]))

    first, second = _differences(steps, 1), _differences(steps, 2)
    for quantity in range(motion.values.shape[1]):
        value = motion.values[:, quantity]
        to_value = _block_rows(motion.slopes[:, quantity, :] * scale)
        low, high = motion.low[quantity], motion.high[quantity]
        if np.isfinite([low, high]).all():
            add(to_value, value - 0.5 * (low + high), np.full(steps, 0.5 * (high - low)))
        for operator, bound in (
            (first, motion.max_rate[quantity] * step_s),
            (second, motion.max_acceleration[quantity] * step_s**2),
        ):
            if np.isfinite(bound):
                add(operator @ to_value, operator @ value, np.full(operator.shape[0], bound))
    count = steps * deviations
    limited = csr_array(vstack(rows)) if rows else csr_array((0, count))
    directions = _directions(deviations)
    lengths = csr_array(kron(diags_array(np.ones(steps)), directions))
    owners = csr_array(kron(diags_array(np.ones(steps)), np.ones((len(directions), 1))))
    upper = vstack(
        [
            hstack([limited, csr_array((limited.shape[0], steps))]),
            hstack([lengths, -owners]),
        ]
    )
    total = max(float(weights.sum()), 1.0)
    solved = linprog(
        np.concatenate([np.zeros(count), weights / total]),
        A_ub=csr_array(upper),
        b_ub=np.concatenate([*limits, np.zeros(lengths.shape[0])]),
        bounds=[(-1.0, 1.0)] * count + [(0.0, None)] * steps,
        method="highs",
    )
    if solved.x is None or solved.status != 0:
        return None
    return np.asarray(scale * solved.x[count:])


def _directions(count: int) -> Floats:
    if count == 3:
        return DIRECTIONS
    return np.concatenate([np.eye(count), -np.eye(count)])


def _differences(steps: int, order: int) -> csr_array:
    """Return the sparse matrix (steps - order, steps) that computes finite differences in time."""
    return csr_array(np.diff(np.eye(steps), n=order, axis=0))


def _block_rows(rows: Floats) -> csr_array:
    """Return the block-diagonal matrix (n, n k) whose n blocks are the given rows of k numbers."""
    steps, width = rows.shape
    columns = np.arange(steps * width)
    owners = np.repeat(np.arange(steps), width)
    return csr_array((rows.ravel(), (owners, columns)), shape=(steps, steps * width))


@dataclass(frozen=True, slots=True)
class RolledSheet:
    """A sheet that touches the object at a point.

    point (3,), rotation (3, 3): contact point and orientation of the sheet, in the object's frame.
    on_sheet_m: contact point in the sheet's coordinates, (x, y, 0).
    """

    point: Floats
    rotation: Floats
    on_sheet_m: Floats

    def pose(self, lifted_m: float = 0.0) -> Floats:
        """Return object_from_sheet (4, 4) after the sheet moves by `lifted_m` along its normal."""
        contact = self.on_sheet_m - np.array([0.0, 0.0, lifted_m])
        return transform(self.rotation, self.point - self.rotation @ contact)

    def rolled_to(self, point: Floats, normal: Floats) -> RolledSheet:
        """Return the sheet after it has rolled without slip to a nearby point of the object.

        point: new contact point (3,). normal: unit normal (3,) of the object at this point.
        """
        before = self.rotation[:, 2]
        axis = np.cross(before, normal)
        sine, cosine = float(np.linalg.norm(axis)), float(before @ normal)
        turn_rad = axis * (np.arctan2(sine, cosine) / sine) if sine > 0.0 else axis
        turn, half = rotation_from_vector(turn_rad), rotation_from_vector(0.5 * turn_rad)
        moved = (half @ self.rotation).T @ (point - self.point)
        on_sheet = self.on_sheet_m + np.array([moved[0], moved[1], 0.0])
        return RolledSheet(point, turn @ self.rotation, on_sheet)


class FollowedContact:
    """A model of a sheet that follows a finger exactly, or with small deviations of its position.

    It computes the heights of the contact and the motions of the arms.
    """

    def __init__(self, scene: Scene, apparatus: Apparatus | None = None) -> None:
        true_scene = apply_apparatus(scene, apparatus or nominal_apparatus(scene))
        self._scene = true_scene
        self._shape = make_shape(dict(scene.object.geometry))
        self._world_from_object = pose_matrix(scene.object.world_from_object)
        self._arms = PlacedArm.of(true_scene.arms.left), PlacedArm.of(true_scene.arms.right)
        low, high = scene.sheet.min_stretch_ratio, scene.sheet.max_stretch_ratio
        self._distance_m = scene.sheet.width_m * 0.5 * (low + high)

    def contact_heights_m(self, positions_world: Floats) -> Floats:
        """Return the heights (n,), m, of n fingertips (n, 3) above the undeformed object."""
        local = apply(inverse(self._world_from_object), positions_world)
        return self._shape.closest(local).height_m

    def roll_along(self, positions_world: Floats) -> list[RolledSheet]:
        """Roll the sheet over the object without slip, and return its pose at n finger positions.

        The sheet starts at the front of the object, and rolls from one position to the next.

        positions_world: finger positions (n, 3), m.
        """
        object_from_world = inverse(self._world_from_object)
        front_world = map_to_surface(self._scene, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-3]]))
        front, above = apply(object_from_world, front_world)
        normal = (above - front) / np.linalg.norm(above - front)
        x_axis = object_from_world[:3, 0] - normal * float(object_from_world[:3, 0] @ normal)
        x_axis /= np.linalg.norm(x_axis)
        rotation = np.column_stack([x_axis, np.cross(normal, x_axis), normal])
        sheet = RolledSheet(front, rotation, np.zeros(3))
        targets = apply(object_from_world, positions_world)
        ahead = np.linspace(front, targets[0], ROLL_STEPS + 1)[1:-1]
        for at in ahead:
            sheet = self._roll(sheet, at)
        sheets = []
        for at in targets:
            sheet = self._roll(sheet, at)
            sheets.append(sheet)
        return sheets

    def _roll(self, sheet: RolledSheet, position: Floats) -> RolledSheet:
        found = self._shape.closest(position, previous=sheet.point)
        return sheet.rolled_to(found.point, found.normal)

    def limit(self, sheets: Sequence[RolledSheet], reachable: list[bool]) -> LimitedMotion:
        """Linearize the motion of the arms for small displacements of the contact.

        The result contains the joint angles and the positions of the ends of the clamped edges,
        with their limits. They are linear functions of three displacements (m) of the contact
        point. The displacements are along the sheet's x axis, along its y axis, and along its
        normal.

        sheets: nominal sheet at each time step.
        reachable: list to which the method appends whether the arms reach each sheet. For a sheet
            that is out of reach, the values in the result are NaN.
        """
        joints = np.full((len(sheets), 4, 2, 6), np.nan)
        ends = np.full((len(sheets), 4, 2, 2, 3), np.nan)
        half_m = 0.5 * self._scene.sheet.height_m
        mechanics = [arm.mechanics for arm in self._arms]
        guesses = [one.start_rad for one in mechanics]
        for number, sheet in enumerate(sheets):
            try:
                for case, pose in enumerate(self._deviated(sheet)):
                    edges = place_edges(self._world_from_object @ pose, self._distance_m)
                    for side, (arm, edge) in enumerate(zip(self._arms, edges, strict=True)):
                        found = arm.solve_joints(edge, guesses[side])
                        if case == 0:
                            guesses[side] = found
                        joints[number, case, side] = found
                        along_edge = half_m * edge[:3, 1]
                        ends[number, case, side] = edge[:3, 3] + [-along_edge, along_edge]
                reachable.append(True)
            except ValueError:
                joints[number] = ends[number] = np.nan
                reachable.append(False)
        joint = joints.reshape(len(sheets), 4, 12)
        along = np.einsum("ncsex,dx->ncsed", ends, SPEED_DIRECTIONS).reshape(len(sheets), 4, -1)
        values = np.concatenate([joint, along], axis=2)
        slopes = (values[:, 1:] - values[:, :1]) / DEVIATION_M
        count = along.shape[2]
        free = np.full(count, np.inf)
        return LimitedMotion(
            values=values[:, 0],
            slopes=slopes.transpose(0, 2, 1),
            max_rate=np.concatenate(
                [
                    *(one.speed_rad_per_s for one in mechanics),
                    np.full(count, self._scene.arms.max_tool_speed_m_per_s),
                ]
            ),
            max_acceleration=np.concatenate(
                [*(one.acceleration_rad_per_s2 for one in mechanics), free]
            ),
            low=np.concatenate([*(one.range_rad[:, 0] for one in mechanics), -free]),
            high=np.concatenate([*(one.range_rad[:, 1] for one in mechanics), free]),
        )

    def _deviated(self, sheet: RolledSheet) -> list[Floats]:
        poses = [sheet.pose()]
        for axis in range(2):
            found = self._shape.closest(
                sheet.point + DEVIATION_M * sheet.rotation[:, axis], previous=sheet.point
            )
            poses.append(sheet.rolled_to(found.point, found.normal).pose())
        return [*poses, sheet.pose(DEVIATION_M)]


def bound_errors(
    scene: Scene,
    times_s: Floats,
    positions_world: Floats,
    progress: Progress = lambda text: None,
    *,
    apparatus: Apparatus | None = None,
) -> dict[str, Any]:
    """Return a lower bound of the contact error (mm) along a finger path.

    The bound is computed for the motion with the least mean error that is possible within the
    limits of the arms. The result contains the mean and the 95 % quantile (p95) of its errors. Only
    time steps in which the finger touches the object are counted.

    The path is divided into windows that are solved independently. Errors count as zero in a window
    without a solution or with fewer than 3 steps. They also count as zero where the arms cannot
    reach the exact pose.

    times_s: n increasing times.
    positions_world: (n, 3), true fingertip positions, m.

    Raises ExperimentError if the path never touches the object.
    """
    followed = FollowedContact(scene, apparatus)
    grid = np.arange(times_s[0], times_s[-1], STEP_S)
    positions = np.column_stack([np.interp(grid, times_s, column) for column in positions_world.T])
    contact = followed.contact_heights_m(positions) <= MAX_CONTACT_HEIGHT_M
    if not contact.any():
        raise ExperimentError(
            "the finger path never touches the object, so no lower bound can be computed; give a "
            "path in contact"
        )
    # The sheet may move freely outside of contact. A smooth nominal motion there gives good slopes.
    touching = PchipInterpolator(grid[contact], positions[contact]) if contact.sum() > 1 else None
    nominal = positions[contact][:1].repeat(len(grid), axis=0)
    if touching is not None:
        nominal = touching(np.clip(grid, grid[contact][0], grid[contact][-1]))
    reachable: list[bool] = []
    motion = followed.limit(followed.roll_along(nominal), reachable)
    lengths = np.zeros(len(grid))
    unsolved = 0
    windows = _windows(np.array(reachable))
    for number, window in enumerate(windows):
        progress(f"lower bound: {number + 1} of {len(windows)} windows")
        part = replace(motion, values=motion.values[window], slopes=motion.slopes[window])
        weights = contact[window].astype(np.float64)
        if not weights.any():
            continue
        found = find_least_deviation(part, weights, STEP_S, max_deviation=MAX_DEVIATION_M)
        if found is None:
            unsolved += 1
        else:
            lengths[window] = found
    errors_mm = 1e3 * lengths[contact]
    return {
        "mean": float(errors_mm.mean()),
        "p95": float(np.quantile(errors_mm, 0.95)),
        "steps": int(contact.sum()),
        "steps_out_of_reach": int((contact & ~np.array(reachable)).sum()),
        "windows": len(windows),
        "windows_without_solution": unsolved,
    }


def _windows(reachable: Bools) -> list[slice]:
    """Divide the reachable time steps into windows of 3 to WINDOW_STEPS consecutive steps.

    reachable: whether the arms reach the sheet in each of the n time steps, (n,).
    """
    changes = np.flatnonzero(np.diff(reachable.astype(int))) + 1
    ends = [0, *changes.tolist(), len(reachable)]
    windows = []
    for begin, end in pairwise(ends):
        if reachable[begin]:
            cuts = [*range(begin, end, WINDOW_STEPS), end]
            windows += [slice(one, other) for one, other in pairwise(cuts) if other - one >= 3]
    return windows


def run_follow(
    launch_file: Path,
    settings: Sequence[str],
    bag: Path | None,
    path: FingerPath,
    progress: Progress,
    *,
    apparatus: str | None = None,
) -> dict[str, Any]:
    """Let the sheet follow a finger path, and return the results of `experiment follow --json`.

    bag: file in which the running graph is recorded. If it is None, no graph is run, and the path
    is followed in simulated time.
    """
    plan = load_graph(launch_file, settings=settings, apparatus=apparatus)
    scene, truth = require_scene(plan), plan.apparatus_message()
    if bag is None:
        progress("following in simulated time")
        followed = {"path": path.label, **follow_in_simulated_time(scene, path, truth)}
        finger = join_points(path.times_s, path.positions_world_m, path.joined_by)
        times_s = np.arange(0.0, finger.duration_s, 0.5 * STEP_S)
        positions = np.array([finger.at(time_s)[0] for time_s in times_s])
    else:
        procedure = make_path_procedure(lambda _: path, progress)
        run_experiment(launch_file, settings, bag, procedure, progress, apparatus=apparatus)
        followed = read_followed_path(bag, path.label)
        times_s, positions = _read_true_finger(bag, path.label)
    bound = bound_errors(scene, times_s, positions, progress, apparatus=truth)
    contact = followed["contact"]["true_delta_d_mm"]
    return {
        **followed,
        "lower_bound_mm": bound,
        "mean_over_bound": (
            contact["mean"] / bound["mean"] if contact and bound["mean"] > 0.0 else None
        ),
        "apparatus": "nominal" if truth is None else truth.origin,
        "bag": None if bag is None else str(bag),
    }


def _read_true_finger(bag: Path, label: str) -> tuple[Floats, Floats]:
    """Return the times (n,), s, and the true positions (n, 3), m, of the finger on a path."""
    positions: dict[int, Floats] = {}
    for _, message, header, _ in BagReader(bag, topics=["twin/finger"]):
        assert isinstance(message, TwinFinger)
        if message.path_label == label and message.path_time_s >= 0.0 and not message.path_done:
            positions[header.source_ns] = message.position_world_m
    times_ns = np.array(sorted(positions), dtype=np.int64)
    times_s = np.asarray((times_ns - times_ns[0]) * 1e-9, dtype=np.float64)
    return times_s, np.array([positions[at_ns] for at_ns in times_ns.tolist()])
