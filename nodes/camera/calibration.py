"""Calibrates a stereo rig from pictures of a board.

Zhang's method (A flexible new technique for camera calibration, 2000) for each camera alone, then
both together with all numbers free (`bundle`), which fits held-out pictures better than fixed
intrinsics do.  Lens model: pinhole with k1, k2, p1, p2; k3 stays 0, since boards that fill less
than the picture cannot tell it from k2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from messages.calibration import Board, PairResidual, StereoCalibration, Uncertainty
from messages.scene import Lens
from nodes.camera.bundle import (
    LEFT,
    PARAMETERS,
    RIGHT,
    Fit,
    NotDeterminedError,
    board_pose,
    fit_rig,
    lens_arrays,
    pose_transform,
    pose_vector,
)
from nodes.camera.corners import (
    BoardPair,
    CalibrationError,
    Progress,
    View,
    board_points,
    find_pairs,
    ignore_progress,
)
from nodes.camera.uncertainty import (
    jackknife_covariance,
    position_slopes,
    position_spread,
    right_from_left_of,
    view_of_work,
)
from nodes.models import rigid

Floats = NDArray[np.float64]

MIN_PAIRS = 5
OUTLIER_RATIO = 3.0
OUTLIER_FLOOR_PX = 0.5
MISFIT_RATIO = 5.0
MISFIT_FLOOR_PX = 5.0
MISFIT = "does not go with the other pairs:"
CORNER_RATIO = 6.0
"""A corner further off than this many standard deviations was drawn to something else."""

CORNER_ROUNDS = 2
REPEAT_PX = 1.0
"""Two pairs whose corners lie nearer to each other than that show the board in one place."""

LARGEST_DEPTH_SHARE = 0.05
"""Of the working distance: a rig that tells depth no better is not determined."""

LARGEST_STRAY_SHARE = 0.15
"""A pair with more stray corners than that is a bad pair, not a good one with strays."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration with what it was made from, for a report: pairs by their number among all."""

    calibration: StereoCalibration
    fit: Fit
    pairs: dict[int, BoardPair]
    size: tuple[int, int]


def single_lens(views: Sequence[View], points: Floats, size: tuple[int, int]) -> Floats:
    """One lens (8,) from its own views of the board, whose corners are `points` (n, 3) m."""
    _, matrix, distortion, *_ = cv2.calibrateCamera(
        [points[view.ids].astype(np.float32) for view in views],
        [view.pixels.astype(np.float32) for view in views],
        size,
        None,
        None,
        flags=cv2.CALIB_FIX_K3,
    )
    return np.array(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:4]]
    )


def misfits(
    pairs: Sequence[BoardPair], points: Floats, left: Floats, right: Floats
) -> tuple[Floats, Floats]:
    """How far each pair (n,) is from what most pairs say of the rig, px rms in the right view.

    Each pair alone determines how the cameras stand to each other.  The pair whose answer suits the
    others best by their median (least median of squares, Rousseeuw 1984) judges them all.  A pair
    of pictures that do not belong together thus stands out; in a common fit it would bend the rig
    until all pairs looked equally bad.  left, right: lenses (8,).  The second result is what the
    judging pair says of right_from_left (6,).
    """
    left_poses = [pose_transform(board_pose(pair.left, points, left)) for pair in pairs]
    right_poses = [pose_transform(board_pose(pair.right, points, right)) for pair in pairs]
    stands = [b @ rigid.inverse(a) for a, b in zip(left_poses, right_poses, strict=True)]
    matrix, distortion = lens_arrays(right)
    errors = np.empty((len(stands), len(pairs)))
    for i, right_from_left in enumerate(stands):
        for j, pair in enumerate(pairs):
            pose = pose_vector(right_from_left @ left_poses[j])
            seen = points[pair.right.ids]
            drawn = cv2.projectPoints(seen, pose[:3], pose[3:], matrix, distortion)[0][:, 0]
            shifts = drawn - pair.right.pixels
            errors[i, j] = np.sqrt(np.mean(np.sum(shifts * shifts, axis=1)))
    judge = int(np.argmin(np.median(errors, axis=1)))
    return np.asarray(errors[judge]), pose_vector(stands[judge])


def fit_pairs(pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]) -> Fit:
    """Both cameras together, from nothing but the pairs; points: the board's corners (n, 3) m."""
    left = single_lens([pair.left for pair in pairs], points, size)
    right = single_lens([pair.right for pair in pairs], points, size)
    _, stand = misfits(pairs, points, left, right)
    poses = np.array([board_pose(pair.left, points, left) for pair in pairs])
    return fit_rig(pairs, points, rig=np.concatenate([left, right, stand]), poses=poses)


def corner_count(pair: BoardPair) -> int:
    """Corners of both views."""
    return len(pair.left.ids) + len(pair.right.ids)


