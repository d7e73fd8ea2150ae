"""Measure the size errors of the image on an inclined sheet and on a pushed sheet.

These are the experiments of Furukawa et al. 2007, section VI, Figs. 11 and 13. A correction is a
method that corrects the image for the sheet's shape. A simulated case combines an angle or a depth
with a correction. The label of the case is stored in the renderer's frames and in the simulated
eye's images. The results are computed from the eye's images in the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments import ExperimentError, find_recorded
from flexsheet.launch.experiments.stroke import object_pose
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.types import Correction, FingerPath, Pattern, TwinEye, Viewpoint
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.twin.error_map import ErrorMap, error_map
from flexsheet.nodes.twin.eye import push_sizes, tilt_sizes

CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
HOVER_M = 0.03
REACH_S = 1.5


def reach_path(
    scene: Scene, label: str, points: Sequence[tuple[float, float]], *, along_m: float = 0.0
) -> FingerPath:
    """Return a finger path through points near the cylinder.

    points: angle (rad) around the cylinder and height (m) above its surface, for each point.
    along_m: position along the cylinder's axis, from its centre.
    """
    radius = require_cylinder(scene).radius_m
    local = [
        [along_m, (radius + height_m) * np.sin(angle_rad), (radius + height_m) * np.cos(angle_rad)]
        for angle_rad, height_m in points
    ]
    return FingerPath(
        label=label,
        times_s=REACH_S * np.arange(1.0, len(points) + 1.0),
        positions_world_m=apply(object_pose(scene), np.array(local)),
        wander_m=0.0,
        tremor_m=0.0,
    )


def tilt_path(scene: Scene, theta_deg: float) -> FingerPath:
    """Return a finger path to a point above the cylinder.

    theta_deg: angle of the point around the cylinder's axis. The sheet is inclined by this angle.
    """
    return reach_path(scene, f"tilt {theta_deg:+g} deg", [(float(np.radians(theta_deg)), HOVER_M)])


def push_path(
    scene: Scene, depth_mm: float, *, along_mm: float = 0.0, tilt_deg: float = 0.0
) -> FingerPath:
    """Return the path of a finger that pushes the side of the cylinder to a depth.

    along_mm: position along the axis, measured from the centre.
    tilt_deg: angle around the axis, measured from the front.

    Raises ExperimentError if the position is not on the cylinder, or more than 60° from its front.
    """
    cylinder = require_cylinder(scene)
    if abs(along_mm) > 500.0 * cylinder.length_m or abs(tilt_deg) > 60.0:
        raise ExperimentError(
            f"--at {along_mm:g} mm, --tilt {tilt_deg:g}°: the limits on the cylinder's side are "
            f"±{500.0 * cylinder.length_m:g} mm and ±60° from the centre of its front; "
            "give smaller values"
        )
    label, angle = f"push {depth_mm:g} mm", float(np.radians(tilt_deg))
    points = [(angle, HOVER_M), (angle, -depth_mm * 1e-3)]
    return reach_path(scene, label, points, along_m=along_mm * 1e-3)


@dataclass(frozen=True, slots=True)
class Series:
    """An image experiment in which one quantity, such as the push depth, varies.

    key: name of the varied quantity in the results.
    name: format string that makes the name of a case from the value of the quantity.
    path: function that makes the finger path for a value of the quantity.
    sizes: function that measures the sizes (m) of the cylinder in an image.
    size_names: symbols of these sizes in Furukawa et al. 2007.
    values: default values of the quantity.
    """

    key: str
    name: str
    path: Callable[[Scene, float], FingerPath]
    sizes: Callable[[NDArray[np.uint8], float], tuple[float, ...]]
    size_names: tuple[str, ...]
    values: tuple[float, ...]

    def label(self, value: float, correction: Correction) -> str:
        return f"{self.name.format(value)}, {correction}"


TILT = Series(
    "theta_deg",
    "tilted {:+g}°",
    tilt_path,
    tilt_sizes,
    ("h", "u", "d"),
    (-50, -40, -30, -20, -10, 10, 20, 30, 40, 50),
)
PUSH = Series("depth_mm", "pushed {:g} mm", push_path, push_sizes, ("h", "w"), (10, 20, 30, 40, 50))


def make_push_series(along_mm: float, tilt_deg: float) -> Series:
    """Return a series of simulated pushes with increasing depth at a position on the cylinder.

    along_mm: position along the axis, measured from the centre.
    tilt_deg: angle around the axis, measured from the front.
    """
    if not along_mm and not tilt_deg:
        return PUSH
    return replace(
        PUSH,
        name=f"pushed {{:g}} mm at {along_mm:g} mm, {tilt_deg:+g}°",
        path=partial(push_path, along_mm=along_mm, tilt_deg=tilt_deg),
    )


RAMPS: tuple[Pattern, ...] = ("coordinate_ramp_x", "coordinate_ramp_y")
"""The patterns whose brightness is the x or y coordinate on the screen plane.

