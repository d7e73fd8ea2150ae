"""Define the apparatus: the true parameters of the simulated hardware.

The nodes assume the parameters in the scene file. The apparatus states how the simulated hardware
deviates from the scene. Only the simulator and the evaluation of experiments read the apparatus.

An offset is the true value minus the value in the scene. A ratio is the true value divided by the
value in the scene. If the hardware does not deviate from the scene, all offsets are zero and all
ratios are one. A rotation offset is a rotation vector about the world's axes, through the origin of
the rotated frame. For the clamped edge of the sheet, the rotation vector is about the flange's
axes.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal, Self

from pydantic import Field

from flexsheet.messages.base import Message
from flexsheet.messages.scene import (
    Arms,
    ArmSpec,
    Eyes,
    Finger,
    Finite,
    NonNegative,
    Part,
    Positive,
    Projector,
    Scene,
    SheetSpec,
    Small,
    SmallSix,
    StereoCamera,
)

Pair = tuple[Finite, Finite]
Triple = tuple[Finite, Finite, Finite]
BelowOne = Annotated[float, Field(ge=0, lt=1)]
SmallTriple = tuple[Small, Small, Small]
NearOne = Annotated[float, Field(ge=0.5, le=2.0)]

ZERO_3 = (0.0, 0.0, 0.0)
ZERO_6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class LensTruth(Part):
    """The deviations of a simulated lens from the lens in the scene."""

    focal_ratio: NearOne = Field(
        default=1.0, description="true focal length divided by the scene's focal length"
    )
    centre_offset_px: Pair = (0.0, 0.0)
    radial_offset: Pair = Field(
        default=(0.0, 0.0), description="true minus nominal distortion coefficients k1 and k2"
    )


class CameraTruth(Part):
    """The deviations of the simulated stereo camera from the stereo camera in the scene."""

    position_offset_m: SmallTriple = ZERO_3
    rotation_offset_rad: SmallTriple = ZERO_3
    left: LensTruth = Field(default_factory=LensTruth)
    right: LensTruth = Field(default_factory=LensTruth)
    right_position_offset_m: SmallTriple = Field(
        default=ZERO_3, description="displacement of the right camera, in its own frame"
    )
    right_rotation_offset_rad: SmallTriple = ZERO_3
    rate_hz: Positive | None = Field(
        default=None, description="true frame rate; null: the frame rate in the scene is used"
    )
    read_out_s: NonNegative | None = Field(
        default=None,
        description="time from the end of exposure to the message; null: the parameter "
        "`transfer_s` of the finger simulator is used",
    )
    skew_s: Annotated[float, Field(ge=-0.05, le=0.05)] = Field(
        default=0.0,
        description="exposure time of the right image minus exposure time of the left image, which "
        "the camera does not report",
    )
    exposure_jitter_s: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=0.0,
        description="standard deviation of the difference between exposure time and timestamp",
    )
    stamp_offset_s: Annotated[float, Field(ge=-0.1, le=0.1)] = Field(
        default=0.0, description="true time of the exposure minus its timestamp"
    )


class ArmTruth(Part):
    """The deviations of a simulated arm from its description in the scene file.

    The behaviour of the arm's controller is also described.
    """

    base_position_offset_m: SmallTriple = ZERO_3
    base_rotation_offset_rad: SmallTriple = ZERO_3
    edge_position_offset_m: SmallTriple = Field(
        default=ZERO_3, description="displacement of the clamped edge, in the flange's frame"
    )
    edge_rotation_offset_rad: SmallTriple = ZERO_3
    joint_offsets_rad: SmallSix = Field(
        default=ZERO_6, description="true joint angles minus the angles that the encoders report"
    )
    flange_compliance_m_per_n: Annotated[float, Field(ge=0, le=1e-2)] = Field(
        default=0.0, description="displacement of the flange per newton of the sheet's tension"
    )
    servo_lag_s: Positive | None = Field(
        default=None,
        description="lag of the arm behind its commands; null: the parameter `servo_lag_s` of "
        "the arm simulator is used",
    )
    command_latency_s: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="time from the arrival of a set-point until it takes effect"
    )
    controller_period_s: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        default=None,
        description="period in which set-points take effect; null: the parameter `cycle_s` of the "
        "arm simulator is used, or the fixed cycle of the protocol mxt",
    )
    controller_jitter_s: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=0.0, description="standard deviation of the start time of each controller cycle"
    )
    backlash_rad: Annotated[float, Field(ge=0, le=0.1)] | None = Field(
        default=None,
        description="backlash of each joint's gear; null: the parameter `backlash_rad` of the "
        "arm simulator is used",
    )

    @classmethod
    def of(cls, arm: ArmSpec) -> Self:
        """Return the parameters of a simulated arm that does not deviate from the scene's arm."""
        return cls(
            joint_offsets_rad=arm.joint_offsets_rad,
            flange_compliance_m_per_n=arm.flange_compliance_m_per_n,
        )


