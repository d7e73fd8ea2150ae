"""Test triangulation: `dlt` against an optimiser, and its failures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flexsheet.messages.calibration import Board, StereoCalibration
from flexsheet.messages.calibration_file import CalibrationMismatchError
from flexsheet.messages.scene import Scene
from flexsheet.nodes.models import camera, rigid
from flexsheet.nodes.triangulator.triangulation import (
    ClosestApproach,
    StereoGeometry,
    TriangulatedPoint,
    dlt,
    measure,
    project_with_jacobian,
    undistort_pixel,
)
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


@pytest.fixture(scope="module")
def geometry(scene: Scene) -> StereoGeometry:
    return StereoGeometry.of(scene.camera)


def turned_rig() -> Floats:
    """Return right_from_left of cameras that converge and are slightly rolled, as real ones."""
    return rigid.transform(rigid.rotation_from_rpy([0.02, -0.15, 0.03]), [-0.12, 0.004, 0.01])


def found_behind(
    geometry: StereoGeometry, left: Floats, right: Floats, noise_px: float = 0.1
) -> TriangulatedPoint | None:
    return measure(
        geometry,
        left,
        right,
        covariance=noise_px**2 * np.eye(2),
    )


def nearest_to_both_rays(left: Floats, right: Floats, right_from_left: Floats) -> Floats:
    """Solve for the point (3,) with the least squared distance to both rays."""
    inverse = np.linalg.inv(right_from_left)
    rays = (np.append(left, 1.0), inverse[:3, :3] @ np.append(right, 1.0))
    across = [np.eye(3) - np.outer(ray, ray) / (ray @ ray) for ray in rays]
    return np.asarray(np.linalg.solve(across[0] + across[1], across[1] @ inverse[:3, 3]))


def seen(points: Floats, right_from_left: Floats) -> tuple[Floats, Floats]:
    right = rigid.apply(right_from_left, points)
    return points[:, :2] / points[:, 2:], right[:, :2] / right[:, 2:]


@given(point=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0.2, 3.0)))
@settings(max_examples=60, deadline=None)
def test_exact_pixels_give_the_exact_point(point: tuple[float, float, float]) -> None:
    truth = np.array([point])
    for rig in (rigid.transform(np.eye(3), [-0.12, 0.0, 0.0]), turned_rig()):
        found = dlt(*seen(truth, rig), rig)
        assert np.allclose(found, truth, rtol=1e-8, atol=1e-9)


def test_marker_noise_leaves_no_more_error_than_the_least_image_error() -> None:
    """Compare with the maximum-likelihood point, which SciPy finds from the four coordinates."""
    rig, generator = turned_rig(), np.random.default_rng(2)
    truth = generator.uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 1.0], (40, 3))
    noise = 0.1 / 540.0
    left, right = (
        view + noise * generator.standard_normal(view.shape) for view in seen(truth, rig)
    )

    def image_error(point: Floats, i: int) -> Floats:
        views = seen(point[None], rig)
        return np.concatenate([views[0][0] - left[i], views[1][0] - right[i]])

    likeliest = [
        least_squares(image_error, start, args=(i,), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        for i, start in enumerate(truth)
    ]
    found = dlt(left, right, rig)
    reference_m = np.linalg.norm(np.array(likeliest) - truth)
    assert np.linalg.norm(found - truth) == pytest.approx(reference_m, rel=0.01)


def test_parallel_rays_give_no_finite_point() -> None:
    rig = rigid.transform(np.eye(3), [-0.12, 0.0, 0.0])
    pixel = np.array([[0.1, 0.05]])
    point = dlt(pixel, pixel, rig)[0]
    assert not np.isfinite(point).all() or np.linalg.norm(point) > 1e6


@given(point=st.tuples(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(-0.1, 0.15)))
@settings(max_examples=60, deadline=None)
def test_pixels_through_the_lenses_and_back(
    geometry: StereoGeometry, point: tuple[float, float, float]
) -> None:
    truth = np.array(point)
    left, right = geometry.project(truth)
    found = found_behind(geometry, left, right)
    assert found is not None
    assert np.allclose(found.point_world, truth, atol=1e-8)
    assert found.reprojection_px < 1e-6


def test_the_covariance_is_that_of_noisy_pixels(geometry: StereoGeometry) -> None:
    truth, noise_px, generator = np.array([0.03, -0.02, 0.01]), 0.2, np.random.default_rng(1)
    left, right = geometry.project(truth)
    points, stated, squares = [], None, []
    for _ in range(1500):
        noise = noise_px * generator.standard_normal((2, 2))
        found = found_behind(geometry, left + noise[0], right + noise[1], noise_px)
        assert found is not None
        points.append(found.point_world)
        stated = found.covariance
        squares.append(found.reprojection_px**2)
    assert stated is not None
    actual = np.cov(np.array(points).T)
    assert np.allclose(np.linalg.eigvalsh(actual), np.linalg.eigvalsh(stated), rtol=0.2)
    # Four pixel coordinates less three of the point leave one to be misfit.
    assert np.mean(squares) == pytest.approx(noise_px**2 / 2, rel=0.2)
    depth_m, baseline_m, focal_px = 0.49, 0.1205, 540.0
    along_view = np.sqrt(np.linalg.eigvalsh(stated)[-1])
    rule = depth_m**2 / (focal_px * baseline_m) * np.sqrt(2) * noise_px
    assert along_view == pytest.approx(rule, rel=0.15)


def test_mismatched_markers_have_a_large_reprojection_error(
    geometry: StereoGeometry,
) -> None:
    left, right = geometry.project(np.array([0.0, 0.0, 0.0]))
    found = found_behind(geometry, left, right + np.array([0.0, 8.0]))
    assert found is not None
    assert found.reprojection_px == pytest.approx(4.0, rel=0.05)


def test_a_point_behind_the_cameras_is_none(geometry: StereoGeometry) -> None:
    left, right = geometry.project(np.array([0.0, 0.0, 0.0]))
    far_apart = found_behind(geometry, left, right + np.array([200.0, 0.0]))
    assert far_apart is None


def test_a_pixel_that_is_no_number_is_none(geometry: StereoGeometry) -> None:
    right = np.array([300.0, 200.0])
    for bad in (np.array([np.nan, 200.0]), np.array([np.inf, 200.0])):
        assert found_behind(geometry, bad, right) is None


def calibration_of(scene: Scene, **changes: object) -> StereoCalibration:
    camera = scene.camera
    calibration = StereoCalibration(
        device=camera.device,
        date="2026-01-01T00:00:00+00:00",
        code_version="0",
        width_px=camera.width_px,
        height_px=camera.height_px,
        left=camera.left.model_copy(update={"fx_px": 600.0}),
        right=camera.right,
        right_from_left=camera.right_from_left,
        board=Board(columns=9, rows=6, square_m=0.02),
        reprojection_rms_px=0.1,
        pairs=(),
    )
    return calibration.model_copy(update=changes)


def test_a_calibration_replaces_the_optics_but_not_the_pose(scene: Scene) -> None:
    geometry = StereoGeometry.of(scene.camera, calibration_of(scene))
    assert geometry.matrices[0][0, 0] == 600.0
    assert np.allclose(geometry.world_from_left[:3, 3], scene.camera.world_from_left.position_m)


def test_a_calibration_of_another_camera_is_rejected(scene: Scene) -> None:
    with pytest.raises(CalibrationMismatchError, match=r'of the camera "other".*"twin-bumblebee"'):
        StereoGeometry.of(scene.camera, calibration_of(scene, device="other"))
    with pytest.raises(CalibrationMismatchError, match=r"1024x480 px.*640x480 px"):
        StereoGeometry.of(scene.camera, calibration_of(scene, width_px=1024))


WIDE = np.array([-0.32, 0.12, 0.0008, -0.0006, 0.01])
"""Distortion of a wide-angle lens."""


@given(ray=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.45, 0.45)), depth=st.floats(0.1, 5.0))
@settings(max_examples=80, deadline=None)
def test_a_ray_through_a_wide_lens_and_back_with_its_slope(
    ray: tuple[float, float], depth: float
) -> None:
    matrix = camera.camera_matrix(540.0, 538.0, 321.0, 236.0)
    point = depth * np.array([*ray, 1.0])
    pixel, slope = project_with_jacobian(point, matrix, WIDE)
    assert np.allclose(pixel, camera.project(point, matrix, WIDE), atol=1e-9)
    assert undistort_pixel(pixel, matrix, WIDE) == pytest.approx(ray, abs=1e-9)
    step = 1e-6 * depth
    for axis in range(3):
        change = step * np.eye(3)[axis]
        ends = [camera.project(point + sign * change, matrix, WIDE) for sign in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * step), slope[:, axis], atol=1e-3 / depth)


def test_a_pixel_beyond_what_the_lens_draws_has_no_ray() -> None:
    """This lens maps all of space into 400 px around its centre; beyond it is not invertible."""
    matrix = camera.camera_matrix(540.0, 540.0, 320.0, 240.0)
    barrel = np.array([-0.5, 0.0, 0.0, 0.0, 0.0])
    assert undistort_pixel(np.array([400.0, 240.0]), matrix, barrel) is not None
    assert undistort_pixel(np.array([720.0, 240.0]), matrix, barrel) is None


@given(
    point=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.2, 2.0)),
    off=st.tuples(*[st.floats(-2e-3, 2e-3)] * 4),
)
@settings(max_examples=60, deadline=None)
def test_one_pair_of_rays_meets_where_arrays_of_them_do(
    point: tuple[float, float, float], off: tuple[float, float, float, float]
) -> None:
    rig = turned_rig()
    left, right = seen(np.array([point]), rig)
    left, right = left + off[:2], right + off[2:]
    met = ClosestApproach.of(rig).between(tuple(left[0]), tuple(right[0]))
    assert met is not None
    assert np.allclose(met[0], nearest_to_both_rays(left[0], right[0], rig), atol=1e-9)
    assert met[1] <= 2e-3 * np.sqrt(8.0) * (met[0][2] + 0.1)


def test_rays_that_do_not_meet_before_the_cameras_have_no_approach() -> None:
    approach = ClosestApproach.of(rigid.transform(np.eye(3), [-0.12, 0.0, 0.0]))
    assert approach.between((0.1, 0.0), (0.1, 0.0)) is None
    assert approach.between((0.1, 0.0), (0.2, 0.0)) is None
    assert approach.between((0.1, 0.0), (0.0, 0.0)) is not None


@pytest.mark.parametrize("depth_m", [0.5, 2.0, 8.0, 30.0])
def test_a_covariance_grows_as_the_rays_become_parallel(
    geometry: StereoGeometry, depth_m: float
) -> None:
    """Depth errors grow with the square of the depth; reported ones must grow at least as fast."""
    truth = rigid.apply(geometry.world_from_left, np.array([0.0, 0.0, depth_m]))
    left, right = geometry.project(truth)
    exact = found_behind(geometry, left, right, 0.01)
    assert exact is not None
    rule_m = depth_m**2 / (540.0 * 0.1205) * np.sqrt(2.0) * 0.01
    assert exact.deviation_m == pytest.approx(rule_m, rel=0.15)
    moved = found_behind(geometry, left, right + np.array([0.01, 0.0]), 0.01)
    assert moved is not None
    assert np.linalg.norm(moved.point_world - truth) < 1.5 * exact.deviation_m


def test_uneven_noise_is_carried_to_the_point(geometry: StereoGeometry) -> None:
    """A marker that is elongated along x is uncertain there, as the point's covariance must be."""
    truth, generator = np.array([0.03, -0.02, 0.01]), np.random.default_rng(4)
    left, right = geometry.project(truth)
    spreads = (np.diag([0.3, 0.05]) ** 2, np.diag([0.05, 0.2]) ** 2)
    normalised = []
    for _ in range(600):
        shifts = [generator.multivariate_normal(np.zeros(2), spread) for spread in spreads]
        found = measure(
            geometry,
            left + shifts[0],
            right + shifts[1],
            covariance=spreads[0],
            right_covariance=spreads[1],
        )
        assert found is not None
        error = found.point_world - truth
        normalised.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(normalised) == pytest.approx(3.0, rel=0.15)


