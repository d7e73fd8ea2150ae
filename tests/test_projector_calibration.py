"""Test the projector's calibration: decoded Gray code, optics, and rejected images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from flexsheet.launch.calibration.gray_code import (
    MIN_STRIPE_PX,
    DecodeError,
    decode_patterns,
    find_pixels,
    make_patterns,
)
from flexsheet.launch.calibration.projector import (
    ProjectorError,
    ProjectorPoints,
    calibrate_projector,
    measure_points,
    project_points,
)
from flexsheet.launch.cli import app
from flexsheet.launch.commands.calibrate import write_scene_values
from flexsheet.launch.commands.calibrate_projector import list_scene_values
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Lens, Projector, Scene, StereoCamera
from flexsheet.nodes.twin.eye import TrueProjector
from flexsheet.nodes.twin.projector import (
    LitSheet,
    errors_at_eye,
    make_true_projector,
    pixels_lighting,
    sheet_poses,
)
from flexsheet.nodes.twin.rig import make_true_camera

SCENE_FILE = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"


def halved(lens: Lens) -> Lens:
    return lens.model_copy(
        update={
            "fx_px": lens.fx_px / 2,
            "fy_px": lens.fy_px / 2,
            "cx_px": (lens.cx_px + 0.5) / 2 - 0.5,
            "cy_px": (lens.cy_px + 0.5) / 2 - 0.5,
        }
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return the demo's scene with half the pixels of camera and projector, for speed."""
    full = load_scene(SCENE_FILE)
    camera, projector = full.camera, full.projector
    return full.model_copy(
        update={
            "camera": camera.model_copy(
                update={
                    "width_px": 320,
                    "height_px": 240,
                    "left": halved(camera.left),
                    "right": halved(camera.right),
                }
            ),
            "projector": projector.model_copy(
                update={"width_px": 400, "height_px": 300, "lens": halved(projector.lens)}
            ),
        }
    )


@pytest.fixture(scope="module")
def true_rig(scene: Scene) -> StereoCamera:
    return make_true_camera(scene.camera)


@pytest.fixture(scope="module")
def true(scene: Scene) -> Projector:
    return make_true_projector(scene.projector, seed=3)


@pytest.fixture(scope="module")
def points(scene: Scene, true_rig: StereoCamera, true: Projector) -> ProjectorPoints:
    """Return the rig's measurement of the true projector's light, with known optics."""
    lit = LitSheet(scene, true_rig, true, seed=3)
    shown = make_patterns(scene.projector.width_px, scene.projector.height_px)
    views = [lit.pair(shown, pose) for pose in sheet_poses(4)]
    return measure_points(views, true_rig, scene.projector)


def test_the_patterns_are_decoded_to_the_cell_as_opencv_decodes_them() -> None:
    shown = make_patterns(70, 50)
    assert len(shown) == 2 * (7 + 6) + 2
    view = decode_patterns(shown, 70, 50)
    assert len(view.pixels) == 70 * 50
    assert np.abs(view.lit_by - view.pixels).max() <= 0.5 * (MIN_STRIPE_PX - 1)
    coder = cv2.structured_light.GrayCodePattern.create(70, 50)
    for x, y in ((0, 0), (69, 49), (33, 17)):
        failed, pixel = coder.getProjPixel(shown[:-2], x, y)
        assert not failed
        assert pixel == (x, y)


