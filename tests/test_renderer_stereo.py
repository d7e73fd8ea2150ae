"""Test stereo images, tracked eyes, the lens of the projector, and predicted display times."""

from __future__ import annotations

from collections.abc import AsyncIterator

import cv2
import moderngl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.base import Header
from flexsheet.messages.scene import Lens, Pose
from flexsheet.messages.types import Correction, Display, Eye, Frame, SoftBody, StereoMode
from flexsheet.nodes.renderer.display_latency import DisplayLatencyEstimator
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.lens import clip_lens
from flexsheet.nodes.renderer.max_age import MaxAge
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet_mesh import flat_mesh, refine_mesh
from flexsheet.nodes.renderer.skin_extrapolator import SkinExtrapolator
from tests.note_text import note_text
from tests.test_renderer import MS, Bench, load_scene, skin_and_body

Image = NDArray[np.uint8]

FRONT_M = -0.06
"""Depth of the object's front below the imaginary screen; the eyes are 0.4 m above it."""


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    radius = 0.0353553
    pose = Pose(position_m=np.array([0.0, 0.0, FRONT_M - radius]), rpy_rad=np.zeros(3))
    deeper = bench.scene.object.model_copy(update={"world_from_object": pose})
    bench.scene = bench.scene.model_copy(update={"object": deeper})
    await bench.node.setup()
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    yield bench
    await bench.node.close()


async def frame_of(bench: Bench, mode: StereoMode, *, swap_eyes: bool = False) -> Frame:
    display = Display(
        correction="two_pass", stereo=mode, swap_eyes=swap_eyes, shading="flat", pixels_every=1
    )
    await bench.step("display", display)
    bench.forward(40)
    await bench.arms(np.eye(4))
    await bench.finger(0.0, 0.0, 0.2)
    return bench.sent[-1][0]


def middle_m(picture: NDArray[np.uint8], *, columns: float = 1.0) -> float:
    """Return the world x (m) of the centre of the bright part of the middle rows."""
    rows = picture.shape[0] // 2 + np.arange(-5, 5)
    bright = np.nonzero(picture[rows].astype(int).sum(axis=0) > 5 * 255)[0]
    return -((bright.min() + bright.max() + 1) / 2.0 * columns - 0.5 - 399.5) / 2000.0


