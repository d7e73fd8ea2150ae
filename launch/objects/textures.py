"""Read and check the texture image of a scene's object.

In a scene file the object may have

    appearance: {texture: image, image_file: marble.png}

with a path relative to the scene file.  The scene message contains the image itself, so that the
renderer has it on any host.
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
"""Maximum width and height; the projector has fewer pixels."""


class TextureError(FlexsheetError, ValueError):
    """Raised for a file that cannot be a texture; the text gives the reason and a remedy."""

    code = "texture"
    remedy = "Name a PNG or JPEG file, and a mesh with texture coordinates."


def put_image(document: Document) -> None:
    """Replace `image_file` in a scene's document by the image; raises BadInputError."""
    value: Any = document.values
    for key in APPEARANCE:
        value = value.get(key) if isinstance(value, dict) else None
    if not isinstance(value, dict) or IMAGE_FILE not in value:
        return
    name, where = value.pop(IMAGE_FILE), (*APPEARANCE, IMAGE_FILE)
    try:
        if value.get("texture") != "image":
            raise TextureError("needs texture: image; set it, or remove image_file")
        if not isinstance(name, str):
            raise TextureError("is not a file name")
        value["image"] = read_image(document.path.parent / name)
    except TextureError as error:
        raise BadInputError([document.problem(where, f'"{name}": {error}')]) from error


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image (height, width, 3), red first; TextureError gives the reason if it fails."""
    if path.suffix.lower() not in SUFFIXES:
        raise TextureError(f"is not an image file; convert it to {' or '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TextureError(f"cannot be read at {path}: {error.strerror}; check the path") from error
    # Late, because only scenes with an image need it.
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise TextureError("is damaged or not an image; export it again")
    if max(image.shape) > MAX_SIDE_PX:
        height, width = image.shape[:2]
        raise TextureError(
            f"has {width}x{height} pixels, at most {MAX_SIDE_PX} per side; shrink it"
        )
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)
