"""Read touches of known points from a CSV file (`flexsheet calibrate marker`), or simulate them."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.calibration.marker_fit import POINT_ERROR_M, Touch, is_sufficient
from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.scene import Scene
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.triangulator.fingertip import DetectorConfig, detect_all
from flexsheet.nodes.triangulator.marker import MARKER_METHODS, BlobFilter
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.triangulation import TRIANGULATION_METHODS, StereoGeometry
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

Floats = NDArray[np.float64]

REQUIRED = ("marker_x_mm", "marker_y_mm", "marker_z_mm",
            "point_x_mm", "point_y_mm", "point_z_mm", "tilt_x_deg", "tilt_y_deg")  # fmt: skip
NORMAL = ("normal_x", "normal_y", "normal_z")
COLUMNS = (*REQUIRED, *NORMAL)

MAX_PROBLEMS = 20
MAX_TILT_DEG = 120.0
MAX_LENGTH_MM = 5000.0
"""Maximum plausible coordinate; a larger number is probably in another unit."""


def read_touches(path: Path, scene: Scene) -> list[Touch]:
    """Read touches from a file; docs/set-up-marker.md lists the columns.

    Raises BadInputError with file, line, column, value and remedy.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(
            [Problem(str(path), (), f"cannot be read: {error}", "give a CSV file in UTF-8")]
        ) from error
    numbered = [
        (number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        remedy = f"start with a line of columns: {', '.join(COLUMNS)}"
        raise BadInputError([Problem(str(path), (), "is empty", remedy)])
    first, header = numbered[0]
    names = [name.strip() for name in next(csv.reader([header]))]
    _check_header(f"{path}:{first}", names)
    problems: list[Problem] = []
    touches = []
    for number, line in numbered[1:]:
        found: list[Problem] = []
        values = _parse_row(f"{path}:{number}", names, next(csv.reader([line])), found)
        if not found:
            touches.append(_make_touch(values, scene))
        problems += found
    if problems:
        raise BadInputError(problems[:MAX_PROBLEMS])
    return touches


def _check_header(where: str, names: list[str]) -> None:
    wanted = COLUMNS if any(name in names for name in NORMAL) else REQUIRED
    problems = [
        Problem(where, (name,), "unknown column", did_you_mean(name, COLUMNS))
        for name in names
        if name not in COLUMNS
    ]
    problems += [
        Problem(where, (name,), "missing column", "add it") for name in wanted if name not in names
    ]
    problems += [
        Problem(where, (name,), "duplicate column", "remove one")
        for name in dict.fromkeys(names)
        if names.count(name) > 1
    ]
    if problems:
        raise BadInputError(problems)


def _parse_row(
    where: str, names: list[str], cells: list[str], problems: list[Problem]
) -> dict[str, float]:
    """Return the values of a row by column; append errors in the row to `problems`."""
    if len(cells) != len(names):
        what = f"expected {len(names)} values, found {len(cells)}"
        problems.append(Problem(where, (), what, "give one value per column"))
        return {}
    values: dict[str, float] = {}
    for name, cell in zip(names, cells, strict=True):
        text = cell.strip()
        if not text and name in NORMAL:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        limit = {"deg": MAX_TILT_DEG, "mm": MAX_LENGTH_MM}.get(name.rpartition("_")[2], 1.0)
        if not math.isfinite(value):
            what = f'expected a finite number, found "{text}"'
            problems.append(Problem(where, (name,), what, "measure this touch again, or remove it"))
        elif abs(value) > limit:
            what = f"expected a magnitude of at most {limit:g}, found {text}"
            problems.append(Problem(where, (name,), what, "check the unit"))
        values[name] = value
    given = [name for name in NORMAL if name in values]
    if not problems and given:
        length = math.hypot(*(values.get(name, 0.0) for name in NORMAL))
        if len(given) < len(NORMAL) or abs(length - 1.0) > 0.01:
            what = f"the normal has {len(given)} components and the length {length:.3g}"
            problems.append(Problem(where, NORMAL[:1], what, "give a unit vector, or no value"))
    return values


def _make_touch(values: dict[str, float], scene: Scene) -> Touch:
    def lengths(name: str) -> Floats:
        return 1e-3 * np.array([values[f"{name}_{axis}_mm"] for axis in "xyz"])

    tilt_rad = np.radians([values["tilt_x_deg"], values["tilt_y_deg"]])
    return Touch(
        marker_m=lengths("marker"),
        point_m=lengths("point"),
        world_from_finger=world_from_finger(scene.finger.direction_world, tilt_rad),
        normal=np.array([values[name] for name in NORMAL]) if NORMAL[0] in values else None,
    )


SIMULATED_TILTS_DEG = ((0, 0), (-20, 0), (15, 0), (0, -25), (0, 25), (-15, -20), (-15, 20),
                       (12, -18), (12, 18), (0, 12), (10, 10), (-10, 10), (20, 0), (0, -12),
                       (10, -10), (-10, -10), (-10, 0), (25, 10), (25, -10), (0, 18),
                       (30, 0), (20, 20), (-25, 10), (8, 25))  # fmt: skip
"""Orientations that are tried, like a person would, until MAX_TOUCHES show the marker."""
MORE_TILTS_DEG = tuple((x, y) for x in (-45, -30, 30, 45) for y in (-40, -20, 0, 20, 40))
"""Further orientations, tried only until the touches suffice for the fit."""
MAX_TOUCHES = 15
SIMULATED_POINT_M = np.array([0.01, 0.02, 0.01])
SIMULATED_HAND_M, SIMULATED_TILT_RAD = 1e-4, math.radians(1.0)
"""Standard deviations of the simulated pad's position and of the finger's angles."""


def simulate_touches(
    scene: Scene,
    apparatus: Apparatus,
    *,
    calibration: StereoCalibration | None,
    seed: int,
) -> list[Touch]:
    """Simulate touches of a known point that the simulated stereo camera observes.

    The orientations of `SIMULATED_TILTS_DEG`, relative to the usual orientation of the finger, are
    used in sequence, and then those of `MORE_TILTS_DEG` while the touches are too few. The fit
    takes the usual one for `direction_world`, so that its offset is right in use.
    The marker positions are those that the triangulator's detector finds; a touch whose
    marker it does not accept is left out. calibration: optics that the detector uses; None: the
    scene's optics.
    """
    geometry = StereoGeometry.of(scene.camera, calibration)
    true_scene = apply_apparatus(scene, apparatus)
    random = np.random.default_rng(seed)
    usual = Nail.of(apparatus.finger)
    measured_point = SIMULATED_POINT_M + random.normal(0.0, POINT_ERROR_M, 3)
    touches = []
    for number, tilt_deg in enumerate((*SIMULATED_TILTS_DEG, *MORE_TILTS_DEG)):
        if number >= len(SIMULATED_TILTS_DEG) and is_sufficient(touches):
            break
        tilt_rad = np.radians(tilt_deg)
        held = tilt_rad + random.normal(0.0, SIMULATED_TILT_RAD, 2)
        turn = rotation_from_vector([*held, 0.0])
        camera = TwinCamera(
            make_true_camera(true_scene.camera),
            finger_radius_m=true_scene.finger.radius_m,
            seed=seed + number,
            nail=Nail(
                turn @ usual.marker_offset_m,
                None if usual.marker_normal is None else turn @ usual.marker_normal,
                turn @ usual.direction,
            ),
        )
        pad = SIMULATED_POINT_M + random.normal(0.0, SIMULATED_HAND_M, 3)
        seen = _see_marker(camera, scene, geometry, pad)
        if seen is not None:
            turned = world_from_finger(scene.finger.direction_world, tilt_rad)
            touches.append(Touch(seen, measured_point, turned))
        if len(touches) == MAX_TOUCHES:
            break
    return touches


def _see_marker(
    camera: TwinCamera, scene: Scene, geometry: StereoGeometry, pad: Floats
) -> Floats | None:
    """Return the detected marker position (3,) for a pad position; None if it is not accepted."""
    left, right = camera.picture(lambda _: pad, exposure_s=scene.camera.exposure_s)
    given = TriangulatorParameters()
    found = detect_all(
        left,
        right,
        geometry=geometry,
        config=DetectorConfig(
            blob_filter=BlobFilter(
                min_contrast=given.marker_min_contrast,
                min_area_px=given.marker_min_area_px,
                max_area_px=given.marker_max_area_px,
                window_half_px=given.window_half_px,
            ),
            refine=MARKER_METHODS["subpixel_fit"],
            triangulate=TRIANGULATION_METHODS["dlt"],
            max_reprojection_px=given.max_reprojection_px,
        ),
        volume=(scene.finger.volume_min_m, scene.finger.volume_max_m),
        gate=None,
    )
    measured = found.measured
    return measured.point_world if found.reason == "ok" and measured is not None else None