class ArmsTruth(Part):
    left: ArmTruth = Field(default_factory=ArmTruth)
    right: ArmTruth = Field(default_factory=ArmTruth)


class SheetTruth(Part):
    """The deviations of the simulated rubber sheet from the sheet in the scene."""

    modulus_ratio: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    thickness_ratio: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    thickness_gradient_ratio: tuple[Small, Small] = Field(
        default=(0.0, 0.0),
        description="relative change of the thickness from one edge to the other, along x and y",
    )
    slack_width_offset_m: Small = 0.0
    clamp_slip_m: tuple[BelowOne, BelowOne] = Field(
        default=(0.0, 0.0),
        description="length of rubber that slips through the left and right clamp",
    )
    density_kg_per_m3: NonNegative | None = Field(
        default=None,
        description="density of the rubber; null: the density in the scene is used; 0: the "
        "rubber has no weight",
    )
    friction_coefficient: NonNegative | None = Field(
        default=None,
        description="friction coefficient between finger and sheet; null: the finger does not slip",
    )
    hysteresis_ratio: BelowOne = Field(
        default=0.0, description="fraction of the stored energy that is lost in a loading cycle"
    )
    creep_ratio_per_decade: BelowOne = Field(
        default=0.0, description="relative loss of tension per tenfold increase of time"
    )


class FingerTruth(Part):
    """The deviations of the simulated finger, its marker and its motion from the scene.

    The finger frame has its origin at the contact point of the fingertip's pad. All messages use
    this point as the position of the fingertip. The x axis points along the finger towards the
    hand, and the z axis points from the pad to the nail. The y axis is the cross product of the z
    axis and the x axis.
    """

    radius_offset_m: Small = 0.0
    marker_from_pad_m: SmallTriple = Field(
        default=ZERO_3,
        description="true position of the marker's centre, in the finger's frame",
    )
    marker_shape: Literal["ball", "disc"] = Field(
        default="ball",
        description="disc: the marker is flat on the nail, so its image is an ellipse",
    )
    marker_tilt_rad: tuple[Finite, Finite] = Field(
        default=(0.0, 0.0),
        description="tilt of the disc's normal from z, about the finger's x and y axes",
    )
    finger_tilt_rad: tuple[Finite, Finite] = Field(
        default=(0.0, 0.0),
        description="tilt of the finger from its nominal direction, about the world's x and y axes",
    )
    tremor_frequency_hz: Positive = Field(
        default=10.0, description="centre of the tremor's frequency band"
    )
    tremor_width_hz: Positive = Field(
        default=4.0, description="total width of the tremor's frequency band"
    )
    tremor_rms_m: NonNegative | None = Field(
        default=None,
        description="rms tremor per axis, on paths with tremor; null: the tremor amplitude of "
        "the path is used",
    )
    voluntary_bandwidth_hz: Annotated[float, Field(ge=0.2, le=20)] = Field(
        default=1.2, description="maximum frequency of the slow random motion of the finger"
    )
    hand_mass_kg: Positive | None = Field(
        default=None,
        description="mass of the hand at the fingertip, for the finger simulator's parameter "
        "`hand: coupled`; null: the mass of an average hand is used",
    )
    hand_damping_ratio: NonNegative | None = Field(
        default=None,
        description="damping of the hand divided by its critical damping; null: the value of an "
        "average hand is used",
    )
    hand_stiffness_n_per_m: NonNegative | None = None


