"""Measure the time and the image error of the methods that correct the projected image.

The time is measured for drawing a stereo frame, without reading its pixels. The error is measured
at each point that the eye sees on a reference sheet. The caller computes the reference sheet
independently of the renderer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import cast, get_args

import numpy as np

from flexsheet.messages.scene import Cylinder, Scene, require_cylinder
from flexsheet.messages.types import Correction, Display, Pattern
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.methods import Family, Trial
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.object_surface import make_surface
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet
from flexsheet.nodes.renderer.sheet_mesh import MAX_TRIANGLES_DEPTH_M, pyramid_mesh

ErrorMeasure = Callable[[Image, Image], Floats]
"""A function that computes the errors (n,), m, at all visible points of the object. Its arguments
are the projector's images of the patterns `coordinate_ramp_x` and `coordinate_ramp_y`."""

ReferenceFactory = Callable[[Scene, Floats, Floats, Floats | None], ErrorMeasure]
"""A function that returns an `ErrorMeasure`. Its arguments are a scene, the poses (4, 4) of the
sheet's left and right edges, and the fingertip (3,), m. The fingertip is None if the sheet is not
pushed."""

TWO_PASS_TRIANGLES = "two_pass_triangles"
"""The name of the method two_pass with a sheet mesh of four triangles."""

METHODS = (*get_args(Correction), TWO_PASS_TRIANGLES)
CASES: tuple[tuple[float, float], ...] = (
    *((tilt, 0) for tilt in (-50, -30, 30, 50)),
    *((0, depth) for depth in (0, 10, 20, 30, 40, 50)),
)
"""The cases of the benchmark: pairs of the sheet's tilt (degrees) and the push depth (mm)."""
STRETCH = 1.05
SPACING_M = 0.0025


def correction_family(reference: ReferenceFactory) -> Family:
    """Define the benchmark of all image correction methods for tilted and pushed sheets.

    The cases are those of figures 11 and 13 in Furukawa et al. 2007. Further cases are at the
    limits of the scene's working range.

    reference: function that computes the reference sheet of a case.
    """
    return Family(
        name="correction",
        unit="mm",
        reference="rms error at the points that the eye sees on the simulated sheet",
        methods=METHODS,
        trials=partial(_trials, reference),
        prepare=lambda scene, progress: deflection_cache.load_or_compute(scene, None, progress),
        tolerance=lambda scene: 1e3 * scene.tolerances.image_m,
    )


def is_in_range(method: str, *, tilt_deg: float, push_mm: float) -> bool:
    """Return whether a tilt (degrees) and a push depth (mm) are in the valid range of a correction
    method.

    The method `none` requires a sheet that is neither tilted nor pushed. The method `one_plane`
    requires a sheet that is not pushed. The method `four_triangles` requires a push depth of at
    most `MAX_TRIANGLES_DEPTH_M`. All methods except `none` are valid for tilts of up to 50 degrees.
    """
    max_triangles_mm = 1e3 * MAX_TRIANGLES_DEPTH_M
    if method == "none":
        return tilt_deg == 0 and push_mm == 0
    deepest_mm = {
        "four_triangles": max_triangles_mm,
        TWO_PASS_TRIANGLES: max_triangles_mm,
        "two_pass": 60.0,
    }.get(method, 0.0)
    return push_mm <= deepest_mm and abs(tilt_deg) <= 50.0


def roll_sheet(
    scene: Scene, tilt_rad: float, contact_m: tuple[float, float] | None = None
) -> Floats:
    """Return the pose world_from_sheet (4, 4) of a tilted sheet that touches the object.

    contact_m: contact point (x, y) on the sheet, m. If it is None and the object is a cylinder, the
    sheet has rolled from zero tilt without slipping. If it is None and the object is not a
    cylinder, the sheet's centre touches the point nearest to the user.
    """
    if not isinstance(scene.object.geometry, Cylinder):
        return _lay_sheet(scene, tilt_rad, contact_m or (0.0, 0.0))
    radius = require_cylinder(scene).radius_m
    axis = pose_matrix(scene.object.world_from_object)[:3, 3]
    rotation = rotation_from_vector([tilt_rad, 0.0, 0.0])
    x, y = (0.0, -radius * tilt_rad) if contact_m is None else contact_m
    return transform(rotation, axis + rotation @ np.array([-x, -y, radius]))


def _lay_sheet(scene: Scene, tilt_rad: float, contact_m: tuple[float, float]) -> Floats:
    geometry = scene.object.geometry
    skin = make_surface(
        geometry,
        make_shape(dict(geometry)),
        world_from_object=pose_matrix(scene.object.world_from_object),
        spacing_m=SPACING_M,
    ).rest_world_m
    rotation = rotation_from_vector([tilt_rad, 0.0, 0.0])
    nearest_to_user = skin[(skin @ rotation[:, 2]).argmax()]
    return transform(rotation, nearest_to_user - rotation @ np.array([*contact_m, 0.0]))


