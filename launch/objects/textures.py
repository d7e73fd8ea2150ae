"""Image files that a scene names as its object's texture: read, or refused, and put into the scene.

In a scene file the object may have

    appearance: {texture: image, image_file: marble.png}

with a path relative to the scene file.  What the scene message holds is the picture itself, so that
the renderer has it on whatever host it runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.documents import BadInputError, Document, Key
from flexsheet.messages.errors import FlexsheetError

APPEARANCE: Key = ("object", "appearance")
IMAGE_FILE = "image_file"
SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_SIDE_PX = 2048
"""A side's; the projector has fewer."""


class TextureError(FlexsheetError, ValueError):
    """A file that is no texture; the text says why, and what helps."""

    code = "texture"
    remedy = "Name a PNG or JPEG file, and a mesh with texture coordinates."


def put_image(document: Document) -> None:
    """Replace `image_file` in a scene's document by the picture; raises BadInputError."""
    value: Any = document.values
    for key in APPEARANCE:
        value = value.get(key) if isinstance(value, dict) else None
    if not isinstance(value, dict) or IMAGE_FILE not in value:
        return
    name, where = value.pop(IMAGE_FILE), (*APPEARANCE, IMAGE_FILE)
    try:
        if value.get("texture") != "image":
            raise TextureError("is used by texture: image only; say so, or leave the file out")
        if not isinstance(name, str):
            raise TextureError("is no file's name")
        value["image"] = read_image(document.path.parent / name)
    except TextureError as error:
        raise BadInputError([document.problem(where, f'"{name}": {error}')]) from error


def read_image(path: Path) -> NDArray[np.uint8]:
    """The picture (height, width, 3) of a file, red first; TextureError says why it is none."""
    if path.suffix.lower() not in SUFFIXES:
        raise TextureError(f"textures are read from {', '.join(SUFFIXES)} files")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TextureError(f"cannot be read at {path}: {error.strerror}; check the path") from error
    # Late, because only scenes with an image need it.
    import cv2

    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        raise TextureError("is damaged, or no picture")
    if max(picture.shape) > MAX_SIDE_PX:
        height, width = picture.shape[:2]
        raise TextureError(
            f"has {width}x{height} pixels, at most {MAX_SIDE_PX} to a side; shrink it"
        )
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
