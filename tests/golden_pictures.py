"""Images that the renderer must reproduce.

    python -m tests.golden_pictures [NAME ...]

draws them again into tests/golden (all, or those named). Inspect them before a commit:
`tests/test_golden.py` compares the renderer with them. The projector has 320x240 pixels here, and
its images are mirrored, because it is behind the sheet.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Appearance, Scene
from flexsheet.messages.types import Display, StereoMode
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.renderer.gl import SAMPLES, DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose
from tests.drawing import dent, follow, sheet_at
from tests.indentation_bases import few_dents
from tests.scenes import make_weightless

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
FOLDER = Path(__file__).parent / "golden"
SCENES = Path(__file__).parents[1] / "launch" / "scenes"
SHAPES = ("box", "cylinder", "ellipsoid", "organ", "plane", "sphere")
MODES: tuple[StereoMode, ...] = ("side_by_side", "top_bottom", "frame_sequential", "anaglyph")
SHARE = 0.4
"""Scale of the projector's width and height."""

TILTED = transform(rotation_from_vector([0.35, -0.25, 0.0]), np.array([0.0, 0.005, 0.0]))
TIP = (TILTED @ [0.015, -0.01, -0.025, 1.0])[:3]


def small_scene(name: str, **appearance: object) -> Scene:
    """Make a scene with few pixels and, if given, another appearance."""
    scene = make_weightless(load_scene(SCENES / f"{name}.yaml"))
    projector, lens = scene.projector, scene.projector.lens
    sizes = {key: SHARE * getattr(lens, key) for key in ("fx_px", "fy_px")}
    # Pixels are counted from the first one's centre.
    middles = {key: SHARE * (getattr(lens, key) + 0.5) - 0.5 for key in ("cx_px", "cy_px")}
    smaller = {
        "lens": lens.model_copy(update=sizes | middles),
        "width_px": round(SHARE * projector.width_px),
        "height_px": round(SHARE * projector.height_px),
    }
    painted = {"appearance": Appearance.model_validate(appearance)}
    return scene.model_copy(
        update={
            "projector": projector.model_copy(update=smaller),
            "object": scene.object.model_copy(update=painted),
        }
    )


def draw(
    context: moderngl.Context, scene: Scene, display: Display, sheet: SheetPose | None = None
) -> Image:
    """Draw a deformed object with the marks of fingertip and target."""
    sheet = sheet_at(scene, np.eye(4)) if sheet is None else sheet
    dented = display.correction == "two_pass" and sheet.pushed_point is not None
    basis = few_dents() if dented else None
    stage = SceneRenderer(scene, context, spacing_m=0.004, samples=SAMPLES, basis=basis)
    follow(stage, dent(stage, 0.014, (0.008, -0.006)))
    marked = display.marks and display.pattern == "object"
    look = DrawStyle(
        flat=False,
        pattern=display.pattern,
        fingertip_mark=stage.surface_point(np.array([0.008, -0.006, 0.01])) if marked else None,
        target_mark=stage.surface_point(np.array([-0.02, 0.012, 0.01])) if marked else None,
    )
    picture = stage.draw(display, sheet, look, read=True)
    assert picture is not None
    return picture


Case = Callable[[moderngl.Context], Image]


def _shape(name: str) -> Case:
    shown = Display(correction="two_pass", stereo="mono")
    return lambda context: draw(context, small_scene(name), shown)


def _stereo(mode: StereoMode, swap_eyes: bool = False) -> Case:
    shown = Display(correction="two_pass", stereo=mode, swap_eyes=swap_eyes)
    return lambda context: draw(context, small_scene("sphere", texture="grid"), shown)


def _pattern(pattern: str) -> Case:
    shown = Display.model_validate(
        {"correction": "one_plane", "stereo": "mono", "pattern": pattern}
    )
    scene = small_scene("cylinder")
    return lambda context: draw(context, scene, shown, sheet_at(scene, TILTED))


def _pushed(correction: str, pattern: str) -> Case:
    shown = Display.model_validate({"correction": correction, "stereo": "mono", "pattern": pattern})
    scene = small_scene("cylinder")
    return lambda context: draw(context, scene, shown, sheet_at(scene, TILTED, TIP))


def _texture(**appearance: object) -> Case:
    shown = Display(correction="two_pass", stereo="mono", marks=False)
    return lambda context: draw(context, small_scene("ellipsoid", **appearance), shown)


def _test_card() -> Image:
    """Draw four colours and a white frame."""
    image = np.full((64, 96, 3), 255, np.uint8)
    image[4:32, 4:48], image[4:32, 48:92] = (200, 40, 40), (40, 160, 60)
    image[32:60, 4:48], image[32:60, 48:92] = (50, 70, 200), (220, 190, 50)
    return image


CASES: dict[str, Case] = {
    **{f"shape-{name}": _shape(name) for name in SHAPES},
    **{f"stereo-{mode}": _stereo(mode) for mode in MODES},
    "stereo-anaglyph-swapped": _stereo("anaglyph", swap_eyes=True),
    **{
        f"pattern-{name}": _pattern(name)
        for name in ("grid", "checker", "white", "black", "coordinate_ramp_x", "coordinate_ramp_y")
    },
    **{
        f"pushed-{correction}-{pattern}": _pushed(correction, pattern)
        for correction in ("two_pass", "four_triangles", "none")
        for pattern in ("object", "grid")
    },
    "texture-speckle": _texture(texture="speckle", colour=(0.6, 0.75, 0.9)),
    "texture-grid": _texture(texture="grid"),
    "texture-image": _texture(texture="image", image=_test_card()),
}


def main() -> None:
    context = headless_context()
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or CASES:
        picture = CASES[name](context)
        cv2.imwrite(str(FOLDER / f"{name}.png"), picture[..., ::-1])
        print(f"tests/golden/{name}.png")


if __name__ == "__main__":
    main()
