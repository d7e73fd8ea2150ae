"""Find launch files and scenes by path, or by the name of a file shipped with the package."""

from __future__ import annotations

from pathlib import Path

LAUNCH_FILES = Path(__file__).resolve().parent.parent
SCENES = LAUNCH_FILES / "scenes"


def list_shipped(folder: Path) -> list[str]:
    """Return the names of the launch files or scenes in a folder of this package."""
    return sorted(file.stem for file in folder.glob("*.yaml"))


def find_file(given: str | Path, shipped: Path, folder: Path = Path()) -> Path:
    """Return the path of a YAML file that is given as a path or as the name of a shipped file.

    shipped: folder of shipped files, LAUNCH_FILES or SCENES. folder: folder to which a relative
    path refers. Return the given path if neither a file nor a shipped file exists.
    """
    path, named = folder / given, shipped / f"{given}.yaml"
    return named if not (path.exists() or path.suffix) and named.is_file() else path
