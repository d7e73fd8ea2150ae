"""Generate the reference of scene files: each key with unit, default and effect."""

from __future__ import annotations

from flexsheet.launch.objects.scene_keys import KeyGroup, SceneKey, list_groups
from website.messages_page import format_table


def render() -> str:
    """Return a table for each group of keys."""
    return "\n".join(_section(group) for group in list_groups())


def _section(group: KeyGroup) -> str:
    heading = f"{'###' if group.is_variant else '##'} {group.title}\n"
    rows = [(f"`{one.key}`", one.type, one.unit, _default(one), one.effect) for one in group.keys]
    table = format_table(("key", "type", "unit", "default", "effect"), rows)
    return "\n".join([heading, *([f"{group.about}\n"] if group.about else []), table])


def _default(key: SceneKey) -> str:
    return key.default if key.default in ("required", "none") else f"`{key.default}`"


def missing_effects() -> list[str]:
    """Return the keys of a scene file that have no description of their effect."""
    return [one.key for group in list_groups() for one in group.keys if not one.effect]
