"""Simulate arm controllers with Mitsubishi's real-time external control (MXT) over UDP.

This module was written from `docs/mxt.md` only. It shares no code with the bridge (the node that
sends commands to an arm), because it is used to test the bridge. The simulated controller executes
the robot program `Mxt 1,1,<filter>`. The rules by which a real controller rejects packets are only
partly known, so the simulated controller is stricter. It sends no answer after its program has
ended.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable

import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.twin.arms import (
    CONTROLLER_CYCLE_S,
    JITTER_STREAM,
    LATE_S,
    RV_1A_MECHANICS,
    ArmMechanics,
    Fault,
    Servo,
)

Address = tuple[str, int]

_HEAD = struct.Struct("<HHHxx8f2I5HHI")
_MONITOR = struct.Struct("<Hxx8f2I")
_BYTES = 196
_NONE, _MOVE, _END = 0, 1, 255
_JOINTS, _PULSES = (2, 5, 8), 3
_MORE_AT = (64, 108, 152)

FILTER_S = 0.01
"""The time constant (s) of the low-pass filter that the manufacturer recommends for the instruction
`Mxt`."""

FIRST_STEP_RAD = 0.01
"""The maximum difference, for each joint, between the first set-point and the measured angle."""

STEP_CYCLES = 2.0
"""The maximum step between set-points, as a multiple of the distance that a joint moves at full
speed in one cycle."""


class MxtError(FlexsheetError):
    """Raised if a command is invalid. The error ends the simulated controller's robot program."""


