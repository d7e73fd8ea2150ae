"""Compute the Cramer-Rao bound of the fingertip from simulated pixels.

No unbiased estimate has a smaller covariance than the inverse of the Fisher information (Kay,
Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, chapter 3). Each pixel has
normal noise: the sensor's and that of rounding. The information in the variance, a ten-thousandth
of that in the mean, is neglected. Only the marker moves with the position; the finger under it is
ground. Nuisance parameters are estimated in each view: levels of marker and ground, the marker's
radius, and the blur.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.pixels import CameraView, Position, Sensor, TwinCamera, Window
from flexsheet.nodes.twin.rig import pixels_per_slope

STEP_PX = 0.02
"""Half the step of the numeric derivatives by position, radius and blur, in px."""

ROUNDING_VARIANCE = 1.0 / 12.0
FULL_LEVEL = 255.0
NUISANCES = 4
MAX_CONDITION = 1e10
"""The maximum condition number of the information matrix after scaling its diagonal to one."""


class BoundError(ValueError):
    """Raised if the marker is not in both images, or if its position is not observable."""


@dataclass(frozen=True, slots=True)
class Bound:
    """The minimum covariances of an unbiased estimate.

    position_m2: covariance (3, 3) of the fingertip in the world frame, from both views.
    views_px2: covariances (2, 2) of the marker's centre in the left and in the right view.
    """

    position_m2: Floats
    views_px2: tuple[Floats, Floats]


def fingertip_bound(
    camera: TwinCamera,
    position: Position,
    *,
    exposure_s: float,
    time_s: float = 0.0,
    margin_px: float = 2.0,
) -> Bound:
    """Compute the bound for a marker as `TwinCamera.picture` renders it, at mid-exposure.

    margin_px: width of the ground around the marker and its blur that is used. Raises BoundError if
        the marker is outside an image, or too occluded or saturated.
    """

    def drawn(changed: TwinCamera) -> tuple[Floats, Floats]:
        left, right = changed.levels(position, exposure_s=exposure_s, time_s=time_s)
        return left.astype(np.float64), right.astype(np.float64)

    def slope(less: TwinCamera, more: TwinCamera, span: float) -> tuple[Floats, Floats]:
        lower, upper = drawn(less), drawn(more)
        return (upper[0] - lower[0]) / span, (upper[1] - lower[1]) / span

    sensor, radius_m, offset_m = camera.sensor, camera.marker_radius_m, camera.marker_offset_m
    left_eye = camera.eyes[0]
    step_m = STEP_PX * left_eye.see(position(0.0))[1] / left_eye.lens.fx_px
    if step_m <= 0:
        raise BoundError("the fingertip is behind the camera")
    by_place = [
        slope(
            camera.with_changes(marker_offset_m=offset_m - step_m * axis),
            camera.with_changes(marker_offset_m=offset_m + step_m * axis),
            2.0 * step_m,
        )
        for axis in np.eye(3)
    ]
    by_level = slope(
        camera,
        camera.with_changes(sensor=replace(sensor, marker_level=sensor.marker_level + 1.0)),
        1.0,
    )
    by_radius = slope(
        camera.with_changes(marker_radius_m=radius_m - step_m),
        camera.with_changes(marker_radius_m=radius_m + step_m),
        2.0 * step_m,
    )
    by_blur = slope(
        camera.with_changes(sensor=replace(sensor, blur_px=sensor.blur_px - STEP_PX)),
        camera.with_changes(sensor=replace(sensor, blur_px=sensor.blur_px + STEP_PX)),
        2.0 * STEP_PX,
    )
    seen = drawn(camera)

    total = np.zeros((3 + 2 * NUISANCES, 3 + 2 * NUISANCES))
    views_px2 = []
    for view, eye in enumerate(camera.eyes):
        window = _about_the_mark(camera, eye, position, exposure_s, margin_px)
        weight = pixel_information(sensor, seen[view][window]).ravel()
        placed = np.stack([by_axis[view][window].ravel() for by_axis in by_place])
        others = np.stack(
            [
                np.ones_like(weight),
                *(each[view][window].ravel() for each in (by_level, by_radius, by_blur)),
            ]
        )
        # A shift of a pixel is a shift of the marker perpendicular to its ray.
        world_from_pixel = np.linalg.pinv(_pixel_from_world(eye, position(0.0) + offset_m))
        alone = np.concatenate([world_from_pixel.T @ placed, others])
        place_px2 = _covariance((alone * weight) @ alone.T, eye.side)[:2, :2]
        if np.sqrt(np.trace(place_px2)) > window[0].stop - window[0].start:
            raise BoundError(f"{eye.side} view: the marker has no contrast with its ground")
        views_px2.append(place_px2)
        both = np.zeros((len(total), len(weight)))
        both[:3] = placed
        both[3 + view * NUISANCES : 3 + (view + 1) * NUISANCES] = others
        total += (both * weight) @ both.T
    return Bound(_covariance(total, "two")[:3, :3], (views_px2[0], views_px2[1]))


def pixel_information(sensor: Sensor, levels: Floats) -> Floats:
    """Return the information of each pixel about its level: the inverse variance unless saturated.

    A saturated pixel only shows that its level is above `FULL_LEVEL`. The information of a normal
    variate censored z deviations above its mean is Phi(z) - z phi(z) + phi(z)^2 / Phi(-z), relative
    to the uncensored one.
    """
    variance = levels / sensor.photons_per_level + sensor.read_noise**2 + ROUNDING_VARIANCE
    z = (FULL_LEVEL - levels) / np.sqrt(variance)
    log_density = -0.5 * z * z - 0.5 * np.log(2.0 * np.pi)
    cut = np.exp(2.0 * log_density - log_ndtr(-z))
    return np.asarray((ndtr(z) - z * np.exp(log_density) + cut) / variance)


def _about_the_mark(
    camera: TwinCamera, eye: CameraView, position: Position, exposure_s: float, margin_px: float
) -> Window:
    """Return the part of an image that the marker covers during the exposure, with a margin."""
    pixels, reach_px = [], 0.0
    for share in (-0.5, 0.0, 0.5):
        tip = position(share * exposure_s) + camera.marker_offset_m
        pixel, depth = eye.see(tip)
        if depth <= 0:
            raise BoundError(f"the marker is behind the {eye.side} camera")
        pixels.append((float(pixel[0]), float(pixel[1])))
        x, y, z = (eye.camera_from_world[:3, :3] @ tip + eye.camera_from_world[:3, 3]).tolist()
        radius_px = pixels_per_slope(eye.lens, x / z, y / z) * camera.marker_radius_m / z
        spread_px = camera.sensor.spread_px(z, eye.lens.fx_px)
        reach_px = max(reach_px, radius_px + 3.0 * spread_px + margin_px)
    window = eye.window(pixels, reach_px)
    if window is None:
        raise BoundError(f"the marker is outside the {eye.side} image")
    return window


def _pixel_from_world(eye: CameraView, point: Floats) -> Floats:
    """Return d(pixel)/d(world) (2, 3) at a world point."""
    step_m = 1e-6
    columns = [
        (eye.see(point + step_m * axis)[0] - eye.see(point - step_m * axis)[0]) / (2.0 * step_m)
        for axis in np.eye(3)
    ]
    return np.stack(columns, axis=1)


def _covariance(information: Floats, views: str) -> Floats:
    """Invert an information matrix, after scaling its diagonal to one."""
    scale = np.sqrt(np.diag(information))
    if not (scale > 0).all():
        raise BoundError(f"{views} view: no pixel depends on the marker's position, size or level")
    scaled = information / np.outer(scale, scale)
    if np.linalg.cond(scaled) > MAX_CONDITION:
        raise BoundError(f"{views} view: the marker's position is not observable")
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
