"""Measure the computing time and the error of the methods that refine markers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats, Image
from flexsheet.nodes.methods import Case, Family, Interval, Trial, estimate_rms
from flexsheet.nodes.models import rigid
from flexsheet.nodes.triangulator.marker import MARKER_METHODS, BlobFilter, Marker, detect_blobs
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, measure

MARKER_RADIUS_M = 0.003
MARKER_IMAGES = 40
IMAGE_PX = 57
RAYS = 5
BLUR_PX = 0.7
GROUND_LEVEL, MARKER_LEVEL = 70.0, 215.0
GROUND_REACH_PX = 10.0
"""The radius around the marker's centre in which the background has a brightness gradient."""

MARKER_CASES = (
    *((radius_px, noise, 0.0, 0.0) for radius_px in (1.6, 3.2, 6.0) for noise in (1.0, 2.0, 4.0)),
    *((3.2, 1.0, motion_px, 0.0) for motion_px in (2.0, 4.0, 8.0)),
    *((radius_px, 1.0, 0.0, 3.0) for radius_px in (1.6, 3.2, 6.0)),
)
"""The benchmarked cases: radius (px), noise (multiple of the sensor's noise), motion during the
exposure (px) and background gradient (levels per px). A marker with a radius of 3 mm has these
radii in the image at 1, 0.5 and 0.27 m. A finger at 1 m/s moves by 4 px in 4 ms. A finger that is
lit from the side has a gradient of 2 or 3 levels per px."""


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


def _scene_cases(scene: Scene) -> tuple[tuple[float, float, float, float], ...]:
    """Return benchmark cases for a marker at the centre of the scene's screen.

    Each case contains radius (px), noise ratio, motion during the exposure (px) and background
    gradient (levels per px). The marker is at rest, or moves at the maximum speed for which the
    scene is specified.
    """
    left_from_world = StereoGeometry.of(scene.camera).left_from_world
    px_per_m = scene.camera.left.fx_px / float(rigid.apply(left_from_world, np.zeros(3))[2])
    radius_px = round(MARKER_RADIUS_M * px_per_m, 2)
    motion_m = scene.working_range.speed_m_per_s * scene.camera.exposure_s
    motions = (0.0, round(motion_m * px_per_m, 2))
    return tuple(
        (radius_px, 1.0, motion_px, slope) for motion_px in motions for slope in (0.0, 3.0)
    )


def _marker_trials(scene: Scene) -> Iterator[Trial]:
    """Yield trials with discs at random subpixel positions that move in random directions.

    The noise of the images is a multiple of the scene's sensor noise. The fit always assumes the
    scene's sensor noise.
    """
    scene_cases = _scene_cases(scene)
    sensor = PixelNoise(scene.camera.read_noise_levels, scene.camera.photons_per_level)
    for radius_px, level, motion_px, slope in dict.fromkeys((*scene_cases, *MARKER_CASES)):
        noise = PixelNoise(level * sensor.read_levels, sensor.photons_per_level / level**2)
        random = np.random.default_rng(1)
        centres = IMAGE_PX // 2 + random.uniform(-0.5, 0.5, (MARKER_IMAGES, 2))
        angles = random.uniform(0.0, np.pi, MARKER_IMAGES)
        motions = motion_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        discs = [
            DrawnDisc(centre, radius_px, motion, slope=slope)
            for centre, motion in zip(centres, motions, strict=True)
        ]
        images = [noisy(disc.levels(), noise, random) for disc in discs]
        bound_px = float(np.mean([centre_bound_px(disc, noise) for disc in discs[:4]]))
        case: Case = {
            "radius_px": radius_px,
            "noise_ratio": level,
            "motion_px": motion_px,
            "slope_levels_per_px": slope,
        }
        for name in MARKER_METHODS:
            in_range = radius_px >= 3.0 and level <= 2.0 and motion_px <= 4.0
            in_scene = (radius_px, level, motion_px, slope) in scene_cases
            yield _marker_trial(
                name,
                case,
                images,
                centres,
                sensor=sensor,
                bound_px=bound_px,
                in_range=in_range,
                in_scene=in_scene,
            )


def _marker_trial(
    name: str,
    case: Case,
    images: list[Image],
    centres: Floats,
    *,
    sensor: PixelNoise,
    bound_px: float,
    in_range: bool,
    in_scene: bool,
) -> Trial:
    refine = MARKER_METHODS[name]

    def markers_in(image: Image) -> list[Marker]:
        blobs = detect_blobs(image, BlobFilter())
        return refine([image] * len(blobs), blobs, sensor)

    def error_px(_: list[Marker]) -> Interval:
        """Return the RMS error (px) per axis; a missing marker counts as an error of IMAGE_PX."""
        found = [markers_in(image) for image in images]
        off = [
            markers[0].centre - centre if len(markers) == 1 else np.full(2, float(IMAGE_PX))
            for markers, centre in zip(found, centres, strict=True)
        ]
        return estimate_rms(np.ravel(off))

    return Trial(
        method=name,
        case=case,
        run=lambda: markers_in(images[0]),
        error=error_px,
        in_range=in_range,
        in_scene=in_scene,
        size={"bound_px": bound_px},
    )


def _marker_tolerance_px(scene: Scene) -> float:
    """Return the standard deviation (px) of a marker's centre that the scene permits.

    At the centre of the screen, this deviation causes an error of scene.tolerances.fingertip_m.
    """
    geometry = StereoGeometry.of(scene.camera)
    left, right = geometry.project(np.zeros(3))
    one_px = measure(geometry, left, right, covariance=np.eye(2))
    if one_px is None:
        raise ValueError(
            "scene: the centre of the screen (the world's origin) is not in front of both cameras; "
            "correct camera.world_from_left"
        )
    return scene.tolerances.fingertip_m / one_px.deviation_m


MARKER = Family(
    name="marker",
    unit="px",
    reference="true centres of drawn discs",
    methods=tuple(MARKER_METHODS),
    trials=_marker_trials,
    tolerance=_marker_tolerance_px,
)
