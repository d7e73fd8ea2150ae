"""Read touches of known points by a finger with a marker from a CSV file, or simulate them.

`flexsheet calibrate marker` uses the touches.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.csv_rows import list_missing, parse_finite, read_table
from flexsheet.launch.calibration.edge_marks import make_detector_config
from flexsheet.launch.calibration.marker_fit import Touch
from flexsheet.launch.plans.documents import Problem
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.rigid import rotation_from_vector
from flexsheet.nodes.triangulator.fingertip import DetectionInput, detect_all
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, TriangulatedPoint
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

REQUIRED = ("marker_x_mm", "marker_y_mm", "marker_z_mm",
            "point_x_mm", "point_y_mm", "point_z_mm", "tilt_x_deg", "tilt_y_deg")  # fmt: skip
NORMAL = ("normal_x", "normal_y", "normal_z")
COLUMNS = (*REQUIRED, *NORMAL)

MAX_TILT_DEG = 120.0
MAX_LENGTH_MM = 5000.0
"""The maximum plausible coordinate (mm). A larger number probably has another unit."""


def read_touches(path: Path, scene: Scene) -> list[Touch]:
    """Read touches (marker positions while the finger touched known points) from a CSV file.

    The document docs/set-up-marker.md lists the columns. Raises BadInputError if the file is
    invalid.
    """
    table = read_table(path, REQUIRED, permitted=COLUMNS)
    if any(name in table.columns for name in NORMAL):
        table.problems.extend(list_missing(table.where, table.columns, NORMAL))
    touches = []
    for number, cells in table.rows:
        found: list[Problem] = []
        values = _parse_row(f"{path}:{number}", cells, found)
        if not found:
            touches.append(_make_touch(values, scene))
        table.problems.extend(found)
    table.check()
    return touches


def _parse_row(where: str, cells: Mapping[str, str], problems: list[Problem]) -> dict[str, float]:
    """Convert the values in a row of the CSV file to numbers by column.

    Append a problem to `problems` for each wrong value.
    """
    values: dict[str, float] = {}
    for name, text in cells.items():
        if not text and name in NORMAL:
            continue
        value = parse_finite(where, name, text, problems)
        limit = {"deg": MAX_TILT_DEG, "mm": MAX_LENGTH_MM}.get(name.rpartition("_")[2], 1.0)
        if abs(value) > limit:
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
                       (30, 0), (20, 20), (-25, 10), (8, 25), (40, 0), (35, 20),
                       (35, -20))  # fmt: skip
"""The orientations of the finger in which the marker is measured before the touches.

Each orientation is given as tilts (degrees) about x and y from the usual orientation of the finger.
"""
TOUCHED_ORIENTATIONS = 6
"""The number of orientations in which points are touched.

These are the orientations in which the measured marker has the smallest uncertainty.
"""
SIMULATED_POINTS_M = np.array([[x, y, 0.01] for y in (0.0, 0.04) for x in (-0.03, 0.01, 0.05)])
"""The n simulated points (n, 3), in m, that the finger touches: corners of a simulated board."""
SIMULATED_CORNER_M, SIMULATED_HAND_M, SIMULATED_TILT_RAD = 1e-4, 1e-4, math.radians(1.0)
"""The standard deviations per axis of errors of corners (m), pad positions (m) and tilts (rad)."""


def simulate_touches(
    scene: Scene,
    apparatus: Apparatus,
    *,
    calibration: StereoCalibration | None,
    seed: int,
) -> list[Touch]:
    """Simulate touches of known points, and measure the finger's marker with the stereo camera.

    The touches are the data for a fit of the marker's position relative to the fingertip. First,
    the marker is measured at all finger tilts of `SIMULATED_TILTS_DEG`. The tilts are relative to
    the usual orientation of the finger. Then the finger touches each point at the tilts at which
    the measured marker has the smallest uncertainty. A touch is omitted if the detector does not
    accept the marker.

    apparatus: true parameters of the simulated hardware.
    calibration: camera parameters for the detector. If None, the scene's parameters are used.
    """
    geometry = StereoGeometry.of(scene.camera, calibration)
    true_scene = apply_apparatus(scene, apparatus)
    true_camera = make_true_camera(true_scene.camera)
    random = np.random.default_rng(seed)
    usual = Nail.of(apparatus.finger)

    def see(tilt_rad: Floats, point: Floats) -> TriangulatedPoint | None:
        held = tilt_rad + random.normal(0.0, SIMULATED_TILT_RAD, 2)
        turn = rotation_from_vector([*held, 0.0])
        camera = TwinCamera(
            true_camera,
            finger_radius_m=true_scene.finger.radius_m,
            seed=int(random.integers(2**31)),
            nail=Nail(
                turn @ usual.marker_offset_m,
                None if usual.marker_normal is None else turn @ usual.marker_normal,
                turn @ usual.direction,
            ),
        )
        pad = point + random.normal(0.0, SIMULATED_HAND_M, 3)
        return _see_marker(camera, scene, geometry, pad)

    shown = [
        (float(np.trace(found.covariance)), tuple(tilt_rad))
        for tilt_rad in np.radians(SIMULATED_TILTS_DEG)
        if (found := see(tilt_rad, SIMULATED_POINTS_M[1])) is not None
    ]
    best = [np.array(tilt_rad) for _, tilt_rad in sorted(shown)[:TOUCHED_ORIENTATIONS]]
    touches = []
    for point in SIMULATED_POINTS_M:
        measured_point = point + random.normal(0.0, SIMULATED_CORNER_M, 3)
        for tilt_rad in best:
            if (found := see(tilt_rad, point)) is not None:
                turned = world_from_finger(scene.finger.direction_world, tilt_rad)
                touches.append(Touch(found.point_world, measured_point, turned))
    return touches


def _see_marker(
    camera: TwinCamera, scene: Scene, geometry: StereoGeometry, pad: Floats
) -> TriangulatedPoint | None:
    """Return the marker that the detector finds in simulated images, or None.

    pad: position (3,) of the fingertip's pad.
    """
    inputs = DetectionInput(
        camera.picture(lambda _: pad, exposure_s=scene.camera.exposure_s),
        geometry,
        make_detector_config(),
        (scene.finger.volume_min_m, scene.finger.volume_max_m),
    )
    found = detect_all(inputs)
    measured = found.measured
    return measured if found.reason == "ok" else None
