"""Test replay: recorded clock, due timers, and the detection of random behaviour."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.bags.player import shift_stamps
from flexsheet.launch.bags.replay import compute_field_differences, replay, verify
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.base import Header, Message, Stamp, find_stamp_fields
from flexsheet.messages.topics import TOPICS, Topic
from flexsheet.messages.types import EStop, SheetTarget, TwinFinger
from flexsheet.messages.wire import decode

MS = 1_000_000


def finger(number: int) -> TwinFinger:
    return TwinFinger(
        path_label="",
        path_done=False,
        path_time_s=float(number),
        position_world_m=np.zeros(3),
        velocity_world_m_per_s=np.zeros(3),
    )


def bag_of(folder: Path, *, log_ms: list[int], **parameters: Any) -> Path:
    """Write a bag with fingers, each exposed 5 ms before it was recorded, for a relay."""
    relay = {"type": "tests.launch_nodes:Relay", "parameters": parameters}
    graph = {"nodes": {"relay": relay}, "external_topics": ["twin/finger"]}
    (folder / "graph.yaml").write_text(json.dumps(graph))
    plan = load_graph(folder / "graph.yaml")
    bag = folder / "a.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "lab"}}) as writer:
        writer.add_attachment("plan.json", plan.model_dump_json().encode(), "application/json")
        for number, at_ms in enumerate(log_ms, 1):
            stamp_ns = (at_ms - 5) * MS
            header = Header(number, stamp_ns, stamp_ns, "lab", "tools", 3)
            writer.write(TOPICS["twin/finger"], finger(number), header, at_ms * MS)
    return bag


async def test_timers_come_due_between_messages_on_the_recorded_clock(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, log_ms=[1000, 1120, 1310], rate_hz=10)
    plan = load_graph(tmp_path / "graph.yaml")
    result = await replay(bag, plan.nodes["relay"])
    printed = [decode(one.data, TOPICS["estop"]) for one in result.sent]
    # Due at 1000 (before the first finger), 1100, 1200 and 1300.
    assert [header.source_ns // MS for _, header in printed] == [1000, 1100, 1200, 1300]
    ages = [message.reason for message, _ in printed if isinstance(message, EStop)]
    assert ages == ["inf ms ", "105 ms ", "85 ms ", "185 ms "]
    assert result.messages_in == 3
    assert all(header.epoch == 0 for _, header in printed)


def test_the_same_bag_gives_the_same_bytes(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, log_ms=[1000, 1500])
    first, second = verify(bag, "relay"), verify(bag, "relay")
    assert first.ok
    assert first.same_bytes
    assert first.messages_out == 6
    assert first.digest == second.digest


def test_a_node_that_throws_dice_is_found_out(tmp_path: Path) -> None:
    result = verify(bag_of(tmp_path, log_ms=[1000, 1500], random=True), "relay")
    assert not result.same_bytes
    assert not result.ok


def test_inputs_that_were_not_recorded_are_named(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, log_ms=[])
    with pytest.raises(BagError, match="does not contain twin/finger, which relay reads"):
        verify(bag, "relay")


@pytest.mark.parametrize(("live", "again", "size"), [
    (float("nan"), 1.0, float("inf")),
    (float("inf"), 1.0, float("inf")),
    (float("nan"), float("nan"), 0.0),
    (float("inf"), float("inf"), 0.0),
    (True, False, 1.0),
])  # fmt: skip
def test_what_is_no_number_differs_from_what_is_one(live: float, again: float, size: float) -> None:
    path = finger(1)
    one, other = (
        path.model_copy(
            update={"path_time_s": value, "position_world_m": np.array([0.0, value, 0.0])}
        )
        for value in (live, again)
    )
    expected = {} if size == 0.0 else {"path_time_s": size, "position_world_m": size}
    assert compute_field_differences(one, other) == expected


def test_differences_are_found_field_by_field() -> None:
    one = finger(1)
    other = one.model_copy(
        update={"position_world_m": np.array([0.0, 0.0, 2e-3]), "path_label": "x"}
    )
    assert compute_field_differences(one, other) == {"position_world_m": 2e-3, "path_label": 1.0}
    assert compute_field_differences(one, one) == {}
    assert compute_field_differences(one, finger(4)) == {"path_time_s": 3.0}


def test_instants_in_a_message_move_with_its_stamps() -> None:
    target = SheetTarget(
        phase="contact",
        reason="ok",
        valid_at_ns=5_000,
        world_from_sheet=np.eye(4),
        twist_world=np.zeros(6),
        stretch_ratio=1.02,
        contact_world_m=np.zeros(3),
        normal_world=np.array([0.0, 0.0, 1.0]),
        contact_sheet_m=np.zeros(2),
        push_depth_m=0.0,
    )
    moved = shift_stamps(target, 700)
    assert isinstance(moved, SheetTarget)
    assert moved.valid_at_ns == 5_700
    never = target.model_copy(update={"valid_at_ns": 0})
    assert shift_stamps(never, 700) is never


class Timed(Message):
    seen_ns: Stamp
    duration_ns: int


def test_a_duration_is_no_instant() -> None:
    assert shift_stamps(Timed(seen_ns=10, duration_ns=20), 5) == Timed(seen_ns=15, duration_ns=20)


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda topic: topic.name)
def test_every_instant_of_a_message_is_marked(topic: Topic) -> None:
    named = {name for name in topic.message.model_fields if name.endswith("_ns")}
    assert named == set(find_stamp_fields(topic.message))
