"""Predict the display errors in a calibrated laboratory from the uncertainties of the calibrations.

The prediction is a Monte Carlo simulation. It samples apparatuses, which are sets of possible true
parameters of the devices. The true parameters deviate at random from the calibrated parameters in
the scene, with the covariances that the calibrations state. For a parameter that no calibration
measures, this module defines a standard deviation. All errors of the sheet, image, force and
fingertip are computed from the same samples, so an error with a common cause is counted once. The
true parameters of simulated devices are not used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
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
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, vector_from_rotation
from flexsheet.nodes.twin.force_history import compute_history_ratios
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.rig import make_true_camera

Random = np.random.Generator

DRAWS = 12
DRAW_SEED = 20_000
PIXEL_M = 0.0025
"""The size (m) of a pixel of the predicted images.

Image errors are averages over an area of about 100 mm², so smaller pixels are not needed.
"""

CELLS = 16
"""The number of mesh intervals along each side of the simulated sheet."""

NORMAL_95 = 1.645
"""The 95 % quantile of the standard normal distribution."""

RADIUS_STD_M = 3e-4
"""The standard deviation (m) of a soft fingertip's radius that was measured with a calliper."""

EYE_STD_M = 5e-3
"""The standard deviation (m) per axis of an eye position from a head tracker.

This value is used if no calibration has measured the eyes.
"""

STAMP_STD_S = 3e-3
"""The standard deviation (s) of the difference between exposure time and timestamp.

This value is used if no calibration has measured the difference. It assumes a uniform distribution
within an exposure of 10 ms.
"""

THICKNESS_GRADIENT_STD, SHEET_MASS_STD_RATIO = 0.03, 0.07
"""The standard deviations of the sheet's relative thickness gradient and relative mass per area.

The second value is used if the mass per area was not measured. It combines deviations of 4 % of the
density and 6 % of the thickness. Sources: ISO 3302-1 class M1 for rubber sheets; densities of
natural rubber compounds.
"""

FRICTION, FRICTION_STD_LN = 1.24, 0.3
"""The friction coefficient between rubber and a finger at 1 N, and its uncertainty.

The second value is the standard deviation of the coefficient's natural logarithm. Source: Seo et
al. 2009.
"""

CREEP_RATIO_PER_DECADE, CREEP_STD = 0.05, 0.02
"""The relative decrease of the force of natural rubber per decade of time, and its uncertainty.

The second value is the standard deviation of the first value.
"""

MAX_HYSTERESIS_RATIO = 0.9

IMAGE_MODEL_STD_M = 6e-5
"""The rms image error (m) that remains if all calibrated parameters are exact.

The lens of the projector and the calculated shape of the sheet cause this error. The value was
measured in simulated laboratories with seeds 0 to 11.
"""


class PredictedError(LimitedModel):
    """The predicted error of one quantity, in the unit of this quantity.

    typical: root mean square error.
    limit_95: 95 % quantile of the error.
    tolerance: maximum error that the scene permits.
    """

    typical: float
    limit_95: float
    tolerance: float
    within: bool = Field(
        description="whether the 95 % quantile of the error is within the tolerance"
    )


@dataclass(frozen=True, slots=True)
class Knowledge:
    """The results of calibrations from which errors are predicted.

    calibrations: calibrations that the nodes use.
    edges: covariance (19, 19) of the unknowns of `fit_edges`, by side. If an arm is not calibrated,
        its side is absent.
    projector_px2: covariance (2, 2) of the displacement of the projected image.
    eyes_m2: covariance (3, 3) of the midpoint between the eyes.
    stamp_std_s: standard deviation of the difference between exposure time and timestamp.
    sheet_mass_std_ratio: relative standard deviation of the sheet's mass per area.
    """

    scene: Scene
    calibrations: NodeCalibrations
    edges: Mapping[str, Floats]
    projector_px2: Floats
    eyes_m2: Floats
    stamp_std_s: float
    sheet_mass_std_ratio: float = SHEET_MASS_STD_RATIO


