"""Compute the region of each camera sensor in which the finger can appear."""

from __future__ import annotations

import numpy as np
from pydantic import ConfigDict

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Lens, Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.camera.image_pair import DeviceError, Region, Regions
from flexsheet.nodes.models import camera, rigid

GRID = 17
"""The number of grid points along each edge of the box in which the finger can be. Between two grid
points, the change of the lens distortion is negligible."""
MARGIN_PX = 16.0
"""The margin around a region, which allows for blur of the marker and for calibration errors."""
ALIGN_PX = (16, 2)
"""The alignment of a region. The numbers of its first column and row must be multiples of these two
numbers."""
NEAREST_M = 1e-3


class ExplicitRegions(LimitedModel):
    """The sensor region of each view in a launch file, as [column, row, width, height] in px."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    left: Region
    right: Region


def volume_points(low_m: Floats, high_m: Floats) -> Floats:
    """Return a grid of n points (n, 3) that fills the box between two opposite corners (3,)."""
    axes = [np.linspace(low, high, GRID) for low, high in zip(low_m, high_m, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def find_visible_region(
    points_camera: Floats, lens: Lens, width_px: int, height_px: int
) -> Region | None:
    """Return the sensor region that contains the images of all visible points, with a margin.

    points_camera: n points (n, 3) in the camera frame, m.

    Returns None if no point is visible, and the full sensor if some points are behind the camera.
    The distortion polynomial is invalid outside the image. Rays to points outside the image are
    therefore rotated to the view angle of the farthest image corner.
    """
    in_front = points_camera[points_camera[:, 2] > NEAREST_M]
    if len(in_front) == 0:
        return None
    if len(in_front) < len(points_camera):
        return Region(0, 0, width_px, height_px)
    matrix = camera.camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    distortion = np.array(lens.distortion)
    right, bottom = width_px - 1.0, height_px - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    radius = np.linalg.norm(camera.normalize(corners, matrix, distortion), axis=1).max()
    rays = in_front / in_front[:, 2:]
    lengths = np.linalg.norm(rays[:, :2], axis=1)
    rays[:, :2] *= np.minimum(1.0, radius / np.maximum(lengths, 1e-12))[:, None]
    pixels = camera.project(rays, matrix, distortion)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    size = np.array([width_px, height_px])
    if np.any(high < 0.0) or np.any(low > size - 1):
        return None
    align = np.array(ALIGN_PX)
    begin = np.maximum(np.floor((low - MARGIN_PX) / align) * align, 0).astype(int)
    end = np.minimum(np.ceil((high + MARGIN_PX + 1) / align) * align, size).astype(int)
    return Region(int(begin[0]), int(begin[1]), int(end[0] - begin[0]), int(end[1] - begin[1]))


def find_finger_regions(scene: Scene) -> Regions:
    """Return the sensor region of each view in which a fingertip can appear.

    The fingertip can be in the box from finger.volume_min_m to finger.volume_max_m, extended by the
    radius of the finger and a margin. Raises DeviceError if the box is not visible in a view.
    """
    finger, rig = scene.finger, scene.camera
    low = np.asarray(finger.volume_min_m) - finger.radius_m
    high = np.asarray(finger.volume_max_m) + finger.radius_m
    left_from_world = rigid.inverse(rigid.pose_matrix(rig.world_from_left))
    in_left = rigid.apply(left_from_world, volume_points(low, high))
    in_right = rigid.apply(np.asarray(rig.right_from_left), in_left)
    found = []
    for side, points, lens in (("left", in_left, rig.left), ("right", in_right, rig.right)):
        region = find_visible_region(points, lens, rig.width_px, rig.height_px)
        if region is None:
            raise DeviceError(
                f"the {side} view does not show the box from finger.volume_min_m to volume_max_m; "
                f"correct the box or camera.world_from_left in scene {scene.name}, or set region: "
                "full"
            )
        found.append(region)
    return found[0], found[1]


def resolve_regions(setting: str | ExplicitRegions, scene: Scene) -> Regions | None:
    """Return the sensor regions to publish, or None if both full sensors are published.

    setting: "full", "finger" (the regions in which the finger can appear), or explicit regions.

    Raises DeviceError if a region is not inside its sensor.
    """
    if setting == "full":
        return None
    if not isinstance(setting, ExplicitRegions):
        return find_finger_regions(scene)
    whole = Region(0, 0, scene.camera.width_px, scene.camera.height_px)
    for side, region in (("left", setting.left), ("right", setting.right)):
        if not whole.contains(region):
            raise DeviceError(
                f"region.{side}: {region} is outside the sensor of {whole.width}x{whole.height} "
                "px; correct the camera node's parameter region"
            )
    return setting.left, setting.right
