"""Select the eyes of a frame and pack the images of both eyes for the projector."""

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
"""Minimum distance of an eye from the imaginary screen."""


def select_eyes(eyes: Eyes, tracked: Eye | None) -> tuple[Eyes, Floats, str]:
    """Return the eyes to draw for, the unit direction (3,) from left to right, and a note.

    tracked: newest `eye` message; None if there is none or it is too old. The note contains the
    reason why a tracked message is not used, or is empty.
    """
    across = np.array([1.0, 0.0, 0.0])
    if tracked is None:
        return eyes, across, ""
    if not tracked.valid:
        return eyes, across, "the eyes are not tracked: using the scene's eyes"
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
            f"an eye is {where} from the screen: using the scene's eyes",
        )
    return eyes.model_copy(update={"centre_world_m": tracked.centre_world_m}), across, ""


def both_eyes(eyes: Eyes, mode: StereoMode, across: Floats | None = None) -> Floats:
    """Return the world positions (2, 3) of the left and right eye, equal in mono mode.

    across: (3,), unit direction from left to right; None: along x.
    """
    direction = np.array([1.0, 0.0, 0.0]) if across is None else across
    half = 0.0 if mode == "mono" else 0.5 * eyes.interocular_m
    return np.stack(
        [eyes.centre_world_m - half * direction, eyes.centre_world_m + half * direction]
    )


def which_eye(mode: StereoMode, number: int, *, shows_both: bool) -> WhichEye:
    """Return the eyes of frame `number`; in frame_sequential, odd frames are for the left eye.

    shows_both: whether the output alternates the eyes and needs both images of each frame.
    """
    if mode != "frame_sequential" or shows_both:
        return "both"
    return "left" if number % 2 else "right"


def select_drawn_eyes(
    pair: Floats, mode: StereoMode, which: WhichEye, *, swap_eyes: bool
) -> Floats:
    """Return the eyes (1 or 2, 3) of a pair (2, 3) for which a frame's images are drawn.

    With swap_eyes, a frame for one eye contains the other eye's image, for glasses of the opposite
    phase. Images of both eyes are swapped by `pack`.
    """
    if which != "both":
        row = int((which == "right") != swap_eyes)
        return pair[row : row + 1]
    return pair[:1] if mode == "mono" else pair


def pack(left: Image, right: Image, mode: StereoMode, *, swap_eyes: bool = False) -> Image:
    """Pack two images into one image (height, width, 3) of the same size.

    mono, frame_sequential: the left image. side_by_side, top_bottom: both, halved in width or
    height by averaging, left first. anaglyph: red of the left, green and blue of the right, both
    in grey. swap_eyes: exchange the images first. Raises ValueError if the sizes differ or are odd.
    """
    if left.shape != right.shape:
        raise ValueError(f"images to pack must have equal sizes: {left.shape} and {right.shape}")
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
        raise ValueError(f"image size {image.shape[1]}x{image.shape[0]} must be even for halving")
    even, odd = (image[:, i::2] if axis == 1 else image[i::2] for i in (0, 1))
    return ((even.astype(np.uint16) + odd + 1) // 2).astype(np.uint8)
