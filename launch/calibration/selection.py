"""Select the image pairs and corners to trust, and fit the rig to them.

Zhang's method (A flexible new technique for camera calibration, 2000) fits each camera alone. Then
both are fitted together with all numbers free (`bundle`), which fits held-out images better than
fixed intrinsics do.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.bundle import (
    NotDeterminedError,
    RigFit,
    board_pose,
    fit_rig,
    lens_arrays,
    pose_transform,
    pose_vector,
)
from flexsheet.launch.calibration.corners import BoardPair, BoardView, CalibrationError
from flexsheet.nodes.models import rigid

Floats = NDArray[np.float64]

MIN_PAIRS = 5
OUTLIER_RATIO = 3.0
OUTLIER_FLOOR_PX = 0.5
MISFIT_RATIO = 5.0
MISFIT_FLOOR_PX = 5.0
MISFIT = "does not go with the other pairs:"
CORNER_RATIO = 6.0
"""A corner with a larger residual, in standard deviations, is an outlier."""

CORNER_ROUNDS = 2
MAX_OUTLIER_FRACTION = 0.15
"""A pair with a larger fraction of outlier corners is dropped as a whole."""

REPEAT_PX = 1.0
"""Two pairs whose corners differ by less show the board at one pose."""


def single_lens(views: Sequence[BoardView], points: Floats, size: tuple[int, int]) -> Floats:
    """Fit one lens (8,) to its own views of the board, whose corners are `points` (n, 3) m."""
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
    """Return each pair's (n,) deviation from most pairs' estimate of the rig, px rms in the right
    view.

    Each pair alone determines the relative pose of the cameras.  The pair whose estimate suits the
    others best by their median is the reference for all (least median of squares, Rousseeuw 1984).
    Images that do not belong together thus stand out; in a common fit they would distort the rig
    until all pairs looked equally bad.

    left, right: lenses (8,).

    The second result is the reference pair's right_from_left (6,).
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


def fit_pairs(pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]) -> RigFit:
    """Fit both cameras together from the pairs alone; points: the board's corners (n, 3) m."""
    left = single_lens([pair.left for pair in pairs], points, size)
    right = single_lens([pair.right for pair in pairs], points, size)
    _, stand = misfits(pairs, points, left, right)
    poses = np.array([board_pose(pair.left, points, left) for pair in pairs])
    return fit_rig(pairs, points, rig=np.concatenate([left, right, stand]), poses=poses)


def corner_count(pair: BoardPair) -> int:
    """Return the number of corners in both views."""
    return len(pair.left.ids) + len(pair.right.ids)


def drop_outlier_corners(fit: RigFit, pairs: Sequence[BoardPair]) -> list[BoardPair]:
    """Return the pairs without outlier corners.

    The standard deviation follows from the median distance, which outliers do not affect (in a
    plane the median distance is 1.1774 standard deviations).
    """
    distances = [[np.linalg.norm(view, axis=1) for view in views] for views in fit.residuals]
    every = np.concatenate([view for views in distances for view in views])
    limit_px = CORNER_RATIO * float(np.median(every)) / 1.1774

    def kept(view: BoardView, off: Floats) -> BoardView:
        good = off <= limit_px
        return BoardView(view.ids[good], view.pixels[good])

    return [
        BoardPair(kept(pair.left, left), kept(pair.right, right))
        for pair, (left, right) in zip(pairs, distances, strict=True)
    ]


