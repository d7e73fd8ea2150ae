"""Test the renderer: shader equations, images, stereo packing, and timing of the node."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import moderngl
import numpy as np
import pytest

from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    Correction,
    Display,
    Frame,
    SheetTarget,
    Skin,
    SoftBody,
    StereoMode,
)
from flexsheet.nodes.models.rigid import pose_matrix, rotation_from_vector, transform
from flexsheet.nodes.models.sheet import edge_poses, flange_pose
from flexsheet.nodes.renderer import gl
from flexsheet.nodes.renderer.correction import (
    ScreenPlane,
    make_flat_screen,
    make_pushed_screen,
)
from flexsheet.nodes.renderer.frame_renderer import FrameRenderer
from flexsheet.nodes.renderer.gl import Canvas, DrawStyle, EyeView, NoOpenGLError, headless_context
from flexsheet.nodes.renderer.node import READ_TIME_NS, Renderer, RendererParameters
from flexsheet.nodes.renderer.object_surface import (
    ObjectSurface,
    VertexNormals,
    cylinder_surface,
    transfer_matrix,
)
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import estimate_sheet
from tests.arm_states import arm_state
from tests.correction_reference import correct
from tests.fingertips import fingertip
from tests.node_harness import NodeHarness
from tests.note_text import note_text
from tests.packing import pack
from tests.scenes import load_cylinder

MS = 1_000_000


def load_scene() -> Scene:
    return load_cylinder()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene()


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.fixture(scope="module")
def stage(scene: Scene, context: moderngl.Context) -> SceneRenderer:
    return SceneRenderer(scene, context, spacing_m=0.004)


def random_screens(scene: Scene) -> list[object]:
    rng = np.random.default_rng(5)
    corners = np.array([[-0.12, -0.12, 0], [0.12, -0.12, 0], [0.12, 0.12, 0], [-0.12, 0.12, 0]])
    screens: list[object] = [None]
    for _ in range(4):
        normal = rotation_from_vector(rng.uniform(-1.2, 1.2, 3) * [1, 1, 0])[:, 2]
        plane = ScreenPlane(rng.uniform(-0.03, 0.03, 3), normal)
        screens += [
            make_flat_screen(plane),
            make_pushed_screen(rng.uniform(-0.05, 0, 3), corners, plane),
        ]
    return screens


def test_shader_moves_points_as_the_numpy_equations(scene: Scene, stage: SceneRenderer) -> None:
    rest = stage._surface.rest_world_m
    projector = scene.projector.world_from_projector.position_m
    for screen in random_screens(scene):
        for eye in stage.eyes(Display(correction="none", stereo="side_by_side")):
            view = EyeView(eye, projector, screen, stage._clip_from_screen)
            shifted = stage.canvas.shifted_points(view)
            if screen is None:
                assert np.allclose(shifted[:, :3], rest, atol=1e-7)
                continue
            wanted = correct(rest, eye=eye, projector=projector, screen=screen)
            same = (shifted[:, 3] > 0.5) == wanted.valid
            # Points within rounding of a sector's or the grazing limit may fall to either side.
            assert same.mean() > 0.999
            close = np.abs(shifted[:, :3] - wanted.points).max(axis=1) < 1e-6
            assert close[same].mean() > 0.999


def test_uncorrected_silhouette_agrees_with_the_projector_model(
    scene: Scene, stage: SceneRenderer
) -> None:
    stage.deform(None)
    sheet = stage.sheet_at_rest()
    shown = Display(correction="none", stereo="mono", shading="flat")
    picture = stage.draw(shown, sheet, DrawStyle(flat=True, pattern="object"), read=True)
    assert picture is not None
    rows, columns = np.nonzero(picture[..., 0] > 127)
    # Front of the cylinder, 60 mm to both sides, 2 px a millimetre around (399.5, 299.5).
    assert abs(columns.min() - 279.5) <= 1
    assert abs(columns.max() - 519.5) <= 1
    radius = scene.object.geometry.radius_m
    half_angle = np.arcsin(radius / (0.4 + radius))
    half = 2000.0 * 0.4 * np.tan(half_angle)
    assert abs(rows.min() - (299.5 - half)) <= 1
    assert abs(rows.max() - (299.5 + half)) <= 1


def test_nearest_surface_hides_what_is_behind(
    context: moderngl.Context, stage: SceneRenderer
) -> None:
    """Draw two overlapping squares in both orders. The nearer square must hide the other one."""
    square = np.array([[-0.05, -0.05, 0.0], [0.05, -0.05, 0], [0.05, 0.05, 0], [-0.05, 0.05, 0]])
    far = square + np.array([0.0, 0.0, -0.05])
    near = 0.4 * square + np.array([0.0, 0.0, 0.02])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    view = EyeView(
        np.array([0.0, 0.0, 0.4]), np.array([0, -0.25, -1.0]), None, np.diag([10.0, 10.0, 1.0])
    )
    lit, dark = np.tile(gl.LIGHT, (4, 1)), np.tile(-gl.LIGHT, (4, 1))
    for order in (1, -1):
        positions = np.concatenate([far, near][::order])
        surface = ObjectSurface(
            positions,
            np.concatenate([dark, lit][::order]),
            np.concatenate([triangles, triangles + 4]).astype(np.int32),
        )
        canvas = Canvas(context, (80, 60), surface, stage._material())
        canvas.begin(multisampled=True)
        canvas.draw_into(canvas.target, view, DrawStyle(flat=False, pattern="object"))
        canvas.resolve()
        picture = canvas.read()
        assert picture[30, 40, 0] > 200
        assert 30 < picture[30, 50, 0] < 100


def test_black_and_grid_patterns(stage: SceneRenderer) -> None:
    sheet = stage.sheet_at_rest()
    shown = Display(correction="one_plane", stereo="mono")
    black = stage.draw(shown, sheet, DrawStyle(flat=False, pattern="black"), read=True)
    grid = stage.draw(shown, sheet, DrawStyle(flat=False, pattern="grid"), read=True)
    assert black is not None
    assert grid is not None
    assert black.max() == 0
    # Lines through the centre and 20 mm beside it; black between.
    assert grid[289, 399, 0] > 200
    assert grid[289, 439, 0] > 200
    assert grid[279, 419, 0] == 0


def test_marks_are_drawn_on_the_object(stage: SceneRenderer) -> None:
    stage.deform(None)
    shown = Display(correction="none", stereo="mono")
    look = DrawStyle(False, "object", np.zeros(3), np.array([0.02, 0.0, 0.0]))
    picture = stage.draw(shown, stage.sheet_at_rest(), look, read=True)
    assert picture is not None
    assert picture[299, 399, 0] > 2 * picture[299, 399, 2]
    ring = picture[290:310, 350:370]
    assert (ring[..., 2] > ring[..., 0].astype(int) + 80).any()


def test_second_eye_sees_the_front_shifted_the_other_direction(stage: SceneRenderer) -> None:
    """The right eye sees an object behind the screen further to the right."""
    stage.deform(None)
    shown = Display(correction="none", stereo="side_by_side", shading="flat")
    picture = stage.draw(shown, stage.sheet_at_rest(), DrawStyle(True, "object"), read=True)
    assert picture is not None
    assert picture.shape == (600, 800, 3)
    left, right = picture[:, :400, 0], picture[:, 400:, 0]
    assert left.any()
    assert np.abs(left.astype(int) - right[:, ::-1]).mean() < 1.0
    top = np.nonzero(left[:, 200] > 127)[0][0] + 2
    assert np.nonzero(left[top])[0].mean() > np.nonzero(right[top])[0].mean()


def test_missing_egl_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**settings: object) -> None:
        raise RuntimeError("libEGL.so not found")

    monkeypatch.setattr(gl.moderngl, "create_context", fail)
    with pytest.raises(NoOpenGLError, match="libegl1 libgl1-mesa-dri"):
        headless_context()


@pytest.mark.parametrize(("cores", "given", "threads"), [(2, "", "0"), (8, "", "4"), (8, "3", "3")])
def test_a_software_driver_leaves_cores_to_other_nodes(
    monkeypatch: pytest.MonkeyPatch, cores: int, given: str, threads: str
) -> None:
    monkeypatch.setenv("LP_NUM_THREADS", given)
    if not given:
        monkeypatch.delenv("LP_NUM_THREADS")
    monkeypatch.setattr(gl.os, "sched_getaffinity", lambda process: set(range(cores)))
    gl.limit_driver_threads()
    assert gl.os.environ["LP_NUM_THREADS"] == threads


@pytest.mark.parametrize("swap_eyes", [False, True])
@pytest.mark.parametrize("correction", ["one_plane", "two_pass"])
def test_both_eyes_share_an_image(
    stage: SceneRenderer, correction: Correction, swap_eyes: bool
) -> None:
    """Compare each stereo mode with the packed images of single eyes, except near outlines."""
    stage.deform(None)
    sheet, look = stage.sheet_at_rest(), DrawStyle(False, "object")
    shown = Display(correction=correction, stereo="mono")
    pair = stage.eyes(Display(correction=correction, stereo="side_by_side"))
    single = [stage.draw(shown, sheet, look, read=True, eyes=eye[None]) for eye in pair]
    left, right = (image for image in single if image is not None)
    modes: tuple[StereoMode, ...] = ("side_by_side", "top_bottom", "anaglyph", "frame_sequential")
    for mode in modes:
        display = Display(correction=correction, stereo=mode, swap_eyes=swap_eyes)
        image = stage.draw(display, sheet, look, read=True)
        assert image is not None
        wanted = pack(left, right, mode, swap_eyes=swap_eyes).astype(int)
        off = np.abs(wanted - image).max(axis=2)[wanted.max(axis=2) > 0]
        assert np.median(off) <= 1, mode
        assert (off > 40).mean() < 0.02, mode
        other = pack(left, right, mode, swap_eyes=not swap_eyes).astype(int)
        assert np.abs(other - image).mean() > 4.0 * np.abs(wanted - image).mean()


def test_surface_is_closed_round_and_outward() -> None:
    surface = cylinder_surface(
        radius_m=0.03, length_m=0.1, world_from_object=np.eye(4), spacing_m=0.005
    )
    corners = surface.rest_world_m[surface.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = np.sum(corners[:, 0] * cross) / 6.0
    assert np.isclose(volume, np.pi * 0.03**2 * 0.1, rtol=1e-3)
    assert (np.sum(cross * corners.mean(axis=1), axis=1) > 0).all()
    normals = VertexNormals(surface.triangles, len(surface.rest_world_m))(surface.rest_world_m)
    assert np.allclose(normals, surface.normals_world, atol=0.02)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_surface_follows_a_linear_displacement_of_a_coarse_skin() -> None:
    fine = cylinder_surface(
        radius_m=0.03, length_m=0.1, world_from_object=np.eye(4), spacing_m=0.002
    )
    coarse = cylinder_surface(
        radius_m=0.03, length_m=0.1, world_from_object=np.eye(4), spacing_m=0.005
    )
    follow = transfer_matrix(fine.rest_world_m, coarse.rest_world_m, coarse.triangles)
    gradient = np.random.default_rng(6).normal(size=(3, 3))
    moved = follow @ (coarse.rest_world_m @ gradient)
    assert np.allclose(moved, fine.rest_world_m @ gradient, atol=2e-4 * np.abs(gradient).sum())
    with pytest.raises(ValueError, match="all triangles have zero area"):
        transfer_matrix(fine.rest_world_m, coarse.rest_world_m, coarse.triangles[:0])
    lost = (
        coarse.rest_world_m * np.where(np.arange(len(coarse.rest_world_m)) == 7, np.nan, 1)[:, None]
    )
    with pytest.raises(ValueError, match="not finite"):
        transfer_matrix(fine.rest_world_m, lost, coarse.triangles)
    # Triangles without area are passed over.
    flat = np.concatenate([coarse.triangles, [[3, 3, 4], [5, 5, 5]]]).astype(np.int32)
    again = transfer_matrix(fine.rest_world_m, coarse.rest_world_m, flat)
    assert abs(again - follow).max() < 1e-6


def test_a_skin_finer_in_front_is_followed_by_its_nearest_triangles() -> None:
    """A large triangle beside many small ones is nearest, although its centre is far away."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    small = np.concatenate([[-0.02, -0.01, 0.0] + 0.02 * (corners - [k, 0, 0]) for k in range(40)])
    vertices = np.concatenate([corners, small])
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    point = np.array([[0.01, 0.3, 0.0], [0.001, 0.01, 0.0]])
    assert np.allclose(transfer_matrix(point, vertices, triangles) @ vertices, point, atol=1e-6)