def eyes_pictures(mode: StereoMode, frames: list[Frame]) -> tuple[float, float]:
    """Return the world x of the object's front in the left and the right eye's image."""
    picture = frames[0].pixels[0]
    height, width = picture.shape[:2]
    if mode == "side_by_side":
        left, right = picture[:, : width // 2, 0], picture[:, width // 2 :, 0]
        return middle_m(left, columns=2.0), middle_m(right, columns=2.0)
    if mode == "top_bottom":
        return middle_m(picture[: height // 2, :, 0]), middle_m(picture[height // 2 :, :, 0])
    if mode == "anaglyph":
        return middle_m(picture[..., 0]), middle_m(picture[..., 1])
    by_eye = {frame.eye: frame.pixels[0][..., 0] for frame in frames}
    return middle_m(by_eye["left"]), middle_m(by_eye["right"])


@pytest.mark.parametrize("mode", ["side_by_side", "top_bottom", "anaglyph", "frame_sequential"])
async def test_a_point_behind_the_screen_has_uncrossed_parallax(
    bench: Bench, mode: StereoMode
) -> None:
    """On the screen, the images of a point at depth d are b d / (d + e) apart."""
    wanted = 0.064 * -FRONT_M / (0.4 - FRONT_M)
    for swap_eyes, sign in ((False, 1.0), (True, -1.0)):
        frames = [await frame_of(bench, mode, swap_eyes=swap_eyes) for _ in range(2)]
        left, right = eyes_pictures(mode, frames)
        assert np.isclose(right - left, sign * wanted, atol=0.0006)
        assert np.allclose(frames[0].eyes_world_m, [[-0.032, 0, 0.4], [0.032, 0, 0.4]])


async def test_frame_sequential_names_the_eye_of_each_frame(bench: Bench) -> None:
    frames = [await frame_of(bench, "frame_sequential") for _ in range(4)]
    assert [frame.eye for frame in frames] in (
        ["left", "right", "left", "right"],
        ["right", "left", "right", "left"],
    )
    assert (await frame_of(bench, "mono")).eye == "both"


async def test_the_image_follows_a_tracked_eye_and_goes_back_when_it_is_stale(
    bench: Bench,
) -> None:
    assert np.isclose(middle_m((await frame_of(bench, "mono")).pixels[0][..., 0]), 0, atol=3e-4)
    eye = Eye(valid=True, centre_world_m=np.array([0.05, 0.0, 0.5]))
    bench.forward(20)
    await bench.step("eye", eye)
    frame = await frame_of(bench, "mono")
    wanted = 0.05 * -FRONT_M / (0.5 - FRONT_M)
    assert np.allclose(frame.eyes_world_m, [[0.05, 0, 0.5]] * 2)
    assert np.isclose(middle_m(frame.pixels[0][..., 0]), wanted, atol=0.0006)
    bench.forward(200)
    frame = await frame_of(bench, "mono")
    assert np.allclose(frame.eyes_world_m, [[0, 0, 0.4]] * 2)


async def test_tilted_heads_have_tilted_eyes(bench: Bench) -> None:
    eye = Eye(
        valid=True, centre_world_m=np.array([0.0, 0.0, 0.4]), right_world=np.array([0.0, 2.0, 0.0])
    )
    bench.forward(20)
    await bench.step("eye", eye)
    frame = await frame_of(bench, "side_by_side")
    assert np.allclose(frame.eyes_world_m, [[0, -0.032, 0.4], [0, 0.032, 0.4]])


@pytest.mark.parametrize(
    ("eye", "why"),
    [
        ({"valid": False, "centre_world_m": np.zeros(3)}, "not tracked"),
        ({"valid": True, "centre_world_m": np.array([0, 0, 0.04])}, "0.040 m from the screen"),
        ({"valid": True, "centre_world_m": np.array([0, 0, -1.0])}, "from the screen"),
        (
            {"valid": True, "centre_world_m": np.array([0, 0, 0.4]), "right_world": np.zeros(3)},
            "right_world is zero",
        ),
    ],
)
async def test_an_eye_that_cannot_be_is_not_followed(
    bench: Bench, eye: dict[str, object], why: str
) -> None:
    bench.forward(20)
    await bench.step("eye", Eye.model_validate(eye))
    frame = await frame_of(bench, "mono")
    assert np.allclose(frame.eyes_world_m, [[0, 0, 0.4]] * 2)
    assert why in note_text(bench.node)


LENS = Lens(
    fx_px=2000.0,
    fy_px=2000.0,
    cx_px=399.5,
    cy_px=799.5,
    distortion=(-0.12, 0.15, 0.002, -0.003, 0.0),
)


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.mark.parametrize("correction", ["none", "one_plane", "two_pass"])
def test_the_lens_distorts_the_image_like_opencv(
    context: moderngl.Context, correction: Correction
) -> None:
    scene = load_scene()
    bent_projector = scene.projector.model_copy(update={"lens": LENS})
    bent_scene = scene.model_copy(update={"projector": bent_projector})
    shown = Display(correction=correction, stereo="mono", shading="flat", pattern="grid")
    pictures = []
    for each in (scene, bent_scene):
        stage = SceneRenderer(each, context, spacing_m=0.004)
        look = DrawStyle(flat=False, pattern="grid")
        picture = stage.draw(shown, stage.sheet_at_rest(), look, read=True)
        assert picture is not None
        pictures.append(picture[..., 0])
    straight, bent = pictures
    matrix = np.array([[2000.0, 0, 399.5], [0, 2000.0, 799.5], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(800.0), np.arange(600.0)), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-9)
    ideal = cv2.undistortImagePoints(
        pixels, matrix, np.array(LENS.distortion), arg1=criteria
    ).reshape(600, 800, 2)
    x, y = (ideal[..., axis].astype(np.float32) for axis in (0, 1))
    wanted = cv2.remap(straight, x, y, cv2.INTER_LINEAR)
    # The lens moves lines by many pixels; both pictures of the grid then agree to blurred edges.
    off = np.abs(cv2.blur(wanted, (3, 3)).astype(int) - cv2.blur(bent, (3, 3)))[20:-20, 20:-20]
    unbent = np.abs(cv2.blur(straight, (3, 3)).astype(int) - cv2.blur(bent, (3, 3)))
    assert np.quantile(off, 0.995) < 60
    assert off.mean() < 0.2 * unbent.mean()


def test_a_lens_that_folds_the_image_is_rejected() -> None:
    assert clip_lens(load_scene().projector.lens, 800, 600) is None
    assert clip_lens(LENS, 800, 600) is not None
    folded = LENS.model_copy(update={"distortion": (-3.0, 0.0, 0.0, 0.0, 0.0)})
    expected = r"projector\.lens\.distortion.*maps several rays to one pixel"
    with pytest.raises(ValueError, match=expected):
        clip_lens(folded, 800, 600)


def test_a_finer_mesh_is_the_same_surface(context: moderngl.Context) -> None:
    stage = SceneRenderer(load_scene(), context, spacing_m=0.01)
    mesh = flat_mesh(stage.sheet_at_rest())
    fine = refine_mesh(mesh)

    def area(vertices: NDArray[np.float64], triangles: NDArray[np.int32]) -> float:
        a, b, c = vertices[triangles].transpose(1, 0, 2)
        return float(0.5 * np.cross(b - a, c - a)[:, 2].sum())

    assert len(fine.triangles) == 4**5 * len(mesh.triangles)
    assert np.isclose(area(fine.vertices, fine.triangles), area(mesh.vertices, mesh.triangles))


def test_light_is_foretold_from_how_long_drawing_took() -> None:
    lead = DisplayLatencyEstimator(first_s=0.016, display_latency_s=0.008)
    assert lead.predict_light_ns(1000 * MS) == 1016 * MS
    for number, draw_ms in enumerate((5, 5, 40, 5, 5)):
        begun = (1000 + 100 * number) * MS
        assert lead.record_drawn(begun, begun + draw_ms * MS) == begun + (draw_ms + 8) * MS
    assert lead.predict_light_ns(2000 * MS) == 2013 * MS  # the slow one is outvoted
    assert not lead.is_late(2020 * MS, 2013 * MS)
    assert lead.is_late(2022 * MS, 2013 * MS)


@given(st.floats(0.2e-3, 30e-3), st.floats(0.0, 1.0), st.sampled_from([1 / 60, 1 / 120, 1 / 48]))
def test_the_display_time_is_predicted_to_the_refresh(
    draw_s: float, phase: float, period_s: float
) -> None:
    """Simulate a projector whose buffer swaps are at multiples of its refresh period."""
    lead = DisplayLatencyEstimator(
        first_s=0.016, display_latency_s=0.5 * period_s, period_s=period_s
    )
    period, draw = round(period_s * 1e9), round(draw_s * 1e9)
    begun = round(phase * period)
    for _ in range(3):
        predicted = lead.predict_light_ns(begun)
        swapped = -(-(begun + draw) // period) * period
        light = lead.record_shown(begun, begun + draw, swapped)
        begun = swapped + round((0.3 + phase) * period)
    # Off by a whole refresh only where drawing ends within the margin before one.
    assert abs(predicted - light) < 1000 or 0 <= predicted - light - period < 1000


def answer(at_ms: int, displacement: float, **changes: object) -> tuple[SoftBody, Header]:
    body = skin_and_body(displacement)[1].model_copy(update=changes)
    return body, Header(1, at_ms * MS, at_ms * MS, "here", "fem_solver", 1)


def test_the_indentation_is_extrapolated_to_the_display_time() -> None:
    dent = SkinExtrapolator()
    assert dent.extrapolate(1000 * MS, "here") == (None, 0)
    for at_ms in (1000, 1016, 1033):
        dent.add(*answer(at_ms, 1e-6 * at_ms, prediction_horizon_s=0.005))
    body, at_ns = dent.extrapolate(1060 * MS, "here")
    assert body is not None
    assert at_ns == 1060 * MS
    assert np.allclose(body.displacement_world_m, 1.055e-3, atol=1e-8)  # of the exposure then
    body, at_ns = dent.extrapolate(2000 * MS, "here")  # no farther than 60 ms
    assert at_ns == 1098 * MS
    for at_ms, clock_id in ((1038, "here"), (1010, "here"), (1060, "elsewhere")):
        body, at_ns = dent.extrapolate(at_ms * MS, clock_id)
        assert at_ns == 1038 * MS
        assert body is not None
        assert np.allclose(body.displacement_world_m, 1.033e-3, atol=1e-8)


def test_an_indentation_of_a_slow_camera_is_extrapolated() -> None:
    dent = SkinExtrapolator()
    for at_ms in (1000, 1067, 1134):  # 15 Hz
        dent.add(*answer(at_ms, 1e-6 * at_ms))
    body, at_ns = dent.extrapolate(1180 * MS, "here")
    assert body is not None
    assert at_ns == 1180 * MS
    assert np.allclose(body.displacement_world_m, 1.18e-3, atol=1e-8)
    dent.add(*answer(1300, 1.3e-3))  # after a gap
    assert dent.extrapolate(1340 * MS, "here")[1] == 1300 * MS


@pytest.mark.parametrize(("rate_hz", "wanted_s"), [(60, 0.1), (15, 4 / 15), (2, 0.5)])
def test_messages_of_a_slow_camera_may_be_older(rate_hz: float, wanted_s: float) -> None:
    limit = MaxAge()
    assert limit.seconds == 0.1
    for number in (1, 2, 3, 6, 7, 11):  # as a busy renderer receives them
        at_ns = round(1e9 * number / rate_hz)
        limit.add(Header(number, at_ns, at_ns, "here", "triangulator", 1))
    assert limit.seconds == pytest.approx(wanted_s)
    limit.add(Header(1, 0, 0, "here", "triangulator", 2))  # a restarted node
    assert limit.seconds == pytest.approx(wanted_s)
    fixed = MaxAge(0.3)
    fixed.add(Header(1, 0, 0, "here", "triangulator", 1))
    fixed.add(Header(2, 1, 1, "here", "triangulator", 1))
    assert fixed.seconds == 0.3


def test_an_indentation_of_another_method_is_not_extrapolated() -> None:
    dent = SkinExtrapolator()
    dent.add(*answer(1000, 0.0))
    dent.add(*answer(1033, 1e-3, method="nonlinear_table"))
    body, at_ns = dent.extrapolate(1060 * MS, "here")
    assert body is not None
    assert (at_ns, float(body.displacement_world_m.max())) == (1033 * MS, np.float32(1e-3))
    dent.add(*answer(1020, 5e-4, method="nonlinear_table"))  # time went back: a replay
    assert dent.extrapolate(1060 * MS, "here")[1] == 1020 * MS
