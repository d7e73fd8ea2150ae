"""Simulate a projector that illuminates a flat sheet, and compute the errors of its calibration.

The projector model shares no code with the nodes, because the simulator is used to test the nodes.
A plane represents the sheet, because an untouched sheet between two parallel edges is flat.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from flexsheet.messages.scene import Lens, Pose, Projector, Scene, StereoCamera
from flexsheet.nodes.arrays import Floats, Image, Singles
from flexsheet.nodes.models.rigid import (
    apply,
    inverse,
    pose_matrix,
    rotation_from_rpy,
    rotation_from_vector,
    rpy_from_rotation,
    transform,
)
from flexsheet.nodes.twin.pixels import Sensor, quantize
from flexsheet.nodes.twin.rig import pixels_of, slopes_of

RAYS = 2
"""The number of rays per camera pixel along each image axis."""

ROOM_LEVEL, LIT_LEVEL, DARK_LEVEL = 14.0, 150.0, 9.0
"""The grey levels of three parts of an image: the room behind the sheet, the light that a white
projector pixel adds, and the sheet where black is projected."""

SPREAD_PX = 0.5
"""The blur (standard deviation, projector pixels) of a projected pixel on the sheet, due to lens
and rubber."""

WINDOW_MARGIN = 0.05
"""The margin around the outline of the sheet in an image, in units of the ray slopes x/z and
y/z."""

FOCAL_DEVIATION, CENTRE_DEVIATION_PX = 0.01, 6.0
OFFSET_DEVIATION_M, ROTATION_DEVIATION_RAD = 0.004, 0.006
RADIAL_DEVIATION, TANGENTIAL_DEVIATION = 0.04, 0.001
"""The standard deviations of the true projector's radial and tangential distortion."""


def make_true_projector(projector: Projector, *, seed: int) -> Projector:
    """Return a copy of the scene's projector with random deviations, like those of real devices.

    The deviations of the pose are typical of a tape measure. Deviations are normally distributed
    and limited to two standard deviations.
    """
    random = np.random.default_rng(seed)

    def deviation(*shape: int) -> Floats:
        return np.clip(random.standard_normal(shape), -2.0, 2.0)

    lens, pose = projector.lens, projector.world_from_projector
    focal = 1.0 + FOCAL_DEVIATION * float(deviation(1)[0])
    centre = CENTRE_DEVIATION_PX * deviation(2)
    k1, k2 = RADIAL_DEVIATION * deviation(2)
    p1, p2 = TANGENTIAL_DEVIATION * deviation(2)
    added = (k1, 0.5 * k2, p1, p2, 0.0)
    k = [float(old + new) for old, new in zip(lens.distortion, added, strict=True)]
    turned = rotation_from_vector(ROTATION_DEVIATION_RAD * deviation(3))
    return projector.model_copy(
        update={
            "lens": Lens(
                fx_px=lens.fx_px * focal,
                fy_px=lens.fy_px * focal,
                cx_px=float(lens.cx_px + centre[0]),
                cy_px=float(lens.cy_px + centre[1]),
                distortion=(k[0], k[1], k[2], k[3], k[4]),
            ),
            "world_from_projector": Pose(
                position_m=pose.position_m + OFFSET_DEVIATION_M * deviation(3),
                rpy_rad=rpy_from_rotation(turned @ rotation_from_rpy(pose.rpy_rad)),
            ),
        }
    )


def sheet_poses(count: int) -> list[Floats]:
    """Return various poses `world_from_sheet` (4, 4) at which the arms can hold the sheet.

    The poses differ in distance and tilt, as the calibration of a projector requires.
    """
    poses = []
    for number in range(count):
        share = number / max(count - 1, 1)
        towards = 2.399963 * number  # Multiples of the golden angle give different tilt directions.
        tilt = 0.0 if number == 0 else 0.15 + 0.25 * share
        turn = rotation_from_vector(tilt * np.array([np.cos(towards), np.sin(towards), 0.0]))
        depth_m = 0.05 * np.cos(np.pi * number * 0.618)
        poses.append(transform(turn, [0.0, 0.0, depth_m]))
    return poses


