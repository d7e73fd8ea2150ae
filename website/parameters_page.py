"""Generate docs/parameters.md: the parameters of each node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from flexsheet.messages.field_types import describe_field_type
from flexsheet.nodes import NODES, node_class
from flexsheet.nodes.node import find_parameters_type
from website.messages_page import nested_models, type_section

ROOT = Path(__file__).resolve().parent.parent
UNITS = {
    "_m_per_s3": "m/s³", "_rad_per_s3": "rad/s³", "_per_s3": "1/s³", "_m_per_s2": "m/s²",
    "_rad_per_s2": "rad/s²", "_per_s2": "1/s²", "_m_per_s": "m/s", "_rad_per_s": "rad/s",
    "_per_s": "1/s", "_n_per_m": "N/m", "_kg_per_m3": "kg/m³", "_m2": "m²",
    "_hz": "Hz", "_rad": "rad", "_px": "px",
    "_kg": "kg", "_pa": "Pa", "_bytes": "bytes", "_ratio": "1", "_n": "N", "_m": "m", "_s": "s",
}  # fmt: skip
"""Units by suffix of the name; longer suffixes first."""

INTRODUCTION = """\
# Parameters

<!-- Written by `make pages`; a test compares. -->

Parameters of each node.  Set them in a launch file under `nodes: NAME: parameters:`, or on the
command line by `--set NAME.PARAMETER=VALUE`.  Names contain the units.  The command
`flexsheet node info NODE` prints the parameters with ports and timers.
"""


def reference() -> str:
    """Return the page."""
    kinds = [find_parameters_type(node_class(name)) for name in NODES]
    parts = dict.fromkeys(part for kind in kinds for part in nested_models(kind))
    sections = [INTRODUCTION, *(_section(name) for name in NODES)]
    return "\n".join([*sections, "## Parts\n", *(type_section(part) for part in parts)])


def unit(name: str) -> str:
    """Return the unit from the suffix of a parameter's name; empty if there is none."""
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")


def _section(name: str) -> str:
    kind = node_class(name)
    about = (kind.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
    rows = [
        f"| `{key}` | {describe_field_type(field)} | {unit(key)} | {_default(field)} | "
        f"{field.description or ''} |"
        for key, field in find_parameters_type(kind).model_fields.items()
    ]
    table = ["| parameter | type | unit | default | what |", "| --- | --- | --- | --- | --- |"]
    return f"## {name}\n\n{' '.join(about.split())}\n\n" + "\n".join([*table, *rows]) + "\n"


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = "null" if value is None else str(value)
    return f"`{text.replace(f'{ROOT}/', '')}`"