def test_errors_in_the_fingers_volume_meet_the_scenes_tolerance(scene: Scene) -> None:
    low, high = np.array(scene.finger.volume_min_m), np.array(scene.finger.volume_max_m)
    size = (high - low) * [1.0, 1.0, 1.0 / 3.0]

    def error_m(baseline_m: float, noise_px: float) -> float:
        """Return the root mean square error in the worst third of the volume's height."""
        rig = scene.camera.right_from_left.copy()
        rig[:3, 3] *= baseline_m / np.linalg.norm(rig[:3, 3])
        geometry = StereoGeometry.of(scene.camera.model_copy(update={"right_from_left": rig}))
        errors = []
        for third in range(3):
            random = np.random.default_rng(third)
            truth = low + size * (random.random((2000, 3)) + np.array([0.0, 0.0, third]))
            pixels = geometry.project(truth)
            left, right = (view + noise_px * random.standard_normal(view.shape) for view in pixels)
            found = dlt(*geometry.normalize(left, right), geometry.right_from_left)
            away = np.linalg.norm(rigid.apply(geometry.world_from_left, found) - truth, axis=1)
            errors.append(np.sqrt(np.mean(away**2)))
        return float(np.max(errors))

    tolerance_m = scene.tolerances.fingertip_m
    for baseline_m in (0.1205, 0.24):
        for noise_px in (0.01, 0.025):
            assert error_m(baseline_m, noise_px) < tolerance_m
    assert error_m(0.012, 0.025) > tolerance_m
    assert error_m(0.1205, 2.0) > tolerance_m
