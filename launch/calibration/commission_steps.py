"""Run the steps of `flexsheet commission`, with simulated devices or with captured data.

Simulated devices are calibrated only from simulated measurements: images, joint angles, the forces
of a gauge, and the finger's radius. The fits do not read the true parameters (apparatus).
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.bags.report import BRIEFLY_BUSY_FRACTION
from flexsheet.launch.calibration.capture import Capture
from flexsheet.launch.calibration.commission import (
    APPARATUS_FILE,
    CommissionError,
    Commissioning,
    MissingDataError,
    MissingQuantity,
    NodeValue,
    Step,
    StepName,
    StepResult,
    list_doubts,
)
from flexsheet.launch.calibration.delays import MeasuredLag, measure_in_simulation, read_delays
from flexsheet.launch.calibration.display_latency import (
    DisplayLatencyError,
    estimate_display_latency,
    read_switch_images,
    simulate_switch_images,
)
from flexsheet.launch.calibration.edge_fit import fit_edges
from flexsheet.launch.calibration.edge_marks import read_edge_marks, simulate_edge_marks
from flexsheet.launch.calibration.eyes import fit_eyes, read_alignments, simulate_alignments
from flexsheet.launch.calibration.gray_code import make_patterns
from flexsheet.launch.calibration.prediction import (
    EYE_STD_M,
    SHEET_MASS_STD_RATIO,
    STAMP_STD_S,
    Knowledge,
    predict_errors,
)
from flexsheet.launch.calibration.projector import (
    calibrate_projector as fit_projector,
)
from flexsheet.launch.calibration.projector import (
    measure_points,
)
from flexsheet.launch.calibration.sheet_fit import MAX_RMS_SIGMAS
from flexsheet.launch.calibration.sheet_rows import read_rows
from flexsheet.launch.calibration.stereo import calibrate_stereo
from flexsheet.launch.calibration.touches import read_touches, simulate_touches
from flexsheet.launch.commands import (
    calibrate,
    calibrate_arms,
    calibrate_projector,
    calibrate_rows,
    capture,
)
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.offline import (
    MOVING_METRICS,
    OfflineEvaluator,
    exceeded_tolerances,
)
from flexsheet.launch.experiments.run import require_scene
from flexsheet.launch.experiments.simulated_time import LoopSettings, stroke_in_simulated_time
from flexsheet.launch.plans.apparatus import format_apparatus
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.calibration import (
    Board,
    StereoCalibration,
)
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene, require_projector
from flexsheet.nodes.models.sheet.tension import edge_force_n
from flexsheet.nodes.twin.truth import apply_apparatus

STEREO, ARMS, SHEET, MARKER = "stereo.yaml", "arms.yaml", "sheet.yaml", "marker.yaml"
BOARD = Board(kind="chessboard", columns=9, rows=6, square_m=0.025)
FLANGE_BOARD = Board(kind="chessboard", columns=7, rows=5, square_m=0.015)
"""The calibration board on the flanges of simulated laboratories."""

CALLIPER_M = 3e-4
"""The standard deviation of the simulated measurement of the finger's radius, in metres."""

WEIGHING_RATIO = 0.004
"""The relative standard deviation of the measured mass per area of a simulated sheet.

It results from the errors of the scale (0.2 g) and of the ruler (0.5 mm).
"""

INSTRUCTIONS: dict[StepName, str] = {
    StepName.CAMERA: "capture board images with `flexsheet calibrate stereo --device-source ... "
    "--pictures FOLDER`, and give --data camera=FOLDER",
    StepName.ARMS: "record poses with `flexsheet calibrate capture` to FOLDER/left and "
    "FOLDER/right, and give --data arms=FOLDER",
    StepName.SHEET: "measure pushes as for `flexsheet calibrate sheet --rows`, and give --data "
    "sheet=CSV; weigh the sheet, and give its mass per area with --sheet-kg-per-m2",
    StepName.PROJECTOR: "write the patterns with `flexsheet calibrate projector --write-patterns`, "
    "capture them on the sheet in six poses, and give --data projector=FOLDER",
    StepName.EDGES: "fix three marks on each clamp, record them with `flexsheet calibrate "
    "capture edges`, and give --data edges=CSV",
    StepName.MARKER: "touch known points as for `flexsheet calibrate marker --rows`, and give "
    "--data marker=CSV; give the finger's radius with --finger-radius-mm",
    StepName.EYES: "align a bead with projected crosses, with one eye closed, record the positions "
    "of both, and give --data eyes=CSV",
    StepName.DELAYS: "run `flexsheet experiment stroke --switches 60 --launch FOLDER/launch.yaml "
    "--json` with the launch file of this folder, and give the bag that its output names with "
    "--data delays=BAG",
    StepName.VERIFICATION: "run `flexsheet experiment stroke --launch FOLDER/launch.yaml --json` "
    "with the launch file of this folder, and give its output with --data verification=JSON",
}


