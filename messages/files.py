"""Write files atomically: a reader never sees an incomplete file."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from flexsheet.messages.errors import FlexsheetError

DISK_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO})
"""The values of errno that indicate an error of the disk or its file system."""


class FileWriteError(FlexsheetError, OSError):
    """Raised if a file cannot be written.

    The text contains the path and the cause. If the disk is full, the text also contains the needed
    and the free space.
    """

    def __str__(self) -> str:
        return str(self.strerror)


def write_file(path: Path, content: str | bytes, *, mode: int | None = None) -> None:
    """Write a file atomically. If writing fails, an existing file remains unchanged.

    mode: file permissions; None means the default permissions of the process.

    Raises FileWriteError if the file cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    part = path.with_name(f"{path.name}.part")
    try:
        try:
            with part.open("wb") as file:
                if mode is not None:
                    os.fchmod(file.fileno(), mode)
                file.write(data)
            part.replace(path)
        except BaseException:
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise make_write_error(path, error, needed_bytes=len(data)) from error


def make_write_error(
    path: Path, error: OSError, *, needed_bytes: int | None = None
) -> FileWriteError:
    """Make the error for a file that could not be written, with a remedy that fits the cause.

    needed_bytes: size of the file, which the error text contains if the disk is full; None if the
    size is unknown.
    """
    text = f"{path}: cannot be written: {error.strerror or error}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        needed = "" if needed_bytes is None else f"{_format_size(needed_bytes)} are needed, "
        with suppress(OSError):
            needed += f"{_format_size(free_bytes(path.parent))} are free; "
        text += f"; {needed}free space, or give a file on another disk"
    elif error.errno == errno.ENOENT:
        text += "; create its folder first"
    else:
        text += "; give another file"
    return FileWriteError(error.errno, text)


def free_bytes(folder: Path) -> int:
    """Return the free space (bytes) for this user on the disk of a folder.

    Raises OSError if the folder does not exist.
    """
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def _format_size(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.2f} MB" if size_bytes >= 100_000 else f"{size_bytes} bytes"
