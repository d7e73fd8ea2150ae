"""Write the measured figures of pages from the results in docs/results.

A figure is a number that a comment `<!-- =FILE:PATH -->` follows.  FILE.json is a result of
`python -m benchmarks.record`; PATH are keys joined by dots, and `[key=value,...]` selects the entry
of a list.  `*FACTOR` after the path converts the unit.  The number keeps its decimals.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
COMMENT = r"<!-- =(?P<file>[\w-]+):(?P<path>[^\s*]+)(?:\*(?P<factor>[\d.e-]+))? -->"
FIGURE = re.compile(r"(?P<shown>[−-]?\d[\d,]*(?:\.\d+)?)" + COMMENT)
KEY = re.compile(r"([^.\[\]]+)|\[([^\]]+)\]")


class FigureError(ValueError):
    """Raised if a page names a value that no result contains."""


def update(text: str, folder: Path = RESULTS) -> str:
    """Return a page with the current values of the figures.

    Raises FigureError if a result does not contain a value.
    """
    return FIGURE.sub(lambda match: _render(match, folder) + match[0][len(match["shown"]) :], text)


def strip(text: str) -> str:
    """Return a page without the comments of its figures."""
    return re.sub(COMMENT, "", text)


def _render(figure: re.Match[str], folder: Path) -> str:
    value = _select(_read(folder / f"{figure['file']}.json"), figure)
    shown = figure["shown"]
    decimals = len(shown.partition(".")[2])
    separator = "," if "," in shown or abs(value) >= 1e5 else ""
    text = f"{value * float(figure['factor'] or 1):{separator}.{decimals}f}"
    return text.replace("-", "−") if "−" in shown else text


@cache
def _read(file: Path) -> Any:
    if not file.is_file():
        raise FigureError(f"{file}: missing; measure by python -m benchmarks.record {file.stem}")
    return json.loads(file.read_text(encoding="utf-8"))["results"]


def _select(value: Any, figure: re.Match[str]) -> float:
    for key, selection in KEY.findall(figure["path"]):
        if selection:
            wanted = dict(pair.split("=") for pair in selection.split(","))
            found = [
                one for one in value if all(str(one.get(k)) == text for k, text in wanted.items())
            ]
            value = found[0] if len(found) == 1 else None
        else:
            value = value.get(key) if isinstance(value, dict) else None
        if value is None:
            raise FigureError(
                f"{figure['file']}.json does not contain exactly one value {figure['path']}"
            )
    if not isinstance(value, int | float):
        raise FigureError(
            f"{figure['file']}.json: {figure['path']} is not a number; correct the path"
        )
    return value