def test_sheet_between_edges_moves_with_its_twist() -> None:
    pose = transform(rotation_from_vector([0.3, 0.0, 0.0]), [0.0, 0.01, 0.02])
    left, right = edge_poses(pose, 0.25)
    twist = np.array([0.0, 0.1, 0.0, 1.0, 0.0, 0.0])
    still = estimate_sheet(
        left, right, height_m=0.24, twist_world=twist, ahead_s=0.0, finger_tip=None
    )
    assert still is not None
    assert np.allclose(still.world_from_sheet, pose)
    later = estimate_sheet(
        left, right, height_m=0.24, twist_world=twist, ahead_s=0.02, finger_tip=pose[:3, 3]
    )
    assert later is not None
    assert np.allclose(later.world_from_sheet[:3, 3], [0.0, 0.012, 0.02])
    assert np.allclose(later.world_from_sheet[:3, :3], rotation_from_vector([0.32, 0, 0]))
    assert np.allclose(
        np.linalg.norm(later.corners - later.plane.point, axis=1), 0.17328, atol=1e-4
    )
    assert (
        estimate_sheet(left, left, height_m=0.24, twist_world=twist, ahead_s=0.0, finger_tip=None)
        is None
    )


@pytest.mark.parametrize(
    ("tip", "pushed"),
    [
        ((0.0, 0.0, -0.01), True),
        ((0.0, 0.0, 0.01), False),
        ((0.0, 0.2, -0.01), False),
        ((0.2, 0, -0.01), False),
    ],
)
def test_finger_pushes_only_below_and_over_the_sheet(
    tip: tuple[float, float, float], pushed: bool
) -> None:
    left, right = edge_poses(np.eye(4), 0.25)
    sheet = estimate_sheet(
        left,
        right,
        height_m=0.24,
        finger_tip=np.array(tip),
    )
    assert sheet is not None
    assert (sheet.pushed_point is not None) is pushed


