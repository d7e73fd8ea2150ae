"""Report the launcher's state to systemd (sd_notify)."""

from __future__ import annotations

import asyncio
import os
import socket

SOCKET_VARIABLE, WATCHDOG_VARIABLE = "NOTIFY_SOCKET", "WATCHDOG_USEC"


def notify_systemd(text: str) -> None:
    """Send a state line to systemd (see sd_notify(3)) if the process runs as a service."""
    address = os.environ.get(SOCKET_VARIABLE)
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        connection.send(text.encode())


async def beat_watchdog() -> None:
    """Reset the systemd watchdog three times per watchdog period, until this task is cancelled."""
    period = os.environ.get(WATCHDOG_VARIABLE)
    if not period:
        return
    while True:
        notify_systemd("WATCHDOG=1")
        await asyncio.sleep(int(period) * 1e-6 / 3.0)
