"""Load the scenes of a run, and change a scene according to the page's sliders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Geometry, Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rotation_from_rpy
from flexsheet.nodes.models.shapes import GEOMETRIES
from flexsheet.nodes.models.sheet.tension import stretch_for_edge_force

MIN_STRETCH_RATIO, STRETCH_STEP = 1.005, 0.001
"""The minimum value and the step of the slider for the sheet's tension, as stretch ratios."""


class SceneChoiceError(FlexsheetError, ValueError):
    """The error raised if a scene cannot be used."""

    remedy = "Choose a scene with the devices of the running one."


def first_scene(plan_file: Path) -> Scene:
    """Return the scene of the run's plan; raise SceneChoiceError if the plan has no scene."""
    values = json.loads(plan_file.read_text())["scene"]
    if values is None:
        raise SceneChoiceError('the launch file has no scene; set its key "scene" for the console')
    return Scene.model_validate(values)


def list_scene_names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.json"))


def load(folder: Path, name: str) -> Scene:
    """Load a scene from the run's folder; raise SceneChoiceError if the name is unknown."""
    names = list_scene_names(folder)
    if name not in names:
        raise SceneChoiceError(f'unknown scene "{name}"; choose one of: {", ".join(names)}')
    return Scene.model_validate_json((folder / f"{name}.json").read_text())


def edit_scene(
    scene: Scene, *, young_modulus_pa: float | None, stretch_ratio: float, size_ratio: float
) -> Scene:
    """Change the object's stiffness, the sheet's minimum stretch and the object's size.

    size_ratio: size relative to the size in `scene`.

    The front of the object stays in place, and the object grows away from the user. A rigid object
    stays rigid. Raises SceneChoiceError if a value is invalid.
    """
    values: dict[str, Any] = {name: getattr(scene, name) for name in type(scene).model_fields}
    solid, sheet = scene.object, scene.sheet
    try:
        geometry = scale_geometry(solid.geometry, size_ratio)
        pose = solid.world_from_object
        rotation = rotation_from_rpy(pose.rpy_rad)
        back_m = front_m(solid.geometry, rotation) * (size_ratio - 1.0)
        position_m = pose.position_m - np.array([0.0, 0.0, back_m])
        material = solid.material
        if material is not None and young_modulus_pa is not None:
            material = _with(material, young_modulus_pa=young_modulus_pa)
        pose = _with(pose, position_m=position_m)
        values["object"] = _with(
            solid, geometry=geometry, material=material, world_from_object=pose
        )
        limit = max_stretch_ratio(scene)
        if stretch_ratio > limit + STRETCH_STEP:
            raise SceneChoiceError(
                f"tension: {100 * (stretch_ratio - 1):.1f} % is above {100 * (limit - 1):.1f} %, "
                "the maximum that max_stretch_ratio and max_edge_force_n of the scene's sheet "
                "permit; lower the tension"
            )
        values["sheet"] = _with(sheet, min_stretch_ratio=min(stretch_ratio, limit))
        return Scene(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(step) for step in first["loc"])
        raise SceneChoiceError(f"{where}: {first['msg']}") from error


def max_stretch_ratio(scene: Scene) -> float:
    """Return the upper limit of the tension slider as a stretch ratio.

    The result depends on the limits of the scene's sheet and arms.
    """
    sheet = scene.sheet
    strongest = stretch_for_edge_force(sheet.max_edge_force_n, sheet)
    limit = min(sheet.max_stretch_ratio, strongest)
    # Round down to the slider's step, but never below the stretch of the scene itself.
    steps = np.floor((limit - 1.0) / STRETCH_STEP + 1e-6)
    return max(1.0 + float(steps) * STRETCH_STEP, sheet.min_stretch_ratio, MIN_STRETCH_RATIO)


def _with(part: Any, **changes: Any) -> Any:
    fields = {name: getattr(part, name) for name in type(part).model_fields}
    return type(part)(**fields | changes)


def scale_geometry(geometry: Geometry, ratio: float) -> Geometry:
    """Scale a shape about its origin; return a plane unchanged.

    Raises SceneChoiceError if the ratio is not a positive number.
    """
    if not (np.isfinite(ratio) and ratio > 0.0):
        raise SceneChoiceError(
            f"size: the factor {ratio} is not a positive number; move the slider Size again"
        )
    changes = GEOMETRIES[geometry.shape].scale(geometry, ratio)
    return _with(geometry, **changes)  # type: ignore[no-any-return]  # of the same type


def front_m(geometry: Geometry, world_from_object: Floats) -> float:
    """Return how far (m) an object's touchable surface extends from its origin towards the user.

    world_from_object: rotation matrix (3, 3) of the object.

    The distance is measured along the world's z axis, which points to the user. The ends of a
    cylinder are not touchable.
    """
    return GEOMETRIES[geometry.shape].extent_m(geometry, world_from_object[2])