def without_stray_corners(fit: Fit, pairs: Sequence[BoardPair]) -> list[BoardPair]:
    """The pairs without the corners that lie further off than noise can put them.

    The standard deviation is taken from the median of the distances, which strays do not move (of
    distances in a plane the median is 1.1774 standard deviations).
    """
    distances = [[np.linalg.norm(view, axis=1) for view in views] for views in fit.residuals]
    every = np.concatenate([view for views in distances for view in views])
    limit_px = CORNER_RATIO * float(np.median(every)) / 1.1774

    def kept(view: View, off: Floats) -> View:
        good = off <= limit_px
        return View(view.ids[good], view.pixels[good])

    return [
        BoardPair(kept(pair.left, left), kept(pair.right, right))
        for pair, (left, right) in zip(pairs, distances, strict=True)
    ]


def repeats(found: Sequence[BoardPair | str]) -> dict[int, int]:
    """The pairs that show the board where an earlier one did: their numbers and the earlier one's.

    They would count as evidence twice: what corners err by together is the same in both.
    """
    seen: dict[int, BoardPair] = {}
    repeated: dict[int, int] = {}
    for number, pair in enumerate(found):
        if isinstance(pair, str):
            continue
        near = (i for i, other in seen.items() if _apart(pair, other) < REPEAT_PX)
        before = next(near, None)
        if before is None:
            seen[number] = pair
        else:
            repeated[number] = before
    return repeated


def _apart(pair: BoardPair, other: BoardPair) -> float:
    """Median distance px of the same corners in two pairs, of the view where it is larger."""
    medians = []
    for here, there in ((pair.left, other.left), (pair.right, other.right)):
        _, a, b = np.intersect1d(here.ids, there.ids, assume_unique=True, return_indices=True)
        if not len(a):
            return float("inf")
        medians.append(np.median(np.linalg.norm(here.pixels[a] - there.pixels[b], axis=1)))
    return float(max(medians))


class _Selection:
    """Which pairs are still in, and why the others are not."""

    def __init__(self, found: Sequence[BoardPair | str], names: Sequence[str]) -> None:
        self.found = found
        self._names = names
        self.reasons = {i: pair for i, pair in enumerate(found) if isinstance(pair, str)}
        self.good = {i: pair for i, pair in enumerate(found) if isinstance(pair, BoardPair)}
        for i, before in repeats(found).items():
            self.reasons[i] = f"shows the board where {names[before]} does"
            del self.good[i]

    def pairs(self) -> list[BoardPair]:
        """The pairs that are in; raises CalibrationError when they are too few."""
        if len(self.good) < MIN_PAIRS:
            listed = "".join(f"\n  {self._names[i]}: {text}" for i, text in self.reasons.items())
            raise CalibrationError(
                f"{len(self.good)} usable pairs of {len(self.found)}, at least {MIN_PAIRS} are "
                f"needed; take more pictures with the board in both views{listed}"
            )
        return list(self.good.values())

    def leave_out(self, errors_px: Floats, ratio: float, floor_px: float, what: str) -> bool:
        """Put out the pairs with large errors; whether there were any."""
        limit_px = max(ratio * float(np.median(errors_px)), floor_px)
        bad = [
            (i, error) for i, error in zip(self.good, errors_px, strict=True) if error > limit_px
        ]
        for i, error in bad:
            self.reasons[i] = f"{what} {error:.2f} px, limit {limit_px:.2f} px"
            del self.good[i]
        return bool(bad)

    def leave_out_corners(self, cleaned: Sequence[BoardPair]) -> None:
        """Take the pairs as `cleaned`; put out those of which too much was cleaned away."""
        for i, pair in zip(list(self.good), cleaned, strict=True):
            whole = self.found[i]
            assert isinstance(whole, BoardPair)
            stray = corner_count(whole) - corner_count(pair)
            if stray > LARGEST_STRAY_SHARE * corner_count(whole):
                self.reasons[i] = (
                    f"{stray} of {corner_count(whole)} corners lie further off than noise puts them"
                )
                del self.good[i]
            else:
                self.good[i] = pair


