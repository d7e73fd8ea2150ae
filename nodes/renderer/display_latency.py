"""Predict the display time of a frame from the latencies of recent frames."""

from __future__ import annotations

from collections import deque
from statistics import median

HISTORY = 31
"""Frames from which latencies are taken: half a second at 60 Hz, enough to outvote a slow one."""

VSYNC_MARGIN_S = 0.0005
"""A frame drawn this shortly before a swap still makes it."""

ON_TIME_FRACTION = 0.85
"""Fraction of the frames that must make their predicted swap."""


class DisplayLatencyEstimator:
    """Predict the middle of a frame's light from how long drawing and showing took.

    All times are of one clock, ns. Without a window the light begins when the frame is drawn; with
    one, when it was swapped to the front. Where swaps wait for the projector's refresh, the
    prediction is the next swap that the frame makes, counted from the last.
    """

    def __init__(self, *, first_s: float, display_latency_s: float, period_s: float = 0.0) -> None:
        """first_s: from the begin to the middle of the light, until a frame has been measured.

        display_latency_s: from a swap (or the end of drawing) to the middle of its light. period_s:
        of the projector's refresh; 0 when nothing waits for it.
        """
        self._first_ns, self._light_ns = round(first_s * 1e9), round(display_latency_s * 1e9)
        self._period_ns = round(period_s * 1e9)
        self._draws_ns: deque[int] = deque(maxlen=HISTORY)
        self._shows_ns: deque[int] = deque(maxlen=HISTORY)
        self._last_swap_ns = 0

    def predict_light_ns(self, begun_ns: int) -> int:
        """Return the middle of the light of a frame that is begun at `begun_ns`."""
        if not self._shows_ns:
            return begun_ns + self._first_ns
        usual_ns = begun_ns + round(median(self._shows_ns)) + self._light_ns
        if not self._period_ns or not self._last_swap_ns:
            return usual_ns
        ordered = sorted(self._draws_ns)
        draw_ns = ordered[min(int(ON_TIME_FRACTION * len(ordered)), len(ordered) - 1)]
        ready_ns = begun_ns + draw_ns + round(VSYNC_MARGIN_S * 1e9)
        swaps = -(-(ready_ns - self._last_swap_ns) // self._period_ns)
        return self._last_swap_ns + max(swaps, 1) * self._period_ns + self._light_ns

    def record_drawn(self, begun_ns: int, drawn_ns: int) -> int:
        """Record a frame that no window shows, and return the middle of its light."""
        self._draws_ns.append(drawn_ns - begun_ns)
        self._shows_ns.append(drawn_ns - begun_ns)
        return drawn_ns + self._light_ns

    def record_shown(self, begun_ns: int, drawn_ns: int, swapped_ns: int) -> int:
        """Record a frame that was swapped to the front, and return the middle of its light."""
        self._draws_ns.append(drawn_ns - begun_ns)
        self._shows_ns.append(swapped_ns - begun_ns)
        self._last_swap_ns = swapped_ns
        return swapped_ns + self._light_ns

    def is_late(self, light_ns: int, predicted_ns: int) -> bool:
        """Return whether light was later than predicted by more than half a frame."""
        return light_ns - predicted_ns > max(self._period_ns // 2, self._light_ns)
