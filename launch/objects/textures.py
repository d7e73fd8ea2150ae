"""Read and check the texture image of a scene's object.

In a scene file, the object can have

appearance: {texture: image, image_file: marble.png}

with a path relative to the scene file. The scene message contains the image itself, so renderers on
other hosts need no file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.documents import Document, Key
from flexsheet.messages.errors import FlexsheetError

APPEARANCE: Key = ("object", "appearance")
IMAGE_FILE = "image_file"
SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_SIDE_PX = 2048
"""The maximum width and height of a texture image, in pixels.

More pixels would not improve the projected image, which has fewer pixels than this maximum.
"""


class TextureError(FlexsheetError, ValueError):
    """Raised if a file cannot be used as the texture of an object."""

    remedy = "Use a PNG or JPEG file, and a mesh with texture coordinates."


def load_image(document: Document) -> None:
    """Replace the key `image_file` in a parsed scene file by the image.

    Raises BadInputError if the file cannot be used.
    """
    value = document.find(APPEARANCE)
    if not isinstance(value, dict) or IMAGE_FILE not in value:
        return
    name, where = value.pop(IMAGE_FILE), (*APPEARANCE, IMAGE_FILE)
    try:
        if value.get("texture") != "image":
            raise TextureError(
                "image_file requires `texture: image`; set texture, or remove image_file"
            )
        if not isinstance(name, str):
            raise TextureError("the value is not a file name; give the name of a PNG or JPEG file")
        value["image"] = read_image(document.path.parent / name)
    except TextureError as error:
        raise document.error(where, f'"{name}": {error}') from error


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as an RGB array (height, width, 3); raise TextureError if this fails."""
    if path.suffix.lower() not in SUFFIXES:
        raise TextureError(
            f"the image format {path.suffix} is not supported; convert the file to "
            f"{' or '.join(SUFFIXES)}"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TextureError(
            f"the image file {path} cannot be read: {error.strerror}; check the path"
        ) from error
    # Import only when needed, because only scenes with an image use OpenCV.
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise TextureError("the file is damaged or not an image; export it again")
    if max(image.shape) > MAX_SIDE_PX:
        height, width = image.shape[:2]
        raise TextureError(
            f"the image has {width}x{height} pixels, but at most {MAX_SIDE_PX} per side are "
            "allowed; reduce its size"
        )
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)
