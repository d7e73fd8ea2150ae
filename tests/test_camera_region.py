"""Test sensor regions: the visible finger volume, cropping, and rejected regions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from camera_bench import HEIGHT, WIDTH, load_scene, running
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Lens, Pose, Scene
from flexsheet.messages.types import StereoPair
from flexsheet.nodes.camera.image_pair import DeviceError, ImagePair, Region, check_size, crop
from flexsheet.nodes.camera.node import CameraParameters
from flexsheet.nodes.camera.region import (
    ExplicitRegions,
    find_finger_regions,
    find_visible_region,
    resolve_regions,
)
from flexsheet.nodes.models import rigid
from tests.examples import examples

WIDE, HIGH = 640, 480
SCENE = load_scene(WIDE, HIGH)
RAMP = np.add.outer(np.arange(HEIGHT), 2 * np.arange(WIDTH)).astype(np.uint8)


def moved(scene: Scene, position_m: tuple[float, float, float], tilt_rad: float) -> Scene:
    """Return the scene with a displaced and tilted camera."""
    pose = scene.camera.world_from_left
    there = Pose(position_m=position_m, rpy_rad=(pose.rpy_rad[0] + tilt_rad, *pose.rpy_rad[1:]))
    camera = scene.camera.model_copy(update={"world_from_left": there})
    return scene.model_copy(update={"camera": camera})


def drawn(points_world: np.ndarray, scene: Scene, side: int) -> np.ndarray:
    """Project points with OpenCV."""
    camera = scene.camera
    pose = camera.world_from_left
    left_from_world = np.linalg.inv(rigid.transform_from_rpy(pose.position_m, pose.rpy_rad))
    from_world = (
        left_from_world if side == 0 else np.asarray(camera.right_from_left) @ (left_from_world)
    )
    lens = (camera.left, camera.right)[side]
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    rotation = cv2.Rodrigues(from_world[:3, :3])[0]
    pixels, _ = cv2.projectPoints(
        points_world, rotation, from_world[:3, 3], matrix, np.array(lens.distortion)
    )
    return np.asarray(pixels)[:, 0]


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-0.3, 0.2),
    y=st.floats(0.2, 0.5),
    z=st.floats(0.35, 1.2),
    tilt=st.floats(-0.3, 0.3),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_finger_that_a_view_can_see_lies_in_its_region(
    x: float, y: float, z: float, tilt: float, seed: int
) -> None:
    scene = moved(SCENE, (x, y, z), tilt)
    low, high = np.array(scene.finger.volume_min_m), np.array(scene.finger.volume_max_m)
    points = np.random.default_rng(seed).uniform(low, high, (200, 3))
    try:
        regions = find_finger_regions(scene)
    except DeviceError:
        return
    for side, region in enumerate(regions):
        pixels = drawn(points, scene, side)
        on_sensor = np.all((pixels >= 0) & (pixels <= [WIDE - 1, HIGH - 1]), axis=1)
        seen = pixels[on_sensor]
        assert np.all(seen >= [region.column, region.row])
        assert np.all(seen <= [region.column + region.width - 1, region.row + region.height - 1])


def test_a_region_is_no_larger_than_it_need_be() -> None:
    """The region contains the image of the volume, the finger's radius and the margin."""
    finger = SCENE.finger.model_copy(
        update={"volume_min_m": (-0.02, -0.02, -0.02), "volume_max_m": (0.02, 0.02, 0.02)}
    )
    for region in find_finger_regions(SCENE.model_copy(update={"finger": finger})):
        image_px = 2 * 540 * (0.02 + 0.007) * np.sqrt(2) / 0.48
        assert region.width <= image_px + 2 * (16 + 16)
        assert region.height <= image_px + 2 * (16 + 2)
        assert region.column % 16 == 0
        assert region.row % 2 == 0


def test_a_lens_that_folds_back_outside_the_image_loses_nothing() -> None:
    """With k1 = -0.5, the distortion polynomial is not monotonic beyond 0.8 focal lengths."""
    lens = Lens(fx_px=540, fy_px=540, cx_px=319.5, cy_px=239.5, distortion=(-0.5, 0, 0, 0, 0))
    line = np.stack([np.linspace(0.0, 3.0, 4000), np.zeros(4000), np.ones(4000)], axis=-1)
    region = find_visible_region(line, lens, WIDE, HIGH)
    assert region is not None
    assert region.column <= 319 - 16
    # The farthest column that this lens can reach on that row, by its own polynomial.
    x = np.linspace(0.0, 0.8, 1000)
    reached_px = 319.5 + 540 * np.max(x * (1 - 0.5 * x * x))
    assert region.column + region.width >= min(WIDE, reached_px)


def test_a_volume_around_the_camera_fills_the_image() -> None:
    scene = moved(SCENE, (0.0, 0.0, 0.0), 0.0)
    whole = Region(0, 0, WIDE, HIGH)
    assert find_finger_regions(scene) == (whole, whole)


