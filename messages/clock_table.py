"""Stamps of other hosts' clocks, put into our own as they arrive.

Downstream of here every stamp is of the own clock: ages, predictions and what is passed on need not
know from where a message came.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from flexsheet.messages.base import Header, Message, stamp_fields
from flexsheet.messages.types import ClockOffset, Clocks

M = TypeVar("M", bound=Message)

MAX_STAMP_AHEAD_NS = 20_000_000
"""By how much clocks that are trusted may at most seem to be ahead of our own."""


class ClockTable:
    """What a host knows of the other hosts' clocks: the newest `Clocks` of its clock node."""

    def __init__(self, clock_id: str) -> None:
        self._own = clock_id
        self._limit_s = 0.0
        self._max_drift = 0.0
        self.offsets: dict[str, ClockOffset] = {}

    def update(self, clocks: Clocks) -> None:
        """Take what the clock node says; what it no longer speaks of is not known any more."""
        self._limit_s, self._max_drift = clocks.max_offset_uncertainty_s, clocks.max_drift_ratio
        self.offsets = {one.clock_id: one for one in clocks.offsets}

    def find_problem(self, clock_id: str, now_ns: int) -> str:
        """Why stamps of a clock cannot be trusted; empty when they can."""
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
            f"clock {clock_id} is known to {1e3 * uncertainty_s:.3g} ms only, "
            f"{1e3 * self._limit_s:.3g} ms are allowed"
        )

    def shift_ns(self, clock_id: str, at_ns: int) -> int | None:
        """What to add to a stamp near `at_ns`, both of that clock, to make it ours; None: unknown.

        at_ns lies where the message was published: what is older by its stamps stays so by as much.
        """
        offset = self.offsets.get(clock_id)
        if offset is None:
            return None
        since_ns = at_ns - offset.offset_ns - offset.at_ns
        drift = offset.drift_ratio
        return -offset.offset_ns - round(since_ns * drift / (1.0 + drift))

    def localize(self, message: M, header: Header, now_ns: int) -> tuple[M, Header, str]:
        """The message and its header with stamps of our clock, and why not to trust them.

        Of a clock that is not measured yet, a message counts as if it had arrived in no time.
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
    """Move the message's instants (fields of type `Stamp`) by a shift; 0 means none and stays."""
    moved = {
        name: max(1, value + shift_ns)
        for name in stamp_fields(type(message))
        if (value := getattr(message, name))
    }
    return message.model_copy(update=moved) if moved else message