class EyesTruth(Part):
    """The deviations of the true eye positions from the positions that the renderer assumes.

    The renderer uses the positions that a head tracker measures. If there is no head tracker, the
    renderer uses the positions in the scene.
    """

    centre_offset_m: SmallTriple = ZERO_3
    interocular_offset_m: Small = 0.0
    sway_m: Annotated[float, Field(ge=0, le=0.3)] = Field(
        default=0.0, description="standard deviation per axis of the slow head motion"
    )
    sway_frequency_hz: Positive = Field(
        default=0.3, description="highest frequency of the head motion"
    )


NOMINAL_DISPLAY_LATENCY_S = 0.008
"""The nominal display latency (s), to which `latency_offset_s` is added.

The display latency is the time from a swap of the frame buffers to the middle of the display of
the new frame.
"""


class ProjectorTruth(Part):
    """The deviations of the simulated projector from the projector in the scene."""

    position_offset_m: SmallTriple = ZERO_3
    rotation_offset_rad: SmallTriple = ZERO_3
    lens: LensTruth = Field(default_factory=LensTruth)
    latency_offset_s: Annotated[float, Field(ge=-0.5, le=0.5)] = Field(
        default=0.0,
        description="true display latency minus the nominal display latency of 8 ms",
    )


class Devices(Part):
    """The parameters of all devices in a scene. The virtual object is not included."""

    camera: StereoCamera
    arms: Arms
    sheet: SheetSpec
    projector: Projector | None = None
    eyes: Eyes
    finger: Finger


class Apparatus(Message):
    """The true parameters of the simulated hardware, given as deviations from a scene."""

    scene: str = Field(description="name of the scene to which the deviations refer")
    scene_id: str | None = Field(
        default=None,
        description="hash of the scene's object and devices; null: only the names of the scenes "
        "are compared",
    )
    origin: str = Field(default="file", description="origin of the values, as text for users")
    nominal: Devices | None = Field(
        default=None,
        description="devices to which the deviations refer; null: the devices of the scene",
    )
    camera: CameraTruth = Field(default_factory=CameraTruth)
    arms: ArmsTruth = Field(default_factory=ArmsTruth)
    sheet: SheetTruth = Field(default_factory=SheetTruth)
    finger: FingerTruth = Field(default_factory=FingerTruth)
    eyes: EyesTruth = Field(default_factory=EyesTruth)
    projector: ProjectorTruth = Field(default_factory=ProjectorTruth)


def identify_scene(scene: Scene) -> str:
    """Return a hash (16 hexadecimal digits) that identifies the object and the devices of a scene.

    The hash does not depend on values that a calibration replaces. A calibrated scene therefore has
    the same hash as the original scene.
    """
    values = {
        "name": scene.name,
        "geometry": scene.object.geometry.model_dump(mode="json"),
        "world_from_object": scene.object.world_from_object.model_dump(mode="json"),
        "camera": [scene.camera.device, scene.camera.width_px, scene.camera.height_px],
        "projector": None
        if scene.projector is None
        else [scene.projector.width_px, scene.projector.height_px],
        "sheet_height_m": scene.sheet.height_m,
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def devices_of(scene: Scene) -> Devices:
    """Return the parameters of the camera, arms, sheet, projector, eyes and finger of a scene."""
    return Devices(**{name: getattr(scene, name) for name in Devices.model_fields})


def nominal_apparatus(scene: Scene) -> Apparatus:
    """Return the true parameters of simulated hardware that does not deviate from a scene."""
    return Apparatus(
        scene=scene.name,
        scene_id=identify_scene(scene),
        origin="nominal",
        nominal=devices_of(scene),
        arms=ArmsTruth(left=ArmTruth.of(scene.arms.left), right=ArmTruth.of(scene.arms.right)),
    )
