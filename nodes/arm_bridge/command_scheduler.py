"""Schedule an arm's commands: a command when a target arrives, and periodic commands in between."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandScheduler:
    """A schedule of an arm's commands.

    period_s: period of periodic commands.  target_period_s: period of targets.
    idle_period_s: period of commands to an idle arm, short enough for the arm's watchdog.
    In all methods, sent_ns is the time of the last command, or 0 before the first command.
    """

    period_s: float
    target_period_s: float
    idle_period_s: float

    def wait_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the time (s) until half a period has passed since the last command.

        This is the minimum time between commands, because a step in a shorter time is too fast.
        """
        since_s = (now_ns - sent_ns) * 1e-9
        return max(0.0, 0.5 * self.period_s - since_s) if sent_ns else 0.0

    def step_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the duration (s) of the motion that a command covers: 0.5 to 2 periods."""
        since_s = (now_ns - sent_ns) * 1e-9
        return min(max(since_s, 0.5 * self.period_s), 2.0 * self.period_s)

    def is_due(self, now_ns: int, sent_ns: int, target_ns: int) -> bool:
        """Return whether to send a periodic command now.

        target_ns: time of arrival of the newest target.
        No command is sent shortly before the next target is due, because the command for this
        target would have to wait for the answer.
        """
        due_s = self.target_period_s - (now_ns - target_ns) * 1e-9
        return self.wait_s(now_ns, sent_ns) == 0.0 and abs(due_s) > 0.5 * self.period_s

    def is_due_when_idle(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether to send a command to an idle arm now."""
        return not sent_ns or (now_ns - sent_ns) * 1e-9 >= self.idle_period_s
