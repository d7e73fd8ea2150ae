"""Test the detection of markers in single images, and the accuracy of their centres."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.nodes.triangulator.marker import (
    BlobFilter,
    Marker,
    detect_blobs,
    is_overexposed,
    subpixel_fit,
    window_around,
)
from flexsheet.nodes.triangulator.subpixel import DiscStart, PixelNoise, fit_discs
from tests.drawn_discs import DrawnDisc, centre_bound_px, noisy
from tests.examples import long_except

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
LOOKS, SENSOR = BlobFilter(), PixelNoise()


def disc(
    centre: tuple[float, float],
    *,
    radius: float = 4.0,
    level: float = 200.0,
    ground: float = 30.0,
    blur_px: float = 0.0,
) -> Image:
    """Draw a disc on a uniform ground, with each pixel weighted by its covered fraction."""
    y, x = np.mgrid[0 : 100 * 8, 0 : 120 * 8] / 8.0 - 0.4375
    covered = np.hypot(x - centre[0], y - centre[1]) < radius
    share = covered.reshape(100, 8, 120, 8).mean(axis=(1, 3))
    if blur_px > 0:
        share = np.asarray(cv2.GaussianBlur(share, (0, 0), blur_px))
    return np.clip(np.rint(ground + share * (level - ground)), 0, 255).astype(np.uint8)


def markers_in(image: Image) -> list[Marker]:
    blobs = detect_blobs(image, LOOKS)
    return subpixel_fit([image] * len(blobs), blobs, SENSOR)


def sound_marks_in(image: Image) -> list[Marker]:
    return [marker for marker in markers_in(image) if marker.rejection_reason is None]


@given(x=st.floats(20, 100), y=st.floats(20, 80), radius=st.floats(2.5, 8))
@settings(max_examples=40, deadline=None)
def test_centres_are_exact_to_a_fraction_of_a_pixel(x: float, y: float, radius: float) -> None:
    """Without blur the smallest marker is the hardest at the worst position on the pixel grid."""
    image = disc((x, y), radius=radius)
    (marker,) = markers_in(image)
    assert np.linalg.norm(marker.centre - [x, y]) < 0.04


def test_a_window_gives_the_same_marker_as_the_whole_image() -> None:
    image = disc((61.3, 40.7), blur_px=0.7)
    window = window_around(np.array([65.0, 45.0]), image.shape, LOOKS.window_half_px)
    whole, near = detect_blobs(image, LOOKS), detect_blobs(image, LOOKS, window)
    a, b = (subpixel_fit([image], blobs, SENSOR)[0] for blobs in (whole, near))
    assert np.array_equal(a.centre, b.centre)
    assert np.array_equal(a.covariance, b.covariance)


def test_a_window_stays_inside_the_image() -> None:
    assert window_around(np.array([2.0, 3.0]), (480, 640), 10) == (slice(0, 14), slice(0, 13))
    for outside in ([-50.0, 3.0], [np.inf, 3.0], [np.nan, 3.0], [3.0, 1e300]):
        assert window_around(np.array(outside), (480, 640), 10) is None


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((100, 120), np.uint8),
        np.full((100, 120), 255, np.uint8),
        np.full((100, 120), 128, np.uint8),
        disc((60, 40), level=70),
        disc((60, 40), radius=0.7),
        disc((60, 40), radius=30),
        disc((60, 1)),
        disc((118, 40)),
        np.random.default_rng(0).integers(0, 256, (100, 120)).astype(np.uint8),
    ],
    ids=["black", "saturated", "grey", "dim", "speck", "lamp", "cut top", "cut right", "chaos"],
)
def test_what_is_no_marker_is_not_found(image: Image) -> None:
    assert sound_marks_in(image) == []


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (200, 2)])
def test_images_too_small_for_a_marker_have_none(shape: tuple[int, int]) -> None:
    assert detect_blobs(np.full(shape, 200, np.uint8), LOOKS) == []


def test_only_a_white_image_is_overexposed() -> None:
    assert is_overexposed(np.full((50, 50), 255, np.uint8))
    assert not is_overexposed(np.full((50, 50), 240, np.uint8))
    image = disc((60, 40), level=255)
    assert not is_overexposed(image)
    assert is_overexposed(image, (slice(37, 44), slice(57, 64)))


def test_a_marker_on_a_bright_finger_and_beside_a_brighter_light_is_found() -> None:
    image = disc((40.0, 40.0), level=215.0)
    image[60:, 30:50] = 110  # the finger, up to the mark and under it
    image[36:60, 30:50] = np.maximum(image[36:60, 30:50], 110)
    cv2.circle(image, (75, 40), 14, 255, -1)
    near = [blob for blob in detect_blobs(image, LOOKS) if math.dist(blob.centre, (40, 40)) < 1.0]
    assert len(near) == 1


def drawn(
    count: int, radius_px: float, motion_px: float, *, seed: int, noise: PixelNoise = SENSOR
) -> list[tuple[DrawnDisc, Image]]:
    """Draw discs at random subpixel positions and motions, with sensor noise."""
    random = np.random.default_rng(seed)
    discs = []
    for _ in range(count):
        angle = random.uniform(0.0, np.pi)
        motion = motion_px * np.array([np.cos(angle), np.sin(angle)])
        one = DrawnDisc(28.0 + random.uniform(-0.5, 0.5, 2), radius_px, motion)
        discs.append((one, noisy(one.levels(), noise, random)))
    return discs


@pytest.mark.parametrize(
    ("radius_px", "motion_px"),
    long_except([(1.6, 0.0), (3.2, 0.0), (3.2, 4.0), (6.0, 0)], (1.6, 0.0), (3.2, 0.0), (6.0, 0)),
)
def test_the_fit_is_near_the_bound_with_a_true_covariance(
    radius_px: float, motion_px: float
) -> None:
    """The error is within 1.25 of the bound, although the fit also estimates a sloped ground. The
    errors, normalised by the reported covariance, are near 2, as for an exact one."""
    discs = drawn(100, radius_px, motion_px, seed=5)
    bound_px = np.mean([centre_bound_px(one, SENSOR) for one, _ in discs[:3]])
    errors, normalised = [], []
    for one, image in discs:
        (marker,) = markers_in(image)
        error = marker.centre - one.centre
        errors.append(error)
        normalised.append(error @ np.linalg.solve(marker.covariance, error))
        assert marker.rejection_reason is None
        assert marker.radius == pytest.approx(radius_px, rel=0.05 + 0.15 / radius_px)
    assert np.sqrt(np.mean(np.square(errors))) < 1.35 * bound_px
    assert 0.4 < np.mean(normalised) < 2.6


def test_a_marker_drawn_out_by_motion_is_less_certain_along_it() -> None:
    ratios = []
    for one, image in drawn(10, 3.2, 6.0, seed=6):
        (marker,) = markers_in(image)
        along = one.motion / np.linalg.norm(one.motion)
        across = np.array([-along[1], along[0]])
        ratios.append(along @ marker.covariance @ along / (across @ marker.covariance @ across))
    assert np.mean(ratios) > 1.1


def test_more_noise_than_the_sensor_should_have_is_stated() -> None:
    """The residuals show it, independent of the sensor's specification."""
    loud = PixelNoise(4.0 * SENSOR.read_levels, SENSOR.photons_per_level / 16.0)
    normalised = []
    for one, image in drawn(100, 3.2, 0.0, seed=7, noise=loud):
        (marker,) = markers_in(image)
        error = marker.centre - one.centre
        normalised.append(error @ np.linalg.solve(marker.covariance, error))
    assert 1.2 < np.mean(normalised) < 3.0