class Bench(NodeHarness[Renderer, VirtualClock]):
    """A renderer node with the paper's scene."""

    def __init__(self, **parameters: object) -> None:
        given = RendererParameters(spacing_m=0.006, **parameters)
        super().__init__(Renderer, given, VirtualClock(10_000 * MS), name="renderer")
        self.scene = load_scene()

    @property
    def sent(self) -> list[tuple[Frame, Header]]:
        return self.messages(Frame)

    def forward(self, milliseconds: float) -> None:
        self.clock.move_to(self.clock.now_ns() + int(milliseconds * MS))

    async def arms(self, world_from_sheet: np.ndarray, *, age_ms: float = 0.0) -> None:
        edges = edge_poses(world_from_sheet, 0.25)
        for side, edge in zip(("left", "right"), edges, strict=True):
            spec = getattr(self.scene.arms, side)
            flange = flange_pose(edge, pose_matrix(spec.flange_from_edge))
            state = arm_state(side, world_from_flange=flange, world_from_flange_commanded=flange)
            await self.step(f"arm_{side}", state, age_ms=age_ms)

    async def finger(self, *tip: float, age_ms: float = 4.0, valid: bool = True) -> None:
        message = fingertip(np.array(tip), reason="ok" if valid else "no_marker")
        await self.step("fingertip", message, age_ms=age_ms)