class LitSheet:
    """A simulation of a sheet that a projector illuminates and a stereo camera observes."""

    def __init__(self, scene: Scene, camera: StereoCamera, projector: Projector, *, seed: int):
        """Store the parameters of the simulated devices.

        camera, projector: true parameters.
        seed: random seed of the image noise.
        """
        self._scene, self._camera, self._projector = scene, camera, projector
        self._random = np.random.default_rng(seed)
        self._sensor = Sensor()
        height, width = camera.height_px, camera.width_px
        columns = (np.arange(RAYS * width) + 0.5) / RAYS - 0.5
        rows = (np.arange(RAYS * height) + 0.5) / RAYS - 0.5
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        self._rays = [slopes_of(lens, grid) for lens in (camera.left, camera.right)]

    def pair(
        self, patterns: Sequence[Image], world_from_sheet: Floats, points: Floats | None = None
    ) -> tuple[list[Image], list[Image]]:
        """Render the left and right images of patterns that are projected onto the sheet.

        world_from_sheet: pose (4, 4) of the sheet.
        points (n, 3): points of a sheet that sags by its weight, m; None if the sheet is flat.
        """
        bend = None if points is None else _fit_bend(apply(inverse(world_from_sheet), points))
        world_from_left = pose_matrix(self._camera.world_from_left)
        views = (world_from_left, world_from_left @ inverse(self._camera.right_from_left))
        left, right = (
            self._pictures(patterns, rays, world_from_eye, world_from_sheet, bend)
            for rays, world_from_eye in zip(self._rays, views, strict=True)
        )
        return left, right

    def _pictures(
        self,
        patterns: Sequence[Image],
        rays: Floats,
        world_from_eye: Floats,
        sheet: Floats,
        bend: Floats | None,
    ) -> list[Image]:
        window = self._find_window(rays, world_from_eye, sheet)
        fine = tuple(slice(RAYS * side.start, RAYS * side.stop) for side in window)
        x, y, inside = self._lit_by(rays[fine], world_from_eye, sheet, bend)
        height, width = (side.stop - side.start for side in window)
        pictures: list[Image] = []
        for pattern in patterns:
            thrown = cv2.GaussianBlur(pattern.astype(np.float32), (0, 0), SPREAD_PX)
            light = cv2.remap(thrown, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            level = np.where(inside, np.float32(LIT_LEVEL / 255.0) * light + DARK_LEVEL, ROOM_LEVEL)
            level = cv2.GaussianBlur(level.astype(np.float32), (0, 0), RAYS * self._sensor.blur_px)
            # This interpolation method averages the rays of each pixel.
            mean = np.asarray(
                cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32
            )
            noise = self._random.standard_normal(mean.shape, dtype=np.float32)
            picture = np.full(
                (self._camera.height_px, self._camera.width_px), round(ROOM_LEVEL), np.uint8
            )
            picture[window] = quantize(mean + self._sensor.noise(mean) * noise)
            pictures.append(picture)
        return pictures

    def _find_window(
        self, rays: Floats, world_from_eye: Floats, world_from_sheet: Floats
    ) -> tuple[slice, slice]:
        """Return the ranges of image rows and columns in which the sheet can be visible.

        Returns the whole image if a part of the sheet is behind the camera.
        """
        height, width = self._camera.height_px, self._camera.width_px
        half = 0.5 * np.array([self._scene.sheet.width_m, self._scene.sheet.height_m])
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
        in_eye = apply(inverse(world_from_eye) @ world_from_sheet, corners)
        if in_eye[:, 2].min() <= 0.0:
            return slice(0, height), slice(0, width)
        slopes = in_eye[:, :2] / in_eye[:, 2:]
        # The margin allows for the bending of the sheet and the blur of the lens.
        low, high = slopes.min(axis=0) - WINDOW_MARGIN, slopes.max(axis=0) + WINDOW_MARGIN
        middle = rays[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS]
        seen = ((middle >= low) & (middle <= high)).all(axis=2)
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if not len(rows):
            return slice(0, 1), slice(0, 1)
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def _lit_by(
        self, rays: Floats, world_from_eye: Floats, world_from_sheet: Floats, bend: Floats | None
    ) -> tuple[Singles, Singles, NDArray[np.bool_]]:
        """Return the projector columns and rows that illuminate the sheet where camera rays hit it.

        The third result is a mask of the rays that hit the sheet.

        rays: x/z and y/z (rows, columns, 2) in the camera frame.
        """
        directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
        directions = directions @ world_from_eye[:3, :3].T
        points, ahead = on_plane(world_from_eye[:3, 3], directions, world_from_sheet)
        sheet_from_world = inverse(world_from_sheet)
        local = apply(sheet_from_world, points.reshape(-1, 3)).reshape(points.shape)
        half = 0.5 * np.array([self._scene.sheet.width_m, self._scene.sheet.height_m])
        if bend is not None:
            # The bend is small, so a ray meets it close to where it meets the plane.
            along = directions @ sheet_from_world[:3, :3].T
            flat, slopes = local[..., :2], along[..., :2] / along[..., 2:]
            for _ in range(2):
                x, y = np.moveaxis(np.clip(local[..., :2], -half, half), -1, 0)
                height = polynomial.polyval2d(x, y, bend)[..., None]
                local = np.concatenate([flat + height * slopes, height], axis=-1)
            points = apply(world_from_sheet, local.reshape(-1, 3)).reshape(points.shape)
        inside = ahead & (np.abs(local[..., :2]) <= half).all(axis=-1)
        pixels = pixels_lighting(self._projector, np.where(inside[..., None], points, 0.0))
        return pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32), inside


