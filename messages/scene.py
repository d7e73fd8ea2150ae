"""Define the scene: object, devices, working range and tolerances.

Scene files (`launch/scenes/*.yaml`) contain the fields that this module defines. Units are metres,
radians and pascals. The world frame has its origin at the centre of the imaginary screen, with x to
the right, y up, and z towards the user.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from flexsheet.messages.arrays import ColorImage, Transform, Triangles, Vector3, Vertices
from flexsheet.messages.base import Message, MessagePart
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.methods import Methods

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Small = Annotated[float, Field(ge=-0.5, le=0.5)]
"""A relative deviation, a length (m) or an angle (rad) of at most 0.5.

A larger magnitude indicates a mistake in the scene file.
"""

Six = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
SmallSix = tuple[Small, Small, Small, Small, Small, Small]

MAX_AXIS_ERROR = 1e-6
"""The maximum difference between the length of a joint axis vector and 1."""


class Part(MessagePart, LimitedModel):
    """The base class of the parts of scenes and calibrations.

    The validation rejects a number that exceeds the limit for its unit.
    """


class Pose(Part):
    """The position (m) and orientation of a frame in its parent frame.

    Roll, pitch and yaw (rad) are rotations about the fixed x, y and z axes, applied in this order.
    """

    position_m: Vector3
    rpy_rad: Vector3


class Material(Part):
    """The linear elastic constants of a soft object."""

    young_modulus_pa: Positive
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)]


class Cylinder(Part):
    """A solid circular cylinder about the x axis of the object frame, centred on the origin.

    The user touches its curved surface, not its flat ends.
    """

    shape: Literal["cylinder"] = "cylinder"
    radius_m: Positive
    length_m: Positive


class Sphere(Part):
    """A solid sphere centred on the origin of the object frame."""

    shape: Literal["sphere"] = "sphere"
    radius_m: Positive


class Ellipsoid(Part):
    """A solid ellipsoid centred on the origin of the object frame."""

    shape: Literal["ellipsoid"] = "ellipsoid"
    semi_axes_m: tuple[Positive, Positive, Positive] = Field(
        description="lengths of the semi-axes along x, y and z"
    )


class Plane(Part):
    """A solid half-space below the plane z = 0. The user can touch a rectangle at the origin.

    The plane is in the object frame. The rectangle is centred on the origin.
    """

    shape: Literal["plane"] = "plane"
    width_m: Positive = Field(description="size along x")
    height_m: Positive = Field(description="size along y")


class RoundedBox(Part):
    """A solid box with rounded edges and corners, centred on the origin of the object frame."""

    shape: Literal["rounded_box"] = "rounded_box"
    size_m: tuple[Positive, Positive, Positive] = Field(
        description="size along x, y and z, including the rounded edges"
    )
    edge_radius_m: Positive

    @model_validator(mode="after")
    def _check_rounding(self) -> Self:
        if 2.0 * self.edge_radius_m > min(self.size_m):
            raise ValueError(
                f"edge_radius_m: {self.edge_radius_m} is more than half of the smallest size_m, "
                f"{min(self.size_m)}; reduce it"
            )
        return self


class Mesh(Part):
    """A solid with a smooth surface that approximates a closed triangle mesh.

    The scene message contains the whole mesh, so all nodes on all hosts use the same mesh. In a
    scene file, `shape: mesh_file` and the name of a mesh file replace the vertices and triangles.
    """

    shape: Literal["mesh"] = "mesh"
    vertices_m: Vertices
    triangles: Triangles = Field(
        description="vertex indices, counter-clockwise when seen from outside"
    )
    smoothing_m: Positive = Field(description="length below which details and edges are smoothed")
    origin: str = Field(description="source file and repairs, for information")


Geometry = Annotated[
    Cylinder | Sphere | Ellipsoid | Plane | RoundedBox | Mesh, Field(discriminator="shape")
]


class StripSupport(Part):
    """A support that fixes the part of a soft object's surface that faces away from the user."""

    kind: Literal["strip"] = "strip"
    angle_rad: Positive = Field(
        description="twice the maximum angle between the normal of fixed surface points and the "
        "direction away from the user"
    )