def skin_and_body(displacement: float) -> tuple[Skin, SoftBody]:
    surface = cylinder_surface(
        radius_m=0.0353553,
        length_m=0.12,
        world_from_object=transform(np.eye(3), [0, 0, -0.0353553]),
        spacing_m=0.01,
    )
    skin = Skin(
        mesh_id="m",
        vertices_world_m=surface.rest_world_m.astype(np.float32),
        triangles=surface.triangles,
    )
    body = SoftBody(
        mesh_id="m",
        method="linear",
        in_range=True,
        push_depth_m=0.0,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=0.0,
        displacement_world_m=np.full((len(surface.rest_world_m), 3), displacement, np.float32),
    )
    return skin, body


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    await bench.node.setup()
    yield bench
    await bench.node.close()


async def test_nothing_is_drawn_before_the_scene(bench: Bench) -> None:
    await bench.finger(0.0, 0.0, 0.1)
    assert bench.sent == []


async def test_frame_follows_the_soft_body_and_carries_its_exposure(bench: Bench) -> None:
    skin, body = skin_and_body(0.0)
    await bench.step("scene", bench.scene)
    await bench.step("skin", skin)
    pose = transform(rotation_from_vector([0.3, 0.0, 0.0]), [0.0, -0.01, 0.0])
    await bench.arms(pose)
    await bench.step("soft_body", body, age_ms=7.0)
    assert len(bench.sent) == 1
    frame, header = bench.sent[0]
    assert header.source_ns == bench.clock.now_ns() - 7 * MS
    assert np.allclose(frame.world_from_sheet, pose, atol=1e-9)
    assert frame.pixels == ()
    assert frame.predicted_to_ns == bench.clock.now_ns() + 16 * MS
    # A fingertip alone does not draw while the solver answers.
    bench.forward(40)
    await bench.step("soft_body", skin_and_body(0.0005)[1])
    await bench.finger(0.0, 0.0, 0.1)
    assert len(bench.sent) == 2


