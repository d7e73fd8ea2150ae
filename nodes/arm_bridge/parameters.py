"""What an arm's bridge is told by the launch file."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flexsheet.messages.methods import KinematicsMethod
from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.link_drivers import Driver
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import DeviceHost, DevicePort


class ArmBridgeParameters(NodeParameters):
    side: Side
    host: DeviceHost = "127.0.0.1"
    port: DevicePort = 5020
    rate_hz: float = Field(default=140.0, ge=10.0, le=1000.0)
    resting_rate_hz: float = Field(
        default=40.0, ge=20.0, le=1000.0, description="while idle, until it is made ready"
    )
    driver: Driver = "modbus"
    timeout_s: Positive | None = Field(default=None, description="null: the driver's own")
    servo_lag_s: NonNegative = Field(
        default=0.03, description="how far the arm trails a command that moves evenly"
    )
    target_period_s: Positive | None = Field(
        default=None, description="older than that is late; null: the period of the scene's camera"
    )
    hold_after_s: Positive = 0.02
    stop_after_s: Positive = 0.1
    furthest_extrapolation_s: Positive = 0.06
    largest_lag_rad: Positive = 0.12
    kinematics: KinematicsMethod | Literal["auto"] = Field(
        default="auto", description="auto: as the scene's methods say, else closed_form_continuous"
    )
    arming: Literal["by_command", "by_itself"] = Field(
        default="by_command",
        description="whether a person must say that it may move (flexsheet arms ready), at first "
        "and after each stop; by_itself is for simulated arms",
    )
