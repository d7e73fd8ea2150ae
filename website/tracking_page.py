"""Generate the tables of the regret of the tracking methods."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from website.messages_page import format_table

Case = dict[str, Any]


def render(result_file: Path) -> str:
    """Return the tables of a result of `benchmarks.tracking_regret`."""
    result = json.loads(result_file.read_text(encoding="utf-8"))
    parts = [_introduce(result), _by_measurement(result["cases"]), _by_hand(result["cases"])]
    return "\n".join(parts)


def _introduce(result: dict[str, Any]) -> str:
    seeds = result["seeds"]
    steps = ", ".join(
        f"`{name}` {1e6 * median_s:.0f} µs" for name, median_s in result["median_step_s"].items()
    )
    return (
        f"Seeds {seeds[0]} to {seeds[-1]}, commit `{result['commit'][:7]}`, "
        f"{result['machine']}. Median time of a step with its predictions: {steps}"
        f"{' (the machine was busy)' if result['load'] else ''}. Each cell holds the median and "
        "the largest ratio over the cases of its row.\n"
    )


def _ratios(cases: Sequence[Case]) -> list[str]:
    """Return the cells of a row: errors relative to the best method, then those of the bounds."""
    names = list(cases[0]["error_mm"])
    cells = [
        _summarise([case["error_mm"][name] / min(case["error_mm"].values()) for case in cases])
        for name in names
    ]
    cells.append(_summarise([case["error_mm"]["adaptive"] / case["bank_mm"] for case in cases]))
    known = [case for case in cases if case["wiener_mm"] is not None]
    cells.append(
        _summarise([case["error_mm"]["adaptive"] / case["wiener_mm"] for case in known])
        if known
        else "–"
    )
    return cells


def _summarise(ratios: Sequence[float]) -> str:
    return f"{statistics.median(ratios):.2f} / {max(ratios):.2f}"


def _table(first: str, rows: Sequence[tuple[str, Sequence[Case]]]) -> str:
    names = [f"`{name}`" for name in rows[0][1][0]["error_mm"]]
    bounds = ["`adaptive` over its best model", "`adaptive` over known spectrum"]
    return format_table(
        (first, *names, *bounds), [(label, *_ratios(cases)) for label, cases in rows]
    )


def _by_measurement(cases: Sequence[Case]) -> str:
    synthetic = [case for case in cases if case["wiener_mm"] is not None]
    keys = ("rate_hz", "noise_px", "horizon_ms")
    rows = []
    for values in product(*(dict.fromkeys(case[key] for case in synthetic) for key in keys)):
        chosen = [case for case in synthetic if tuple(case[key] for key in keys) == values]
        rows.append(("{} Hz, {} px, {} ms".format(*values), chosen))
    return _table("frame rate, marker noise, horizon", rows)


def _by_hand(cases: Sequence[Case]) -> str:
    rows = []
    hands = dict.fromkeys((case["motion"], case["band"]) for case in cases)
    for motion, band in hands:
        chosen = [case for case in cases if (case["motion"], case["band"]) == (motion, band)]
        label = f"{motion}, tremor {band}" if chosen[0]["wiener_mm"] is not None else "recorded"
        rows.append((label, chosen))
    return _table("voluntary motion, tremor", rows)
