"""Select the eyes to draw for, which of them a frame is for, and how the projector packs both."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Eyes
from flexsheet.messages.types import Eye, StereoMode

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
WhichEye = Literal["both", "left", "right"]

MIN_EYE_DISTANCE_M = 0.05
"""Minimum distance of an eye from the imaginary screen. For closer eyes nothing can be drawn."""


def select_eyes(eyes: Eyes, tracked: Eye | None) -> tuple[Eyes, Floats, str]:
    """Return the eyes to draw for, the unit direction (3,) from left to right, and a reason.

    tracked: the newest `eye` message, or None when there is none or it is too old. The reason tells
    why the eyes are not the tracked ones; empty if they are.
    """
    across = np.array([1.0, 0.0, 0.0])
    if tracked is None:
        return eyes, across, ""
    if not tracked.valid:
        return eyes, across, "the eyes are not seen: using the scene's"
    length = float(np.linalg.norm(tracked.right_world))
    if length < 1e-6:
        return eyes, across, "eye.right_world is zero: using the scene's eyes"
    across = np.asarray(tracked.right_world / length, dtype=np.float64)
    reach = 0.5 * eyes.interocular_m * abs(float(across[2]))
    if tracked.centre_world_m[2] - reach < MIN_EYE_DISTANCE_M:
        where = f"{tracked.centre_world_m[2] - reach:.3f} m"
        return (
            eyes,
            np.array([1.0, 0.0, 0.0]),
            f"an eye {where} before the screen: using the scene's eyes",
        )
    return eyes.model_copy(update={"centre_world_m": tracked.centre_world_m}), across, ""


def both_eyes(eyes: Eyes, mode: StereoMode, across: Floats | None = None) -> Floats:
    """Return the world positions (2, 3) of the left and right eye.

    In mono mode both are the point of view.

    across: (3,) unit direction from left to right; None: along x.
    """
    direction = np.array([1.0, 0.0, 0.0]) if across is None else across
    half = 0.0 if mode == "mono" else 0.5 * eyes.interocular_m
    return np.stack(
        [eyes.centre_world_m - half * direction, eyes.centre_world_m + half * direction]
    )


def which_eye(mode: StereoMode, number: int, *, shows_both: bool) -> WhichEye:
    """Return the eye that frame `number` is for: in frame_sequential odd frames are the left eye's.

    shows_both: the output alternates by itself, and takes both images of each frame.
    """
    if mode != "frame_sequential" or shows_both:
        return "both"
    return "left" if number % 2 else "right"


def select_drawn_eyes(
    pair: Floats, mode: StereoMode, which: WhichEye, *, swap_eyes: bool
) -> Floats:
    """Return (1 or 2, 3): the eyes of a pair (2, 3) that a frame draws, one image each.

    A frame for one eye shows the other's image where the eyes are swapped: the glasses then open
    the other way round. Images of both eyes are swapped where they are packed.
    """
    if which != "both":
        row = int((which == "right") != swap_eyes)
        return pair[row : row + 1]
    return pair[:1] if mode == "mono" else pair


def pack(left: Image, right: Image, mode: StereoMode, *, swap_eyes: bool = False) -> Image:
    """Return one image (height, width, 3) of two of that size.

    mono: the left image. side_by_side, top_bottom: each squeezed to half the width or height by
    averaging neighbours, left first. anaglyph: red of the left, green and blue of the right, each
    from its grey. frame_sequential: nothing is packed, the left one comes first. swap_eyes
    exchanges the two first. Raises ValueError if the sizes differ or are odd.
    """
    if left.shape != right.shape:
        raise ValueError(f"images of {left.shape} and {right.shape} cannot be packed")
    if swap_eyes:
        left, right = right, left
    if mode in ("mono", "frame_sequential"):
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
        raise ValueError(f"an image of {image.shape[1]}x{image.shape[0]} cannot be halved")
    even, odd = (image[:, i::2] if axis == 1 else image[i::2] for i in (0, 1))
    return ((even.astype(np.uint16) + odd + 1) // 2).astype(np.uint8)
