"""Pack two images as one, as reference for the renderer's images of both eyes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import StereoMode

Image = NDArray[np.uint8]


def pack(left: Image, right: Image, mode: StereoMode, *, swap_eyes: bool = False) -> Image:
    """Pack two images into one image (height, width, 3) of the same size.

    mono, frame_sequential: the left image. side_by_side, top_bottom: both, halved in width or
    height by averaging, left first. anaglyph: red of the left, green and blue of the right, both
    in grey. swap_eyes: exchange the images first.
    """
    if swap_eyes:
        left, right = right, left
    if mode in ("mono", "frame_sequential"):
        return left
    if mode == "anaglyph":
        return np.dstack([_gray(left), _gray(right), _gray(right)])
    axis = 1 if mode == "side_by_side" else 0
    return np.concatenate([_halved(left, axis), _halved(right, axis)], axis=axis)


def _gray(image: Image) -> Image:
    gray: Image = np.rint(image @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return gray


def _halved(image: Image, axis: int) -> Image:
    even, odd = (image[:, i::2] if axis == 1 else image[i::2] for i in (0, 1))
    return ((even.astype(np.uint16) + odd + 1) // 2).astype(np.uint8)
