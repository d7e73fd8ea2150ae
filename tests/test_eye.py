"""Test the reference of the image: rays, occlusion, sizes, and figures 11 and 13 of the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from benchmarks.image_correction import CorrectionBench
from flexsheet.messages.apparatus import NOMINAL_DISPLAY_LATENCY_S, nominal_apparatus
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Correction, Display, Frame, TwinArms, TwinEye
from flexsheet.nodes.arrays import Image
from flexsheet.nodes.models.rigid import rotation_from_vector, transform, transform_from_rpy
from flexsheet.nodes.models.shapes.triangles import intersect_rays
from flexsheet.nodes.models.sheet import edge_poses, flange_pose
from flexsheet.nodes.renderer.benchmarks import roll_sheet
from flexsheet.nodes.renderer.parameters import RendererParameters
from flexsheet.nodes.renderer.sheet import SheetPose
from flexsheet.nodes.twin import eye_node
from flexsheet.nodes.twin.eye import (
    METRES_PER_PX,
    NotMeasurableError,
    Rays,
    TrueProjector,
    first_hits,
    push_sizes,
    render_expected,
    seen,
    tilt_sizes,
)
from flexsheet.nodes.twin.eye_node import TwinEyeNode, TwinEyeParameters
from flexsheet.nodes.twin.membrane import DeformedSheet
from flexsheet.nodes.twin.true_object import TrueBody
from flexsheet.nodes.twin.truth import find_display_delay_s
from tests.node_harness import NodeHarness
from tests.scenes import load_cylinder

EYE = np.array([0.0, 0.0, 0.4])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return the scene with a sheet that stays plane at any tilt."""
    loaded = load_cylinder()
    sheet = loaded.sheet.model_copy(update={"density_kg_per_m3": 0.0})
    return loaded.model_copy(update={"sheet": sheet})


@pytest.fixture(scope="module")
def bench(scene: Scene) -> CorrectionBench:
    return CorrectionBench(scene, stretch=1.05)


def flat_sheet(world_from_sheet: np.ndarray, cells: int = 4) -> DeformedSheet:
    """Return a plane sheet of 240 mm, without mechanics."""
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, cells + 1), np.linspace(-0.12, 0.12, cells + 1))
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    positions = points @ world_from_sheet[:3, :3].T + world_from_sheet[:3, 3]
    return DeformedSheet(points[..., :2], positions, np.zeros(3), np.zeros(3), np.zeros(3), 0)


def fan(size: int = 41, reach: float = 0.1) -> Rays:
    pitch = 2 * reach / (size - 1)
    first = np.array([-reach, reach, 0.0]) - EYE
    return Rays(EYE, first, np.array([pitch, 0, 0]), np.array([0, -pitch, 0]), size, size)


def test_rays_hit_what_a_slow_intersection_hits() -> None:
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-0.12, 0.12, (30, 3)) * [1, 1, 0.5]
    triangles = rng.permutation(30).reshape(10, 3)
    rays = fan()
    hits = first_hits(rays, vertices, triangles)
    directions = rays.directions()
    for row in range(0, 41, 3):
        for column in range(0, 41, 3):
            best, first = np.inf, -1
            for index, corners in enumerate(vertices[triangles]):
                edges = np.column_stack(
                    [corners[1] - corners[0], corners[2] - corners[0], -directions[row, column]]
                )
                u, v, t = np.linalg.solve(edges, EYE - corners[0])
                if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < best:
                    best, first = t, index
            assert hits.triangle[row, column] == first
            if first >= 0:
                assert np.isclose(1.0 / hits.inverse_range[row, column], best)


def test_triangles_edge_on_or_behind_the_eye_are_not_hit() -> None:
    edge_on = np.array([[0.0, -0.1, -0.1], [0.0, 0.1, -0.1], [0.0, 0.0, 0.1]])
    behind = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.0, 0.1, 0.5]])
    across = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, -0.5], [0.0, 0.1, 0.1]])
    for corners in (edge_on, behind, across, np.zeros((3, 3))):
        assert (first_hits(fan(), corners, np.array([[0, 1, 2]])).triangle == -1).all()
    assert (first_hits(fan(), np.empty((0, 3)), np.empty((0, 3), int)).triangle == -1).all()


