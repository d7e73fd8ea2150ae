"""Replace the assumed parameters of a scene by the true parameters of the simulated hardware.

The scene contains the device parameters that the nodes assume. The apparatus contains the
deviations of the simulated devices from these parameters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from flexsheet.messages.apparatus import (
    NOMINAL_DISPLAY_LATENCY_S,
    Apparatus,
    ArmTruth,
    CameraTruth,
    LensTruth,
    devices_of,
)
from flexsheet.messages.scene import ArmSpec, Lens, Pose, Scene, StereoCamera
from flexsheet.messages.types import Frame
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    pose_matrix,
    rotation_from_rpy,
    rotation_from_vector,
    rpy_from_rotation,
    transform,
    vector_from_rotation,
)
from flexsheet.nodes.node import NodeParameters


class SimulatorParameters(NodeParameters):
    """The parameters that all simulator nodes have in common."""

    apparatus: Apparatus | None = Field(
        default=None,
        description="true hardware parameters, set by `--apparatus`; null: the true parameters "
        "equal the parameters in the scene",
    )


def find_display_delay_s(frame: Frame | None, apparatus: Apparatus | None) -> float:
    """Return by how much (s) a frame is displayed later than the renderer assumes.

    The assumed latency is the time from the buffer swap to the display, according to the times in
    the frame. If no frame has been displayed, the nominal latency is used.

    apparatus: true hardware parameters. If it is None, the result is 0.
    """
    if apparatus is None:
        return 0.0
    assumed_s = NOMINAL_DISPLAY_LATENCY_S
    if frame is not None and frame.light_ns and (shown_ns := frame.swapped_ns or frame.drawn_ns):
        assumed_s = 1e-9 * (frame.light_ns - shown_ns)
    return NOMINAL_DISPLAY_LATENCY_S + apparatus.projector.latency_offset_s - assumed_s


def apply_apparatus(scene: Scene, apparatus: Apparatus | None) -> Scene:
    """Return a copy of the scene with the true parameters of the devices.

    apparatus: deviations of the devices from the scene. If it is None, the scene is returned
        unchanged.

    Virtual objects and requirements do not change. The random deviations of an individual camera
    are not included; the function `make_true_camera` adds them.
    """
    if apparatus is None:
        return scene
    base = scene
    if apparatus.nominal is not None:
        names = type(apparatus.nominal).model_fields
        base = scene.model_copy(update={name: getattr(apparatus.nominal, name) for name in names})
    sheet, eyes, projector = apparatus.sheet, apparatus.eyes, apparatus.projector
    slip_m = sum(apparatus.sheet.clamp_slip_m)
    return base.model_copy(
        update={
            "camera": _true_camera(base.camera, apparatus),
            "arms": base.arms.model_copy(
                update={
                    "left": _true_arm(base.arms.left, apparatus.arms.left),
                    "right": _true_arm(base.arms.right, apparatus.arms.right),
                }
            ),
            "sheet": base.sheet.model_copy(
                update={
                    "young_modulus_pa": base.sheet.young_modulus_pa * sheet.modulus_ratio,
                    "thickness_m": base.sheet.thickness_m * sheet.thickness_ratio,
                    "width_m": base.sheet.width_m + sheet.slack_width_offset_m + slip_m,
                    "density_kg_per_m3": (
                        base.sheet.density_kg_per_m3
                        if sheet.density_kg_per_m3 is None
                        else sheet.density_kg_per_m3
                    ),
                }
            ),
            "finger": base.finger.model_copy(
                update={"radius_m": base.finger.radius_m + apparatus.finger.radius_offset_m}
            ),
            "eyes": base.eyes.model_copy(
                update={
                    "centre_world_m": base.eyes.centre_world_m + np.array(eyes.centre_offset_m),
                    "interocular_m": base.eyes.interocular_m + eyes.interocular_offset_m,
                }
            ),
            "projector": None
            if base.projector is None
            else base.projector.model_copy(
                update={
                    "lens": _true_lens(base.projector.lens, projector.lens),
                    "world_from_projector": _shifted_pose(
                        base.projector.world_from_projector,
                        projector.position_offset_m,
                        projector.rotation_offset_rad,
                    ),
                }
            ),
        }
    )


def _true_camera(camera: StereoCamera, apparatus: Apparatus) -> StereoCamera:
    truth = apparatus.camera
    right = camera.right_from_left
    turn, shift = truth.right_rotation_offset_rad, truth.right_position_offset_m
    if any((*turn, *shift)):
        # If the camera is shifted, points in its frame move by the opposite vector.
        right = transform(rotation_from_vector(turn), -np.array(shift)) @ right
    return camera.model_copy(
        update={
            "left": _true_lens(camera.left, truth.left),
            "right": _true_lens(camera.right, truth.right),
            "right_from_left": right,
            "world_from_left": _shifted_pose(
                camera.world_from_left, truth.position_offset_m, truth.rotation_offset_rad
            ),
            "rate_hz": camera.rate_hz if truth.rate_hz is None else truth.rate_hz,
        }
    )


def _true_lens(lens: Lens, truth: LensTruth) -> Lens:
    k1, k2, *others = lens.distortion
    return lens.model_copy(
        update={
            "fx_px": lens.fx_px * truth.focal_ratio,
            "fy_px": lens.fy_px * truth.focal_ratio,
            "cx_px": lens.cx_px + truth.centre_offset_px[0],
            "cy_px": lens.cy_px + truth.centre_offset_px[1],
            "distortion": (k1 + truth.radial_offset[0], k2 + truth.radial_offset[1], *others),
        }
    )


def _true_arm(arm: ArmSpec, truth: ArmTruth) -> ArmSpec:
    return arm.model_copy(
        update={
            "world_from_base": _shifted_pose(
                arm.world_from_base, truth.base_position_offset_m, truth.base_rotation_offset_rad
            ),
            "flange_from_edge": _shifted_pose(
                arm.flange_from_edge, truth.edge_position_offset_m, truth.edge_rotation_offset_rad
            ),
        }
    )


def _shifted_pose(pose: Pose, shift_m: tuple[float, ...], rotation_rad: tuple[float, ...]) -> Pose:
    """Return a pose after a translation in the parent frame and a rotation about its own origin.

    shift_m: translation (3,).
    rotation_rad: rotation vector (3,). With a zero rotation, the angles are exactly unchanged.
    """
    rpy_rad = pose.rpy_rad
    if any(rotation_rad):
        turned = rotation_from_vector(rotation_rad) @ rotation_from_rpy(rpy_rad)
        rpy_rad = rpy_from_rotation(turned)
    return Pose(position_m=pose.position_m + np.array(shift_m), rpy_rad=rpy_rad)


def align_world_to_camera(scene: Scene, apparatus: Apparatus) -> Apparatus:
    """Express the true hardware parameters in the world frame that the stereo camera defines.

    Calibrations define the world frame by the left camera. In this frame, the pose of the camera in
    the scene is exact. Instead of the camera, the arms, the projector and the eyes have a pose
    error, which is the inverse of the camera's original error. The coordinates of the finger's
    path, the finger's tilt and gravity are unchanged.
    """
    nominal = apparatus.nominal or devices_of(scene)
    true_scene = apply_apparatus(scene, apparatus)
    aligned_from_world = pose_matrix(nominal.camera.world_from_left) @ inverse(
        pose_matrix(true_scene.camera.world_from_left)
    )

    def offsets(before: Pose, true: Pose) -> list[tuple[float, ...]]:
        moved = aligned_from_world @ pose_matrix(true)
        turned = vector_from_rotation(moved[:3, :3] @ rotation_from_rpy(before.rpy_rad).T)
        return [tuple((moved[:3, 3] - before.position_m).tolist()), tuple(turned.tolist())]

    arms = {}
    for side in ("left", "right"):
        found = offsets(
            getattr(nominal.arms, side).world_from_base,
            getattr(true_scene.arms, side).world_from_base,
        )
        names = ("base_position_offset_m", "base_rotation_offset_rad")
        arms[side] = getattr(apparatus.arms, side).model_copy(
            update=dict(zip(names, found, strict=True))
        )
    projector = apparatus.projector
    if nominal.projector is not None and true_scene.projector is not None:
        found = offsets(
            nominal.projector.world_from_projector, true_scene.projector.world_from_projector
        )
        names = ("position_offset_m", "rotation_offset_rad")
        projector = projector.model_copy(update=dict(zip(names, found, strict=True)))
    eyes_m = apply(aligned_from_world, true_scene.eyes.centre_world_m[None])[0]
    return apparatus.model_copy(
        update={
            "nominal": nominal,
            "camera": apparatus.camera.model_copy(
                update={
                    name: CameraTruth.model_fields[name].default
                    for name in ("position_offset_m", "rotation_offset_rad")
                }
            ),
            "arms": apparatus.arms.model_copy(update=arms),
            "projector": projector,
            "eyes": apparatus.eyes.model_copy(
                update={"centre_offset_m": tuple((eyes_m - nominal.eyes.centre_world_m).tolist())}
            ),
        }
    )


def check_truth(scene: Scene, apparatus: Apparatus) -> list[tuple[tuple[str, ...], Any, str, str]]:
    """List the parameters of an apparatus that are impossible for the scene.

    An entry is (key, value, problem, remedy).
    """
    base = apparatus.nominal or scene
    hand, sheet, eyes = apparatus.finger, apparatus.sheet, apparatus.eyes
    radius_m = base.finger.radius_m + hand.radius_offset_m
    width_m = base.sheet.width_m + sheet.slack_width_offset_m
    missing = [hand.hand_mass_kg, hand.hand_damping_ratio, hand.hand_stiffness_n_per_m].count(None)
    rules = (
        (radius_m <= 0.0, ("finger", "radius_offset_m"), hand.radius_offset_m,
         f"makes the finger radius {radius_m:g} m",
         "give more than minus the scene's finger.radius_m"),
        (width_m <= 0.0, ("sheet", "slack_width_offset_m"), sheet.slack_width_offset_m,
         f"makes the sheet width {width_m:g} m",
         "give more than minus the scene's sheet.width_m"),
        (base.eyes.interocular_m + eyes.interocular_offset_m < 0.0,
         ("eyes", "interocular_offset_m"), eyes.interocular_offset_m,
         "makes the distance between the eyes negative",
         "give at least minus the scene's eyes.interocular_m"),
        (missing in (1, 2), ("finger", "hand_mass_kg"), hand.hand_mass_kg,
         "hand mass, damping ratio and stiffness are not given together",
         "give all three or none"),
        (hand.tremor_frequency_hz <= 0.5 * hand.tremor_width_hz,
         ("finger", "tremor_width_hz"), hand.tremor_width_hz,
         "makes the tremor band begin below 0 Hz",
         "give less than twice finger.tremor_frequency_hz"),
    )  # fmt: skip
    return [
        (key, value, problem, remedy) for is_wrong, key, value, problem, remedy in rules if is_wrong
    ]
