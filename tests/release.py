"""Build the wheel of the working tree, and install it into an empty environment."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE_FOLDERS = ("messages", "nodes", "launch", "docker")
"""Folders that `flexsheet/` contains as links."""

BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, sys.argv[1])('dist')"


def link_sources(folder: Path) -> Path:
    """Link the sources of a build into a folder, so that the build writes nothing into the tree."""
    folder.mkdir()
    for name in (
        *PACKAGE_FOLDERS, "flexsheet", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE",
        "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "requirements.lock",
    ):  # fmt: skip
        (folder / name).symlink_to(ROOT / name)
    return folder


def build(folder: Path, kind: str) -> Path:
    """Build in a folder with sources; kind: build_wheel or build_sdist.  Return the file."""
    subprocess.run([sys.executable, "-c", BUILD, kind], cwd=folder, check=True, capture_output=True)
    suffix = {"build_wheel": "*.whl", "build_sdist": "*.tar.gz"}[kind]
    (found,) = (folder / "dist").glob(suffix)
    return found


@dataclass(frozen=True)
class Environment:
    """Virtual environment; its commands run in another folder and without PYTHONPATH."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    def run(self, *command: str | Path, cwd: Path, timeout_s: float = 600.0) -> str:
        """Run a command of the environment and return its standard output."""
        inherited = {key: value for key, value in os.environ.items() if "PYTHON" not in key}
        done = subprocess.run(
            [self.folder / "bin" / command[0], *command[1:]],
            cwd=cwd, env=inherited, capture_output=True, text=True, timeout=timeout_s, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


def install_without_dependencies(wheel: Path, folder: Path) -> Environment:
    """Install a wheel into a new environment, which finds the packages of this interpreter.

    The packages come by their folders, so that no editable installation is among them.
    """
    venv.create(folder, symlinks=True)
    environment = Environment(folder)
    (site,) = folder.glob("lib/python*/site-packages")
    ours = [entry for entry in sys.path if entry.endswith("site-packages")]
    (site / "dependencies.pth").write_text("\n".join(ours) + "\n")
    subprocess.run(
        [
            sys.executable, "-m", "pip", "--python", environment.python, "install", "--quiet",
            "--disable-pip-version-check", "--no-index", "--no-deps", "--no-compile",
            "--ignore-installed", wheel,
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return environment
