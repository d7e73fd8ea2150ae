"""Which of several methods answers: the best, as long as it is in time."""

from __future__ import annotations

from collections.abc import Sequence

LATE_STEPS = 5
"""So many late answers running make the method change."""
TRIED_AGAIN_STEPS = 600
"""After so many answers by another one the best is tried again."""
SMOOTHING = 0.1


class Pace:
    """Follows how long answers take, and names the method to use."""

    def __init__(self, names: Sequence[str], budget_s: float) -> None:
        """names: best first; budget_s: what an answer may take."""
        self._names, self._budget = tuple(names), budget_s
        self._mean: dict[str, float] = {}
        self._late, self._since = 0, 0
        self.name = self._names[0]

    @property
    def dropped(self) -> bool:
        """Whether another than the best is used, because that was late."""
        return self.name != self._names[0]

    def took(self, seconds: float) -> bool:
        """Tell how long an answer took; True if the method changes with that."""
        mean = self._mean.get(self.name, seconds)
        self._mean[self.name] = mean + SMOOTHING * (seconds - mean)
        self._late = self._late + 1 if seconds > self._budget else 0
        self._since += 1
        chosen = self.name
        if self._late >= LATE_STEPS:
            # one that was never tried may be quick
            chosen = min(self._names, key=lambda name: self._mean.get(name, 0.0))
        elif self.dropped and self._since >= TRIED_AGAIN_STEPS:
            chosen = self._names[0]
            self._mean.pop(chosen, None)
        if self._late >= LATE_STEPS or chosen != self.name:
            self._late, self._since = 0, 0
        changed = chosen != self.name
        self.name = chosen
        return changed
