"""Section VI of the paper: the picture on an inclined sheet (Fig. 11) and a pushed one (Fig. 13).

Each case is a label: the renderer puts it into its frames, the twin's eye into its pictures, and
the rows are computed from the pictures in the bag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from launch.experiments import ExperimentError
from launch.experiments.stroke import object_pose
from messages.bag import BagReader
from messages.scene import Scene, cylinder_of
from messages.types import Correction, FingerPath, TwinEye
from nodes.models.rigid import apply
from nodes.twin.eye import push_sizes, tilt_sizes

CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
HOVER_M = 0.03
REACH_S = 1.5


def reach_path(scene: Scene, label: str, points: Sequence[tuple[float, float]]) -> FingerPath:
    """Go straight from point to point, each (angle around the cylinder, height above its side)."""
    radius = cylinder_of(scene).radius_m
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
    """Hover above the cylinder at that angle: the sheet waits there, inclined by it."""
    return reach_path(scene, f"tilt {theta_deg:+g} deg", [(float(np.radians(theta_deg)), HOVER_M)])


def push_path(scene: Scene, depth_mm: float) -> FingerPath:
    """Push the middle of the front by that depth, from above."""
    return reach_path(scene, f"push {depth_mm:g} mm", [(0.0, HOVER_M), (0.0, -depth_mm * 1e-3)])


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


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of the twin's eye from the bag."""

    label: str
    correction: Correction
    metres_per_px: float
    seen: NDArray[np.uint8]
    proper: NDArray[np.uint8]


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
                message.proper,
            )
    return pictures


def size_errors_mm(
    picture: Picture, sizes: Callable[[NDArray[np.uint8], float], tuple[float, ...]]
) -> list[float]:
    """Absolute differences (mm) of the sizes seen and the proper ones, as in the paper."""
    seen = np.array(sizes(picture.seen, picture.metres_per_px))
    proper = np.array(sizes(picture.proper, picture.metres_per_px))
    return [float(error) for error in np.abs(seen - proper) * 1e3]


def picture_of(pictures: dict[str, Picture], label: str) -> Picture:
    """The picture of that label; ExperimentError when the bag has none."""
    if label not in pictures:
        have = ", ".join(pictures) or "none"
        raise ExperimentError(f'the bag has no picture "{label}"; it has: {have}')
    return pictures[label]


def rows(pictures: dict[str, Picture], series: Series) -> list[dict[str, Any]]:
    """The rows of an experiment from its pictures: one for each value and correction."""
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
            result.append(row)
    return result