class BaseSupport(Part):
    """A support that fixes the lowest part of a soft object's surface, as a table does."""

    kind: Literal["base"] = "base"
    height_m: Positive = Field(
        description="height above the lowest point up to which the surface is fixed"
    )
    down_world: tuple[Finite, Finite, Finite] = Field(
        default=(0.0, 0.0, -1.0), description="direction downwards, of any length except zero"
    )

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        if not any(self.down_world):
            raise ValueError(
                "down_world: (0, 0, 0) is not a direction; give for example [0, -1, 0]"
            )
        return self


class SpherePatchSupport(Part):
    """A support that fixes the part of a soft object's surface inside a sphere, as a clamp does."""

    kind: Literal["sphere_patch"] = "sphere_patch"
    centre_m: Vector3 = Field(description="centre of the sphere in the object frame")
    radius_m: Positive


class BoxPatchSupport(Part):
    """A support that fixes the part of a soft object's surface inside a box.

    The edges of the box are parallel to the axes of the object frame.
    """

    kind: Literal["box_patch"] = "box_patch"
    min_m: Vector3 = Field(description="lower corner of the box in the object frame")
    max_m: Vector3 = Field(description="upper corner of the box in the object frame")

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if not (self.min_m < self.max_m).all():
            raise ValueError(f"min_m {self.min_m} must be below max_m {self.max_m} on every axis")
        return self


Support = StripSupport | BaseSupport | SpherePatchSupport | BoxPatchSupport


Fraction = Annotated[float, Field(ge=0, le=1)]


class Appearance(Part):
    """The colour and the texture of the virtual object.

    The texture moves with the surface and therefore shows its strain. The value `texture: image`
    requires an image. A scene file gives the name of the image file as `image_file`.
    """

    colour: tuple[Fraction, Fraction, Fraction] = Field(
        default=(0.95, 0.72, 0.60), description="red, green, blue at full illumination"
    )
    texture: Literal["none", "speckle", "grid", "image"] = "none"
    texture_pitch_m: Positive = Field(
        default=0.008,
        description="approximate distance between the lines of the grid, or between the speckles",
    )
    image: ColorImage | None = Field(
        default=None,
        description="rows from top to bottom; the image is projected along the object frame's z "
        "and scaled to the object's width and height",
    )

    @model_validator(mode="after")
    def _check_image(self) -> Self:
        if self.texture == "image" and (self.image is None or not self.image.size):
            raise ValueError(
                "texture: the texture `image` requires an image; set image_file, or choose "
                "another texture"
            )
        return self


class VirtualObject(Part):
    """The virtual object that the user touches. An object without a material is rigid."""

    geometry: Geometry
    material: Material | None = Field(
        default=None, description="elastic constants of the object; null: the object is rigid"
    )
    world_from_object: Pose
    support: Support | None = Field(
        default=None,
        discriminator="kind",
        description="fixed part of the object's surface; null only for a rigid object",
    )
    appearance: Appearance = Appearance()

    @model_validator(mode="after")
    def _check_support(self) -> Self:
        if self.material is not None and self.support is None:
            raise ValueError(
                "support is missing: a soft object needs a fixed part of its surface; "
                "add for example support: {kind: strip, angle_rad: 1.57}"
            )
        return self


class SheetSpec(Part):
    """The rubber sheet, clamped at its left and right edges and free at its top and bottom edges.

    In the sheet frame, the x axis points from the left to the right edge. The y axis points upwards
    along the clamped edges.
    """

    width_m: Positive = Field(
        description="distance between the clamped edges when the sheet is unstretched"
    )
    height_m: Positive = Field(description="length of a clamped edge")
    thickness_m: Positive
    young_modulus_pa: Positive
    density_kg_per_m3: Annotated[float, Field(ge=0, le=20000)] = Field(
        default=0.0, description="density of the rubber; 0 neglects the sheet's weight"
    )
    hysteresis_ratio: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.0,
        description="fraction of the loading energy that the rubber loses in a cycle; the rendered "
        "force is corrected by it; a sheet calibration replaces it",
    )
    max_stretch_ratio: Annotated[float, Field(gt=1)]
    min_stretch_ratio: Annotated[float, Field(ge=1)] = 1.0
    max_edge_force_n: Positive
    usable_half_height_m: Positive = Field(
        description="maximum distance of the finger from the sheet's horizontal centre line"
    )


