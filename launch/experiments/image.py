"""Section VI of the paper: the picture on an inclined sheet (Fig. 11) and a pushed one (Fig. 13).

Each case is a label: the renderer puts it into its frames, the twin's eye into its pictures, and
the rows are computed from the pictures in the bag.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from launch.experiments import ExperimentError
from launch.experiments.stroke import object_pose
from messages.bag import BagReader
from messages.scene import Scene
from messages.types import Correction, FingerPath, TwinEye
from nodes.models.rigid import apply
from nodes.twin.eye import push_sizes, tilt_sizes

CORRECTIONS: tuple[Correction, ...] = get_args(Correction)
TILTS_DEG = (-50, -40, -30, -20, -10, 10, 20, 30, 40, 50)
DEPTHS_MM = (10, 20, 30, 40, 50)
HOVER_M = 0.03
REACH_S = 1.5

PAPER_FIGURE_11_AT_50_DEG = {"none": 27.5, "one_plane": 2.1}
PAPER_FIGURE_13_AT_50_MM = {"none": 15.8, "four_triangles": 2.1}
"""Mean errors in mm that the paper's text gives for the largest tilt and the deepest push."""


def tilt_label(theta_deg: float, correction: Correction) -> str:
    return f"tilt {theta_deg:+g} deg, {correction}"


def push_label(depth_mm: float, correction: Correction) -> str:
    return f"push {depth_mm:g} mm, {correction}"


def reach_path(scene: Scene, label: str, *, angle_rad: float, height_m: float) -> FingerPath:
    """Go straight to the point at `angle_rad` around the cylinder, `height_m` above its side."""
    distance = scene.object.geometry.radius_m + height_m
    point = np.array([[0.0, distance * np.sin(angle_rad), distance * np.cos(angle_rad)]])
    return FingerPath(
        label=label,
        times_s=np.array([REACH_S]),
        positions_world_m=apply(object_pose(scene), point),
        wander_m=0.0,
        tremor_m=0.0,
    )


def tilt_path(scene: Scene, theta_deg: float) -> FingerPath:
    """Hover above the cylinder at that angle: the sheet waits there, inclined by it."""
    return reach_path(
        scene, f"tilt {theta_deg:+g} deg", angle_rad=np.radians(theta_deg), height_m=HOVER_M
    )


def push_path(scene: Scene, depth_mm: float) -> FingerPath:
    """Push the middle of the front by that depth."""
    return reach_path(scene, f"push {depth_mm:g} mm", angle_rad=0.0, height_m=-depth_mm * 1e-3)


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


def tilt_rows(pictures: dict[str, Picture], tilts_deg: tuple[float, ...]) -> list[dict[str, Any]]:
    """Rows of `experiment tilt`, from its pictures."""
    rows = []
    for theta_deg in tilts_deg:
        for correction in CORRECTIONS:
            errors = size_errors_mm(
                picture_of(pictures, tilt_label(theta_deg, correction)), tilt_sizes
            )
            rows.append(
                {
                    "theta_deg": theta_deg,
                    "method": correction,
                    "delta_h_mm": errors[0],
                    "delta_u_mm": errors[1],
                    "delta_d_mm": errors[2],
                    "mean_mm": float(np.mean(errors)),
                }
            )
    return rows


def push_rows(pictures: dict[str, Picture], depths_mm: tuple[float, ...]) -> list[dict[str, Any]]:
    """Rows of `experiment push`, from its pictures."""
    rows = []
    for depth_mm in depths_mm:
        for correction in CORRECTIONS:
            errors = size_errors_mm(
                picture_of(pictures, push_label(depth_mm, correction)), push_sizes
            )
            rows.append(
                {
                    "depth_mm": depth_mm,
                    "method": correction,
                    "delta_h_mm": errors[0],
                    "delta_w_mm": errors[1],
                    "mean_mm": float(np.mean(errors)),
                }
            )
    return rows
