"""The drivers to choose from, by the name that a launch file gives."""

from __future__ import annotations

from typing import Literal

from flexsheet.nodes.arm_bridge.link import ArmLink
from flexsheet.nodes.arm_bridge.modbus import ModbusLink
from flexsheet.nodes.arm_bridge.mxt import MxtLink

Driver = Literal["modbus", "mxt", "mxt_pose"]


def link_for(driver: Driver, host: str, port: int, timeout_s: float | None) -> ArmLink:
    """An arm's link, not yet open; timeout_s None: the driver's own."""
    given = {} if timeout_s is None else {"timeout_s": timeout_s}
    if driver == "modbus":
        return ModbusLink(host, port, **given)
    return MxtLink(host, port, poses=driver == "mxt_pose", **given)
