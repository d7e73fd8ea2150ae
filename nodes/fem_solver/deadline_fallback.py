"""Select a soft-body method that is fast enough to meet a deadline."""

from __future__ import annotations

from collections.abc import Sequence

LATE_STEPS = 5
"""The number of consecutive late responses after which another method is selected."""
RETRY_STEPS = 600
"""The number of responses of a fallback method after which the best method is tried again."""
SMOOTHING = 0.1
"""The weight of the newest duration in the exponentially smoothed mean duration."""


class DeadlineFallback:
    """A selector of the soft-body method, according to the durations of recent responses."""

    def __init__(self, names: Sequence[str], budget_s: float) -> None:
        """Start with the first method of a list.

        names: names of the methods, in order of decreasing quality. budget_s: maximum duration of a
        response.
        """
        self._names, self._budget = tuple(names), budget_s
        self._mean: dict[str, float] = {}
        self._late, self._since = 0, 0
        self.name = self._names[0]

    @property
    def is_fallback(self) -> bool:
        """Return whether the current method differs from the best method."""
        return self.name != self._names[0]

    def record(self, seconds: float) -> bool:
        """Record the duration of a response, in seconds, and return whether the method changed."""
        mean = self._mean.get(self.name, seconds)
        self._mean[self.name] = mean + SMOOTHING * (seconds - mean)
        self._late = self._late + 1 if seconds > self._budget else 0
        self._since += 1
        chosen = self.name
        if self._late >= LATE_STEPS:
            # A method without measured durations counts as the fastest, so that it is tried.
            chosen = min(self._names, key=lambda name: self._mean.get(name, 0.0))
        elif self.is_fallback and self._since >= RETRY_STEPS:
            chosen = self._names[0]
            self._mean.pop(chosen, None)
        if self._late >= LATE_STEPS or chosen != self.name:
            self._late, self._since = 0, 0
        changed = chosen != self.name
        self.name = chosen
        return changed
