"""Change scenes for tests."""

from __future__ import annotations

from flexsheet.messages.scene import Scene


def make_weightless(scene: Scene) -> Scene:
    """Return the scene with a sheet without weight, which is flat when nothing pushes it."""
    return scene.model_copy(
        update={"sheet": scene.sheet.model_copy(update={"density_kg_per_m3": 0.0})}
    )
