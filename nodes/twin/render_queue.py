"""Queue the frames that the simulated eye renders."""

from __future__ import annotations

from typing import Generic, TypeVar

Key = tuple[str, ...]
"""The label, correction method and viewpoint of a frame. They identify a rendering job."""

J = TypeVar("J")


class RenderQueue(Generic[J]):
    """A queue of rendering jobs in order of arrival, without repeated jobs.

    max_length: maximum number of waiting jobs.
    min_interval_s: minimum time before a job with the same key is rendered again.
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
        """Return whether the queue is full."""
        return len(self._jobs) >= self._max_length

    def is_known(self, key: Key, now_ns: int) -> bool:
        """Return whether a job with this key is waiting or was rendered within `min_interval_s`."""
        if key in self._jobs:
            return True
        return key in self._recent_ns and self._is_recent(self._recent_ns[key], now_ns)

    def _is_recent(self, at_ns: int, now_ns: int) -> bool:
        return now_ns - at_ns < self._min_interval_s * 1e9

    def reject(self, key: Key) -> bool:
        """Record that the full queue rejected a job.

        Returns True if this is the first rejected job with this key.
        """
        is_new = key not in self._rejected
        self._rejected.add(key)
        return is_new

    def add(self, key: Key, job: J) -> None:
        """Append a job to the queue, or replace the waiting job with the same key."""
        self._jobs[key] = job

    def next(self) -> tuple[Key, J]:
        """Return the key of the oldest job, and the job. The job remains in the queue."""
        return next(iter(self._jobs.items()))

    def finish(self, key: Key, now_ns: int) -> None:
        """Remove a rendered job from the queue, and store `now_ns` as its rendering time."""
        self._jobs.pop(key, None)
        self._rejected.discard(key)
        self._recent_ns[key] = now_ns
        self._recent_ns = {
            one: at_ns for one, at_ns in self._recent_ns.items() if self._is_recent(at_ns, now_ns)
        }

    def clear(self) -> None:
        """Remove all waiting jobs."""
        self._jobs.clear()
