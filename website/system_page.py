"""Draw and tabulate the recorded measurement of the whole system."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flexsheet.launch.methods.system_picture import draw_system_chart
from website.messages_page import format_table
from website.sensitivity_page import METRICS

SYSTEM = "system.json"
DRAWN_SCENE = "cylinder"
"""The scene in the picture of the README: the demo's."""


def draw(results: Path, images: Path) -> None:
    """Draw the recorded measurement of the demo's scene."""
    result = _read(results / SYSTEM)["results"]
    drawn = {
        key: [one for one in _select(result[key]) if one["scene"] == DRAWN_SCENE]
        for key in ("points", "front")
    }
    draw_system_chart(drawn, images / "system.svg")


def render_system(results: Path) -> str:
    """Return a table with the configurations of each scene in the system chart, in Markdown.

    An error is the 95 % value with nominal hardware, and in parentheses the median and the maximum
    of the 95 % values with random apparatuses.
    """
    heads = ("scene", "configuration", "cores", "to arm, ms", "to light, ms", *METRICS.values(),
             "exceeds")  # fmt: skip
    rows = []
    record = _read(results / SYSTEM)
    for point in _select(record["results"]["points"]):
        cells = (
            point["scene"],
            point["configuration"],
            f"{point['cpu_cores']:.2f}",
            *(_format_latency(point[f"exposure_to_{end}_ms"]) for end in ("arm", "light")),
            *(_format_error(point, key) for key in METRICS),
            ", ".join(key.removesuffix(".p95") for key in point["failing"]) or "–",
        )
        rows.append(cells)
    note = f"{record['machine']}, load {record['load']:.1f}; commit `{record['code']['commit']}`."
    return f"{format_table(heads, rows)}\n{note}"


def _format_error(point: Mapping[str, Any], key: str) -> str:
    random = point["random_apparatuses"].get(key)
    if point[key] is None:
        return "–"
    spread = "" if random is None else f" ({random['median']:.2f}, {random['max']:.2f})"
    return f"{point[key]:.2f}{spread}"


def _select(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one for one in points if one["configuration"] in ("paper", "tuned", "most exact")]


def _read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _format_latency(quantiles: Mapping[str, float] | None) -> str:
    return "–" if quantiles is None else f"{quantiles['p50']:.0f} / {quantiles['p99']:.0f}"
