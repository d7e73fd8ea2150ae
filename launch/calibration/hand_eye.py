"""Where an arm's base stands in the world, from pictures of a board on its flange.

Robot-world and hand-eye calibration: at each of several places of the arm

    world_from_base base_from_flange(joints) flange_from_board = world_from_left left_from_board

where the first and the third transform are unknown.  A closed form (Shah, Solving the
robot-world/hand-eye calibration problem using the Kronecker product, J. Mechanisms Robotics 5(3),
2013) gives a start; then all corners of all pictures are fitted at once.  An arm is not where its
joints say by some tenths of a millimetre, and that error all corners of a pair share.  So each
place has a small unknown motion of the flange of its own, of which only the size is unknown
beforehand: a mixed model, with the sizes found by restricted maximum likelihood (Patterson and
Thompson, Biometrika 58(3), 1971).  Without it each corner would count as a witness of its own, and
the result would claim to be several times as certain as it is.

Motions (6,) are a rotation vector (rad), then a shift (m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arm_bridge.kinematics import forward
from flexsheet.nodes.models.camera import project
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    rotation_from_vector,
    skew,
    transform,
    vector_from_rotation,
)

Floats = NDArray[np.float64]

FEWEST = 6
"""Places that are needed; 15 to 20 give a result worth having."""

LEAST_TURN_RAD = float(np.radians(5.0))
"""Root mean square turns of the flange about two axes, to tell the unknowns apart."""

TRIES = 60
SUBSET = 5
"""Starts are also made from so many places chosen at random, lest one wrong place spoils all."""

LENGTH_M = 0.3
"""A turn of a radian counts as much as a shift by that."""

ROUGH = 6.0
"""A place that is off by so many times the median is left out of the first fit."""

STRAY, MEDIAN_CHI_SQUARE = 60.0, 5.348
"""A place whose squared deviation is above that is left out (chi-square with six degrees of
freedom, whose median scales it).  In 75 made-up sets of 15 places without a stray the largest was
43: an arm's error is not quite the same everywhere."""

ROUNDING_PX, ROUNDING_RAD, ROUNDING_M = 1e-4, 1e-8, 1e-8
LEAST_SCALE = 0.01
"""Poses that agree to rounding have no spread to be measured by."""

RETURNS = 5

NO_ARM_M, NO_ARM_RAD = 0.01, 0.05
"""No arm is so far off (deviations): the joints are then not those of the pictures."""

STRAY_SHARE = 1.0 / 3.0
"""If more places than that are left out, something else is wrong."""

SMALLEST_RAD, SMALLEST_M = 1e-6, 1e-6
"""An arm is not taken for more exact than that."""

LARGEST_RAD, LARGEST_M = 0.1, 0.1

ADVICE = (
    "are the joints those at the moment of the pictures, is the board fast on the flange, do the "
    "stereo calibration and the board's square fit?"
)

SIMPLEX = np.array([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]])
"""First steps of the search for the deviations' logarithms."""

ROUNDS = 30
SETTLED = 1e-10
"""A step of all unknowns (rad, m) that ends the iteration."""

STARTED = 1e-6
"""The same for what is only a start."""


class HandEyeError(FlexsheetError, ValueError):
    """Places that do not fix where the base stands; the message says why and what to do."""

    code = "hand-eye"
    remedy = "Measure more poses, with the board rotated about at least two axes."


@dataclass(frozen=True, slots=True)
class Lens:
    """Camera matrix (3, 3) px and Brown's distortion (5,)."""

    matrix: Floats
    distortion: Floats


@dataclass(frozen=True, slots=True)
class Rig:
    """The stereo camera, and where it stands in the world; transforms (4, 4)."""

    left: Lens
    right: Lens
    right_from_left: Floats
    world_from_left: Floats


@dataclass(frozen=True, slots=True)
class View:
    """Corners of the board in one picture: where they are on the board (k, 3) m, and pixels."""

    points_board: Floats
    pixels: Floats


@dataclass(frozen=True, slots=True)
class Sighting:
    """A place of the arm: its joints (6,) rad, and what both cameras saw of the board."""

    name: str
    joints_rad: Floats
    left: View
    right: View


