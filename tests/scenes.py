"""Load and change scenes for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flexsheet.launch.plans.documents import read_document
from flexsheet.messages.scene import Scene

CYLINDER_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
"""The paper's scene."""


def load_values(path: Path = CYLINDER_FILE) -> dict[str, Any]:
    """Return a new copy of the values in a scene file. The file is parsed only once."""
    return read_document(path).values


def load_cylinder() -> Scene:
    """Return the scene of the paper."""
    return Scene.model_validate(load_values())


def set_density(scene: Scene, density_kg_per_m3: float) -> Scene:
    """Return the scene with a different density of the sheet."""
    sheet = scene.sheet.model_copy(update={"density_kg_per_m3": density_kg_per_m3})
    return scene.model_copy(update={"sheet": sheet})


def make_weightless(scene: Scene) -> Scene:
    """Return the scene with a sheet without weight, which is flat if nothing touches it."""
    return set_density(scene, 0.0)
