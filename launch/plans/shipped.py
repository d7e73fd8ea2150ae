"""Find launch files and scenes by path, or by the name of a file in the package."""

from __future__ import annotations

from pathlib import Path

LAUNCH_FILES = Path(__file__).resolve().parent.parent
SCENES = LAUNCH_FILES / "scenes"


def list_shipped(folder: Path) -> list[str]:
    """Return the names of the launch files or scenes in a folder of the package."""
    return sorted(file.stem for file in folder.glob("*.yaml"))


def find_file(given: str | Path, shipped: Path, folder: Path = Path()) -> Path:
    """Return the path of a YAML file that is given as a path or as the name of a shipped file.

    shipped: folder of shipped files, LAUNCH_FILES or SCENES.
    folder: base folder of a relative path. If no such file exists, the given path is returned.
    """
    path, named = folder / given, shipped / f"{given}.yaml"
    return named if not (path.exists() or path.suffix) and named.is_file() else path