@dataclass(frozen=True, slots=True)
class Residual:
    """How a place fits.

    shift_m, turn_rad: how far the cameras see the flange from where the joints say it is.
    rms_px: of the corners, drawn where the joints say.  reason: why it was left out; "" if it
        was not.
    """

    name: str
    shift_m: float
    turn_rad: float
    rms_px: float
    reason: str


@dataclass(frozen=True, slots=True)
class BaseFit:
    """Where the base stands, how well that is known, and how the places fit.

    covariance: (6, 6) of the motion that takes the found world_from_base to the true one: a turn
        about the base's origin, in the world's axes, then a shift.  Raised by the square of
        `jackknife_ratio` where that is above 1.
    corner_sigma_px: of one coordinate of a corner.  arm_sigma_rad, arm_sigma_m: of one component of
        the flange's error of place.
    jackknife_ratio: what the result scatters when places are left out one by one, over what the fit
        alone states (root mean square over the six).
    leave_one_out: (n, 6) motions of the base when a used place is left out.
    """

    world_from_base: Floats
    flange_from_board: Floats
    covariance: Floats
    corner_sigma_px: float
    arm_sigma_rad: float
    arm_sigma_m: float
    jackknife_ratio: float
    leave_one_out: Floats
    residuals: tuple[Residual, ...]

    def std_at(self, world_m: Floats) -> tuple[float, float]:
        """How far a place in the world (3,) m, as this arm is sent there, may be off.

        Standard deviations: of the distance (m), and of the turn (rad), all three axes together.
        """
        lever = np.hstack([-skew(world_m - self.world_from_base[:3, 3]), np.eye(3)])
        shift = float(np.sqrt(np.trace(lever @ self.covariance @ lever.T)))
        return shift, float(np.sqrt(np.trace(self.covariance[:3, :3])))


@dataclass(frozen=True, slots=True)
class _Unknowns:
    """What is sought, both (4, 4)."""

    world_from_base: Floats
    flange_from_board: Floats

    def moved(self, step: Floats) -> _Unknowns:
        """After motions (12,) of base and board, each a turn about its own origin and a shift."""
        return _Unknowns(
            _moved(self.world_from_base, step[:6]), _moved(self.flange_from_board, step[6:])
        )


@dataclass(frozen=True, slots=True)
class _Linear:
    """One place, linearised about the present unknowns.

    seen: (6,) motion of the flange, in its own frame, that draws the corners best.
    spread: (6, 6), its covariance per px^2 of the corners.  by_unknowns: (6, 12), the flange's
        motion for those of base and board.
    inner_px2: what is left of the squared pixels (sum) after the motion that is seen.
    count: coordinates.  rms_px: of the corners, without that motion.
    """

    seen: Floats
    spread: Floats
    by_unknowns: Floats
    inner_px2: float
    count: int
    rms_px: float


def calibrate_base(sightings: Sequence[Sighting], rig: Rig, *, seed: int = 0) -> BaseFit:
    """Where the arm's base stands; HandEyeError where the places do not say.

    seed: of the starts.  The stereo rig and its place in the world are taken as they are: what is
    wrong there the result shares, and the fingertip, measured by the same rig, shares it too.
    """
    _refuse_few(sightings)
    flanges = [forward(one.joints_rad) for one in sightings]
    _refuse_poor_turns(flanges)
    boards = [_board_pose(one, rig) for one in sightings]
    unknowns = _start(flanges, boards, rig, seed=seed)
    used = _roughly_sound(_discrepancies(unknowns, flanges, boards, rig))
    for attempt in range(2 * RETURNS):
        _refuse_strays(sightings, used)
        kept = np.flatnonzero(used).tolist()
        _refuse_poor_turns([flanges[i] for i in kept])
        unknowns, model = _fitted(
            unknowns, [sightings[i] for i in kept], [flanges[i] for i in kept], rig
        )
        _refuse_absurd(model)
        again = _sound(_linearised(unknowns, sightings, flanges, rig), model)
        if (again == used).all():
            break
        # A place once left out may come back, but not for ever.
        used = again if attempt < RETURNS else again & used
    return _result(sightings, flanges, rig, unknowns=unknowns, model=model, used=used)


