"""`experiment gestures`: what it reads from a bag is what was put into it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from ruamel.yaml import YAML

from flexsheet.launch.commands import experiment
from flexsheet.launch.commands.options import split_names
from flexsheet.launch.experiments import ExperimentError, gestures, select_names
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import Fingertip, TwinFinger
from flexsheet.nodes.twin.finger import FingerMotion, FingerPathError
from tests.commands import Command

ROOT = Path(__file__).resolve().parent.parent
SCENE = Scene.model_validate(
    YAML(typ="safe").load((ROOT / "launch" / "scenes" / "cylinder.yaml").read_text())
)
Floats = NDArray[np.float64]
PERIOD_NS = 16_666_667
BEGIN_NS = 300 * 24 * 3600 * 10**9
SIGMA_M = 1e-4


class Tracked:
    """A finger that follows a gesture, and a tracker that errs by what `error` says.

    late_s: how much later than it says the tracker's finger is.
    """

    def __init__(
        self,
        name: str,
        *,
        error: Callable[[int], Floats] = lambda _: np.zeros(3),
        late_s: float = 0.0,
        reason: Callable[[int], str] = lambda _: "ok",
        absent: Callable[[int], bool] = lambda _: False,
        unseen: Callable[[int], bool] = lambda _: False,
    ) -> None:
        self.path = gestures.gesture_path(name, SCENE)
        self.motion = FingerMotion.resting(np.array([0.0, 0.0, 0.1]), seed=2).followed_by(
            0.0,
            times_s=self.path.times_s,
            points=self.path.positions_world_m,
            wander_m=self.path.wander_m,
            tremor_m=self.path.tremor_m,
            max_speed_m_per_s=SCENE.finger.max_speed_m_per_s,
            joined_by=self.path.joined_by,
        )
        self.error, self.late_s = error, late_s
        self.reason, self.absent, self.unseen = reason, absent, unseen

    def messages(self) -> list[tuple[str, Message, int]]:
        """(topic, message, exposure) from the easing on until a while after the path."""
        ease_s = -self.motion.at(0.0).path_time_s
        count = int((ease_s + self.path.times_s[-1] + 0.5) * 1e9 / PERIOD_NS)
        printed: list[tuple[str, Message, int]] = []
        for i in range(count):
            at_ns = BEGIN_NS + i * PERIOD_NS
            if not self.unseen(i):
                printed.append(("twin/finger", self._truth(i), at_ns))
            if not self.absent(i):
                printed.append(("fingertip", self._fingertip(i), at_ns))
        return printed

    def _truth(self, i: int) -> TwinFinger:
        state = self.motion.at(i * PERIOD_NS * 1e-9)
        return TwinFinger(
            path_label=self.path.label,
            path_done=state.path_done,
            path_time_s=state.path_time_s,
            position_world_m=state.position,
            velocity_world_m_per_s=state.velocity,
        )

    def _fingertip(self, i: int) -> Fingertip:
        at_s = i * PERIOD_NS * 1e-9 - self.late_s
        valid = self.reason(i) == "ok"
        ahead = [self.motion.at(at_s + 0.01 * step).position for step in range(7)]
        return Fingertip.model_validate(
            {
                "valid": valid,
                "state": "tracking" if valid else "coasting",
                "reason": self.reason(i),
                "position_world_m": ahead[0] + self.error(i),
                "velocity_world_m_per_s": self.motion.at(at_s).velocity,
                "covariance": np.diag([SIGMA_M**2] * 3 + [1e-4] * 3),
                "predicted_path_world_m": np.array(ahead) + self.error(i),
                "prediction_step_s": 0.01,
                "measured_world_m": ahead[0],
                "reprojection_px": 0.1,
            }
        )


def write(bag: Path, *tracked: Tracked) -> Path:
    with BagWriter(bag) as writer:
        for i, one in enumerate(tracked):
            for number, (topic, message, at_ns) in enumerate(one.messages()):
                at = at_ns + i * 60 * 10**9
                header = Header(number, at, at + 10**7, "virtual", "test", 1)
                writer.write(find_topic(topic), message, header, at + 10**7)
    return bag


def result_of(bag: Path, name: str) -> dict[str, Any]:
    return gestures.gesture_result(gestures.read_gestures(bag), name)


def by_turns(i: int) -> Floats:
    """An error of 0.3 mm in x whose sign turns every ten pictures."""
    return np.array([3e-4 if i // 10 % 2 else -3e-4, 0.0, 0.0])


def test_a_perfect_tracker_is_found_perfect(tmp_path: Path) -> None:
    result = result_of(write(tmp_path / "a.mcap", Tracked("tap")), "tap")
    path_s = gestures.gesture_path("tap", SCENE).times_s[-1]
    assert result["seconds"] == pytest.approx(path_s, abs=0.05)
    assert (result["valid_ratio"], result["missing"], result["reasons"]) == (1.0, 0, {})
    assert result["error_mm"]["max"] < 1e-9
    assert result["jump"] == {
        "max_sigmas": pytest.approx(0.0, abs=1e-6),
        "max_mm": pytest.approx(0.0, abs=1e-9),
        "beyond_3_sigmas": 0,
    }
    now, *ahead = result["prediction"]
    assert now["lag_ms"] == pytest.approx(0.0, abs=0.01)
    # Between its exposures the truth is interpolated, and so is what is told every 10 ms.
    for each in ahead:
        assert each["rms"] < 0.03
        assert each["lag_ms"] == pytest.approx(0.0, abs=0.2)


def test_errors_and_jumps_come_out_as_large_as_they_are(tmp_path: Path) -> None:
    result = result_of(write(tmp_path / "a.mcap", Tracked("hold", error=by_turns)), "hold")
    assert result["error_mm"] == {key: pytest.approx(0.3) for key in ("rms", "p99", "max")}
    assert result["measured_error_mm"]["max"] < 1e-9
    assert result["jump"]["max_mm"] == pytest.approx(0.6)
    # Both estimates have a sigma of 0.1 mm, their difference one of 0.14 mm.
    assert result["jump"]["max_sigmas"] == pytest.approx(0.6 / (0.1 * np.sqrt(2)), rel=1e-6)
    frames = result["seconds"] * 60
    assert result["jump"]["beyond_3_sigmas"] == pytest.approx(frames / 10, abs=1.5)


@pytest.mark.parametrize("name", ["stroke-10", "reach", "tap-fast"])
def test_a_late_tracker_is_found_late_at_every_lead(tmp_path: Path, name: str) -> None:
    result = result_of(write(tmp_path / "a.mcap", Tracked(name, late_s=0.03)), name)
    assert [each["horizon_ms"] for each in result["prediction"]] == [0.0, 20.0, 50.0]
    for each in result["prediction"]:
        assert each["lag_ms"] == pytest.approx(30.0, abs=1.0)
        assert each["rms"] > 0.1


def test_what_is_not_valid_is_counted_by_its_reason_and_left_out(tmp_path: Path) -> None:
    def reason(i: int) -> str:
        return {7: "two_markers", 9: "no_marker"}.get(i % 10, "ok")

    def error(i: int) -> Floats:
        return np.full(3, 0.0 if reason(i) == "ok" else 1.0)

    result = result_of(
        write(tmp_path / "a.mcap", Tracked("circle", reason=reason, error=error)), "circle"
    )
    assert result["valid_ratio"] == pytest.approx(0.8, abs=0.01)
    tenth = result["fingertips"] / 10
    assert result["reasons"] == {
        "two_markers": pytest.approx(tenth, abs=1),
        "no_marker": pytest.approx(tenth, abs=1),
    }
    assert result["error_mm"]["max"] < 1e-9


def test_fingertips_that_never_came_are_counted(tmp_path: Path) -> None:
    bag = write(tmp_path / "a.mcap", Tracked("hover", absent=lambda i: i % 6 == 5))
    result = result_of(bag, "hover")
    assert result["missing"] == pytest.approx(result["fingertips"] / 5, abs=2)
    assert result["error_mm"]["max"] < 1e-9


def test_a_prediction_is_not_evaluated_without_the_truth(tmp_path: Path) -> None:
    """Eight missed frames in each second: across them the truth is not known, so not made up."""
    unseen = Tracked("reach-fast", unseen=lambda i: i % 60 > 51)
    result = result_of(write(tmp_path / "a.mcap", unseen), "reach-fast")
    assert result["error_mm"]["max"] < 1e-9
    assert all(each["max"] < 0.1 for each in result["prediction"])


def test_a_gesture_that_is_never_tracked_is_a_result(tmp_path: Path) -> None:
    bag = write(tmp_path / "a.mcap", Tracked("hold", reason=lambda _: "no_marker"))
    result = result_of(bag, "hold")
    assert result["valid_ratio"] == 0.0
    assert set(result["reasons"]) == {"no_marker"}
    assert result["error_mm"] == {"rms": None, "p99": None, "max": None}
    assert result["jump"]["max_sigmas"] is None
    assert [each["lag_ms"] for each in result["prediction"]] == [None] * 3


def test_each_gesture_has_its_own_window(tmp_path: Path) -> None:
    """Easing to the path and resting after it belong to no gesture."""
    far = Tracked("tap", error=lambda _: np.array([0.0, 5e-4, 0.0]))
    bag = write(tmp_path / "a.mcap", Tracked("eight"), far)
    eight, tap = gestures.gestures_result(bag, ["eight", "tap"])["gestures"]
    assert eight["error_mm"]["max"] < 1e-9
    assert tap["error_mm"]["rms"] == pytest.approx(0.5)
    # Nobody held a sheet.
    assert eight["followed"] is tap["followed"] is None
    path = gestures.gesture_path("eight", SCENE)
    assert eight["seconds"] == pytest.approx(path.times_s[-1], abs=0.05)


def test_a_gesture_that_is_not_in_the_bag_is_named(tmp_path: Path) -> None:
    bag = write(tmp_path / "a.mcap", Tracked("hover"))
    with pytest.raises(
        ExperimentError, match='does not contain the gesture "tap"; it contains: hover'
    ):
        result_of(bag, "tap")


def test_a_bag_without_a_finger_is_named(tmp_path: Path) -> None:
    bag = tmp_path / "empty.mcap"
    with BagWriter(bag):
        pass
    with pytest.raises(ExperimentError, match="0 messages of twin/finger"):
        gestures.read_gestures(bag)


def test_a_jump_is_measured_along_itself() -> None:
    """Depth is ten times as uncertain as the rest: the same jump is ten times as bold sideways."""
    covariance = np.diag([1e-10, 1e-10, 1e-8])
    for axis, sigmas in ((0, 10.0), (2, 1.0)):
        errors = np.zeros((2, 3))
        errors[1, axis] = np.sqrt(2.0) * 1e-4
        found = gestures.jump_sigmas(errors, np.stack([covariance, covariance]))
        assert found == pytest.approx([sigmas])
    assert gestures.jump_sigmas(np.zeros((3, 3)), np.stack([covariance] * 3)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("name", gestures.GESTURES)
def test_every_gesture_of_the_demos_scene_is_labelled_by_its_name(name: str) -> None:
    assert gestures.gesture_path(name, SCENE).label == name


def test_names_are_chosen_once_each_and_checked() -> None:
    assert select_names([], gestures.GESTURES, "gesture") == list(gestures.GESTURES)
    assert select_names(["tap", "stop", "tap"], gestures.GESTURES, "gesture") == ["tap", "stop"]
    with pytest.raises(BadInputError, match=r'tapp: unknown gesture; did you mean "tap"\?'):
        select_names(["hold", "tapp"], gestures.GESTURES, "gesture")
    # One value with commas is the former form of a repeated option.
    assert split_names(["tap, stop", "hold"]) == ["tap", "stop", "hold"]
    with pytest.raises(typer.BadParameter, match="omit the option to select all"):
        split_names([" ,"])


def test_a_finger_path_is_a_gesture_or_a_file(tmp_path: Path) -> None:
    launch_file = ROOT / "launch" / "demo.yaml"
    assert gestures.finger_path(launch_file, "stop").label == "stop"
    hand = tmp_path / "hand.csv"
    hand.write_text("t_s,x_mm,y_mm,z_mm\n0,0,0,0\n1,20,30,-40\n2,0,10,5\n")
    assert gestures.finger_path(launch_file, str(hand)).label == "hand"
    wrong = r'stopp: neither a gesture nor a file; did you mean "stop"\?'
    with pytest.raises(BadInputError, match=wrong):
        gestures.finger_path(launch_file, "stopp")
    with pytest.raises(FingerPathError, match=r"absent\.csv: the file cannot be read"):
        gestures.finger_path(launch_file, str(tmp_path / "absent.csv"))


def test_the_placement_of_a_recorded_motion_is_stated(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    launch_file = ROOT / "launch" / "demo.yaml"
    experiment.announce_recording("stop", gestures.finger_path(launch_file, "stop"))
    assert capsys.readouterr().err == ""
    hand = tmp_path / "hand.csv"
    hand.write_text("t_s,x_mm,y_mm,z_mm\n0,0,0,0\n1,20,30,-40\n2,0,10,5\n")
    experiment.announce_recording(str(hand), gestures.finger_path(launch_file, str(hand)))
    printed = " ".join(capsys.readouterr().err.split())
    assert "hand.csv is centred in front of the object" in printed
    assert "flexsheet topic pub twin/finger_path" in printed


@pytest.mark.parametrize(
    "arguments", [("experiment", "gestures", "--names", "tapp"), ("demo", "--finger-path", "tapp")]
)
def test_a_wrong_name_is_answered_in_a_sentence(
    arguments: tuple[str, ...], flexsheet: Command
) -> None:
    printed = flexsheet(*arguments)
    assert printed.code == 2
    assert 'did you mean "tap"?' in printed.err
