"""List the keys of scene files with their types, units, defaults and effects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import NoneType
from typing import Annotated, Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flexsheet.launch.objects.meshes import MeshFile
from flexsheet.messages.field_types import describe_bounds, describe_field_type
from flexsheet.messages.scene import Lens, Mesh, Pose, Scene
from flexsheet.messages.units import find_unit

LEAVES: tuple[type[BaseModel], ...] = (Pose, Lens)
"""The types whose keys form separate groups, because several other types contain these types."""

EFFECTS: Mapping[str, str] = {
    "name": "name in logs, bags and reports",
    "object.material.young_modulus_pa": "stiffness of the object; determines force and deformation",
    "object.material.poisson_ratio": "lateral expansion under compression; close to 0.5: nearly "
    "constant volume",
    "object.world_from_object": "position and orientation of the object",
    "object.geometry.radius_m": "radius",
    "object.geometry.length_m": "length along the axis",
    "object.geometry.edge_radius_m": "radius of the rounded edges",
    "object.support.centre_m": "centre of the sphere, object frame",
    "object.support.radius_m": "radius of the sphere",
    "object.support.max_m": "upper corner of the box, object frame",
    "object.support.min_m": "lower corner of the box, object frame",
    "object.appearance.texture": "texture of the rendered object",
    "sheet.thickness_m": "thickness of the rubber; determines the force for a stretch",
    "sheet.young_modulus_pa": "stiffness of the rubber; determines the force for a stretch",
    "sheet.max_stretch_ratio": "maximum length over slack length that the planner commands",
    "sheet.min_stretch_ratio": "minimum length over slack length that the planner commands",
    "sheet.max_edge_force_n": "maximum force of the sheet on an arm that the planner commands",
    "arms.left.world_from_base": "base of the left arm",
    "arms.right.world_from_base": "base of the right arm",
    "arms.max_tool_speed_m_per_s": "speed limit of both flanges",
    "arms.workspace_max_m": "upper corner of the box that limits the flanges, world",
    "camera.device": "name of the stereo rig; images of another one are refused",
    "camera.width_px": "width of an image",
    "camera.height_px": "height of an image",
    "camera.rate_hz": "image pairs per second",
    "camera.exposure_s": "exposure time; a fingertip is stamped at its middle",
    "camera.left": "left lens",
    "camera.right": "right lens",
    "camera.right_from_left": "4x4 transform from the left to the right camera frame",
    "camera.world_from_left": "pose of the left camera",
    "projector.width_px": "width of a frame",
    "projector.height_px": "height of a frame",
    "projector.lens": "lens of the projector",
    "projector.world_from_projector": "pose of the projector",
    "eyes.centre_world_m": "point between the eyes; images are corrected for it",
    "eyes.interocular_m": "distance between the eyes; 0: one eye",
    "finger.radius_m": "radius of the fingertip, for contact and deformation",
    "finger.max_speed_m_per_s": "maximum speed of a fingertip that the tracking assumes",
    "finger.volume_max_m": "upper corner of the box of possible fingertips, world",
    "working_range.push_depth_m": "maximum depth of a push",
    "working_range.tilt_rad": "maximum tilt of the sheet",
    "working_range.speed_m_per_s": "maximum speed of a stroke",
    "tolerances.fingertip_m": "error of the fingertip's position",
    "tolerances.force_ratio": "relative error of the force",
    "tolerances.sheet_position_m": "distance between the sheet and the finger",
    "tolerances.latency_s": "time from the exposure to a frame",
    "methods.marker": "detection of the marker in an image",
    "methods.tracking": "motion model of the fingertip",
    "methods.sheet_force": "model of the sheet's force",
    "methods.sheet_shape": "model of the sheet's shape for the image correction",
    "methods.correction": "correction of the projected image",
    "methods.soft_body.method": "deformation of the object",
    "methods.soft_body.skin_spacing_m": "distance of the nodes on the object's surface",
    "position_m": "origin of the frame",
    "rpy_rad": "rotations about the fixed axes x, y and z, in this order",
    "fx_px": "focal length in x",
    "fy_px": "focal length in y",
    "cx_px": "principal point in x",
    "cy_px": "principal point in y",
    "distortion": "Brown's coefficients k1, k2, p1, p2, k3 in OpenCV's convention",
}
"""The effects of keys that the message types do not describe sufficiently."""


class SceneKey(NamedTuple):
    """A row in the reference table of scene files; `type` and `effect` are Markdown."""

    key: str
    type: str
    unit: str
    default: str
    effect: str


@dataclass(frozen=True, slots=True)
class KeyGroup:
    """A group of keys with a heading.

    is_variant: whether the keys describe one of several possible shapes or supports.
    """

    title: str
    about: str
    keys: tuple[SceneKey, ...]
    is_variant: bool = False


def list_groups() -> Iterator[KeyGroup]:
    """Yield all groups of keys, in the order of the scene file."""
    yield KeyGroup("Top level", "", tuple(_rows(Scene, "", recursive=False)))
    for name, field in Scene.model_fields.items():
        kind = _single_model(field.annotation)
        if kind is None:
            continue
        yield KeyGroup(name, _first_paragraph(kind), tuple(_rows(kind, f"{name}.")))
        if name == "object":
            yield from _variants("geometry", kind)
            yield from _variants("support", kind)
    for leaf in LEAVES:
        yield KeyGroup(leaf.__name__, _first_paragraph(leaf), tuple(_rows(leaf, "")))


def _variants(key: str, kind: type[BaseModel]) -> Iterator[KeyGroup]:
    """Yield the keys of each type of geometry or of support that an object can have.

    key: "geometry" or "support".
    """
    field = kind.model_fields[key]
    for variant in get_args(field.annotation):
        if variant is NoneType:
            continue
        model = MeshFile if variant is Mesh else variant
        tag = next(iter(get_args(model.model_fields[str(field.discriminator)].annotation)))
        yield KeyGroup(
            f"{key}: {tag.replace('_', ' ')}",
            _first_paragraph(model),
            tuple(_rows(model, f"object.{key}.")),
            is_variant=True,
        )


def _rows(kind: type[BaseModel], prefix: str, *, recursive: bool = True) -> Iterator[SceneKey]:
    for name, field in kind.model_fields.items():
        inner = _single_model(field.annotation)
        if inner is not None and inner not in LEAVES:
            if recursive:
                yield from _rows(inner, f"{prefix}{name}.")
        elif field.discriminator is not None:
            effect = field.description or "shape of the object"
            yield SceneKey(f"{prefix}{name}", "one of the types below", "", _default(field), effect)
        elif prefix + name == "object.appearance.image":
            yield SceneKey(
                "object.appearance.image_file", "str", "", "none",
                "image file for `texture: image`, relative to the scene file",
            )  # fmt: skip
        else:
            effect = EFFECTS.get(prefix + name) or field.description or _tag_effect(field)
            yield SceneKey(
                f"{prefix}{name}", _type(field), find_unit(name), _default(field), effect
            )


def _tag_effect(field: FieldInfo) -> str:
    return "selects this type" if len(get_args(field.annotation)) == 1 else ""


def _type(field: FieldInfo) -> str:
    return ", ".join([describe_field_type(field), *dict.fromkeys(describe_bounds(field))])


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)


def _single_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model of an annotation `Model` or `Model | None`; None for other annotations."""
    if get_origin(annotation) is Annotated:
        return None
    kinds = [one for one in (annotation, *get_args(annotation)) if isinstance(one, type)]
    models = [one for one in kinds if issubclass(one, BaseModel)]
    return models[0] if len(models) == 1 else None


def _first_paragraph(kind: type[BaseModel]) -> str:
    return " ".join((kind.__doc__ or "").strip().split("\n\n")[0].split())
