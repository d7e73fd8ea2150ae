"""Measure the positions of the viewer's eyes from pairs of points that appear aligned to one eye.

The projector shows a cross on the sheet. The viewer closes one eye and moves a bead, which is
between the eye and the sheet, until it covers the cross. The stereo camera measures the positions
of the bead and the cross. The eye is on the straight line through both points, and the lines for
several bead positions intersect at the eye. This method is used in augmented reality (active
alignment, Tuceryan and Navab 2000). It measures the centre of projection of the eye, and needs no
calibration of the projector or the sheet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from flexsheet.launch.calibration.csv_rows import SIDES, parse_finite, parse_side, read_table
from flexsheet.launch.calibration.edge_marks import MarkDetector, rest
from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Eyes, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.membrane import solve
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.truth import apply_apparatus
from flexsheet.nodes.twin.viewer import HeadSway, Viewer

POINTS = ("bead", "cross")
COLUMNS = ("eye", *(f"{point}_{axis}_mm" for point in POINTS for axis in "xyz"))
"""The columns of the CSV file of alignments, which has one row for each alignment.

`eye` is the open eye (left or right). The other columns contain the measured world positions (mm)
of the bead and the cross.
"""

MIN_ALIGNMENTS = 6
OUTLIER_RATIO = 2.0
"""The offset of a cross from its line of sight above which the Huber loss is linear.

The unit is the median offset. Source: Huber, Robust estimation of a location parameter (1964).
"""

MAX_ANGLE_RAD = 0.02
"""The maximum rms angle (rad) between bead and cross, as seen from the fitted eye.

A larger angle indicates that the left and the right eye, or the bead and the cross, were confused
in the CSV file.
"""

MAX_SHIFT_M = 0.3
"""The maximum distance (m) of a measured eye from its position in the scene."""

MIN_DISTANCE_M = 0.05
"""The minimum distance (m) between bead and cross."""

BEADS_M = tuple((x, y, z) for z in (0.10, 0.15) for y in (-0.05, 0.0, 0.05)
                for x in (-0.05, 0.0, 0.05))  # fmt: skip
"""The simulated positions (x, y, z) of the bead in the world, in m, for each eye."""
ALIGNMENT_S = 6.0
"""The time (s) between two simulated alignments."""

HEAD_REST_SWAY_M = 1.5e-3
"""The maximum standard deviation (m) of the head's motion while it is on a chin rest.

