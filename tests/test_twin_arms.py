"""Test the simulated arms: kinematics, servo and rejected commands."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import TwinArms
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.twin.arms import (
    CONTROLLER_CYCLE_S,
    FAULT_FINITE,
    FAULT_RANGE,
    FAULT_STEP,
    FAULT_WATCHDOG,
    STATE_FAULT,
    STATE_HOLDING,
    STATE_IDLE,
    STATE_MOVING,
    Controller,
    Servo,
)
from flexsheet.nodes.twin.arms_node import TwinArmsNode, TwinArmsParameters
from flexsheet.nodes.twin.mxt_controller import MxtServer
from tests.note_text import note_text
from tests.rv_1a import (
    ACCELERATION_RAD_PER_S2,
    RANGE_RAD,
    SPEED_RAD_PER_S,
    solve_inverse_kinematics,
)
from tests.rv_1a import (
    twin_forward as forward,
)
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
JOINTS = np.radians([0.0, 25.0, 118.0, 0.0, -54.0, 0.0])


def test_home_pose_by_hand() -> None:
    home = forward(np.radians([0.0, 0.0, 90.0, 0.0, 0.0, 0.0]))
    assert home[:3, 3] == pytest.approx([0.232, 0.0, 0.64], abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(arrays(np.float64, 6, elements=st.floats(-0.2, 0.2)))
def test_inverse_finds_the_pose(change: Floats) -> None:
    pose = forward(JOINTS + change)
    assert forward(solve_inverse_kinematics(pose, JOINTS)) == pytest.approx(pose, abs=1e-6)


def test_a_pose_out_of_reach_is_an_error() -> None:
    pose = forward(JOINTS)
    pose[0, 3] += 1.0
    with pytest.raises(ValueError, match="cannot reach"):
        solve_inverse_kinematics(pose, JOINTS)


def test_the_servo_trails_an_even_command_by_its_lag() -> None:
    servo, rate = Servo(JOINTS.copy(), 0.025), np.full(6, 0.2)
    time_s = 0.0
    for _ in range(400):
        time_s += 0.001
        servo.advance(JOINTS + rate * time_s, 0.001)
    assert (JOINTS + rate * time_s - servo.joints_rad) / rate == pytest.approx(0.025, abs=0.0015)


@settings(max_examples=30, deadline=None)
@given(st.lists(arrays(np.float64, 6, elements=st.floats(-3.0, 3.0)), min_size=1, max_size=10))
def test_the_servo_keeps_its_limits(wanted: list[Floats]) -> None:
    servo = Servo(JOINTS.copy(), 0.025)
    for target in wanted:
        for _ in range(20):
            before = servo.velocity_rad_per_s
            servo.advance(target, 0.001)
            change = np.abs(servo.velocity_rad_per_s - before)
            assert (change <= ACCELERATION_RAD_PER_S2 * 0.001 * (1 + 1e-9)).all()
            assert (np.abs(servo.velocity_rad_per_s) <= SPEED_RAD_PER_S * (1 + 1e-9)).all()


def command(
    sequence: int,
    joints: Floats = JOINTS,
    *,
    mode: int = 1,
    magic: int = 0x4653,
    version: int = 1,
    crc: int | None = None,
) -> list[int]:
    body = struct.pack(">HHIIHH6f", magic, version, sequence, 0, mode, 0, *joints)
    body += struct.pack(">I", zlib.crc32(body) if crc is None else crc)
    return list(struct.unpack(f">{len(body) // 2}H", body))


def controller() -> Controller:
    result = Controller(JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=0.1)
    assert result.receive_command(command(1, mode=0))
    return result


@pytest.mark.parametrize(
    "registers",
    [
        command(2, magic=1),
        command(2, version=2),
        command(2, crc=5),
        command(2, mode=4),
        command(1),
        command(2**31 + 1),
        command(2)[:-1],
        [],
    ],
)
def test_what_is_not_a_new_command_is_rejected(registers: list[int]) -> None:
    arm = controller()
    assert not arm.receive_command(registers)
    assert arm.refused == 1
    assert (arm.state, arm.accepted) == (STATE_IDLE, 1)


@pytest.mark.parametrize(
    ("joints", "bit"),
    [
        (np.where(np.arange(6) == 2, np.nan, JOINTS), FAULT_FINITE),
        (np.where(np.arange(6) == 4, RANGE_RAD[4, 0] - 0.01, JOINTS), FAULT_RANGE),
        (JOINTS + 0.2, FAULT_STEP),
    ],
)
def test_what_an_arm_must_not_do_is_a_fault_that_idle_clears(joints: Floats, bit: int) -> None:
    arm = controller()
    assert arm.receive_command(command(2, joints))
    assert (arm.state, arm.faults) == (STATE_FAULT, bit)
    assert arm.receive_command(command(3))
    arm.advance(0.1)
    assert arm.state == STATE_FAULT
    assert arm.servo.joints_rad == pytest.approx(JOINTS, abs=1e-12)
    assert arm.receive_command(command(1, mode=0))
    assert (arm.state, arm.faults) == (STATE_IDLE, 0)
    assert arm.receive_command(command(2))
    assert arm.state == STATE_MOVING


def test_the_watchdog_stops_an_arm_that_is_no_longer_commanded() -> None:
    arm = controller()
    arm.receive_command(command(2, JOINTS + 0.1))
    arm.advance(0.09)
    assert arm.state == STATE_MOVING
    arm.advance(0.02)
    assert (arm.state, arm.faults) == (STATE_FAULT, FAULT_WATCHDOG)
    arm.advance(0.3)
    assert arm.servo.velocity_rad_per_s == pytest.approx(np.zeros(6), abs=1e-12)


def test_hold_brakes_and_a_counter_may_wrap() -> None:
    arm = controller()
    arm.accepted = 2**32 - 2
    assert arm.receive_command(command(2**32 - 1, JOINTS + 0.05))
    arm.advance(0.01)
    assert arm.receive_command(command(0, mode=2))
    assert arm.state == STATE_HOLDING
    arm.advance(0.3)
    assert arm.servo.velocity_rad_per_s == pytest.approx(np.zeros(6), abs=1e-12)


velocities = arrays(np.float64, 6, elements=st.floats(-1.0, 1.0)).map(SPEED_RAD_PER_S.__mul__)


@settings(max_examples=50, deadline=None)
@given(velocity=velocities)
def test_a_stop_keeps_to_the_path_and_ends_as_soon_as_the_slowest_joint_can(
    velocity: Floats,
) -> None:
    servo = Servo(JOINTS.copy(), 0.025)
    servo.velocity_rad_per_s = velocity
    stopping_s = float((np.abs(velocity) / ACCELERATION_RAD_PER_S2).max())
    for _ in range(int(np.ceil(stopping_s / 1e-3)) + 1):
        before = servo.velocity_rad_per_s
        servo.advance(JOINTS, 1e-3, braking=True)
        change = np.abs(servo.velocity_rad_per_s - before)
        assert (change <= ACCELERATION_RAD_PER_S2 * 1e-3 * (1 + 1e-9)).all()
        gone = servo.joints_rad - JOINTS
        along = velocity * float(gone @ velocity) / max(float(velocity @ velocity), 1e-300)
        assert gone == pytest.approx(along, abs=1e-12)
    assert servo.velocity_rad_per_s == pytest.approx(np.zeros(6), abs=1e-12)


@pytest.mark.parametrize("how", ["stop", "idle", "watchdog", "fault"])
def test_a_stopped_arm_stays_on_its_path(how: str) -> None:
    """Fast and slow joints end together: a straight line in joint space remains straight."""
    arm, way = controller(), np.array([0.08, -0.01, 0.02, 0.1, -0.05, 0.03])
    for number in range(20):
        assert arm.receive_command(command(number + 2, JOINTS + way * number / 10.0))
        arm.advance(0.007)
    speed = arm.servo.velocity_rad_per_s
    if how == "watchdog":
        arm.advance(0.3)
        assert arm.faults == FAULT_WATCHDOG
    else:
        assert arm.receive_command(
            command(50, JOINTS + 3.0) if how == "fault" else command(50, mode=3 * (how == "stop"))
        )
        before = arm.servo.joints_rad
        arm.advance(0.3)
        gone = arm.servo.joints_rad - before
        assert gone == pytest.approx(speed * (gone @ speed) / (speed @ speed), abs=1e-9)
        assert np.abs(gone).max() > 1e-3
    assert arm.servo.velocity_rad_per_s == pytest.approx(np.zeros(6), abs=1e-12)


async def test_the_node_switches_its_arms_on_with_the_first_scene() -> None:
    scene = load_cylinder()
    clock, sent = VirtualClock(), []

    def send(topic: Topic, message: Message, header: Header) -> None:
        assert isinstance(message, TwinArms)
        sent.append(message)

    node = TwinArmsNode(
        TwinArmsParameters(left_port=0, right_port=0), name="twin", clock=clock, send=send
    )
    await node.setup()
    await node.cycle()
    assert sent == []
    try:
        await node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
        assert node.errors == 0, node.last_error
        clock.move_to(7_100_000)
        await node.cycle()
        clamp = transform_from_rpy(
            scene.arms.left.flange_from_edge.position_m, scene.arms.left.flange_from_edge.rpy_rad
        )
        edge = sent[-1].world_from_flange_left @ clamp
        half = 0.5 * scene.sheet.width_m * scene.sheet.min_stretch_ratio
        assert edge[:3, 3] == pytest.approx([-half, 0.0, 0.0], abs=1e-6)
        assert edge[:3, :3] == pytest.approx(np.eye(3), abs=1e-6)
        ports = {server.port for server in node.servers.values()}
        await node.step("scene", scene, Header(2, 0, 0, "virtual", "test", 1))
        assert {server.port for server in node.servers.values()} == ports
    finally:
        await node.close()


async def switch_on(joints_file: Path) -> TwinArmsNode:
    """Start the node with a scene."""
    scene = load_cylinder()
    parameters = TwinArmsParameters(left_port=0, right_port=0, joints_file=str(joints_file))
    node = TwinArmsNode(parameters, name="twin", clock=VirtualClock(), send=lambda *_: None)
    await node.setup()
    await node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
    assert node.errors == 0, node.last_error
    return node


async def test_a_restarted_arm_keeps_its_joints(tmp_path: Path) -> None:
    first = await switch_on(tmp_path / "joints")
    left = first.servers["left"].controller
    at_start, right_joints = left.servo.joints_rad, first.servers["right"].controller.servo
    left.servo.velocity_rad_per_s[0] = 0.5
    first.clock.move_to(20_000_000)
    await first.cycle()
    await first.close()
    assert left.servo.joints_rad[0] > at_start[0] + 1e-3
    second = await switch_on(tmp_path / "joints")
    try:
        for side, before in (("left", left.servo), ("right", right_joints)):
            after = second.servers[side].controller.servo
            assert after.joints_rad.tolist() == before.joints_rad.tolist()
    finally:
        await second.close()


@pytest.mark.parametrize("content", [b"", b"short", bytes([255]) * 96, np.full(12, 9.0).tobytes()])
async def test_an_invalid_file_of_joints_is_replaced(tmp_path: Path, content: bytes) -> None:
    fresh = await switch_on(tmp_path / "fresh")
    (tmp_path / "spoilt").write_bytes(content)
    node = await switch_on(tmp_path / "spoilt")
    try:
        for side in ("left", "right"):
            expected = fresh.servers[side].controller.servo.joints_rad
            assert node.servers[side].controller.servo.joints_rad.tolist() == expected.tolist()
    finally:
        await fresh.close()
        await node.close()


def test_a_gear_has_play_when_its_motor_turns_back() -> None:
    servo = Servo(JOINTS.copy(), 0.025, backlash_rad=2e-3)
    up, down = JOINTS + 0.1, JOINTS - 0.1
    servo.advance(up, 1.0)
    assert servo.driven_rad == pytest.approx(servo.joints_rad - 1e-3, abs=1e-9)
    stood = servo.driven_rad
    for _ in range(5):
        servo.advance(servo.joints_rad - 3e-4, 1e-3)
    assert (servo.joints_rad < up - 1e-5).all()
    assert (servo.driven_rad == stood).all(), "the motor turns in its gear's play"
    servo.advance(down, 1.0)
    assert servo.driven_rad == pytest.approx(servo.joints_rad + 1e-3, abs=1e-9)


def test_the_play_of_the_gears_is_the_arms_repeatability() -> None:
    """Poses approached from all sides differ by about the manufacturer's +-0.02 mm."""
    random = np.random.default_rng(3)
    play = TwinArmsParameters().backlash_rad
    places = []
    for _ in range(200):
        servo = Servo(JOINTS + 0.05 * random.choice([-1.0, 1.0], 6), 0.025, play)
        servo.advance(JOINTS, 0.4)
        places.append(forward(servo.driven_rad)[:3, 3])
    spread = np.linalg.norm(np.array(places) - np.mean(places, axis=0), axis=1).max()
    assert 0.5e-5 < spread < 2e-5