class ArmModel(Part):
    """The base class of models of a 6-axis arm, with the arm's name and joint limits."""

    name: str
    min_rad: Six = Field(description="lower end of each joint's range")
    max_rad: Six
    speed_rad_per_s: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = Field(
        description="maximum speed of each joint"
    )
    start_rad: Six = Field(
        description="joint angles of a pose towards the sheet; they select the configuration of "
        "elbow, shoulder and wrist with which the arm holds the sheet"
    )

    def __str__(self) -> str:
        return self.name

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        rows = zip(self.min_rad, self.start_rad, self.max_rad, strict=True)
        for number, (low, start, high) in enumerate(rows, start=1):
            if not low < start < high:
                raise ValueError(
                    f"J{number}: start_rad {start:.4g} must be between min_rad {low:.4g} and "
                    f"max_rad {high:.4g}"
                )
        return self


class JointChain(ArmModel):
    """A model of an arm as a chain of six rotary joints, such as one read from a URDF file."""

    kind: Literal["joint_chain"] = "joint_chain"
    origins: tuple[Pose, Pose, Pose, Pose, Pose, Pose] = Field(
        description="pose of each joint's frame in the frame of the previous joint, at angle 0; "
        "the pose of the first joint is in the base frame"
    )
    axes: tuple[Vector3, Vector3, Vector3, Vector3, Vector3, Vector3] = Field(
        description="unit vector of each joint's axis in its own frame"
    )
    flange: Pose = Field(description="pose of the flange in the frame of the last joint")

    @model_validator(mode="after")
    def _check_axes(self) -> Self:
        for number, axis in enumerate(self.axes, start=1):
            if not abs(math.hypot(*axis) - 1.0) <= MAX_AXIS_ERROR:
                raise ValueError(f"axes: the axis of J{number} is {axis}; its length must be 1")
        return self


class ClosedFormArm(ArmModel):
    """A model of an arm whose inverse kinematics have a closed-form solution.

    The joint axes are z, y, y, z, y, z. The last three axes intersect in one point. At joint angles
    of zero, the arm is upright, and every frame is parallel to the base frame.
    """

    kind: Literal["closed_form"] = "closed_form"
    shoulder_height_m: Positive
    upper_arm_m: Positive
    elbow_shift_m: Finite = Field(
        description="distance by which the forearm's axis is behind the elbow; negative: in front"
    )
    forearm_m: Positive = Field(description="distance along the forearm's axis to the wrist centre")
    flange_m: Positive = Field(description="distance from the wrist centre to the flange")

    def chain(self) -> JointChain:
        """Convert this model to a general chain of six joints with the same kinematics."""
        offsets = (
            (0.0, 0.0, 0.0),
            (0.0, 0.0, self.shoulder_height_m),
            (0.0, 0.0, self.upper_arm_m),
            (-self.elbow_shift_m, 0.0, self.forearm_m),
            (0.0, 0.0, 0.0),
            (0.0, 0.0, 0.0),
            (0.0, 0.0, self.flange_m),
        )
        *origins, flange = ({"position_m": one, "rpy_rad": (0.0, 0.0, 0.0)} for one in offsets)
        z, y = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
        limits = {name: getattr(self, name) for name in ArmModel.model_fields}
        return JointChain.model_validate(
            {**limits, "origins": origins, "axes": (z, y, y, z, y, z), "flange": flange}
        )


def _radians(*degrees: float) -> Any:
    return tuple(math.radians(angle) for angle in degrees)


RV_1A = ClosedFormArm(
    name="rv-1a",
    shoulder_height_m=0.3,
    upper_arm_m=0.25,
    elbow_shift_m=0.09,
    forearm_m=0.16,
    flange_m=0.072,
    min_rad=_radians(-150, -60, 60, -160, -90, -200),
    max_rad=_radians(150, 120, 155, 160, 90, 200),
    speed_rad_per_s=_radians(180, 90, 135, 180, 180, 210),
    start_rad=_radians(0, 25, 119, 0, -54, 0),
)
"""The model of the Mitsubishi RV-1A arm.

Source: two public models (Adolphus `mitsubishirv1a.yaml`, ICube `mrv1a.urdf`).
"""

