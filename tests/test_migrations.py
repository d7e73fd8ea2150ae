"""Test that the current message types can read bags of earlier versions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from flexsheet.messages import migrations
from flexsheet.messages.arms_calibration import ArmBase, ArmsCalibration
from flexsheet.messages.bag import BagError, BagReader, BagWriter, info
from flexsheet.messages.base import Header, Message, compute_fingerprint
from flexsheet.messages.marker_calibration import MarkerCalibration, load_marker_calibration
from flexsheet.messages.migrations import find_migration, is_compatible, rename_fields
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.topics import TOPICS, Delivery, Topic
from flexsheet.messages.types import Fingertip, Frame, TwinFinger
from tests.examples import examples

OLD_BAG = Path(__file__).parent / "recorded" / "before-migrations.mcap"
CALIBRATIONS = (ArmsCalibration, MarkerCalibration, SheetCalibration)
HEADER = Header(1, 10, 11, "clock", "node", 5, "plan")


def test_a_bag_from_before_any_migration_is_read_whole() -> None:
    summary = info(OLD_BAG)
    assert {topic.name for topic in summary.topics if topic.readable} == set(
        BagReader(OLD_BAG).topics
    )
    found = {name: message for name, message, _, _ in BagReader(OLD_BAG)}
    scene, frame, finger = found["scene"], found["frame"], found["fingertip"]
    assert isinstance(scene, Scene)
    assert scene.name == "cylinder"
    assert isinstance(frame, Frame)
    assert frame.light_ns == 0, "a field that came later has its default"
    assert frame.occluded_fraction >= 0.0
    assert isinstance(finger, Fingertip)
    assert np.isfinite(finger.position_world_m).all()
    assert len(finger.predicted_path_world_m) > 1
    assert finger.prediction_step_s > 0.0


def recorded_schema(name: str) -> dict[str, Any]:
    with OLD_BAG.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (schema,) = (one for one in summary.schemas.values() if one.name == name)
    return dict(json.loads(schema.data))


@pytest.mark.parametrize("kinematics", ["closed_form", "closed_form_continuous", None])
def test_a_recorded_scene_is_read_with_todays_methods_and_without_removed_ones(
    kinematics: str | None,
) -> None:
    recorded = next(message for name, message, *_ in BagReader(OLD_BAG) if name == "scene")
    fields = recorded.model_dump()
    fields["methods"] = {
        "kinematics": kinematics,
        "mark": "moments",
        "triangulation": "midpoint",
        "tracking": "hand",
    }
    migration = find_migration(Scene, "d7307561a5180666", recorded_schema("Scene"))
    assert migration is not None
    methods = Scene.model_validate(migration(fields)).methods
    assert not hasattr(methods, "kinematics")
    assert not hasattr(methods, "triangulation")
    assert (methods.marker, methods.tracking) == ("moments", "adaptive")


@pytest.mark.parametrize(("label", "seconds"), [("stroke 2.5 s", 2.5), ("push 30 mm", None)])
def test_a_recorded_stroke_has_its_duration(label: str, seconds: float | None) -> None:
    finger = next(message for name, message, *_ in BagReader(OLD_BAG) if name == "twin/finger")
    migration = find_migration(TwinFinger, "c1881b3029f02367", recorded_schema("TwinFinger"))
    assert migration is not None
    recorded = finger.model_dump(exclude={"path_stroke_s"}) | {"path_label": label}
    assert TwinFinger.model_validate(migration(recorded)).path_stroke_s == seconds


@pytest.mark.parametrize(
    ("model", "renamed"),
    [*migrations.RENAMED_FIELDS.items(), *migrations.RENAMED_VALUES.items()],
    ids=str,
)
def test_every_renaming_leads_to_a_name_of_today(
    model: str | tuple[str, str], renamed: dict[str, str]
) -> None:
    name, field = (model, None) if isinstance(model, str) else model
    kinds: list[Any] = [*(topic.message for topic in TOPICS.values()), *CALIBRATIONS]
    schemas = [kind.model_json_schema() for kind in kinds]
    parts = [part for schema in schemas for part in (schema, *schema.get("$defs", {}).values())]
    models = [part["properties"] for part in parts if part.get("title") == name]
    assert models
    for properties in models:
        text = json.dumps(properties if field is None else properties[field])
        assert all(f'"{new}"' in text for new in renamed.values())
        assert not any(f'"{old}"' in text for old in renamed)


class Before(Message):
    mode: Literal["on", "off"]
    size_mm: float
    note: str | None = None


class WithDefaults(Message):
    """A later version of `Before` that needs no migration."""

    mode: Literal["on", "off", "auto"]
    size_mm: float
    note: str | int | None = None
    rate_hz: float = 60.0


class Renamed(Message):
    mode: Literal["on", "off"]
    size_m: float
    note: str | None = None


class WithRequiredField(Before):
    rate_hz: float


class Narrower(Message):
    mode: Literal["on"]
    size_mm: float
    note: str | None = None


class WithoutField(Message):
    mode: Literal["on", "off"]
    note: str | None = None


class Retyped(Message):
    mode: Literal["on", "off"]
    size_mm: int
    note: str | None = None


@pytest.mark.parametrize("today", [Before, WithDefaults])
def test_gains_need_nothing(today: type[Message]) -> None:
    assert is_compatible(Before.model_json_schema(), today.model_json_schema())
    today.model_validate(Before(mode="on", size_mm=1.0).model_dump())


@pytest.mark.parametrize("today", [Renamed, WithRequiredField, Narrower, WithoutField, Retyped])
def test_anything_else_does(today: type[Message]) -> None:
    assert not is_compatible(Before.model_json_schema(), today.model_json_schema())
    fingerprint = compute_fingerprint(Before).hex()
    assert find_migration(today, fingerprint, Before.model_json_schema()) is None


@pytest.mark.parametrize("topic", TOPICS.values(), ids=lambda topic: topic.name)
def test_each_type_fits_itself(topic: Topic) -> None:
    schema = topic.message.model_json_schema()
    assert is_compatible(schema, schema)


def row(message_type: type[Message]) -> Topic:
    return Topic("size", message_type, Delivery.EVERY, None, True, "a size")


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a bag with a size in millimetres, and change the message type to metres."""
    path = tmp_path / "before.mcap"
    with BagWriter(path) as writer:
        writer.write(row(Before), Before(mode="off", size_mm=2.5), HEADER, 10)
    monkeypatch.setitem(TOPICS, "size", row(renamed()))
    return path


