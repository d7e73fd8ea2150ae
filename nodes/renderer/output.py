"""Select the eyes for which a frame is drawn, and each eye's part of the projector's image."""

from __future__ import annotations

from typing import Literal

import numpy as np

from flexsheet.messages.scene import Eyes
from flexsheet.messages.types import Eye, StereoMode
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.renderer.gl import ImagePart

WhichEye = Literal["both", "left", "right"]

MIN_EYE_DISTANCE_M = 0.05
"""The minimum distance (m) of an eye from the imaginary screen, which is the plane z = 0."""


def select_eyes(eyes: Eyes, tracked: Eye | None) -> tuple[Eyes, Floats, str]:
    """Return the eyes for drawing, the unit vector (3,) from left to right eye, and a note.

    eyes: eye positions of the scene, which are used if no eyes are tracked. tracked: newest message
    of the topic eye; None if there is no message, or if the message is too old. The note for the
    user is the reason why `tracked` is not used, or empty.
    """
    across = np.array([1.0, 0.0, 0.0])
    if tracked is None:
        return eyes, across, ""
    if not tracked.valid:
        return eyes, across, "the eyes are not tracked"
    length = float(np.linalg.norm(tracked.right_world))
    if length < 1e-6:
        return eyes, across, "topic eye: right_world is zero"
    across = np.asarray(tracked.right_world / length, dtype=np.float64)
    reach = 0.5 * eyes.interocular_m * abs(float(across[2]))
    if tracked.centre_world_m[2] - reach < MIN_EYE_DISTANCE_M:
        where = f"{tracked.centre_world_m[2] - reach:.3f} m"
        return (
            eyes,
            np.array([1.0, 0.0, 0.0]),
            f"a tracked eye is {where} from the screen, which is less than the minimum of "
            f"{MIN_EYE_DISTANCE_M:g} m",
        )
    return eyes.model_copy(update={"centre_world_m": tracked.centre_world_m}), across, ""


def both_eyes(eyes: Eyes, mode: StereoMode, across: Floats | None = None) -> Floats:
    """Return the world positions (2, 3), in m, of the left and the right eye.

    The positions are equal in mono mode. across: unit vector (3,) from the left to the right eye.
    If it is None, the x axis is used.
    """
    direction = np.array([1.0, 0.0, 0.0]) if across is None else across
    half = 0.0 if mode == "mono" else 0.5 * eyes.interocular_m
    return np.stack(
        [eyes.centre_world_m - half * direction, eyes.centre_world_m + half * direction]
    )


def which_eye(mode: StereoMode, number: int, *, shows_both: bool) -> WhichEye:
    """Return the eye or eyes for which a frame is drawn.

    number: number of the frame. shows_both: whether the output itself alternates between the eyes.
    In this case, each frame needs both images. Otherwise, in the mode frame_sequential, odd frames
    are for the left eye and even frames for the right eye.
    """
    if mode != "frame_sequential" or shows_both:
        return "both"
    return "left" if number % 2 else "right"


def select_drawn_eyes(
    pair: Floats, mode: StereoMode, which: WhichEye, *, swap_eyes: bool
) -> Floats:
    """Return the eye positions (1 or 2, 3) for which a frame is drawn.

    pair (2, 3): positions of the left and right eye. which: eye or eyes to which the projector
    shows the frame. swap_eyes: whether the shutter glasses open in the opposite order. In this
    case, a frame for one eye is drawn for the other eye. If the frame is for both eyes, `swap_eyes`
    has no effect.
    """
    if which != "both":
        row = int((which == "right") != swap_eyes)
        return pair[row : row + 1]
    return pair[:1] if mode == "mono" else pair


def image_parts(mode: StereoMode, size: tuple[int, int], *, swap_eyes: bool) -> list[ImagePart]:
    """Return the parts of the projector's image for the eyes that share the image.

    size: width and height, px. In side_by_side mode, the left eye has the left half of the image.
    In top_bottom mode, it has the upper half. In anaglyph mode, each eye has the whole image, the
    left eye in red, and the right eye in green and blue. Other modes have one part. swap_eyes:
    whether to exchange the parts.
    """
    width, height = size
    across, up = width // 2, height // 2
    match mode:
        case "side_by_side":
            parts = [ImagePart((left, 0, across, height)) for left in (0, across)]
        case "top_bottom":
            parts = [ImagePart((0, bottom, width, up)) for bottom in (up, 0)]
        case "anaglyph":
            whole = (0, 0, width, height)
            parts = [ImagePart(whole, (red, not red, not red)) for red in (True, False)]
        case _:
            parts = [ImagePart((0, 0, width, height))]
    return parts[::-1] if swap_eyes else parts