def _refuse_few(sightings: Sequence[Sighting]) -> None:
    if len(sightings) < FEWEST:
        raise HandEyeError(
            f"{len(sightings)} places of the arm, at least {FEWEST} are needed; take 15 to 20"
        )
    for one in sightings:
        if not np.isfinite(one.joints_rad).all() or one.joints_rad.shape != (6,):
            raise HandEyeError(f"{one.name}: its joints are not six numbers; correct or remove it")


def _refuse_strays(sightings: Sequence[Sighting], used: NDArray[np.bool_]) -> None:
    strays = int((~used).sum())
    if strays > STRAY_SHARE * len(used):
        names = ", ".join(one.name for one, good in zip(sightings, used, strict=True) if not good)
        raise HandEyeError(
            f"{strays} of {len(used)} places do not fit with the others ({names}): {ADVICE}"
        )


def _refuse_absurd(model: _Model) -> None:
    if model.arm_m > NO_ARM_M or model.arm_rad > NO_ARM_RAD:
        raise HandEyeError(
            f"the places do not fit together (the arm would be {1e3 * model.arm_m:.1f} mm and "
            f"{np.degrees(model.arm_rad):.1f} degrees off its joints): {ADVICE}"
        )


def _refuse_poor_turns(flanges: Sequence[Floats]) -> None:
    """Turns about two axes are needed: about one alone, the shift along it stays open."""
    mean = _mean_rotation([flange[:3, :3] for flange in flanges])
    turns = np.array([vector_from_rotation(mean.T @ flange[:3, :3]) for flange in flanges])
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    spread = np.sqrt(np.maximum(values, 0.0))
    if spread[2] < LEAST_TURN_RAD:
        raise HandEyeError(
            f"the flange hardly turns between the places ({np.degrees(spread[2]):.1f} degrees rms, "
            f"at least {np.degrees(LEAST_TURN_RAD):.0f} about two axes): turn it by 20 to 40 "
            "degrees, each way"
        )
    if spread[1] < LEAST_TURN_RAD:
        x, y, z = axes[:, 2]
        raise HandEyeError(
            f"the flange turns about one axis only, ({x:.2f}, {y:.2f}, {z:.2f}) of its own frame "
            f"(about others {np.degrees(spread[1]):.1f} degrees rms, at least "
            f"{np.degrees(LEAST_TURN_RAD):.0f}): turn it about another too"
        )


def _mean_rotation(rotations: Sequence[Floats]) -> Floats:
    """The rotation nearest to all (least squares of the matrices)."""
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt)


def _board_pose(sighting: Sighting, rig: Rig) -> Floats:
    """left_from_board (4, 4) that draws the corners of both pictures best.

    A flat board has two poses that look nearly alike in one picture; the other picture decides.
    """
    left = sighting.left
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        left.points_board, left.pixels, rig.left.matrix, rig.left.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )  # fmt: skip
    best, least = None, np.inf
    for index in range(count):
        pose = transform(
            rotation_from_vector(np.asarray(turns[index], np.float64).ravel()),
            np.asarray(shifts[index], np.float64).ravel(),
        )
        for _ in range(ROUNDS):
            residuals, slopes = _pixels_by_motion(sighting, rig, pose, np.eye(4))
            step = np.linalg.lstsq(slopes, residuals, rcond=None)[0]
            pose = pose @ transform(rotation_from_vector(step[:3]), step[3:])
            if np.abs(step).max() < STARTED:
                break
        cost = float(residuals @ residuals)
        if np.isfinite(cost) and cost < least:
            best, least = pose, cost
    if best is None:
        raise HandEyeError(f"{sighting.name}: no pose of the board draws its corners; remove it")
    return np.asarray(best)


