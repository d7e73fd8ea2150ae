"""Find launch files and scenes by path, or by the name of a file in the package."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

LAUNCH_FILES = Path(__file__).resolve().parent.parent
SCENES = LAUNCH_FILES / "scenes"


def list_shipped(folder: Path) -> list[str]:
    """Return the names of the launch files or scenes in a folder of the package."""
    return sorted(file.stem for file in folder.glob("*.yaml"))


def find_file(given: str | Path, shipped: Path, folder: Path = Path()) -> Path:
    """Return the path of a YAML file that is given as a path or as the name of a shipped file.

    If no such file exists, the given path is returned.

    shipped: folder of the shipped files, which is LAUNCH_FILES or SCENES.
    folder: base folder of a relative path.
    """
    path, named = folder / given, shipped / f"{given}.yaml"
    return named if not (path.exists() or path.suffix) and named.is_file() else path


SIMILAR = 0.75
"""The minimum similarity (0 to 1) of a wrong name and a shipped name that is suggested."""


def name_shipped(given: str | Path, shipped: Path) -> str:
    """Return the remedy for an error about a missing file, with the names of the shipped files.

    given: path or name that the user gave.
    shipped: folder of the shipped files, which is LAUNCH_FILES or SCENES.
    """
    names = list_shipped(shipped)
    near = get_close_matches(Path(given).stem, names, n=1, cutoff=SIMILAR)
    remedy = f'did you mean "{near[0]}"? Shipped' if near else "check the path, or name a shipped"
    kind = "scene" if shipped == SCENES else "launch file"
    return f"{remedy} {kind}{'s' if near else ''}: {', '.join(names)}"