def _fit_bend(points: Floats) -> Floats:
    """Fit a polynomial z(x, y) to points (n, 3) in the sheet's frame; return its coefficients."""
    powers = polynomial.polyvander2d(points[:, 0], points[:, 1], [4, 4])
    return np.asarray(np.linalg.lstsq(powers, points[:, 2], rcond=None)[0].reshape(5, 5))


def on_plane(origin: Floats, directions: Floats, plane: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Intersect rays (..., 3) from a point with the x-y plane of a pose (4, 4).

    Returns the points (..., 3), and a mask of the points in front of the origin.
    """
    normal = plane[:3, 2]
    slant = directions @ normal
    share = ((plane[:3, 3] - origin) @ normal) / np.where(np.abs(slant) < 1e-9, np.nan, slant)
    ahead = np.nan_to_num(share, nan=-1.0) > 0.0
    return origin + np.where(ahead, share, 1.0)[..., None] * directions, ahead


def pixels_lighting(projector: Projector, points: Floats) -> Floats:
    """Return the projector pixels (..., 2) that illuminate world points (..., 3), m.

    The points must be in front of the projector.
    """
    from_world = inverse(pose_matrix(projector.world_from_projector))
    local = points @ from_world[:3, :3].T + from_world[:3, 3]
    return pixels_of(projector.lens, local[..., :2] / local[..., 2:])


def errors_at_eye(
    believed: Projector, true: Projector, eye: Floats, planes: Sequence[Floats], half_m: float
) -> Floats:
    """Return how far a calibrated projector misses the intended points, as seen by an eye.

    believed: calibrated projector, from which the pixels of the intended points are computed.
    true: true projector, which projects these pixels.
    planes: poses (4, 4) of planes. On each plane, the intended points form a square grid with half
        the width `half_m`.

    The result (n,), m, contains the distances between intended and actual points. The eye's rays
    through these points meet the imaginary screen (world plane z = 0), where the distances are
    measured.
    """
    axis = np.linspace(-half_m, half_m, 9)
    flat = np.stack([*np.meshgrid(axis, axis), np.zeros((9, 9))], axis=-1).reshape(-1, 3)
    world_from_true = pose_matrix(true.world_from_projector)
    errors = []
    for plane in planes:
        meant = apply(plane, flat)
        slopes = slopes_of(true.lens, pixels_lighting(believed, meant))
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ world_from_true[:3, :3].T
        lit, _ = on_plane(world_from_true[:3, 3], rays, plane)
        seen = [
            eye[:2] + (points[:, :2] - eye[:2]) * (eye[2] / (eye[2] - points[:, 2:]))
            for points in (meant, lit)
        ]
        errors.append(np.linalg.norm(seen[0] - seen[1], axis=1))
    return np.concatenate(errors)
