"""Create the driver of an arm's controller by its name in a launch file."""

from __future__ import annotations

from typing import Any, Literal

from flexsheet.nodes.arm_bridge.lines import LineLink
from flexsheet.nodes.arm_bridge.link import ArmLink
from flexsheet.nodes.arm_bridge.modbus import ModbusLink
from flexsheet.nodes.arm_bridge.mxt import MxtLink

Driver = Literal["modbus", "mxt", "lines"]

TCP_DRIVERS: frozenset[Driver] = frozenset({"modbus", "lines"})
"""The drivers whose controllers listen for TCP connections, which `flexsheet doctor` checks."""

_LINKS: dict[Driver, Any] = {"modbus": ModbusLink, "mxt": MxtLink, "lines": LineLink}


def make_link(
    driver: Driver, host: str, port: int, timeout_s: float | None, *, with_currents: bool = False
) -> ArmLink:
    """Make the link to an arm, without opening a connection.

    timeout_s: maximum time to wait for an answer; None: the driver's default.
    with_currents: whether to request the motor currents, which only MXT reports.
    """
    options: dict[str, Any] = {} if timeout_s is None else {"timeout_s": timeout_s}
    if with_currents:
        options["with_currents"] = True
    link: ArmLink = _LINKS[driver](host, port, **options)
    return link
