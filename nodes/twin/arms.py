"""Simulate arms with six joints and servo lag that receive commands over Modbus TCP.

This module was written from `docs/modbus.md` and the dimensions of the arms only. It shares no code
with the bridge (the node that sends commands to an arm), because it is used to test the bridge. The
forward kinematics is a product of exponentials (Brockett 1984; Lynch and Park, Modern Robotics, ch.
4). The inverse kinematics applies a Gauss-Newton method to this product.
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
from typing import Any, Literal, Self

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.exceptions import NoSuchIdException
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from flexsheet.messages.scene import RV_1A, ArmSpec, ClosedFormArm, JointChain
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import inverse, pose_matrix

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
"""The faults that a test can switch on in a simulated arm. MXT is Mitsubishi's protocol for
real-time external control.

silent: the arm does not answer.
slow: the arm answers with the delay LATE_S.
exception: the arm answers with a Modbus exception (MXT: with a packet of another data type).
bad_crc: the arm answers with a wrong checksum (MXT: with a truncated packet).
old_version: the arm answers with the version of an older register map.
repeated: the arm answers with the message counter of its previous answer.
frozen: the arm answers, but its joints do not move.
lagging: the arm executes commands with the delay LATE_S.
"""

LATE_S = 0.05

# Without this, the library would log whole packets whenever a client disconnects.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

CONTROLLER_CYCLE_S = 0.0071
MAX_STEP_RAD = 0.15
"""The maximum change of a joint angle between two set-points that the controller accepts, rad."""

JITTER_STREAM = 1
"""The second element of the random seed for the jitter of controller cycles. It makes the jitter
independent of the noise of measured joint angles."""


def check_loopback(address: str) -> str:
    """Return a network address if it is a loopback address; otherwise raise ValueError.

    The simulated arms accept commands from any client without authentication.
    """
    if not ipaddress.ip_address(address).is_loopback:
        raise ValueError(
            f"{address} is not a loopback address; use 127.0.0.1, because a simulated arm obeys "
            "any client that can reach it"
        )
    return address


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


class ArmMechanics:
    """The kinematics and limits of a simulated arm.

    range_rad: lower and upper ends of the joints' ranges (6, 2).
    speed_rad_per_s, acceleration_rad_per_s2: maximum speeds and accelerations of the joints (6,).
    start_rad: joint angles (6,) from which the inverse kinematics starts.
    """

    def __init__(self, model: ClosedFormArm | JointChain) -> None:
        self.range_rad = np.column_stack([model.min_rad, model.max_rad])
        self.speed_rad_per_s = np.array(model.speed_rad_per_s)
        self.acceleration_rad_per_s2 = 8.0 * self.speed_rad_per_s
        self.start_rad = np.array(model.start_rad)
        chain = model.chain() if isinstance(model, ClosedFormArm) else model
        self._axes, self._points = np.zeros((6, 3)), np.zeros((6, 3))
        # The motion of a joint by an angle q is 1 + sin(q) C + (1 - cos(q)) C C (Rodrigues), where
        # C is the matrix (4, 4) of the twist of its axis at angles of zero.
        self._cross, self._square = np.zeros((6, 4, 4)), np.zeros((6, 4, 4))
        frame = np.eye(4)
        for joint, (origin, axis) in enumerate(zip(chain.origins, chain.axes, strict=True)):
            frame = frame @ pose_matrix(origin)
            self._axes[joint], self._points[joint] = frame[:3, :3] @ axis, frame[:3, 3]
            skew = _skew(self._axes[joint])
            self._cross[joint, :3] = np.column_stack([skew, -skew @ self._points[joint]])
            self._square[joint, :3] = skew @ self._cross[joint, :3]
        self._home = frame @ pose_matrix(chain.flange)

    def is_in_range(self, joints_rad: Floats) -> bool:
        """Return whether joint angles (6,) are finite and within the range of the arm."""
        low, high = self.range_rad.T
        return bool(((joints_rad >= low) & (joints_rad <= high)).all())

    def forward(self, joints_rad: Floats) -> Floats:
        """Return the flange pose base_from_flange (4, 4) for joint angles (6,), rad.

        The pose is exp(S1 q1) ... exp(S6 q6) M, with the screw axes S, the joint angles q, and the
        flange pose M at joint angles of zero.
        """
        turns = self._rotations(joints_rad)
        one, two, three = turns[::2] @ turns[1::2]
        return np.asarray(one @ two @ three @ self._home)

    def _rotations(self, joints_rad: Floats) -> Floats:
        """Return the matrices exp(S q) (6, 4, 4) for screw axes S and joint angles q (6,), rad."""
        angles = joints_rad[:, None, None]
        return np.asarray(
            np.eye(4) + np.sin(angles) * self._cross + (1.0 - np.cos(angles)) * self._square
        )

    def solve_inverse_kinematics(self, base_from_flange: Floats, guess_rad: Floats) -> Floats:
        """Return joint angles (6,), rad, within their ranges for a flange pose (4, 4).

        A damped Gauss-Newton method starts at `guess_rad` (6,). Raises ValueError unless the pose
        error decreases to a micrometre and a microradian.
        """
        joints = guess_rad.copy()
        low, high = self.range_rad.T
        for _ in range(200):
            *ahead, last = accumulate((np.eye(4), *self._rotations(joints)), np.matmul)
            pose = last @ self._home
            error = _pose_error(base_from_flange, pose)
            if np.abs(error).max() < 1e-10:
                break
            frames = np.array(ahead)
            axes = np.einsum("nij,nj->ni", frames[:, :3, :3], self._axes)
            places = np.einsum("nij,nj->ni", frames[:, :3, :3], self._points) + frames[:, :3, 3]
            slope = np.vstack([np.cross(axes, pose[:3, 3] - places).T, axes.T])
            step = np.linalg.solve(slope.T @ slope + 1e-8 * np.eye(6), slope.T @ error)
            joints = np.clip(joints + np.clip(step, -0.3, 0.3), low, high)
        if not np.abs(_pose_error(base_from_flange, self.forward(joints))).max() <= 1e-6:
            raise ValueError(
                f"the arm cannot reach the flange pose at {base_from_flange[:3, 3]} m (base "
                "frame); move the base or the flange"
            )
        return joints


def _pose_error(wanted: Floats, present: Floats) -> Floats:
    """Return the small translation (m) and rotation (rad), (6,), from `present` to `wanted`."""
    turn = wanted[:3, :3] @ present[:3, :3].T
    spin = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return np.concatenate([wanted[:3, 3] - present[:3, 3], spin])


RV_1A_MECHANICS = ArmMechanics(RV_1A)
"""The mechanics of the Mitsubishi RV-1A, the default arm of a scene."""


@dataclass(frozen=True, slots=True)
class PlacedArm:
    """An arm, and the poses (4, 4) of its base and of the sheet's edge that it clamps."""

    mechanics: ArmMechanics
    world_from_base: Floats
    flange_from_edge: Floats

    @classmethod
    def of(cls, arm: ArmSpec) -> Self:
        return cls(
            ArmMechanics(arm.model),
            pose_matrix(arm.world_from_base),
            pose_matrix(arm.flange_from_edge),
        )

    def world_from_flange(self, joints_rad: Floats) -> Floats:
        """Return the pose (4, 4) of the flange for joint angles (6,), rad."""
        return self.world_from_base @ self.mechanics.forward(joints_rad)

    def solve_joints(self, world_from_edge: Floats, guess_rad: Floats) -> Floats:
        """Return the joint angles (6,), rad, for a pose (4, 4) of the edge.

        guess_rad: initial joint angles (6,).

        Raises ValueError if the pose is out of reach.
        """
        flange = inverse(self.world_from_base) @ world_from_edge @ inverse(self.flange_from_edge)
        return self.mechanics.solve_inverse_kinematics(flange, guess_rad)


