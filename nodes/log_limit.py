"""Limit the number of times that the log of a node repeats a warning or an error."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

import structlog

LIMITED_LEVELS = {"warning", "error", "critical"}
REPORT_PERIOD_S = 60.0
MAX_DISTINCT = 1000
"""The maximum number of distinct log records that are counted. If there are more, the least recent
record is forgotten."""

_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_IGNORED_KEYS = {"exc_info", "count"}

Record = MutableMapping[str, Any]
Key = tuple[tuple[str, str], ...]


@dataclass(slots=True)
class Repeats:
    """The number of occurrences of a log record, and the time (s) at which it was last logged."""

    count: int = 0
    logged_s: float = float("-inf")


class RepeatLimiter:
    """A structlog processor that passes only the 1st, 10th, 100th and so on of equal log records.

    In addition, one repeated record passes every REPORT_PERIOD_S seconds. Records that differ only
    in numbers count as equal. In each repeated record that passes, `count` is the number of
    occurrences since the start of the node.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._repeats: OrderedDict[Key, Repeats] = OrderedDict()

    def __call__(self, logger: Any, method: str, record: Record) -> Record:
        if method not in LIMITED_LEVELS:
            return record
        repeats = self._count_repeats(record)
        repeats.count += 1
        now_s = self._now_s()
        if not _is_power_of_ten(repeats.count) and now_s < repeats.logged_s + REPORT_PERIOD_S:
            raise structlog.DropEvent
        repeats.logged_s = now_s
        if repeats.count > 1:
            record["count"] = repeats.count
        return record

    def _count_repeats(self, record: Record) -> Repeats:
        key = tuple(
            (name, _NUMBER.sub("#", str(value)))
            for name, value in sorted(record.items())
            if name not in _IGNORED_KEYS
        )
        repeats = self._repeats.setdefault(key, Repeats())
        self._repeats.move_to_end(key)
        if len(self._repeats) > MAX_DISTINCT:
            self._repeats.popitem(last=False)
        return repeats


def _is_power_of_ten(count: int) -> bool:
    return int(f"1{'0' * (len(str(count)) - 1)}") == count
