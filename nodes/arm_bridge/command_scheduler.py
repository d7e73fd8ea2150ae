"""Schedule an arm's commands: one when a target arrives, and periodic ones in between."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandScheduler:
    """Schedule of an arm's commands.

    period_s: period of periodic commands.  target_period_s: period of targets.
    idle_period_s: period of commands to an idle arm, short enough for its watchdog.
    In all methods, sent_ns is the time of the last command, or 0 before the first.
    """

    period_s: float
    target_period_s: float
    idle_period_s: float

    def wait_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the time until half a period has passed since the last command.

        Commands are never closer together, since a step in a shorter time would be too fast.
        """
        since_s = (now_ns - sent_ns) * 1e-9
        return max(0.0, 0.5 * self.period_s - since_s) if sent_ns else 0.0

    def step_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the duration of the motion that a command covers: half a period to two periods."""
        since_s = (now_ns - sent_ns) * 1e-9
        return min(max(since_s, 0.5 * self.period_s), 2.0 * self.period_s)

    def is_due(self, now_ns: int, sent_ns: int, target_ns: int) -> bool:
        """Return whether to send a periodic command now; target_ns: arrival of the newest target.

        None is sent shortly before the next target, which would have to wait for its answer.
        """
        due_s = self.target_period_s - (now_ns - target_ns) * 1e-9
        return self.wait_s(now_ns, sent_ns) == 0.0 and abs(due_s) > 0.5 * self.period_s

    def is_due_when_idle(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether to send a command to an idle arm now."""
        return not sent_ns or (now_ns - sent_ns) * 1e-9 >= self.idle_period_s
