"""Test that the renderer's images are unchanged. `tests/golden_pictures.py` draws them again."""

from __future__ import annotations

import cv2
import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.nodes.renderer import gl
from flexsheet.nodes.renderer.gl import headless_context
from tests.golden_pictures import CASES, FOLDER

Image = NDArray[np.uint8]

MAX_MEAN = 3.0
"""Maximum mean difference over the lit pixels, levels. Other sampling gives up to 2.7, an object
shifted by a pixel 4.5 and more."""
MAX_OFF, OFF_LEVELS = 0.02, 40
"""Maximum fraction of these pixels that differ by more levels, as at outlines."""


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


def golden(name: str) -> Image:
    picture = cv2.imread(str(FOLDER / f"{name}.png"), cv2.IMREAD_COLOR)
    assert picture is not None, f"python -m tests.golden_pictures {name}"
    return np.asarray(picture[..., ::-1], np.uint8)


def difference(picture: Image, wanted: Image) -> tuple[float, float]:
    """Return the mean difference (levels) and the fraction of very different pixels, of the lit
    ones."""
    assert picture.shape == wanted.shape
    off = np.abs(picture.astype(int) - wanted).max(axis=2)
    lit = max(int((wanted.max(axis=2) > 8).sum()), 1000)
    return float(off.sum() / lit), float((off > OFF_LEVELS).sum() / lit)


def agree(picture: Image, wanted: Image) -> bool:
    mean, share = difference(picture, wanted)
    return mean <= MAX_MEAN and share <= MAX_OFF


@pytest.mark.parametrize("name", CASES)
def test_the_image_is_as_it_was(context: moderngl.Context, name: str) -> None:
    mean, share = difference(CASES[name](context), golden(name))
    assert mean <= MAX_MEAN
    assert share <= MAX_OFF


def test_no_two_goldens_are_alike() -> None:
    pictures = [golden(name)[::2, ::2] for name in CASES]
    for i, one in enumerate(pictures):
        least = min((difference(one, other)[0] for other in pictures[i + 1 :]), default=np.inf)
        assert least > 1.0, list(CASES)[i]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_light_from_elsewhere_is_noticed(
    context: moderngl.Context, monkeypatch: pytest.MonkeyPatch, axis: int
) -> None:
    monkeypatch.setattr(gl, "LIGHT", gl.LIGHT * np.where(np.arange(3) == axis, -1.0, 1.0))
    assert not agree(CASES["shape-cylinder"](context), golden("shape-cylinder"))


def test_an_image_moved_by_a_pixel_is_noticed() -> None:
    wanted = golden("texture-grid")
    assert not agree(np.roll(wanted, 1, axis=1), wanted)
