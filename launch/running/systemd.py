"""Write the systemd unit of one host, and notify systemd of the launcher's state (sd_notify)."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.nodes import NodeRole

TEMPLATE = Path(__file__).parent.parent / "systemd" / "flexsheet@.service"
NETWORK = TEMPLATE.with_name("90-flexsheet.conf")
SOFTWARE = Path(__file__).resolve().parents[2]
STATE_FOLDER = Path("/var/lib/flexsheet")
"""The only folder to which the service can write."""
SOCKET_VARIABLE, WATCHDOG_VARIABLE = "NOTIFY_SOCKET", "WATCHDOG_USEC"


def list_bags(plan: ResolvedGraph, host: str) -> Iterator[Path]:
    """Yield the bags that a host's recorders write."""
    for node in plan.nodes_on(host):
        if node.role is NodeRole.RECORDER:
            yield Path(node.parameters["bag"])


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file to write: path, text and mode."""

    path: Path
    text: str
    mode: int = 0o644


def make_files(
    *, launch_file: Path, host: str, user: str, root: Path, flexsheet: Path | None = None
) -> Iterator[SystemFile]:
    """Yield the unit, the settings for TCP and the host's environment file.

    root: root folder of the system; "/" outside of tests.
    flexsheet: path of the command; default: the one beside this Python.
    """
    command = flexsheet or Path(sys.executable).parent / "flexsheet"
    unit = TEMPLATE.read_text()
    for key, value in (
        ("@SOFTWARE@", str(SOFTWARE)),
        ("@USER@", user),
        ("@FLEXSHEET@", str(command)),
    ):
        unit = unit.replace(key, value)
    yield SystemFile(root / "etc/systemd/system/flexsheet@.service", unit)
    yield SystemFile(root / "etc/sysctl.d/90-flexsheet.conf", NETWORK.read_text())
    yield SystemFile(
        root / f"etc/flexsheet/{host}.env",
        f"# Launch file of flexsheet@{host}.service; it must be the same on all hosts.\n"
        f"FLEXSHEET_LAUNCH_FILE={launch_file.resolve()}\n",
    )


def notify_systemd(text: str) -> None:
    """Send a line of sd_notify(3); do nothing if systemd did not request it."""
    address = os.environ.get(SOCKET_VARIABLE)
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as connection:
        connection.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        connection.send(text.encode())


async def beat_watchdog() -> None:
    """Notify systemd three times in each watchdog period, without end."""
    period = os.environ.get(WATCHDOG_VARIABLE)
    if not period:
        return
    while True:
        notify_systemd("WATCHDOG=1")
        await asyncio.sleep(int(period) * 1e-6 / 3.0)
