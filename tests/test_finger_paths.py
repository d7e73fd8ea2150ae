"""Test the finger paths that commands accept."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from flexsheet.launch.commands import experiment
from flexsheet.launch.experiments import finger_paths, select_names
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.messages.scene import Scene
from tests.commands import Command

ROOT = Path(__file__).resolve().parent.parent
SCENE = Scene.model_validate(
    YAML(typ="safe").load((ROOT / "launch" / "scenes" / "cylinder.yaml").read_text())
)


@pytest.mark.parametrize("name", finger_paths.GESTURES)
def test_every_gesture_of_the_demos_scene_is_labelled_by_its_name(name: str) -> None:
    assert finger_paths.gesture_path(name, SCENE).label == name


def test_names_are_chosen_once_each_and_checked() -> None:
    assert select_names([], finger_paths.GESTURES, "gesture") == list(finger_paths.GESTURES)
    assert select_names(["tap", "stop", "tap"], finger_paths.GESTURES, "gesture") == ["tap", "stop"]
    with pytest.raises(BadInputError, match=r'tapp: unknown gesture; did you mean "tap"\?'):
        select_names(["hold", "tapp"], finger_paths.GESTURES, "gesture")


def test_a_finger_path_is_a_gesture_or_a_file(tmp_path: Path) -> None:
    launch_file = ROOT / "launch" / "demo.yaml"
    assert finger_paths.finger_path(launch_file, "stop").label == "stop"
    hand = tmp_path / "hand.csv"
    hand.write_text("t_s,x_mm,y_mm,z_mm\n0,0,0,0\n1,20,30,-40\n2,0,10,5\n")
    assert finger_paths.finger_path(launch_file, str(hand)).label == "hand"
    wrong = r'stopp: neither a gesture nor a file; did you mean "stop"\?'
    with pytest.raises(BadInputError, match=wrong):
        finger_paths.finger_path(launch_file, "stopp")
    with pytest.raises(BadInputError, match=r"absent\.csv: cannot be read"):
        finger_paths.finger_path(launch_file, str(tmp_path / "absent.csv"))


def test_the_placement_of_a_recorded_motion_is_stated(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    launch_file = ROOT / "launch" / "demo.yaml"
    experiment.announce_recording("stop", finger_paths.finger_path(launch_file, "stop"))
    assert capsys.readouterr().err == ""
    hand = tmp_path / "hand.csv"
    hand.write_text("t_s,x_mm,y_mm,z_mm\n0,0,0,0\n1,20,30,-40\n2,0,10,5\n")
    experiment.announce_recording(str(hand), finger_paths.finger_path(launch_file, str(hand)))
    printed = " ".join(capsys.readouterr().err.split())
    assert "hand.csv is centred in front of the object" in printed
    assert "flexsheet topic pub twin/finger_path" in printed


def test_a_wrong_name_is_answered_in_a_sentence(flexsheet: Command) -> None:
    printed = flexsheet("experiment", "follow", "--finger-path", "tapp")
    assert printed.code == 2
    assert 'did you mean "tap"?' in printed.err