def test_an_overexposed_marker_keeps_its_centre_and_covariance() -> None:
    errors, normalised = [], []
    for one, _ in drawn(60, 3.2, 0.0, seed=8):
        image = noisy(replace(one, marker=400.0).levels(), SENSOR, np.random.default_rng(1))
        (marker,) = markers_in(image)
        error = marker.centre - one.centre
        errors.append(error)
        normalised.append(error @ np.linalg.solve(marker.covariance, error))
    assert np.sqrt(np.mean(np.square(errors))) < 0.03
    assert np.mean(normalised) < 3.0


def test_a_marker_out_of_focus_is_reported() -> None:
    sharp, soft = (
        noisy(
            DrawnDisc(np.array([28.2, 27.9]), 4.5, np.zeros(2), blur_px=blur_px).levels(),
            SENSOR,
            np.random.default_rng(2),
        )
        for blur_px in (1.5, 3.6)
    )
    assert [marker.rejection_reason for marker in markers_in(sharp)] == [None]
    assert [marker.rejection_reason for marker in markers_in(soft)] == ["blurred"]


@pytest.mark.parametrize("gap_px", [3.0, 4.0, 5.5])
def test_a_marker_merged_with_a_light_is_not_valid(gap_px: float) -> None:
    """Two lights in one blob never give a valid marker of the right size between them."""
    image = np.maximum(disc((50.0, 40.0), radius=3.2), disc((50.0 + gap_px, 41.0), radius=2.5))
    image = np.maximum(image, disc((50.0 + gap_px, 41.0), radius=2.5, level=255.0))
    for marker in sound_marks_in(np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7))):
        wrong_px = np.linalg.norm(marker.centre - [50.0, 40.0])
        assert wrong_px < 0.3 or abs(math.log(marker.radius / 3.2)) > 0.15


