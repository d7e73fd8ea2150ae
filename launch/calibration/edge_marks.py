"""Read, record and simulate positions of marks on the clamps of the sheet.

`flexsheet calibrate edges` uses these positions.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.arm_poses import MAX_STILL_RAD, MIN_STILL_S
from flexsheet.launch.calibration.csv_rows import SIDES, parse_finite, parse_side, read_table
from flexsheet.launch.calibration.edge_fit import EdgeMark, HeldPose
from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.triangulator.fingertip import DetectionInput, DetectorConfig, detect_all
from flexsheet.nodes.triangulator.marker import BlobFilter
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import StereoGeometry
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

JOINT_COLUMNS = tuple(f"{side}_j{number}_deg" for side in SIDES for number in range(1, 7))
COLUMNS = ("pose", "side", "along_mm", "x_mm", "y_mm", "z_mm", *JOINT_COLUMNS)
"""The columns of the CSV file of marks, which has one row for each mark in each pose.

`pose` is the number of the pose, and `side` is the arm. `along_mm` is the position of the mark
along the clamped edge, relative to the edge's centre. The other columns contain the mark's measured
position in the world and the joint angles of both arms.
"""

MAX_PROBLEMS = 20

ALONG = (-0.45, 0.0, 0.45)
"""The positions of the marks relative to the edge's centre, as fractions of the edge's length."""

SIMULATED_POSES = 24
MAX_TRIES = 400
TILT_RAD = np.array([0.5, 0.35, 0.1])
CENTRE_MIN_M, CENTRE_MAX_M = np.array([-0.02, -0.03, -0.02]), np.array([0.02, 0.03, 0.03])
MIN_STRETCH, STRETCH_RANGE = 1.005, 0.9
"""The minimum stretch ratio of the simulated sheet, and the used fraction of the range above it.

The range ends at the maximum stretch ratio in the scene.
"""

SEARCH_M = 0.02
"""The maximum distance (m) between a detected mark and its expected position."""

MIN_NEW_JOINT_RAD = 0.02
"""A pose is new if at least one joint differs by this angle (rad) from each recorded pose."""


def read_edge_marks(path: Path) -> list[HeldPose]:
    """Read the measured marks from a CSV file with the columns `COLUMNS`.

    Raises BadInputError if the file is invalid.
    """
    table = read_table(path, COLUMNS)
    joints: dict[str, tuple[Floats, Floats]] = {}
    marks: dict[str, list[EdgeMark]] = defaultdict(list)
    for number, row in table.rows:
        where, problems = f"{path}:{number}", table.problems
        values = {name: parse_finite(where, name, row[name], problems) for name in COLUMNS[2:]}
        side = parse_side(where, "side", row["side"], problems)
        left, right = np.radians([values[name] for name in JOINT_COLUMNS]).reshape(2, 6)
        joints[row["pose"]] = left, right
        mark_edge_m = 1e-3 * np.array([0.0, values["along_mm"], 0.0])
        position_m = 1e-3 * np.array([values["x_mm"], values["y_mm"], values["z_mm"]])
        marks[row["pose"]].append(EdgeMark(side, mark_edge_m, position_m))
    table.check()
    return [HeldPose(*joints[pose], tuple(marks[pose])) for pose in joints]


def make_detector_config() -> DetectorConfig:
    """Make the settings of a marker detector from the triangulator's default parameters."""
    given = TriangulatorParameters()
    return DetectorConfig(
        blob_filter=BlobFilter(min_contrast=given.marker_min_contrast),
        max_reprojection_px=given.max_reprojection_px,
    )


class MarkDetector:
    """A detector of the marks on the clamps in stereo images."""

    def __init__(self, scene: Scene, calibration: StereoCalibration | None) -> None:
        self._geometry = StereoGeometry.of(scene.camera, calibration)
        self._config = make_detector_config()

    def find(
        self,
        left: Image,
        right: Image,
        *,
        near_world_m: Floats,
        left_origin_px: tuple[int, int] = (0, 0),
        right_origin_px: tuple[int, int] = (0, 0),
    ) -> Floats | None:
        """Return the world position (3,), in m, of the mark near an expected position.

        Return None if no mark or several marks are found near the expected position.

        near_world_m: expected position (3,).
        left_origin_px, right_origin_px: column and row, in the full image, of the first pixel of a
            cropped image.
        """
        inputs = DetectionInput(
            (left, right),
            self._geometry,
            self._config,
            (near_world_m - SEARCH_M, near_world_m + SEARCH_M),
            Gate(near_world_m, SEARCH_M),
            (left_origin_px, right_origin_px),
        )
        found = detect_all(inputs)
        if found.reason != "ok" or found.measured is None:
            return None
        return found.measured.point_world