def test_set_points_act_at_once_or_at_the_next_cycle() -> None:
    at_once = Controller(JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=0.1)
    in_cycles = Controller(
        JOINTS, servo_lag_s=0.025, noise_rad=0.0, watchdog_s=0.1, cycle_s=CONTROLLER_CYCLE_S
    )
    for arm in (at_once, in_cycles):
        arm.receive_command(command(1, mode=0))
        arm.advance(0.001)
        assert arm.receive_command(command(2, JOINTS + 0.1))
        arm.advance(0.006)
    assert (at_once.servo.joints_rad > JOINTS + 1e-4).all()
    assert (in_cycles.servo.joints_rad == JOINTS).all()
    in_cycles.advance(0.0062)
    assert in_cycles.servo.joints_rad == pytest.approx(at_once.servo.joints_rad, abs=5e-5)


def test_a_lagging_arm_does_the_same_fifty_milliseconds_later() -> None:
    prompt, lagging = controller(), controller()
    lagging.fault = "lagging"
    tracks: dict[int, list[Floats]] = {0: [], 1: []}
    for number in range(60):
        for which, arm in enumerate((prompt, lagging)):
            arm.receive_command(command(number + 2, JOINTS + 0.1 * np.sin(0.1 * number)))
            for _ in range(5):
                arm.advance(0.001)
                tracks[which].append(arm.servo.joints_rad)
    ahead, late = np.array(tracks[0]), np.array(tracks[1])
    assert late[50:] == pytest.approx(ahead[:-50], abs=1e-3)


def test_stopping_forgets_what_was_still_to_be_done() -> None:
    arm = controller()
    arm.fault = "lagging"
    arm.receive_command(command(2, JOINTS + 0.1))
    arm.advance(0.01)
    arm.receive_command(command(3, mode=3))
    arm.advance(0.5)
    assert arm.servo.joints_rad == pytest.approx(JOINTS, abs=1e-12)


async def test_the_node_can_use_the_real_time_control() -> None:
    scene = load_cylinder()
    node = TwinArmsNode(
        TwinArmsParameters(left_port=0, right_port=0, protocol="mxt"),
        name="twin",
        clock=VirtualClock(),
        send=lambda topic, message, header: None,
    )
    await node.setup()
    try:
        await node.step("scene", scene, Header(1, 0, 0, "virtual", "test", 1))
        assert node.errors == 0, node.last_error
        assert {type(server) for server in node.servers.values()} == {MxtServer}
        await node.cycle()
        assert note_text(node) == "left: 0 commands, refused: 0, right: 0 commands, refused: 0"
    finally:
        await node.close()
