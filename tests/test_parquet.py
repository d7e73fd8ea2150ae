"""Test tables of bags: they are read back by pyarrow and contain the values of the messages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.bags.export import ExportError
from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import (
    HostKey,
    HostStatus,
    NodeProcess,
    SheetTarget,
    SheetTrajectory,
    TwinEye,
)
from flexsheet.nodes.models.rigid import rotation_from_rpy, transform
from tests.commands import Command
from tests.example_bag import DENT, LEFT, RECORDED, SCENE, STARTED_NS, STEP_NS, TIP, write_example

parquet = pytest.importorskip("pyarrow.parquet")

from flexsheet.launch.bags.parquet import list_columns, read_table, write_parquet  # noqa: E402

POSE = transform(rotation_from_rpy([0.0, 0.0, np.pi / 2]), np.array([1.0, 2.0, 3.0]))
TARGET = SheetTarget(
    phase="contact", reason="ok", valid_at_ns=STARTED_NS, world_from_sheet=POSE,
    twist_world=np.arange(6.0), stretch_ratio=1.1, contact_world_m=TIP, normal_world=TIP,
    contact_sheet_m=np.array([0.01, 0.02]), push_depth_m=0.003,
)  # fmt: skip
HOST = HostStatus(
    host="main", run="r", plan_hash="p", code="c", python="3.11", uptime_s=1.0, load_ratio=0.5,
    disk_free_bytes=1, memory_free_bytes=2, missing_devices=(), keys=(HostKey(host="a", key="b"),),
    nodes=(NodeProcess(name="planner", state="ready", restarts=0, hangs=1),),
)  # fmt: skip
FURTHER = (
    ("sheet_target", TARGET),
    ("sheet_target", TARGET.model_copy(
        update={"trajectory": SheetTrajectory(keep_s=0.1, brake_s=0.05)})),
    ("host", HOST),
)  # fmt: skip


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_example(tmp_path / "bag.mcap", RECORDED + FURTHER)


def test_every_topic_is_a_table_of_its_messages(bag: Path, tmp_path: Path) -> None:
    result = write_parquet(bag, tmp_path / "tables")
    tables = {path.name: parquet.read_table(path) for path in result.output.iterdir()}
    assert tables.keys() == {f"{topic}.parquet" for topic, _ in RECORDED + FURTHER}
    assert result.messages["sheet_target"] == tables["sheet_target.parquet"].num_rows == 2

    tip = tables["fingertip.parquet"].to_pylist()[0]
    assert (tip["log_time_ns"], tip["writer"]) == (STARTED_NS + 2 * STEP_NS, "node")
    assert tip["time_s"] == pytest.approx(0.02)
    assert [tip[f"position_world_m.{axis}"] for axis in "xyz"] == TIP.tolist()
    assert np.reshape(tip["covariance"], (6, 6)) == pytest.approx(np.eye(6) * 1e-8)
    path = tables["fingertip.parquet"].schema.field("predicted_path_world_m")
    assert path.metadata[b"shape"] == b"(points, 3)"
    body = tables["soft_body.parquet"].to_pylist()[0]
    assert np.reshape(body["displacement_world_m"], (-1, 3)).tolist() == DENT.tolist()
    scene = tables["scene.parquet"].to_pylist()[0]
    assert scene["sheet.width_m"] == SCENE.sheet.width_m
    assert json.loads(scene["object.geometry"])["shape"] == "cylinder"


def test_poses_twists_and_groups_have_named_columns(bag: Path) -> None:
    first, second = read_table(bag, "sheet_target").to_pylist()
    assert [first[f"world_from_sheet.{one}"] for one in ("x_m", "y_m", "z_m")] == [1.0, 2.0, 3.0]
    half = np.sqrt(0.5)
    assert [first[f"world_from_sheet.{one}"] for one in ("qx", "qy", "qz", "qw")] == pytest.approx(
        [0.0, 0.0, half, half]
    )
    assert first["twist_world.linear_y_m_per_s"] == 1.0
    assert first["twist_world.angular_z_rad_per_s"] == 5.0
    assert (first["trajectory.keep_s"], second["trajectory.keep_s"]) == (None, 0.1)
    host = read_table(bag, "host").to_pylist()[0]
    assert host["nodes"] == [{"name": "planner", "state": "ready", "restarts": 0, "hangs": 1}]
    assert host["estop"] is None


def test_images_are_written_only_on_request(bag: Path) -> None:
    assert "left" not in read_table(bag, "stereo").column_names
    row = read_table(bag, "stereo", images=True).to_pylist()[0]
    assert (row["left.height"], row["left.width"], row["left"]) == (3, 4, LEFT.tobytes())


def test_every_message_type_has_columns_with_different_names() -> None:
    for topic in TOPICS.values():
        names = [one.name for one in list_columns(topic.message, images=True)]
        assert len(names) == len(set(names)), topic.name
        # Each field has a column or is the prefix of some.
        prefixes = {name.partition(".")[0] for name in names}
        assert prefixes == set(topic.message.model_fields), topic.name
    assert isinstance(TwinEye.model_fields["seen"].metadata[0], ArraySpec)


def test_row_groups_are_joined(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexsheet.launch.bags.parquet.ROWS_PER_GROUP", 1)
    output = write_parquet(bag, tmp_path / "tables", topics=["sheet_target"]).output
    assert [one.name for one in output.iterdir()] == ["sheet_target.parquet"]
    rows = parquet.read_table(output / "sheet_target.parquet").to_pylist()
    assert [row["trajectory.keep_s"] for row in rows] == [None, 0.1]


def test_an_existing_folder_stays(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "tables").mkdir()
    with pytest.raises(ExportError, match="exists already"):
        write_parquet(bag, tmp_path / "tables")


def test_the_command(bag: Path, flexsheet: Command) -> None:
    printed = flexsheet("bag", "to-parquet", bag, "--json")
    assert printed.code == 0
    answer = printed.json()
    assert answer["messages"]["fingertip"] == 1
    assert (Path(answer["output"]) / "arm_left.parquet").is_file()
