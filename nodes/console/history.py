"""Store the latencies of the last 30 s for the latency chart of the console page."""

from __future__ import annotations

from collections import deque

import numpy as np

from flexsheet.messages.base import Message
from flexsheet.messages.types import ArmState, Fingertip, Frame, SheetTarget, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.latest_messages import MessageSource

WINDOW_S = 30.0
SAMPLE_S = 0.5
SERIES = ("finger found", "sheet placed", "body answered", "arm commanded", "frame drawn")


class History:
    """The latencies (ms) of the last 30 s, from the camera exposure to each processing step."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, tuple[float, ...]]] = deque()

    def add(self, now_s: float, source: MessageSource) -> None:
        """Store the latencies at the time `now_s`, and delete those older than half a minute."""
        self._samples.append((now_s, read_latencies_ms(source)))
        while self._samples and self._samples[0][0] < now_s - WINDOW_S:
            self._samples.popleft()

    def columns(self) -> tuple[Floats, ...]:
        """Return the n times (n,), in s relative to the latest sample, and all latency series.

        The series (n,) are in ms. If a value is missing, it is NaN.
        """
        if not self._samples:
            return (np.zeros(1), *(np.full(1, np.nan) for _ in SERIES))
        newest_s = self._samples[-1][0]
        times = np.array([time_s - newest_s for time_s, _ in self._samples])
        values = np.array([values for _, values in self._samples])
        return (times, *values.T)

    def latest_and_max(self) -> dict[str, tuple[float, float]]:
        """Return the latest value and the maximum (ms) of each series.

        Both values are NaN if there are no samples.
        """
        found = {}
        for name, values in zip(SERIES, self.columns()[1:], strict=True):
            valid = values[np.isfinite(values)]
            found[name] = float(values[-1]), float(valid.max()) if len(valid) else float("nan")
        return found


def widen_isolated(columns: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Repeat isolated values of a chart, because the chart draws only lines between values.

    columns: n times (n,), s, and series (n,).

    If a value is between two missing values, it is repeated at the time of the previous sample. If
    there is only one sample, it is repeated half a second earlier.
    """
    times, *series = columns
    if len(times) == 1:
        times = np.array([times[0] - SAMPLE_S, times[0]])
        series = [np.repeat(values, 2) for values in series]
    widened = []
    for values in series:
        valid = np.isfinite(values)
        isolated = valid & ~np.r_[False, valid[:-1]] & ~np.r_[valid[1:], False]
        indices = np.flatnonzero(isolated)
        filled = values.copy()
        filled[np.where(indices > 0, indices - 1, 1)] = values[indices]
        widened.append(filled)
    return (times, *widened)


def read_latencies_ms(source: MessageSource) -> tuple[float, ...]:
    """Return the latencies (ms) from the exposure to the newest message of each processing step.

    If a step has no message, its latency is NaN. The latency of the arms ends when the command is
    sent.
    """
    missing = float("nan")

    def latency_ms(name: str, kind: type[Message]) -> float:
        entry = source.latest(name, kind)
        return missing if entry is None else 1e-6 * (entry[1].publish_ns - entry[1].source_ns)

    arms = [source.latest(name, ArmState) for name in ("arm_left", "arm_right")]
    sent = [
        1e-6 * (arm[0].command_sent_ns - arm[0].target_source_ns)
        for arm in arms
        if arm is not None and arm[0].target_source_ns and arm[0].command_sent_ns
    ]
    return (
        latency_ms("fingertip", Fingertip),
        latency_ms("sheet_target", SheetTarget),
        latency_ms("soft_body", SoftBody),
        max(sent, default=missing),
        latency_ms("frame", Frame),
    )