def open_laboratory(
    folder: Path,
    launch_file: Path,
    scene_file: Path | None = None,
    apparatus: str | None = None,
    **options: Any,
) -> tuple[Commissioning, Laboratory]:
    """Open or create a folder for the calibration of a whole laboratory (commissioning).

    Return the state of the calibration, and the devices of the laboratory. If the devices are
    simulated, their true parameters are written to an apparatus file in the folder.

    apparatus: apparatus file, or the specification of a random sample, such as "seed:7". None if
        the devices are real.
    options: fields of `Laboratory`.
    """
    plan = load_graph(launch_file)
    if plan.scene_file is None:
        raise CommissionError(f'{launch_file}: missing key "scene"; add a scene file')
    base = scene_file or Path(plan.scene_file)
    # Check the apparatus before the folder is created.
    true = calibrate.load_true_devices(apparatus, load_scene(base), base)
    lab = Commissioning(folder, launch_file, base, apparatus)
    if true is not None:
        write_file(folder / APPARATUS_FILE, format_apparatus(true))
    lab.write()
    return lab, Laboratory(true, **options)


@dataclass(slots=True)
class Laboratory:
    """The devices of one laboratory: simulated devices, or files with the data of real devices.

    apparatus: true parameters of simulated devices, or None if the devices are real. All poses
        refer to the world frame in which the stereo camera has its pose from the scene.
    data: file or folder with the data captured for each calibration step, for real devices.
    board, flange_board: calibration boards for the stereo camera and for the arms.
    finger_radius_m: measured radius of the fingertip, for real devices.
    sheet_kg_per_m2: measured mass per area of a real sheet.
    seconds: duration of the finger's stroke in the verification.
    seed: random seed of the simulation.
    simulated_time: whether to verify simulated devices in simulated time, without a running graph.
    pairs, arm_poses, sheet_poses: numbers of simulated image pairs, arm poses and sheet poses.
    """

    apparatus: Apparatus | None
    data: dict[StepName, Path] = field(default_factory=dict)
    board: Board = BOARD
    flange_board: Board = FLANGE_BOARD
    finger_radius_m: float | None = None
    sheet_kg_per_m2: float | None = None
    seconds: float = 10.0
    seed: int = 1
    simulated_time: bool = False
    pairs: int = 20
    arm_poses: int = 16
    sheet_poses: int = 6

    @property
    def steps(self) -> dict[StepName, Step]:
        """Return the functions that run the steps, by step name."""
        return {
            StepName.CAMERA: self.calibrate_camera,
            StepName.ARMS: self.calibrate_arms,
            StepName.SHEET: self.calibrate_sheet,
            StepName.PROJECTOR: self.calibrate_projector,
            StepName.EDGES: self.calibrate_edges,
            StepName.MARKER: self.calibrate_marker,
            StepName.EYES: self.calibrate_eyes,
            StepName.DELAYS: self.measure_delays,
            StepName.VERIFICATION: self.verify,
        }

    def _find_data(self, step: StepName) -> Path:
        path = self.data.get(step)
        if path is None:
            raise MissingDataError(step, INSTRUCTIONS[step])
        if not path.exists():
            raise CommissionError(f"--data {step}={path}: does not exist; {INSTRUCTIONS[step]}")
        return path

    @contextmanager
    def _folder(self, step: StepName) -> Iterator[Path]:
        """Yield the folder with a step's captured data, or a temporary folder for a simulation."""
        if self.apparatus is None:
            yield self._find_data(step)
            return
        with tempfile.TemporaryDirectory(prefix="flexsheet-commission-") as folder:
            yield Path(folder)

    def _load(self, lab: Commissioning) -> tuple[Scene, StereoCalibration | None]:
        """Load the scene, and also the stereo calibration if the step `camera` is finished."""
        stereo = lab.find_file(STEREO)
        calibration = None if stereo is None else StereoCalibration.load(stereo)
        return load_scene(lab.scene_copy), calibration

    def calibrate_camera(self, lab: Commissioning) -> StepResult:

        scene = load_scene(lab.scene_copy)
        camera = scene.camera
        values: dict[str, Any] = {}
        with self._folder(StepName.CAMERA) as given:
            folder = given if self.apparatus is None else given / "pairs"
            if self.apparatus is not None:
                capture.write_pairs(
                    capture.simulate_views(
                        scene, self.board, self.apparatus, pairs=self.pairs, seed=self.seed
                    ),
                    Capture(
                        self.board,
                        lens=camera.left,
                        size=(camera.width_px, camera.height_px),
                        pairs=self.pairs,
                        still_images=1,
                    ),
                    folder,
                )
                values = {"camera.rate_hz": apply_apparatus(scene, self.apparatus).camera.rate_hz}
            found = calibrate_stereo(
                *(_find_images(folder, side) for side in ("left", "right")),
                board=self.board,
                device=camera.device,
                working_distance_m=calibrate.measure_distance_m(scene),
            ).calibration
        found.save(lab.folder / STEREO)
        assert found.uncertainty is not None
        return StepResult(
            residual=found.reprojection_rms_px,
            unit="px",
            limit=0.3,
            advice="Check that the board is flat and rests in each image; add tilted poses.",
            uncertainty={
                "depth_mm": 1e3 * found.uncertainty.depth_std_m,
                "lateral_mm": 1e3 * found.uncertainty.lateral_std_m,
            },
            scene_values=values,
            parameters={"triangulator.calibration": STEREO},
        )

    def calibrate_arms(self, lab: Commissioning) -> StepResult:

        scene, optics = self._load(lab)
        fits = {}
        with self._folder(StepName.ARMS) as folder:
            for side in calibrate_arms.SIDES:
                poses = folder / side
                if self.apparatus is not None:
                    calibrate_arms.simulate_folder(
                        scene, self.flange_board, side, self.apparatus,
                        folder=folder, places=self.arm_poses, seed=self.seed,
                    )  # fmt: skip
                fits[side], _ = calibrate_arms.fit_folder(
                    poses, self.flange_board, scene, optics, side
                )
        measured = calibrate_arms.make_calibration(fits, scene, self.flange_board)
        measured.save(lab.folder / ARMS)
        uncertainty = {}
        for side, fit in fits.items():
            std_m, std_rad = fit.compute_std(np.zeros(3))
            uncertainty[f"{side}_position_mm"] = 1e3 * std_m
            uncertainty[f"{side}_rotation_mrad"] = 1e3 * std_rad
        return StepResult(
            residual=1e3 * max(fit.arm_sigma_m for fit in fits.values()),
            unit="mm",
            limit=1.0,
            advice="Check that the board is rigid on the flange and that the arm was at rest.",
            uncertainty=uncertainty,
            scene_values=calibrate_arms.list_scene_values(measured),
        )

    def calibrate_sheet(self, lab: Commissioning) -> StepResult:

        scene = load_scene(lab.scene_copy)
        if self.apparatus is None:
            file = self._find_data(StepName.SHEET)
            pushes, lines = read_rows(file, scene.sheet, scene.finger.radius_m)
            source, mass_kg_per_m2 = str(file), self.sheet_kg_per_m2
        else:
            pushes = calibrate_rows.simulate_pushes(scene, self.apparatus, seed=self.seed)
            lines, source = list(range(1, len(pushes) + 1)), f"twin of {scene.name}"
            true = apply_apparatus(scene, self.apparatus).sheet
            weighing = np.random.default_rng([self.seed, 3]).normal(1.0, WEIGHING_RATIO)
            mass_kg_per_m2 = float(true.density_kg_per_m3 * true.thickness_m * weighing)
        found = calibrate_rows.make_sheet_calibration(scene, pushes, lines, source=source)
        modulus, width_m = found.modulus_thickness_n_per_m, round(found.slack_width_m.value, 6)
        wider = width_m / scene.sheet.width_m
        # Stretch ratios refer to the width of the scene, which becomes the measured one.
        found = found.model_copy(
            update={
                "nominal_width_m": width_m,
                "min_stretch_ratio": found.min_stretch_ratio / wider,
                "max_stretch_ratio": found.max_stretch_ratio / wider,
            }
        )
        found.save(lab.folder / SHEET)
        assert found.residual_rms_sigmas is not None
        return StepResult(
            residual=found.residual_rms_sigmas,
            unit="sd",
            limit=MAX_RMS_SIGMAS,
            advice="Tighten the clamps, zero the force gauge, and push more slowly; remove rows "
            "with a sliding finger.",
            uncertainty={
                "modulus_percent": 100.0 * modulus.standard_deviation / modulus.value,
                "slack_width_mm": 1e3 * found.slack_width_m.standard_deviation,
            },
            scene_values=describe_sheet(scene, modulus.value, width_m, mass_kg_per_m2),
            covariances=(
                {} if mass_kg_per_m2 is None else {"sheet_mass_ratio2": [[WEIGHING_RATIO**2]]}
            ),
            parameters={"planner.sheet_calibration": SHEET},
        )

    def calibrate_projector(self, lab: Commissioning) -> StepResult:

        scene = load_scene(lab.scene_copy)
        guess = require_projector(scene)
        camera = calibrate_projector.load_camera(scene, lab.find_file(STEREO))
        if self.apparatus is None:
            patterns = make_patterns(guess.width_px, guess.height_px)
            folder = self._find_data(StepName.PROJECTOR)
            views = list(calibrate_projector.read_views(folder, len(patterns)))
        else:
            true = require_projector(apply_apparatus(scene, self.apparatus))
            views = list(
                calibrate_projector.simulate_views(
                    scene, true, self.apparatus, self.sheet_poses, self.seed
                )
            )
        fit = fit_projector(measure_points(views, camera, guess), guess)
        return StepResult(
            residual=fit.rms_px,
            unit="px",
            limit=0.7,
            advice="Keep the sheet still during each pose, and repeat the step camera.",
            uncertainty={
                "held_out_px": fit.held_out_rms_px,
                "on_sheet_mm": 1e3 * fit.held_out_rms_px * fit.rms_m / max(fit.rms_px, 1e-9),
            },
            scene_values=calibrate_projector.list_scene_values(fit.projector),
            covariances={"shift_px2": fit.shift_covariance_px2.tolist()},
        )

    def calibrate_edges(self, lab: Commissioning) -> StepResult:

        scene, optics = self._load(lab)
        if self.apparatus is None:
            poses = read_edge_marks(self._find_data(StepName.EDGES))
        else:
            poses = simulate_edge_marks(scene, self.apparatus, calibration=optics, seed=self.seed)
        fits = fit_edges(poses, scene)
        uncertainty = {}
        for side, fit in fits.items():
            uncertainty[f"{side}_edge_mm"] = 1e3 * fit.edge_std_m
            uncertainty[f"{side}_compliance_um_per_n"] = 1e6 * fit.compliance_std_m_per_n
        return StepResult(
            covariances={side: fit.covariance.tolist() for side, fit in fits.items()},
            residual=1e3 * max(fit.residual_rms_m for fit in fits.values()),
            unit="mm",
            limit=0.4,
            advice="Check the marks and their fixing; repeat the step arms.",
            uncertainty=uncertainty,
            scene_values=calibrate_rows.list_arm_values(fits),
        )

    def calibrate_marker(self, lab: Commissioning) -> StepResult:

        scene, optics = self._load(lab)
        radius_m = self.finger_radius_m
        if self.apparatus is None:
            file = self._find_data(StepName.MARKER)
            touches, source = read_touches(file, scene), str(file)
        else:
            touches = simulate_touches(scene, self.apparatus, calibration=optics, seed=self.seed)
            source = f"twin of {scene.name}"
            true_m = apply_apparatus(scene, self.apparatus).finger.radius_m
            radius_m = true_m + np.random.default_rng(self.seed).normal(0.0, CALLIPER_M)
        found = calibrate_rows.make_marker_calibration(touches, scene, source)
        found.save(lab.folder / MARKER)
        uncertainty = {
            f"{axis}_mm": 1e3 * deviation_m
            for axis, deviation_m in zip("xyz", found.standard_deviations_m, strict=True)
        }
        return StepResult(
            residual=1e3 * found.residual_rms_m,
            unit="mm",
            limit=0.5,
            advice="Touch again with more different orientations of the finger.",
            uncertainty=uncertainty,
            scene_values=(
                {} if radius_m is None else {"finger.radius_m": calibrate.round_digits(radius_m)}
            ),
            parameters={"triangulator.marker_calibration": MARKER},
        )

    def calibrate_eyes(self, lab: Commissioning) -> StepResult:

        scene, optics = self._load(lab)
        if self.apparatus is None:
            alignments = read_alignments(self._find_data(StepName.EYES))
        else:
            alignments = simulate_alignments(
                scene, self.apparatus, calibration=optics, seed=self.seed
            )
        found = fit_eyes(alignments, scene.eyes)
        centre = [calibrate.round_digits(one) for one in found.eyes.centre_world_m]
        std_mm = 1e3 * np.sqrt(np.diag(found.covariance_m2))
        lateral_mm, depth_mm = float(np.linalg.norm(std_mm[:2])), float(std_mm[2])
        # An eye position error displaces the image of points behind the screen, here at push depth.
        behind_m, distance_m = scene.working_range.push_depth_m, found.eyes.centre_world_m[2]
        across_m = 0.25 * scene.sheet.width_m
        shift_mm = behind_m * math.hypot(lateral_mm, depth_mm * across_m / distance_m)
        return StepResult(
            residual=1e3 * found.angle_rms_rad,
            unit="mrad",
            limit=6.0,
            advice="Use a chin rest, and align again with the bead at other positions.",
            uncertainty={"image_mm": float(shift_mm / (behind_m + distance_m))},
            figures={
                "eyes_lateral_std_mm": lateral_mm,
                "eyes_depth_std_mm": depth_mm,
                "interocular_std_mm": 1e3 * found.interocular_std_m,
            },
            scene_values={
                "eyes.centre_world_m": centre,
                "eyes.interocular_m": calibrate.round_digits(found.eyes.interocular_m),
            },
            covariances={"eyes_m2": found.covariance_m2.tolist()},
        )

    def measure_delays(self, lab: Commissioning) -> StepResult:

        scene, optics = self._load(lab)
        graph, added_s = load_graph(lab.launch_copy), 0.0
        if self.apparatus is None:
            added_s = NodeCalibrations.of(graph).stamp_offset_s
            found = read_delays(self._find_data(StepName.DELAYS), scene, optics, added_s)
        else:
            found = measure_in_simulation(scene, self.apparatus, calibration=optics, seed=self.seed)
        measured = {f"{side}_lag": lag for side, lag in found.servo.items()}
        values = [
            NodeValue(
                node_type="arm_bridge",
                parameter="servo_lag_s",
                value=round(lag.lag_s, 4),
                side=side,
            )
            for side, lag in found.servo.items()
        ]
        stamp = found.stamp_offset
        if stamp is not None:
            measured["stamp_offset"] = stamp
            value = round(stamp.lag_s, 5)
            values.append(NodeValue(node_type="camera", parameter="stamp_offset_s", value=value))
        missing: tuple[MissingQuantity, ...] = ()
        if scene.projector is not None and graph.nodes_of_type("renderer"):
            try:
                latency = self._measure_display_latency(scene, graph, stamp, added_s)
            except DisplayLatencyError as error:
                reason = f"{error}. {error.remedy}"
                missing = (MissingQuantity(quantity="display_latency", reason=reason),)
            else:
                measured["display_latency"] = latency
                value = round(max(latency.lag_s, 0.0), 4)
                values.append(
                    NodeValue(node_type="renderer", parameter="display_latency_s", value=value)
                )
        return StepResult(
            residual=1e3 * max(one.uncertainty_s for one in measured.values()),
            unit="ms",
            limit=4.0,
            advice="Repeat the stroke at the speed of use, and check that both arms follow it.",
            uncertainty={f"{name}_ms": 1e3 * one.uncertainty_s for name, one in measured.items()},
            node_values=tuple(values),
            missing=missing,
            figures={f"{name}_ms": 1e3 * one.lag_s for name, one in measured.items()},
            covariances={} if stamp is None else {"stamp_s2": [[stamp.uncertainty_s**2]]},
        )

    def _measure_display_latency(
        self, scene: Scene, graph: ResolvedGraph, stamp: MeasuredLag | None, added_s: float
    ) -> MeasuredLag:
        """Measure the time from the buffer swap of a frame to the middle of its display.

        stamp: measured offset of the camera's timestamps; None if it is unknown.
        added_s: offset (s) by which the timestamps in the data have already been corrected. Only
            the difference between `stamp` and this offset is still corrected.
        """

        stamp = stamp or MeasuredLag(added_s, STAMP_STD_S)
        offset_s = stamp.lag_s - added_s
        if self.apparatus is None:
            images = read_switch_images(self._find_data(StepName.DELAYS), offset_s)
        else:
            images = simulate_switch_images(
                scene, self.apparatus, seed=self.seed, stamp_offset_s=offset_s
            )
        change = estimate_display_latency(images)
        given = graph.nodes_of_type("renderer")[0].parameters
        # A window shows each frame until the next one. A simulated frame is displayed at once.
        shown_s = 1.0 / given["rate_hz"] if given["output"] == "window" else 0.0
        return MeasuredLag(
            change.lag_s + 0.5 * shown_s,
            math.hypot(change.uncertainty_s, stamp.uncertainty_s),
        )

    def verify(self, lab: Commissioning) -> StepResult:
        """Verify the calibrations by measuring the display errors.

        The errors are measured during a stroke of the finger. In a simulated laboratory, they are
        also measured with a resting finger.
        """

        scene = load_scene(lab.scene_copy)
        if self.apparatus is None:
            stroke = _read_stroke(self._find_data(StepName.VERIFICATION))
            figures: dict[str, Any] = {"stroke": stroke, "flagged": stroke.get("flagged", [])}
        else:
            figures = run_verification(
                lab, self.seconds, self.seed, simulated_time=self.simulated_time
            )
        tracking_mm = figures["stroke"]["delta_d_mm"]["mean"]
        limit_mm = 1e3 * scene.tolerances.sheet_position_m
        predicted = predict_errors(collect_knowledge(lab), 1e-3 * tracking_mm)
        figures["predicted"] = {name: one.model_dump() for name, one in predicted.items()}
        # A stroke in simulated time has no load, because no graph runs.
        busy_fraction = figures["stroke"].get("busy_fraction")
        figures["overloaded"] = busy_fraction is not None and busy_fraction > BRIEFLY_BUSY_FRACTION
        figures["doubts"] = list_doubts(lab.state.steps, figures, (tracking_mm, limit_mm))
        return StepResult(
            residual=tracking_mm,
            unit="mm",
            limit=limit_mm,
            advice="Repeat the steps that the verification names.",
            figures=figures,
        )