class EdgeMarkRecorder:
    """A recorder that writes positions of marks on both clamps to a CSV file.

    It records a pose whenever both arms are at rest in a new pose. Joint angles and images must be
    added in the order of their times. All times (s) must come from the same clock.
    """

    def __init__(self, path: Path, scene: Scene, calibration: StereoCalibration | None) -> None:
        self.count = 0
        self._path, self._scene = path, scene
        self._detector = MarkDetector(scene, calibration)
        self._geometries = {side: ArmGeometry(scene, side) for side in SIDES}
        self._joints: dict[Side, Floats] = {}
        self._still_since_s = math.inf
        self._recorded: list[Floats] = []
        with path.open("x", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(COLUMNS)

    def update_joints(self, side: Side, joints_rad: Floats, time_s: float) -> None:
        """Detect motion of one arm from its joint angles (6,), in rad, measured at `time_s`."""
        before = self._joints.get(side)
        if before is None or np.abs(joints_rad - before).max() > MAX_STILL_RAD:
            self._joints[side], self._still_since_s = joints_rad, time_s

    def update_images(self, left: Image, right: Image, exposed_s: float) -> str:
        """Add an image pair, each (h, w), and record the marks if the pose is new.

        Return an instruction to the user, or the reason why the marks were not recorded.

        exposed_s: time of the exposure.
        """
        if len(self._joints) < len(SIDES):
            return "no joint angles of both arms received yet"
        if exposed_s - self._still_since_s < MIN_STILL_S:
            return "the arms are moving"
        joints = np.concatenate([self._joints[side] for side in SIDES])
        if any(np.abs(joints - other).max() < MIN_NEW_JOINT_RAD for other in self._recorded):
            return "a similar pose is already recorded; move and rotate the sheet"
        rows = []
        for side in SIDES:
            edge = self._geometries[side].world_from_edge(self._joints[side])
            for fraction in ALONG:
                mark = np.array([0.0, fraction * self._scene.sheet.height_m, 0.0])
                found = self._detector.find(left, right, near_world_m=apply(edge, mark))
                if found is not None:
                    rows.append([side, *(1e3 * np.array([mark[1], *found])).tolist()])
        if {row[0] for row in rows} != set(SIDES):
            return "no mark is visible on one of the clamps"
        self.count += 1
        self._recorded.append(joints)
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(
                [self.count, *row, *np.degrees(joints).tolist()] for row in rows
            )
        return f"pose {self.count} recorded with {len(rows)} marks; move and rotate the sheet"


def simulate_edge_marks(
    scene: Scene,
    apparatus: Apparatus,
    *,
    calibration: StereoCalibration | None,
    seed: int,
) -> list[HeldPose]:
    """Simulate how the stereo camera measures marks on the clamps of the sheet.

    The arms hold the stretched sheet in random poses. In each pose, every joint is at a random
    angle within its backlash. Marks that the triangulator's detector rejects are omitted.

    apparatus: true parameters of the simulated hardware.
    calibration: camera parameters for the detector. If None, the scene's parameters are used.
    """
    random = np.random.default_rng(seed)
    true_scene = apply_apparatus(scene, apparatus)
    arms = ArmPair(scene, apparatus)
    detector = MarkDetector(scene, calibration)
    camera = TwinCamera(
        make_true_camera(true_scene.camera), finger_radius_m=true_scene.finger.radius_m, seed=seed
    )
    found: list[HeldPose] = []
    for _ in range(MAX_TRIES):
        if len(found) == SIMULATED_POSES:
            break
        edges = _draw_edges(scene, random)
        try:
            joints = arms.solve_joints(edges)
        except ValueError:
            continue  # The pose is out of reach: try another random one.
        left, right = (
            0.5 * (arm.backlash_rad or 0.0) * random.uniform(-1.0, 1.0, 6)
            for arm in (apparatus.arms.left, apparatus.arms.right)
        )
        true_edges = arms.hold(edges, play_rad=(left, right))
        marks = _see_marks(scene, camera, detector, edges, true_edges)
        found.append(HeldPose(*joints, tuple(marks)))
    return found


def _draw_edges(scene: Scene, random: np.random.Generator) -> tuple[Floats, Floats]:
    sheet = scene.sheet
    highest = MIN_STRETCH + STRETCH_RANGE * (sheet.max_stretch_ratio - MIN_STRETCH)
    length_m = sheet.width_m * random.uniform(MIN_STRETCH, highest)
    rotation = rotation_from_vector(random.uniform(-TILT_RAD, TILT_RAD))
    return place_edges(transform(rotation, random.uniform(CENTRE_MIN_M, CENTRE_MAX_M)), length_m)


def rest(position: Floats, _time_s: float) -> Floats:
    """Return the position (3,) of a mark that does not move.

    The simulated camera requires the position of a mark as a function of time.
    """
    return position


def _see_marks(
    scene: Scene,
    camera: TwinCamera,
    detector: MarkDetector,
    expected_edges: tuple[Floats, Floats],
    true_edges: tuple[Floats, Floats],
) -> list[EdgeMark]:
    """Return the marks of both clamps that the detector finds in simulated images.

    expected_edges, true_edges: expected and true poses (4, 4) of the left and right clamped edge.
    """
    marks = []
    for side, expected, true in zip(SIDES, expected_edges, true_edges, strict=True):
        for fraction in ALONG:
            mark = np.array([0.0, fraction * scene.sheet.height_m, 0.0])
            images = camera.picture(
                partial(rest, apply(true, mark)), exposure_s=scene.camera.exposure_s
            )
            found = detector.find(*images, near_world_m=apply(expected, mark))
            if found is not None:
                marks.append(EdgeMark(side, mark, found))
    return marks