They are used to measure the image error at all visible points.
"""


def make_pattern_label(label: str, pattern: Pattern) -> str:
    """Return the label of an image that shows a pattern.

    label: label of the simulated case.
    """
    return f"{label}, {pattern}"


def make_eyes_label(label: str, pattern: Pattern) -> str:
    """Return the label of the images that show a pattern to each eye separately.

    label: label of the simulated case.
    """
    return f"{make_pattern_label(label, pattern)}, both eyes"


def make_eye_key(label: str, viewpoint: Viewpoint) -> str:
    """Return the key of an eye image in the result of `read_images`."""
    return label if viewpoint == "centre" else f"{label}, {viewpoint}"


@dataclass(frozen=True, slots=True)
class EyeImage:
    """An image that the simulated eye sees, and the image that it should see (`expected`)."""

    label: str
    correction: Correction
    metres_per_px: float
    seen: NDArray[np.uint8]
    expected: NDArray[np.uint8]


def read_images(bag: Path) -> dict[str, EyeImage]:
    """Read images of the simulated eye from a bag: the newest image of each label and viewpoint."""
    images = {}
    for _, message, _, _ in BagReader(bag, topics=["twin/eye"]):
        if isinstance(message, TwinEye):
            images[make_eye_key(message.label, message.viewpoint)] = EyeImage(
                message.label,
                message.correction,
                message.metres_per_px,
                message.seen,
                message.expected,
            )
    return images


def size_errors_mm(
    image: EyeImage, sizes: Callable[[NDArray[np.uint8], float], tuple[float, ...]]
) -> list[float]:
    """Return the absolute differences (mm) between sizes in the seen image and the expected image.

    sizes: function that measures the sizes of the cylinder, as in Furukawa et al. 2007.
    """
    measured = np.array(sizes(image.seen, image.metres_per_px))
    expected = np.array(sizes(image.expected, image.metres_per_px))
    return [float(error) for error in np.abs(measured - expected) * 1e3]


def make_error_map(images: dict[str, EyeImage], label: str) -> ErrorMap:
    """Compute the position errors of the image points that the eye sees in a simulated case.

    The errors are computed from two images of coordinate ramps. A coordinate ramp is a pattern
    whose brightness encodes the x or the y coordinate.

    label: label of the case.
    """
    x, y = (find_recorded(images, "image", make_pattern_label(label, pattern)) for pattern in RAMPS)
    return error_map(x.seen, y.seen, x.metres_per_px)


def make_eye_maps(images: dict[str, EyeImage], label: str) -> tuple[ErrorMap, ErrorMap]:
    """Compute the errors of the visible image points in a simulated case, for each eye."""

    def errors_of(viewpoint: Viewpoint) -> ErrorMap:
        x, y = (
            find_recorded(images, "image", make_eye_key(make_eyes_label(label, pattern), viewpoint))
            for pattern in RAMPS
        )
        return error_map(x.seen, y.seen, x.metres_per_px)

    return errors_of("left"), errors_of("right")


def summarize_eyes(left: ErrorMap, right: ErrorMap) -> dict[str, float | None]:
    """Return the mean image errors (mm) of both eyes, and of the disparity.

    The disparity error is the error of the right eye minus the error of the left eye. It is
    computed where both eyes see the object, separately in the horizontal and the vertical
    direction. A mean is None if there are no points.
    """
    disparity_mm = 1e3 * np.abs(right.errors_m - left.errors_m)
    across_mm, up_mm = (
        part[np.isfinite(part)] for part in (disparity_mm[..., 0], disparity_mm[..., 1])
    )
    means = {
        "left_mean_mm": 1e3 * left.sizes_m,
        "right_mean_mm": 1e3 * right.sizes_m,
        "disparity_mean_mm": across_mm,
        "vertical_disparity_mean_mm": up_mm,
    }
    summary = {name: float(part.mean()) if len(part) else None for name, part in means.items()}
    return summary | {
        "disparity_p95_mm": float(np.quantile(across_mm, 0.95)) if len(across_mm) else None
    }


def make_rows(
    images: dict[str, EyeImage],
    series: Series,
    *,
    with_maps: bool = False,
    with_eyes: bool = False,
) -> list[dict[str, Any]]:
    """Return the results of an image experiment as table rows.

    There is one row for each value of the varied quantity and each image correction.

    with_maps: whether to add mean, 95 % quantile and maximum of the errors at all visible points.
    with_eyes: whether to add the errors of both eyes and of the disparity.
    """
    result = []
    for value in series.values:
        for correction in CORRECTIONS:
            image = find_recorded(images, "image", series.label(value, correction))
            errors = size_errors_mm(image, series.sizes)
            row: dict[str, Any] = {series.key: value, "method": correction}
            row.update(
                (f"delta_{name}_mm", error)
                for name, error in zip(series.size_names, errors, strict=True)
            )
            row["mean_mm"] = float(np.mean(errors))
            if with_maps:
                row |= summarize_map(make_error_map(images, series.label(value, correction)))
            if with_eyes:
                row |= summarize_eyes(*make_eye_maps(images, series.label(value, correction)))
            result.append(row)
    return result


def summarize_methods(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return mean and maximum error (mm) of the visible object size for each image correction."""
    return {
        method: {
            "mean_mm": float(np.mean([row["mean_mm"] for row in rows if row["method"] == method])),
            "max_mm": max(
                abs(value)
                for row in rows
                if row["method"] == method
                for key, value in row.items()
                if key.startswith("delta_")
            ),
        }
        for method in dict.fromkeys(row["method"] for row in rows)
    }


def summarize_map(errors: ErrorMap) -> dict[str, float | None]:
    """Return the mean, 95 % quantile and maximum image error (mm) over all visible points.

    All values are None if there are no visible points.
    """
    sizes_mm = 1e3 * errors.sizes_m
    if len(sizes_mm) == 0:
        return dict.fromkeys(("map_mean_mm", "map_p95_mm", "map_max_mm"))
    return {
        "map_mean_mm": float(sizes_mm.mean()),
        "map_p95_mm": float(np.quantile(sizes_mm, 0.95)),
        "map_max_mm": float(sizes_mm.max()),
    }