def _between(values: Floats, lowest: Floats, highest: Floats) -> Floats:
    return np.minimum(np.maximum(values, lowest), highest)


def decelerate(
    velocity_rad_per_s: Floats, duration_s: float, acceleration_rad_per_s2: Floats
) -> Floats:
    """Return the joint velocities (..., 6), rad/s, after braking for `duration_s`.

    All velocities are reduced by the same factor, so the arm stays on its path.
    acceleration_rad_per_s2: maximum decelerations (6,).
    """
    stopping_s = (np.abs(velocity_rad_per_s) / acceleration_rad_per_s2).max(axis=-1, keepdims=True)
    left = np.maximum(stopping_s - duration_s, 0.0) / np.maximum(stopping_s, 1e-12)
    return np.asarray(velocity_rad_per_s * left)


@dataclass(slots=True)
class Servo:
    """The six joint servos of an arm. Each servo is a second-order system with critical damping.

    joints_rad: joint angles (6,) that the encoders at the motors measure.
    lag_s: time by which a joint lags behind a set-point that moves at constant velocity.
    driven_rad: joint angles (6,) at the output of the gears. After a motor reverses, its joint does
        not move until the motor has moved by `backlash_rad`.
    """

    joints_rad: Floats
    lag_s: float
    backlash_rad: float = 0.0
    mechanics: ArmMechanics = RV_1A_MECHANICS
    velocity_rad_per_s: Floats = field(default_factory=lambda: np.zeros(6))
    driven_rad: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.driven_rad = self.joints_rad.copy()

    def advance(self, wanted_rad: Floats, duration_s: float, *, braking: bool = False) -> None:
        """Simulate the servos for `duration_s`, in steps of at most a millisecond.

        wanted_rad: set-point (6,), rad.
        braking: whether to brake along the path instead of following the set-point.
        """
        if braking and not self.velocity_rad_per_s.any():
            return
        steps = max(1, int(np.ceil(duration_s / 1e-3)))
        step_s = duration_s / steps
        natural = 2.0 / self.lag_s
        max_pull, max_speed = self.mechanics.acceleration_rad_per_s2, self.mechanics.speed_rad_per_s
        for _ in range(steps):
            if braking:
                speed = decelerate(self.velocity_rad_per_s, step_s, max_pull)
            else:
                pull = natural * (
                    natural * (wanted_rad - self.joints_rad) - 2.0 * self.velocity_rad_per_s
                )
                pull = _between(pull, -max_pull, max_pull)
                speed = self.velocity_rad_per_s + pull * step_s
            self.velocity_rad_per_s = _between(speed, -max_speed, max_speed)
            self.joints_rad = self.joints_rad + self.velocity_rad_per_s * step_s
        play = 0.5 * self.backlash_rad
        self.driven_rad = _between(self.driven_rad, self.joints_rad - play, self.joints_rad + play)


