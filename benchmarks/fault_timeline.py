"""Record what happens after a fault: lines of the launchers, topics that resume, modes of arms."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Self

from flexsheet.messages.base import Message
from flexsheet.messages.types import ArmState, Fingertip, HostStatus, SheetTarget
from tests.lab import HOSTS, Lab

POLL_S = 0.01
GAP_S = 0.1
"""Silence of a topic after which its next message is an event."""


class FaultTimeline:
    """Recorder of events after a fault; an async context manager.

    events: time (s of the monotonic clock) and text of each event, in the order of their times.
    """

    def __init__(self, lab: Lab) -> None:
        self.events: list[tuple[float, str]] = []
        self._lab = lab
        self._arrived_s: dict[str, float] = {}
        self._states: dict[str, str] = {}
        self._read: dict[str, int] = {}

    async def __aenter__(self) -> Self:
        self._read_logs()
        self.events.clear()
        self._lab.listeners.append(self._on_message)
        self._polling = asyncio.create_task(self._poll_logs())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._lab.listeners.remove(self._on_message)
        self._polling.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._polling
        self._read_logs()

    def describe(self, begun_s: float) -> str:
        """Return the events as lines, with their times after `begun_s`."""
        return "\n".join(
            f"{at_s - begun_s:8.3f} s  {text}" for at_s, text in self.events if at_s >= begun_s
        )

    def _add(self, text: str) -> None:
        self.events.append((time.monotonic(), text))

    def _on_message(self, topic: str, message: Message) -> None:
        if isinstance(message, HostStatus):
            return
        now_s, state = time.monotonic(), ""
        if isinstance(message, ArmState):
            state = f"{message.mode} {message.reason}"
        elif isinstance(message, Fingertip):
            state = f"{message.state} {message.reason}"
        elif isinstance(message, SheetTarget):
            state = f"{message.phase} {message.reason}"
        is_new = now_s - self._arrived_s.get(topic, now_s) > GAP_S
        self._arrived_s[topic] = now_s
        if is_new or state != self._states.get(topic, state):
            self._add(f"{topic}{' resumes' if is_new else ''}: {state}")
        self._states[topic] = state

    async def _poll_logs(self) -> None:
        while True:
            await asyncio.sleep(POLL_S)
            self._read_logs()

    def _read_logs(self) -> None:
        for host in HOSTS:
            directory = self._lab.run_directory(host)
            log = None if directory is None else directory / "logs" / "launch.log"
            if log is None or not log.exists():
                continue
            with log.open("rb") as file:
                file.seek(self._read.get(str(log), 0))
                text = file.read()
            # An incomplete line is read again when it is complete.
            end = text.rfind(b"\n") + 1
            self._read[str(log)] = self._read.get(str(log), 0) + end
            for line in text[:end].decode().splitlines():
                self._add(f"launcher of {host}: {line}")
