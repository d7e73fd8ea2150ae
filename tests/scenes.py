"""Change scenes for tests."""

from __future__ import annotations

from flexsheet.messages.scene import Scene


def set_density(scene: Scene, density_kg_per_m3: float) -> Scene:
    """Return the scene with a sheet of that density."""
    sheet = scene.sheet.model_copy(update={"density_kg_per_m3": density_kg_per_m3})
    return scene.model_copy(update={"sheet": sheet})


def make_weightless(scene: Scene) -> Scene:
    """Return the scene with a sheet without weight, which is flat when nothing pushes it."""
    return set_density(scene, 0.0)