RV_2FR = ClosedFormArm(
    name="rv-2fr",
    shoulder_height_m=0.295,
    upper_arm_m=0.23,
    elbow_shift_m=0.05,
    forearm_m=0.27,
    flange_m=0.07,
    min_rad=_radians(-240, -120, 0, -200, -120, -360),
    max_rad=_radians(240, 120, 160, 200, 120, 360),
    speed_rad_per_s=_radians(300, 150, 300, 450, 450, 720),
    start_rad=_radians(0, 10, 115, 0, -35, 0),
)
"""The model of the Mitsubishi RV-2FR arm.

Source: the manufacturer's public model (`melfa_description`). The elbow is shifted backwards, as in
the RV-1A. Without this shift, the maximum reach of the wrist centre would differ from the 504 mm of
the data sheet.
"""

ARM_MODELS = {arm.name: arm for arm in (RV_1A, RV_2FR)}
"""The arm models that a scene file may select by name."""


class ArmSpec(Part):
    """A robot arm: its model, the pose of its base, and the pose of the sheet's edge on its flange.

    In the sheet frame, the x axis points from the left to the right edge. The y axis points upwards
    along the clamped edges, and the z axis points towards the user.
    """

    model: Annotated[ClosedFormArm | JointChain, Field(discriminator="kind")] = Field(
        default=RV_1A,
        description="name of a known arm (rv-1a, rv-2fr), its dimensions, or in a scene file "
        "`{urdf: FILE, base: LINK, tip: LINK, start_rad: [...]}`",
    )
    world_from_base: Pose
    flange_from_edge: Pose = Field(
        description="pose of the clamped edge's centre in the flange frame; its axes are those of "
        "the sheet frame"
    )
    joint_offsets_rad: SmallSix = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="true joint angles minus the angles that the encoders report",
    )
    flange_compliance_m_per_n: Annotated[float, Field(ge=0, le=1e-2)] = Field(
        default=0.0,
        description="displacement of the flange per newton of the sheet's tension; the commands to "
        "the arm are corrected by it",
    )

    @field_validator("model", mode="before")
    @classmethod
    def _find_model(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in ARM_MODELS:
            raise ValueError(f'unknown arm "{value}"; known arms: {", ".join(ARM_MODELS)}')
        return ARM_MODELS[value]


class Arms(Part):
    """The two robot arms and the limits that they have in common."""

    left: ArmSpec
    right: ArmSpec
    max_tool_speed_m_per_s: Positive
    min_distance_m: Positive = Field(description="minimum distance between the two flanges")
    workspace_min_m: Vector3 = Field(
        description="lower corner of the box that limits the flanges, world frame"
    )
    workspace_max_m: Vector3


class Lens(Part):
    """The parameters of a pinhole camera with Brown's lens distortion (k1, k2, p1, p2, k3).

    OpenCV defines these parameters.
    """

    fx_px: Positive
    fy_px: Positive
    cx_px: Finite
    cy_px: Finite
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)


class StereoCamera(Part):
    """The parameters of the stereo camera.

    In each camera frame, the x axis points to the right in the image, and the y axis points down.
    The z axis is the optical axis of the camera, and points forwards.
    """

    device: str
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    rate_hz: Positive
    exposure_s: Positive
    gain: Finite | None = Field(
        default=None,
        description="gain in units of the device; null: the present gain of the device is kept",
    )
    read_noise_levels: Positive = Field(
        default=1.5,
        description="standard deviation of the noise of a dark pixel, in grey levels (0 to 255)",
    )
    photons_per_level: Positive = Field(
        default=40.0,
        description="photons per grey level; level L has shot noise sqrt(L / photons_per_level)",
    )
    left: Lens
    right: Lens
    right_from_left: Transform
    world_from_left: Pose


class Projector(Part):
    """The parameters of the projector, which has the same lens model as a camera.

    The z axis of the projector frame points in the direction of projection.
    """

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    lens: Lens
    world_from_projector: Pose


class Eyes(Part):
    """The positions of the user's eyes.

    The line through both eyes is parallel to the x axis of the world.
    """

    centre_world_m: Vector3
    interocular_m: NonNegative


FingerLength = Annotated[float, Field(ge=-0.1, le=0.1)]
FingerLengths = tuple[FingerLength, FingerLength, FingerLength]


