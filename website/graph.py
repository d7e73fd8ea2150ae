"""Define the drawings of the node graph in the documentation.

The positions of boxes and arrows are constants.  A test compares the arrows with the launch files.
"""

from __future__ import annotations

from flexsheet.launch.plans.drawing import Arrow, GraphDrawing, Position


def _arrow(writer: str, reader: str, topics: str, path: str, label_at: Position) -> Arrow:
    return Arrow(writer, reader, tuple(topics.split(", ")), path, label_at)


def _wire(
    writer: str, reader: str, what: str, path: str, label_at: Position, *, both: bool = True
) -> Arrow:
    return Arrow(writer, reader, (), path, label_at, wire=what, is_bidirectional=both)


LAB = GraphDrawing(
    title="Three computers: nodes and topics",
    size=(960, 520),
    hosts={
        "main PC": (10, 10, 940, 290),
        "left arm's PC": (10, 350, 300, 75),
        "right arm's PC": (430, 350, 300, 75),
    },
    boxes={
        "camera": (90, 75),
        "triangulator": (290, 75),
        "planner": (540, 75),
        "fem_solver": (540, 165),
        "renderer": (790, 165),
        "recorder": (860, 75),
        "arm_left_bridge": (160, 395),
        "arm_right_bridge": (580, 395),
    },
    devices={"left RV-1A": (160, 490), "right RV-1A": (580, 490), "projector": (860, 490)},
    arrows=(
        _arrow("camera", "triangulator", "stereo", "156,75 224,75", (190, 68)),
        _arrow("triangulator", "planner", "fingertip", "356,75 474,75", (415, 68)),
        _arrow("triangulator", "fem_solver", "fingertip", "310,92 310,165 474,165", (390, 158)),
        _arrow(
            "triangulator", "renderer", "fingertip", "270,92 270,225 760,225 760,182", (380, 218)
        ),
        _arrow("fem_solver", "planner", "soft_body", "520,148 520,92", (486, 124)),
        _arrow("planner", "renderer", "sheet_target", "606,75 730,75 730,148", (668, 68)),
        _arrow("fem_solver", "renderer", "skin, soft_body", "606,165 724,165", (678, 158)),
        _arrow("renderer", "recorder", "frame", "830,148 830,92", (852, 124)),
        _arrow(
            "planner",
            "arm_left_bridge",
            "sheet_target",
            "580,92 580,130 625,130 625,265 130,265 130,378",
            (200, 258),
        ),
        _arrow("planner", "arm_right_bridge", "sheet_target", "625,265 625,378", (664, 285)),
        _arrow("arm_left_bridge", "arm_right_bridge", "arm_left", "226,388 514,388", (370, 381)),
        _arrow("arm_right_bridge", "arm_left_bridge", "arm_right", "514,404 226,404", (370, 418)),
        _arrow(
            "arm_left_bridge", "renderer", "arm_left", "190,378 190,322 790,322 790,182", (260, 316)
        ),
        _arrow("arm_right_bridge", "renderer", "arm_right", "646,388 820,388 820,182", (780, 381)),
        _arrow(
            "arm_left_bridge",
            "planner",
            "arm_latency",
            "660,322 660,112 590,112 590,92",
            (660, 245),
        ),
        _arrow(
            "arm_right_bridge",
            "planner",
            "arm_latency",
            "640,378 640,336 706,336 706,122 600,122 600,92",
            (712, 205),
        ),
        _wire("arm_left_bridge", "left RV-1A", "Modbus or MXT", "160,412 160,473", (215, 447)),
        _wire("arm_right_bridge", "right RV-1A", "Modbus or MXT", "580,412 580,473", (635, 447)),
        _wire("renderer", "projector", "light", "856,165 890,165 890,473", (908, 330), both=False),
    ),
)

TWIN = GraphDrawing(
    title="The simulator in place of finger, camera, arms and eye",
    size=(960, 300),
    hosts={"this computer": (10, 10, 940, 280)},
    boxes={
        "twin_finger": (100, 80),
        "camera": (310, 80),
        "twin_arms": (100, 220),
        "arm_left_bridge": (310, 190),
        "arm_right_bridge": (310, 250),
        "twin_eye": (600, 150),
        "recorder": (860, 150),
        "renderer": (600, 250),
        "fem_solver": (860, 250),
    },
    devices={},
    arrows=(
        _arrow("twin_finger", "camera", "twin/stereo", "166,80 244,80", (205, 73)),
        _arrow("twin_finger", "twin_eye", "twin/finger", "100,63 100,38 600,38 600,133", (490, 31)),
        _arrow("twin_arms", "twin_eye", "twin/arms", "100,203 100,140 534,140", (470, 133)),
        _wire(
            "arm_left_bridge", "twin_arms", "Modbus", "244,190 205,190 205,212 166,212", (205, 183)
        ),
        _wire(
            "arm_right_bridge", "twin_arms", "Modbus", "244,250 205,250 205,228 166,228", (205, 267)
        ),
        _arrow("renderer", "twin_eye", "frame", "600,233 600,167", (624, 204)),
        _arrow(
            "fem_solver",
            "twin_eye",
            "skin, soft_body",
            "860,233 860,200 645,200 645,167",
            (752, 193),
        ),
        _arrow("twin_eye", "recorder", "twin/eye", "666,150 794,150", (730, 143)),
    ),
)

DRAWINGS = {"graph.svg": LAB, "graph-twin.svg": TWIN}
