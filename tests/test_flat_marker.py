"""Test the detection of a flat marker, which is seen as an ellipse."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.nodes.triangulator.ellipse import integrate_ellipse
from flexsheet.nodes.triangulator.fingertip import DetectionInput, DetectorConfig, detect_all
from flexsheet.nodes.triangulator.flat_marker import DiscView, estimate_flat_pose
from flexsheet.nodes.triangulator.marker import (
    BlobFilter,
    Marker,
    detect_blobs,
    fit_flat_markers,
)
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import StereoGeometry
from flexsheet.nodes.twin.clutter import CLUTTER
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.pixels import Sensor, TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.tolerance_table import Profile, sample_apparatus
from flexsheet.nodes.twin.truth import apply_apparatus
from tests.drawn_discs import noisy

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
LAUNCH = Path(__file__).resolve().parent.parent / "launch"
FILTER, SENSOR = BlobFilter(), PixelNoise()
SIDE_PX, RAYS, BLUR_PX = 48, 8, 0.7
GROUND_LEVEL, MARKER_LEVEL = 70.0, 215.0
FINE = (np.arange(SIDE_PX * RAYS) - 0.5 * (RAYS - 1)) / RAYS
CENTRE = (23.3, 23.8)


def covered_by_ellipse(
    centre: tuple[float, float], semi_axes: tuple[float, float], angle_rad: float
) -> NDArray[np.bool_]:
    """Return which rays of the image meet an ellipse."""
    x, y = FINE[None, :] - centre[0], FINE[:, None] - centre[1]
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    along, across = x * cosine + y * sine, y * cosine - x * sine
    return np.asarray(np.hypot(along / semi_axes[0], across / semi_axes[1]) < 1.0)


def expose(lit: NDArray[np.bool_] | Floats, seed: int = 0) -> Image:
    """Blur and sample an image of rays, with the sensor's noise."""
    blurred = cv2.GaussianBlur(lit.astype(float), (0, 0), RAYS * BLUR_PX)
    share = np.asarray(blurred).reshape(SIDE_PX, RAYS, SIDE_PX, RAYS).mean(axis=(1, 3))
    levels = GROUND_LEVEL + share * (MARKER_LEVEL - GROUND_LEVEL)
    return noisy(levels, SENSOR, np.random.default_rng(seed))


def flat_markers_in(image: Image) -> list[Marker]:
    blobs = detect_blobs(image, FILTER)
    return fit_flat_markers([image] * len(blobs), blobs, SENSOR)


def valid_flat_markers_in(image: Image) -> list[Marker]:
    return [marker for marker in flat_markers_in(image) if marker.rejection_reason is None]


def test_the_light_of_an_ellipse_and_its_derivatives_are_exact() -> None:
    y, x = (each.ravel().astype(float) for each in np.mgrid[:15, :15])
    shape = np.array([[7.3, 6.8, 2.0, 0.75, 0.6, -0.4]])
    light, slopes = integrate_ellipse(shape, x, y)
    grid = (np.arange(15 * 20) - 9.5) / 20
    points = np.stack([each.ravel() for each in np.meshgrid(grid, grid)])
    axes = np.array([[2.6, -0.4], [-0.4, 1.4]])
    inside = np.hypot(*np.linalg.solve(axes, points - [[7.3], [6.8]])) < 1.0
    away = (x[:, None] - points[0, inside]) ** 2 + (y[:, None] - points[1, inside]) ** 2
    area = np.exp(-0.5 * away / 0.75**2).sum(axis=1) / (math.tau * 0.75**2 * 20**2)
    assert light[0] == pytest.approx(area, abs=3e-3)
    for number in range(6):
        step = np.zeros((1, 6))
        step[0, number] = 1e-5
        more, less = (integrate_ellipse(shape + sign * step, x, y)[0] for sign in (1, -1))
        assert slopes[0, number] == pytest.approx((more - less)[0] / 2e-5, abs=2e-3)


