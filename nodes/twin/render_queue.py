"""Queue the frames that the simulated eye renders: one per label and correction."""

from __future__ import annotations

from typing import Generic, TypeVar

Key = tuple[str, ...]
"""Label, correction and viewpoint of a frame."""

J = TypeVar("J")


class RenderQueue(Generic[J]):
    """Queue of jobs, which selects the frames that are rendered.

    max_length: number of jobs that may wait.
    min_interval_s: time before the same key is rendered again.
    """

    def __init__(self, max_length: int, min_interval_s: float) -> None:
        self._max_length, self._min_interval_s = max_length, min_interval_s
        self._jobs: dict[Key, J] = {}
        self._recent_ns: dict[Key, int] = {}
        self._rejected: set[Key] = set()

    def __len__(self) -> int:
        return len(self._jobs)

    @property
    def is_full(self) -> bool:
        """Return whether no further job may wait."""
        return len(self._jobs) >= self._max_length

    def is_known(self, key: Key, now_ns: int) -> bool:
        """Return whether a job of the key waits, or was rendered a short time ago."""
        if key in self._jobs:
            return True
        return key in self._recent_ns and self._is_recent(self._recent_ns[key], now_ns)

    def _is_recent(self, at_ns: int, now_ns: int) -> bool:
        return now_ns - at_ns < self._min_interval_s * 1e9

    def reject(self, key: Key) -> bool:
        """Reject a key while the queue is full; True the first time, which is to be reported."""
        is_new = key not in self._rejected
        self._rejected.add(key)
        return is_new

    def add(self, key: Key, job: J) -> None:
        """Append a job, or replace the one of the same key."""
        self._jobs[key] = job

    def next(self) -> tuple[Key, J]:
        """Return the oldest job, which stays in the queue until `finish`."""
        return next(iter(self._jobs.items()))

    def finish(self, key: Key, now_ns: int) -> None:
        """Remove a rendered job."""
        self._jobs.pop(key, None)
        self._rejected.discard(key)
        self._recent_ns[key] = now_ns
        self._recent_ns = {
            one: at_ns for one, at_ns in self._recent_ns.items() if self._is_recent(at_ns, now_ns)
        }

    def clear(self) -> None:
        """Drop all jobs that wait."""
        self._jobs.clear()
