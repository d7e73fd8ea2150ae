"""Test the two-pass correction: equal to the equations on a flat sheet, correct on a deformed
one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from flexsheet.launch.calibration.simulated_sheet import simulate_points
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.types import Correction, Display
from flexsheet.nodes.cache import load_cached
from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.models.sheet.indentation import IndentationBasis
from flexsheet.nodes.models.sheet.rubber import Rubber
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import NO_SHAPES_NOTE, SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet
from flexsheet.nodes.renderer.sheet_mesh import deflected_mesh, flat_mesh, pyramid_mesh
from flexsheet.nodes.renderer.sheet_shape_benchmark import sheet_shape_family
from flexsheet.nodes.twin.eye import METRES_PER_PX, push_sizes, render_expected, seen
from flexsheet.nodes.twin.membrane import DeformedSheet, TrueRubber, solve
from flexsheet.nodes.twin.true_object import TrueBody
from tests.indentation_bases import few_dents
from tests.scenes import make_weightless

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
SCENE = make_weightless(
    load_scene(Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml")
)
STRETCH = 1.05
FLAT = DrawStyle(flat=True, pattern="object")


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.fixture(scope="module")
def stage(context: moderngl.Context) -> SceneRenderer:
    return SceneRenderer(SCENE, context, spacing_m=0.004, basis=few_dents())


def sheet_at(pose: Floats, tip: Floats | None = None, *, twist_rad: float = 0.0) -> SheetPose:
    left, right = edge_poses(pose, STRETCH * SCENE.sheet.width_m)
    turn = transform(rotation_from_vector([twist_rad, 0.0, 0.0]), np.zeros(3))
    sheet = estimate_sheet(
        left,
        right @ turn,
        height_m=SCENE.sheet.height_m,
        finger_tip=tip,
    )
    assert sheet is not None
    return sheet


def true_sheet(tip: Floats) -> DeformedSheet:
    spec = SCENE.sheet
    rubber = TrueRubber(spec.width_m, spec.height_m, spec.thickness_m, spec.young_modulus_pa)
    edges = edge_poses(np.eye(4), STRETCH * spec.width_m)
    return solve(rubber, *edges, finger_tip=tip, finger_radius_m=SCENE.finger.radius_m)


def drawn(
    stage: SceneRenderer, correction: Correction, sheet: SheetPose, look: DrawStyle = FLAT
) -> Image:
    shown = Display(correction=correction, stereo="mono", shading="flat", marks=False)
    picture = stage.draw(shown, sheet, look, read=True)
    assert picture is not None
    return picture


@pytest.mark.parametrize("tilt_deg", [-45.0, 0.0, 30.0])
def test_on_a_flat_sheet_two_passes_are_the_equations(
    stage: SceneRenderer, tilt_deg: float
) -> None:
    pose = transform(rotation_from_vector([np.radians(tilt_deg), 0.0, 0.0]), np.zeros(3))
    one_plane = drawn(stage, "one_plane", sheet_at(pose)).astype(float)
    two_pass = drawn(stage, "two_pass", sheet_at(pose)).astype(float)
    lit = (one_plane > 0).mean()
    assert lit > 0.02
    # Outlines are blurred by a pixel; nothing else may differ.
    assert (np.abs(one_plane - two_pass) > 100).mean() < 0.01 * lit
    assert np.abs(one_plane - two_pass).mean() < 0.05 * one_plane.mean()


@pytest.mark.parametrize("depth_mm", [15, 29])
def test_on_a_deformed_sheet_the_image_is_correct(stage: SceneRenderer, depth_mm: int) -> None:
    tip = np.array([0.0, 0.0, -1e-3 * depth_mm])
    eye = SCENE.eyes.centre_world_m
    truth, sheet = true_sheet(tip), sheet_at(np.eye(4), tip)
    wanted = np.array(
        push_sizes(render_expected(TrueBody(SCENE).at_rest(), eye=eye, flat=True), METRES_PER_PX)
    )

    def errors_mm(correction: Correction) -> Floats:
        picture = seen(drawn(stage, correction, sheet), truth, SCENE, eye=eye)
        return np.asarray(1e3 * np.abs(np.array(push_sizes(picture, METRES_PER_PX)) - wanted))

    assert errors_mm("two_pass").max() < 0.35
    assert errors_mm("four_triangles").max() > 0.7


# Between only two places in a quarter of the sheet there is little to interpolate from.
@pytest.mark.parametrize(("place", "rms_m"), [((0.0, 0.0), 4e-4), ((0.03, -0.04), 1e-3)])
def test_the_deformed_mesh_is_the_simulated_sheet(place: tuple[float, float], rms_m: float) -> None:
    tip = np.array([*place, -0.02])
    mesh = deflected_mesh(sheet_at(np.eye(4), tip), few_dents())
    assert mesh.note == ""
    truth = true_sheet(tip)
    points = truth.positions.reshape(-1, 3)
    heights = LinearNDInterpolator(mesh.vertices[:, :2], mesh.vertices[:, 2])(points[:, :2])
    off = (heights - points[:, 2])[np.isfinite(heights)]
    assert len(off) > 0.9 * len(points)
    assert np.sqrt(np.mean(off**2)) < rms_m
    assert np.linalg.norm(mesh.vertices - tip, axis=1).min() < rms_m


@pytest.mark.parametrize("depth_m", [None, 0.005])
def test_the_weight_of_the_sheet_deflects_the_mesh(depth_m: float | None) -> None:
    """The simulated sheet has weight: 1 mm of sag at 50 degrees."""
    density = 1200.0
    pose = transform(rotation_from_vector([np.radians(50.0), 0.0, 0.0]), np.zeros(3))
    tip = None if depth_m is None else apply(pose, np.array([0.0, 0.0, -depth_m]))
    sheet = sheet_at(pose, tip)
    left, right = edge_poses(pose, sheet.edge_distance_m)
    spec = SCENE.sheet
    truth = solve(
        TrueRubber(spec.width_m, spec.height_m, spec.thickness_m, spec.young_modulus_pa, density),
        left,
        right,
        finger_tip=tip,
        finger_radius_m=SCENE.finger.radius_m,
        cells=24,
    )
    local = (truth.positions @ pose[:3, :3]).reshape(-1, 3)

    def rms_m(density_kg_per_m3: float) -> float:
        mesh = deflected_mesh(sheet, few_dents(), density_kg_per_m3=density_kg_per_m3)
        points = mesh.vertices @ pose[:3, :3]
        heights = LinearNDInterpolator(points[:, :2], points[:, 2])(local[:, :2])
        off = (heights - local[:, 2])[np.isfinite(heights)]
        return float(np.sqrt(np.mean(off**2)))

    assert rms_m(density) < 0.25 * rms_m(0.0)


def test_meshes_reach_to_the_corners_and_the_fingertip() -> None:
    pose = transform(rotation_from_vector([0.4, 0.1, 0.0]), np.array([0.01, 0.02, -0.01]))
    tip = apply(pose, np.array([0.02, 0.01, -0.015]))
    for sheet in (sheet_at(pose, tip), sheet_at(pose, tip, twist_rad=0.15)):
        for mesh in (pyramid_mesh(sheet), deflected_mesh(sheet, few_dents())):
            for corner in sheet.corners:
                assert np.linalg.norm(mesh.vertices - corner, axis=1).min() < 1e-4
            assert np.linalg.norm(mesh.vertices - tip, axis=1).min() < 1e-3
    unpushed = sheet_at(pose)
    assert pyramid_mesh(unpushed).vertices == pytest.approx(flat_mesh(unpushed).vertices)


def test_without_indentation_shapes_four_triangles_are_used_and_reported(
    context: moderngl.Context,
) -> None:
    bare = SceneRenderer(SCENE, context, spacing_m=0.006)
    tip = np.array([0.0, 0.0, -0.02])
    picture = drawn(bare, "two_pass", sheet_at(np.eye(4), tip))
    assert picture.max() == 255
    assert bare.note.startswith(NO_SHAPES_NOTE)
    assert f'the scene "{SCENE.name}" as SCENE, run flexsheet precompute SCENE' in bare.note


@pytest.mark.parametrize("tilt_deg", [88.5, 91.0])
def test_a_sheet_edge_on_is_not_lit(stage: SceneRenderer, tilt_deg: float) -> None:
    pose = transform(rotation_from_vector([0.0, np.radians(tilt_deg), 0.0]), np.zeros(3))
    assert drawn(stage, "two_pass", sheet_at(pose)).max() == 0


def test_the_grid_is_projected_too(stage: SceneRenderer) -> None:
    grid = drawn(stage, "two_pass", sheet_at(np.eye(4)), DrawStyle(flat=False, pattern="grid"))
    assert grid[300, 400].max() > 150
    assert grid[290, 410].max() < 60


def test_a_new_shape_of_another_grid_is_drawn_again(stage: SceneRenderer) -> None:
    tip = np.array([0.0, 0.0, -0.02])
    dented = drawn(stage, "two_pass", sheet_at(np.eye(4), tip))
    stage.basis = None
    pyramid = drawn(stage, "two_pass", sheet_at(np.eye(4), tip))
    stage.basis = few_dents()
    again = drawn(stage, "two_pass", sheet_at(np.eye(4), tip))
    assert (dented == again).all()
    assert (dented != pyramid).any()


def test_indentation_shapes_are_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solves = []

    def solve_few(rubber: object, **given: object) -> object:
        solves.append(rubber)
        return few_dents()

    monkeypatch.setattr(deflection_cache, "solve_indentation_basis", solve_few)
    monkeypatch.setattr(deflection_cache, "FOLDER", tmp_path / "shapes")
    assert load_cached(deflection_cache.shapes_cache(SCENE), tmp_path) is None
    deflection_cache.load_or_compute(SCENE, tmp_path)
    kept = deflection_cache.load_or_compute(SCENE, tmp_path)
    assert len(solves) == 1
    at = (1.05, (0.01, 0.02), 0.01)
    same = replace(few_dents(), deepest_m=kept.deepest_m)
    assert kept.offsets(*at) == pytest.approx(same.offsets(*at), abs=1e-6)
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]
    path = deflection_cache.shapes_cache(SCENE).path(tmp_path)
    path.write_bytes(path.read_bytes()[:1000])
    assert load_cached(deflection_cache.shapes_cache(SCENE), tmp_path) is None
    deflection_cache.load_or_compute(SCENE, tmp_path)
    assert len(solves) == 2


def test_shapes_of_another_finger_are_interpolated_and_of_another_width_scaled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = []

    def solve_few(rubber: Rubber, *, finger_radius_m: float, **_: object) -> IndentationBasis:
        solved.append((finger_radius_m, rubber.width_m))
        found = few_dents()
        return replace(found, coefficients=found.coefficients * finger_radius_m / 0.007)

    monkeypatch.setattr(deflection_cache, "solve_indentation_basis", solve_few)
    monkeypatch.setattr(deflection_cache, "FOLDER", tmp_path / "shapes")
    finger = SCENE.finger.model_copy(update={"radius_m": 0.0075})
    sheet = SCENE.sheet.model_copy(update={"width_m": 1.01 * SCENE.sheet.width_m})
    scene = SCENE.model_copy(update={"finger": finger, "sheet": sheet})
    assert deflection_cache.load(scene, tmp_path) is None
    found = deflection_cache.load_or_compute(scene, tmp_path)
    assert solved == [(0.007, SCENE.sheet.width_m), (0.009, SCENE.sheet.width_m)]
    own = replace(few_dents(), deepest_m=found.deepest_m).offsets(1.05, (0.01, 0.02), 0.01)
    scaled = found.offsets(1.05, (0.0101, 0.02), 0.01)
    assert scaled == pytest.approx(7.5 / 7.0 * own * [1.01, 1.0, 1.0], abs=1e-7)
    assert found.grid(1.05, (0.0101, 0.02))[..., 0] == pytest.approx(
        1.01 * few_dents().grid(1.05, (0.01, 0.02))[..., 0], abs=1e-9
    )
    again = deflection_cache.load(scene, tmp_path)
    assert again is not None
    assert len(solved) == 2


def test_another_sheet_or_finger_has_another_file_and_another_modulus_has_not(
    tmp_path: Path,
) -> None:
    own = deflection_cache.shapes_cache(SCENE).path(tmp_path)
    for part, change, differs in (
        ("sheet", {"width_m": 0.26}, True),
        ("sheet", {"max_stretch_ratio": 1.1}, True),
        ("finger", {"radius_m": 0.008}, True),
        ("sheet", {"young_modulus_pa": 2e6}, False),
    ):
        changed = getattr(SCENE, part).model_copy(update=change)
        other = deflection_cache.shapes_cache(SCENE.model_copy(update={part: changed})).path(
            tmp_path
        )
        assert (other != own) == differs


@pytest.mark.long
def test_the_family_of_shapes_distinguishes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deflection_cache, "load_or_compute", lambda scene, folder: few_dents())
    shallow = SCENE.working_range.model_copy(update={"push_depth_m": 0.02})
    spec = SCENE.sheet.model_copy(update={"min_stretch_ratio": 1.04, "max_stretch_ratio": 1.06})
    scene = SCENE.model_copy(update={"working_range": shallow, "sheet": spec})
    errors: dict[str, float] = {}
    for trial in sheet_shape_family(simulate_points).trials(scene):
        if trial.case == {"stretch": 1.04, "depth_mm": 20.0, "position": "centre"}:
            errors[trial.method] = trial.error(trial.run())
            assert trial.in_range == (trial.method in ("reduced_order", "membrane"))
        elif errors:
            break
    assert errors["membrane"] < 0.4
    assert errors["reduced_order"] < 0.4
    assert errors["reduced_order"] < 0.2 * errors["four_triangles"]
