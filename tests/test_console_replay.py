"""Test the display of a bag in place of the running graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import (
    ArmState,
    Bookmark,
    EStop,
    Fingertip,
)
from flexsheet.nodes.console.controller import Replay
from flexsheet.nodes.console.replay import Timeline, list_bags
from tests.fingertips import fingertip
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


@pytest.fixture
def bag(tmp_path: Path, scene: Scene) -> Path:
    """Write ten seconds of a finger that moves at 1 mm/s, with a bookmark at 4 s."""
    path = tmp_path / "sub" / "a.mcap"
    path.parent.mkdir()
    start_ns = 1_000_000_000_000
    with BagWriter(path) as writer:

        def write(topic: str, message: Message, seconds: float) -> None:
            header = Header(1, start_ns, start_ns, "c", "w", 1)
            writer.write(TOPICS[topic], message, header, start_ns + round(seconds * 1e9))

        write("scene", scene, 0.0)
        for tenth in range(101):
            at = np.array([0.0, 0.0, 1e-4 * tenth])
            write("fingertip", fingertip(at), 0.1 * tenth)
            if tenth == 40:
                write("bookmark", Bookmark(label="touch"), 4.0)
    return path


def test_a_bag_is_shown_as_it_was_at_any_moment(bag: Path) -> None:
    timeline = Timeline(bag)
    assert timeline.duration_s == pytest.approx(10.0)
    assert timeline.bookmarks == [(pytest.approx(4.0), "touch")]
    for seconds, height in ((0.05, 0.0), (10.0, 1e-2), (3.14, 3.1e-3), (0.0, 0.0)):
        timeline.seconds = seconds
        entry = timeline.latest("fingertip", Fingertip)
        assert entry is not None
        assert entry[0].position_world_m[2] == pytest.approx(height)
    assert timeline.latest("arm_left", ArmState) is None
    one, again = timeline.latest("scene", Scene), timeline.latest("scene", Scene)
    assert one is not None
    assert again is not None
    assert one[0] is again[0], "the scene is not redrawn at each frame"
    timeline.seconds = -1.0
    assert timeline.latest("fingertip", Fingertip) is None
    assert list_bags(bag.parent.parent) == ["sub/a.mcap"]


def test_bags_that_cannot_be_shown_give_a_reason(tmp_path: Path, bag: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        Timeline(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(BagError, match="not an MCAP file"):
        Timeline(tmp_path / "text.mcap")
    with BagWriter(tmp_path / "stop.mcap") as writer:
        message = EStop(engaged=True, reason="")
        writer.write(TOPICS["estop"], message, Header(1, 1, 1, "c", "w", 1), 1)
    with pytest.raises(BagError, match="contains no topic that"):
        Timeline(tmp_path / "stop.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:-300])
    assert Timeline(cut).duration_s > 0.0


def test_a_replay_that_has_ended_begins_again(bag: Path) -> None:
    replay = Replay(bag.parent)
    replay.play_or_pause()
    replay.open(bag.name)
    assert replay.timeline is not None
    replay.seek(9.9)
    replay.advance(1.0)
    assert (replay.playing, replay.timeline.seconds) == (False, replay.timeline.duration_s)
    replay.play_or_pause()
    replay.advance(0.5)
    assert (replay.playing, replay.timeline.seconds) == (True, 0.5)
    replay.play_or_pause()
    assert not replay.playing
