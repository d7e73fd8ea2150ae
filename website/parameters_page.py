"""Generate the reference of the parameters of each node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from flexsheet.messages.field_types import describe_field_type
from flexsheet.messages.units import find_unit
from flexsheet.nodes import NODES, node_class
from flexsheet.nodes.node import find_parameters_type
from website.messages_page import format_table, nested_models, type_section

ROOT = Path(__file__).resolve().parent.parent


def render() -> str:
    """Return a section for each node, and for each group of parameters."""
    kinds = [find_parameters_type(node_class(name)) for name in NODES]
    parts = dict.fromkeys(part for kind in kinds for part in nested_models(kind))
    sections = [_section(name) for name in NODES]
    return "\n".join([*sections, "## Parts\n", *(type_section(part) for part in parts)])


def _section(name: str) -> str:
    kind = node_class(name)
    about = (kind.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
    rows = [
        (
            f"`{key}`",
            describe_field_type(field),
            find_unit(key),
            _default(field),
            field.description or "",
        )
        for key, field in find_parameters_type(kind).model_fields.items()
    ]
    table = format_table(("parameter", "type", "unit", "default", "what"), rows)
    return f"## {name}\n\n{' '.join(about.split())}\n\n{table}"


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = "null" if value is None else str(value)
    return f"`{text.replace(f'{ROOT}/', '')}`"