The viewer must use a chin rest during the measurement.
"""


class EyesError(FlexsheetError, ValueError):
    """Raised if the alignments do not determine the positions of the eyes."""

    remedy = (
        "Align at least six positions of the bead with each eye, spread over the sheet and at two "
        "distances from it, with the head on a rest."
    )


@dataclass(frozen=True, slots=True)
class Alignment:
    """A bead and a cross that appear at the same point to one eye.

    bead_m, cross_m: measured positions (3,) in the world.
    """

    eye: Side
    bead_m: Floats
    cross_m: Floats


@dataclass(frozen=True, slots=True)
class EyesFit:
    """The fitted positions of both eyes, with their uncertainty.

    angle_rms_rad: rms angle between bead and cross, as seen from the fitted eyes.
    covariance_m2: covariance (3, 3) of the midpoint between the eyes.
    interocular_std_m: standard deviation of the distance between the eyes.
    """

    eyes: Eyes
    angle_rms_rad: float
    covariance_m2: Floats
    interocular_std_m: float


def fit_eyes(alignments: Sequence[Alignment], guess: Eyes) -> EyesFit:
    """Fit the positions of both eyes to alignments, starting from the positions `guess`.

    For each eye, the fit minimizes the distances from the crosses to the lines of sight through the
    beads, with a Huber loss. It does not minimize angles, because angles approach zero for an eye
    at infinity.

    Raises EyesError if the alignments do not determine the eyes.
    """
    positions, covariances, angles = [], [], []
    for sign, side in zip((-0.5, 0.5), SIDES, strict=True):
        given = [one for one in alignments if one.eye == side]
        if len(given) < MIN_ALIGNMENTS:
            raise EyesError(
                f"there are {len(given)} alignments of the {side} eye, but at least "
                f"{MIN_ALIGNMENTS} are required; record more alignments"
            )
        start = guess.centre_world_m + sign * guess.interocular_m * np.eye(3)[0]
        position, covariance, rms_rad = _fit_eye(given, start)
        if np.linalg.norm(position - start) > MAX_SHIFT_M:
            raise EyesError(
                f"the measured {side} eye is {np.linalg.norm(position - start):.2g} m from its "
                f"position in the scene, but at most {MAX_SHIFT_M:g} m are allowed; check "
                "eyes.centre_world_m in the scene, and the columns of the CSV file"
            )
        if rms_rad > MAX_ANGLE_RAD:
            raise EyesError(
                f"{side} eye: the rms angle between bead and cross is {1e3 * rms_rad:.1f} mrad, "
                f"but at most {1e3 * MAX_ANGLE_RAD:.0f} mrad are allowed; check all columns of the "
                "CSV file"
            )
        positions.append(position)
        covariances.append(covariance)
        angles.append(rms_rad)
    left, right = positions
    across = right - left
    distance_m = float(np.linalg.norm(across))
    both = covariances[0] + covariances[1]
    along = across / distance_m
    return EyesFit(
        eyes=Eyes(centre_world_m=0.5 * (left + right), interocular_m=distance_m),
        angle_rms_rad=math.hypot(*angles) / math.sqrt(2.0),
        covariance_m2=0.25 * both,
        interocular_std_m=float(np.sqrt(along @ both @ along)),
    )


def _fit_eye(alignments: Sequence[Alignment], start: Floats) -> tuple[Floats, Floats, float]:
    """Fit the position of one eye, starting from the position `start` (3,).

    In each alignment, the viewer has moved a bead until it covers a projected cross for this eye.
    Returns the position (3,) in m, its covariance (3, 3), and an rms angle (rad). The angle is
    between the directions from the fitted eye to the bead and to the cross.
    """
    beads = np.array([one.bead_m for one in alignments])
    crosses = np.array([one.cross_m for one in alignments])
    if np.linalg.norm(beads - crosses, axis=1).min() < MIN_DISTANCE_M:
        raise EyesError(
            f"{alignments[0].eye} eye: in one alignment, the bead is less than "
            f"{1e3 * MIN_DISTANCE_M:.0f} mm from the projected cross; hold the bead closer to the "
            "eye"
        )

    def offsets(eye: Floats) -> Floats:
        """Return the vectors (n, 3), in m, from the lines of sight to the measured crosses.

        Each vector is perpendicular to its line of sight, which passes through the eye and a bead.
        If the eye position is exact, the line also passes through the cross on the sheet that
        belongs to the bead.

        eye: assumed position (3,) of the eye.
        """
        directions, far = beads - eye, crosses - eye
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        return np.asarray(far - np.einsum("ni,ni->n", far, directions)[:, None] * directions)

    scale_m = 1e-3
    for _ in range(2):
        solved = least_squares(
            lambda eye: offsets(eye).ravel(),
            start,
            loss="huber",
            f_scale=scale_m,
            x_scale=1e-2,
            gtol=1e-15,
            ftol=1e-12,
        )
        lengths_m = np.linalg.norm(offsets(solved.x), axis=1)
        scale_m = OUTLIER_RATIO * max(float(np.median(lengths_m)), 1e-5)
        start = solved.x
    # Each offset has two components, across the line of sight; the eye has three unknowns.
    variance_m2 = float((lengths_m**2).sum()) / (2 * len(lengths_m) - 3)
    covariance = variance_m2 * np.linalg.pinv(solved.jac.T @ solved.jac)
    angles = lengths_m / np.linalg.norm(crosses - solved.x, axis=1)
    return solved.x, covariance, float(np.sqrt(np.mean(angles**2)))


def read_alignments(path: Path) -> list[Alignment]:
    """Read alignments from a CSV file with the columns `COLUMNS`.

    Raises BadInputError if the file is invalid.
    """
    table = read_table(path, COLUMNS)
    found = []
    for number, row in table.rows:
        where, problems = f"{path}:{number}", table.problems
        side = parse_side(where, "eye", row["eye"], problems)
        values = [parse_finite(where, name, row[name], problems) for name in COLUMNS[1:]]
        found.append(Alignment(side, 1e-3 * np.array(values[:3]), 1e-3 * np.array(values[3:])))
    table.check()
    return found


def simulate_alignments(
    scene: Scene, apparatus: Apparatus, *, calibration: StereoCalibration | None, seed: int
) -> list[Alignment]:
    """Simulate how a viewer aligns a bead with crosses on the sheet, and measure the positions.

    The alignment is simulated for each eye and several positions of the bead. The simulated stereo
    camera measures the bead and the cross. The arms hold the flat sheet at the origin of the world.

    The result omits an alignment if the viewer does not see the sheet behind the bead. It also
    omits an alignment if the camera does not detect the bead or the cross.

    apparatus: true parameters of the simulated hardware.
    calibration: camera parameters for the detector. If None, the scene's parameters are used.
    """
    random = np.random.default_rng(seed)
    true_scene = apply_apparatus(scene, apparatus)
    spec = scene.sheet
    distance_m = 0.5 * (spec.min_stretch_ratio + spec.max_stretch_ratio) * spec.width_m
    edges = ArmPair(scene, apparatus).hold(place_edges(np.eye(4), distance_m))
    sheet = solve(true_rubber(true_scene.sheet, apparatus), *edges)
    sway_m = min(apparatus.eyes.sway_m, HEAD_REST_SWAY_M)
    on_rest = apparatus.eyes.model_copy(update={"sway_m": sway_m})
    viewer = Viewer(true_scene, HeadSway.drawn(on_rest, seed), random)
    camera = TwinCamera(
        make_true_camera(true_scene.camera), finger_radius_m=true_scene.finger.radius_m, seed=seed
    )
    detector = MarkDetector(scene, calibration)
    found = []
    for number, (side, place) in enumerate((side, bead) for side in SIDES for bead in BEADS_M):
        bead = np.array(place)
        cross = viewer.align(side, bead, sheet, number * ALIGNMENT_S)
        if cross is None:
            continue
        images = camera.picture(
            partial(rest, bead), exposure_s=scene.camera.exposure_s, lit_points=cross[None]
        )
        seen = [detector.find(*images, near_world_m=point) for point in (bead, cross)]
        if seen[0] is not None and seen[1] is not None:
            found.append(Alignment(side, seen[0], seen[1]))
    return found