class Controller:
    """A simulated controller of one arm that checks command blocks and answers with its status.

    If a command has an invalid magic number, version, CRC, mode or sequence number, the controller
    refuses it and answers with a Modbus exception. Four faults make the arm brake: joint angles out
    of range, joint angles that are not finite, a jump of the set-point, and no command for
    `watchdog_s` while the arm moves. A command with the mode `idle` clears a fault, and can restart
    the sequence numbers.

    noise_rad: standard deviation of the measured joint angles.
    cycle_s: period of the controller. A set-point takes effect when the next cycle begins. If the
        period is 0, set-points take effect immediately.
    cycle_jitter_s: standard deviation of the start time of a cycle.
    latency_s: time from the arrival of a set-point until it is ready for the next cycle.
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
        mechanics: ArmMechanics = RV_1A_MECHANICS,
        seed: int = 0,
    ) -> None:
        self.servo = Servo(
            np.array(joints_rad, dtype=np.float64), servo_lag_s, backlash_rad, mechanics
        )
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
        self._noise_rad = noise_rad
        self._random = np.random.default_rng(seed)

    def advance(self, duration_s: float) -> None:
        """Simulate the arm's motion and the watchdog for the time `duration_s`."""
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
        """Check and execute a command in 16-bit registers; return False if it is invalid."""
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
        elif not self.servo.mechanics.is_in_range(joints):
            self._fail(FAULT_RANGE)
        elif np.abs(joints - before).max() > MAX_STEP_RAD:
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
        """Return the status block of the register map as 16-bit registers."""
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
    """A Modbus TCP server that passes commands from clients to a simulated controller."""

    def __init__(
        self, controller: Controller, *, host: str, port: int, before: Callable[[], None]
    ) -> None:
        """Store the settings. The method `start` opens the port.

        before: function that is called before each request is processed. It must call
            `controller.advance` to advance the simulated controller to the present time.
        """
        self.controller = controller
        self._address = (host, port)
        self._before = before
        self._server: ModbusTcpServer | None = None

    async def start(self) -> None:
        """Start the server. Raises OSError or RuntimeError if the port is in use."""
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
        """Return the network port of the server.

        If the configured port is 0, the system chooses a free port.
        """
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