class MxtController:
    """A simulated controller of one arm that answers one packet per cycle.

    An error ends the robot program. Then the arm brakes, and the controller answers no packet until
    `restart` is called. The errors are:

    - a motion command before a packet that only requests the state
    - an unknown command or data type
    - joint angles outside the allowed range
    - a first set-point that is far from the measured joint angles
    - a jump of the set-point
    - no packet for `timeout_s`

    servo_lag_s, backlash_rad: time lag of the joint servos, and backlash of the gears.
    noise_rad: standard deviation of the measured joint angles.
    filter_s: time constant of the low-pass filter on set-points.
    restart_after_s: time after which the program restarts automatically.
    cycle_s, cycle_jitter_s: mean and standard deviation of the cycle's duration.
    latency_s: time from the arrival of a set-point until the set-point takes effect.
    """

    def __init__(
        self,
        joints_rad: Floats,
        *,
        servo_lag_s: float,
        filter_s: float,
        noise_rad: float,
        timeout_s: float,
        backlash_rad: float = 0.0,
        restart_after_s: float = math.inf,
        cycle_s: float = CONTROLLER_CYCLE_S,
        cycle_jitter_s: float = 0.0,
        latency_s: float = 0.0,
        mechanics: ArmMechanics = RV_1A_MECHANICS,
        seed: int = 0,
    ) -> None:
        self.servo = Servo(
            np.array(joints_rad, dtype=np.float64), servo_lag_s, backlash_rad, mechanics
        )
        self.fault: Fault = "none"
        self.error = ""
        self.commands = 0
        self.refused = 0
        self.wanted_rad = self.servo.joints_rad.copy()
        self.answers: list[tuple[bytes, Address]] = []
        self._filtered_rad = self.wanted_rad
        self._cycle_s, self._cycle_jitter_s, self._latency_s = cycle_s, cycle_jitter_s, latency_s
        self._next_cycle_s = cycle_s
        self._jitter = np.random.default_rng((seed, JITTER_STREAM))
        self._filter_share = 1.0 - math.exp(-cycle_s / filter_s) if filter_s else 1.0
        # Clients send at the period of the protocol, even if the controller's cycle is shorter.
        self._max_step_rad = (
            STEP_CYCLES * mechanics.speed_rad_per_s * max(cycle_s, CONTROLLER_CYCLE_S)
        )
        self._timeout_cycles = round(timeout_s / cycle_s)
        self._restart_cycles = restart_after_s / cycle_s
        self._noise_rad = noise_rad
        self._random = np.random.default_rng(seed)
        self._into_cycle_s = 0.0
        self._waiting: tuple[bytes, Address] | None = None
        self._late: list[tuple[int, Floats]] = []
        self._cycles = self._failed_at = 0
        self.restart()

    def restart(self) -> None:
        """Clear the error and restart the robot program."""
        self.error = ""
        self._master: Address | None = None
        self._moved = False
        self._count = self._timeouts = self._missing = 0

    def receive_command(self, packet: bytes, sender: Address) -> None:
        """Store a packet for the next cycle; a newer packet replaces it.

        Packets with a wrong length are ignored. While a sender has control, packets from other
        senders are also ignored.
        """
        if len(packet) != _BYTES or (self._master not in (None, sender)):
            self.refused += 1
        elif not self.error:
            self._waiting = packet, sender

    @property
    def waits(self) -> bool:
        """Return whether a packet has arrived that the next cycle will process."""
        return self._waiting is not None

    def until_cycle_s(self) -> float:
        """Return the time (s) until the next cycle begins."""
        return self._next_cycle_s - self._into_cycle_s

    def advance(self, duration_s: float) -> None:
        """Simulate the motion for `duration_s`, and append the new answers to `answers`."""
        while duration_s >= self.until_cycle_s():
            duration_s -= self.until_cycle_s()
            self._move_on(self.until_cycle_s())
            self._into_cycle_s = 0.0
            if self._cycle_jitter_s:
                late_s = self._cycle_jitter_s * float(self._jitter.standard_normal())
                self._next_cycle_s = max(self._cycle_s + late_s, 0.1 * self._cycle_s)
            self._cycle()
        self._move_on(duration_s)
        self._into_cycle_s += duration_s

    def _move_on(self, duration_s: float) -> None:
        if duration_s > 0.0 and self.fault != "frozen":
            self.servo.advance(self._filtered_rad, duration_s, braking=bool(self.error))

    def _cycle(self) -> None:
        self._cycles += 1
        packet, self._waiting = self._waiting, None
        if self.error:
            if self._cycles - self._failed_at >= self._restart_cycles:
                self.restart()
        elif packet is not None:
            self._missing = 0
            self._obey(*packet)
        elif self._master is not None:
            self._timeouts = (self._timeouts + 1) & 0xFFFF
            self._missing += 1
            if self._missing > self._timeout_cycles:
                self._fail(f"no packet arrived in {self._timeout_cycles} cycles")
        wanted = self._acting()
        self._filtered_rad = self._filtered_rad + self._filter_share * (wanted - self._filtered_rad)

    def _acting(self) -> Floats:
        """Return the set-point (6,), rad, that takes effect in the current cycle."""
        late_s = self._latency_s + (LATE_S if self.fault == "lagging" else 0.0)
        if not late_s:
            self._late.clear()
            return self.wanted_rad
        self._late.append((self._cycles, self.wanted_rad))
        while len(self._late) > 1 and self._late[1][0] <= self._cycles - late_s / self._cycle_s:
            self._late.pop(0)
        return self._late[0][1]

    def _obey(self, packet: bytes, sender: Address) -> None:
        command, send_type, receive_type, *data = _HEAD.unpack_from(packet)
        if command == _NONE:
            self._stay(sender)
        elif command == _MOVE:
            try:
                self._move(send_type, np.array(data[:8]))
            except MxtError as error:
                self._fail(str(error))
                return
        elif command == _END:
            self.restart()
            return
        else:
            self._fail(f"the packet has the unknown command {command}")
            return
        self.commands += 1
        if self.fault != "repeated":
            self._count = (self._count + 1) & 0xFFFFFFFF
        if self.fault != "silent":
            self.answers.append((self._answer(command, receive_type, packet), sender))

    def _stay(self, sender: Address) -> None:
        """Stop the arm at its present joint angles, after a packet that only requests the state.

        The next set-point counts as the first, and must therefore agree with the measured joint
        angles.
        """
        self._master = sender
        if self._moved:
            self.wanted_rad = self._filtered_rad = self.servo.joints_rad.copy()
            self._moved = False

    def _move(self, send_type: int, data: Floats) -> None:
        """Check and store a set-point. Raises MxtError if the set-point is invalid."""
        if self._master is None:
            raise MxtError("a move command came before a packet that only requests the state")
        before = self.wanted_rad if self._moved else self.servo.joints_rad
        joints = self._set_point(send_type, data)
        step = np.abs(joints - before)
        if not self._moved and step.max() > FIRST_STEP_RAD:
            raise MxtError(
                f"the first set-point differs by more than {FIRST_STEP_RAD:g} rad from the "
                "measured joint angles"
            )
        if (step > self._max_step_rad).any():
            raise MxtError("the step from the previous set-point is too large")
        self._moved, self.wanted_rad = True, joints

    def _set_point(self, send_type: int, data: Floats) -> Floats:
        """Decode the set-point (6,), rad, of a packet. Raises MxtError if it is invalid."""
        if send_type != _JOINTS[0]:
            raise MxtError(f"the set-point has the unknown data type {send_type}")
        if not np.isfinite(data).all():
            raise MxtError("the set-point contains a number that is not finite")
        if not self.servo.mechanics.is_in_range(data[:6]):
            raise MxtError("the set-point contains joint angles outside the allowed range")
        return data[:6]

    def _fail(self, why: str) -> None:
        self.error, self._failed_at = why, self._cycles
        self.refused += 1
        self.wanted_rad = self.servo.joints_rad.copy()

    def _answer(self, command: int, wanted_type: int, packet: bytes) -> bytes:
        found, *numbers = self._monitor(wanted_type)
        if self.fault == "exception":
            found = _PULSES
        whole = _HEAD.pack(command, found, found, *numbers, *([0] * 5), self._timeouts, self._count)
        for at in _MORE_AT:
            (wanted,) = struct.unpack_from("<H", packet, at)
            whole += _MONITOR.pack(*self._monitor(wanted))
        return whole[:-4] if self.fault == "bad_crc" else whole

    def _monitor(self, wanted_type: int) -> tuple[float, ...]:
        """Return the fields of an answer that contain the requested state of the arm.

        The fields are a data type, eight numbers and two flags. The data type is 0 if the requested
        quantity is not available.
        """
        if wanted_type in _JOINTS:
            joints = self._seen(_JOINTS.index(wanted_type))
            return (wanted_type, *joints, 0.0, 0.0, 0, 0)
        return (0, *([0.0] * 8), 0, 0)

    def _seen(self, what: int) -> Floats:
        """Return one of three kinds of joint angles (6,), rad, for an answer to the client.

        what: 0 for the set-point, 1 for the filtered set-point, 2 for the measured angles.
        """
        noise = self._noise_rad * self._random.standard_normal(6)
        return (self.wanted_rad, self._filtered_rad, self.servo.joints_rad + noise)[what]


