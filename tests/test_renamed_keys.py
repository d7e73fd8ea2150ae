"""Old names of public keys and fields: bags that have them are read, files get a clear error."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest
from ruamel.yaml import YAML

from flexsheet.launch.plans import renamed_keys
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_plan, load_scene
from flexsheet.messages import migrations
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Display, Frame, SheetReason, SheetTarget
from flexsheet.nodes import node_class
from flexsheet.nodes.node import parameters_of

OLD_BAG = Path(__file__).parent / "recorded" / "before-migrations.mcap"
SCENE_FILE = Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml"
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
    fields = parameters_of(node_class(node_type)).model_fields
    assert new in fields
    assert old not in fields
    file = tmp_path / "old.yaml"
    nodes = {"one": {"type": node_type, "parameters": {old: 0.1}}}
    YAML().dump({"nodes": nodes}, file)
    with pytest.raises(BadInputError, match=f'unknown key "{old}"; it is now "{new}"'):
        load_plan(file)


@pytest.mark.parametrize("old", renamed_keys.VALUES["compliance_mode"])
def test_an_old_value_of_a_parameter_gets_an_error_that_names_the_new_one(
    tmp_path: Path, old: str
) -> None:
    file = tmp_path / "old.yaml"
    nodes = {"one": {"type": "planner", "parameters": {"compliance_mode": old}}}
    YAML().dump({"nodes": nodes}, file)
    new = renamed_keys.VALUES["compliance_mode"][old]
    with pytest.raises(BadInputError, match=f'compliance_mode.*it is now "{new}"'):
        load_plan(file)


@pytest.mark.parametrize("old", renamed_keys.VALUES["sheet_shape"])
def test_an_old_method_in_a_scene_gets_an_error_that_names_the_new_one(
    tmp_path: Path, old: str
) -> None:
    content = YAML(typ="safe").load(SCENE_FILE.read_text())
    content["methods"] = {"sheet_shape": old}
    file = tmp_path / "scene.yaml"
    YAML().dump(content, file)
    new = renamed_keys.VALUES["sheet_shape"][old]
    with pytest.raises(BadInputError, match=f'sheet_shape.*it is now "{new}"'):
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
    migration = migrations.migration_for(TYPES[type_name], "0" * 16, recorded)
    assert migration is not None
    assert migration({old: 0.25}) == {new: 0.25}


def test_a_recorded_value_of_an_old_name_is_read() -> None:
    recorded: dict[str, Any] = Display.model_json_schema()
    pattern = recorded["properties"]["pattern"]
    pattern["enum"] = [one.replace("coordinate_ramp", "places") for one in pattern["enum"]]
    migration = migrations.migration_for(Display, "0" * 16, recorded)
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
    migration = migrations.migration_for(SheetTarget, "0" * 16, recorded)
    assert migration is not None
    assert reason in get_args(SheetReason)
    assert migration({"reason": text}) == {"reason": reason}
    assert migration({"reason": reason}) == {"reason": reason}


def test_a_recorded_value_within_a_part_is_read() -> None:
    recorded: dict[str, Any] = Scene.model_json_schema()
    options = recorded["$defs"]["Methods"]["properties"]["sheet_shape"]["anyOf"]
    options[0]["enum"] = ["flat", "four_triangles", "dents"]
    migration = migrations.migration_for(Scene, "0" * 16, recorded)
    assert migration is not None
    scene = {"methods": {"sheet_shape": "dents", "correction": "two_pass"}}
    assert migration(scene) == {
        "methods": {"sheet_shape": "reduced_order", "correction": "two_pass"}
    }


def test_a_value_that_never_was_is_not_read() -> None:
    recorded: dict[str, Any] = Display.model_json_schema()
    recorded["properties"]["pattern"]["enum"].append("stripes")
    assert migrations.migration_for(Display, "0" * 16, recorded) is None


def test_the_old_bag_is_read_with_todays_names() -> None:
    frames = [message for name, message, *_ in BagReader(OLD_BAG) if name == "frame"]
    assert frames
    assert all(isinstance(one, Frame) and one.occluded_fraction >= 0.0 for one in frames)