def renamed() -> type[Message]:
    class Before(Message):
        mode: Literal["on", "off"]
        size_m: float
        note: str | None = None

    return Before


KEY = ("Before", compute_fingerprint(Before).hex())


def test_a_renamed_field_is_followed_by_a_migration(
    changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BagError, match=r"has other fields than the current one.*migrations\.py"):
        list(BagReader(changed))
    assert not info(changed).topics[0].readable

    def in_metres(fields: dict[str, Any]) -> dict[str, Any]:
        size_m = fields["size_mm"] * 1e-3
        return {"mode": fields["mode"], "size_m": size_m, "note": fields["note"]}

    monkeypatch.setitem(migrations.MIGRATIONS, KEY, in_metres)
    ((_, message, header, log_time_ns),) = BagReader(changed)
    assert message.model_dump() == {"mode": "off", "size_m": 0.0025, "note": None}
    assert (header, log_time_ns) == (HEADER, 10)


def test_a_migration_that_gives_a_wrong_field_is_an_error(
    changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(migrations.MIGRATIONS, KEY, lambda fields: {"mode": "sideways"})
    with pytest.raises(BagError, match=r'topic "size", message 0 .*mode'):
        list(BagReader(changed))


@examples(40)
@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text(),
                    lambda parts: st.lists(parts) | st.dictionaries(
                        st.sampled_from(["$ref", "properties", "required", "enum", "anyOf",
                                         "items", "type", "$defs"]), parts)))  # fmt: skip
def test_a_damaged_schema_fits_nothing_and_breaks_nothing(schema: Any) -> None:
    if schema != {}:
        assert not is_compatible(schema, Before.model_json_schema())


def test_a_calibration_file_with_former_keys_is_read(tmp_path: Path) -> None:
    file = tmp_path / "marker.yaml"
    file.write_text(
        "{version: 1, date: '2026-01-01', code_version: '', source: rows.csv, scene: cylinder, "
        "marker_from_pad_m: [0.01, 0.0, 0.0], standard_deviations_m: [1e-4, 1e-4, 1e-4], "
        "point_offset_m: [0.0, 0.0, 0.0], residual_rms_m: 1e-4, residual_worst_m: 3e-4, "
        "touches: 12, orientations: 4}"
    )
    assert load_marker_calibration(file).max_residual_m == 3e-4
    arm = {"places": [{"turn_rad": 0.1}], "largest_change_m": 0.2}
    assert rename_fields(ArmBase, arm) == {"poses": [{"rotation_rad": 0.1}], "max_change_m": 0.2}
