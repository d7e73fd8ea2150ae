"""Schedule an arm's commands: one when a target arrives, and periodic ones in between."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandScheduler:
    """Schedule of an arm's commands.

    period_s: period of periodic commands.  target_period_s: period of targets.
    idle_period_s: period of commands to an idle arm, short enough for its watchdog.
    sent_ns, in all methods: time of the last command; 0: none.
    """

    period_s: float
    target_period_s: float
    idle_period_s: float

    def wait_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the time until half a period has passed since the last command.

        Commands are never closer together, since a joint's speed is its step over that time.
        """
        since_s = (now_ns - sent_ns) * 1e-9
        return max(0.0, 0.5 * self.period_s - since_s) if sent_ns else 0.0

    def step_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the duration that a command covers: half a period to two periods."""
        since_s = (now_ns - sent_ns) * 1e-9
        return min(max(since_s, 0.5 * self.period_s), 2.0 * self.period_s)

    def is_due(self, now_ns: int, sent_ns: int, target_ns: int) -> bool:
        """Return whether a periodic command is sent now; target_ns: arrival of the newest target.

        No command is sent shortly before the next target, which would have to wait for the answer.
        """
        due_s = self.target_period_s - (now_ns - target_ns) * 1e-9
        return self.wait_s(now_ns, sent_ns) == 0.0 and abs(due_s) > 0.5 * self.period_s

    def is_due_when_idle(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether an idle arm is sent a command now; no target is awaited."""
        return not sent_ns or (now_ns - sent_ns) * 1e-9 >= self.idle_period_s
