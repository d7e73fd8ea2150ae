"""Measure the size errors of the image on an inclined sheet and on a pushed sheet.

These are the experiments of Furukawa et al. 2007, section VI, Figs. 11 and 13. A correction is a
method that corrects the image for the sheet's shape. A simulated case combines an angle or a depth
with a correction. The label of the case is stored in the renderer's frames and in the simulated
eye's images. The results are computed from the eye's images in the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments import find_recorded
from flexsheet.launch.experiments.stroke import object_pose
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.types import Correction, FingerPath, TwinEye
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.twin.eye import push_sizes, tilt_sizes

CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
HOVER_M = 0.03
REACH_S = 1.5


def reach_path(scene: Scene, label: str, points: Sequence[tuple[float, float]]) -> FingerPath:
    """Return a finger path through points near the cylinder.

    points: angle (rad) around the cylinder and height (m) above its surface, for each point.
    """
    radius = require_cylinder(scene).radius_m
    local = [
        [0.0, (radius + height_m) * np.sin(angle_rad), (radius + height_m) * np.cos(angle_rad)]
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


def push_path(scene: Scene, depth_mm: float) -> FingerPath:
    """Return the path of a finger that pushes the front of the cylinder to a depth."""
    points = [(0.0, HOVER_M), (0.0, -depth_mm * 1e-3)]
    return reach_path(scene, f"push {depth_mm:g} mm", points)


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


@dataclass(frozen=True, slots=True)
class EyeImage:
    """An image that the simulated eye sees, and the image that it should see (`expected`)."""

    label: str
    correction: Correction
    metres_per_px: float
    seen: NDArray[np.uint8]
    expected: NDArray[np.uint8]


def read_images(bag: Path) -> dict[str, EyeImage]:
    """Read images of the simulated eye from a bag: the newest image of each label."""
    images = {}
    for _, message, _, _ in BagReader(bag, topics=["twin/eye"]):
        if isinstance(message, TwinEye):
            images[message.label] = EyeImage(
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


def make_rows(images: dict[str, EyeImage], series: Series) -> list[dict[str, Any]]:
    """Return the results of an image experiment as table rows.

    There is one row for each value of the varied quantity and each image correction.
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
