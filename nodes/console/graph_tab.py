"""Show the page's tab with the state of the graph: a chart of latencies, and tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.controls import Html
from flexsheet.nodes.console.history import SERIES, WINDOW_S, widen_isolated


class GraphTab:
    """The tab with a chart of latencies and tables of latencies, topics and nodes."""

    def __init__(self, gui: Any) -> None:
        gui.add_html(
            '<p class="fs-words"><b>Latency, ms</b>, during the last half minute. The table below '
            "explains the lines.</p>"
        )
        lines = tuple(
            {"label": name, "stroke": line.color, "width": 2, "dash": line.dash, "spanGaps": False}
            for name, line in zip(SERIES, panels.LINES, strict=True)
        )
        self._chart = gui.add_uplot(
            (np.zeros(1), *(np.full(1, np.nan) for _ in SERIES)),
            ({"label": "s"}, *lines),
            scales=_scales(1.0),
            axes=({}, {}),
            legend={"show": False},
            height=180,
            padding=(10, 24, 0, 0),
        )
        self._tables = Html(gui)

    def show(self, tables: str, columns: tuple[Floats, ...]) -> None:
        self._tables.show(tables)
        # The chart library uPlot finds no range if one of the series has no value.
        scales = _scales(max_latency_ms(columns))
        if self._chart.scales != scales:
            self._chart.scales = scales
        self._chart.data = widen_isolated(columns)


def _scales(top_ms: float) -> dict[str, Any]:
    return {
        "x": {"time": False, "range": (-WINDOW_S, 0.0)},
        "y": {"auto": False, "range": (0.0, top_ms)},
    }


def max_latency_ms(columns: tuple[Floats, ...]) -> float:
    """Return the upper limit of the chart's scale (ms), which is one of 1, 2, 5, 10 and so on.

    columns: times (n,), s, and latency series (n,), ms.
    """
    values = np.concatenate(columns[1:])
    largest = float(values[np.isfinite(values)].max(initial=1.0))
    decade = 10.0 ** np.floor(np.log10(largest))
    return float(next(step * decade for step in (1, 2, 5, 10) if step * decade >= largest))
