"""Looking through the user's eye, and what is put back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Message
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    Correction,
    Display,
    Frame,
    TwinEye,
)
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.desk import CAPTURE_S, MAX_TRACING_S, Desk, Files, Look, LookState
from flexsheet.nodes.console.finger import Finger
from tests.console_parts import cylinder

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return cylinder()


def test_looking_puts_back_what_another_had_set(scene: Scene) -> None:
    sent: list[Display] = []

    def publish(message: Message) -> None:
        assert isinstance(message, Display)
        sent.append(message)

    look = Look(publish, scene)
    look.advance(1.0)
    assert not sent, "nobody wants to look"
    anothers = Display(correction="one_plane", stereo="anaglyph", label="mine")
    look.on_others_display(anothers)
    look.wanted = True
    look.advance(2.0)
    asked = sent[0]
    assert (asked.stereo, asked.pixels_every > 0) == ("mono", True)
    pixel = np.zeros((2, 2, 3), np.uint8)
    eye = TwinEye(label="x", correction="none", metres_per_px=1e-3, seen=pixel, expected=pixel)
    assert not look.got(eye, 2.5)
    assert look.got(eye.model_copy(update={"label": asked.label}), 3.0)
    assert sent[-1] is anothers
    look.advance(3.1)
    assert len(sent) == 2, "not at once again"
    look.again()
    look.advance(3.2)
    assert look.state is LookState.DRAWING
    look.advance(60.0)
    assert sent[-1] is anothers, "a frame that is never drawn is given up"
    look.follow(scene)
    assert len(sent) == 4, "a scene changes nothing of what another has set"


def test_after_a_look_each_scene_has_its_own_correction_until_one_is_picked(
    scene: Scene, tmp_path: Path
) -> None:
    def corrected_by(correction: Correction | None) -> Scene:
        return scene.model_copy(update={"methods": Methods(correction=correction)})

    (tmp_path / "plan.json").write_text(
        f'{{"scene": {corrected_by("four_triangles").model_dump_json()}}}'
    )
    for name, correction in (("flat", "one_plane"), ("silent", None)):
        (tmp_path / f"{name}.json").write_text(corrected_by(correction).model_dump_json())
    sent: list[Message] = []
    files = Files(tmp_path / "plan.json", tmp_path, tmp_path, tmp_path / "console.json")
    desk = Desk(sent.append, files, Finger(sent.append, speed_m_per_s=0.1), print)

    def corrections() -> list[str]:
        return [message.correction for message in sent if isinstance(message, Display)]

    desk.begin()
    desk.scenes.choose("flat")
    assert corrections() == [], "the renderer follows the scene by itself"
    desk.scenes.choose("silent")
    desk.look.follow(corrected_by("four_triangles"))
    desk.look.wanted = True
    desk.look.advance(1.0)
    desk.look.advance(60.0)
    rested = sent[-1]
    assert isinstance(rested, Display)
    assert corrections() == ["four_triangles", "four_triangles"]
    desk.scenes.choose("flat")
    desk.scenes.choose("silent")
    assert corrections()[2:] == ["one_plane", "two_pass"]
    desk.look.picked = "none"
    desk.scenes.choose("flat")
    assert corrections()[4:] == ["none"]


def frame(label: str, *, pixels: bool = True) -> Frame:
    picture = np.zeros((2, 2, 3), np.uint8)
    return Frame(
        number=1,
        correction="none",
        stereo="mono",
        label=label,
        eyes_world_m=np.zeros((2, 3)),
        world_from_sheet=np.eye(4),
        pushed_point_world_m=np.zeros(3),
        predicted_to_ns=0,
        draw_s=0.0,
        late_frames=0,
        pixels=(picture,) if pixels else (),
    )


def test_a_picture_that_takes_long_is_shown_all_the_same(scene: Scene) -> None:
    """On a busy computer each picture came after the next was asked for, and none was shown."""
    sent: list[Message] = []
    look = Look(sent.append, scene)
    look.wanted = True
    look.advance(1.0)
    look.on_frame(frame("another"), 1.5)
    look.on_frame(frame(look.label, pixels=False), 1.5)
    states = [look.state]
    look.on_frame(frame(look.label), 2.0)
    states.append(look.state)
    assert states == [LookState.DRAWING, LookState.TRACING]
    assert len(sent) == 1
    look.advance(2.0 + 1.1 * CAPTURE_S)
    rested = sent[-1]
    assert isinstance(rested, Display)
    assert rested.label == "console rests", "the display is not held while a picture is traced"
    label = look.label
    for second in range(4, 80):
        look.advance(float(second))
    assert (look.label, len(sent)) == (label, 2), "nothing else is asked for meanwhile"
    assert look.waited_s(80.0) == 78.0
    pixel = np.zeros((2, 2, 3), np.uint8)
    eye = TwinEye(label=label, correction="none", metres_per_px=1e-3, seen=pixel, expected=pixel)
    assert look.got(eye, 80.0)
    assert (look.state, len(sent)) == (LookState.RESTING, 2)
    look.advance(90.0)
    assert look.label != label
    assert look.got(eye, 91.0), "one from before is shown too"
    assert look.state is LookState.DRAWING


def test_a_picture_that_never_comes_is_given_up(scene: Scene) -> None:
    look = Look(lambda message: None, scene)
    look.wanted = True
    look.advance(1.0)
    look.on_frame(frame(look.label), 2.0)
    look.advance(2.0 + 1.1 * MAX_TRACING_S)
    assert look.state is LookState.RESTING


@pytest.mark.parametrize(
    ("state", "ago_s", "expected"),
    [
        (LookState.DRAWING, None, "renderer to draw a frame: 7 s."),
        (LookState.TRACING, None, "busy computer: 7 s."),
        (LookState.TRACING, 31.0, "The last picture came 31 s ago"),
        (LookState.RESTING, 3.0, "Taken 3 s ago"),
        (LookState.RESTING, None, "no frame or no picture"),
    ],
)
def test_the_eye_tab_says_what_it_waits_for(
    state: LookState, ago_s: float | None, expected: str
) -> None:
    html = panels.eye(possible=True, wanted=True, state=state, waited_s=7.0, ago_s=ago_s)
    assert expected in html