def repeats(found: Sequence[BoardPair | str]) -> dict[int, int]:
    """Return the pairs that repeat an earlier pose: their numbers and the earlier one's.

    They would count twice as evidence, since their common errors are the same in both.
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
    """Return the median distance px of the same corners in two pairs, of the view with the larger
    one."""
    medians = []
    for here, there in ((pair.left, other.left), (pair.right, other.right)):
        _, a, b = np.intersect1d(here.ids, there.ids, assume_unique=True, return_indices=True)
        if not len(a):
            return float("inf")
        medians.append(np.median(np.linalg.norm(here.pixels[a] - there.pixels[b], axis=1)))
    return float(max(medians))


class PairSelection:
    """Hold which pairs remain, and why the others were dropped.

    good: the remaining pairs, by their number.
    reasons: why the others were dropped.
    residuals: of each pair (2,) px rms, left and right, also of dropped pairs.
    """

    def __init__(self, found: Sequence[BoardPair | str], names: Sequence[str]) -> None:
        self.found = found
        self._names = names
        self.residuals: dict[int, Floats] = {}
        self.reasons = {i: pair for i, pair in enumerate(found) if isinstance(pair, str)}
        self.good = {i: pair for i, pair in enumerate(found) if isinstance(pair, BoardPair)}
        for i, before in repeats(found).items():
            self.reasons[i] = f"shows the board where {names[before]} does"
            del self.good[i]

    def pairs(self) -> list[BoardPair]:
        """Return the remaining pairs; raises CalibrationError when they are too few."""
        if len(self.good) < MIN_PAIRS:
            listed = "".join(f"\n  {self._names[i]}: {text}" for i, text in self.reasons.items())
            raise CalibrationError(
                f"{len(self.good)} usable pairs of {len(self.found)}, at least {MIN_PAIRS} are "
                f"needed; take more pictures with the board in both views{listed}"
            )
        return list(self.good.values())

    def leave_out(self, errors_px: Floats, ratio: float, floor_px: float, what: str) -> bool:
        """Drop the pairs with large errors; return whether there were any."""
        limit_px = max(ratio * float(np.median(errors_px)), floor_px)
        bad = [
            (i, error) for i, error in zip(self.good, errors_px, strict=True) if error > limit_px
        ]
        for i, error in bad:
            self.reasons[i] = f"{what} {error:.2f} px, limit {limit_px:.2f} px"
            del self.good[i]
        return bool(bad)

    def leave_out_corners(self, cleaned: Sequence[BoardPair]) -> None:
        """Replace the pairs by `cleaned`; drop those that lost too many corners."""
        for i, pair in zip(list(self.good), cleaned, strict=True):
            whole = self.found[i]
            assert isinstance(whole, BoardPair)
            stray = corner_count(whole) - corner_count(pair)
            if stray > MAX_OUTLIER_FRACTION * corner_count(whole):
                self.reasons[i] = (
                    f"{stray} of {corner_count(whole)} corners lie further off than noise puts them"
                )
                del self.good[i]
            else:
                self.good[i] = pair

    def stray_corners(self, number: int) -> int:
        """Return the number of corners in both views that were removed from a pair."""
        whole = self.found[number]
        if isinstance(whole, str) or number not in self.good:
            return 0
        return corner_count(whole) - corner_count(self.good[number])


def fit_selection(selection: PairSelection, points: Floats, size: tuple[int, int]) -> RigFit:
    """Fit the rig to the trusted pairs and corners; the selection then lists what was dropped.

    Dropped are pairs that contradict the others grossly (`misfits`), single corners six standard
    deviations off, and pairs whose residual then exceeds three times the median and half a pixel.
    Raises CalibrationError when too few pairs remain or they do not determine the rig.
    """
    try:
        pairs = selection.pairs()
        left = single_lens([pair.left for pair in pairs], points, size)
        right = single_lens([pair.right for pair in pairs], points, size)
        errors_px, _ = misfits(pairs, points, left, right)
        selection.leave_out(errors_px, MISFIT_RATIO, MISFIT_FLOOR_PX, MISFIT)
        while True:
            fit = fit_pairs(selection.pairs(), points, size)
            for _ in range(CORNER_ROUNDS):
                selection.leave_out_corners(drop_outlier_corners(fit, selection.pairs()))
                fit = fit_pairs(selection.pairs(), points, size)
            rms_px = fit.pair_rms_px()
            selection.residuals.update(zip(selection.good, rms_px, strict=True))
            worst = rms_px.max(axis=1)
            if not selection.leave_out(worst, OUTLIER_RATIO, OUTLIER_FLOOR_PX, "residual"):
                return fit
    except (cv2.error, NotDeterminedError) as error:
        said = error.err if isinstance(error, cv2.error) else str(error)
        raise not_determined(len(selection.good), said) from error


def not_determined(pairs: int, said: str) -> CalibrationError:
    """Make the error for pairs that do not determine the rig."""
    return CalibrationError(
        f"the {pairs} pairs do not determine the rig ({said}); tilt the board differently from "
        "picture to picture"
    )
