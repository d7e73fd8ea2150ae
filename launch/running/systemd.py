"""Create the systemd files for one host, and report the launcher's state to systemd (sd_notify)."""

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
"""The only folder to which the systemd service is allowed to write."""
SOCKET_VARIABLE, WATCHDOG_VARIABLE = "NOTIFY_SOCKET", "WATCHDOG_USEC"


def list_bags(plan: ResolvedGraph, host: str) -> Iterator[Path]:
    """Yield the paths of the bag files that the recorders on a host write."""
    for node in plan.nodes_on(host):
        if node.role is NodeRole.RECORDER:
            yield Path(node.parameters["bag"])


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file to install: path, text and permission bits."""

    path: Path
    text: str
    mode: int = 0o644


def make_files(*, launch_file: Path, host: str, user: str, root: Path) -> Iterator[SystemFile]:
    """Yield the systemd unit, the kernel's TCP settings and the environment file of a host.

    root: root folder of the file system, which is "/" except in tests.
    """
    command = Path(sys.executable).parent / "flexsheet"
    unit = TEMPLATE.read_text()
    replaced = {"@SOFTWARE@": str(SOFTWARE), "@USER@": user, "@FLEXSHEET@": str(command)}
    for key, value in replaced.items():
        unit = unit.replace(key, value)
    yield SystemFile(root / "etc/systemd/system/flexsheet@.service", unit)
    yield SystemFile(root / "etc/sysctl.d/90-flexsheet.conf", NETWORK.read_text())
    yield SystemFile(
        root / f"etc/flexsheet/{host}.env",
        f"# Launch file of flexsheet@{host}.service; it must be the same on all hosts.\n"
        f"FLEXSHEET_LAUNCH_FILE={launch_file.resolve()}\n",
    )


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