def test_half_a_marker_is_not_valid() -> None:
    image = disc((50.0, 40.0), radius=3.2, blur_px=0.7)
    image[:, 51:] = 30
    for marker in sound_marks_in(image):
        assert marker.radius < 0.8 * 3.2


def test_each_fit_converges_independently_of_the_others() -> None:
    image = disc((50.0, 40.0), blur_px=0.7)
    deviation = DiscStart((56.0, 40.0), 4.0, 0.8, 200.0, 30.0, (0.0, 0.0))
    nothing = DiscStart((20.0, 80.0), 4.0, 0.8, 200.0, 30.0, (0.0, 0.0))
    outside = DiscStart((-3.0, 50.0), 4.0, 0.8, 200.0, 30.0, (0.0, 0.0))
    good = DiscStart((50.3, 39.8), 3.5, 0.9, 210.0, 40.0, (0.0, 0.0))
    fits = fit_discs([image] * 4, [deviation, nothing, outside, good], SENSOR)
    assert [fit.converged for fit in fits] == [False, True, False, True]
    assert fits[1].height < 0.01, "without a disc, the fit has no contrast"
    alone = fit_discs([image], [good], SENSOR)[0]
    assert alone.converged
    assert np.allclose(alone.centre, [50.0, 40.0], atol=0.01)
    assert fit_discs([], [], SENSOR) == []
    for fit in fits:
        assert np.isfinite(fit.covariance).all()


@given(seed=st.integers(0, 10**6))
@settings(max_examples=12, deadline=None)
def test_no_image_breaks_the_search(seed: int) -> None:
    """Noise and steps can give markers, but all numbers are finite."""
    random = np.random.default_rng(seed)
    image = random.normal(120.0, 80.0, (60, 80))
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), float(random.uniform(0.3, 3.0))))
    image = 127.0 + (image - image.mean()) * float(random.uniform(1.0, 20.0))
    picture = np.clip(image, 0, 255).astype(np.uint8)
    for marker in markers_in(picture):
        assert np.isfinite(marker.centre).all()
        assert np.linalg.eigvalsh(marker.covariance).min() > 0