@given(
    offset=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    radius=st.floats(2.0, 8.0),
    ratio=st.floats(0.4, 1.0),
    angle_rad=st.floats(0.0, math.pi),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_the_centre_of_an_ellipse_is_accurate(
    offset: tuple[float, float], radius: float, ratio: float, angle_rad: float, seed: int
) -> None:
    centre = (23.5 + offset[0], 23.5 + offset[1])
    image = expose(covered_by_ellipse(centre, (radius, ratio * radius), angle_rad), seed)
    (marker,) = flat_markers_in(image)
    assert marker.rejection_reason is None
    assert math.dist(marker.centre.tolist(), centre) < 0.1
    length = math.hypot(*marker.elongation)
    assert marker.radius + length == pytest.approx(radius, abs=0.15)
    if ratio * radius > 1.5:  # a narrower one cannot be distinguished from a darker one
        assert marker.radius - length == pytest.approx(ratio * radius, abs=0.15)


@pytest.mark.parametrize("radius", [3.2, 6.0])
@pytest.mark.parametrize("ratio", [1.0, 0.7])
@pytest.mark.parametrize("angle_rad", [0.3, 1.4])
def test_half_a_disc_is_no_ellipse(radius: float, ratio: float, angle_rad: float) -> None:
    lit = covered_by_ellipse(CENTRE, (radius, ratio * radius), angle_rad)
    x, y = FINE[None, :] - CENTRE[0], FINE[:, None] - CENTRE[1]
    for share in (0.0, 0.3):
        cut = lit & (x * math.cos(0.8) + y * math.sin(0.8) < share * radius)
        for marker in valid_flat_markers_in(expose(cut)):
            major = marker.radius + math.hypot(*marker.elongation)
            assert major < 0.85 * radius


@pytest.mark.parametrize("radius", [3.2, 6.0])
@pytest.mark.parametrize("distance", [0.5, 1.0, 1.5, 1.9])
@pytest.mark.parametrize("other", [0.75, 1.0])
def test_merged_markers_are_no_ellipse_of_the_right_size_elsewhere(
    radius: float, distance: float, other: float
) -> None:
    """Two discs that nearly coincide resemble an ellipse, but a larger one."""
    beside = (CENTRE[0] + 0.8 * distance * radius, CENTRE[1] + 0.6 * distance * radius)
    lit = covered_by_ellipse(CENTRE, (radius, radius), 0.0)
    lit |= covered_by_ellipse(beside, (other * radius, other * radius), 0.0)
    for marker in valid_flat_markers_in(expose(lit)):
        is_larger = marker.radius + math.hypot(*marker.elongation) > 1.17 * radius
        assert is_larger or math.dist(marker.centre.tolist(), CENTRE) < 0.15 * radius


@pytest.mark.parametrize("radius", [3.2, 6.0])
@pytest.mark.parametrize("motion", [8.0, 12.0, 16.0])
def test_a_streak_of_motion_is_no_ellipse_of_the_right_size(radius: float, motion: float) -> None:
    steps = np.arange(-0.5, 0.5, 0.4 / motion)
    lit = np.mean(
        [
            covered_by_ellipse(
                (CENTRE[0] + 0.8 * motion * step, CENTRE[1] + 0.6 * motion * step),
                (radius, radius),
                0.0,
            )
            for step in steps
        ],
        axis=0,
    )
    for marker in valid_flat_markers_in(expose(lit)):
        assert marker.radius + math.hypot(*marker.elongation) > 1.17 * radius


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_constant_image_has_no_flat_marker(level: int) -> None:
    assert flat_markers_in(np.full((60, 80), level, np.uint8)) == []


def test_chaos_gives_finite_flat_markers() -> None:
    random = np.random.default_rng(3)
    for _ in range(6):
        image = cv2.GaussianBlur(random.normal(120.0, 80.0, (60, 80)), (0, 0), 1.5)
        image = 127.0 + 5.0 * (np.asarray(image) - image.mean())
        for marker in flat_markers_in(np.clip(image, 0, 255).astype(np.uint8)):
            assert np.isfinite(marker.centre).all()
            assert np.linalg.eigvalsh(marker.covariance).min() > 0.0


def pinhole_views(point: Floats, normal: Floats, radius_m: float) -> list[DiscView]:
    """Return two views of a disc by its projected edge, as of pinholes with 540 px."""
    found = []
    for shift_m in (0.0, 0.12):
        there = point - [shift_m, 0.0, 0.0]
        x, y, z = there
        jacobian = 540.0 / z * np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]])
        across = np.eye(3) - np.outer(normal, normal)
        square = radius_m**2 * jacobian @ across @ jacobian.T
        values, vectors = np.linalg.eigh(square)
        axes = vectors @ np.diag(np.sqrt(values)) @ vectors.T
        found.append(DiscView(np.eye(3), there, jacobian, axes))
    return found