class Finger(Part):
    """The user's finger, its marker, and the limits of its motion.

    The finger frame has its origin at the contact point of the fingertip's pad. The x axis points
    along `direction_world`, the z axis points out of the nail, and the y axis is horizontal. The
    orientation of the finger frame in the world is constant.
    """

    radius_m: Positive
    direction_world: tuple[Finite, Finite, Finite] = Field(
        default=(0.0, -0.5, 0.866),
        description="direction from the fingertip along the finger to the hand",
    )
    marker_from_pad_m: FingerLengths = Field(
        default=(0.0, 0.0, 0.0),
        description="marker's centre in the finger's frame; a marker calibration replaces it",
    )
    max_speed_m_per_s: Positive
    volume_min_m: Vector3 = Field(
        description="lower corner of the box of possible fingertip positions, world frame"
    )
    volume_max_m: Vector3

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        x, y, z = self.direction_world
        if math.hypot(y, z) < 0.1 * math.hypot(x, y, z) or not math.hypot(x, y, z):
            raise ValueError(
                f"direction_world {self.direction_world} must not be zero or along the world's x "
                "axis; give the direction from the fingertip to the hand"
            )
        return self


class WorkingRange(Part):
    """The range of finger motions that the display must support.

    Limits and method comparisons are computed for this range.
    """

    push_depth_m: Positive
    tilt_rad: Positive
    speed_m_per_s: Positive


class Tolerances(Part):
    """The maximum permitted errors of the display.

    For each task, nodes can choose a method that meets the corresponding tolerance.
    """

    image_m: Positive = Field(description="displacement of the image as seen from the eye")
    fingertip_m: Positive
    skin_m: Positive = Field(
        description="error of surface displacements, beyond 1.5 finger radii from the contact"
    )
    force_ratio: Positive
    sheet_position_m: Positive
    latency_s: Positive = Field(
        description="time from exposure to the arms' commands, 95th percentile"
    )
    light_latency_s: Positive = Field(
        default=0.06,
        description="time from exposure to display of the image, 95th percentile; people notice an "
        "image that is 45 ms later than the touch (Vogels 2004), and the touch is up to 15 ms late",
    )


class Scene(Message):
    """The scene that all nodes use: object, devices, working range and tolerances."""

    name: str
    object: VirtualObject
    sheet: SheetSpec
    arms: Arms
    camera: StereoCamera
    projector: Projector | None = Field(
        default=None, description="projector of the images; null: no image is projected"
    )
    eyes: Eyes
    finger: Finger
    working_range: WorkingRange
    tolerances: Tolerances
    methods: Methods = Field(
        default_factory=Methods,
        description="methods that nodes use if their parameter has the value `auto`",
    )


class UnfitGeometryError(FlexsheetError, ValueError):
    """Raised if a command or method does not work with the object's shape or support."""

    exit_code = 2


def require_cylinder(scene: Scene) -> Cylinder:
    """Return the geometry of the scene's object, which must be a cylinder.

    Raises UnfitGeometryError if the object has a different shape.
    """
    geometry = scene.object.geometry
    if not isinstance(geometry, Cylinder):
        raise UnfitGeometryError(
            f'object.geometry.shape of the scene is "{geometry.shape}", expected "cylinder"; '
            "choose a scene with a cylinder, such as --scene cylinder"
        )
    return geometry


class MissingPartError(FlexsheetError, ValueError):
    """Raised if a scene does not contain a part that a node or command requires."""

    remedy = "Add the part to the scene file, or leave out the node or command that needs it."


def require_projector(scene: Scene) -> Projector:
    """Return the scene's projector. Raises MissingPartError if the scene has no projector."""
    if scene.projector is None:
        raise MissingPartError(f'scene "{scene.name}": the key `projector` is missing')
    return scene.projector


def require_material(scene: Scene) -> Material:
    """Return the object's material. Raises MissingPartError for a rigid object."""
    if scene.object.material is None:
        raise MissingPartError(
            f'scene "{scene.name}": the key `object.material` is missing, so the object is rigid'
        )
    return scene.object.material


def require_support(scene: Scene) -> Support:
    """Return the support that fixes a part of the object's surface.

    Raises MissingPartError if the object has no support.
    """
    if scene.object.support is None:
        raise MissingPartError(
            f'scene "{scene.name}": the key `object.support` is missing; a soft object needs it'
        )
    return scene.object.support
