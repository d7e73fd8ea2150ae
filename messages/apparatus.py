"""Define the apparatus: the true parameters of the simulation, as differences from the scene.

The scene is what the nodes believe. The apparatus is what is true, and only the simulator and the
evaluation of experiments read it. All differences are zero, and all ratios one, in a nominal
apparatus. Offsets are true value minus the scene's. Rotation offsets are rotation vectors about the
world's axes (edge: the flange's axes), applied about the frame's own origin.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal

from pydantic import Field

from flexsheet.messages.base import Message
from flexsheet.messages.scene import (
    Arms,
    Eyes,
    Finger,
    Finite,
    NonNegative,
    Part,
    Positive,
    Projector,
    Scene,
    SheetSpec,
    StereoCamera,
)

Pair = tuple[Finite, Finite]
Triple = tuple[Finite, Finite, Finite]
Share = Annotated[float, Field(ge=0, lt=1)]
Small = Annotated[float, Field(ge=-0.5, le=0.5)]
"""A relative deviation or a small angle; what is beyond it is a mistake in the file."""

SmallTriple = tuple[Small, Small, Small]
SmallSix = tuple[Small, Small, Small, Small, Small, Small]
NearOne = Annotated[float, Field(ge=0.5, le=2.0)]

ZERO_3 = (0.0, 0.0, 0.0)
ZERO_6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class LensTruth(Part):
    """Differences of a lens from the scene's (a camera's: from that of its device)."""

    focal_ratio: NearOne = Field(default=1.0, description="true focal length over the scene's")
    centre_offset_px: Pair = (0.0, 0.0)
    radial_offset: Pair = Field(default=(0.0, 0.0), description="of the distortion's k1 and k2")


class CameraTruth(Part):
    """Differences of the stereo camera from the scene's."""

    position_offset_m: SmallTriple = ZERO_3
    rotation_offset_rad: SmallTriple = ZERO_3
    left: LensTruth = Field(default_factory=LensTruth)
    right: LensTruth = Field(default_factory=LensTruth)
    right_position_offset_m: SmallTriple = Field(
        default=ZERO_3, description="of the right camera, in its own frame"
    )
    right_rotation_offset_rad: SmallTriple = ZERO_3
    rate_hz: Positive | None = Field(default=None, description="null: the scene's")
    read_out_s: NonNegative | None = Field(
        default=None,
        description="from the end of exposure to the message; null: the simulator's parameter",
    )
    skew_s: Annotated[float, Field(ge=-0.05, le=0.05)] = Field(
        default=0.0, description="exposure of the right image minus that of the left, not reported"
    )
    exposure_jitter_s: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=0.0, description="standard deviation of the true exposure time about its stamp"
    )
    stamp_offset_s: Annotated[float, Field(ge=-0.1, le=0.1)] = Field(
        default=0.0, description="true exposure time minus its stamp"
    )


class ArmTruth(Part):
    """Differences of one arm from the scene's, and how its controller behaves."""

    base_position_offset_m: SmallTriple = ZERO_3
    base_rotation_offset_rad: SmallTriple = ZERO_3
    edge_position_offset_m: SmallTriple = Field(
        default=ZERO_3, description="of the clamped edge, in the flange's frame"
    )
    edge_rotation_offset_rad: SmallTriple = ZERO_3
    joint_offsets_rad: SmallSix = Field(
        default=ZERO_6, description="true joint angle minus that of the encoder"
    )
    flange_compliance_m_per_n: Annotated[float, Field(ge=0, le=1e-2)] = Field(
        default=0.0, description="displacement of the flange by the sheet's pull"
    )
    servo_lag_s: Positive | None = Field(
        default=None, description="null: the simulator's parameter"
    )
    command_latency_s: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="from the arrival of a set-point to its effect"
    )
    controller_period_s: Annotated[float, Field(gt=0, le=0.1)] | None = Field(
        default=None, description="set-points take effect in such cycles; null: the simulator's"
    )
    controller_jitter_s: Annotated[float, Field(ge=0, le=0.05)] = Field(
        default=0.0, description="standard deviation of each cycle's begin"
    )
    backlash_rad: Annotated[float, Field(ge=0, le=0.1)] | None = Field(
        default=None, description="play of each gear; null: the simulator's parameter"
    )


class ArmsTruth(Part):
    left: ArmTruth = Field(default_factory=ArmTruth)
    right: ArmTruth = Field(default_factory=ArmTruth)


