"""Create the driver of an arm's controller by its name in a launch file."""

from __future__ import annotations

from typing import Literal

from flexsheet.nodes.arm_bridge.link import ArmLink
from flexsheet.nodes.arm_bridge.modbus import ModbusLink
from flexsheet.nodes.arm_bridge.mxt import MxtLink

Driver = Literal["modbus", "mxt"]


def make_link(
    driver: Driver, host: str, port: int, timeout_s: float | None, *, with_currents: bool = False
) -> ArmLink:
    """Create the link to an arm, without opening it; timeout_s None: the driver's default.

    with_currents: whether to request the motor currents, which only MXT reports.
    """
    options = {} if timeout_s is None else {"timeout_s": timeout_s}
    if driver == "modbus":
        return ModbusLink(host, port, **options)
    return MxtLink(host, port, with_currents=with_currents, **options)
