"""Predict the errors of a commissioned laboratory from the uncertainties of its calibrations.

The scene describes the devices as they were calibrated. Random apparatuses (true parameters) are
drawn that could equal the real devices: deviations with the covariances of the calibrations, and
with the tolerances below for what no step measures. All errors of the sheet, image, force and
fingertip follow from one such apparatus, so that errors that several devices have in common are
counted once. Only files of the commissioning are read, not the true parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import brentq

from flexsheet.launch.calibration.bundle import LEFT, RIGHT, STAND
from flexsheet.launch.calibration.edge_fit import BASE, COMPLIANCE, EDGE, JOINTS
from flexsheet.launch.calibration.uncertainty import compute_position_jacobian
from flexsheet.launch.experiments.node_calibrations import NodeCalibrations
from flexsheet.launch.experiments.offline import (
    ALL_METRICS,
    Metric,
    OfflineEvaluator,
    metric_tolerances,
)
from flexsheet.messages.apparatus import Apparatus, ArmTruth, FingerTruth, nominal_apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, vector_from_rotation
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.rig import make_true_camera

Floats = NDArray[np.float64]
Random = np.random.Generator

DRAWS = 12
DRAW_SEED = 20_000
PIXEL_M = 0.0025
"""Resolution of the predicted images. Their error is the mean over a hundred mm²."""

CELLS = 16
"""Number of node intervals per side of the sheet's mesh in a prediction."""

NORMAL_95 = 1.645
"""95 % quantile of the standard normal distribution."""

RADIUS_STD_M = 3e-4
"""Calliper on a soft fingertip."""

EYE_STD_M = 5e-3
"""Head tracker, per axis, unless a step measures the eyes."""

STAMP_STD_S = 3e-3
"""Exposure time minus timestamp, unless a step measures it: within half an exposure of 10 ms."""

THICKNESS_GRADIENT_STD, DENSITY_STD_RATIO = 0.03, 0.04
"""Rubber sheets by ISO 3302-1 class M1, and density of natural rubber compounds."""

FRICTION, FRICTION_STD_LN = 1.24, 0.3
"""Friction coefficient between rubber and a finger at 1 N (Seo et al. 2009)."""

CREEP_RATIO_PER_DECADE, CREEP_STD = 0.05, 0.02
"""Relative decrease of the force of natural rubber per decade of time."""

MAX_HYSTERESIS_RATIO = 0.9