def test_projector_lands_and_is_found_again(scene: Scene) -> None:
    sheet = flat_sheet(transform(rotation_from_vector([0.5, 0.1, 0.0]), [0.0, 0.0, 0.01]))
    projector = TrueProjector(scene.projector, sheet.positions.reshape(-1, 3), sheet.triangles())
    pixels = np.random.default_rng(1).uniform([250, 200], [550, 400], (200, 2))
    points, lands = projector.intersect_surface(pixels)
    assert lands.all()
    again, lit = projector.pixels_of(points)
    assert lit.all()
    assert np.allclose(again, pixels, atol=1e-6)
    outside, lands = projector.intersect_surface(
        np.array([[-5.0, 10.0], [900.0, 10.0], [2.0, 2.0]])
    )
    assert not lands.any()
    assert np.isfinite(outside).all()


def test_part_of_the_sheet_behind_another_gets_no_light(scene: Scene) -> None:
    low = flat_sheet(np.eye(4))
    vertices = np.concatenate([low.positions.reshape(-1, 3), [[-0.02, -0.1, -0.1]]])
    vertices = np.concatenate([vertices, [[0.02, -0.1, -0.1], [0.0, 0.0, -0.1]]])
    count = len(vertices)
    triangles = np.concatenate([low.triangles(), [[count - 3, count - 2, count - 1]]])
    projector = TrueProjector(scene.projector, vertices, triangles)
    shadowed = vertices[-3:].mean(axis=0)
    light = shadowed - np.array([0.0, -0.25, -1.0])
    behind = shadowed + light * (-shadowed[2] / light[2])
    _, lit = projector.pixels_of(behind + np.array([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]]))
    assert lit.tolist() == [False, True]


def test_flat_sheet_on_the_imaginary_screen_shows_the_image_mirrored_back(
    scene: Scene,
) -> None:
    projected = np.zeros((600, 800, 3), np.uint8)
    projected[300 - 61 : 300, 400 - 41 : 400] = (
        255,
        100,
        0,
    )  # 2 px a millimetre about (399.5, 299.5)
    picture = seen(projected, flat_sheet(np.eye(4)), scene, eye=EYE, metres_per_px=0.0005)
    rows, columns = np.nonzero(picture[..., 0] > 127)
    # 20 mm to the right of the centre and 30 mm up, in a picture of 480 half millimetres.
    assert abs(columns.min() - 240) <= 1
    assert abs(columns.max() - 280) <= 1
    assert abs(rows.max() - 239) <= 1
    assert abs(rows.min() - 179) <= 1
    assert np.abs(picture[210, 260].astype(int) - [255, 100, 0]).max() <= 1
    assert picture[:, :20].max() == 0


def test_expected_image_has_the_cylinders_own_size(scene: Scene) -> None:
    picture = render_expected(TrueBody(scene).at_rest(), eye=EYE, flat=True)
    radius, length = scene.object.geometry.radius_m, scene.object.geometry.length_m
    height, width = push_sizes(picture, METRES_PER_PX)
    assert np.isclose(height, 0.8 * np.tan(np.arcsin(radius / (0.4 + radius))), atol=3e-5)
    assert np.isclose(width, length, atol=6e-5)
    soft = render_expected(TrueBody(scene).at_rest(), eye=EYE, flat=False)
    assert len(np.unique(soft[..., 0])) > 20
    assert ((soft.max(axis=2) > 0) == (picture[..., 0] > 0)).mean() > 0.998


