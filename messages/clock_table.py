"""Convert the timestamps of messages from other hosts to the local clock.

After the conversion, ages and predictions do not depend on the host that sent the message.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from flexsheet.messages.base import Header, Message, find_stamp_fields
from flexsheet.messages.types import ClockOffset, Clocks

M = TypeVar("M", bound=Message)

MAX_STAMP_AHEAD_NS = 20_000_000
"""The maximum time (ns) by which a timestamp of another clock may be in the future."""


class ClockTable:
    """A table of the offsets between the clocks of other hosts and the local clock.

    The offsets are taken from the newest `Clocks` message.
    """

    def __init__(self, clock_id: str) -> None:
        self._own = clock_id
        self._limit_s = 0.0
        self._max_drift = 0.0
        self.offsets: dict[str, ClockOffset] = {}

    def update(self, clocks: Clocks) -> None:
        """Replace all offsets by the offsets in a new message of the clock node."""
        self._limit_s, self._max_drift = clocks.max_offset_uncertainty_s, clocks.max_drift_ratio
        self.offsets = {one.clock_id: one for one in clocks.offsets}

    def find_problem(self, clock_id: str, now_ns: int) -> str:
        """Return the reason why the offset of a clock is too inaccurate, or "" if it is accurate.

        now_ns: current time on the local clock.
        """
        if clock_id == self._own:
            return ""
        offset = self.offsets.get(clock_id)
        if offset is None:
            return f"clock {clock_id} is not measured"
        aged_s = self._max_drift * max(0, now_ns - offset.at_ns) * 1e-9
        uncertainty_s = offset.uncertainty_s + aged_s
        if uncertainty_s <= self._limit_s:
            return ""
        return (
            f"clock {clock_id} has an uncertainty of {1e3 * uncertainty_s:.3g} ms, "
            f"{1e3 * self._limit_s:.3g} ms are allowed"
        )

    def shift_ns(self, clock_id: str, at_ns: int) -> int | None:
        """Return the time (ns) to add to a timestamp to convert it to the local clock.

        Return None if the offset of the clock is unknown. All timestamps of a message get the same
        shift, which preserves their differences.

        at_ns: time when the message was published, on the clock `clock_id`.
        """
        offset = self.offsets.get(clock_id)
        if offset is None:
            return None
        since_ns = at_ns - offset.offset_ns - offset.at_ns
        drift = offset.drift_ratio
        return -offset.offset_ns - round(since_ns * drift / (1.0 + drift))

    def localize(self, message: M, header: Header, now_ns: int) -> tuple[M, Header, str]:
        """Convert the timestamps of a message and its header to the local clock.

        Return the message, the header, and the reason why the conversion is too inaccurate ("" if
        it is accurate). If the offset of the message's clock is unknown, the publication time is
        assumed to be the time of arrival `now_ns`.
        """
        clock_id = header.clock_id
        if clock_id == self._own:
            return message, header, ""
        shift_ns = self.shift_ns(clock_id, header.publish_ns)
        if shift_ns is None:
            shift_ns = now_ns - header.publish_ns
        return (
            shift_stamps(message, shift_ns),
            replace(
                header,
                source_ns=max(0, header.source_ns + shift_ns),
                publish_ns=max(0, header.publish_ns + shift_ns),
                clock_id=self._own,
            ),
            self.find_problem(clock_id, now_ns),
        )


def shift_stamps(message: M, shift_ns: int) -> M:
    """Return a copy of a message in which `shift_ns` was added to each timestamp.

    A timestamp of 0, which means no timestamp, remains 0.
    """
    moved = {
        name: max(1, value + shift_ns)
        for name in find_stamp_fields(type(message))
        if (value := getattr(message, name))
    }
    return message.model_copy(update=moved) if moved else message
