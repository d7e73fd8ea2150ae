"""Test that projected check marks reach the triangulator: drawn, lit on the true sheet, seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import NOMINAL_DISPLAY_LATENCY_S, nominal_apparatus
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Display, Frame, StereoMode, StereoPair, TwinArms
from flexsheet.nodes.models.rigid import inverse, transform, transform_from_rpy
from flexsheet.nodes.models.shapes.triangles import intersect_rays
from flexsheet.nodes.renderer.node import Renderer
from flexsheet.nodes.renderer.parameters import RendererParameters
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.twin.finger_node import TwinFingerNode, TwinFingerParameters
from flexsheet.nodes.twin.lit_marks import LitMarks
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.truth import apply_apparatus, find_display_delay_s
from tests.node_harness import build_node

CYLINDER = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
PLACES = ((-0.06, 0.06), (0.06, 0.05), (0.03, -0.03), (0.055, -0.05), (-0.06, -0.06))
assert CYLINDER.projector is not None
SCENE: Scene = CYLINDER.model_copy(
    update={"projector": CYLINDER.projector.model_copy(update={"check_marks_sheet_m": PLACES})}
)
FRAME_NS = 200_000_000
FINGER = np.array([0.0, 0.0, 0.05])


def make_arms(scene: Scene) -> TwinArms:
    """Return true arms that hold the sheet on the screen, stretched by 5 %."""
    half_m = 0.5 * 1.05 * scene.sheet.width_m
    flanges = []
    for spec, x_m in ((scene.arms.left, -half_m), (scene.arms.right, half_m)):
        edge = spec.flange_from_edge
        flange = transform(np.eye(3), [x_m, 0.0, 0.0])
        flanges.append(flange @ inverse(transform_from_rpy(edge.position_m, edge.rpy_rad)))
    return TwinArms(
        joints_left_rad=np.zeros(6),
        joints_right_rad=np.zeros(6),
        world_from_flange_left=flanges[0],
        world_from_flange_right=flanges[1],
    )


@pytest.mark.parametrize("stereo", ["mono", "side_by_side"])
async def test_the_renderer_draws_each_mark_where_its_message_says(stereo: StereoMode) -> None:
    bench = build_node(Renderer, RendererParameters())
    await bench.node.setup()
    await bench.step("scene", SCENE)
    shown = Display(correction="two_pass", stereo=stereo, pixels_every=1, pattern="black")
    await bench.step("display", shown)
    bench.clock.move_to(bench.clock.now_ns() + FRAME_NS)
    bench.node.refresh()
    frame, _ = bench.messages(Frame)[-1]
    await bench.node.close()
    parts = 2 if stereo == "side_by_side" else 1
    image = frame.pixels[0][..., 0].astype(float)
    for first in range(0, image.shape[1], image.shape[1] // parts):
        part = image[:, first : first + image.shape[1] // parts]
        assert part.sum() == 255.0 * len(PLACES) * 10**2 / parts
        for column, row in frame.marks_px:
            assert part[int(row), int(column / parts)] == 255.0
    np.testing.assert_allclose(frame.marks_world_m[:, :2], PLACES, atol=6e-4)


@pytest.mark.long
async def test_a_moved_projector_is_named_from_images() -> None:
    """Project marks on the simulated sheet, and let the triangulator find them in images."""
    reported = []
    for shift_m in (0.0, 0.002):
        apparatus = nominal_apparatus(SCENE)
        projector = apparatus.projector.model_copy(update={"position_offset_m": (0.0, shift_m, 0)})
        apparatus = apparatus.model_copy(update={"projector": projector})
        true = apply_apparatus(SCENE, apparatus)
        renderer = build_node(Renderer, RendererParameters(idle_rate_hz=30.0))
        await renderer.node.setup()
        await renderer.step("scene", SCENE)
        lit, arms = LitMarks(true, apparatus), make_arms(true)
        camera = TwinCamera(true.camera, finger_radius_m=0.007, seed=100)
        bench = build_node(Triangulator, TriangulatorParameters())
        await bench.node.setup()
        await bench.step("scene", SCENE)
        for number in range(1, 45):
            at_ns = number * FRAME_NS // 2
            renderer.clock.move_to(at_ns - 50_000_000)
            bench.clock.move_to(at_ns)
            renderer.node.refresh()
            frames = [frame for frame, _ in renderer.messages(Frame) if len(frame.marks_px)]
            renderer.published.clear()
            for frame in frames:
                lit.on_frame(frame)
                await bench.step("frame", frame)
            points = lit.light(arms, FINGER, at_ns)
            lit.settle()
            left, right = camera.picture(
                lambda _: FINGER, exposure_s=0.004, time_s=at_ns * 1e-9, lit_points=points
            )
            pair = StereoPair(
                device=true.camera.device, exposure_s=0.004, dropped_frames=0, left=left,
                right=right,
            )  # fmt: skip
            await bench.step("stereo", pair, sequence=number)
        lit.close()
        await renderer.node.close()
        reported.append({one.cause: one for one in bench.node.self_checks})
    nominal, moved = reported
    assert {"camera_or_projector_moved", "camera_or_arm_base_moved"} <= set(nominal)
    assert not any(one.suspected for one in nominal.values())
    assert [one.cause for one in moved.values() if one.suspected] == ["camera_or_projector_moved"]


def test_without_marks_the_simulator_and_the_triangulator_do_not_read_frames() -> None:
    assert "frame" in Triangulator.unused_inputs(TriangulatorParameters(), CYLINDER)
    assert "frame" in TwinFingerNode.unused_inputs(TwinFingerParameters(), CYLINDER)
    assert not Triangulator.unused_inputs(TriangulatorParameters(), SCENE)
    assert not TwinFingerNode.unused_inputs(TwinFingerParameters(), SCENE)


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
    apparatus = nominal_apparatus(SCENE)
    projector = apparatus.projector.model_copy(update={"latency_offset_s": 0.02})
    apparatus = apparatus.model_copy(update={"projector": projector})
    frame = Frame.model_construct(
        drawn_ns=1_000, swapped_ns=0, light_ns=1_000 + round(1e9 * assumed_s)
    )
    assert find_display_delay_s(frame, apparatus) == pytest.approx(late_s)
    assert find_display_delay_s(frame, None) == 0.0
    assert RendererParameters().display_latency_s == NOMINAL_DISPLAY_LATENCY_S