def blob(height: float, upper: float, lower: float, size: int = 300) -> np.ndarray:
    """Draw a trapezoid about the centre (sizes in pixels), antialiased by 16 x 16 samples."""
    axis = (np.arange(size * 16) + 0.5) / 16 - size / 2
    y = axis[:, None] / height + 0.5
    half = 0.5 * (upper + (lower - upper) * y)
    inside = (y >= 0) & (y <= 1) & (np.abs(axis[None, :]) <= half)
    mean = inside.reshape(size, 16, size, 16).mean(axis=(1, 3))
    return np.repeat(np.rint(255 * mean).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(("height", "upper", "lower"), [(80.0, 120.0, 120.0), (83.4, 101.3, 141.7)])
def test_sizes_are_measured_below_a_tenth_of_a_pixel(
    height: float, upper: float, lower: float
) -> None:
    sizes = np.array(tilt_sizes(blob(height, upper, lower), 1.0))
    inset = 0.05 * (lower - upper)
    assert np.allclose(sizes, [height, upper + inset, lower - inset], atol=0.06)
    assert np.allclose(
        push_sizes(blob(height, upper, lower), 1.0), [height, 0.5 * (upper + lower)], atol=0.06
    )


def test_a_second_small_blob_does_not_count() -> None:
    picture = blob(80.0, 120.0, 120.0)
    picture[10:30, 10:30] = 255
    assert np.allclose(tilt_sizes(picture, 1.0), [80.0, 120.0, 120.0], atol=0.06)


@pytest.mark.parametrize("what", ["black", "specks", "cut off", "split"])
def test_what_cannot_be_measured_is_reported(what: str) -> None:
    picture = blob(80.0, 120.0, 120.0)
    if what == "black":
        picture[:] = 0
    elif what == "specks":
        picture[:] = 0
        picture[::10, ::10] = 255
    elif what == "cut off":
        picture = picture[:, 120:]
    else:
        picture[::3] = 0
    with pytest.raises(NotMeasurableError):
        tilt_sizes(picture, 1.0)


pytestmark = pytest.mark.timeout(900)
"""Without a cache, the deflection shapes are computed first, with the lowest priority."""

EyeSituation = tuple[SheetPose, DeformedSheet]
Sizes = Callable[[Image, float], Sequence[float]]


def mean_mm(
    bench: CorrectionBench, correction: Correction, situation: EyeSituation, sizes: Sizes
) -> float:
    return float(1e3 * bench.size_errors(correction, *situation, sizes).mean())


def test_row_of_figure_11(bench: CorrectionBench) -> None:
    """At 50 degrees the uncorrected error is some tens of mm, as in the paper; corrected, a
    tenth."""
    rolled = bench.situation(roll_sheet(bench.scene, np.radians(50.0)), None)
    assert 27.0 < mean_mm(bench, "none", rolled, tilt_sizes) < 34.0
    assert 1e3 * bench.size_errors("one_plane", *rolled, tilt_sizes).max() < 0.15
    turn = transform(rotation_from_vector([np.radians(50.0), 0.0, 0.0]), np.zeros(3))
    assert 20.0 < mean_mm(bench, "none", bench.situation(turn, None), tilt_sizes) < 28.0


@pytest.mark.long
def test_row_of_figure_13(bench: CorrectionBench) -> None:
    """Pushed by 50 mm, four triangles reduce the paper's ten mm and more to a few millimetres."""
    pushed = bench.situation(*bench.pushed(0.05))
    corrections: tuple[Correction, ...] = ("none", "one_plane", "four_triangles", "two_pass")
    errors = {each: mean_mm(bench, each, pushed, push_sizes) for each in corrections}
    assert errors["none"] > 8.0
    assert np.isclose(errors["one_plane"], errors["none"], atol=0.2)  # the plane has not moved
    assert errors["four_triangles"] < 6.0
    assert errors["two_pass"] < 0.2


class EyeBench(NodeHarness[TwinEyeNode, VirtualClock]):
    def __init__(self, scene: Scene) -> None:
        given = TwinEyeParameters(metres_per_px=0.002)
        super().__init__(TwinEyeNode, given, VirtualClock(10**10), name="twin_eye")
        self.scene = scene

    @property
    def sent(self) -> list[tuple[TwinEye, Header]]:
        return self.messages(TwinEye)

    async def step(
        self, port: str, message: Message, *, age_ms: float = 0.0, sequence: int = 1
    ) -> None:
        """Pass a message with a fixed stamp; the test checks the node's errors."""
        header = Header(1, 123, 124, "virtual", "test", 1)
        await self.node.step(port, message, header)

    async def ready(self) -> None:
        await self.node.setup()
        await self.step("scene", self.scene)
        flanges = []
        for side, edge in zip(("left", "right"), edge_poses(np.eye(4), 0.25), strict=True):
            pose = getattr(self.scene.arms, side).flange_from_edge
            flanges.append(flange_pose(edge, transform_from_rpy(pose.position_m, pose.rpy_rad)))
        self.arms = TwinArms(
            joints_left_rad=np.zeros(6),
            joints_right_rad=np.zeros(6),
            world_from_flange_left=flanges[0],
            world_from_flange_right=flanges[1],
        )
        await self.step("twin__arms", self.arms)

    async def show(self, *frames: Frame) -> None:
        """Pass frames, each followed by the true arms at the time of its display."""
        for each in frames:
            await self.step("frame", each)
            await self.step("twin__arms", self.arms)

    async def finish(self) -> None:
        if self.node._task is not None:
            await self.node._task


def frame(label: str, **changes: object) -> Frame:
    values: dict[str, object] = {
        "number": 1,
        "correction": "none",
        "stereo": "mono",
        "label": label,
        "eyes_world_m": np.tile(EYE, (2, 1)),
        "world_from_sheet": np.eye(4),
        "pushed_point_world_m": np.zeros(3),
        "predicted_to_ns": 0,
        "draw_s": 0.0,
        "late_frames": 0,
        "pixels": (np.full((600, 800, 3), 200, np.uint8),),
    }
    return Frame.model_validate({**values, **changes})


async def test_eye_node_renders_each_label_once(scene: Scene) -> None:
    bench = EyeBench(scene)
    await bench.ready()
    display = Display(correction="none", stereo="mono", shading="flat", label="a")
    await bench.step("display", display)
    await bench.show(*(frame(label) for label in ("a", "a", "b", "", "a")))
    await bench.show(frame("a", correction="one_plane"))
    await bench.show(frame("c", pixels=()), frame("d", stereo="anaglyph"))
    assert [one.code for one in bench.node.notes] == [NoteCode.FRAME_NOT_RENDERED]
    await bench.finish()
    assert [(eye.label, eye.correction) for eye, _ in bench.sent] == [
        ("a", "none"),
        ("b", "none"),
        ("a", "one_plane"),
    ]
    picture, header = bench.sent[0]
    assert header.source_ns == 123
    assert picture.seen.shape == (120, 120, 3)
    assert picture.seen[60, 60].tolist() == [200, 200, 200]
    assert picture.expected[60, 60].tolist() == [255, 255, 255]
    # The label just taken is passed over, but not for ever.
    await bench.show(frame("a", correction="one_plane"))
    await bench.finish()
    assert len(bench.sent) == 3
    bench.clock.move_to(bench.clock.now_ns() + 6 * 10**9)
    await bench.show(frame("a", correction="one_plane"))
    await bench.finish()
    assert len(bench.sent) == 4
    assert bench.node.errors == 0
    await bench.node.close()


async def test_eye_node_reports_a_missing_image_and_continues(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eye_node, "MAX_QUEUE", 2)
    bench = EyeBench(scene)
    await bench.ready()
    real = bench.node._camera.take

    def fails_once(projected: object, situation: object, **rest: object) -> object:
        monkeypatch.setattr(bench.node._camera, "take", real)
        raise ValueError("folded beyond seeing")

    monkeypatch.setattr(bench.node._camera, "take", fails_once)
    await bench.show(*(frame(label) for label in ("a", "b", "c", "c")))
    assert "2 frames are waiting" in bench.node.last_error
    assert bench.node.errors == 1
    await bench.finish()
    assert bench.node.errors == 2
    assert "folded beyond seeing" in bench.node.last_error
    assert [eye.label for eye, _ in bench.sent] == ["b"]
    await bench.node.close()


async def test_eye_node_uses_the_sheet_at_the_display_time(scene: Scene) -> None:
    bench = EyeBench(scene)
    await bench.ready()
    # Arms' stamps are 123 in this bench: before this frame's light nothing is pictured.
    await bench.show(frame("early", predicted_to_ns=124))
    await bench.finish()
    assert bench.sent == []
    await bench.node.step("twin__arms", bench.arms, Header(2, 124, 124, "virtual", "test", 1))
    await bench.finish()
    assert [eye.label for eye, _ in bench.sent] == ["early"]
    await bench.node.close()


async def test_eye_node_waits_for_the_scene(scene: Scene) -> None:
    bench = EyeBench(scene)
    await bench.node.setup()
    await bench.step("frame", frame("a"))
    assert [one.code for one in bench.node.notes] == [NoteCode.WAITING_FOR_SCENE]
    await bench.node.close()
    assert bench.sent == []


def test_rays_hit_the_nearest_point_of_their_triangle_or_nothing() -> None:
    square = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    rays = np.array([[0.2, 0.3, -1.0], [0.7, 0.8, -1.0], [3.0, 0.0, -1.0]])
    triangles, weights = intersect_rays(np.array([0.0, 0.0, 1.0]), rays, square)
    points = np.einsum("nk,nki->ni", weights, square[triangles])
    np.testing.assert_allclose(points[:2], [[0.2, 0.3, 0.0], [0.7, 0.8, 0.0]], atol=1e-12)
    assert np.isnan(points[2]).all()


@pytest.mark.parametrize(("assumed_s", "late_s"), [(0.008, 0.02), (0.028, 0.0), (0.03, -0.002)])
def test_the_true_display_time_does_not_depend_on_the_assumed_latency(
    assumed_s: float, late_s: float
) -> None:
    apparatus = nominal_apparatus(load_cylinder())
    projector = apparatus.projector.model_copy(update={"latency_offset_s": 0.02})
    apparatus = apparatus.model_copy(update={"projector": projector})
    frame = Frame.model_construct(
        drawn_ns=1_000, swapped_ns=0, light_ns=1_000 + round(1e9 * assumed_s)
    )
    assert find_display_delay_s(frame, apparatus) == pytest.approx(late_s)
    assert find_display_delay_s(frame, None) == 0.0
    assert RendererParameters().display_latency_s == NOMINAL_DISPLAY_LATENCY_S
