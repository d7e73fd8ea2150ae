"""Test that messages are decoded only for viewers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.topics import Topic
from flexsheet.messages.types import (
    Bookmark,
    EStop,
)
from flexsheet.messages.wire import WireError
from flexsheet.nodes.console.latest_messages import LatestMessages
from tests.console_parts import frames_of

Floats = NDArray[np.float64]


def test_only_shown_messages_are_decoded() -> None:
    refused: list[tuple[Topic, WireError]] = []
    newest = LatestMessages(lambda topic, error: refused.append((topic, error)))
    assert newest.latest("estop", EStop) is None
    assert not newest.put("estop", frames_of(EStop(engaged=True, reason="1"))[0])
    assert newest.put("estop", frames_of(EStop(engaged=True, reason="2"))[0]), "never looked at"
    entry = newest.latest("estop", EStop)
    assert entry is not None
    assert entry[0].reason == "2"
    assert newest.latest("estop", EStop) is entry or newest.latest("estop", EStop) == entry
    newest.put("estop", [b"rubbish"])
    assert newest.latest("estop", EStop) == entry, "what came before still stands"
    assert [topic.name for topic, _ in refused] == ["estop"]
    with pytest.raises(TypeError):
        newest.latest("estop", Bookmark)
