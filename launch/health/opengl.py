"""Check whether OpenGL works without a display.

This module imports only the standard library, because it is used before the other libraries are
installed.
"""

from __future__ import annotations

import subprocess
import sys

OPENGL_PACKAGES = ("libegl1", "libgl1-mesa-dri")
"""The Debian packages that provide headless OpenGL."""

OPENGL_REMEDY = f"on Debian: sudo apt-get install -y {' '.join(OPENGL_PACKAGES)}"


def find_opengl_problem() -> str | None:
    """Return why no OpenGL context can be created without a display, or None if it can be created.

    A separate process tries to create the context, because a driver that fails once in a process
    always fails in this process.
    """
    code = "import moderngl; moderngl.create_standalone_context(backend='egl').release()"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    if result.returncode == 0:
        return None
    lines = result.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit code {result.returncode}"
