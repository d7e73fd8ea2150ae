"""Generate the table of the parameters whose errors matter most, from two recorded measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flexsheet.nodes.twin.tolerance_table import Profile
from website.messages_page import format_table

ROWS_PER_PROFILE = 16
METRICS = {
    "sheet_mm": "sheet, mm",
    "image_mm": "image, mm",
    "force_percent": "force, %",
    "fingertip_mm": "fingertip, mm",
}
"""The headings of the metrics in a result of `flexsheet experiment sensitivity`."""


def render(results: Path) -> str:
    """Return the parameters with the largest effects for each profile, in Markdown.

    A row that is the same for both profiles stands once.
    """
    heads = ("parameter", "profile", *METRICS.values(), "over the tolerance")
    profiles: dict[tuple[str, ...], list[str]] = {}
    notes = []
    for profile in Profile:
        record = json.loads((results / f"sensitivity-{profile.value}.json").read_text("utf-8"))
        found = record["results"]
        for one in found["ranking"][:ROWS_PER_PROFILE]:
            effects = _format_effects(found, one["parameter"])
            row = (f"`{one['parameter']}`", *effects, f"{one['share']:.2f}")
            profiles.setdefault(row, []).append(f"`{profile.value}`")
        notes.append(f"{record['machine']}; commit `{record['code']['commit']}`.\n")
    rows = [(row[0], ", ".join(names), *row[1:]) for row, names in profiles.items()]
    return "\n".join([format_table(heads, rows), *notes])


def _format_effects(found: dict[str, Any], parameter: str) -> list[str]:
    """Return the largest effect of one and of three standard deviations for each metric."""
    cells = []
    for metric in METRICS:
        largest = [
            max(
                (
                    row[metric]
                    for row in found["rows"]
                    if row["parameter"] == parameter
                    and abs(row["sigma"]) == sigma
                    and row[metric] is not None
                ),
                default=None,
            )
            for sigma in (1.0, 3.0)
        ]
        shown = ["–" if one is None else f"{one:.2f}" for one in largest]
        cells.append("–" if largest == [None, None] else " / ".join(shown))
    return cells
