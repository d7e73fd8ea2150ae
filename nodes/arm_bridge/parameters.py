"""Define the parameters of the node `arm_bridge`, which commands one arm."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.link_drivers import Driver
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import DeviceHost, DevicePort


class ArmBridgeParameters(NodeParameters):
    """The parameters of the node `arm_bridge`, which commands one arm."""

    side: Side = Field(description="arm of the scene that this bridge commands")
    host: DeviceHost = Field(default="127.0.0.1", description="address of the arm's controller")
    port: DevicePort = Field(default=5020, description="port of the arm's controller")
    rate_hz: float = Field(
        default=140.0, ge=10.0, le=1000.0, description="rate of commands to the arm, Hz"
    )
    resting_rate_hz: float = Field(
        default=40.0, ge=20.0, le=1000.0, description="rate of commands to an idle arm, Hz"
    )
    driver: Driver = Field(default="modbus", description="protocol of the arm's controller")
    timeout_s: Positive | None = Field(
        default=None,
        description="maximum time to wait for the arm's answer, s; null: the driver's default "
        "time is used",
    )
    servo_lag_s: NonNegative = Field(
        default=0.03,
        description="lag of the arm behind commands of constant velocity, s. If measure_servo_lag "
        "is true, this is the initial value",
    )
    measure_servo_lag: bool = Field(
        default=True,
        description="whether to measure the arm's lag while it moves, and use the measured value",
    )
    max_servo_lag_s: Positive = Field(
        default=0.1, description="maximum lag of the arm that is measured and used, s"
    )
    target_period_s: Positive | None = Field(
        default=None,
        description="period of the sheet targets, s; null: the period is measured, and its "
        "initial value is the period of the camera in the scene",
    )
    hold_after_s: Positive = Field(
        default=0.02,
        description="delay of a sheet target or of the other arm's state, beyond the end of the "
        "trajectory, after which the arm decelerates, s",
    )
    stop_after_s: Positive = Field(
        default=0.1,
        description="delay of a sheet target or of the other arm's state, beyond the end of the "
        "trajectory, after which the arm stops, s",
    )
    max_extrapolation_s: Positive = Field(
        default=0.06, description="maximum time by which a sheet target is extrapolated, s"
    )
    max_tracking_error_rad: Positive = Field(
        default=0.12,
        description="difference between measured and commanded joint angle above which a fault is "
        "latched, rad",
    )
    arming: Literal["manual", "auto"] = Field(
        default="manual",
        description="manual: the operator enables the arm's motion with `flexsheet arms enable` "
        "after the start and after each stop; auto: the arm is enabled automatically, which is "
        "permitted only for simulated arms",
    )
