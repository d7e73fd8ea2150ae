"""Define the base class of errors that are shown to users."""

from __future__ import annotations

from typing import ClassVar

EXTRAS = {
    "cyclonedds": "ros2",
    "distributed": "cluster",
    "foxglove": "view",
    "glfw": "projector",
    "matplotlib": "charts",
    "moderngl": "projector",
    "pyrealsense2": "realsense",
    "rosbags": "ros2",
    "trimesh": "meshes",
    "viser": "console",
    "websockets": "console",
    "yourdfpy": "urdf",
}
"""The optional dependencies of pyproject.toml (extras) that install each module."""


class FlexsheetError(Exception):
    """The base class of errors that a user can correct.

    remedy: sentence that states what the user can do; "" if the text of each error states it.
    exit_code: exit status of a command that ends with this error.
    """

    remedy: ClassVar[str] = ""
    exit_code: int = 1

    def __str__(self) -> str:
        """Return the error text.

        Without this method, an error that is also a KeyError would return the text in quotes.
        """
        return Exception.__str__(self)


def find_missing_extra(error: Exception) -> str | None:
    """Return the extra whose packages are missing if the error is a failed import of one."""
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return None
    return EXTRAS.get(error.name.partition(".")[0])


def describe_error(error: Exception) -> str:
    """Return the text of an error and the remedy of its class, separated by a full stop."""
    if extra := find_missing_extra(error):
        return f"{error}. Install it: pip install 'flexsheet[{extra}]'"
    text, remedy = str(error), getattr(error, "remedy", "")
    return f"{text.removesuffix('.')}. {remedy}" if remedy else text