def predict_errors(known: Knowledge, tracking_m: float) -> dict[Metric, PredictedError]:
    """Predict the errors of sheet, image, force and fingertip in a calibrated laboratory.

    The errors of sheet and fingertip apply to a stroke of the finger at the working speed of the
    scene. The errors of image and force apply to a finger at rest.

    tracking_m: mean tracking error of the sheet that the devices report during a stroke. It is
        independent of the sheet error that the calibrations cause. Therefore, the squares of these
        two errors are added.
    """
    random = np.random.default_rng(DRAW_SEED)
    scene = known.scene
    given = known.calibrations
    if given.stereo is not None:
        # All sampled apparatuses have the true camera that the simulator derives from the scene.
        true = make_true_camera(scene.camera)
        exact = {
            "left": true.left, "right": true.right, "right_from_left": true.right_from_left,
        }  # fmt: skip
        given = replace(given, stereo=given.stereo.model_copy(update=exact))
    evaluator = OfflineEvaluator(scene, given, metres_per_px=PIXEL_M, cells=CELLS)
    speed_m_per_s = scene.working_range.speed_m_per_s
    metrics = ALL_METRICS if scene.projector is not None else ALL_METRICS - {Metric.IMAGE}
    drawn = [
        evaluator.evaluate(draw_apparatus(known, random), metrics, speed_m_per_s).figures()
        for _ in range(DRAWS)
    ]
    tolerances = metric_tolerances(scene)
    predicted = {}
    for metric in Metric:
        errors = np.array([one[metric] for one in drawn if one[metric] is not None])
        if not len(errors):
            continue
        if metric is Metric.SHEET:
            errors = np.hypot(errors, 1e3 * tracking_m)
        elif metric is Metric.IMAGE:
            errors = np.hypot(errors, 1e3 * IMAGE_MODEL_STD_M)
        # With few samples, the quantile of a fitted normal distribution is more certain than the
        # empirical quantile.
        high = float(errors.mean() + NORMAL_95 * errors.std(ddof=1))
        predicted[metric] = PredictedError(
            typical=float(np.sqrt(np.mean(errors**2))),
            limit_95=high,
            tolerance=tolerances[metric],
            within=high <= tolerances[metric],
        )
    return predicted


def draw_apparatus(known: Knowledge, random: Random) -> Apparatus:
    """Return random true parameters of the devices that are consistent with the calibrations."""
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
            * (1.0 + known.sheet_mass_std_ratio * float(random.standard_normal())),
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
    stamp_s = known.calibrations.stamp_offset_s
    stamp_s += known.stamp_std_s * float(random.standard_normal())
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
    """Return a random error (3,), in m, of the measured position of each clamp, by side.

    The error is relative to the measured position of the finger. If an error displaces clamp and
    finger equally, it has no effect.
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
    """Return random true parameters of an arm that are consistent with its calibration.

    arm: parameters without errors.
    covariance: covariance (19, 19) of the parameters from `fit_edges`. If it is None, the arm is
        returned unchanged.
    seen_m: error (3,), in m, of the clamp's position if the stereo camera measures it.
    """
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
    """Return a random modulus and a random unstretched width of the sheet.

    The result has the keys `modulus_ratio` and `slack_width_offset_m`. If there is no sheet
    calibration, the result is empty.
    """
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
    """Return the true hardware parameters with a random hysteresis that fits the calibration.

    The calibration measures how much smaller the force is during unloading than during loading at
    the same depth. Creep causes a part of this difference. The hysteresis is chosen to cause the
    remainder.
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
    """Return a random true position (3,), in m, of the marker in the simulator's finger frame."""
    world_m = given.find_marker_offset_m(scene)
    if (marker := given.marker) is not None:
        covariance_m2 = (
            np.diag(np.square(marker.standard_deviations_m))
            if marker.covariance_m2 is None
            else np.array(marker.covariance_m2)
        )
        turned = world_from_finger(scene.finger.direction_world)
        world_m = world_m + turned @ _draw(covariance_m2, random)
    units = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    axes = [100.0 * Nail.of(FingerTruth(marker_from_pad_m=unit)).marker_offset_m for unit in units]
    return tuple(np.linalg.solve(np.column_stack(axes), world_m).tolist())


def _draw(covariance: Floats, random: Random) -> Floats:
    """Return a random vector from a normal distribution with mean 0 and the given covariance.

    The covariance can be singular.
    """
    values, vectors = np.linalg.eigh(covariance)
    scales = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(vectors @ (scales * random.standard_normal(len(values))))


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(float(one) for one in values)
