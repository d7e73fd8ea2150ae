"""When an arm is sent its next command: when a target comes, and on an even beat in between."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pace:
    """period_s: of the beat.  target_period_s: after which the next target is due.
    resting_period_s: of the beat of an arm that is not to move, in time for its watchdog.

    sent_ns, in all that follows: when the last command was sent; 0: none was.
    """

    period_s: float
    target_period_s: float
    resting_period_s: float

    def wait_s(self, now_ns: int, sent_ns: int) -> float:
        """How long until half a period has passed since the last command; zero when it has.

        Commands do not follow one another faster: a joint's speed is its step over that time.
        """
        since_s = (now_ns - sent_ns) * 1e-9
        return max(0.0, 0.5 * self.period_s - since_s) if sent_ns else 0.0

    def step_s(self, now_ns: int, sent_ns: int) -> float:
        """The time that a command covers: since the last one, but not after a long silence."""
        since_s = (now_ns - sent_ns) * 1e-9
        return min(max(since_s, 0.5 * self.period_s), 2.0 * self.period_s)

    def is_beat(self, now_ns: int, sent_ns: int, target_ns: int) -> bool:
        """Whether the beat sends a command now; target_ns: when the newest target came.

        Not just before the next target is due, which would have to wait for the arm's answer.
        """
        due_s = self.target_period_s - (now_ns - target_ns) * 1e-9
        return self.wait_s(now_ns, sent_ns) == 0.0 and abs(due_s) > 0.5 * self.period_s

    def is_resting_beat(self, now_ns: int, sent_ns: int) -> bool:
        """Whether an arm that is not to move is sent a command now: no target is waited for."""
        return not sent_ns or (now_ns - sent_ns) * 1e-9 >= self.resting_period_s
