"""Tells systemd, where it asks to be told, that all is up and that the launcher still turns."""

from __future__ import annotations

import asyncio
import os
import socket

SOCKET_VARIABLE, WATCHDOG_VARIABLE = "NOTIFY_SOCKET", "WATCHDOG_USEC"


def tell(text: str) -> None:
    """Send a line of sd_notify(3); nothing where nobody asked for it."""
    address = os.environ.get(SOCKET_VARIABLE)
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        notify.send(text.encode())


async def keep_telling() -> None:
    """Three signs of life in the time that systemd allows; for ever."""
    period = os.environ.get(WATCHDOG_VARIABLE)
    if not period:
        return
    while True:
        tell("WATCHDOG=1")
        await asyncio.sleep(int(period) * 1e-6 / 3.0)