def calibrate_stereo(
    left_paths: Sequence[Path],
    right_paths: Sequence[Path],
    *,
    board: Board,
    device: str,
    working_distance_m: float | None = None,
    progress: Progress = ignore_progress,
) -> Calibrated:
    """Calibrate a rig from pairs of pictures of a board.

    Left out, with the reason kept in the result: pairs without the board; pairs that repeat an
    earlier one; pairs that contradict the others grossly (`misfits`); single corners six standard
    deviations off; pairs whose residual then exceeds three times the median and half a pixel.

    working_distance_m: where the uncertainty is stated; None: at the median distance of the boards.
    Raises CalibrationError when the pictures cannot be used, fewer than MIN_PAIRS pairs remain, or
    they do not determine the rig.
    """
    found, size = find_pairs(left_paths, right_paths, board, progress)
    selection = _Selection(found, [path.name for path in left_paths])
    points = board_points(board)
    residuals: dict[int, Floats] = {}
    try:
        pairs = selection.pairs()
        left = single_lens([pair.left for pair in pairs], points, size)
        right = single_lens([pair.right for pair in pairs], points, size)
        errors_px, _ = misfits(pairs, points, left, right)
        selection.leave_out(errors_px, MISFIT_RATIO, MISFIT_FLOOR_PX, MISFIT)
        while True:
            fit = fit_pairs(selection.pairs(), points, size)
            for _ in range(CORNER_ROUNDS):
                selection.leave_out_corners(without_stray_corners(fit, selection.pairs()))
                fit = fit_pairs(selection.pairs(), points, size)
            rms_px = fit.pair_rms_px()
            residuals.update(zip(selection.good, rms_px, strict=True))
            worst = rms_px.max(axis=1)
            if not selection.leave_out(worst, OUTLIER_RATIO, OUTLIER_FLOOR_PX, "residual"):
                break
        uncertainty = state_uncertainty(
            fit,
            selection.pairs(),
            points,
            size=size,
            distance_m=working_distance_m,
            progress=progress,
        )
        if uncertainty.depth_std_m > LARGEST_DEPTH_SHARE * uncertainty.working_distance_m:
            raise NotDeterminedError(
                f"depth at {1e3 * uncertainty.working_distance_m:.0f} mm is uncertain by "
                f"{1e3 * uncertainty.depth_std_m:.0f} mm"
            )
    except (cv2.error, NotDeterminedError) as error:
        said = error.err if isinstance(error, cv2.error) else str(error)
        raise CalibrationError(
            f"the {len(selection.good)} pairs do not determine the rig ({said}); tilt the board "
            "differently from picture to picture"
        ) from error
    stray = {
        i: corner_count(whole) - corner_count(selection.good[i])
        for i, whole in enumerate(found)
        if isinstance(whole, BoardPair) and i in selection.good
    }
    calibration = StereoCalibration(
        device=device,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        code_version=version("flexsheet"),
        opencv_version=cv2.__version__,
        width_px=size[0],
        height_px=size[1],
        left=lens_of(fit.rig[LEFT]),
        right=lens_of(fit.rig[RIGHT]),
        right_from_left=right_from_left_of(fit.rig),
        board=board,
        reprojection_rms_px=fit.rms_px(),
        uncertainty=uncertainty,
        pairs=tuple(
            PairResidual(
                left=left_path.name,
                right=right_path.name,
                used=i in selection.good,
                reason=selection.reasons.get(i, ""),
                left_rms_px=float(residuals[i][0]) if i in residuals else None,
                right_rms_px=float(residuals[i][1]) if i in residuals else None,
                stray_corners=stray.get(i, 0),
            )
            for i, (left_path, right_path) in enumerate(zip(left_paths, right_paths, strict=True))
        ),
    )
    return Calibrated(calibration, fit, selection.good, size)


def state_uncertainty(
    fit: Fit,
    pairs: Sequence[BoardPair],
    points: Floats,
    *,
    size: tuple[int, int],
    distance_m: float | None,
    progress: Progress = ignore_progress,
) -> Uncertainty:
    """The rig's covariance and what it means for a fingertip `distance_m` away.

    Where refits without some of the pairs scatter more than the covariance says, it is raised to
    what they say.
    """
    if distance_m is None:
        middles = [pose_transform(pose) @ [*points.mean(axis=0), 1.0] for pose in fit.poses]
        distance_m = float(np.median([middle[2] for middle in middles]))
    slopes = position_slopes(fit.rig, view_of_work(fit.rig, size, distance_m))
    refits = jackknife_covariance(fit, pairs, points, progress)
    stated = float(np.hypot(*position_spread(slopes, fit.covariance)))
    ratio = float(np.hypot(*position_spread(slopes, refits))) / stated
    covariance = fit.covariance * max(1.0, ratio) ** 2
    depth_m, lateral_m = position_spread(slopes, covariance)
    return Uncertainty(
        corner_sigma_px=fit.sigma_px,
        jackknife_ratio=ratio,
        working_distance_m=distance_m,
        depth_std_m=depth_m,
        lateral_std_m=lateral_m,
        parameters=PARAMETERS,
        covariance=covariance,
    )


def lens_of(numbers: Floats) -> Lens:
    """A lens's eight numbers as a scene's part."""
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(number) for number in numbers)
    return Lens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=(k1, k2, p1, p2, 0.0))
