"""Write a small bag with one message of most topics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import ArmState, EStop, Skin, SoftBody, StereoPair
from flexsheet.nodes.models.rigid import transform
from tests.arm_states import arm_state
from tests.fingertips import fingertip

SCENE = load_scene(Path("launch/scenes/cylinder.yaml"))
STARTED, STARTED_NS = "2026-11-22T10:00:00+00:00", 5_000_000_000
STEP_NS = 10_000_000
TIP = np.array([0.01, 0.02, 0.03])
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
DENT = np.array([[0, 0, -0.5], [0, 0, 0], [0, 0, 0]], np.float32)
LEFT = np.arange(12, dtype=np.uint8).reshape(3, 4)


def arm(side: str, x_m: float) -> ArmState:
    flange = transform(np.eye(3), np.array([x_m, 0.0, 0.0]))
    return arm_state(side, world_from_flange=flange, edge_distance_m=0.24)


RECORDED: tuple[tuple[str, Message], ...] = (
    ("scene", SCENE),
    ("skin", Skin(mesh_id="a", vertices_world_m=VERTICES, triangles=np.array([[0, 1, 2]], "i4"))),
    ("fingertip", fingertip(TIP, np.array([0.1, 0.0, 0.0]))),
    ("arm_left", arm("left", -0.15)),
    ("arm_right", arm("right", 0.15)),
    ("soft_body", SoftBody(mesh_id="a", method="linear", in_range=True, push_depth_m=0.001,
                           force_world_n=np.zeros(3), stiffness_n_per_m=50.0,
                           displacement_world_m=DENT)),
    ("stereo", StereoPair(device="t", exposure_s=0.001, dropped_frames=0, left=LEFT,
                          right=LEFT[:, ::-1].copy())),
    ("estop", EStop(engaged=True, reason="a person")),
)  # fmt: skip


def write_example(path: Path, recorded: tuple[tuple[str, Message], ...] = RECORDED) -> Path:
    """Write the messages to a bag, at intervals of STEP_NS from the time STARTED."""
    recording = {"clock_id": "c", "started": STARTED, "started_ns": str(STARTED_NS)}
    with BagWriter(path, {"recording": recording}) as writer:
        for number, (topic, message) in enumerate(recorded):
            at_ns = STARTED_NS + number * STEP_NS
            writer.write(TOPICS[topic], message, Header(1, at_ns, at_ns, "c", "node", 1), at_ns)
    return path
