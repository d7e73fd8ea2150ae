"""Define the parameters of an arm's bridge."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.link_drivers import Driver
from flexsheet.nodes.node import NodeParameters
from flexsheet.nodes.parameter_marks import DeviceHost, DevicePort


class ArmBridgeParameters(NodeParameters):
    """Parameters of `arm_bridge`."""

    side: Side = Field(description="arm of the scene that this bridge commands")
    host: DeviceHost = Field(default="127.0.0.1", description="address of the arm's controller")
    port: DevicePort = Field(default=5020, description="port of the arm's controller")
    rate_hz: float = Field(default=140.0, ge=10.0, le=1000.0, description="rate of commands")
    resting_rate_hz: float = Field(
        default=40.0, ge=20.0, le=1000.0, description="rate of commands to an idle arm"
    )
    driver: Driver = Field(default="modbus", description="protocol of the arm's controller")
    timeout_s: Positive | None = Field(
        default=None, description="maximum wait for an answer; null: the driver's default"
    )
    servo_lag_s: NonNegative = Field(
        default=0.03,
        description="lag of the arm behind a command of constant velocity; with "
        "measure_servo_lag, until it is measured",
    )
    measure_servo_lag: bool = Field(
        default=True, description="measure the lag while the arm moves, and use the measured one"
    )
    max_servo_lag_s: Positive = Field(
        default=0.1, description="maximum lag that is measured and used"
    )
    target_period_s: Positive | None = Field(
        default=None,
        description="period of the targets; null: measured, at first the scene's camera's",
    )
    hold_after_s: Positive = Field(
        default=0.02,
        description="lateness of a target or of the other arm, from the end of the trajectory, "
        "after which it decelerates",
    )
    stop_after_s: Positive = Field(
        default=0.1,
        description="lateness of a target or of the other arm, from the end of the trajectory, "
        "after which it stops",
    )
    max_extrapolation_s: Positive = Field(
        default=0.06, description="maximum extrapolation of a target"
    )
    max_tracking_error_rad: Positive = Field(
        default=0.12, description="maximum lag of a measured joint behind its command"
    )
    arming: Literal["manual", "auto"] = Field(
        default="manual",
        description="manual: the operator arms it with `flexsheet arms enable`, at first and after "
        "each stop; auto: it arms itself, only for simulated arms",
    )
