"""Measure the clock offsets of other hosts by pings between the clock nodes of the hosts."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Positive
from flexsheet.messages.types import ClockEcho, ClockOffset, ClockPing, Clocks
from flexsheet.nodes import NodeRole
from flexsheet.nodes.clock.offset import OtherClock, make_sample
from flexsheet.nodes.node import Input, Node, NodeParameters, Output, periodic

MAX_ECHO_AGE_NS = 2_000_000_000
PEER_TIMEOUT_NS = 60_000_000_000


class ClockParameters(NodeParameters):
    """The parameters of the clock node, which the key `clocks` of the launch file defines."""

    rate_hz: Positive = Field(default=8.0, description="rate at which pings are sent, Hz")
    max_offset_uncertainty_s: Positive = Field(
        default=0.005,
        description="maximum uncertainty of a clock offset, s; above it, no arm moves",
    )
    max_drift_ratio: float = Field(
        default=5e-4,
        gt=0,
        lt=0.1,
        description="maximum relative difference between the rates of two clocks",
    )


class ClockNode(Node):
    """A node that exchanges pings with all other clock nodes, and publishes the clock offsets."""

    measures_clocks = True
    role: ClassVar[NodeRole | None] = NodeRole.CLOCK
    parameters: ClockParameters
    clock_ping: Input[ClockPing]
    clock_ping_out: Output[ClockPing]
    clocks: Output[Clocks]

    async def setup(self) -> None:
        self._echoes: dict[str, ClockEcho] = {}
        self._peers: dict[str, OtherClock] = {}

    def on_clock_ping(self, ping: ClockPing, header: Header) -> None:
        if header.clock_id == self.clock.id:
            return
        received_ns = self.clock_ping.received_ns
        other = self._peers.setdefault(header.clock_id, OtherClock(self.parameters.max_drift_ratio))
        self._echoes[header.clock_id] = ClockEcho(
            clock_id=header.clock_id, sent_ns=header.publish_ns, received_ns=received_ns
        )
        for echo in ping.echoes:
            if echo.clock_id == self.clock.id and received_ns - echo.sent_ns < 2 * MAX_ECHO_AGE_NS:
                sample = make_sample(
                    echo.sent_ns,
                    echo.received_ns,
                    header.publish_ns,
                    received_ns,
                    max_drift_ratio=self.parameters.max_drift_ratio,
                )
                if sample is not None:
                    other.add(sample)

    @periodic("rate_hz")
    def ping(self) -> None:
        now_ns = self.clock.now_ns()
        for clock_id, echo in list(self._echoes.items()):
            if echo.received_ns < now_ns - PEER_TIMEOUT_NS:
                del self._echoes[clock_id], self._peers[clock_id]
        echoes = [
            one for one in self._echoes.values() if one.received_ns > now_ns - MAX_ECHO_AGE_NS
        ]
        self.clock_ping_out.publish(ClockPing(echoes=tuple(echoes)))
        offsets = tuple(self._offset(clock_id, now_ns) for clock_id in self._peers)
        self.clocks.publish(
            Clocks(
                max_offset_uncertainty_s=self.parameters.max_offset_uncertainty_s,
                max_drift_ratio=self.parameters.max_drift_ratio,
                offsets=tuple(one for one in offsets if one is not None),
            )
        )
        texts = (
            f"clock offset of {one.clock_id}: {one.offset_ns * 1e-9:+.6f} s, "
            f"uncertainty {one.uncertainty_s * 1e3:.3f} ms"
            for one in offsets
            if one is not None
        )
        self.set_note(NoteCode.INFO, ", ".join(texts))

    def _offset(self, clock_id: str, now_ns: int) -> ClockOffset | None:
        other = self._peers[clock_id]
        found = other.estimate(now_ns)
        if found is None:
            return None
        return ClockOffset(
            clock_id=clock_id,
            at_ns=found.at_ns,
            offset_ns=found.offset_ns,
            uncertainty_s=found.half_ns * 1e-9,
            drift_ratio=found.drift_ratio,
            resets=other.resets,
        )
