"""Test `read_arrays`: fields of a recorded topic as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import flexsheet
from flexsheet.messages.bag import BagError, BagWriter
from tests import sessions
from tests.arm_states import arm_state


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sessions.write_session(tmp_path_factory.mktemp("bags") / "a.mcap")


def test_fields_are_arrays_with_a_row_for_each_message(bag: Path) -> None:
    arrays = flexsheet.read_arrays(bag, "arm_right")
    seconds = arrays["time_s"]
    assert seconds[1:] - seconds[:-1] == pytest.approx(1.0 / sessions.RATE_HZ)
    assert arrays["joints_rad"].shape == (len(seconds), 6)
    assert arrays["joints_rad"][:, 1] == pytest.approx(3.3 * (seconds - seconds[0]))
    assert arrays["world_from_flange"].shape == (len(seconds), 4, 4)
    assert set(arrays["mode"]) == {"follow"}


def test_a_missing_value_is_nan(tmp_path: Path) -> None:
    bag = tmp_path / "a.mcap"
    with BagWriter(bag) as writer:
        desk = sessions.MessageWriter(writer, ())
        for number, force_n in enumerate((2.0, None)):
            desk.write("arm_left", arm_state("left", edge_force_n=force_n), float(number))
    found = flexsheet.read_arrays(bag, "arm_left", "edge_force_n")["edge_force_n"]
    assert np.array_equal(found, [2.0, np.nan], equal_nan=True)


def test_large_fields_are_read_if_they_are_named(bag: Path) -> None:
    assert "left" not in flexsheet.read_arrays(bag, "stereo")
    named = flexsheet.read_arrays(bag, "stereo", "left")
    assert set(named) == {"time_s", "left"}
    assert named["left"].shape == (3, 30, 40)
    assert named["left"].max() == 20


@pytest.mark.parametrize(
    ("topic", "field", "printed"),
    [("arm_right", "speed", "has no field speed"), ("nothing", "x", "nothing")],
)
def test_an_unknown_name_is_an_error(bag: Path, topic: str, field: str, printed: str) -> None:
    with pytest.raises(BagError, match=printed):
        flexsheet.read_arrays(bag, topic, field)