def collect_knowledge(lab: Commissioning) -> Knowledge:
    """Collect the calibrations and covariances that are needed to predict errors."""

    covariances: dict[StepName, dict[str, Any]] = {
        name: {key: np.array(one) for key, one in record.result.covariances.items()}
        for name, record in lab.state.steps.items()
        if record.result is not None
    }
    named = {key: one for found in covariances.values() for key, one in found.items()}
    plan = load_graph(lab.launch_copy)
    return Knowledge(
        scene=load_scene(lab.scene_copy),
        calibrations=NodeCalibrations.of(plan),
        edges=covariances.get(StepName.EDGES, {}),
        projector_px2=named.get("shift_px2", np.zeros((2, 2))),
        eyes_m2=named.get("eyes_m2", EYE_STD_M**2 * np.eye(3)),
        sheet_mass_std_ratio=float(
            np.sqrt(named.get("sheet_mass_ratio2", np.array(SHEET_MASS_STD_RATIO**2)).item())
        ),
        stamp_std_s=float(np.sqrt(named.get("stamp_s2", np.array(STAMP_STD_S**2)).item())),
    )


def run_verification(
    lab: Commissioning, seconds: float, seed: int, *, simulated_time: bool
) -> dict[str, Any]:
    """Measure the true display errors in a simulated laboratory, for a moving and a resting finger.

    seconds: duration of the stroke of the finger.
    simulated_time: whether to run the stroke in simulated time, without a graph. If true, the
        self-checks and the errors before calibration are omitted.

    Raises ExperimentError if the stroke fails; finished steps are kept.
    """
    from flexsheet.launch.experiments.trial import run_stroke

    file = str(lab.folder / APPARATUS_FILE)
    if simulated_time:
        plan = load_graph(lab.launch_copy, apparatus=file)
        scene, apparatus = require_scene(plan), plan.apparatus_message()
        assert apparatus is not None
        settings = LoopSettings(seed=seed, calibrations=NodeCalibrations.of(plan))
        stroke: dict[str, Any] = {
            **stroke_in_simulated_time(scene, apparatus, settings, seconds),
            "flagged": [],
        }
        folders = {"after": (lab.launch_copy, lab.scene_copy)}
    else:
        trial = {"launch_file": str(lab.launch_copy), "seconds": seconds}
        stroke = run_stroke(trial, file)
        folders = {
            "before": (lab.launch_file, lab.scene_file),
            "after": (lab.launch_copy, lab.scene_copy),
        }
    at_rest = {}
    for name, (launch_file, scene_file) in folders.items():
        plan = load_graph(launch_file, settings=[f"scene={scene_file}"], apparatus=file)
        scene, apparatus = require_scene(plan), plan.apparatus_message()
        assert apparatus is not None
        evaluator = OfflineEvaluator(scene, NodeCalibrations.of(plan))
        at_rest[name] = evaluator.evaluate(apparatus).figures()
    assert apparatus is not None
    speed_m_per_s = scene.working_range.speed_m_per_s
    moving = evaluator.evaluate(apparatus, MOVING_METRICS, speed_m_per_s).figures()
    return {
        "stroke": stroke,
        "at_rest": at_rest,
        "at_working_speed": {one: moving[one] for one in MOVING_METRICS},
        "co_location": evaluator.compare_crosses(apparatus).figures(),
        "out_of_tolerance": exceeded_tolerances(scene, at_rest["after"]),
        "flagged": stroke["flagged"],
    }


