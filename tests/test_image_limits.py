"""Test the image on sheets at extreme poses: it is dark or correct, but never wrong."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.calibration.simulated_sheet import solve_sheet
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.types import Display
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer.benchmarks import (
    COORDINATE_RAMPS,
    draw_coordinate_ramps,
    draw_stereo,
    roll_sheet,
)
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import estimate_sheet
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh
from flexsheet.nodes.twin.error_map import error_map
from flexsheet.nodes.twin.eye import seen
from tests.drawing import sheet_at
from tests.indentation_bases import DEEPEST_M, few_dents
from tests.scenes import make_weightless

Floats = NDArray[np.float64]
SCENE = make_weightless(
    load_scene(Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml")
)
STRETCH = 1.05
WHOLE = 14600
"""Number of points of the whole object at 0.7 mm per pixel."""
METHODS = ("one_plane", "four_triangles", "two_pass")
EYE = SCENE.eyes.centre_world_m
PROJECTOR = np.array(SCENE.projector.world_from_projector.position_m)


@pytest.fixture(scope="module")
def stage() -> Iterator[SceneRenderer]:
    context = headless_context()
    made = SceneRenderer(SCENE, context, spacing_m=0.005, basis=few_dents())
    yield made
    context.release()


def plane_through(point: Floats) -> Floats:
    """Return the pose (4, 4) of a sheet about the x axis whose plane contains a point."""
    angle = float(np.arctan2(point[1], point[2])) - 0.5 * np.pi
    return transform(rotation_from_vector([-angle, 0.0, 0.0]), np.zeros(3))


@pytest.mark.parametrize("seer", ["eye", "projector"])
@pytest.mark.parametrize("turned_deg", [-2.0, 0.0, 2.0])
def test_a_sheet_with_eye_or_projector_in_its_plane_is_dark(
    stage: SceneRenderer, seer: str, turned_deg: float
) -> None:
    pose = plane_through(EYE if seer == "eye" else PROJECTOR)
    turn = transform(rotation_from_vector([np.radians(turned_deg), 0.0, 0.0]), np.zeros(3))
    sheet = sheet_at(SCENE, pose @ turn)
    towards = (EYE if seer == "eye" else PROJECTOR) - sheet.plane.point
    assert abs(sheet.plane.normal @ towards) < 0.04 * np.linalg.norm(towards)
    assert not stage.usable(sheet)
    for method in METHODS:
        for picture in draw_coordinate_ramps(stage, method, sheet):
            # Near the plane a few rays to the object's ends are not quite grazing.
            assert (picture.max(axis=2) > 0).mean() < 0.002, method


@pytest.mark.parametrize("tilt_deg", [-85, -80, 80, 85, 100, 180])
def test_beyond_the_steepest_tilts_the_plane_is_not_usable(
    stage: SceneRenderer, tilt_deg: int
) -> None:
    sheet = sheet_at(SCENE, roll_sheet(SCENE, -np.radians(tilt_deg)))
    assert stage.usable(sheet) == (tilt_deg == 80)
    for method in ("none", *METHODS):
        draw_stereo(stage, method, sheet)


@pytest.mark.parametrize("what", ["left", "right", "twist", "corner"])
def test_poses_that_are_not_finite_hold_no_sheet(what: str) -> None:
    left, right = edge_poses(np.eye(4), STRETCH * SCENE.sheet.width_m)
    twist = np.zeros(6)
    {"left": left, "right": right, "corner": right[:1]}.get(what, twist[None])[0, 1] = np.nan
    found = estimate_sheet(
        left, right, height_m=0.24, twist_world=twist, ahead_s=0.01, finger_tip=None
    )
    assert found is None


@pytest.mark.parametrize(
    ("tip", "pushes"),
    [
        ((0.0, 0.0, 0.001), False),
        ((0.0, 0.121, -0.01), False),
        ((0.127, 0.0, -0.01), False),
        ((np.nan, 0.0, -0.01), False),
        ((0.0, 0.0, np.nan), False),
        ((0.0, 0.119, -0.01), True),
        ((0.125, 0.0, -0.01), True),
    ],
)
def test_what_pushes_the_sheet(tip: tuple[float, float, float], pushes: bool) -> None:
    sheet = sheet_at(SCENE, np.eye(4), np.array(tip))
    assert (sheet.pushed_point is not None) == pushes


@pytest.mark.parametrize(
    ("tip", "printed"),
    [
        ((0.0, 0.119, -0.01), "too close to the sheet's edge"),
        ((0.125, 0.0, -0.01), "too close to the sheet's edge"),
        ((0.0, 0.0, -0.065), "deeper than"),
        ((0.0, 0.0, -0.02), ""),
    ],
)
def test_a_push_out_of_range_is_drawn_and_reported(
    stage: SceneRenderer, tip: tuple[float, float, float], printed: str
) -> None:
    picture, _ = draw_coordinate_ramps(stage, "two_pass", sheet_at(SCENE, np.eye(4), np.array(tip)))
    assert picture.max() > 150
    assert stage.note == "" if not printed else printed in stage.note


def test_a_fold_that_keeps_the_light_away_is_dark_and_the_rest_is_right(
    stage: SceneRenderer,
) -> None:
    """The indentation of a tilted sheet shades a part of the image."""
    place = np.array([0.0, 0.05, 0.0])
    pose = roll_sheet(SCENE, np.radians(40.0), (0.0, 0.05))
    tip = pose[:3, 3] + pose[:3, :3] @ (place - [0.0, 0.0, DEEPEST_M])
    edges = edge_poses(pose, STRETCH * SCENE.sheet.width_m)
    truth = solve_sheet(SCENE, *edges, tip)
    mesh = SheetMesh(truth.positions.reshape(-1, 3), truth.triangles().astype(np.int32))
    found = []
    for pattern in COORDINATE_RAMPS:
        display = Display(correction="two_pass", stereo="mono", pattern=pattern)
        picture = stage.draw_onto(display, mesh, DrawStyle(flat=True, pattern=pattern), read=True)
        assert picture is not None
        found.append(seen(picture, truth, SCENE, eye=EYE, metres_per_px=0.0007))
    sizes = error_map(*found, 0.0007).sizes_m
    assert 0.3 * WHOLE < len(sizes) < 0.97 * WHOLE
    assert np.quantile(sizes, 0.99) < 0.001
