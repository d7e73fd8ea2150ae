"""Select reliable image pairs and corners, and fit the stereo rig to them.

Each camera is first fitted alone by Zhang's method (A flexible new technique for camera
calibration, 2000). Then the parameters of both cameras are fitted together (module `bundle`).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flexsheet.launch.calibration.bundle import (
    NotDeterminedError,
    RigFit,
    board_pose,
    fit_rig,
    lens_arrays,
    pose_transform,
    pose_vector,
)
from flexsheet.launch.calibration.corners import (
    BoardPair,
    BoardView,
    CalibrationError,
    measure_shift_px,
)
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import rigid

MIN_PAIRS = 5
OUTLIER_RATIO = 3.0
MIN_OUTLIER_PX = 0.5
MISFIT_RATIO = 5.0
MIN_MISFIT_PX = 5.0
MISFIT = "inconsistent with the other pairs:"
CORNER_RATIO = 6.0
"""The residual, in standard deviations, above which a corner is an outlier."""

CORNER_ROUNDS = 2
MAX_OUTLIER_FRACTION = 0.15
"""An image pair is not used if a larger fraction of its corners are outliers."""

REPEAT_PX = 1.0
"""Two image pairs show the same board pose if the corners' median displacement (px) is smaller."""


def fit_lens(views: Sequence[BoardView], points: Floats, size: tuple[int, int]) -> Floats:
    """Fit fx, fy, cx, cy (px), k1, k2, p1 and p2 (8,) of one camera to its images of the board.

    points: corners of the board (n, 3), m.
    size: width and height of the images, px.
    """
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


def compute_misfits(
    pairs: Sequence[BoardPair], points: Floats, left: Floats, right: Floats
) -> tuple[Floats, Floats]:
    """Compute how much each of n image pairs deviates from a reference pair, to find wrong pairs.

    Each pair alone determines the relative pose of the cameras. The reference is the pair whose
    relative pose has the smallest median deviation from all pairs (least median of squares,
    Rousseeuw 1984). Unlike a fit to all pairs, the reference is not affected by wrong pairs.

    Return the rms deviations (n,), in px of the right image. Also return the pose right_from_left
    (6,) of the reference: a rotation vector (rad) and a translation (m).

    points: corners of the board (n, 3), m.
    left, right: intrinsics (8,): fx, fy, cx, cy (px), k1, k2, p1, p2.
    """
    left_poses = [pose_transform(board_pose(pair.left, points, left)) for pair in pairs]
    right_poses = [pose_transform(board_pose(pair.right, points, right)) for pair in pairs]
    stands = [b @ rigid.inverse(a) for a, b in zip(left_poses, right_poses, strict=True)]
    matrix, distortion = lens_arrays(right)
    errors = np.empty((len(stands), len(pairs)))
    for i, right_from_left in enumerate(stands):
        for j, pair in enumerate(pairs):
            pose = pose_vector(right_from_left @ left_poses[j])
            corners = points[pair.right.ids]
            projected = cv2.projectPoints(corners, pose[:3], pose[3:], matrix, distortion)[0][:, 0]
            shifts = projected - pair.right.pixels
            errors[i, j] = np.sqrt(np.mean(np.sum(shifts * shifts, axis=1)))
    reference = int(np.argmin(np.median(errors, axis=1)))
    return np.asarray(errors[reference]), pose_vector(stands[reference])


def fit_pairs(pairs: Sequence[BoardPair], points: Floats, size: tuple[int, int]) -> RigFit:
    """Fit the stereo rig to the corners of all image pairs.

    The initial values come from fits to each single camera and to each single pair.

    points: corners of the board (n, 3), m.
    size: width and height of the images, px.
    """
    left = fit_lens([pair.left for pair in pairs], points, size)
    right = fit_lens([pair.right for pair in pairs], points, size)
    _, stand = compute_misfits(pairs, points, left, right)
    poses = np.array([board_pose(pair.left, points, left) for pair in pairs])
    return fit_rig(pairs, points, rig=np.concatenate([left, right, stand]), poses=poses)


def count_corners(pair: BoardPair) -> int:
    """Return the total number of detected corners in both images of a pair."""
    return len(pair.left.ids) + len(pair.right.ids)


def drop_outlier_corners(fit: RigFit, pairs: Sequence[BoardPair]) -> list[BoardPair]:
    """Return the image pairs without their outlier corners.

    The standard deviation of the residuals is estimated from their median, because outliers hardly
    affect the median. The median length of normally distributed residuals in two dimensions is
    1.1774 standard deviations.
    """
    distances = [[np.linalg.norm(view, axis=1) for view in views] for views in fit.residuals]
    every = np.concatenate([view for views in distances for view in views])
    limit_px = CORNER_RATIO * float(np.median(every)) / 1.1774

    def select(view: BoardView, error_px: Floats) -> BoardView:
        good = error_px <= limit_px
        return BoardView(view.ids[good], view.pixels[good])

    return [
        BoardPair(select(pair.left, left), select(pair.right, right))
        for pair, (left, right) in zip(pairs, distances, strict=True)
    ]