def centre_of_edge(view: DiscView, normal: Floats, radius_m: float) -> Floats:
    """Return the centre of a disc's image, px, from the extremes of its projected edge."""
    first = np.cross(normal, [0.3, 0.8, 0.5])
    first /= np.linalg.norm(first)
    angle = np.linspace(0.0, math.tau, 20001)[:, None]
    edge = view.point + radius_m * (np.cos(angle) * first + np.sin(angle) * np.cross(normal, first))
    pixels = 540.0 * edge[:, :2] / edge[:, 2:]
    return np.asarray(0.5 * (pixels.min(axis=0) + pixels.max(axis=0)))


@pytest.mark.parametrize("tilt_rad", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("depth_m", [0.2, 0.5])
def test_perspective_shifts_the_centre_of_an_ellipse(tilt_rad: float, depth_m: float) -> None:
    """At half a metre by 0.01 px, at 0.2 m by 0.06 px; the normal gives it."""
    point = np.array([0.05, 0.02, depth_m])
    normal = np.array([0.6 * math.sin(tilt_rad), 0.8 * math.sin(tilt_rad), -math.cos(tilt_rad)])
    views = pinhole_views(point, normal, 0.003)
    pose = estimate_flat_pose(views, 0.003)
    assert pose.normal @ normal > math.cos(0.02)
    assert pose.mismatch_px < 1e-3
    for view, offset_px in zip(views, pose.centre_offsets_px, strict=True):
        seen = 540.0 * view.point[:2] / view.point[2]
        shift_px = centre_of_edge(view, normal, 0.003) - seen
        assert offset_px == pytest.approx(shift_px, abs=1e-3)
        assert np.linalg.norm(shift_px) < (0.02 if depth_m > 0.4 else 0.1)


def test_shapes_that_contradict_each_other_have_a_mismatch() -> None:
    normal = np.array([0.6, 0.0, -0.8])
    left, right = pinhole_views(np.array([0.05, 0.02, 0.5]), normal, 0.003)
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    wrong = DiscView(
        right.camera_from_left, right.point, right.jacobian, turned @ right.axes @ turned.T
    )
    assert estimate_flat_pose([left, wrong], 0.003).mismatch_px > 0.3


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 6))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("profile", list(Profile))
def test_the_marker_of_an_apparatus_is_measured(profile: Profile, seed: int) -> None:
    """At most one of 50 image pairs is invalid, with and without an expected position."""
    scene = load_scene(LAUNCH / "scenes" / "cylinder.yaml")
    calibration = StereoCalibration.load(LAUNCH / "calibrations" / "twin-bumblebee.yaml")
    truth = sample_apparatus(scene, seed, profile=profile, calibrated=True)
    true_scene = apply_apparatus(scene, truth)
    camera = TwinCamera(
        make_true_camera(true_scene.camera),
        finger_radius_m=true_scene.finger.radius_m,
        seed=3,
        clutter=CLUTTER["lab"],
        nail=Nail.of(truth.finger),
        sensor=Sensor(noisy_backgrounds=1),
    )
    random = np.random.default_rng(1)
    invalid = []
    for number in range(50):
        tip = random.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.06])
        velocity = random.uniform(-0.04, 0.04, 3)
        views = camera.picture(
            lambda t, tip=tip, velocity=velocity: tip + t * velocity,
            exposure_s=scene.camera.exposure_s,
        )
        marker = tip + camera.marker_offset_m
        found = detect_all(
            DetectionInput(
                views,
                StereoGeometry.of(scene.camera, calibration),
                DetectorConfig(FILTER, max_reprojection_px=1.5),
                (scene.finger.volume_min_m, scene.finger.volume_max_m),
                None if number % 2 else Gate(marker, 0.009),
            )
        )
        reason, measured = found.reason, found.measured
        if reason != "ok" or measured is None:
            invalid.append(reason)
        else:
            # Mostly the residual of the calibrated camera's pose.
            assert np.linalg.norm(measured.point_world - marker) < 6e-4
    assert len(invalid) <= 1, invalid
