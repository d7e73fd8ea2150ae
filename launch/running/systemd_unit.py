"""The systemd unit of one host: its text, and where it and what belongs to it is put."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.nodes import NodeRole

TEMPLATE = Path(__file__).parent.parent / "systemd" / "flexsheet@.service"
NETWORK = TEMPLATE.with_name("90-flexsheet.conf")
SOFTWARE = Path(__file__).resolve().parents[2]


STATE = Path("/var/lib/flexsheet")
"""Where the service may write and what is there stays."""


def list_bags(plan: ResolvedGraph, host: str) -> Iterator[Path]:
    """Where a host's recorders put what they record."""
    for node in plan.nodes_on(host):
        if node.role is NodeRole.RECORDER:
            yield Path(node.parameters["bag"])


@dataclass(frozen=True, slots=True)
class Installed:
    """A file to be written: where, with what, and the mode."""

    path: Path
    text: str
    mode: int = 0o644


def files_of(
    *, launch_file: Path, host: str, user: str, root: Path, flexsheet: Path | None = None
) -> Iterator[Installed]:
    """The unit, settings for TCP and the host's environment.

    root: where the system lies, "/" on a real computer.
    flexsheet: the command; default: the one beside this Python.
    """
    command = flexsheet or Path(sys.executable).parent / "flexsheet"
    unit = TEMPLATE.read_text()
    for key, value in (
        ("@SOFTWARE@", str(SOFTWARE)),
        ("@USER@", user),
        ("@FLEXSHEET@", str(command)),
    ):
        unit = unit.replace(key, value)
    yield Installed(root / "etc/systemd/system/flexsheet@.service", unit)
    yield Installed(root / "etc/sysctl.d/90-flexsheet.conf", NETWORK.read_text())
    yield Installed(
        root / f"etc/flexsheet/{host}.env",
        f"# What flexsheet@{host}.service runs; the file must be the same on all hosts.\n"
        f"FLEXSHEET_LAUNCH_FILE={launch_file.resolve()}\n",
    )
