"""Schedule the commands to an arm.

A command is sent when a target of the sheet arrives. Between targets, commands are sent
periodically.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandScheduler:
    """A scheduler for the commands to one arm.

    period_s: time between periodic commands, which are sent even if no new target of the sheet
        arrives.
    target_period_s: time between targets of the sheet from the planner.
    idle_period_s: time between commands to an idle arm.

    In all methods, `sent_ns` is the time of the last command, or 0 before the first command.
    """

    period_s: float
    target_period_s: float
    idle_period_s: float

    def wait_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the time (s) until the next command may be sent to the arm.

        The minimum time between two commands is half a period.
        """
        since_s = (now_ns - sent_ns) * 1e-9
        return max(0.0, 0.5 * self.period_s - since_s) if sent_ns else 0.0

    def step_s(self, now_ns: int, sent_ns: int) -> float:
        """Return the duration (s) of the motion in the next command: 0.5 to 2 periods."""
        since_s = (now_ns - sent_ns) * 1e-9
        return min(max(since_s, 0.5 * self.period_s), 2.0 * self.period_s)

    def is_due(self, now_ns: int, sent_ns: int, target_ns: int) -> bool:
        """Return whether a periodic command must be sent now.

        target_ns: arrival time of the newest target.

        No periodic command is sent shortly before the next target is due, because the arm would
        still be busy when the target arrives.
        """
        due_s = self.target_period_s - (now_ns - target_ns) * 1e-9
        return self.wait_s(now_ns, sent_ns) == 0.0 and abs(due_s) > 0.5 * self.period_s

    def is_due_when_idle(self, now_ns: int, sent_ns: int) -> bool:
        """Return whether a command to an idle arm must be sent now."""
        return not sent_ns or (now_ns - sent_ns) * 1e-9 >= self.idle_period_s
