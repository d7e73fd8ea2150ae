"""Test the recorder that waits for the console's request."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.bag import BagReader
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.types import (
    Display,
    EStop,
    Recording,
)
from flexsheet.nodes.recorder.node import Recorder, RecorderParameters
from tests.console_parts import frames_of
from tests.node_harness import build_node

Floats = NDArray[np.float64]


def names_in(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


async def test_a_recorder_that_waits_begins_a_bag_for_each_start(tmp_path: Path) -> None:
    names = ("estop", "recording", "display")
    node = build_node(
        Recorder,
        RecorderParameters(bag=tmp_path / "a.mcap", attach=(), start_paused=True),
        topics={f"in/{name}": name for name in names},
    ).node
    await node.setup()
    shown = Display(correction="none", stereo="mono")
    node.deliver("in/display", *frames_of(shown))
    node.deliver("in/estop", *frames_of(EStop(engaged=True, reason="before")))
    assert not names_in(tmp_path)
    for reason in ("first", "second"):
        node.deliver("in/recording", *frames_of(Recording(running=True)))
        node.deliver("in/recording", *frames_of(Recording(running=True)))
        node.deliver("in/estop", *frames_of(EStop(engaged=True, reason=reason)))
        node.deliver("in/recording", *frames_of(Recording(running=False)))
    node.deliver("in/estop", *frames_of(EStop(engaged=False, reason="after")))
    await node.close()
    assert node.inputs["in/estop"].counts.dropped == 0
    found = [list(BagReader(path)) for path in names_in(tmp_path)]
    printed = [
        [message.reason for _, message, _, _ in entries if isinstance(message, EStop)]
        for entries in found
    ]
    # The e-stop is latched: whoever reads the bag must know it from its beginning.
    assert sorted(printed) == [["before", "first"], ["first", "second"]]
    assert all(any(entry[0] == "display" for entry in entries) for entries in found)
    node.deliver("in/recording", *frames_of(Recording(running=False)))
    assert node.errors == 0


async def test_a_recorder_that_cannot_start_reports_it_and_continues(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    node = build_node(
        Recorder,
        RecorderParameters(bag=tmp_path / "file" / "a.mcap", attach=(), start_paused=True),
        topics={"in/recording": "recording"},
    ).node
    await node.setup()
    node.deliver("in/recording", *frames_of(Recording(running=True)))
    assert node.errors == 1
    assert [one.code for one in node.notes] == [NoteCode.NOT_RECORDING]