async def test_a_frame_contains_the_unlit_fraction_of_the_sheet(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Draw on a folded sheet."""
    monkeypatch.setattr(
        "flexsheet.nodes.renderer.scene_renderer.occluded_fraction",
        lambda mesh, eye, projector: 0.25,
    )
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    await bench.finger(0.0, 0.0, 0.1)
    assert bench.sent[0][0].occluded_fraction == 0.25


async def test_without_solver_the_fingertip_draws_and_the_rate_is_limited(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    for _ in range(60):  # one second of a 60 Hz camera, at most 30 frames a second
        bench.forward(1000 / 60)
        await bench.finger(0.0, 0.0, 0.1)
    assert 29 <= len(bench.sent) <= 31


async def test_after_a_slow_frame_the_next_one_begins_once_messages_are_read(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawing takes 60 ms, which is longer than the period of 33 ms."""
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    draw = FrameRenderer.render

    def draw_slowly(self: FrameRenderer, *given: Any, **options: Any) -> Any:
        bench.forward(60)
        return draw(self, *given, **options)

    monkeypatch.setattr(FrameRenderer, "render", draw_slowly)
    await bench.finger(0.0, 0.0, 0.1)
    bench.forward(1e-6 * READ_TIME_NS - 0.5)
    await bench.finger(0.0, 0.0, 0.1)
    assert len(bench.sent) == 1
    bench.forward(1)
    await bench.finger(0.0, 0.0, 0.1)
    assert len(bench.sent) == 2


async def test_timer_keeps_the_image_alive_only_when_idle(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    await bench.finger(0.0, 0.0, 0.1)
    bench.forward(34)
    bench.node.refresh()
    assert len(bench.sent) == 1
    bench.forward(50)
    bench.node.refresh()
    assert len(bench.sent) == 2


async def test_while_nothing_moves_few_frames_are_drawn(bench: Bench) -> None:
    """A finger or a motion of the sheet causes the next frame immediately."""
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    _, body = skin_and_body(0.0)
    for _ in range(180):  # three seconds, nobody there
        bench.forward(1000 / 60)
        await bench.step("soft_body", body)
    assert 3 <= len(bench.sent) <= 4
    begun = len(bench.sent)
    while len(bench.sent) == begun:
        bench.forward(10)
        await bench.step("soft_body", body)
    bench.forward(1000 / 30)
    await bench.arms(transform(np.eye(3), [0.0, 0.0, 2e-5]))
    await bench.step("soft_body", body)
    assert len(bench.sent) == begun + 1, "servos ripple"
    await bench.arms(transform(np.eye(3), [0.0, 0.0, 3e-4]))
    await bench.step("soft_body", body)
    assert len(bench.sent) == begun + 2
    bench.forward(1000 / 30)
    await bench.step("soft_body", body)
    assert len(bench.sent) == begun + 2
    await bench.finger(0.0, 0.0, 0.1)
    await bench.step("soft_body", body)
    assert len(bench.sent) == begun + 3


async def test_stale_arms_keep_the_last_plane_and_are_reported(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    pose = transform(rotation_from_vector([0.5, 0.0, 0.0]), [0.0, 0.0, 0.0])
    await bench.arms(pose)
    await bench.finger(0.0, 0.0, 0.1)
    assert NoteCode.SHEET_POSE_OLD not in [one.code for one in bench.node.notes]
    bench.forward(500)
    await bench.finger(0.0, 0.0, 0.1)
    assert np.allclose(bench.sent[-1][0].world_from_sheet, pose, atol=1e-9)
    assert "sheet-pose-old: the arm poses are 0.50 s old" in note_text(bench.node)


async def test_with_a_slow_camera_older_poses_are_used(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    for number in range(10):
        bench.forward(1000 / 15)
        await bench.arms(np.eye(4))
        tip = fingertip(np.array([0.0, 0.0, 0.1]))
        await bench.step("fingertip", tip, age_ms=4.0, sequence=number)
    bench.forward(200)
    await bench.finger(0.0, 0.0, 0.1)
    assert NoteCode.SHEET_POSE_OLD not in [one.code for one in bench.node.notes]


async def test_sheet_turned_away_holds_the_last_plane(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    await bench.finger(0.0, 0.0, 0.1)
    bench.forward(100)
    await bench.arms(transform(rotation_from_vector([1.5, 0.0, 0.0]), [0.0, 0.0, 0.0]))
    await bench.finger(0.0, 0.0, 0.1)
    assert np.allclose(bench.sent[-1][0].world_from_sheet, np.eye(4), atol=1e-9)
    assert "edge-on" in note_text(bench.node)


async def test_sheet_is_predicted_to_when_the_light_leaves(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4), age_ms=4.0)
    target = SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=bench.clock.now_ns(),
        world_from_sheet=np.eye(4),
        twist_world=np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]),
        stretch_ratio=1.04,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.0,
    )
    await bench.step("sheet_target", target)
    await bench.finger(0.0, 0.0, -0.02)
    frame = bench.sent[-1][0]
    assert np.isclose(frame.world_from_sheet[1, 3], 0.1 * 0.020)
    assert np.allclose(frame.pushed_point_world_m, [0.0, 0.0, -0.02])


async def test_invalid_finger_pushes_nothing(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    await bench.arms(np.eye(4))
    await bench.finger(0.0, 0.0, -0.02, valid=False)
    assert np.allclose(bench.sent[-1][0].pushed_point_world_m, 0.0, atol=1e-9)


async def test_pixels_come_with_each_nth_frame_and_the_label(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    display = Display(
        correction="one_plane", stereo="mono", shading="flat", pixels_every=3, label="tilt 10"
    )
    await bench.step("display", display)
    for _ in range(7):
        bench.forward(40)
        await bench.finger(0.0, 0.0, 0.1)
    with_pixels = [bool(frame.pixels) for frame, _ in bench.sent]
    assert with_pixels == [False, False, True, False, False, True, False]
    assert {frame.label for frame, _ in bench.sent} == {"tilt 10"}
    assert bench.sent[2][0].pixels[0].shape == (600, 800, 3)


async def test_object_follows_its_own_skin_only(bench: Bench) -> None:
    skin, body = skin_and_body(0.01)
    display = Display(correction="none", stereo="mono", shading="flat", pixels_every=1)
    await bench.step("scene", bench.scene)
    await bench.step("display", display)
    centres = []
    for message in (body, body.model_copy(update={"mesh_id": "other"})):
        await bench.step("skin", skin)
        bench.forward(40)
        await bench.step("soft_body", message)
        picture = bench.sent[-1][0].pixels[0][..., 0]
        centres.append(np.nonzero(picture)[0].mean())
    assert centres[0] < centres[1] - 15  # 10 mm up is about 20 px


async def test_a_new_scene_is_drawn_and_a_bad_one_is_reported(bench: Bench) -> None:
    await bench.step("scene", bench.scene)
    lens = bench.scene.projector.lens.model_copy(update={"distortion": (-3.0, 0, 0, 0, 0)})
    projector = bench.scene.projector.model_copy(update={"lens": lens})
    header = Header(1, 0, 0, "virtual", "test", 1)
    bad = bench.scene.model_copy(update={"projector": projector})
    await bench.node.step("scene", bad, header)
    assert bench.node.errors == 1
    assert "projector.lens.distortion" in bench.node.last_error
    bench.node.errors = 0
    small = bench.scene.projector.model_copy(update={"width_px": 400})
    await bench.step("scene", bench.scene.model_copy(update={"projector": small}))
    await bench.step("display", Display(correction="none", stereo="mono", pixels_every=1))
    bench.forward(100)
    await bench.finger(0.0, 0.0, 0.1)
    assert bench.sent[-1][0].pixels[0].shape == (600, 400, 3)


async def test_a_silent_solver_leaves_the_object_as_it_was(bench: Bench) -> None:
    """If the solver is late, the object keeps its shape, and fingertips cause the frames."""
    skin, body = skin_and_body(0.01)
    await bench.step("scene", bench.scene)
    await bench.step("skin", skin)
    await bench.step(
        "display", Display(correction="none", stereo="mono", shading="flat", pixels_every=1)
    )
    await bench.step("soft_body", body)
    bench.forward(300)
    await bench.finger(0.0, 0.0, 0.1)
    assert len(bench.sent) == 2
    assert np.array_equal(bench.sent[0][0].pixels[0], bench.sent[1][0].pixels[0])
    assert bench.sent[1][1].source_ns == bench.clock.now_ns() - 4 * MS


async def test_displacement_of_another_size_is_reported(bench: Bench) -> None:
    skin, body = skin_and_body(0.0)
    await bench.step("scene", bench.scene)
    await bench.step("skin", skin)
    short = body.model_copy(update={"displacement_world_m": body.displacement_world_m[:5]})
    await bench.node.step("soft_body", short, Header(1, 0, 0, "virtual", "test", 1))
    assert "vertices as in the skin" in bench.node.last_error
    assert bench.sent == []