def _find_images(folder: Path, side: str) -> list[Path]:
    found = sorted(one for one in folder.glob(f"{side}*") if one.suffix in (".png", ".jpg"))
    if not found:
        raise CommissionError(f"{folder}: no images {side}*.png or {side}*.jpg; check the folder")
    return found


def _read_stroke(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        float(found["delta_d_mm"]["mean"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommissionError(
            f"--data verification={path}: not a result of `flexsheet experiment stroke --json`: "
            f"{error!r}; save the output of that command"
        ) from error
    return found


def describe_sheet(
    scene: Scene,
    modulus_thickness_n_per_m: float,
    width_m: float,
    mass_kg_per_m2: float | None = None,
) -> dict[str, float]:
    """Return the parameters of a measured sheet as new values for a scene file.

    Each key is a dotted path, such as `sheet.width_m`.

    The step `edges` has measured how far the sheet's tension displaces the flanges. The measured
    sheet has another tension than the sheet in the scene. The flange compliances are therefore
    rescaled, so that the displacement remains as measured.

    modulus_thickness_n_per_m: product of Young's modulus and thickness.
    width_m: width without tension.
    mass_kg_per_m2: mass per area, from which the density is computed. If it is None, the result
        contains no density.
    """
    sheet = scene.sheet
    modulus_pa = modulus_thickness_n_per_m / sheet.thickness_m
    measured = sheet.model_copy(update={"young_modulus_pa": modulus_pa, "width_m": width_m})
    distance_m = 0.5 * (sheet.min_stretch_ratio + sheet.max_stretch_ratio) * sheet.width_m
    before_n, after_n = (edge_force_n(distance_m / one.width_m, one) for one in (sheet, measured))
    values = {"sheet.young_modulus_pa": modulus_pa, "sheet.width_m": width_m}
    if mass_kg_per_m2 is not None:
        values["sheet.density_kg_per_m3"] = mass_kg_per_m2 / sheet.thickness_m
    for side, arm in (("left", scene.arms.left), ("right", scene.arms.right)):
        compliance = arm.flange_compliance_m_per_n * before_n / after_n
        values[f"arms.{side}.flange_compliance_m_per_n"] = compliance
    return values
