"""Predict the display time of a frame from the latencies of recent frames."""

from __future__ import annotations

from collections import deque
from statistics import median

HISTORY = 31
"""The number of recent frames from which latencies are computed, half a second at 60 Hz."""

VSYNC_MARGIN_S = 0.0005
"""The minimum time (s) between the end of drawing and the buffer swap that shows the frame."""

ON_TIME_FRACTION = 0.85
"""The fraction of recent frames whose drawing would have ended before the predicted swap (buffer
exchange)."""


class DisplayLatencyEstimator:
    """An estimator of the time at which a frame will be projected.

    The display time (`light_ns`) is the middle of the interval in which the frame is projected. All
    times are in ns and are from the same clock. The display time is a constant latency after the
    swap of the window's buffers. Without a window, it is this latency after the end of drawing. If
    swaps wait for the projector's refresh, the estimator predicts at which refresh the frame will
    be ready.
    """

    def __init__(self, *, first_s: float, display_latency_s: float, period_s: float = 0.0) -> None:
        """Create an estimator without recorded frames.

        first_s: time from the start of drawing to the display time, used for the first frame.
        display_latency_s: time from the swap, or the end of drawing, to the display time. period_s:
        refresh period of the projector; 0 if swaps do not wait for it.
        """
        self._first_ns, self._light_ns = round(first_s * 1e9), round(display_latency_s * 1e9)
        self._period_ns = round(period_s * 1e9)
        self._draws_ns: deque[int] = deque(maxlen=HISTORY)
        self._shows_ns: deque[int] = deque(maxlen=HISTORY)
        self._last_swap_ns = 0

    def predict_light_ns(self, begun_ns: int) -> int:
        """Return the predicted display time (ns) of a frame whose drawing starts at `begun_ns`."""
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
        """Record a frame that was drawn without a window, and return its display time (ns).

        begun_ns, drawn_ns: start and end of drawing.
        """
        self._draws_ns.append(drawn_ns - begun_ns)
        self._shows_ns.append(drawn_ns - begun_ns)
        return drawn_ns + self._light_ns

    def record_shown(self, begun_ns: int, drawn_ns: int, swapped_ns: int) -> int:
        """Record a frame that a window has shown, and return its display time (ns).

        begun_ns, drawn_ns: start and end of drawing. swapped_ns: time of the buffer swap that
        showed the frame.
        """
        self._draws_ns.append(drawn_ns - begun_ns)
        self._shows_ns.append(swapped_ns - begun_ns)
        self._last_swap_ns = swapped_ns
        return swapped_ns + self._light_ns

    def is_late(self, light_ns: int, predicted_ns: int) -> bool:
        """Return whether a frame was displayed too late.

        A frame is too late if its display time exceeds the prediction by more than a tolerance. The
        tolerance is half a refresh period or the display latency, whichever is larger. light_ns,
        predicted_ns: measured and predicted display time.
        """
        return light_ns - predicted_ns > max(self._period_ns // 2, self._light_ns)
