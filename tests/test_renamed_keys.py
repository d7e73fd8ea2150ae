"""Test renamed keys and fields. Old bags are read, and old files cause an error with the new
name.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from pydantic import create_model
from ruamel.yaml import YAML

from flexsheet.launch.bags.replay import read_runs
from flexsheet.launch.plans import renamed_keys
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages import migrations
from flexsheet.messages.bag import BagReader, BagWriter, recover
from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS, Delivery, Topic, UnknownTopicError, find_topic
from flexsheet.messages.types import (
    Bookmark,
    Display,
    HostStatus,
    SheetReason,
    SheetTarget,
    Status,
)
from flexsheet.nodes import node_class
from flexsheet.nodes.node import find_parameters_type
from tests.scenes import load_values

TYPES: dict[str, type[Message]] = {
    topic.message.__name__: topic.message for topic in TOPICS.values()
}


@pytest.mark.parametrize(
    ("node_type", "old", "new"),
    [(node, *names) for node, table in renamed_keys.NODE_PARAMETERS.items()
     for names in table.items()],
)  # fmt: skip
def test_an_old_parameter_gets_an_error_that_names_the_new_one(
    tmp_path: Path, node_type: str, old: str, new: str
) -> None:
    fields = find_parameters_type(node_class(node_type)).model_fields
    assert new in fields
    assert old not in fields
    file = tmp_path / "old.yaml"
    nodes = {"one": {"type": node_type, "parameters": {old: 0.1}}}
    YAML().dump({"nodes": nodes}, file)
    with pytest.raises(BadInputError, match=f'unknown key "{old}"; it was renamed to "{new}"'):
        load_graph(file)


def test_a_class_path_of_a_shipped_node_gets_the_same_error(tmp_path: Path) -> None:
    file = tmp_path / "old.yaml"
    node_type = "flexsheet.nodes.renderer.node:Renderer"
    YAML().dump({"nodes": {"one": {"type": node_type, "parameters": {"lead_s": 0.1}}}}, file)
    with pytest.raises(BadInputError, match='it was renamed to "prediction_horizon_s"'):
        load_graph(file)


def test_the_former_key_of_external_topics_gets_an_error_that_names_the_new_one(
    tmp_path: Path,
) -> None:
    file = tmp_path / "old.yaml"
    YAML().dump({"nodes": {}, "from_tools": ["fingertip"]}, file)
    with pytest.raises(BadInputError, match='"from_tools"; it was renamed to "external_topics"'):
        load_graph(file)


@pytest.mark.parametrize("old", renamed_keys.VALUES["compliance_mode"])
def test_an_old_value_of_a_parameter_gets_an_error_that_names_the_new_one(
    tmp_path: Path, old: str
) -> None:
    file = tmp_path / "old.yaml"
    nodes = {"one": {"type": "planner", "parameters": {"compliance_mode": old}}}
    YAML().dump({"nodes": nodes}, file)
    new = renamed_keys.VALUES["compliance_mode"][old]
    with pytest.raises(BadInputError, match=f'compliance_mode.*it was renamed to "{new}"'):
        load_graph(file)


@pytest.mark.parametrize("old", renamed_keys.VALUES["sheet_shape"])
def test_an_old_method_in_a_scene_gets_an_error_that_names_the_new_one(
    tmp_path: Path, old: str
) -> None:
    content = load_values()
    content["methods"] = {"sheet_shape": old}
    file = tmp_path / "scene.yaml"
    YAML().dump(content, file)
    new = renamed_keys.VALUES["sheet_shape"][old]
    with pytest.raises(BadInputError, match=f'sheet_shape.*it was renamed to "{new}"'):
        load_scene(file)


@pytest.mark.parametrize(
    ("type_name", "old", "new"),
    [(name, *names) for name, table in migrations.RENAMED_FIELDS.items()
     for names in table.items() if name in TYPES],
)  # fmt: skip
def test_a_recorded_field_of_an_old_name_is_read(type_name: str, old: str, new: str) -> None:
    today = TYPES[type_name].model_json_schema()
    recorded = today | {
        "properties": {{new: old}.get(name, name): one for name, one in today["properties"].items()}
    }
    migration = migrations.find_migration(TYPES[type_name], "0" * 16, recorded)
    assert migration is not None
    assert migration({old: 0.25}) == {new: 0.25}


def test_a_recorded_value_of_an_old_name_is_read() -> None:
    recorded: dict[str, Any] = Display.model_json_schema()
    pattern = recorded["properties"]["pattern"]
    pattern["enum"] = [one.replace("coordinate_ramp", "places") for one in pattern["enum"]]
    migration = migrations.find_migration(Display, "0" * 16, recorded)
    assert migration is not None
    assert migration({"pattern": "places_x"}) == {"pattern": "coordinate_ramp_x"}
    assert migration({"pattern": "grid"}) == {"pattern": "grid"}


@pytest.mark.parametrize(
    ("text", "reason"),
    [*migrations.SHEET_REASONS.items(), ("fingertip: two_markers", "fingertip_invalid"),
     ("fingertip is 150 ms old", "fingertip_too_old"),
     ("fingertip is -20 ms old", "fingertip_in_future")],
)  # fmt: skip
def test_the_recorded_text_of_a_sheet_target_is_read_as_its_reason(text: str, reason: str) -> None:
    recorded: dict[str, Any] = SheetTarget.model_json_schema()
    recorded["properties"]["reason"] = {"type": "string"}
    migration = migrations.find_migration(SheetTarget, "0" * 16, recorded)
    assert migration is not None
    assert reason in get_args(SheetReason)
    assert migration({"reason": text}) == {"reason": reason}
    assert migration({"reason": reason}) == {"reason": reason}


def test_a_recorded_value_within_a_part_is_read() -> None:
    recorded: dict[str, Any] = Scene.model_json_schema()
    options = recorded["$defs"]["Methods"]["properties"]["sheet_shape"]["anyOf"]
    options[0]["enum"] = ["flat", "four_triangles", "dents"]
    migration = migrations.find_migration(Scene, "0" * 16, recorded)
    assert migration is not None
    scene = {"methods": {"sheet_shape": "dents", "correction": "two_pass"}}
    assert migration(scene) == {
        "methods": {"sheet_shape": "reduced_order", "correction": "two_pass"}
    }


def test_a_value_that_never_was_is_not_read() -> None:
    recorded: dict[str, Any] = Display.model_json_schema()
    recorded["properties"]["pattern"]["enum"].append("stripes")
    assert migrations.find_migration(Display, "0" * 16, recorded) is None


class Moment(Bookmark):
    """The message type `Bookmark` under its former name."""


def with_old_names(message_type: type[Message], names: dict[str, str]) -> type[Message]:
    """Return a message type with former field names.

    names: former names of fields, by current name.
    """
    hints = get_type_hints(message_type, include_extras=True)
    fields: dict[str, Any] = {
        names.get(name, name): (hints[name], field)
        for name, field in message_type.model_fields.items()
    }
    return create_model(message_type.__name__, __base__=Message, **fields)


@pytest.fixture
def bag_with_old_names(tmp_path: Path) -> Path:
    path = tmp_path / "before.mcap"
    header = Header(1, 10, 11, "clock", "planner", 5, "plan")
    old_status = with_old_names(Status, {"execution_log": "taken"})
    steps = np.array([[0, 1, 5, 20], [-1, 0, 0, 30]], dtype=np.int64)
    status = old_status(
        node="planner", state="running", pid=1, uptime_s=1.0, cpu_ratio=0.0, resident_bytes=0,
        inputs=(), outputs=(), errors=0, last_error="", note="", plan_hash="", taken=steps,
    )  # fmt: skip
    with BagWriter(path, {"recording": {"clock_id": "clock"}}) as writer:
        for topic, message in (("moment", Moment(label="touch")), ("status", status)):
            row = Topic(topic, type(message), Delivery.EVERY, None, True, "as recorded then")
            writer.write(row, message, header, 100)
    return path


def test_a_bag_with_old_topic_type_and_field_names_is_read_and_replayed(
    bag_with_old_names: Path, tmp_path: Path
) -> None:
    repaired = tmp_path / "repaired.mcap"
    recover(bag_with_old_names, repaired)
    for path in (bag_with_old_names, repaired):
        reader = BagReader(path)
        assert reader.topics == {"bookmark": "Bookmark", "status": "Status"}
        assert all(topic.readable for topic in reader.info().topics)
        found = {name: message for name, message, *_ in reader}
        assert found["bookmark"] == Bookmark(label="touch")
        by_old_name = [message for _, message, *_ in BagReader(path, ["moment"])]
        assert by_old_name == [Bookmark(label="touch")]
        (run,) = read_runs(path, "planner")
        assert run.steps.tolist() == [[0, 1, 5, 20], [-1, 0, 0, 30]]


def test_a_recorded_value_within_a_list_of_parts_is_read() -> None:
    recorded: dict[str, Any] = HostStatus.model_json_schema()
    recorded["$defs"]["NodeProcess"]["properties"]["state"]["enum"] = ["starting", "ready", "away"]
    migration = migrations.find_migration(HostStatus, "0" * 16, recorded)
    assert migration is not None
    nodes = [{"name": "one", "state": "away"}, {"name": "two", "state": "ready"}]
    states = [one["state"] for one in migration({"nodes": nodes})["nodes"]]
    assert states == ["exited", "ready"]


@pytest.mark.parametrize(("old", "new"), migrations.RENAMED_TOPICS.items())
def test_an_old_topic_gets_an_error_that_names_the_new_one(old: str, new: str) -> None:
    assert new in TOPICS
    with pytest.raises(
        UnknownTopicError, match=f'unknown topic "{old}"; it was renamed to "{new}"'
    ):
        find_topic(old)


@pytest.mark.parametrize("key", sorted({"kinematics", "triangulation"} | renamed_keys.REMOVED_KEYS))
def test_a_removed_method_in_a_scene_gets_an_error_with_a_remedy(tmp_path: Path, key: str) -> None:
    content = load_values()
    content["methods"] = {key: "any"}
    file = tmp_path / "scene.yaml"
    YAML().dump(content, file)
    words = f'unknown key "{key}"; remove the key, because only one method is left'
    with pytest.raises(BadInputError, match=words):
        load_scene(file)


@pytest.mark.parametrize("old", renamed_keys.VALUES["arming"])
def test_an_old_arming_gets_an_error_that_names_the_new_one(tmp_path: Path, old: str) -> None:
    file = tmp_path / "old.yaml"
    nodes = {"one": {"type": "arm_bridge", "parameters": {"side": "left", "arming": old}}}
    YAML().dump({"nodes": nodes}, file)
    with pytest.raises(
        BadInputError, match=f'it was renamed to "{renamed_keys.VALUES["arming"][old]}"'
    ):
        load_graph(file)
