"""Publish the force between finger and sheet that a force gauge measures."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar, Literal

from pydantic import ConfigDict, Field

from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import Finite, NonNegative, Positive
from flexsheet.messages.types import Force, ForceAxis, ForceReason
from flexsheet.nodes.gauge.serial_gauge import GaugeError, SerialGauge
from flexsheet.nodes.node import Node, NodeParameters, Output, periodic
from flexsheet.nodes.parameter_marks import DeviceFile


class SerialSource(LimitedModel):
    """A source of forces: a gauge at a serial port that sends one line of text per measurement."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["serial"] = "serial"
    port: DeviceFile = Field(description="path of the port, such as /dev/ttyUSB0")
    baud: int = Field(default=9600, description="rate of the serial port, bits per second")


class GaugeParameters(NodeParameters):
    source: SerialSource
    axis: ForceAxis = Field(
        default="sheet_normal", description="component that the gauge measures; see topic `force`"
    )
    newtons_per_unit: Finite = Field(
        default=1.0,
        description="force per displayed unit, N; negative if a positive reading means a pull",
    )
    zero_units: Finite = Field(
        default=0.0,
        description="reading without contact, in displayed units; it is subtracted from each "
        "reading",
    )
    standard_deviation_n: NonNegative = Field(
        default=0.02, description="standard deviation of noise and calibration error, N"
    )
    max_force_n: Positive = Field(default=20.0, description="measuring range of the gauge, N")
    delay_s: NonNegative = Field(
        default=0.0,
        description="time from a measurement to its arrival, including the gauge's filter, s",
    )
    silence_s: Positive = Field(
        default=1.0, description="time without a reading after which the force is invalid, s"
    )
    watch_hz: Positive = Field(
        default=2.0,
        description="rate at which missing readings and a lost connection are checked, Hz",
    )


class Gauge(Node):
    """A node that publishes each reading of a force gauge with the time of its measurement."""

    opens_devices: ClassVar[bool] = True
    parameters: GaugeParameters
    force: Output[Force]

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it reads a device; the bag contains its readings as the topic force"

    async def setup(self) -> None:
        self._reader: SerialGauge | None = None
        self._last_ns = self.clock.now_ns()
        self._last_n = 0.0
        self._problem = ""
        self._open()

    async def close(self) -> None:
        self._drop()

    def _open(self) -> None:
        source = self.parameters.source
        try:
            self._reader = SerialGauge(source.port, source.baud)
        except GaugeError as error:
            self._report(error)
            return
        self._problem = ""
        asyncio.get_running_loop().add_reader(self._reader.fileno(), self._read)

    def _drop(self) -> None:
        if self._reader is not None:
            asyncio.get_running_loop().remove_reader(self._reader.fileno())
            self._reader.close()
        self._reader = None

    def _report(self, error: GaugeError) -> None:
        self.note = f"no gauge: {error}"
        if str(error) != self._problem:
            self._problem = str(error)
            self.report_error("source", error)

    def _read(self) -> None:
        if self._reader is None:
            return
        try:
            values = self._reader.read()
        except GaugeError as error:
            self._drop()
            self._report(error)
            return
        given = self.parameters
        for value in values:
            self._last_n = given.newtons_per_unit * (value - given.zero_units)
            self._last_ns = self.clock.now_ns()
            within = abs(self._last_n) <= given.max_force_n
            self._publish("ok" if within else "overload", round(1e9 * given.delay_s))
        if self._reader.unreadable:
            self.note = f"the gauge has sent {self._reader.unreadable} lines without a number"

    def _publish(self, reason: ForceReason, age_ns: int) -> None:
        self.force.publish(
            Force(
                source="gauge",
                axis=self.parameters.axis,
                valid=reason == "ok",
                reason=reason,
                force_n=self._last_n,
                standard_deviation_n=self.parameters.standard_deviation_n,
            ),
            source_ns=self.clock.now_ns() - age_ns,
        )

    @periodic("watch_hz")
    def watch(self) -> None:
        """Reopen a disconnected gauge, and publish an invalid force while no readings arrive."""
        if self._reader is None:
            self._open()
        if self.clock.now_ns() - self._last_ns > 1e9 * self.parameters.silence_s:
            self._publish("no_reading", 0)