def find_repeats(found: Sequence[BoardPair | str]) -> dict[int, int]:
    """Find the pairs that repeat the board pose of an earlier pair.

    Return a mapping from the index of the repeated pair to the index of the earlier pair. A
    repeated pair has the same errors as the earlier pair, so it must not count as an independent
    measurement.

    found: corners of each pair, or the reason why no corners were found.
    """
    unique: dict[int, BoardPair] = {}
    repeated: dict[int, int] = {}
    for number, pair in enumerate(found):
        if isinstance(pair, str):
            continue
        near = (
            i
            for i, other in unique.items()
            if measure_shift_px(pair.left, other.left) < REPEAT_PX
            and measure_shift_px(pair.right, other.right) < REPEAT_PX
        )
        before = next(near, None)
        if before is None:
            unique[number] = pair
        else:
            repeated[number] = before
    return repeated


class PairSelection:
    """The image pairs that are used in a calibration, and the reasons why others are excluded.

    found: corners of each pair, or the reason why no corners were found.
    good: corners of each used pair, by index.
    reasons: reason for each excluded pair, by index.
    residuals: for each used or excluded pair, by index, rms residual (2,), in px, of the left and
        the right image.
    """

    def __init__(self, found: Sequence[BoardPair | str], names: Sequence[str]) -> None:
        self.found = found
        self._names = names
        self.residuals: dict[int, Floats] = {}
        self.reasons = {i: pair for i, pair in enumerate(found) if isinstance(pair, str)}
        self.good = {i: pair for i, pair in enumerate(found) if isinstance(pair, BoardPair)}
        for i, before in find_repeats(found).items():
            self.reasons[i] = f"same board pose as {names[before]}"
            del self.good[i]

    def pairs(self) -> list[BoardPair]:
        """Return the usable image pairs. Raises CalibrationError if fewer than MIN_PAIRS exist."""
        if len(self.good) < MIN_PAIRS:
            listed = "".join(f"\n  {self._names[i]}: {text}" for i, text in self.reasons.items())
            raise CalibrationError(
                f"{len(self.good)} of {len(self.found)} pairs are usable, but at least {MIN_PAIRS} "
                f"are required; capture more images with the board in both views{listed}"
            )
        return list(self.good.values())

    def exclude_pairs(self, errors_px: Floats, ratio: float, min_px: float, what: str) -> bool:
        """Exclude pairs with large errors, and return whether any pair was excluded.

        An error is large if it exceeds both `min_px` and `ratio` times the median error.

        errors_px: errors (n,) of the n used pairs.
        what: description of the error, which becomes part of the reason.
        """
        limit_px = max(ratio * float(np.median(errors_px)), min_px)
        bad = [
            (i, error) for i, error in zip(self.good, errors_px, strict=True) if error > limit_px
        ]
        for i, error in bad:
            self.reasons[i] = f"{what} {error:.2f} px, limit {limit_px:.2f} px"
            del self.good[i]
        return bool(bad)

    def replace_pairs(self, cleaned: Sequence[BoardPair]) -> None:
        """Replace the used pairs by pairs from which outlier corners were removed.

        Pairs that have lost too many corners are excluded.
        """
        for i, pair in zip(list(self.good), cleaned, strict=True):
            whole = self.found[i]
            assert isinstance(whole, BoardPair)
            stray = count_corners(whole) - count_corners(pair)
            if stray > MAX_OUTLIER_FRACTION * count_corners(whole):
                self.reasons[i] = f"{stray} of {count_corners(whole)} corners are outliers"
                del self.good[i]
            else:
                self.good[i] = pair

    def stray_corners(self, number: int) -> int:
        """Return how many outlier corners were removed from the used pair with index `number`."""
        whole = self.found[number]
        if isinstance(whole, str) or number not in self.good:
            return 0
        return count_corners(whole) - count_corners(self.good[number])


def fit_selection(selection: PairSelection, points: Floats, size: tuple[int, int]) -> RigFit:
    """Exclude unreliable pairs and corners, and fit the stereo rig to the remaining ones.

    Pairs are excluded if they contradict the other pairs (`compute_misfits`) or have large
    residuals. A pair's residual is large if it exceeds both half a pixel and three times the
    median. Corners are excluded if their residuals exceed six standard deviations.

    points: corners of the board (n, 3), m.
    size: width and height of the images, px.

    Raises CalibrationError if too few pairs remain or if they do not determine the rig.
    """
    try:
        pairs = selection.pairs()
        left = fit_lens([pair.left for pair in pairs], points, size)
        right = fit_lens([pair.right for pair in pairs], points, size)
        errors_px, _ = compute_misfits(pairs, points, left, right)
        selection.exclude_pairs(errors_px, MISFIT_RATIO, MIN_MISFIT_PX, MISFIT)
        while True:
            fit = fit_pairs(selection.pairs(), points, size)
            for _ in range(CORNER_ROUNDS):
                selection.replace_pairs(drop_outlier_corners(fit, selection.pairs()))
                fit = fit_pairs(selection.pairs(), points, size)
            rms_px = fit.pair_rms_px()
            selection.residuals.update(zip(selection.good, rms_px, strict=True))
            worst = rms_px.max(axis=1)
            if not selection.exclude_pairs(worst, OUTLIER_RATIO, MIN_OUTLIER_PX, "residual"):
                return fit
    except (cv2.error, NotDeterminedError) as error:
        reason = error.err if isinstance(error, cv2.error) else str(error)
        raise make_undetermined_error(len(selection.good), reason) from error


def make_undetermined_error(pairs: int, reason: str) -> CalibrationError:
    """Make the error for image pairs that do not determine the parameters of the stereo rig.

    pairs: number of image pairs.
    """
    return CalibrationError(
        f"the {pairs} pairs do not determine the rig ({reason}); change the tilt of the board "
        "between images"
    )
