"""Check for the required system packages, and install missing ones if possible.

`python -m tests.system_packages` checks what the nodes need; `--tests` adds what the tests
need.  Missing packages are installed if the process runs as root on Debian or a derivative.
Otherwise the command that installs them is printed.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flexsheet.launch.health.opengl import OPENGL_PACKAGES, find_opengl_problem

SYSTEM_PATHS = ("/usr/sbin", "/sbin")
"""Folders that contain `ip` and may be missing in a user's PATH."""

APT_OPTIONS = ("-qq", "-o", "DPkg::Lock::Timeout=120", "-o", "Acquire::Retries=2")


@dataclass(frozen=True, slots=True)
class SystemPackages:
    """Debian packages that are needed for one purpose.

    problem: function that returns why the packages do not work; None if they do.
    """

    purpose: str
    packages: tuple[str, ...]
    problem: Callable[[], str | None]
    tests_only: bool = True


def find_missing_files(
    *, programs: Sequence[str] = (), libraries: Sequence[str] = ()
) -> str | None:
    """Return which programs and shared libraries are missing; None if none is."""
    path = os.pathsep.join([os.environ.get("PATH", os.defpath), *SYSTEM_PATHS])
    missing = [name for name in programs if shutil.which(name, path=path) is None]
    for name in libraries:
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return f"no {', no '.join(missing)}" if missing else None


OPENGL = SystemPackages("headless OpenGL", OPENGL_PACKAGES, find_opengl_problem, tests_only=False)

TABLE = (
    OPENGL,
    SystemPackages(
        "browser tests", ("chromium",), lambda: find_missing_files(programs=["chromium"])
    ),
    SystemPackages(
        "window tests",
        ("xvfb", "libgl1", "libglx-mesa0", "libxrandr2"),
        lambda: find_missing_files(
            programs=["Xvfb"], libraries=["libGL.so.1", "libGLX_mesa.so.0", "libXrandr.so.2"]
        ),
    ),
    SystemPackages(
        "network namespace tests", ("iproute2",), lambda: find_missing_files(programs=["ip"])
    ),
    SystemPackages(
        "tests of systemd units",
        ("systemd",),
        lambda: find_missing_files(programs=["systemd-analyze"]),
    ),
)
"""System packages by their purpose."""


def can_install() -> bool:
    """Return whether this process may install Debian packages."""
    return os.geteuid() == 0 and shutil.which("apt-get") is not None


def run_apt(*arguments: str) -> bool:
    """Run apt-get; return whether it succeeded.  Its output goes to stderr."""
    command = ["apt-get", *APT_OPTIONS, *arguments]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    try:
        done = subprocess.run(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=sys.stderr, check=False
        )
    except OSError as error:
        _report(f"{' '.join(command)}: {error}")
        return False
    if done.returncode:
        _report(f"{' '.join(command)} failed with exit code {done.returncode}")
    return done.returncode == 0


def install(missing: Sequence[SystemPackages]) -> list[SystemPackages]:
    """Install the packages of each purpose, and return those that still do not work.

    Each purpose is a separate transaction, so that an unavailable package does not block others.
    """
    run_apt("update")
    for one in missing:
        _report(f"{one.purpose}: installing {' '.join(one.packages)}")
        run_apt("install", "-y", "--no-install-recommends", *one.packages)
    return [one for one in missing if one.problem() is not None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the system packages; return exit code 1 if a package that nodes need is missing.

    With --tests return 0, because the tests themselves report missing packages.
    """
    parser = argparse.ArgumentParser(description="Check the system packages.")
    parser.add_argument("--tests", action="store_true", help="check packages for tests, too")
    tests = parser.parse_args(arguments).tests
    required = [one for one in TABLE if tests or not one.tests_only]
    missing = [one for one in required if one.problem() is not None]
    if missing and can_install():
        missing = install(missing)
    if missing:
        reasons = "; ".join(f"{one.purpose} ({one.problem()})" for one in missing)
        packages = " ".join(package for one in missing for package in one.packages)
        _report(
            f"missing system packages: {reasons}; on Debian: sudo apt-get install -y {packages}"
        )
    return int(bool(missing) and not tests)


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