def test_a_pixel_is_found_between_the_cameras_pixels() -> None:
    """The camera sees the projector's image rotated, scaled and distorted."""
    shown = make_patterns(256, 192)
    rows, columns = np.mgrid[:110, :140].astype(np.float64)

    def lit_by(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([20 + 1.6 * x + 0.1 * y + 4e-4 * x * y, 10 - 0.08 * x + 1.5 * y], axis=-1)

    source = lit_by(columns, rows).astype(np.float32)
    pictures = [
        cv2.remap(pattern, source[..., 0], source[..., 1], cv2.INTER_LINEAR) for pattern in shown
    ]
    wanted = np.array([[100.0, 80.0], [150.0, 120.0], [3.0, 3.0]])
    found, seen = find_pixels(decode_patterns(pictures, 256, 192), wanted)
    assert seen.tolist() == [True, True, False]
    again = lit_by(found[:2, 0], found[:2, 1])
    assert np.abs(again - wanted[:2]).max() < 0.35


def test_the_twins_projector_is_recovered(
    scene: Scene, true: Projector, points: ProjectorPoints
) -> None:
    lens = true.lens
    assert any(lens.distortion)
    off = np.linalg.norm(pixels_lighting(true, points.world) - points.pixels, axis=1)
    assert np.median(off) < 0.4
    fit = calibrate_projector(points, scene.projector)
    assert fit.rms_px < 0.4
    assert fit.held_out_rms_px < 1.2 * fit.rms_px
    assert fit.before_rms_px > 2.0
    eye, planes = scene.eyes.centre_world_m, sheet_poses(7)
    before = errors_at_eye(scene.projector, true, eye, planes, 0.1)
    after = errors_at_eye(fit.projector, true, eye, planes, 0.1)
    assert before.mean() > 1e-3
    assert after.mean() < 0.15e-3
    assert after.max() < 0.4e-3


def test_points_that_make_no_calibration_are_rejected(
    scene: Scene, points: ProjectorPoints
) -> None:
    def some(keep: np.ndarray) -> ProjectorPoints:
        return ProjectorPoints(points.world[keep], points.pixels[keep], points.pose[keep])

    with pytest.raises(ProjectorError, match="in 2 poses"):
        calibrate_projector(some(points.pose < 2), scene.projector)
    flat = points.world * [1.0, 1.0, 0.0]
    with pytest.raises(ProjectorError, match="the depth range of the points"):
        calibrate_projector(ProjectorPoints(flat, points.pixels, points.pose), scene.projector)
    near = np.linalg.norm(points.pixels - points.pixels.mean(axis=0), axis=1) < 60
    corner = ProjectorPoints(*(np.repeat(part[near], 6, axis=0) for part in (
        points.world, points.pixels, points.pose)))  # fmt: skip
    with pytest.raises(ProjectorError, match="% of the projector's image"):
        calibrate_projector(corner, scene.projector)
    moved = points.world + np.where(points.pose == 1, 0.01, 0.0)[:, None]
    with pytest.raises(ProjectorError, match="keep the sheet still"):
        calibrate_projector(ProjectorPoints(moved, points.pixels, points.pose), scene.projector)
    with pytest.raises(ProjectorError, match="0 points"):
        calibrate_projector(some(points.pose < 0), scene.projector)


def test_images_that_are_not_of_the_patterns_are_rejected(scene: Scene) -> None:
    dark = [np.full((60, 80), 10, np.uint8)] * 38
    with pytest.raises(DecodeError, match="there are 5 images, but 38 patterns"):
        decode_patterns(dark[:5], 400, 300)
    with pytest.raises(
        ProjectorError, match="pose 1, left camera: the projector lights only 0 camera pixels"
    ):
        measure_points([(dark, dark)], scene.camera, scene.projector)


def test_the_scene_keeps_its_comments_and_gets_the_projector(tmp_path: Path) -> None:
    scene = load_scene(SCENE_FILE)
    found = make_true_projector(scene.projector, seed=5)
    copy = tmp_path / "scene.yaml"
    write_scene_values(SCENE_FILE, list_scene_values(found), copy)
    before, after = (path.read_text().splitlines() for path in (SCENE_FILE, copy))
    changed = [line for line in after if line not in before]
    assert len(changed) == 2, changed
    assert [line for line in before if line.strip().startswith("#")] == [
        line for line in after if line.strip().startswith("#")
    ]
    written = load_scene(copy).projector
    assert np.allclose(written.lens.distortion, found.lens.distortion, atol=1e-8)
    world = np.array([[0.05, -0.03, 0.02]])
    assert np.allclose(project_points(written, world), project_points(found, world), atol=1e-4)


def test_the_command_names_what_is_missing(tmp_path: Path) -> None:
    def failing(*arguments: str) -> str:
        result = CliRunner().invoke(
            app, ["calibrate", "projector", "--scene", str(SCENE_FILE), *arguments]
        )
        assert result.exit_code != 0
        return str(result.exception)

    assert "exactly one of" in failing()
    assert "contains no subfolders" in failing("--pictures", str(tmp_path))
    (tmp_path / "pose1").mkdir()
    assert "expected 42 files left*.png, one per pattern, found 0" in failing(
        "--pictures", str(tmp_path)
    )


def test_the_twins_eye_bends_light_as_the_true_lens(scene: Scene, true: Projector) -> None:
    """The pixel of a lit point, and the point of a pixel, agree through a distorting lens."""
    vertices = np.array([[-0.12, -0.12, 0], [0.12, -0.12, 0], [0.12, 0.12, 0], [-0.12, 0.12, 0]])
    projector = TrueProjector(true, vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    pixels = np.array([[200.0, 150.0], [20.5, 30.25], [380.0, 280.0]])
    landed, lands = projector.intersect_surface(pixels)
    assert lands[0]
    assert np.allclose(pixels_lighting(true, landed[lands]), pixels[lands], atol=1e-6)
    again, lit = projector.pixels_of(landed[lands])
    assert lit.all()
    assert np.allclose(again, pixels[lands], atol=1e-6)
