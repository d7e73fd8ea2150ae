"""Test the object's appearance: shading, textures, markers and patterns, without seams."""

from __future__ import annotations

from pathlib import Path

import cv2
import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Appearance, Scene
from flexsheet.messages.types import Correction, Display
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose
from tests.drawing import dent, follow, sheet_at

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
CYLINDER = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"
SCENE = load_scene(CYLINDER)
SOFT = DrawStyle(flat=False, pattern="object")
MIDDLE = (299, 399)
"""Row and column that light the world's origin; two pixels per millimetre, x to the left."""


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.fixture(scope="module")
def plain(context: moderngl.Context) -> SceneRenderer:
    return SceneRenderer(SCENE, context, spacing_m=0.004)


def painted(**appearance: object) -> Scene:
    changed = SCENE.object.model_copy(update={"appearance": Appearance.model_validate(appearance)})
    return SCENE.model_copy(update={"object": changed})


def drawn(
    stage: SceneRenderer,
    look: DrawStyle = SOFT,
    *,
    correction: Correction = "none",
    sheet: SheetPose | None = None,
) -> Image:
    shown = Display(correction=correction, stereo="mono")
    picture = stage.draw(shown, sheet or stage.sheet_at_rest(), look, read=True)
    assert picture is not None
    return picture


def test_the_indentation_is_darker_and_its_walls_are_shaded(plain: SceneRenderer) -> None:
    follow(plain, None)
    before = drawn(plain).astype(int)
    follow(plain, dent(plain, 0.015))
    after = drawn(plain).astype(int)
    follow(plain, None)
    row, column = MIDDLE
    assert after[row, column, 0] < 0.8 * before[row, column, 0]
    assert np.abs(after[:, :200] - before[:, :200]).max() <= 1
    # The light comes from above: the dent's upper wall turns away from it, the lower one to it.
    upper, lower = after[row - 22, column, 0], after[row + 22, column, 0]
    assert lower - upper > 20


def test_shadows_are_redder_than_light(plain: SceneRenderer) -> None:
    picture = drawn(plain).astype(float)[60:540, 399]
    lit = picture[picture[:, 0] > 20]
    share = lit[:, 0] / lit.sum(axis=1)
    dim, bright = lit[:, 0].argmin(), lit[:, 0].argmax()
    assert share[dim] > share[bright] + 0.01
    assert lit[:, 0].min() > 40  # never quite dark


def test_an_image_is_laid_over_the_front(context: moderngl.Context) -> None:
    image = np.zeros((4, 8, 3), np.uint8)
    image[:2, :4], image[:2, 4:] = (255, 0, 0), (0, 255, 0)
    image[2:, :4], image[2:, 4:] = (0, 0, 255), (255, 255, 0)
    stage = SceneRenderer(painted(texture="image", image=image), context, spacing_m=0.004)
    picture = drawn(stage).astype(int)
    row, column = MIDDLE
    # As the projector shows it: left is right, seen through the sheet.
    assert picture[row - 20, column + 60].argmax() == 0
    assert picture[row - 20, column - 60].argmax() == 1
    assert picture[row + 20, column + 60].argmax() == 2
    assert picture[row + 20, column - 60, :2].min() > 2 * picture[row + 20, column - 60, 2]


@pytest.mark.parametrize("texture", ["speckle", "grid"])
def test_a_texture_moves_with_the_skin(context: moderngl.Context, texture: str) -> None:
    stage = SceneRenderer(painted(texture=texture), context, spacing_m=0.004)
    row, column = MIDDLE
    patch = np.s_[row - 30 : row + 30, column - 60 : column + 60]
    before = drawn(stage)[patch]
    assert before[..., 0].std() > 15
    # 4 mm to the right in the world is 8 pixels to the left.
    follow(stage, np.tile([0.004, 0.0, 0.0], (len(stage._surface.rest_world_m), 1)))
    after = drawn(stage)[patch].astype(int)
    assert np.abs(after[:, :-8] - before[:, 8:]).mean() < 2.0
    assert np.abs(after - before).mean() > 10.0


