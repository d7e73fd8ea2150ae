"""Write a bag of a short session for the tests of reports: a stroke with several events."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.experiments.stroke import stroke_label, stroke_window_s
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.notes import Note
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import (
    ArmState,
    Bookmark,
    EStop,
    Frame,
    PortStatus,
    SheetTarget,
    Side,
    SoftBody,
    Status,
    StereoPair,
    TwinArms,
    TwinEye,
    TwinFinger,
)
from flexsheet.nodes.models.rigid import (
    inverse,
    rotation_from_vector,
    transform,
    transform_from_rpy,
)
from tests.arm_states import arm_state
from tests.fingertips import fingertip
from tests.scenes import make_weightless

Floats = NDArray[np.float64]

START_NS = 7_000_000_000_000
RATE_HZ = 50
STROKE_S = 1.0
OFF_M, TURNED_RAD = 2e-4, 3e-3
"""Constant position and rotation error of the sheet."""

LATENCY_S = 0.008
FAULT_S, ESTOP_S, SILENCE_S, BOOKMARK_S = 2.0, 2.1, (1.0, 1.8), 1.5
ENDS_S = 3.0
SCENE: Scene = make_weightless(load_scene(Path("launch/scenes/cylinder.yaml")))


def target(pose: Floats, phase: Any = "contact", valid_at_ns: int = 0) -> SheetTarget:
    return SheetTarget(
        phase=phase,
        reason="ok",
        valid_at_ns=valid_at_ns,
        world_from_sheet=pose,
        twist_world=np.zeros(6),
        stretch_ratio=1.02,
        contact_world_m=np.zeros(3),
        normal_world=pose[:3, 2],
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.002,
    )


def sheet_at(angle_rad: float) -> Floats:
    """Return the pose of a tangent sheet at an angle around the cylinder, with an error."""
    solid = SCENE.object
    pose = solid.world_from_object
    turn = rotation_from_vector(np.array([-angle_rad - TURNED_RAD, 0.0, 0.0]))
    radius_m = solid.geometry.radius_m + OFF_M  # type: ignore[union-attr]  # it is a cylinder
    # Its point nearest to the axis lies in the direction of its normal.
    local = transform(turn, turn @ np.array([0.0, 0.0, radius_m]))
    return np.asarray(transform_from_rpy(pose.position_m, pose.rpy_rad) @ local)


def flange(side: Side, world_from_sheet: Floats) -> Floats:
    arm = SCENE.arms.left if side == "left" else SCENE.arms.right
    half_m = 0.5 * SCENE.sheet.width_m * (-1.0 if side == "left" else 1.0)
    edge = world_from_sheet @ transform(np.eye(3), np.array([half_m, 0.0, 0.0]))
    grip = transform_from_rpy(arm.flange_from_edge.position_m, arm.flange_from_edge.rpy_rad)
    return np.asarray(edge @ inverse(grip))


def finger_at(angle_rad: float) -> Floats:
    centre = SCENE.object.world_from_object.position_m
    radius_m = SCENE.object.geometry.radius_m  # type: ignore[union-attr]  # it is a cylinder
    return np.asarray(centre + radius_m * np.array([0.0, np.sin(angle_rad), np.cos(angle_rad)]))


class MessageWriter:
    """A writer of messages with their headers."""

    def __init__(self, writer: BagWriter, leave_out: Collection[str]) -> None:
        self._writer, self._leave_out = writer, leave_out
        self._sequences: dict[str, int] = {}

    def skip(self, topic: str) -> None:
        """Skip a sequence number, as if the message was lost before the recorder."""
        self._sequences[topic] = self._sequences.get(topic, 0) + 1

    def write(
        self, topic: str, message: Message, seconds: float, *, age_s: float = 0.0, writer: str = "n"
    ) -> None:
        """Write a message at a time (s), with a source timestamp that is `age_s` earlier."""
        self.skip(topic)
        if topic in self._leave_out:
            return
        at_ns = START_NS + round(seconds * 1e9)
        source_ns = at_ns - round(age_s * 1e9)
        header = Header(self._sequences[topic], source_ns, at_ns, "clock", writer, 1)
        self._writer.write(TOPICS[topic], message, header, at_ns)


def write_session(path: Path, *, leave_out: Collection[str] = ()) -> Path:
    """Write a bag of three seconds: a stroke of one second, then faults and a bookmark."""
    begin_s, finish_s = stroke_window_s(STROKE_S)
    recording = {"clock_id": "clock", "started": "2026-11-22T10:00:00+00:00",
                 "started_ns": str(START_NS)}  # fmt: skip
    with BagWriter(path, {"recording": recording}) as writer:
        writer.add_attachment("git.json", b'{"commit": "abc"}', "application/json")
        desk = MessageWriter(writer, leave_out)
        desk.write("scene", SCENE, 0.0)
        for i in range(round(ENDS_S * RATE_HZ)):
            seconds = i / RATE_HZ
            _write_step(desk, i, seconds, begin_s, finish_s)
        desk.write("bookmark", Bookmark(label="<b>first touch</b>"), BOOKMARK_S)
        desk.write("estop", EStop(engaged=True, reason="a person"), ESTOP_S, writer="console")
        port = PortStatus(topic="fingertip", rate_hz=50.0, age_s=0.01, messages=90, dropped=5,
                          gaps=2, rejected=1)  # fmt: skip
        status = Status(node="planner", state="degraded", pid=1, uptime_s=1.0, cpu_ratio=0.25,
                        resident_bytes=10**8, inputs=(port,), outputs=(), errors=3,
                        last_error="on_fingertip: bang",
                        notes=(Note(detail="strokes"),), plan_hash="")  # fmt: skip
        desk.write("status", status, 2.5)
    return path


def _write_step(
    desk: MessageWriter, i: int, seconds: float, begin_s: float, finish_s: float
) -> None:
    share = np.clip((seconds - begin_s) / (finish_s - begin_s), 0.0, 1.0)
    angle_rad = float(np.radians(60.0) * share)
    tip, pose = finger_at(angle_rad), sheet_at(angle_rad)
    recorded_s = seconds + LATENCY_S
    true = TwinFinger(path_label=stroke_label(STROKE_S), path_done=False, path_time_s=seconds,
                      position_world_m=tip,
                      velocity_world_m_per_s=np.zeros(3))  # fmt: skip
    desk.write("twin/finger", true, seconds)
    if not SILENCE_S[0] < seconds < SILENCE_S[1] - 1e-9:
        desk.write("fingertip", fingertip(tip), recorded_s, age_s=LATENCY_S)
    else:
        desk.skip("fingertip")
    sheet_target = target(pose, valid_at_ns=START_NS + round(seconds * 1e9))
    desk.write("sheet_target", sheet_target, recorded_s, age_s=LATENCY_S)
    for side in ("left", "right"):
        desk.write(f"arm_{side}", _arm(side, seconds, pose), seconds + 1e-3, age_s=1e-3)
    arms = TwinArms(joints_left_rad=np.zeros(6), joints_right_rad=np.zeros(6),
                    world_from_flange_left=flange("left", pose),
                    world_from_flange_right=flange("right", pose))  # fmt: skip
    desk.write("twin/arms", arms, seconds)
    if i % 50 == 10:
        grey = np.full((30, 40), 10 * (i // 50), np.uint8)
        stereo = StereoPair(device="t", exposure_s=0.001, dropped_frames=0, left=grey, right=grey)
        desk.write("stereo", stereo, recorded_s, age_s=LATENCY_S)
        colour = np.zeros((24, 32, 3), np.uint8)
        eye = TwinEye(label="look", correction="two_pass", metres_per_px=1e-3, seen=colour,
                      expected=colour)  # fmt: skip
        desk.write("twin/eye", eye, recorded_s)
        desk.write("frame", _frame(pose, colour), recorded_s + 0.02, age_s=0.028)
    body = SoftBody(mesh_id="a", method="linear", in_range=i % 10 > 0, push_depth_m=0.002,
                    force_world_n=np.array([0.0, 0.0, 0.5]), stiffness_n_per_m=100.0,
                    displacement_world_m=np.zeros((0, 3), np.float32))  # fmt: skip
    desk.write("soft_body", body, recorded_s, age_s=LATENCY_S)


def _arm(side: Side, seconds: float, pose: Floats) -> ArmState:
    faulty = side == "left" and seconds >= FAULT_S
    now_ns = START_NS + round(seconds * 1e9)
    return arm_state(
        side,
        mode="fault" if faulty else "follow",
        faults=("joint 3 is hot",) if faulty else (),
        # 3.3 rad/s of joint 2, which can do 1.57.
        joints_rad=np.array([0.0, 3.3 * seconds if side == "right" else 0.0, 0, 0, 0, 0]),
        world_from_flange=flange(side, pose),
        target_source_ns=now_ns - round(5e-3 * 1e9),
        command_sent_ns=now_ns,
        edge_force_n=25.0 if side == "left" else 5.0,
    )


def _frame(pose: Floats, colour: NDArray[np.uint8]) -> Frame:
    return Frame(
        number=1,
        correction="two_pass",
        stereo="mono",
        label="look",
        eyes_world_m=np.zeros((2, 3)),
        world_from_sheet=pose,
        pushed_point_world_m=np.zeros(3),
        predicted_to_ns=0,
        draw_s=0.01,
        late_frames=0,
        pixels=(colour,),
    )
