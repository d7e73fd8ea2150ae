"""How far a long piece of work is, and how much longer it takes."""

from __future__ import annotations

KEPT_S = 1.0
"""Steps that are there so soon were done before, and kept."""
MINUTE_S = 60.0


class Remaining:
    """Reckons the time that is left from what the steps took so far."""

    def __init__(self) -> None:
        self._total = self._last = self._kept = 0
        self._begun_s = 0.0

    def text(self, done: int, total: int, now_s: float) -> str:
        """Such as "40 %, about 3 min left"; done: steps so far, at the time now_s.

        With another total, or fewer steps done than before, something new has begun.
        """
        if total != self._total or done < self._last:
            self._total, self._begun_s = total, now_s
        if now_s - self._begun_s < KEPT_S:
            self._kept = done
        self._last = done
        share = f"{100 * done // total} %"
        if done in (self._kept, total):
            return share
        left_s = (now_s - self._begun_s) / (done - self._kept) * (total - done)
        if left_s < MINUTE_S:
            return f"{share}, about {max(1, round(left_s))} s left"
        return f"{share}, about {round(left_s / MINUTE_S)} min left"