def _pixels_by_motion(
    sighting: Sighting, rig: Rig, left_from_flange: Floats, flange_from_board: Floats
) -> tuple[Floats, Floats]:
    """Seen minus drawn (m,) px, and the drawn pixels' slopes (m, 6) by a motion of the flange."""
    residuals, slopes = [], []
    for view, lens, eye_from_left in (
        (sighting.left, rig.left, np.eye(4)),
        (sighting.right, rig.right, rig.right_from_left),
    ):
        on_flange = apply(flange_from_board, view.points_board)
        eye_from_flange = eye_from_left @ left_from_flange
        in_eye = apply(eye_from_flange, on_flange)
        residuals.append((view.pixels - project(in_eye, lens.matrix, lens.distortion)).ravel())
        turn = eye_from_flange[:3, :3]
        by_place = np.empty((len(in_eye), 2, 3))
        for axis in range(3):
            # Half a micrometre: pixels are smooth enough for ten digits.
            nudge = np.zeros(3)
            nudge[axis] = 5e-7
            ahead, behind = (
                project(in_eye + way * nudge, lens.matrix, lens.distortion) for way in (1.0, -1.0)
            )
            by_place[:, :, axis] = (ahead - behind) / 1e-6
        x, y, z = on_flange.T
        motion = np.zeros((len(on_flange), 3, 6))
        motion[:, 0, 1], motion[:, 0, 2], motion[:, 1, 2] = z, -y, x
        motion[:, 1, 0], motion[:, 2, 0], motion[:, 2, 1] = -z, y, -x
        motion[:, :, 3:] = np.eye(3)
        slopes.append((by_place @ turn @ motion).reshape(-1, 6))
    return np.concatenate(residuals), np.concatenate(slopes)


def _start(
    flanges: Sequence[Floats], boards: Sequence[Floats], rig: Rig, *, seed: int
) -> _Unknowns:
    """OpenCV's closed form from all places, or from those few with which most others agree."""
    random = np.random.default_rng(seed)
    every = np.arange(len(flanges))
    subsets = [every, *(random.choice(every, SUBSET, replace=False) for _ in range(TRIES))]
    best, least = None, np.inf
    for chosen in subsets:
        found = _closed_form([flanges[i] for i in chosen], [boards[i] for i in chosen], rig)
        if found is None:
            continue
        off = _discrepancies(found, flanges, boards, rig)
        score = float(
            np.median(
                np.linalg.norm(off[:, 3:], axis=1) + LENGTH_M * np.linalg.norm(off[:, :3], axis=1)
            )
        )
        if score < least:
            best, least = found, score
    if best is None:
        raise HandEyeError(
            "no start was found from these places: turn the flange more, about two axes"
        )
    return best


def _closed_form(flanges: Sequence[Floats], boards: Sequence[Floats], rig: Rig) -> _Unknowns | None:
    """Shah's solution of B F X = C, or None where these places have none.

    With Y the transpose of X's rotation, C Y = B F for all places' rotations; hence the matrix
    sum(kron(F, C)) takes the stacked columns of Y to those of B, n times as long, and both are its
    first singular vectors.  The shifts follow by linear least squares.
    """
    seen = [rig.world_from_left @ board for board in boards]
    stacked = np.sum(
        [np.kron(f[:3, :3], c[:3, :3]) for f, c in zip(flanges, seen, strict=True)], axis=0
    )
    u, values, vt = np.linalg.svd(stacked)
    if values[0] - values[1] < 1e-9 * values[0]:
        return None
    base = _rotation_of(u[:, 0])
    board = _rotation_of(vt[0]).T
    # R_B (R_F t_X + t_F) + t_B = t_C
    rows = np.vstack([np.hstack([base @ f[:3, :3], np.eye(3)]) for f in flanges])
    sides = np.concatenate([c[:3, 3] - base @ f[:3, 3] for f, c in zip(flanges, seen, strict=True)])
    shifts, _, rank, _ = np.linalg.lstsq(rows, sides, rcond=1e-9)
    if rank < 6:
        return None
    return _Unknowns(transform(base, shifts[3:]), transform(board, shifts[:3]))


def _rotation_of(stacked: Floats) -> Floats:
    """The rotation whose columns, one below the other and times some number, are these nine."""
    matrix = stacked.reshape(3, 3).T
    return _mean_rotation([matrix if np.linalg.det(matrix) > 0.0 else -matrix])


