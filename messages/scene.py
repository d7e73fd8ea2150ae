"""The scene: what is shown, with which devices, over which range, and how well.

A scene file (`launch/scenes/*.yaml`) holds exactly these fields (but a mesh is named by its file,
see `launch/objects/meshes.py`).  Lengths are metres, angles radians, stresses pascals.  The world
frame has its origin at the centre of the imaginary screen, x to the right, y up, z towards the
user.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from flexsheet.messages.arrays import ColorImage, Transform, Triangles, Vector3, Vertices
from flexsheet.messages.base import Message, MessagePart
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.methods import Methods

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Part(MessagePart, LimitedModel):
    """A named group of values in a scene or a calibration, each within the limits of its unit."""


class Pose(Part):
    """Where a frame sits in another; roll, pitch, yaw turn about fixed x, y, z axes, in order."""

    position_m: Vector3
    rpy_rad: Vector3


class Material(Part):
    young_modulus_pa: Positive
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)]


class Cylinder(Part):
    """Solid circular cylinder, axis along the object frame's x, centred on its origin.

    Its side is touched, not its ends.
    """

    shape: Literal["cylinder"] = "cylinder"
    radius_m: Positive
    length_m: Positive


class Sphere(Part):
    """Solid sphere about the object frame's origin."""

    shape: Literal["sphere"] = "sphere"
    radius_m: Positive


class Ellipsoid(Part):
    """Solid ellipsoid about the object frame's origin."""

    shape: Literal["ellipsoid"] = "ellipsoid"
    semi_axes_m: tuple[Positive, Positive, Positive] = Field(description="along x, y, z")


class Plane(Part):
    """The half-space below z = 0 of the object frame, touched on a rectangle about the origin."""

    shape: Literal["plane"] = "plane"
    width_m: Positive = Field(description="along x")
    height_m: Positive = Field(description="along y")


class RoundedBox(Part):
    """Solid box about the object frame's origin, its edges and corners rounded by a ball."""

    shape: Literal["rounded_box"] = "rounded_box"
    size_m: tuple[Positive, Positive, Positive] = Field(
        description="along x, y, z, rounding included"
    )
    edge_radius_m: Positive

    @model_validator(mode="after")
    def _rounding_fits(self) -> Self:
        if 2.0 * self.edge_radius_m > min(self.size_m):
            raise ValueError(
                f"edge_radius_m: {self.edge_radius_m} is more than half of the least size_m, "
                f"{min(self.size_m)}; round the edges less"
            )
        return self


class Mesh(Part):
    """The smooth solid that a closed triangle mesh stands for.

    It travels with the scene, so that every node on every host has the same.  A scene file names
    the mesh's file instead, as `shape: mesh_file`; see `launch/objects/meshes.py`.
    """

    shape: Literal["mesh"] = "mesh"
    vertices_m: Vertices
    triangles: Triangles = Field(description="indices, counter-clockwise seen from outside")
    smoothing_m: Positive = Field(description="what is finer is smoothed away; edges are rounded")
    origin: str = Field(description="for people: where it comes from, what was repaired")


Geometry = Annotated[
    Cylinder | Sphere | Ellipsoid | Plane | RoundedBox | Mesh, Field(discriminator="shape")
]


class StripSupport(Part):
    """Held is the skin that faces away from the user."""

    kind: Literal["strip"] = "strip"
    angle_rad: Positive = Field(
        description="full angle that the held skin's normals span about the line from the user"
    )


class BaseSupport(Part):
    """Held is the lowest skin, as of an object that stands on something."""

    kind: Literal["base"] = "base"
    height_m: Positive = Field(description="of the held skin, above the lowest point")
    down_world: tuple[Finite, Finite, Finite] = Field(
        default=(0.0, 0.0, -1.0), description="where low is; of any length but zero"
    )

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not any(self.down_world):
            raise ValueError("down_world: (0, 0, 0) is no direction; [0, -1, 0] is below")
        return self


class SpherePatchSupport(Part):
    """Held is the skin within a sphere, as by a clamp."""

    kind: Literal["sphere_patch"] = "sphere_patch"
    centre_m: Vector3 = Field(description="object frame")
    radius_m: Positive


class BoxPatchSupport(Part):
    """Held is the skin within a box, its sides along the object frame's axes."""

    kind: Literal["box_patch"] = "box_patch"
    min_m: Vector3 = Field(description="object frame")
    max_m: Vector3

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        if not (self.min_m < self.max_m).all():
            raise ValueError(f"min_m: {self.min_m} is not below max_m: {self.max_m} on every axis")
        return self


Support = Annotated[
    StripSupport | BaseSupport | SpherePatchSupport | BoxPatchSupport, Field(discriminator="kind")
]


Share = Annotated[float, Field(ge=0, le=1)]


class Appearance(Part):
    """How the object is painted; a texture moves with the skin and so shows how that is strained.

    `texture: image` needs an image; a scene file names its file instead, as `image_file`, see
    `launch/objects/textures.py`.
    """

    colour: tuple[Share, Share, Share] = Field(
        default=(0.95, 0.72, 0.60), description="red, green, blue in full light"
    )
    texture: Literal["none", "speckle", "grid", "image"] = "none"
    texture_pitch_m: Positive = Field(
        default=0.008, description="between the grid's lines, or the speckle's spots, about"
    )
    image: ColorImage | None = Field(
        default=None,
        description="top row first; laid over the object from its front, the object frame's +z, "
        "fitted to its width and height",
    )

    @model_validator(mode="after")
    def _has_image(self) -> Self:
        if self.texture == "image" and (self.image is None or not self.image.size):
            raise ValueError("texture: image has no image; give image_file, or another texture")
        return self


