"""Read and check the texture image of a scene's object.

In a scene file the object may have

appearance: {texture: image, image_file: marble.png}

with a path relative to the scene file. The scene message contains the image itself, so that
renderers on other hosts need no file.
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
    """Raised for a file that cannot be used as a texture."""

    code = "texture"
    remedy = "Use a PNG or JPEG file, and a mesh with texture coordinates."


def load_image(document: Document) -> None:
    """Replace `image_file` in a scene's document by the image. Raises BadInputError."""
    value: Any = document.values
    for key in APPEARANCE:
        value = value.get(key) if isinstance(value, dict) else None
    if not isinstance(value, dict) or IMAGE_FILE not in value:
        return
    name, where = value.pop(IMAGE_FILE), (*APPEARANCE, IMAGE_FILE)
    try:
        if value.get("texture") != "image":
            raise TextureError("requires texture: image; set it, or remove image_file")
        if not isinstance(name, str):
            raise TextureError("expected a file name")
        value["image"] = read_image(document.path.parent / name)
    except TextureError as error:
        raise BadInputError([document.problem(where, f'"{name}": {error}')]) from error


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image (height, width, 3) in RGB order. Raises TextureError."""
    if path.suffix.lower() not in SUFFIXES:
        raise TextureError(f"unsupported image format; convert the file to {' or '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TextureError(f"cannot be read at {path}: {error.strerror}; check the path") from error
    # Import late, because only scenes with an image need it.
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise TextureError("the file is damaged or not an image; export it again")
    if max(image.shape) > MAX_SIDE_PX:
        height, width = image.shape[:2]
        raise TextureError(
            f"{width}x{height} pixels, at most {MAX_SIDE_PX} per side; reduce the image"
        )
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)
