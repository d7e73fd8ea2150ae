"""Test drawing at its limits: points behind the eye, folded sheets, and values like NaN."""

from __future__ import annotations

from pathlib import Path

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Correction, Display
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh, occluded_fraction, pyramid_mesh
from flexsheet.nodes.twin.eye import render_expected, seen
from flexsheet.nodes.twin.membrane import TrueRubber, solve
from flexsheet.nodes.twin.true_object import TrueBody
from tests.drawing import body_of, dent, follow, sheet_at

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
SCENE = load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
EYE = SCENE.eyes.centre_world_m
PROJECTOR = SCENE.projector.world_from_projector.position_m
CORRECTIONS: tuple[Correction, ...] = ("none", "one_plane", "four_triangles", "two_pass")


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.fixture(scope="module")
def stage(context: moderngl.Context) -> SceneRenderer:
    return SceneRenderer(SCENE, context, spacing_m=0.004)


def drawn(stage: SceneRenderer, correction: Correction, sheet: SheetPose) -> Image:
    shown = Display(correction=correction, stereo="mono", shading="flat", marks=False)
    picture = stage.draw(shown, sheet, DrawStyle(True, "object"), read=True)
    assert picture is not None
    return picture


def with_object_at(z_m: float) -> Scene:
    pose = SCENE.object.world_from_object.model_copy(
        update={"position_m": np.array([0.0, 0.0, z_m])}
    )
    return SCENE.model_copy(
        update={"object": SCENE.object.model_copy(update={"world_from_object": pose})}
    )


def test_what_is_behind_the_eye_is_not_drawn(context: moderngl.Context) -> None:
    behind = SceneRenderer(with_object_at(0.6), context, spacing_m=0.006)
    for correction in CORRECTIONS:
        assert drawn(behind, correction, behind.sheet_at_rest()).max() == 0
    # Half of it behind: the rest is there, ahead of the eye it fills the view.
    half = SceneRenderer(with_object_at(0.39), context, spacing_m=0.006)
    for correction in CORRECTIONS:
        assert drawn(half, correction, half.sheet_at_rest()).max() in (0, 255)


def test_a_point_in_front_of_the_sheet_is_seen_at_its_position(stage: SceneRenderer) -> None:
    """Place the sheet 25 mm behind the front of the object."""
    pose = transform(np.eye(3), np.array([0.0, 0.0, -0.025]))
    spec = SCENE.sheet
    rubber = TrueRubber(spec.width_m, spec.height_m, spec.thickness_m, spec.young_modulus_pa)
    edges = edge_poses(pose, 1.05 * spec.width_m)
    truth = solve(rubber, *edges, finger_tip=None, finger_radius_m=SCENE.finger.radius_m)
    wanted = (
        render_expected(TrueBody(SCENE).at_rest(), eye=EYE, flat=True, metres_per_px=0.001) / 255.0
    )
    for correction in ("one_plane", "two_pass"):
        picture = drawn(stage, correction, sheet_at(SCENE, pose))
        off = seen(picture, truth, SCENE, eye=EYE, metres_per_px=0.001) / 255.0 - wanted
        assert abs(off.sum()) < 0.005 * wanted.sum()
        assert np.abs(off).sum() < 0.02 * wanted.sum()


def folded(overhang_m: float) -> SheetMesh:
    """Return a sheet with a fold along y that overlaps itself by an overhang.

    Seen along z, its middle strip is reversed.
    """
    y = np.array([-0.1, 0.02, 0.02 - overhang_m, 0.1])
    z = np.array([0.0, 0.0, -0.02, -0.02])
    points = [[x, *place] for place in zip(y, z, strict=True) for x in (-0.1, 0.1)]
    triangles = [[[2 * i, 2 * i + 1, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 2]] for i in range(3)]
    return SheetMesh(np.array(points), np.array(triangles, np.int32).reshape(-1, 3))


def test_light_lost_at_folds_is_measured() -> None:
    far_eye, far_light = np.array([0.0, 0.0, 1e3]), np.array([0.0, 0.0, -1e3])
    turned = folded(0.04)
    # 40 mm turned over, and 40 in their shadow, of 120 + 40 + 120.
    assert occluded_fraction(turned, far_eye, far_light) == pytest.approx(80 / 280, abs=1e-3)
    assert occluded_fraction(folded(-0.01), far_eye, far_light) == 0.0
    tip = np.array([0.01, 0.02, -0.025])
    assert occluded_fraction(pyramid_mesh(sheet_at(SCENE, np.eye(4), tip)), EYE, PROJECTOR) == 0.0


def test_a_folded_sheet_is_drawn_and_reported(
    stage: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The projector lights only the nearer of two points on one ray."""
    monkeypatch.setattr(stage, "sheet_mesh", lambda sheet: folded(0.03))
    stage.note = ""
    picture = drawn(stage, "two_pass", stage.sheet_at_rest())
    assert picture.max() == 255
    assert 0.1 < stage.occluded_fraction < 0.4
    assert "is folded and gets no light" in stage.note
    monkeypatch.undo()
    drawn(stage, "two_pass", stage.sheet_at_rest())
    assert stage.occluded_fraction == 0.0
    assert "folded" not in stage.note


def test_triangles_without_area_are_nothing(
    stage: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    sheet = stage.sheet_at_rest()
    before, mesh = drawn(stage, "two_pass", sheet), stage.sheet_mesh(sheet)
    needles = np.concatenate([mesh.triangles, [[0, 0, 1], [2, 2, 2]]]).astype(np.int32)
    monkeypatch.setattr(stage, "sheet_mesh", lambda sheet: SheetMesh(mesh.vertices, needles))
    assert np.array_equal(drawn(stage, "two_pass", sheet), before)
    assert stage.occluded_fraction < 0.001


def test_non_finite_positions_are_rejected(stage: SceneRenderer) -> None:
    lost = np.full((4, 4), np.nan)
    rest = stage.sheet_at_rest()
    nowhere = SheetPose(lost, rest.corners, None)
    assert not stage.usable(nowhere)
    for correction in CORRECTIONS:
        with pytest.raises(ValueError, match="pose is not finite"):
            drawn(stage, correction, nowhere)
    follow(stage, dent(stage, 0.01))
    before = drawn(stage, "none", rest)
    for value in (np.nan, np.inf):
        displacement = dent(stage, 0.02)
        displacement[5] = value
        bad = body_of(np.zeros_like(displacement)).model_copy(
            update={"displacement_world_m": displacement.astype(np.float32)}
        )
        with pytest.raises(ValueError, match="displacement_world_m is not finite"):
            stage.deform(bad)
    assert np.array_equal(drawn(stage, "none", rest), before)
    follow(stage, None)
