"""Test the map of the image error for perfect and for displaced images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.types import Display
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer.gl import DrawStyle, headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.twin.error_map import PERIOD_M, RANGE_M, RIM_PX, error_map
from flexsheet.nodes.twin.eye import seen
from flexsheet.nodes.twin.membrane import TrueRubber, solve

Image = NDArray[np.uint8]
SCENE = load_scene(Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml")
SCALE_M = 0.0007


def painted(places: NDArray[np.float64]) -> Image:
    """Draw positions (rows, columns), m, as colours, and NaN as black."""
    phase = 2.0 * np.pi * places / PERIOD_M
    coarse = 0.2 + 0.8 * (places / RANGE_M + 0.5)
    colours = np.stack([0.5 + 0.5 * np.cos(phase), 0.5 + 0.5 * np.sin(phase), coarse], axis=-1)
    return np.rint(255.0 * np.nan_to_num(colours)).astype(np.uint8)


@pytest.mark.parametrize("moved_m", [(0.0, 0.0), (0.0004, -0.0011), (-0.031, 0.017)])
def test_what_was_moved_comes_out(moved_m: tuple[float, float]) -> None:
    side = 120
    along = (np.arange(side) - 0.5 * (side - 1)) * SCALE_M
    x, y = np.meshgrid(along, -along)
    covered = np.hypot(x, y) < 0.03
    pictures = [
        painted(np.where(covered, place - by, np.nan))
        for place, by in zip((x, y), moved_m, strict=True)
    ]
    found = error_map(*pictures, SCALE_M).errors_m
    inside = np.isfinite(found).all(axis=-1)
    assert 0.75 * covered.sum() < inside.sum() < covered.sum()
    assert np.abs(found[inside] - moved_m).max() < 5e-5
    # The outline's pixels are left out.
    rim = covered & ~np.roll(covered, RIM_PX - 1, axis=1)
    assert not inside[rim].any()


def test_nothing_seen_has_no_errors() -> None:
    black = np.zeros((40, 40, 3), np.uint8)
    assert len(error_map(black, black, SCALE_M).sizes_m) == 0


def test_blended_colours_are_left_out() -> None:
    white = np.full((40, 40, 3), 255, np.uint8)
    assert len(error_map(white, white, SCALE_M).sizes_m) == 0


def test_the_renderer_paints_what_the_twin_reads() -> None:
    """The error is zero on an undeflected sheet, and constant on a displaced sheet."""
    stage = SceneRenderer(SCENE, headless_context(), spacing_m=0.005)
    sheet = SCENE.sheet
    rubber = TrueRubber(sheet.width_m, sheet.height_m, sheet.thickness_m, sheet.young_modulus_pa)
    eye = SCENE.eyes.centre_world_m

    def mean_error_mm(back_m: float) -> tuple[float, float]:
        pose = transform(np.eye(3), [0.0, 0.0, -back_m])
        truth = solve(rubber, *edge_poses(pose, 1.05 * sheet.width_m), cells=4)
        pictures = []
        for pattern in ("coordinate_ramp_x", "coordinate_ramp_y"):
            shown = Display.model_validate(
                {"correction": "none", "stereo": "mono", "pattern": pattern}
            )
            drawn = stage.draw(shown, stage.sheet_at_rest(), DrawStyle(True, pattern), read=True)
            assert drawn is not None
            pictures.append(seen(drawn, truth, SCENE, eye=eye, metres_per_px=SCALE_M))
        found = error_map(*pictures, SCALE_M)
        assert len(found.sizes_m) > 8000
        x, y = 1e3 * np.nanmean(found.errors_m, axis=(0, 1))
        return float(x), float(y)

    assert mean_error_mm(0.0) == pytest.approx((0.0, 0.0), abs=0.02)
    # 10 mm behind the imaginary screen the projector's light, from 250 mm below and 1 m behind,
    # lands 2.5 mm lower, and is seen as much smaller as it is farther from the eye.
    x, y = mean_error_mm(0.01)
    assert x == pytest.approx(0.0, abs=0.05)
    assert y == pytest.approx(-2.5, abs=0.3)