class PredictedError(LimitedModel):
    """Predicted error of one metric, in the unit of the metric.

    typical: root mean square. limit_95: 95 % quantile. tolerance: tolerance of the scene.
    """

    typical: float
    limit_95: float
    tolerance: float
    within: bool = Field(description="whether the 95 % quantile is within the tolerance")


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Results of a commissioning from which errors are predicted.

    calibrations: calibration files of the nodes. edges: covariances (19, 19) of the unknowns of
    `fit_edges` by side, or empty. projector_px2: covariance (2, 2) of the image's displacement.
    eyes_m2: covariance (3, 3) of the eyes. stamp_std_s: see STAMP_STD_S.
    """

    scene: Scene
    calibrations: NodeCalibrations
    edges: Mapping[str, Floats]
    projector_px2: Floats
    eyes_m2: Floats
    stamp_std_s: float


def predict_errors(
    known: Knowledge, tracking_m: float, *, draws: int = DRAWS
) -> dict[Metric, PredictedError]:
    """Predict the errors of sheet and fingertip during a stroke, and of image and force at rest.

    tracking_m: mean error of the sheet that the devices themselves report during a stroke. It is
    independent of the errors of the calibrations, and is added to them in quadrature.
    """
    random = np.random.default_rng(DRAW_SEED)
    scene = known.scene
    given = known.calibrations
    if given.stereo is not None:
        # The drawn apparatuses have the camera that the simulator assumes for the scene.
        true = make_true_camera(scene.camera)
        exact = {
            "left": true.left, "right": true.right, "right_from_left": true.right_from_left,
        }  # fmt: skip
        given = NodeCalibrations(given.stereo.model_copy(update=exact), given.sheet, given.marker)
    evaluator = OfflineEvaluator(scene, given, metres_per_px=PIXEL_M, cells=CELLS)
    metrics = ALL_METRICS if scene.projector is not None else ALL_METRICS - {Metric.IMAGE}
    drawn = [
        evaluator.evaluate(draw_apparatus(known, random), metrics).figures() for _ in range(draws)
    ]
    tolerances = metric_tolerances(scene)
    predicted = {}
    for metric in Metric:
        errors = np.array([one[metric] for one in drawn if one[metric] is not None])
        if not len(errors):
            continue
        if metric is Metric.SHEET:
            errors = np.hypot(errors, 1e3 * tracking_m)
        # The quantile of a length with normal components: of few draws, it is more certain than
        # an empirical one.
        high = float(errors.mean() + NORMAL_95 * errors.std(ddof=1))
        predicted[metric] = PredictedError(
            typical=float(np.sqrt(np.mean(errors**2))),
            limit_95=high,
            tolerance=tolerances[metric],
            within=high <= tolerances[metric],
        )
    return predicted


def draw_apparatus(known: Knowledge, random: Random) -> Apparatus:
    """Draw an apparatus that is consistent with what is known about the devices."""
    scene, given = known.scene, known.calibrations
    apparatus = nominal_apparatus(scene)
    seen_m = dict.fromkeys(("left", "right"), np.zeros(3))
    if given.stereo is not None:
        seen_m = draw_camera_errors(scene, given.stereo, random)
    arms = {
        side: draw_arm(getattr(apparatus.arms, side), known.edges.get(side), seen_m[side], random)
        for side in ("left", "right")
    }
    sheet = apparatus.sheet.model_copy(
        update={
            "thickness_gradient_ratio": _tuple(THICKNESS_GRADIENT_STD * random.standard_normal(2)),
            "density_kg_per_m3": scene.sheet.density_kg_per_m3
            * (1.0 + DENSITY_STD_RATIO * float(random.standard_normal())),
            "friction_coefficient": FRICTION
            * float(np.exp(FRICTION_STD_LN * random.standard_normal())),
            "creep_ratio_per_decade": max(
                CREEP_RATIO_PER_DECADE + CREEP_STD * float(random.standard_normal()), 0.0
            ),
        }
        | draw_rubber(known, random)
    )
    finger = apparatus.finger.model_copy(
        update={
            "radius_offset_m": RADIUS_STD_M * float(random.standard_normal()),
            "marker_from_pad_m": draw_marker(scene, given, random),
        }
    )
    projector = apparatus.projector
    shift_px = _draw(known.projector_px2, random)
    projector = projector.model_copy(
        update={"lens": projector.lens.model_copy(update={"centre_offset_px": _tuple(shift_px)})}
    )
    stamp_s = known.stamp_std_s * float(random.standard_normal())
    drawn = apparatus.model_copy(
        update={
            "arms": apparatus.arms.model_copy(update=arms),
            "sheet": sheet,
            "finger": finger,
            "projector": projector,
            "camera": apparatus.camera.model_copy(update={"stamp_offset_s": stamp_s}),
            "eyes": apparatus.eyes.model_copy(
                update={"centre_offset_m": _tuple(_draw(known.eyes_m2, random))}
            ),
        }
    )
    return drawn if given.sheet is None else draw_hysteresis(drawn, given.sheet, random)


def draw_camera_errors(
    scene: Scene, calibration: StereoCalibration, random: Random
) -> dict[str, Floats]:
    """Draw the errors (3,), m, of measured positions at the clamps, relative to the finger.

    An error that clamps and finger share displaces both, so that only the difference counts.
    """
    left, right, stand = calibration.left, calibration.right, calibration.right_from_left
    rig = np.zeros(22)
    for part, lens in ((LEFT, left), (RIGHT, right)):
        rig[part] = [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion[:4]]
    rig[STAND] = [*vector_from_rotation(stand[:3, :3]), *stand[:3, 3]]
    sheet = scene.sheet
    half_m = 0.25 * (sheet.min_stretch_ratio + sheet.max_stretch_ratio) * sheet.width_m
    world = np.array([[0.0, 0.0, 0.0], [-half_m, 0.0, 0.0], [half_m, 0.0, 0.0]])
    world_from_left = pose_matrix(scene.camera.world_from_left)
    slopes = compute_position_jacobian(rig, apply(inverse(world_from_left), world))
    assert calibration.uncertainty is not None
    drawn = _draw(np.asarray(calibration.uncertainty.covariance), random)
    centre, *clamps = (slopes @ drawn) @ world_from_left[:3, :3].T
    return {side: at - centre for side, at in zip(("left", "right"), clamps, strict=True)}


def draw_arm(arm: ArmTruth, covariance: Floats | None, seen_m: Floats, random: Random) -> ArmTruth:
    """Draw the true parameters of an arm; seen_m: error of its clamp's measured position."""
    if covariance is None:
        return arm
    off = _draw(covariance, random)
    compliance = arm.flange_compliance_m_per_n + float(off[COMPLIANCE])
    return arm.model_copy(
        update={
            "base_rotation_offset_rad": _tuple(off[BASE][:3]),
            "base_position_offset_m": _tuple(off[BASE][3:] - seen_m),
            "joint_offsets_rad": _tuple(np.array(arm.joint_offsets_rad) + off[JOINTS]),
            "edge_rotation_offset_rad": _tuple(off[EDGE][:3]),
            "edge_position_offset_m": _tuple(off[EDGE][3:]),
            "flange_compliance_m_per_n": max(compliance, 0.0),
        }
    )


