"""Simulate a switch that delays, loses and reorders frames: `python -m tests.switch NAMESPACE...`.

Each namespace gets a TAP device "eth" whose frames pass through this process, so that the kernel's
TCP experiences a bad network. The kernel's netem is not always available. A line of JSON on stdin,
{namespace: {"delay_s", "jitter_s", "loss", "cut"}}, sets its cable from then on.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import selectors
import struct
import sys
import time
from contextlib import suppress
from dataclasses import dataclass

CLONE_NEWNET = 0x40000000
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
FRAME_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class Cable:
    """The properties of a network cable.

    delay_s: delay in one direction.
    jitter_s: standard deviation of the delay. Jitter can reorder frames.
    loss: fraction of lost frames.
    cut: whether all frames are lost.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    cut: bool = False

    def passes(self, chance: random.Random) -> float | None:
        """Return the delay (s) of a frame, or None for a lost frame."""
        if self.cut or chance.random() < self.loss:
            return None
        return max(0.0, chance.gauss(self.delay_s, self.jitter_s))


def open_tap(namespace: str) -> int:
    """Open a TAP device "eth" in a network namespace. This process enters the namespace."""
    space = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(space, CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), f"setns {namespace}")
    os.close(space)
    tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH22x", b"eth", IFF_TAP | IFF_NO_PI))
    return tap


class Switch:
    """A switch that forwards frames between TAP devices after the delays of the cables."""

    def __init__(self, taps: dict[str, int]) -> None:
        self._taps = taps
        self._cables = dict.fromkeys(taps, Cable())
        self._chance = random.Random(7)
        self._waiting: list[tuple[float, int, int, bytes]] = []
        self._number = 0

    def take_order(self, line: bytes) -> None:
        for name, values in json.loads(line).items():
            self._cables[name] = Cable(**values)

    def take_frames(self, source: str) -> None:
        with suppress(BlockingIOError):
            while True:
                frame = os.read(self._taps[source], FRAME_BYTES)
                for name, tap in self._taps.items():
                    if name != source:
                        self._send(frame, (self._cables[source], self._cables[name]), tap)

    def _send(self, frame: bytes, way: tuple[Cable, Cable], tap: int) -> None:
        took = [cable.passes(self._chance) for cable in way]
        if None in took:
            return
        self._number += 1
        due_s = time.monotonic() + sum(one for one in took if one is not None)
        heapq.heappush(self._waiting, (due_s, self._number, tap, frame))

    def hand_out(self) -> float | None:
        """Deliver the frames that are due. Return the time (s) until the next frame, or None."""
        while self._waiting:
            ahead_s = self._waiting[0][0] - time.monotonic()
            if ahead_s > 0.0:
                return ahead_s
            _, _, tap, frame = heapq.heappop(self._waiting)
            # A computer that is not up yet, or takes no more, loses frames as it would really.
            with suppress(OSError):
                os.write(tap, frame)
        return None


def main(namespaces: list[str]) -> None:
    taps = {name: open_tap(name) for name in namespaces}
    switch = Switch(taps)
    events = selectors.DefaultSelector()
    for name, tap in taps.items():
        events.register(tap, selectors.EVENT_READ, name)
    events.register(sys.stdin.buffer, selectors.EVENT_READ, None)
    print("ready", flush=True)
    while True:
        for key, _ in events.select(switch.hand_out()):
            if key.data is not None:
                switch.take_frames(key.data)
                continue
            line = sys.stdin.buffer.raw.readline()  # type: ignore[union-attr]  # never detached
            if not line:
                return
            switch.take_order(line)
            print("done", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
