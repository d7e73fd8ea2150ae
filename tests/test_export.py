"""Test that exported bags can be opened by the usual readers, with correct contents."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from flexsheet.launch.bags.export import ExportError, export
from tests.commands import Command
from tests.example_bag import DENT, LEFT, SCENE, TIP, VERTICES, write_example


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_example(tmp_path / "bag.mcap")


def opened(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return (time, message) per channel: JSON, or protobuf by the schema in the file."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                value = json.loads(message.data)
            else:
                decode = DecoderFactory().decoder_for("protobuf", schema)
                value = decode(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


def test_foxglove_gets_images_meshes_frames_and_numbers(bag: Path, tmp_path: Path) -> None:
    result = export(bag, tmp_path / "out.mcap")
    found = opened(result.output)
    assert result.messages == {name: len(values) for name, values in found.items()}
    assert result.unreadable == ()

    started_ns = 1795341600 * 10**9
    assert found["scene"][0][0] == started_ns, "the time of day, as the recorder knew it"
    number = found["fingertip"][0][1]
    assert number["position_world_m"] == TIP.tolist()
    assert number["state"] == "tracking"
    assert "displacement_world_m" in found["soft_body"][0][1], "small arrays are numbers to plot"

    at_rest, dented = (update.entities[0].triangles[0] for _, update in found["object"])
    assert [(p.x, p.y, p.z) for p in at_rest.points] == list(map(tuple, VERTICES.tolist()))
    assert [(p.x, p.y, p.z) for p in dented.points] == list(map(tuple, (VERTICES + DENT).tolist()))
    assert list(dented.indices) == [0, 1, 2]

    left = found["stereo/left"][0][1]
    shown = cv2.imdecode(np.frombuffer(left.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    assert np.abs(shown.astype(int) - LEFT).max() < 4
    ball = found["finger"][0][1].entities[0].spheres[0]
    assert (ball.pose.position.x, ball.pose.position.y, ball.pose.position.z) == tuple(TIP)
    assert ball.size.x == 2 * SCENE.finger.radius_m
    frames = {t.child_frame_id: t for _, update in found["tf"] for t in update.transforms}
    assert {"fingertip", "left_link_1", "right_link_6"} <= frames.keys()
    assert frames["fingertip"].translation.x == TIP[0]
    corners = found["sheet"][0][1].entities[0].triangles[0].points
    # The edges of the example are along x, at flanges 0.3 m apart.
    assert np.ptp([p.x for p in corners]) == pytest.approx(0.3 + SCENE.sheet.height_m)
    assert found["log"][0][1].message == "e-stop engaged: a person"


def test_a_channel_has_its_fields_before_a_message_is_decoded(bag: Path, tmp_path: Path) -> None:
    output = export(bag, tmp_path / "out.mcap").output
    with output.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {channel.topic: summary.schemas[channel.schema_id]
               for channel in summary.channels.values()}  # fmt: skip
    assert schemas["object"].name == "foxglove.SceneUpdate"
    assert "position_world_m" in json.loads(schemas["fingertip"].data)["properties"]


def test_rerun_finds_nothing_wrong(bag: Path, tmp_path: Path) -> None:
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("rerun-sdk (170 MB, not in requirements-dev.lock): pip install rerun-sdk")
    output = export(bag, tmp_path / "out.mcap").output
    checked = subprocess.run([rerun, "mcap", "check", output], capture_output=True, text=True,
                             check=False)  # fmt: skip
    assert checked.returncode == 0, checked.stdout + checked.stderr
    rrd = tmp_path / "out.rrd"
    subprocess.run([rerun, "mcap", "convert", output, "-o", rrd], check=True, capture_output=True)
    assert rrd.stat().st_size > 1000


def test_only_the_topics_asked_for(bag: Path, tmp_path: Path) -> None:
    result = export(bag, tmp_path / "out.mcap", topics=["fingertip"])
    assert set(result.messages) == {"fingertip", "finger", "tf"}


def test_a_topic_that_the_bag_lacks_is_named(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(Exception, match="twin/eye"):
        export(bag, tmp_path / "out.mcap", topics=["twin/eye"])


def test_an_export_is_never_written_over(bag: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    output.write_bytes(b"mine")
    with pytest.raises(ExportError, match="exists already"):
        export(bag, output)
    assert output.read_bytes() == b"mine"


def test_the_command(bag: Path, tmp_path: Path, flexsheet: Command) -> None:
    printed = flexsheet("bag", "export", bag, "-o", tmp_path / "out.mcap", "--json")
    assert printed.code == 0
    assert printed.json()["messages"]["object"] == 2