def _discrepancies(
    unknowns: _Unknowns, flanges: Sequence[Floats], boards: Sequence[Floats], rig: Rig
) -> Floats:
    """Motions (n, 6) of the flange, in its frame, from where the joints say to where it is seen."""
    found = []
    for flange, board in zip(flanges, boards, strict=True):
        seen = rig.world_from_left @ board @ inverse(unknowns.flange_from_board)
        motion = inverse(unknowns.world_from_base @ flange) @ seen
        found.append(np.concatenate([vector_from_rotation(motion[:3, :3]), motion[:3, 3]]))
    return np.array(found)


def _roughly_sound(discrepancies: Floats) -> NDArray[np.bool_]:
    """Which places (n,) are off by no more than some times what most are: for a first fit."""
    good = np.ones(len(discrepancies), dtype=bool)
    for part, smallest in ((slice(0, 3), SMALLEST_RAD), (slice(3, 6), SMALLEST_M)):
        off = np.linalg.norm(discrepancies[:, part], axis=1)
        good &= off <= ROUGH * max(float(np.median(off)), smallest)
    return good


@dataclass(frozen=True, slots=True)
class _Model:
    """Deviations of a corner's coordinate (px) and of the flange's place (rad, m)."""

    corner_px: float
    arm_rad: float
    arm_m: float

    def weights(self, places: Sequence[_Linear]) -> Floats:
        """Information (n, 6, 6) of what is seen of each flange, its own error included."""
        own = np.diag([self.arm_rad**2] * 3 + [self.arm_m**2] * 3)
        spreads = np.array([one.spread for one in places])
        return np.asarray(np.linalg.inv(self.corner_px**2 * spreads + own))


def _sound(places: Sequence[_Linear], model: _Model) -> NDArray[np.bool_]:
    """Which places (n,) are off by no more than chance allows, given how far most are off.

    What is off by no more than rounding is sound, however exact the others are.
    """
    seen = np.array([one.seen for one in places])
    at_least = _Model(
        max(model.corner_px, ROUNDING_PX),
        max(model.arm_rad, ROUNDING_RAD),
        max(model.arm_m, ROUNDING_M),
    )
    squares = np.einsum("nk,nkl,nl->n", seen, at_least.weights(places), seen)
    scale = max(float(np.median(squares)) / MEDIAN_CHI_SQUARE, LEAST_SCALE)
    return np.asarray(squares <= STRAY * scale)


def _fitted(
    unknowns: _Unknowns, sightings: Sequence[Sighting], flanges: Sequence[Floats], rig: Rig
) -> tuple[_Unknowns, _Model]:
    """The unknowns that fit best from a start, with the model's deviations; Gauss-Newton."""
    model: _Model | None = None
    for _ in range(ROUNDS):
        places = _linearised(unknowns, sightings, flanges, rig)
        model = _deviations(places, model)
        matrix, side = _normal(places, model)
        try:
            step = np.asarray(np.linalg.solve(matrix, side), np.float64)
        except np.linalg.LinAlgError as error:
            raise HandEyeError(
                "the places do not fix where the base stands: turn the flange more, about two axes"
            ) from error
        unknowns = unknowns.moved(step)
        if np.abs(step).max() < SETTLED:
            break
    assert model is not None
    return unknowns, model


def _linearised(
    unknowns: _Unknowns, sightings: Sequence[Sighting], flanges: Sequence[Floats], rig: Rig
) -> list[_Linear]:
    board = unknowns.flange_from_board
    by_board = np.block([[np.eye(3), np.zeros((3, 3))], [skew(board[:3, 3]), np.eye(3)]])
    left_from_world = inverse(rig.world_from_left)
    found = []
    for sighting, flange in zip(sightings, flanges, strict=True):
        world_from_flange = unknowns.world_from_base @ flange
        residuals, slopes = _pixels_by_motion(
            sighting, rig, left_from_world @ world_from_flange, board
        )
        information = slopes.T @ slopes
        seen = np.asarray(np.linalg.solve(information, slopes.T @ residuals), np.float64)
        back = world_from_flange[:3, :3].T
        lever = world_from_flange[:3, 3] - unknowns.world_from_base[:3, 3]
        by_base = np.block([[back, np.zeros((3, 3))], [-back @ skew(lever), back]])
        found.append(
            _Linear(
                seen=seen,
                spread=np.asarray(np.linalg.inv(information), np.float64),
                by_unknowns=np.hstack([by_base, by_board]),
                inner_px2=float(residuals @ residuals - seen @ information @ seen),
                count=len(residuals),
                rms_px=float(np.sqrt(2.0 * np.mean(residuals * residuals))),
            )
        )
    return found


