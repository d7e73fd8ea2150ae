"""Simulate two arms that are controlled over the network, and publish their true poses.

The parameter `apparatus` contains the true parameters of the simulated hardware. The scene contains
the parameters that the other nodes assume.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field

from flexsheet.messages.apparatus import ArmTruth, nominal_apparatus
from flexsheet.messages.base import Header
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import NonNegative, Positive, Scene
from flexsheet.messages.types import TwinArms
from flexsheet.nodes import NodeRole
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.node import Input, Node, Output, periodic
from flexsheet.nodes.parameter_marks import ListenPort
from flexsheet.nodes.twin.arms import (
    CONTROLLER_CYCLE_S,
    ArmServer,
    Controller,
    PlacedArm,
    check_loopback,
)
from flexsheet.nodes.twin.mxt_controller import FILTER_S, MxtController, MxtServer
from flexsheet.nodes.twin.sheet_pull import SheetPull
from flexsheet.nodes.twin.truth import SimulatorParameters, apply_apparatus

Loopback = Annotated[str, AfterValidator(check_loopback)]


class TwinArmsParameters(SimulatorParameters):
    """The parameters of the simulated arms.

    Values in the parameter `apparatus` (true hardware parameters) take precedence.
    """

    host: Loopback = "127.0.0.1"
    left_port: ListenPort = Field(
        default=5020, description="network port of the left simulated arm; 0: any free port is used"
    )
    right_port: ListenPort = 5021
    rate_hz: Positive = 140.8
    servo_lag_s: Positive = 0.025
    noise_rad: NonNegative = Field(
        default=5e-6, description="standard deviation of the measured joint angles, rad"
    )
    backlash_rad: NonNegative = Field(
        default=3e-5,
        description="backlash of each gear, rad; the default corresponds to 0.02 mm at the flange",
    )
    watchdog_s: Positive = 0.1
    protocol: Literal["modbus", "mxt"] = "modbus"
    cycle_s: NonNegative = Field(
        default=0.0,
        description="Modbus: period of the controller, s. Set-points take effect at the start of "
        "a period; 0: set-points take effect immediately",
    )
    restart_after_s: Positive = Field(
        default=2.0,
        description="MXT: time from an error until the robot program restarts, s",
    )
    joints_file: str | None = Field(
        default=None,
        description="file that stores the joint angles, so that a restart does not move the arms; "
        "null: the angles are not stored",
    )


def open_joints_file(path: str | None) -> dict[str, Floats]:
    """Open a file that stores the joint angles (rad) of both arms, as memory-mapped arrays.

    Returns one array (6,) per side. The arrays contain NaN if the file is new or `path` is None.
    Raises OSError if the file cannot be opened.
    """
    if path is None:
        rows = np.full((2, 6), np.nan)
    else:
        exists = Path(path).exists() and Path(path).stat().st_size == 2 * 6 * 8
        rows = np.memmap(path, dtype=np.float64, mode="r+" if exists else "w+", shape=(2, 6))
        if not exists:
            rows[:] = np.nan
    return {"left": rows[0], "right": rows[1]}


class TwinArmsNode(Node):
    """A node that simulates both arms and the sheet between them.

    The simulation starts when the first scene arrives.
    """

    role: ClassVar[NodeRole | None] = NodeRole.ARM_SIMULATOR
    opens_devices: ClassVar[bool] = True

    parameters: TwinArmsParameters
    scene: Input[Scene]
    twin__arms: Output[TwinArms]

    @classmethod
    def replay_refusal(cls, parameters: Any) -> str:
        return "it answers requests of the arm bridges over the network, which are not recorded"

    async def setup(self) -> None:
        self.servers: dict[str, ArmServer | MxtServer] = {}
        self._placed: dict[str, PlacedArm] = {}
        self._pull: SheetPull | None = None
        self._moved_ns: dict[str, int] = {}
        self._stored_joints = open_joints_file(self.parameters.joints_file)

    async def close(self) -> None:
        for server in self.servers.values():
            await server.stop()

    async def on_scene(self, scene: Scene, header: Header) -> None:
        truth = self.parameters.apparatus or nominal_apparatus(scene)
        self._arms = truth.arms
        scene = apply_apparatus(scene, truth)
        arms = {"left": scene.arms.left, "right": scene.arms.right}
        self._placed = {side: PlacedArm.of(spec) for side, spec in arms.items()}
        self._pull = SheetPull.of(scene.sheet, truth)
        if len(self.servers) == len(arms):
            return
        for number, side in enumerate(arms):
            if side in self.servers:
                continue
            port = self.parameters.left_port if side == "left" else self.parameters.right_port
            self._moved_ns[side] = self.clock.now_ns()
            joints_rad = self._stored_joints[side]
            if not self._placed[side].mechanics.is_in_range(joints_rad):
                joints_rad = self._start_joints(side, scene)
            server = self._server(side, joints_rad, port, number)
            await server.start()
            self.servers[side] = server

    def _server(self, side: str, joints_rad: Floats, port: int, seed: int) -> ArmServer | MxtServer:
        given, before = self.parameters, partial(self._advance, side)
        truth = self._truth(side)
        lag_s = given.servo_lag_s if truth.servo_lag_s is None else truth.servo_lag_s
        backlash_rad = given.backlash_rad if truth.backlash_rad is None else truth.backlash_rad
        period_s = truth.controller_period_s
        if given.protocol == "mxt":
            mxt = MxtController(
                joints_rad,
                servo_lag_s=max(lag_s - FILTER_S, 1e-3),
                filter_s=FILTER_S,
                noise_rad=given.noise_rad,
                timeout_s=given.watchdog_s,
                backlash_rad=backlash_rad,
                restart_after_s=given.restart_after_s,
                cycle_s=CONTROLLER_CYCLE_S if period_s is None else period_s,
                cycle_jitter_s=truth.controller_jitter_s,
                latency_s=truth.command_latency_s,
                mechanics=self._placed[side].mechanics,
                seed=seed,
            )
            return MxtServer(mxt, host=given.host, port=port, before=before)
        controller = Controller(
            joints_rad,
            servo_lag_s=lag_s,
            noise_rad=given.noise_rad,
            watchdog_s=given.watchdog_s,
            backlash_rad=backlash_rad,
            cycle_s=given.cycle_s if period_s is None else period_s,
            cycle_jitter_s=truth.controller_jitter_s,
            latency_s=truth.command_latency_s,
            mechanics=self._placed[side].mechanics,
            seed=seed,
        )
        return ArmServer(controller, host=given.host, port=port, before=before)

    def _truth(self, side: str) -> ArmTruth:
        return self._arms.left if side == "left" else self._arms.right

    def _true_joints(self, side: str, motor_rad: Floats) -> Floats:
        """Add the true zero offsets to the joint angles (6,), rad, at the outputs of the gears."""
        offsets_rad = self._truth(side).joint_offsets_rad
        return motor_rad + np.array(offsets_rad) if any(offsets_rad) else motor_rad

    def _start_joints(self, side: str, scene: Scene) -> Floats:
        """Return the encoder angles (6,), rad, at which an arm starts.

        At these angles, the sheet is in the screen plane (z = 0) with the scene's minimum stretch.
        """
        half = 0.5 * scene.sheet.width_m * scene.sheet.min_stretch_ratio
        edge = transform(np.eye(3), [-half if side == "left" else half, 0.0, 0.0])
        arm = self._placed[side]
        joints_rad = arm.solve_joints(edge, arm.mechanics.start_rad)
        return np.asarray(joints_rad - np.array(self._truth(side).joint_offsets_rad))

    def _advance(self, side: str) -> None:
        now_ns = self.clock.now_ns()
        duration_s = (now_ns - self._moved_ns[side]) * 1e-9
        self._moved_ns[side] = now_ns
        if duration_s > 0.0 and side in self.servers:
            controller = self.servers[side].controller
            controller.advance(duration_s)
            self._stored_joints[side][:] = controller.servo.joints_rad

    @periodic("rate_hz")
    async def cycle(self) -> None:
        if len(self.servers) < 2:
            self.set_note(NoteCode.WAITING_FOR_SCENE)
            return
        for side in self.servers:
            self._advance(side)
        joints = {
            side: self._true_joints(side, server.controller.servo.driven_rad)
            for side, server in self.servers.items()
        }
        left, right = (self._placed[side].world_from_flange(joints[side]) for side in joints)
        if self._pull is not None:
            clamps = [self._placed[side].flange_from_edge for side in ("left", "right")]
            left, right = self._pull.displace(
                left, right, *clamps, time_s=self.clock.now_ns() * 1e-9
            )
        self.twin__arms.publish(
            TwinArms(
                joints_left_rad=joints["left"],
                joints_right_rad=joints["right"],
                world_from_flange_left=left,
                world_from_flange_right=right,
            )
        )
        texts = (
            f"{side}: {one.commands} commands, refused: {one.refused}"
            for side, one in ((side, server.controller) for side, server in self.servers.items())
        )
        self.set_note(NoteCode.INFO, ", ".join(texts))
