"""Test the requests for eye views, and the display settings after them."""

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
from flexsheet.nodes.console.controller import (
    CAPTURE_S,
    EYE_VIEW_PERIOD_S,
    MAX_TRACING_S,
    ConsoleController,
    EyeViewRequester,
    EyeViewState,
)
from flexsheet.nodes.console.finger import FingerController
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


def test_looking_puts_back_what_another_had_set(scene: Scene) -> None:
    sent: list[Display] = []

    def publish(message: Message) -> None:
        assert isinstance(message, Display)
        sent.append(message)

    eye_view = EyeViewRequester(publish, scene)
    eye_view.advance(1.0)
    assert not sent, "nobody wants to look"
    anothers = Display(correction="one_plane", stereo="anaglyph", label="mine")
    eye_view.on_others_display(anothers)
    eye_view.enabled = True
    eye_view.advance(2.0)
    asked = sent[0]
    assert (asked.stereo, asked.pixels_every > 0) == ("mono", True)
    pixel = np.zeros((2, 2, 3), np.uint8)
    eye = TwinEye(label="x", correction="none", metres_per_px=1e-3, seen=pixel, expected=pixel)
    eye_view.on_image(eye, 2.5)
    assert len(sent) == 1, "the image of another request"
    eye_view.on_image(eye.model_copy(update={"label": asked.label}), 3.0)
    assert sent[-1] is anothers
    eye_view.advance(3.1)
    assert len(sent) == 2, "not at once again"
    eye_view.advance(3.0 + EYE_VIEW_PERIOD_S)
    assert eye_view.state is EyeViewState.DRAWING
    eye_view.advance(60.0)
    assert sent[-1] is anothers, "a frame that is never drawn is given up"
    eye_view.on_scene(scene)
    assert len(sent) == 4, "a scene changes nothing of what another has set"


def test_after_a_view_each_scene_has_its_own_correction(scene: Scene, tmp_path: Path) -> None:
    def corrected_by(correction: Correction | None) -> Scene:
        return scene.model_copy(update={"methods": Methods(correction=correction or "two_pass")})

    (tmp_path / "plan.json").write_text(
        f'{{"scene": {corrected_by("four_triangles").model_dump_json()}}}'
    )
    (tmp_path / "scenes").mkdir()
    for name, correction in (("flat", "one_plane"), ("silent", None)):
        (tmp_path / "scenes" / f"{name}.json").write_text(
            corrected_by(correction).model_dump_json()
        )
    sent: list[Message] = []
    controller = ConsoleController(
        sent.append, tmp_path / "plan.json", FingerController(sent.append)
    )

    def corrections() -> list[str]:
        return [message.correction for message in sent if isinstance(message, Display)]

    controller.begin()
    controller.scenes.choose("flat")
    assert corrections() == [], "the renderer follows the scene by itself"
    controller.scenes.choose("silent")
    controller.eye_view.on_scene(corrected_by("four_triangles"))
    controller.eye_view.enabled = True
    controller.eye_view.advance(1.0)
    controller.eye_view.advance(60.0)
    rested = sent[-1]
    assert isinstance(rested, Display)
    assert corrections() == ["four_triangles", "four_triangles"]
    controller.scenes.choose("flat")
    controller.scenes.choose("silent")
    assert corrections()[2:] == ["one_plane", "two_pass"]


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


def test_a_slow_image_ends_only_its_own_request(scene: Scene) -> None:
    """On a busy computer, an image may arrive after the next request."""
    sent: list[Message] = []
    eye_view = EyeViewRequester(sent.append, scene)
    eye_view.enabled = True
    eye_view.advance(1.0)
    eye_view.on_frame(frame("another"), 1.5)
    eye_view.on_frame(frame(eye_view.label, pixels=False), 1.5)
    states = [eye_view.state]
    eye_view.on_frame(frame(eye_view.label), 2.0)
    states.append(eye_view.state)
    assert states == [EyeViewState.DRAWING, EyeViewState.TRACING]
    assert len(sent) == 1
    eye_view.advance(2.0 + 1.1 * CAPTURE_S)
    rested = sent[-1]
    assert isinstance(rested, Display)
    assert rested.label == "console rests", "the display is not held while a picture is traced"
    label = eye_view.label
    for second in range(4, 80):
        eye_view.advance(float(second))
    assert (eye_view.label, len(sent)) == (label, 2), "nothing else is asked for meanwhile"
    assert eye_view.waited_s(80.0) == 78.0
    pixel = np.zeros((2, 2, 3), np.uint8)
    eye = TwinEye(label=label, correction="none", metres_per_px=1e-3, seen=pixel, expected=pixel)
    eye_view.on_image(eye, 80.0)
    assert (eye_view.state, len(sent)) == (EyeViewState.RESTING, 2)
    eye_view.advance(90.0)
    assert eye_view.label != label
    eye_view.on_image(eye, 91.0)
    assert eye_view.state is EyeViewState.DRAWING


def test_an_image_that_never_comes_is_abandoned(scene: Scene) -> None:
    eye_view = EyeViewRequester(lambda message: None, scene)
    eye_view.enabled = True
    eye_view.advance(1.0)
    eye_view.on_frame(frame(eye_view.label), 2.0)
    eye_view.advance(2.0 + 1.1 * MAX_TRACING_S)
    assert eye_view.state is EyeViewState.RESTING


@pytest.mark.parametrize(
    ("state", "ago_s", "expected"),
    [
        (EyeViewState.DRAWING, None, "for a frame of the renderer: 7 s."),
        (EyeViewState.TRACING, None, "busy computer: 7 s."),
        (EyeViewState.TRACING, 31.0, "The last image is 31 s old"),
        (EyeViewState.RESTING, 3.0, "Rendered 3 s ago"),
        (EyeViewState.RESTING, None, "No frame or image"),
    ],
)
def test_the_eye_tab_shows_what_it_waits_for(
    state: EyeViewState, ago_s: float | None, expected: str
) -> None:
    html = panels.eye(possible=True, enabled=True, state=state, waited_s=7.0, ago_s=ago_s)
    assert expected in html
