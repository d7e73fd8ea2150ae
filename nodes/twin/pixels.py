"""The twin's stereo camera: pixels of a fingertip with a bright mark, as a real rig would see it.

Own optics: pinhole with Brown's distortion, written here anew, since the twin judges the camera
model that the nodes use.  The fingertip is a tapered finger that ends in a small luminous bead, the
mark, whose centre is the fingertip's point.  Edges are drawn as the pixel's own area and the lens's
blur smear them, the exposure's motion is integrated, and photon and read noise are added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from messages.scene import Lens, StereoCamera
from nodes.models.rigid import inverse, transform_from_rpy

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

MARK_RADIUS_M = 0.003
FINGER_LENGTH_M = 0.06
FINGER_DIRECTION = np.array([0.0, -0.5, 0.866])
"""World direction from the tip to the knuckle: up from below, out of the mark's sight."""

MOTION_STEP_PX = 1.0
"""Motion within the exposure is summed at steps no longer than this; the blur closes the gaps."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Levels in digital numbers (0..255), linear.

    photons_per_level: full-well photons over 255; the variance of a level L is L over it.
    blur_px: standard deviation of the lens's point spread.
    """

    mark_level: float = 215.0
    finger_level: float = 85.0
    background_level: float = 32.0
    texture_level: float = 9.0
    read_noise: float = 1.5
    photons_per_level: float = 40.0
    blur_px: float = 0.7
    noisy_backgrounds: int = 8

    def noise(self, levels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Standard deviation of each level."""
        variance = levels / np.float32(self.photons_per_level) + np.float32(self.read_noise**2)
        return np.asarray(np.sqrt(variance), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Eye:
    """One camera of the rig with its stack of noisy backgrounds."""

    lens: Lens
    camera_from_world: Floats
    background: NDArray[np.float32]
    noisy: list[Image]

    def see(self, point_world: Floats) -> tuple[Floats, float]:
        """Pixel (2,) and depth (m) of a world point; the pixel is void when the depth is <= 0."""
        x, y, z = self.camera_from_world[:3, :3] @ point_world + self.camera_from_world[:3, 3]
        if z <= 0:
            return np.zeros(2), float(z)
        u, v = x / z, y / z
        k1, k2, p1, p2, k3 = self.lens.distortion
        r2 = u * u + v * v
        radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        du = 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
        dv = p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
        return np.array(
            [
                self.lens.fx_px * (u * radial + du) + self.lens.cx_px,
                self.lens.fy_px * (v * radial + dv) + self.lens.cy_px,
            ]
        ), float(z)


class TwinCamera:
    """Draws stereo pairs of a scene's camera; the noise comes from `seed`."""

    def __init__(self, camera: StereoCamera, *, finger_radius_m: float, seed: int) -> None:
        self.camera = camera
        self.finger_radius_m = finger_radius_m
        self.sensor = Sensor()
        self._random = np.random.default_rng(seed)
        world_from_left = transform_from_rpy(
            camera.world_from_left.position_m, camera.world_from_left.rpy_rad
        )
        left_from_world = inverse(world_from_left)
        self.eyes = (
            self._eye(camera.left, left_from_world),
            self._eye(camera.right, camera.right_from_left @ left_from_world),
        )

    def _eye(self, lens: Lens, camera_from_world: Floats) -> Eye:
        height, width = self.camera.height_px, self.camera.width_px
        background = self._background(height, width)
        deviation = self.sensor.noise(background)
        noisy = []
        for _ in range(self.sensor.noisy_backgrounds):
            noise = self._random.standard_normal((height, width), dtype=np.float32)
            noisy.append(quantized(background + deviation * noise))
        return Eye(lens, camera_from_world, background, noisy)

    def _background(self, height: int, width: int) -> NDArray[np.float32]:
        """A dim, blotchy backdrop: two octaves of smooth noise, always well below the mark."""
        texture = np.zeros((height, width), dtype=np.float32)
        for cells, share in ((24, 0.7), (96, 0.3)):
            coarse = self._random.standard_normal((cells, cells), dtype=np.float32)
            texture += share * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        level = self.sensor.background_level + self.sensor.texture_level * texture
        return np.asarray(np.clip(level, 2.0, 0.4 * self.sensor.mark_level), dtype=np.float32)

    def picture(
        self, position: Callable[[float], Floats], *, exposure_s: float, mark: bool = True
    ) -> tuple[Image, Image]:
        """The left and right pictures of a fingertip at `position(seconds from mid-exposure)`.

        mark: false draws a finger that wears none (rubbed off, or turned away).
        """
        left, right = (self._draw(eye, position, exposure_s, mark) for eye in self.eyes)
        return left, right

    def _draw(
        self, eye: Eye, position: Callable[[float], Floats], exposure_s: float, mark: bool
    ) -> Image:
        """One picture: a noisy background with the finger drawn into its own window."""
        image = eye.noisy[int(self._random.integers(len(eye.noisy)))].copy()
        ends = [eye.see(position(share * exposure_s)) for share in (-0.5, 0.5)]
        if min(depth for _, depth in ends) <= 0:
            return image
        travel_px = float(np.linalg.norm(ends[1][0] - ends[0][0]))
        steps = 1 + int(np.ceil(travel_px / MOTION_STEP_PX))
        instants = (np.arange(steps) + 0.5) / steps - 0.5
        tips = [position(float(instant) * exposure_s) for instant in instants]
        window = self._window(eye, tips)
        if window is None:
            return image
        rows, columns = window
        levels = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.float32)
        for tip in tips:
            levels += self._exposed(eye, tip, window, mark)
        levels /= steps
        noise = self._random.standard_normal(levels.shape, dtype=np.float32)
        image[window] = quantized(levels + self.sensor.noise(levels) * noise)
        return image

    def _window(self, eye: Eye, tips: list[Floats]) -> tuple[slice, slice] | None:
        """Rows and columns that the finger touches during exposure; None: not in the picture."""
        height, width = eye.background.shape
        centres, reach_px = [], 0.0
        for tip in (tips[0], tips[-1]):
            knuckle, depth = eye.see(tip + FINGER_LENGTH_M * FINGER_DIRECTION)
            if depth <= 0:
                return None
            centres += [eye.see(tip)[0], knuckle]
            scale = eye.lens.fx_px / min(depth, eye.see(tip)[1])
            reach_px = max(reach_px, 1.2 * scale * self.finger_radius_m)
        margin = reach_px + 5.0 * self.sensor.blur_px
        low = np.floor(np.min(centres, axis=0) - margin).astype(int)
        high = np.ceil(np.max(centres, axis=0) + margin).astype(int) + 1
        rows = slice(max(low[1], 0), min(high[1], height))
        columns = slice(max(low[0], 0), min(high[0], width))
        empty = rows.start >= rows.stop or columns.start >= columns.stop
        return None if empty else (rows, columns)

    def _exposed(
        self, eye: Eye, tip: Floats, window: tuple[slice, slice], mark: bool
    ) -> NDArray[np.float32]:
        """Noise-free levels of a window with the fingertip at `tip`.

        An edge seen through pixel area and blur is the normal distribution of the signed distance
        to it, its variance blur^2 + 1/12; the window's pixels are taken at their centres.
        """
        y, x = np.mgrid[window].astype(np.float32)
        backdrop = eye.background[window]
        smear = np.float32(np.hypot(self.sensor.blur_px, np.sqrt(1.0 / 12.0)))
        centre, depth = eye.see(tip)
        knuckle, knuckle_depth = eye.see(tip + FINGER_LENGTH_M * FINGER_DIRECTION)
        radius = eye.lens.fx_px * self.finger_radius_m / depth
        knuckle_radius = 1.2 * eye.lens.fx_px * self.finger_radius_m / knuckle_depth
        axis = knuckle - centre
        dx, dy = x - np.float32(centre[0]), y - np.float32(centre[1])
        length_sq = max(float(axis @ axis), 1e-6)
        along = np.clip((dx * axis[0] + dy * axis[1]) / length_sq, 0.0, 1.0).astype(np.float32)
        off = np.hypot(dx - along * np.float32(axis[0]), dy - along * np.float32(axis[1]))
        width = np.float32(radius) + along * np.float32(knuckle_radius - radius)
        finger = _smeared((width - off) / smear)
        shade = np.float32(self.sensor.finger_level) * (
            1.0 - 0.35 * np.square(np.minimum(off / width, 1.0))
        )
        levels = backdrop + finger * (shade - backdrop)
        if mark:
            mark_radius = np.float32(eye.lens.fx_px * MARK_RADIUS_M / depth)
            covered = _smeared((mark_radius - np.hypot(dx, dy)) / smear)
            levels += covered * (np.float32(self.sensor.mark_level) - levels)
        return np.asarray(levels, dtype=np.float32)


def _smeared(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Share of a smeared edge's light at a signed distance in standard deviations."""
    return np.asarray(ndtr(distance), dtype=np.float32)


def quantized(levels: NDArray[np.float32]) -> Image:
    """Digital numbers as the converter gives them: rounded, clipped at 0 and 255."""
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
