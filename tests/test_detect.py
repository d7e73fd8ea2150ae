"""Test the detection of a fingertip in a stereo pair, and each reason for its rejection."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.types import FingertipReason
from flexsheet.nodes.models import rigid
from flexsheet.nodes.triangulator.fingertip import DetectionInput, DetectorConfig, detect_all
from flexsheet.nodes.triangulator.marker import BlobFilter
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.tracking import Gate
from flexsheet.nodes.triangulator.triangulation import StereoGeometry, TriangulatedPoint
from flexsheet.nodes.twin.clutter import (
    CLUTTER,
    Clutter,
    FixedPoint,
    Highlight,
    covered,
    second_marker,
    together,
    touching_highlight,
)
from flexsheet.nodes.twin.pixels import Sensor, TwinCamera
from tests.drawn_discs import DrawnDisc, noisy
from tests.examples import long_except
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Pictures = tuple[Image, Image]
SCENE = load_cylinder()
GEOMETRY = StereoGeometry.of(SCENE.camera)
VOLUME = (SCENE.finger.volume_min_m, SCENE.finger.volume_max_m)
HERE = np.array([0.01, 0.0, 0.02])
REACH_M = 0.009
LAB = CLUTTER["lab"]


def config(**changes: object) -> DetectorConfig:
    return replace(DetectorConfig(BlobFilter(), max_reprojection_px=1.5), **changes)


def detect_in(
    pictures: Pictures,
    *,
    expected: Floats | None = None,
    radius_m: float = REACH_M,
    volume: tuple[Floats, Floats] = VOLUME,
    geometry: StereoGeometry = GEOMETRY,
    **changes: object,
) -> tuple[FingertipReason, TriangulatedPoint | None]:
    gate = None if expected is None else Gate(expected, radius_m)
    found = detect_all(DetectionInput(pictures, geometry, config(**changes), volume, gate))
    return found.reason, found.measured


def twin(clutter: Clutter = LAB, **sensor: float) -> TwinCamera:
    return TwinCamera(
        SCENE.camera,
        finger_radius_m=SCENE.finger.radius_m,
        seed=4,
        clutter=clutter,
        sensor=replace(Sensor(), **sensor),
    )


def pictures(
    camera: TwinCamera, tip: Floats = HERE, velocity: Sequence[float] = (0, 0, 0)
) -> Pictures:
    return camera.picture(lambda t: tip + t * np.array(velocity), exposure_s=0.004)


def error_m(measured: TriangulatedPoint | None, tip: Floats = HERE) -> float:
    assert measured is not None
    return float(np.linalg.norm(measured.point_world - tip))


@given(
    point=st.tuples(st.floats(-0.12, 0.12), st.floats(-0.1, 0.1), st.floats(-0.1, 0.15)),
    origin=st.tuples(st.integers(0, 40), st.integers(0, 30)),
)
@settings(max_examples=15, deadline=None)
def test_a_point_is_drawn_and_found_again(
    point: tuple[float, float, float], origin: tuple[int, int]
) -> None:
    """The point is projected through calibrated lenses to two discs in regions of the sensor, and
    back."""
    truth, seed = np.array(point), np.random.default_rng(1)
    pixels = GEOMETRY.project(truth)
    depth_m = rigid.apply(GEOMETRY.left_from_world, truth)[2]
    views, origins = [], []
    for pixel in pixels:
        corner = (round(pixel[0]) - 28 - origin[0], round(pixel[1]) - 28 - origin[1])
        disc = DrawnDisc(pixel - corner - origin, 540.0 * 0.003 / depth_m, np.zeros(2), ground=40.0)
        image = np.full((130, 130), 40, np.uint8)
        image[origin[1] : origin[1] + 57, origin[0] : origin[0] + 57] = noisy(
            disc.levels(), PixelNoise(), seed
        )
        views.append(image)
        origins.append(corner)
    for expected in (None, Gate(truth + 0.002, REACH_M)):
        found = detect_all(
            DetectionInput(
                (views[0], views[1]), GEOMETRY, config(), VOLUME, expected, (origins[0], origins[1])
            )
        )
        reason, measured = found.reason, found.measured
        assert reason == "ok"
        assert error_m(measured, truth) < 4e-4


@pytest.mark.parametrize("speed_m_per_s", long_except([0.0, 1.0], 1.0))
def test_in_the_lab_every_pair_is_found_and_its_covariance_is_honest(
    speed_m_per_s: float,
) -> None:
    """The normalised squared error has a mean of 3 if the reported covariance is correct."""
    camera, random = twin(), np.random.default_rng(3)
    errors, normalised, reasons = [], [], Counter[str]()
    for _ in range(40):
        tip = random.uniform([-0.08, -0.08, -0.03], [0.08, 0.08, 0.08])
        way = random.standard_normal(3)
        velocity = speed_m_per_s * way / np.linalg.norm(way)
        reason, measured = detect_in(
            pictures(camera, tip, velocity),
            expected=tip + random.normal(0.0, 0.001, 3),
        )
        reasons[reason] += 1
        assert measured is not None
        error = measured.point_world - tip
        errors.append(error)
        normalised.append(error @ np.linalg.solve(measured.covariance, error))
    assert reasons == {"ok": 40}
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 1.2e-4
    assert 0.5 < np.mean(normalised) < 6.0


def test_the_marker_is_also_found_without_an_expected_position() -> None:
    """The lab's glints (on the clamps, on the nail) are smaller than a marker, or in one view
    only."""
    camera, random = twin(), np.random.default_rng(5)
    for _ in range(20):
        tip = random.uniform([-0.08, -0.08, -0.03], [0.08, 0.08, 0.08])
        reason, measured = detect_in(pictures(camera, tip))
        assert reason == "ok"
        assert error_m(measured, tip) < 5e-4


def test_a_region_of_interest_gives_what_the_whole_image_gives() -> None:
    views = pictures(twin())
    whole, near = detect_in(views), detect_in(views, expected=HERE + 0.003)
    assert whole[0] == near[0] == "ok"
    assert whole[1] is not None
    assert near[1] is not None
    assert np.array_equal(whole[1].point_world, near[1].point_world)


def test_images_of_regions_have_their_origin() -> None:
    views = pictures(twin())
    full = detect_in(views)[1]
    cut = tuple(np.ascontiguousarray(view[180:320, 200:470]) for view in views)
    corner, gate = (200, 180), Gate(HERE, REACH_M)
    found = detect_all(
        DetectionInput((cut[0], cut[1]), GEOMETRY, config(), VOLUME, gate, (corner, corner))
    )
    reason, measured = found.reason, found.measured
    assert reason == "ok"
    assert full is not None
    assert measured is not None
    assert np.allclose(full.point_world, measured.point_world, atol=1e-6)


def test_an_invalid_expected_position_is_ignored() -> None:
    views = pictures(twin())
    behind = rigid.apply(GEOMETRY.world_from_left, np.array([0.0, 0.0, -0.3]))
    assert detect_in(views, expected=np.full(3, np.nan))[0] == "ok"
    for nowhere in (behind, np.array([9.0, 0.0, 0.0])):
        assert detect_in(views, expected=nowhere)[0] == "too_fast"
        assert detect_in(views, expected=nowhere, radius_m=20.0)[0] == "ok"


def test_no_marker_and_a_marker_in_one_view() -> None:
    empty = twin().picture(lambda _: HERE, exposure_s=0.004, marker=False)
    views = pictures(twin())
    for expected in (None, HERE):
        assert detect_in(empty, expected=expected)[0] in (
            "no_marker",
            "marker_in_one_view",
            "inconsistent",
        )
        reason, measured = detect_in((views[0], np.full_like(views[1], 40)), expected=expected)
        assert (reason, measured) == ("marker_in_one_view", None)
    plain = twin(Clutter()).picture(lambda _: HERE, exposure_s=0.004, marker=False)
    assert detect_in(plain) == ("no_marker", None)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_marker_that_one_camera_does_not_see(side: str) -> None:
    hidden = covered(1.0, views="left" if side == "left" else "right")
    for expected in (None, HERE):
        reason, _ = detect_in(pictures(twin(together(LAB, hidden))), expected=expected)
        assert reason in ("marker_in_one_view", "inconsistent")


def test_two_markers_are_ambiguous_unless_one_is_expected() -> None:
    views = pictures(twin(together(LAB, second_marker((0.03, 0.0, 0.0)))))
    assert detect_in(views)[0] == "two_markers"
    for there in (HERE, HERE + np.array([0.03, 0.0, 0.0])):
        reason, measured = detect_in(views, expected=there)
        assert reason == "ok"
        assert error_m(measured, there) < 4e-4
    beside = pictures(twin(together(LAB, second_marker((0.012, 0.0, 0.0)))))
    reason, _ = detect_in(beside, expected=HERE + np.array([0.006, 0, 0]), radius_m=0.015)
    assert reason == "two_markers"
    assert detect_in(beside, expected=HERE, radius_m=0.005)[0] == "ok"


@pytest.mark.parametrize(
    ("radius_m", "views"), [(0.0012, "both"), (0.008, "both"), (0.003, "left")]
)
def test_a_light_that_is_no_marker_does_not_count(radius_m: float, views: str) -> None:
    """The light is too small or too large for its depth, or in one view only."""
    blob = Highlight(FixedPoint((0.05, 0.04, 0.02)), radius_m, 200.0, views=views)  # type: ignore[arg-type]  # a parameter of pytest is any str
    for expected in (None, HERE):
        reason, measured = detect_in(
            pictures(twin(together(LAB, Clutter(highlights=(blob,))))), expected=expected
        )
        assert reason == "ok"
        assert error_m(measured) < 4e-4


def test_lights_that_do_not_belong_together_are_inconsistent() -> None:
    views = pictures(twin())
    reason, measured = detect_in((views[0], np.roll(views[1], 12, axis=0)))
    assert reason == "inconsistent"
    assert measured is None or measured.reprojection_px > 1.5


@pytest.mark.parametrize("overlap", long_except([0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0], 0.1, 0.3, 0.7))
def test_a_marker_that_a_light_touches_is_right_or_rejected(overlap: float) -> None:
    camera, random = twin(together(LAB, touching_highlight(overlap))), np.random.default_rng(2)
    for _ in range(8):
        tip = random.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 0.05])
        reason, measured = detect_in(pictures(camera, tip), expected=tip)
        assert reason in ("ok", "merged", "blurred", "inconsistent", "two_markers")
        if reason == "ok":
            assert error_m(measured, tip) < 5e-4


@pytest.mark.parametrize(
    "share", long_except([0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9], 0.1, 0.35, 0.7)
)
def test_a_marker_that_is_partly_hidden_is_right_or_rejected(share: float) -> None:
    camera, random = twin(together(LAB, covered(share))), np.random.default_rng(2)
    for _ in range(8):
        tip = random.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 0.05])
        reason, measured = detect_in(pictures(camera, tip), expected=tip)
        assert reason in ("ok", "merged", "inconsistent", "no_marker", "marker_in_one_view")
        if reason == "ok":
            assert error_m(measured, tip) < 8e-4


@pytest.mark.parametrize("defocus_px", [0.5, 1.0, 1.5, 2.0, 3.0, 5.0])
def test_a_marker_out_of_focus_has_a_true_covariance_or_is_rejected(defocus_px: float) -> None:
    sensor = Sensor(aperture_m=0.05).out_of_focus(defocus_px, 0.48, 540.0)
    camera = twin(aperture_m=sensor.aperture_m, focus_m=sensor.focus_m)
    reason, measured = detect_in(pictures(camera), expected=HERE)
    assert reason in ("ok", "blurred", "merged", "no_marker", "marker_in_one_view", "inconsistent")
    if defocus_px <= 0.5:
        assert reason == "ok"
    if defocus_px >= 3.0:
        assert reason != "ok"
    if reason == "ok":
        assert error_m(measured) < 5e-4


def test_a_too_bright_image_is_saturated() -> None:
    white = np.full((480, 640), 255, np.uint8)
    views = pictures(twin())
    assert detect_in((white, white))[0] == "saturated"
    assert detect_in((views[0], white), expected=HERE)[0] == "saturated"
    assert detect_in(pictures(twin(exposure=6.0)), expected=HERE)[0] == "saturated"
    black = np.zeros_like(white)
    assert detect_in((black, black)) == ("no_marker", None)


@pytest.mark.parametrize("exposure", [0.6, 1.3])
def test_a_wrong_exposure_is_borne(exposure: float) -> None:
    reason, measured = detect_in(pictures(twin(exposure=exposure)), expected=HERE)
    assert reason == "ok"
    assert error_m(measured) < 4e-4


def test_beyond_the_volume_and_beyond_what_can_be_known() -> None:
    outside = np.array([0.0, 0.0, -0.16])
    reason, measured = detect_in(pictures(twin(Clutter()), outside))
    assert reason == "outside_volume"
    assert error_m(measured, outside) < 2e-3
    everywhere = (np.full(3, -1e9), np.full(3, 1e9))
    assert detect_in(pictures(twin(Clutter()), outside), volume=everywhere)[0] == "ok"
    uncertain, measured = detect_in(
        pictures(twin(Clutter())), volume=everywhere, max_deviation_m=1e-5
    )
    assert uncertain == "inconsistent"
    assert error_m(measured) < 4e-4


def test_a_baseline_too_short_for_the_depth_is_rejected_not_guessed() -> None:
    """With 2 mm between the cameras a hundredth of a pixel is 2 mm of depth."""
    short = SCENE.camera.right_from_left.copy()
    short[:3, 3] *= 0.002 / 0.1205
    rig = SCENE.camera.model_copy(update={"right_from_left": short})
    camera = TwinCamera(rig, finger_radius_m=SCENE.finger.radius_m, seed=4)
    everywhere = (np.full(3, -1e9), np.full(3, 1e9))
    reason, measured = detect_in(
        pictures(camera), geometry=StereoGeometry.of(rig), volume=everywhere
    )
    assert reason == "inconsistent"
    if measured is not None:
        assert measured.deviation_m > 0.002
        assert error_m(measured) < 5.0 * measured.deviation_m


def test_a_crowd_of_lights_never_makes_a_wrong_fingertip() -> None:
    camera, random = twin(CLUTTER["crowded"]), np.random.default_rng(8)
    reasons: Counter[str] = Counter()
    for _ in range(60):
        tip = random.uniform([-0.06, -0.06, -0.03], [0.06, 0.06, 0.06])
        time_s = float(random.uniform(0.0, 60.0))
        views = camera.picture(lambda _, tip=tip: tip, exposure_s=0.004, time_s=time_s)
        reason, measured = detect_in(views, expected=tip + random.normal(0.0, 0.001, 3))
        reasons[reason] += 1
        if reason == "ok":
            assert error_m(measured, tip) < 8e-4
    assert reasons["ok"] > 45