class SheetTruth(Part):
    """Differences of the sheet from the scene's, and properties that the scene lacks."""

    modulus_ratio: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    thickness_ratio: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    thickness_gradient_ratio: tuple[Small, Small] = Field(
        default=(0.0, 0.0),
        description="relative change of thickness from edge to edge, along x and y",
    )
    slack_width_offset_m: Small = 0.0
    clamp_slip_m: tuple[Share, Share] = Field(
        default=(0.0, 0.0), description="rubber that the left and right clamp let through"
    )
    density_kg_per_m3: NonNegative | None = Field(
        default=None, description="null: the scene's; 0: without weight"
    )
    friction_coefficient: NonNegative | None = Field(
        default=None, description="between finger and sheet; null: touched rubber sticks"
    )
    hysteresis_ratio: Share = Field(
        default=0.0, description="fraction of the stored energy that a cycle loses"
    )
    creep_ratio_per_decade: Share = Field(
        default=0.0, description="relative loss of tension per decade of time"
    )


class FingerTruth(Part):
    """Differences of the finger, its marker and its motion from the nodes' assumptions.

    The finger's frame has its origin at the pad's contact point (the fingertip of all messages), x
    along the finger towards the hand, z from the pad to the nail, y = z x x.
    """

    radius_offset_m: Small = 0.0
    marker_from_pad_m: SmallTriple = Field(
        default=ZERO_3, description="centre of the marker in the finger's frame"
    )
    marker_shape: Literal["ball", "disc"] = Field(
        default="ball", description="disc: flat on the nail, seen as an ellipse"
    )
    marker_tilt_rad: tuple[Finite, Finite] = Field(
        default=(0.0, 0.0), description="of the disc's normal from z, about the finger's x and y"
    )
    finger_tilt_rad: tuple[Finite, Finite] = Field(
        default=(0.0, 0.0),
        description="of the finger from the simulator's direction, about the world's x and y",
    )
    tremor_frequency_hz: Positive = Field(default=10.0, description="middle of the band")
    tremor_width_hz: Positive = Field(default=4.0, description="whole width of the band")
    tremor_rms_m: NonNegative | None = Field(
        default=None, description="per axis, on paths with tremor; null: the path's own"
    )
    voluntary_bandwidth_hz: Annotated[float, Field(ge=0.2, le=20)] = Field(
        default=1.2, description="upper end of the slow unsteadiness"
    )
    hand_mass_kg: Positive | None = Field(
        default=None, description="null: the finger follows its path whatever it feels"
    )
    hand_damping_ns_per_m: NonNegative | None = None
    hand_stiffness_n_per_m: NonNegative | None = None


class EyesTruth(Part):
    """Offsets of the true eyes from the tracked eyes, or from the scene's."""

    centre_offset_m: SmallTriple = ZERO_3
    interocular_offset_m: Small = 0.0
    sway_m: Annotated[float, Field(ge=0, le=0.3)] = Field(
        default=0.0, description="standard deviation per axis of the head's slow motion"
    )
    sway_frequency_hz: Positive = Field(default=0.3, description="highest frequency of the sway")


class ProjectorTruth(Part):
    """Differences of the projector from the scene's."""

    position_offset_m: SmallTriple = ZERO_3
    rotation_offset_rad: SmallTriple = ZERO_3
    lens: LensTruth = Field(default_factory=LensTruth)
    latency_offset_s: Annotated[float, Field(ge=-0.5, le=0.5)] = Field(
        default=0.0, description="true time of light minus the renderer's display_latency_s"
    )


class Devices(Part):
    """Device parts of the scene from which the differences are counted."""

    camera: StereoCamera
    arms: Arms
    sheet: SheetSpec
    projector: Projector | None = None
    eyes: Eyes
    finger: Finger


class Apparatus(Message):
    """True devices of the simulator, as differences from a scene."""

    scene: str = Field(description="name of the scene")
    scene_id: str | None = Field(
        default=None, description="identity of its object and devices; null: only the name counts"
    )
    origin: str = Field(default="file", description="origin, as text for users")
    nominal: Devices | None = Field(
        default=None,
        description="devices from which the differences are counted; null: those of the scene",
    )
    camera: CameraTruth = Field(default_factory=CameraTruth)
    arms: ArmsTruth = Field(default_factory=ArmsTruth)
    sheet: SheetTruth = Field(default_factory=SheetTruth)
    finger: FingerTruth = Field(default_factory=FingerTruth)
    eyes: EyesTruth = Field(default_factory=EyesTruth)
    projector: ProjectorTruth = Field(default_factory=ProjectorTruth)


def identify_scene(scene: Scene) -> str:
    """Return 16 digits that identify a scene's object and devices.

    What a calibration changes has no influence, so that a calibrated scene keeps its identity.
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
    """Return the device parts of a scene."""
    return Devices(
        camera=scene.camera,
        arms=scene.arms,
        sheet=scene.sheet,
        projector=scene.projector,
        eyes=scene.eyes,
        finger=scene.finger,
    )


def nominal_apparatus(scene: Scene) -> Apparatus:
    """Return the apparatus that equals its scene."""
    return Apparatus(
        scene=scene.name,
        scene_id=identify_scene(scene),
        origin="nominal",
        nominal=devices_of(scene),
    )
