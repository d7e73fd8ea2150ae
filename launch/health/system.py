"""Sees to the system libraries that headless OpenGL needs: `python -m launch.health.system`.

Debian and its kin: installed when we are root; otherwise one line says what to install.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

PACKAGES = ("libegl1", "libgl1-mesa-dri")
MANUAL = f"sudo apt-get install -y {' '.join(PACKAGES)}"


def opengl_problem() -> str | None:
    """Why no headless OpenGL context can be made; None when one can.

    Asked in a process of its own: a driver that failed to load once stays failed in its process.
    """
    code = "import moderngl; moderngl.create_standalone_context(backend='egl').release()"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    if result.returncode == 0:
        return None
    lines = result.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit code {result.returncode}"


def install_packages() -> None:
    """Install the libraries with apt-get; raises CalledProcessError with its output shown."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (
        ["apt-get", "update", "-qq"],
        ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *PACKAGES],
    ):
        subprocess.run(command, env=environment, stdout=sys.stderr, check=True)


def main() -> int:
    problem = opengl_problem()
    if problem is None:
        return 0
    if os.geteuid() == 0 and shutil.which("apt-get"):
        print(f"headless OpenGL is missing; installing {' '.join(PACKAGES)}", file=sys.stderr)
        try:
            install_packages()
        except subprocess.CalledProcessError as error:
            print(f"{' '.join(error.cmd)} ended with {error.returncode}", file=sys.stderr)
        problem = opengl_problem()
        if problem is None:
            return 0
    print(f"headless OpenGL does not work ({problem}); on Debian: {MANUAL}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
