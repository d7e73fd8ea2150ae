"""Choose among several methods: the best one that meets the deadline."""

from __future__ import annotations

from collections.abc import Sequence

LATE_STEPS = 5
"""Number of consecutive late responses that change the method."""
RETRY_STEPS = 600
"""Number of responses of a fallback after which the best method is tried again."""
SMOOTHING = 0.1


class DeadlineFallback:
    """Track how long responses take, and name the method to use."""

    def __init__(self, names: Sequence[str], budget_s: float) -> None:
        """names: best first; budget_s: the maximum duration of a response."""
        self._names, self._budget = tuple(names), budget_s
        self._mean: dict[str, float] = {}
        self._late, self._since = 0, 0
        self.name = self._names[0]

    @property
    def is_fallback(self) -> bool:
        """Return whether another method replaces the best one, because that was late."""
        return self.name != self._names[0]

    def record(self, seconds: float) -> bool:
        """Record the duration of a response; return whether the method changes."""
        mean = self._mean.get(self.name, seconds)
        self._mean[self.name] = mean + SMOOTHING * (seconds - mean)
        self._late = self._late + 1 if seconds > self._budget else 0
        self._since += 1
        chosen = self.name
        if self._late >= LATE_STEPS:
            # A method that was never tried may be quick.
            chosen = min(self._names, key=lambda name: self._mean.get(name, 0.0))
        elif self.is_fallback and self._since >= RETRY_STEPS:
            chosen = self._names[0]
            self._mean.pop(chosen, None)
        if self._late >= LATE_STEPS or chosen != self.name:
            self._late, self._since = 0, 0
        changed = chosen != self.name
        self.name = chosen
        return changed