class VirtualObject(Part):
    """The soft object that is seen and touched.

    `support_angle_rad: x` in a scene file is short for `support: {kind: strip, angle_rad: x}`.
    """

    geometry: Geometry
    material: Material
    world_from_object: Pose
    support: Support = Field(description="the part of the skin that does not move")
    appearance: Appearance = Appearance()

    @model_validator(mode="before")
    @classmethod
    def _strip_by_its_angle(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or "support_angle_rad" not in values:
            return values
        if "support" in values:
            raise ValueError(
                "support and support_angle_rad are both given; the latter is short for "
                "support: {kind: strip, angle_rad: ...}, keep one of them"
            )
        rest = {key: value for key, value in values.items() if key != "support_angle_rad"}
        return rest | {"support": {"kind": "strip", "angle_rad": values["support_angle_rad"]}}

    @property
    def support_angle_rad(self) -> float:
        """Angle of the held strip, for who can handle no other support; UnfitGeometryError."""
        if not isinstance(self.support, StripSupport):
            raise UnfitGeometryError(
                f'object.support.kind: "{self.support.kind}" cannot be handled here; use "strip"'
            )
        return self.support.angle_rad


class SheetSpec(Part):
    """The rubber sheet, clamped at its left and right edges (x), free at top and bottom (y)."""

    width_m: Positive = Field(description="slack distance between the clamped edges")
    height_m: Positive = Field(description="length of a clamped edge")
    thickness_m: Positive
    young_modulus_pa: Positive
    max_stretch_ratio: Annotated[float, Field(gt=1)]
    min_stretch_ratio: Annotated[float, Field(ge=1)] = 1.0
    max_edge_force_n: Positive
    usable_half_height_m: Positive = Field(
        description="how far from the sheet's middle line the finger may come"
    )


class ArmSpec(Part):
    """One RV-1A: where it stands and how it holds its edge of the sheet.

    Sheet frame: x from the left edge to the right, y along the edges, z towards the user.
    """

    world_from_base: Pose
    flange_from_edge: Pose = Field(
        description="the middle of the clamped edge, axes as the sheet's, seen from the flange"
    )


class Arms(Part):
    left: ArmSpec
    right: ArmSpec
    max_tool_speed_m_per_s: Positive
    min_distance_m: Positive = Field(description="least distance between the two flanges")
    workspace_min_m: Vector3 = Field(description="corner of the box the flanges stay in, world")
    workspace_max_m: Vector3


class Lens(Part):
    """Pinhole with Brown's distortion (k1, k2, p1, p2, k3), OpenCV's convention, in pixels."""

    fx_px: Positive
    fy_px: Positive
    cx_px: Finite
    cy_px: Finite
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)


class StereoCamera(Part):
    """A rig of two cameras; camera frames have x right, y down, z along the view (OpenCV)."""

    device: str
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    rate_hz: Positive
    exposure_s: Positive
    gain: Finite | None = Field(
        default=None, description="in the device's own units; null: as the device has it"
    )
    read_noise_levels: Positive = Field(
        default=1.5, description="standard deviation of a dark pixel, of 255 levels"
    )
    photons_per_level: Positive = Field(
        default=40.0, description="a level L has the shot noise sqrt(L / photons_per_level)"
    )
    left: Lens
    right: Lens
    right_from_left: Transform
    world_from_left: Pose


class Projector(Part):
    """A projector as a camera run backwards: same lens model, z along the light."""

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    lens: Lens
    world_from_projector: Pose


class Eyes(Part):
    """The point of view V; the eyes stand half the interocular distance to either side along x."""

    centre_world_m: Vector3
    interocular_m: NonNegative


class Finger(Part):
    radius_m: Positive
    max_speed_m_per_s: Positive
    volume_min_m: Vector3 = Field(description="corner of the box a fingertip can be in, world")
    volume_max_m: Vector3


class WorkingRange(Part):
    """What the user may do; limits and charts are taken over it."""

    push_depth_m: Positive
    tilt_rad: Positive
    speed_m_per_s: Positive


class Tolerances(Part):
    """How good is good enough; each method family is tuned against one of these."""

    image_m: Positive = Field(description="displacement of the picture as the eye sees it")
    fingertip_m: Positive
    skin_m: Positive = Field(description="skin displacement outside 1.5 finger radii")
    force_ratio: Positive
    sheet_position_m: Positive
    latency_s: Positive


class Scene(Message):
    """Everything that the nodes must agree on."""

    name: str
    object: VirtualObject
    sheet: SheetSpec
    arms: Arms
    camera: StereoCamera
    projector: Projector
    eyes: Eyes
    finger: Finger
    working_range: WorkingRange
    tolerances: Tolerances
    methods: Methods = Field(
        default_factory=Methods, description="methods of nodes whose parameter has the value `auto`"
    )


class UnfitGeometryError(FlexsheetError, ValueError):
    """A scene whose object has a shape that the asker cannot handle."""

    code = "unfit-geometry"
    remedy = "Choose an object of a shape that this command supports."


def require_cylinder(scene: Scene) -> Cylinder:
    """The scene's geometry, for who can handle no other than a cylinder; UnfitGeometryError."""
    geometry = scene.object.geometry
    if not isinstance(geometry, Cylinder):
        raise UnfitGeometryError(
            f'object.geometry.shape: "{geometry.shape}" cannot be handled here; use "cylinder"'
        )
    return geometry