class MxtServer:
    """A UDP server that passes packets from clients to a simulated controller."""

    def __init__(
        self, controller: MxtController, *, host: str, port: int, before: Callable[[], None]
    ) -> None:
        """Store the settings. The method `start` opens the port.

        before: function that is called before each packet is processed and before each cycle. It
            must call `controller.advance` to advance the simulated controller to the present time.
        """
        self.controller = controller
        self._address = (host, port)
        self._before = before
        self._transport: asyncio.DatagramTransport | None = None
        self._due: asyncio.TimerHandle | None = None

    async def start(self) -> None:
        """Start the server. Raises OSError if the port is in use."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(
            lambda: _Packets(self._received), local_addr=self._address
        )

    @property
    def port(self) -> int:
        """Return the network port of the server.

        If the configured port is 0, the system chooses a free port.
        """
        if self._transport is None:
            raise RuntimeError("the server of the simulated arm is not started; call start() first")
        return int(self._transport.get_extra_info("sockname")[1])

    async def stop(self) -> None:
        if self._due is not None:
            self._due.cancel()
        if self._transport is not None:
            self._transport.close()
        self._due = self._transport = None

    def _received(self, packet: bytes, sender: Address) -> None:
        self._before()
        self.controller.receive_command(packet, sender)
        self._wait_for_cycle()

    def _wait_for_cycle(self) -> None:
        if self._due is None:
            loop = asyncio.get_running_loop()
            self._due = loop.call_later(self.controller.until_cycle_s(), self._flush)

    def _flush(self) -> None:
        self._due = None
        self._before()
        answers, self.controller.answers = self.controller.answers, []
        late_s = LATE_S if self.controller.fault == "slow" else 0.0
        for packet, sender in answers:
            asyncio.get_running_loop().call_later(late_s, self._send, packet, sender)
        if self.controller.waits:
            self._wait_for_cycle()

    def _send(self, packet: bytes, sender: Address) -> None:
        if self._transport is not None:
            self._transport.sendto(packet, sender)


class _Packets(asyncio.DatagramProtocol):
    def __init__(self, received: Callable[[bytes, Address], None]) -> None:
        self._received = received

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._received(data, addr)
