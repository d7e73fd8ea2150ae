"""Draw synthetic discs with sensor noise, and bound the error of their centres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.triangulator.subpixel import PixelNoise

IMAGE_PX = 57
RAYS = 5
BLUR_PX = 0.7
GROUND_LEVEL, MARKER_LEVEL = 70.0, 215.0
GROUND_REACH_PX = 10.0
"""The radius around the marker's centre in which the background has a brightness gradient."""


@dataclass(frozen=True, slots=True)
class DrawnDisc:
    """The parameters of a synthetic disc: centre, radius, motion and blur (standard deviation), px.

    marker, ground: grey levels of the disc and of the background.
    slope: gradient of the background along y, levels per px.
    """

    centre: Floats
    radius_px: float
    motion: Floats
    blur_px: float = BLUR_PX
    marker: float = MARKER_LEVEL
    ground: float = GROUND_LEVEL
    slope: float = 0.0

    def levels(self) -> Floats:
        """Render the image (IMAGE_PX, IMAGE_PX) of the disc by supersampling, without noise."""
        fine = (np.arange(IMAGE_PX * RAYS) - 0.5 * (RAYS - 1)) / RAYS
        x, y = fine[None, :] - self.centre[0], fine[:, None] - self.centre[1]
        steps = 1 + int(4.0 * np.linalg.norm(self.motion))
        lit = np.zeros((IMAGE_PX * RAYS, IMAGE_PX * RAYS))
        for along in (np.arange(steps) + 0.5) / steps - 0.5:
            away = np.hypot(x - along * self.motion[0], y - along * self.motion[1])
            lit += np.clip(RAYS * (self.radius_px - away) + 0.5, 0.0, 1.0) / steps
        blurred = np.asarray(cv2.GaussianBlur(lit, (0, 0), RAYS * self.blur_px))
        coverage = blurred.reshape(IMAGE_PX, RAYS, IMAGE_PX, RAYS).mean(axis=(1, 3))
        rows = np.clip(np.arange(IMAGE_PX) - self.centre[1], -GROUND_REACH_PX, GROUND_REACH_PX)
        ground = self.ground + self.slope * rows[:, None]
        return np.asarray(ground + coverage * (self.marker - ground))


def noisy(levels: Floats, noise: PixelNoise, random: np.random.Generator) -> Image:
    """Add a sensor's photon noise and read noise to an image, and round it to whole grey levels."""
    deviation = np.sqrt(noise.read_levels**2 + levels / noise.photons_per_level)
    seen = levels + deviation * random.standard_normal(levels.shape)
    return np.asarray(np.clip(np.rint(seen), 0, 255), dtype=np.uint8)


def centre_bound_px(disc: DrawnDisc, noise: PixelNoise) -> float:
    """Return the Cramer-Rao bound on the standard deviation (px per axis) of a disc's centre.

    All parameters of the disc are unknown. The rounding of grey levels and the dependence of the
    noise on the parameters are neglected.
    """
    levels = disc.levels()
    weights = 1.0 / (noise.read_levels**2 + levels / noise.photons_per_level)
    step = 0.05
    slopes = []
    for name, change in (
        ("centre", np.array([step, 0.0])),
        ("centre", np.array([0.0, step])),
        ("radius_px", step),
        ("blur_px", step),
        ("marker", 1.0),
        ("ground", 1.0),
    ):
        value = getattr(disc, name)
        more, less = (
            replace(disc, **{name: value + sign * change}).levels() for sign in (0.5, -0.5)
        )
        slopes.append((more - less).ravel() / float(np.max(np.abs(change))))
    slope = np.array(slopes)
    covariance = np.linalg.inv((slope * weights.ravel()) @ slope.T)
    return float(np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1])))