@pytest.mark.parametrize("tilt_rad", [np.pi, 1.2], ids=["behind", "beside"])
def test_a_camera_that_faces_elsewhere_is_reported(tilt_rad: float) -> None:
    scene = moved(SCENE, (0.0, 0.5, 0.9), tilt_rad)
    with pytest.raises(
        DeviceError, match=r"the left view does not show the box from finger\.volume"
    ):
        find_finger_regions(scene)


def test_regions_beyond_the_sensor_are_rejected() -> None:
    asked = ExplicitRegions(left=Region(0, 0, 64, 48), right=Region(600, 0, 64, 48))
    with pytest.raises(DeviceError, match=r"region\.right: 64x48 px at \(600, 0\) is outside"):
        resolve_regions(asked, SCENE)


@pytest.mark.parametrize(
    "region",
    [
        "fingers",
        {"left": [0, 0, 10, 10]},
        {"left": [0, 0, 10, 10], "right": [0, 0, 0, 10]},
        {"left": [0, 0, 10, 10], "right": [-1, 0, 10, 10]},
        {"left": [0, 0, 10, 10], "right": [0, 0, 10]},
    ],
)
def test_a_wrong_region_is_rejected(region: object) -> None:
    with pytest.raises(ValidationError):
        CameraParameters.model_validate({"region": region})


@examples(50)
@given(data=st.data())
def test_a_cut_shows_the_same_pixels_of_the_sensor(data: st.DataObject) -> None:
    def inside(whole: Region) -> Region:
        column = data.draw(st.integers(0, whole.width - 1))
        row = data.draw(st.integers(0, whole.height - 1))
        width = data.draw(st.integers(1, whole.width - column))
        height = data.draw(st.integers(1, whole.height - row))
        return Region(whole.column + column, whole.row + row, width, height)

    def part(region: Region) -> np.ndarray:
        rows = slice(region.row, region.row + region.height)
        return RAMP[rows, region.column : region.column + region.width]

    whole = Region(0, 0, WIDTH, HEIGHT)
    reads = inside(whole), inside(whole)
    wanted = inside(reads[0]), inside(reads[1])
    result = crop(ImagePair(part(reads[0]), part(reads[1]), 7, regions=reads), wanted)
    np.testing.assert_array_equal(result.left, part(wanted[0]))
    np.testing.assert_array_equal(result.right, part(wanted[1]))
    assert result.regions == wanted
    assert result.exposure_ns == 7


def test_a_crop_outside_the_image_is_rejected() -> None:
    reads = Region(0, 0, 64, 40), Region(10, 0, 64, 40)
    pictures = ImagePair(RAMP[:40, :64], RAMP[:40, 10:74], 0, regions=reads)
    with pytest.raises(DeviceError, match=r"region\.right: 20x20 px at"):
        crop(pictures, (Region(0, 0, 20, 20), Region(0, 0, 20, 20)))


def test_images_must_have_their_regions_size() -> None:
    camera = load_scene().camera
    reads = Region(0, 0, 64, 40), Region(10, 0, 64, 40)
    check_size(ImagePair(RAMP[:40, :64], RAMP[:40, :64], 0, regions=reads), camera, "camera")
    wrong = ImagePair(RAMP[:40, :64], RAMP, 0, regions=reads)
    with pytest.raises(DeviceError, match=r"right view has 160x120 px, but its region is 64x40 px"):
        check_size(wrong, camera, "camera")


async def test_the_twins_pairs_are_cut_to_the_fingers_regions() -> None:
    scene = load_scene()
    async with running(scene, source="twin", region="finger") as bench:
        left, right = find_finger_regions(scene)
        pair = StereoPair(device="t", exposure_s=0.0, dropped_frames=0, left=RAMP, right=RAMP)
        header = Header(1, 5, 6, bench.node.clock.id, "twin", 1)
        await bench.node.step("twin__stereo", pair, header)
        sent, header = bench.sent[0]
        assert header.source_ns == 5
        assert sent.exposure_s == 0.0
        assert sent.left_origin_px == (left.column, left.row)
        assert sent.right.shape == (right.height, right.width)
        origin = sent.left_origin_px
        np.testing.assert_array_equal(
            sent.left, RAMP[origin[1] :, origin[0] :][: left.height, : left.width]
        )
        # What is cut already passes as it is.
        await bench.node.step("twin__stereo", sent, Header(2, 7, 8, "virtual", "twin", 1))
        again, _ = bench.sent[1]
        assert again.left_origin_px == sent.left_origin_px
        np.testing.assert_array_equal(again.left, sent.left)


async def test_nothing_is_published_while_the_region_is_wrong() -> None:
    scene = load_scene()
    region = {"left": [0, 0, 64, 48], "right": [0, 0, 640, 480]}
    async with running(scene, source="twin", region=region) as bench:
        pair = StereoPair(device="t", exposure_s=0.0, dropped_frames=0, left=RAMP, right=RAMP)
        header = Header(1, 5, 6, bench.node.clock.id, "twin", 1)
        await bench.node.step("twin__stereo", pair, header)
        assert bench.sent == []
        assert "region.right" in bench.node.last_error