def _normal(places: Sequence[_Linear], model: _Model) -> tuple[Floats, Floats]:
    """Normal equations (12, 12) and (12,) of a step of the unknowns."""
    weights = model.weights(places)
    slopes = np.array([one.by_unknowns for one in places])
    seen = np.array([one.seen for one in places])
    matrix = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes)
    side = np.einsum("nki,nkl,nl->i", slopes, weights, seen)
    return matrix, side


def _deviations(places: Sequence[_Linear], before: _Model | None) -> _Model:
    """Corner noise from what each place's own motion leaves, the arm's by restricted likelihood."""
    freedom = sum(one.count - 6 for one in places)
    corner = float(np.sqrt(max(sum(one.inner_px2 for one in places), 0.0) / max(freedom, 1)))
    corner = max(corner, 1e-6)
    seen = np.array([one.seen for one in places])
    slopes = np.array([one.by_unknowns for one in places])

    def unlikeliness(logs: Floats) -> float:
        """-2 log of the restricted likelihood, but for a constant."""
        logs = np.clip(
            logs,
            [np.log(SMALLEST_RAD), np.log(SMALLEST_M)],
            [np.log(LARGEST_RAD), np.log(LARGEST_M)],
        )
        weights = _Model(corner, *np.exp(logs).tolist()).weights(places)
        matrix = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes)
        side = np.einsum("nki,nkl,nl->i", slopes, weights, seen)
        left = seen - slopes @ np.linalg.lstsq(matrix, side, rcond=None)[0]
        squares = float(np.einsum("nk,nkl,nl->", left, weights, left))
        spread = float(np.linalg.slogdet(matrix)[1] - np.linalg.slogdet(weights)[1].sum())
        return squares + spread

    start = np.log([1e-4, 1e-4] if before is None else [before.arm_rad, before.arm_m])
    options = {"xatol": 1e-3, "fatol": 1e-3, "initial_simplex": start + SIMPLEX}
    best = minimize(unlikeliness, start, method="Nelder-Mead", options=options).x
    arm_rad, arm_m = np.exp(best).tolist()
    return _Model(
        corner,
        min(max(arm_rad, SMALLEST_RAD), LARGEST_RAD),
        min(max(arm_m, SMALLEST_M), LARGEST_M),
    )


def _moved(pose: Floats, motion: Floats) -> Floats:
    """The pose turned about its own origin, and shifted; the motion's axes are the parent's."""
    turn = rotation_from_vector(motion[:3])
    return transform(turn @ pose[:3, :3], pose[:3, 3] + motion[3:])


def _result(
    sightings: Sequence[Sighting],
    flanges: Sequence[Floats],
    rig: Rig,
    *,
    unknowns: _Unknowns,
    model: _Model,
    used: NDArray[np.bool_],
) -> BaseFit:
    every = _linearised(unknowns, sightings, flanges, rig)
    places = [one for one, good in zip(every, used, strict=True) if good]
    matrix, _ = _normal(places, model)
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    left_out = []
    for index in range(len(places)):
        # At the optimum a place less is a step of the remaining normal equations.
        without, side = _normal(places[:index] + places[index + 1 :], model)
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
            Residual(
                name=sighting.name,
                shift_m=float(np.linalg.norm(one.seen[3:])),
                turn_rad=float(np.linalg.norm(one.seen[:3])),
                rms_px=one.rms_px,
                reason="" if good else "does not fit with the others",
            )
            for sighting, one, good in zip(sightings, every, used, strict=True)
        ),
    )