def scene_cases(scene: Scene) -> tuple[tuple[float, float], ...]:
    """Return cases (tilt in degrees, push depth in mm) at the limits of a scene's working range."""
    tilt = round(float(np.degrees(scene.working_range.tilt_rad)), 1)
    return ((-tilt, 0.0), (tilt, 0.0), (0.0, round(1e3 * scene.working_range.push_depth_m, 3)))


def _trials(reference: ReferenceFactory, scene: Scene) -> Iterator[Trial]:
    context = headless_context()
    scene_renderer = SceneRenderer(
        scene,
        context,
        spacing_m=SPACING_M,
        basis=deflection_cache.load_or_compute(scene, None),
    )
    largest_deg = np.degrees(scene.working_range.tilt_rad) + 0.1
    for tilt_deg, push_mm in dict.fromkeys((*CASES, *scene_cases(scene))):
        if push_mm > 1e3 * scene.working_range.push_depth_m + 1e-9:
            continue
        sheet, get_measure = _make_situation(scene, reference, tilt_deg=tilt_deg, push_mm=push_mm)
        for method in METHODS:
            yield Trial(
                method=method,
                case={"tilt_deg": tilt_deg, "push_mm": push_mm},
                run=partial(draw_stereo, scene_renderer, method, sheet),
                error=partial(_error_mm, scene_renderer, method, sheet, get_measure),
                in_range=is_in_range(method, tilt_deg=tilt_deg, push_mm=push_mm),
                in_scene=abs(tilt_deg) <= largest_deg,
            )
    context.release()


def _make_situation(
    scene: Scene, reference: ReferenceFactory, *, tilt_deg: float, push_mm: float
) -> tuple[SheetPose, Callable[[], ErrorMeasure]]:
    """Return the sheet's pose in a benchmark case, as the renderer predicts it.

    A second result is a function. When it is called, it computes the reference sheet, and returns
    the function that measures the image error.
    """
    pose = roll_sheet(scene, np.radians(tilt_deg))
    edges = edge_poses(pose, scene.sheet.width_m * STRETCH)
    tip = pose[:3, 3] - 1e-3 * push_mm * pose[:3, 2] if push_mm else None
    predicted = estimate_sheet(*edges, height_m=scene.sheet.height_m, finger_tip=tip)
    assert predicted is not None
    return predicted, cache(lambda: reference(scene, *edges, tip))


def draw_stereo(scene_renderer: SceneRenderer, method: str, sheet: SheetPose) -> None:
    """Draw one stereo frame by a correction method."""
    display = Display(correction=_get_correction(method), stereo="side_by_side")
    look = DrawStyle(flat=False, pattern="object")
    _draw(scene_renderer, method, display, sheet, look, read=False)


def _get_correction(method: str) -> Correction:
    return "two_pass" if method == TWO_PASS_TRIANGLES else cast(Correction, method)


def _draw(
    scene_renderer: SceneRenderer,
    method: str,
    display: Display,
    sheet: SheetPose,
    look: DrawStyle,
    *,
    read: bool,
) -> Image | None:
    if method == TWO_PASS_TRIANGLES:
        return scene_renderer.draw_onto(display, pyramid_mesh(sheet), look, read=read)
    return scene_renderer.draw(display, sheet, look, read=read)


def draw_coordinate_ramps(
    scene_renderer: SceneRenderer, method: str, sheet: SheetPose
) -> tuple[Image, Image]:
    """Draw the projector's images in which colours encode the x and y coordinates of the object.

    Returns the images of the patterns `coordinate_ramp_x` and `coordinate_ramp_y` for one eye. The
    image error is computed from them.
    """
    images = []
    for pattern in COORDINATE_RAMPS:
        display = Display(correction=_get_correction(method), stereo="mono", pattern=pattern)
        look = DrawStyle(flat=True, pattern=pattern)
        image = _draw(scene_renderer, method, display, sheet, look, read=True)
        assert image is not None
        images.append(image)
    return images[0], images[1]


COORDINATE_RAMPS: tuple[Pattern, Pattern] = ("coordinate_ramp_x", "coordinate_ramp_y")


def _error_mm(
    scene_renderer: SceneRenderer,
    method: str,
    sheet: SheetPose,
    get_measure: Callable[[], ErrorMeasure],
    _drawn: None,
) -> float:
    """Return the root mean square position error of all visible object points, in mm.

    The error is infinite if no point is visible.
    """
    errors_m = get_measure()(*draw_coordinate_ramps(scene_renderer, method, sheet))
    return 1e3 * float(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else float("inf")
