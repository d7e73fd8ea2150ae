"""Packing of the two eyes' pictures into what the projector takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messages.types import StereoMode

Image = NDArray[np.uint8]


def pack(left: Image, right: Image, mode: StereoMode, *, swap_eyes: bool = False) -> Image:
    """One picture (height, width, 3) of two of that size.

    mono: the left picture.  side_by_side, top_bottom: each squeezed to half the width or height by
    averaging neighbours, left first.  anaglyph: red of the left, green and blue of the right, each
    from its grey.  swap_eyes exchanges the two first.  ValueError if the sizes differ or are odd.
    """
    if left.shape != right.shape:
        raise ValueError(f"pictures of {left.shape} and {right.shape} cannot be packed")
    if swap_eyes:
        left, right = right, left
    if mode == "mono":
        return left
    if mode == "anaglyph":
        packed = np.empty_like(left)
        packed[..., 0] = _gray(left)
        packed[..., 1:] = _gray(right)[..., None]
        return packed
    axis = 1 if mode == "side_by_side" else 0
    return np.concatenate([_halved(left, axis), _halved(right, axis)], axis=axis)


def _gray(image: Image) -> Image:
    gray: Image = np.rint(image @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return gray


def _halved(image: Image, axis: int) -> Image:
    if image.shape[axis] % 2:
        raise ValueError(f"a picture of {image.shape[1]}x{image.shape[0]} cannot be halved")
    even, odd = (image[:, i::2] if axis == 1 else image[i::2] for i in (0, 1))
    return ((even.astype(np.uint16) + odd + 1) // 2).astype(np.uint8)