def test_checker_and_white(plain: SceneRenderer) -> None:
    row, column = MIDDLE
    checker = drawn(plain, DrawStyle(False, "checker"))
    signs = [int(checker[row + 20 * j, column + 20 * i, 0]) for j in (-1, 1) for i in (-1, 1)]
    assert sorted(signs) == [0, 0, 255, 255]
    assert signs[0] == signs[3]
    assert checker[row + 20, column + 60, 0] == signs[2]
    assert drawn(plain, DrawStyle(False, "white"))[row, column].tolist() == [255] * 3


POSES = [
    pytest.param(transform(rotation_from_vector([0.0, 0.0, 0.0]), np.zeros(3)), id="upright"),
    pytest.param(transform(rotation_from_vector([0.5, -0.3, 0.1]), np.zeros(3)), id="tilted"),
]


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("correction", ["one_plane", "four_triangles", "two_pass"])
def test_an_even_patch_has_no_seam(
    plain: SceneRenderer, correction: Correction, pose: Floats
) -> None:
    """No dark line may appear between triangles of the sheet or of the object."""
    tip = (pose @ [0.02, -0.03, -0.03, 1.0])[:3]
    picture = drawn(
        plain, DrawStyle(False, "white"), correction=correction, sheet=sheet_at(SCENE, pose, tip)
    )
    lit = picture.min(axis=2)
    outlines, _ = cv2.findContours(
        (lit > 128).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    filled = cv2.drawContours(np.zeros_like(lit), outlines, -1, 1, cv2.FILLED)
    inside = cv2.erode(filled, np.ones((7, 7), np.uint8), borderValue=0) > 0
    assert inside.mean() > 0.3
    assert lit[inside].min() == 255


@pytest.mark.parametrize("correction", ["none", "four_triangles", "two_pass"])
def test_edges_are_soft(plain: SceneRenderer, correction: Correction) -> None:
    """Multisampled outlines have intermediate brightness."""
    picture = drawn(plain, DrawStyle(True, "object"), correction=correction)[..., 0]
    between = (picture > 16) & (picture < 240)
    assert between.sum() > 200
    assert len(np.unique(picture[between])) >= 3


def scene_with(tmp_path: Path, appearance: str) -> Path:
    text = CYLINDER.read_text().replace(
        "  support:", f"  appearance: {{{appearance}}}\n  support:", 1
    )
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    return path


def test_a_scene_file_names_its_image(tmp_path: Path) -> None:
    picture = np.zeros((5, 7, 3), np.uint8)
    picture[0, 0] = (1, 2, 3)
    cv2.imwrite(str(tmp_path / "skin.png"), picture[..., ::-1])
    scene = load_scene(scene_with(tmp_path, "texture: image, image_file: skin.png"))
    assert np.array_equal(scene.object.appearance.image, picture)


@pytest.mark.parametrize(
    ("appearance", "reported"),
    [
        ("texture: image, image_file: gone.png", 'image_file.*"gone.png".*No such file'),
        ("texture: image, image_file: skin.tif", r"convert the file to \.png"),
        ("texture: image, image_file: bad.png", "damaged"),
        ("texture: image, image_file: huge.png", "2050x1 pixels, but at most 2048"),
        ("texture: grid, image_file: bad.png", "image_file requires `texture: image`"),
        ("texture: image, image_file: 7", "the value is not a file name"),
        ("texture: image", "requires an image"),
    ],
)
def test_a_file_that_is_no_texture_is_reported(
    tmp_path: Path, appearance: str, reported: str
) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    cv2.imwrite(str(tmp_path / "huge.png"), np.zeros((1, 2050, 3), np.uint8))
    with pytest.raises(BadInputError, match=f"(?s){reported}"):
        load_scene(scene_with(tmp_path, appearance))


def test_appearance_is_checked() -> None:
    with pytest.raises(ValidationError, match="less than or equal to 1"):
        Appearance(colour=(2.0, 0.0, 0.0))
