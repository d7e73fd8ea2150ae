"""Create the driver for an arm's controller from the driver's name in a launch file."""

from __future__ import annotations

from typing import Any, Literal

from flexsheet.nodes.arm_bridge.lines import LineLink
from flexsheet.nodes.arm_bridge.link import ArmLink
from flexsheet.nodes.arm_bridge.modbus import ModbusLink
from flexsheet.nodes.arm_bridge.mxt import MxtLink

Driver = Literal["modbus", "mxt", "lines"]

TCP_DRIVERS: frozenset[Driver] = frozenset({"modbus", "lines"})
"""The drivers for controllers that accept TCP connections. `flexsheet doctor` checks these
connections."""

_LINKS: dict[Driver, Any] = {"modbus": ModbusLink, "mxt": MxtLink, "lines": LineLink}


def make_link(driver: Driver, host: str, port: int, timeout_s: float | None) -> ArmLink:
    """Create the link to an arm, without opening a connection.

    timeout_s: maximum time to wait for an answer; None means the driver's default.
    """
    options: dict[str, Any] = {} if timeout_s is None else {"timeout_s": timeout_s}
    link: ArmLink = _LINKS[driver](host, port, **options)
    return link