def draw_rubber(known: Knowledge, random: Random) -> dict[str, float]:
    """Draw errors of the modulus and width of the sheet; none if there is no calibration."""
    sheet = known.calibrations.sheet
    if sheet is None:
        return {}
    modulus, width = sheet.modulus_thickness_n_per_m, sheet.slack_width_m
    return {
        "modulus_ratio": 1.0
        + modulus.standard_deviation / modulus.value * float(random.standard_normal()),
        "slack_width_offset_m": width.standard_deviation * float(random.standard_normal()),
    }


def draw_hysteresis(apparatus: Apparatus, sheet: SheetCalibration, random: Random) -> Apparatus:
    """Return the apparatus with the hysteresis whose forces differ as in the calibration.

    The calibration compares the forces of a push in and out at the same depth. They differ by
    hysteresis and by the creep of the apparatus.
    """
    if sheet.hysteresis_ratio is None:
        return apparatus
    measured = sheet.hysteresis_ratio
    lost = measured.value + measured.standard_deviation * float(random.standard_normal())

    def change(ratio: float) -> Apparatus:
        rubber = apparatus.sheet.model_copy(update={"hysteresis_ratio": ratio})
        return apparatus.model_copy(update={"sheet": rubber})

    def excess(ratio: float) -> float:
        moving_in, moving_out = compute_history_ratios(change(ratio))
        return float(1.0 - moving_out / moving_in) - lost

    if excess(0.0) >= 0.0:
        return change(0.0)
    return change(brentq(excess, 0.0, MAX_HYSTERESIS_RATIO, xtol=1e-4))


def draw_marker(scene: Scene, given: NodeCalibrations, random: Random) -> tuple[float, ...]:
    """Draw the true marker in the finger's frame of the simulator, m."""
    world_m = given.find_marker_offset_m(scene)
    if given.marker is not None:
        world_m = world_m + np.array(given.marker.standard_deviations_m) * random.standard_normal(3)
    units = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    axes = [100.0 * Nail.of(FingerTruth(marker_from_pad_m=unit)).marker_offset_m for unit in units]
    return tuple(np.linalg.solve(np.column_stack(axes), world_m).tolist())


def _draw(covariance: Floats, random: Random) -> Floats:
    """Draw from a normal distribution with mean 0; the covariance may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    scales = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(vectors @ (scales * random.standard_normal(len(values))))


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(float(one) for one in values)
