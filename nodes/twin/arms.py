"""Simulate the arms: Mitsubishi RV-1A manipulators with servo lag behind Modbus TCP servers.

This module was written from `docs/modbus.md` and the dimensions of the arm only. It shares no code
with the bridge (the node that sends commands to an arm), because it serves to test the bridge. The
forward kinematics is a product of exponentials (Brockett 1984; Lynch and Park, Modern Robotics, ch.
4). The inverse kinematics is a Gauss-Newton method on it.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import math
import struct
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, Literal

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from flexsheet.nodes.arrays import Floats

Fault = Literal[
    "none",
    "silent",
    "slow",
    "exception",
    "bad_crc",
    "old_version",
    "repeated",
    "frozen",
    "lagging",
]
"""Faults that a test can switch on in a simulated arm. MXT is the protocol of `mxt_controller.py`.

silent: does not answer.
slow: answers with the delay LATE_S.
exception: answers with a Modbus exception (MXT: with a packet of another data type).
bad_crc: answers with a wrong checksum (MXT: with a truncated packet).
old_version: answers with the version of an older register map.
repeated: repeats the counter of the previous answer.
frozen: answers, but its joints do not move.
lagging: executes commands with the delay LATE_S.
"""

LATE_S = 0.05

# Without this, the library would log whole packets whenever a client disconnects.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

CONTROLLER_CYCLE_S = 0.0071

JITTER_STREAM = 1
"""Second element of the random seed for the jitter of cycles, which makes it independent of the
noise of measured joints."""


def check_loopback(address: str) -> str:
    """Return the address; raises ValueError unless only this computer can reach it.

    The simulated arms have no authentication: they obey any client.
    """
    if not ipaddress.ip_address(address).is_loopback:
        raise ValueError(
            f"{address} is not a loopback address, but any client can move a simulated arm; "
            "use 127.0.0.1"
        )
    return address


# Axes of the joints at joint angles of zero, in the base frame: direction, and a point on the axis.
_AXES = np.array(
    [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], dtype=np.float64
)
_POINTS = np.array(
    [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.55], [-0.09, 0, 0], [-0.09, 0, 0.71], [-0.09, 0, 0]]
)
_FLANGE_AT_ZERO = np.array([-0.09, 0.0, 0.782])

RANGE_RAD = np.radians(
    [[-150, 150], [-60, 120], [60, 155], [-160, 160], [-90, 90], [-200, 200]]
).astype(np.float64)
SPEED_RAD_PER_S = np.radians([180.0, 90.0, 135.0, 180.0, 180.0, 210.0])
ACCELERATION_RAD_PER_S2 = 8.0 * SPEED_RAD_PER_S

_COMMAND = struct.Struct(">HHIIHH6fI")
_STATUS = struct.Struct(">HHIIIHH6fII")
_STATUS_AT = 100
_READ_AND_WRITE = 23
_IDLE, _MOVE, _HOLD, _STOP = range(4)
STATE_IDLE, STATE_MOVING, STATE_HOLDING, STATE_STOPPED, STATE_FAULT = range(5)
FAULT_RANGE, FAULT_STEP, FAULT_FINITE, FAULT_WATCHDOG, FAULT_SERVO = 1, 2, 4, 8, 16


def _skew(axis: Floats) -> Floats:
    x, y, z = axis.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


# The motion of a joint by an angle q is 1 + sin(q) C + (1 - cos(q)) C C (Rodrigues), where C is the
# matrix (4, 4) of the twist of its axis. These are C (_CROSS) and C C (_SQUARE) of all joints.
_CROSS, _SQUARE = np.zeros((6, 4, 4)), np.zeros((6, 4, 4))
for _joint, (_axis, _point) in enumerate(zip(_AXES, _POINTS, strict=True)):
    _CROSS[_joint, :3] = np.column_stack([_skew(_axis), -_skew(_axis) @ _point])
    _SQUARE[_joint, :3] = _skew(_axis) @ _CROSS[_joint, :3]
_UNIT = np.eye(4)
_HOME = _UNIT.copy()
_HOME[:3, 3] = _FLANGE_AT_ZERO


def forward(joints_rad: Floats) -> Floats:
    """Compute the forward kinematics: base_from_flange (4, 4) for joint angles (6,).

    It is exp(S1 q1) ... exp(S6 q6) M, with the screw axes S, joint angles q, and the flange pose M
    at joint angles of zero.
    """
    turns = _rotations(joints_rad)
    one, two, three = turns[::2] @ turns[1::2]
    return np.asarray(one @ two @ three @ _HOME)


def _rotations(joints_rad: Floats) -> Floats:
    """Return the motions exp(S q) (6, 4, 4) of all joints about their axes at zero angles."""
    angles = joints_rad[:, None, None]
    return np.asarray(_UNIT + np.sin(angles) * _CROSS + (1.0 - np.cos(angles)) * _SQUARE)


def solve_inverse_kinematics(base_from_flange: Floats, guess_rad: Floats) -> Floats:
    """Solve the joint angles (6,), within their ranges, for a flange pose (4, 4).

    The method is damped Gauss-Newton from `guess_rad`. Raises ValueError unless it converges to a
    micrometre and a microradian.
    """
    joints = guess_rad.copy()
    for _ in range(200):
        *ahead, last = accumulate((np.eye(4), *_rotations(joints)), np.matmul)
        pose = last @ _HOME
        error = _pose_error(base_from_flange, pose)
        if np.abs(error).max() < 1e-10:
            break
        frames = np.array(ahead)
        axes = np.einsum("nij,nj->ni", frames[:, :3, :3], _AXES)
        places = np.einsum("nij,nj->ni", frames[:, :3, :3], _POINTS) + frames[:, :3, 3]
        slope = np.vstack([np.cross(axes, pose[:3, 3] - places).T, axes.T])
        step = np.linalg.solve(slope.T @ slope + 1e-8 * np.eye(6), slope.T @ error)
        joints = np.clip(joints + np.clip(step, -0.3, 0.3), RANGE_RAD[:, 0], RANGE_RAD[:, 1])
    if not np.abs(_pose_error(base_from_flange, forward(joints))).max() <= 1e-6:
        raise ValueError(
            f"the arm cannot reach the flange pose at {base_from_flange[:3, 3]} m (base frame); "
            "move the base or the flange"
        )
    return joints


def _pose_error(wanted: Floats, present: Floats) -> Floats:
    """Return translation (m) and small rotation (rad), as (6,), from present to wanted pose."""
    turn = wanted[:3, :3] @ present[:3, :3].T
    spin = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return np.concatenate([wanted[:3, 3] - present[:3, 3], spin])


def _between(values: Floats, lowest: Floats, highest: Floats) -> Floats:
    return np.minimum(np.maximum(values, lowest), highest)


def decelerate(velocity_rad_per_s: Floats, duration_s: float) -> Floats:
    """Return the joint velocities (..., 6) after braking for a duration.

    All joints are slowed by the same factor, so that the arm stays on its path.
    """
    stopping_s = (np.abs(velocity_rad_per_s) / ACCELERATION_RAD_PER_S2).max(axis=-1, keepdims=True)
    left = np.maximum(stopping_s - duration_s, 0.0) / np.maximum(stopping_s, 1e-12)
    return np.asarray(velocity_rad_per_s * left)


@dataclass(slots=True)
class Servo:
    """Six joint servos of second order with critical damping.

    joints_rad: joint angles (6,) by the encoders, which are at the motors.
    lag_s: lag of a joint behind a set-point of constant velocity.
    driven_rad: joint angles (6,) at the output of the gears. After a reversal they stay constant
        until the motor has moved by `backlash_rad`.
    """

    joints_rad: Floats
    lag_s: float
    backlash_rad: float = 0.0
    velocity_rad_per_s: Floats = field(default_factory=lambda: np.zeros(6))
    driven_rad: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.driven_rad = self.joints_rad.copy()

    def advance(self, wanted_rad: Floats, duration_s: float, *, braking: bool = False) -> None:
        """Simulate `duration_s` in steps of at most a millisecond.

        wanted_rad: set-point (6,). braking: brake along the path instead of following it.
        """
        if braking and not self.velocity_rad_per_s.any():
            return
        steps = max(1, int(np.ceil(duration_s / 1e-3)))
        step_s = duration_s / steps
        natural = 2.0 / self.lag_s
        for _ in range(steps):
            if braking:
                speed = decelerate(self.velocity_rad_per_s, step_s)
            else:
                pull = natural * (
                    natural * (wanted_rad - self.joints_rad) - 2.0 * self.velocity_rad_per_s
                )
                pull = _between(pull, -ACCELERATION_RAD_PER_S2, ACCELERATION_RAD_PER_S2)
                speed = self.velocity_rad_per_s + pull * step_s
            self.velocity_rad_per_s = _between(speed, -SPEED_RAD_PER_S, SPEED_RAD_PER_S)
            self.joints_rad = self.joints_rad + self.velocity_rad_per_s * step_s
        play = 0.5 * self.backlash_rad
        self.driven_rad = _between(self.driven_rad, self.joints_rad - play, self.joints_rad + play)


class Controller:
    """Simulated controller of one arm, which checks command blocks and answers with its status.

    It rejects an invalid command (magic number, version, CRC, mode, sequence number) by a Modbus
    exception. In four cases it enters the fault state, in which it brakes and stops: joints out of
    range, joints not finite, a jump of the set-point, and no command for `watchdog_s` while moving.
    An `idle` command clears a fault and may restart the sequence numbers.

    noise_rad: standard deviation of the measured joints.
    cycle_s: duration of a cycle; a set-point takes effect when the next one begins. 0: at once.
    cycle_jitter_s: standard deviation of the time at which a cycle begins.
    latency_s: time from the arrival of a set-point until it waits for the next cycle.
    """

    def __init__(
        self,
        joints_rad: Floats,
        *,
        servo_lag_s: float,
        noise_rad: float,
        watchdog_s: float,
        backlash_rad: float = 0.0,
        cycle_s: float = 0.0,
        cycle_jitter_s: float = 0.0,
        latency_s: float = 0.0,
        max_step_rad: float = 0.15,
        seed: int = 0,
    ) -> None:
        self.servo = Servo(np.array(joints_rad, dtype=np.float64), servo_lag_s, backlash_rad)
        self.state = STATE_IDLE
        self.faults = 0
        self.refused = 0
        self.accepted = 0
        self.commands = 0
        self.wanted_rad = self.servo.joints_rad.copy()
        self.fault: Fault = "none"
        self._acting_rad = self.wanted_rad
        self._pending: deque[tuple[float, Floats]] = deque()
        self._time_s = 0.0
        self._command_at_s = 0.0
        self._watchdog_s = watchdog_s
        self._cycle_s = cycle_s
        self._cycle_jitter_s, self._latency_s = cycle_jitter_s, latency_s
        self._jitter = np.random.default_rng((seed, JITTER_STREAM))
        self._max_step_rad = max_step_rad
        self._noise_rad = noise_rad
        self._random = np.random.default_rng(seed)

    def advance(self, duration_s: float) -> None:
        """Simulate `duration_s` of motion; enter the fault state if commands are missing."""
        end_s = self._time_s + duration_s
        while self._pending and self._pending[0][0] <= end_s:
            due_s, wanted_rad = self._pending.popleft()
            self._run_until(due_s)
            self._acting_rad = wanted_rad
        self._run_until(end_s)

    def _run_until(self, end_s: float) -> None:
        duration_s, self._time_s = end_s - self._time_s, max(self._time_s, end_s)
        if self.state == STATE_MOVING and self._time_s - self._command_at_s > self._watchdog_s:
            self._fail(FAULT_WATCHDOG)
        if duration_s > 0.0 and self.fault != "frozen":
            self.servo.advance(self._acting_rad, duration_s, braking=self.state != STATE_MOVING)

    def receive_command(self, registers: list[int]) -> bool:
        """Check and execute a command block; return False if it must be rejected."""
        block = struct.pack(f">{len(registers)}H", *registers)
        if len(block) != _COMMAND.size:
            return self._refuse()
        magic, version, sequence, _, mode, _, *joints, crc = _COMMAND.unpack(block)
        if magic != 0x4653 or version != 1 or crc != zlib.crc32(block[:-4]) or mode > _STOP:
            return self._refuse()
        # Newer means ahead by less than half the range, so that the 32-bit counter may wrap around.
        newer = 0 < (sequence - self.accepted) % 2**32 < 2**31
        if mode != _IDLE and not newer:
            return self._refuse()
        self.accepted = sequence
        self.commands += 1
        self._command_at_s = self._time_s
        if mode == _IDLE:
            self._pending.clear()
            self.faults, self.state = 0, STATE_IDLE
        elif self.state != STATE_FAULT:
            self._obey(mode, np.array(joints))
        return True

    def _obey(self, mode: int, joints: Floats) -> None:
        if mode != _MOVE:
            self._pending.clear()
            self.state = STATE_HOLDING if mode == _HOLD else STATE_STOPPED
            return
        before = self.wanted_rad if self.state == STATE_MOVING else self.servo.joints_rad
        if not np.isfinite(joints).all():
            self._fail(FAULT_FINITE)
        elif (joints < RANGE_RAD[:, 0]).any() or (joints > RANGE_RAD[:, 1]).any():
            self._fail(FAULT_RANGE)
        elif np.abs(joints - before).max() > self._max_step_rad:
            self._fail(FAULT_STEP)
        else:
            if self.state != STATE_MOVING:
                self._acting_rad = self.servo.joints_rad.copy()
            self.state, self.wanted_rad = STATE_MOVING, joints
            self._pending.append((self._due_s(), joints))

    def _due_s(self) -> float:
        due_s = self._time_s + self._latency_s + (LATE_S if self.fault == "lagging" else 0.0)
        if not self._cycle_s:
            return due_s
        due_s = math.ceil(due_s / self._cycle_s) * self._cycle_s
        if not self._cycle_jitter_s:
            return due_s
        # Jitter must not change the order in which set-points take effect.
        late_s = self._cycle_jitter_s * float(self._jitter.standard_normal())
        last_s = self._pending[-1][0] if self._pending else self._time_s
        return max(due_s + late_s, last_s)

    def _fail(self, bit: int) -> None:
        self._pending.clear()
        self.faults |= bit
        self.state = STATE_FAULT

    def _refuse(self) -> bool:
        self.refused += 1
        return False

    def status_registers(self) -> list[int]:
        """Return the status block of the register map, with the measured joints."""
        measured = self.servo.joints_rad + self._noise_rad * self._random.standard_normal(6)
        block = _STATUS.pack(
            0x4653,
            0 if self.fault == "old_version" else 1,
            (self.accepted - (self.fault == "repeated")) & 0xFFFFFFFF,
            int(self._time_s / CONTROLLER_CYCLE_S) & 0xFFFFFFFF,
            int(self._time_s * 1e6) & 0xFFFFFFFF,
            self.state,
            self.faults,
            *measured,
            self.refused,
            0,
        )
        crc = zlib.crc32(block[:-4]) ^ (1 if self.fault == "bad_crc" else 0)
        block = block[:-4] + struct.pack(">I", crc)
        return list(struct.unpack(f">{len(block) // 2}H", block))


class ArmServer:
    """Modbus TCP server through which clients command a simulated controller."""

    def __init__(
        self, controller: Controller, *, host: str, port: int, before: Callable[[], None]
    ) -> None:
        """`before` is called before each request; it must call `controller.advance`."""
        self.controller = controller
        self._address = (host, port)
        self._before = before
        self._server: ModbusTcpServer | None = None

    async def start(self) -> None:
        """Start to listen; raises OSError or RuntimeError if the port is in use."""
        device = SimDevice(
            1,
            simdata=[
                SimData(0, count=_COMMAND.size // 2, datatype=DataType.REGISTERS),
                SimData(_STATUS_AT, count=_STATUS.size // 2, datatype=DataType.REGISTERS),
            ],
            action=self._act,
        )
        # With this option, NoSuchIdException in `_act` makes the server silent.
        self._server = ModbusTcpServer(device, address=self._address, ignore_missing_devices=True)
        await self._server.serve_forever(background=True)

    @property
    def port(self) -> int:
        """Return the port on which the server listens, also if it was given as 0 (any)."""
        listener: Any = None if self._server is None else self._server.transport
        if listener is None:
            raise RuntimeError("the server of the simulated arm is not started; call start() first")
        return int(listener.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        if self._server is not None:
            await self._server.shutdown()  # type: ignore[no-untyped-call]  # pymodbus
            self._server = None

    async def _act(  # noqa: PLR0917  # pymodbus calls it so
        self,
        function_code: int,
        first: int,
        address: int,
        count: int,
        registers: list[int],
        written: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        fault = self.controller.fault
        if fault == "silent":
            raise NoSuchIdException
        if fault == "exception":
            return ExcCodes.DEVICE_FAILURE
        if fault == "slow" and written:
            await asyncio.sleep(LATE_S)
        # A combined read and write request calls this first for the write, which advances the arm.
        if written or function_code != _READ_AND_WRITE:
            self._before()
        if written:
            if address != 0 or not self.controller.receive_command(
                [int(value) for value in written]
            ):
                return ExcCodes.ILLEGAL_VALUE
            return None
        if address == _STATUS_AT:
            start = _STATUS_AT - first
            registers[start : start + _STATUS.size // 2] = self.controller.status_registers()
        return None
