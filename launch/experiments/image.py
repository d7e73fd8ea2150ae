"""Section VI of the paper: the picture on an inclined sheet (Fig. 11) and a pushed one (Fig. 13).

Each case is a label: the renderer puts it into its frames, the twin's eye into its pictures, and
the rows are computed from the pictures in the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.stroke import object_pose
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene, cylinder_of
from flexsheet.messages.types import Correction, FingerPath, Pattern, TwinEye
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.twin.error_map import ErrorMap, error_map
from flexsheet.nodes.twin.eye import push_sizes, tilt_sizes

CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
HOVER_M = 0.03
REACH_S = 1.5


def reach_path(
    scene: Scene, label: str, points: Sequence[tuple[float, float]], *, along_m: float = 0.0
) -> FingerPath:
    """Go straight from point to point, each (angle around the cylinder, height above its side).

    along_m: from the cylinder's middle, along its axis.
    """
    radius = cylinder_of(scene).radius_m
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
    """Hover above the cylinder at that angle: the sheet waits there, inclined by it."""
    return reach_path(scene, f"tilt {theta_deg:+g} deg", [(float(np.radians(theta_deg)), HOVER_M)])


def push_path(
    scene: Scene, depth_mm: float, *, along_mm: float = 0.0, tilt_deg: float = 0.0
) -> FingerPath:
    """Push the cylinder's side by that depth, from above.

    Where: along its axis from the middle, and around it from the front, which inclines the sheet.
    ExperimentError for a place that is not on the side that can be touched.
    """
    cylinder = cylinder_of(scene)
    if abs(along_mm) > 500.0 * cylinder.length_m or abs(tilt_deg) > 60.0:
        raise ExperimentError(
            f"--at {along_mm:g} mm, --tilt {tilt_deg:g}°: the cylinder's side can be touched to "
            f"{500.0 * cylinder.length_m:g} mm and 60° from the middle of its front"
        )
    label, angle = f"push {depth_mm:g} mm", float(np.radians(tilt_deg))
    points = [(angle, HOVER_M), (angle, -depth_mm * 1e-3)]
    return reach_path(scene, label, points, along_m=along_mm * 1e-3)


@dataclass(frozen=True, slots=True)
class Series:
    """One of the two experiments: what is varied, how the finger does it, what is measured.

    name: with the value, what a case is called.  sizes: of the cylinder in a picture (m);
    size_names: their letters in the paper.
    """

    key: str
    name: str
    path: Callable[[Scene, float], FingerPath]
    sizes: Callable[[NDArray[np.uint8], float], tuple[float, ...]]
    size_names: tuple[str, ...]
    values: tuple[float, ...]

    def label(self, value: float, correction: Correction) -> str:
        """What the picture of that case is called."""
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


def pushed_at(along_mm: float, tilt_deg: float) -> Series:
    """The pushes at another place of the cylinder's side than the middle of its front."""
    if not along_mm and not tilt_deg:
        return PUSH
    return replace(
        PUSH,
        name=f"pushed {{:g}} mm at {along_mm:g} mm, {tilt_deg:+g}°",
        path=partial(push_path, along_mm=along_mm, tilt_deg=tilt_deg),
    )


PLACES: tuple[Pattern, ...] = ("coordinate_ramp_x", "coordinate_ramp_y")
"""Patterns of which a dense map of the errors is made."""


def places_label(label: str, pattern: Pattern) -> str:
    """What the picture of a case in such a pattern is called."""
    return f"{label}, {pattern}"


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of the twin's eye from the bag."""

    label: str
    correction: Correction
    metres_per_px: float
    seen: NDArray[np.uint8]
    expected: NDArray[np.uint8]


def read_pictures(bag: Path) -> dict[str, Picture]:
    """The newest picture of each label."""
    pictures = {}
    for _, message, _, _ in BagReader(bag, topics=["twin/eye"]):
        if isinstance(message, TwinEye):
            pictures[message.label] = Picture(
                message.label,
                message.correction,
                message.metres_per_px,
                message.seen,
                message.expected,
            )
    return pictures


def size_errors_mm(
    picture: Picture, sizes: Callable[[NDArray[np.uint8], float], tuple[float, ...]]
) -> list[float]:
    """Absolute differences (mm) of the sizes seen and the expected ones, as in the paper."""
    seen = np.array(sizes(picture.seen, picture.metres_per_px))
    expected = np.array(sizes(picture.expected, picture.metres_per_px))
    return [float(error) for error in np.abs(seen - expected) * 1e3]


def picture_of(pictures: dict[str, Picture], label: str) -> Picture:
    """The picture of that label; ExperimentError when the bag has none."""
    if label not in pictures:
        have = ", ".join(pictures) or "none"
        raise ExperimentError(f'the bag has no picture "{label}"; it has: {have}')
    return pictures[label]


def error_map_of(pictures: dict[str, Picture], label: str) -> ErrorMap:
    """The errors at all visible points of a case that was pictured in both patterns."""
    x, y = (picture_of(pictures, places_label(label, pattern)) for pattern in PLACES)
    return error_map(x.seen, y.seen, x.metres_per_px)


def rows(
    pictures: dict[str, Picture], series: Series, *, with_maps: bool = False
) -> list[dict[str, Any]]:
    """The rows of an experiment from its pictures: one for each value and correction.

    with_maps: and mean, 95 % and maximum of the errors at all visible points.
    """
    result = []
    for value in series.values:
        for correction in CORRECTIONS:
            picture = picture_of(pictures, series.label(value, correction))
            errors = size_errors_mm(picture, series.sizes)
            row: dict[str, Any] = {series.key: value, "method": correction}
            row.update(
                (f"delta_{name}_mm", error)
                for name, error in zip(series.size_names, errors, strict=True)
            )
            row["mean_mm"] = float(np.mean(errors))
            if with_maps:
                row |= map_figures(error_map_of(pictures, series.label(value, correction)))
            result.append(row)
    return result


def map_figures(errors: ErrorMap) -> dict[str, float | None]:
    """Mean, 95 % and maximum (mm) over all visible points; None where none is."""
    sizes_mm = 1e3 * errors.sizes_m
    if len(sizes_mm) == 0:
        return dict.fromkeys(("map_mean_mm", "map_p95_mm", "map_max_mm"))
    return {
        "map_mean_mm": float(sizes_mm.mean()),
        "map_p95_mm": float(np.quantile(sizes_mm, 0.95)),
        "map_max_mm": float(sizes_mm.max()),
    }
