"""Test the page's texts: table, banner, and readable colours."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.notes import Note
from flexsheet.messages.types import ArmState
from flexsheet.nodes.console import banner, panels
from flexsheet.nodes.console.access_control import HERE
from flexsheet.nodes.console.banner import BannerState, GraphState
from flexsheet.nodes.console.controller import EyeViewState
from flexsheet.nodes.console.page import STOP_COLOR
from flexsheet.nodes.console.tabs import RECORDING_COLOR
from tests.arm_states import arm_state
from tests.colours import luminance
from tests.console_parts import status_of
from tests.fingertips import fingertip

PAGE_STYLE = (HERE / "page.css").read_text()


def test_the_table_names_faults() -> None:
    nodes = panels.make_nodes_table(
        {
            "camera": (status_of("camera", notes=(Note(detail="60 Hz"),)), 0.5),
            "left": (status_of("left", state="degraded", errors=2, last_error="<b>bang</b>"), 0.0),
            "right": (status_of("right"), 9.0),
        }
    )
    assert "60 Hz" in nodes
    assert "degraded" in nodes
    assert "2 errors: &lt;b&gt;bang" in nodes
    assert "silent for 9 s" in nodes


def rendered(**state: Any) -> str:
    return banner.render(GraphState(**{"scene": "cylinder"} | state))


def arms_in(**changes: Any) -> dict[str, ArmState]:
    return {side: arm_state(side, **changes) for side in ("left", "right")}


FAULTY_ARM = arm_state("left", mode="fault", faults=("joint 3",))


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ({}, BannerState.WAITING),
        ({"arms": arms_in()}, BannerState.READY),
        ({"arms": {"left": arm_state("left"), "right": FAULTY_ARM}}, BannerState.FAULT),
        ({"arms": arms_in(mode="disconnected")}, BannerState.FAULT),
        ({"arms": arms_in(mode="hold", path_blocked=True)}, BannerState.FAULT),
        ({"arms": arms_in(mode="hold")}, BannerState.WAITING),
        ({"arms": arms_in(mode="idle")}, BannerState.WAITING),
        ({"arms": arms_in(), "overload": "8 jobs a core."}, BannerState.READY),
        ({"arms": {"left": FAULTY_ARM}, "overload": "8 jobs a core."}, BannerState.FAULT),
        ({"arms": {"left": FAULTY_ARM}, "estop_reason": "why"}, BannerState.ESTOP),
        ({"arms": arms_in(mode="estop")}, BannerState.ESTOP),
    ],
)
def test_the_banner_shows_the_most_urgent_state(
    state: dict[str, Any], expected: BannerState
) -> None:
    assert GraphState(scene="", **state).banner is expected
    html = rendered(**state)
    assert f'data-state="{expected.name.lower()}"' in html
    assert ("fs-ground-good" in html) == (expected is BannerState.READY)
    if state.get("overload"):
        assert "cylinder</b>. 8 jobs a core." in html, "the cause comes first"


def test_the_banner_names_the_fault_and_the_remedy() -> None:
    follow = {"left": arm_state("left", edge_force_n=5.1), "right": arm_state("right")}
    assert "5.1 N" in rendered(arms=follow)
    fault = rendered(arms={"left": FAULTY_ARM})
    assert "left arm: at fault (joint 3)" in fault
    assert "press Reset the fault" in fault
    blocked = rendered(arms=arms_in(mode="hold", path_blocked=True, reason="edge force 21 N"))
    assert "its path is blocked (edge force 21 N)" in blocked
    assert "Lower Tension" in blocked
    assert "Check the power" in rendered(arms=arms_in(mode="disconnected"))
    assert "E-STOP is engaged: why" in rendered(arms={"left": FAULTY_ARM}, estop_reason="why")
    assert GraphState("", {"left": FAULTY_ARM}).resettable
    assert not GraphState("", arms_in(mode="hold", path_blocked=True)).resettable
    assert panels.problem("") == ""
    assert "&lt;" in panels.problem("<")


def test_the_text_names_a_busy_computer_before_the_remedy_for_the_arms() -> None:
    lost = {"left": arm_state("left", mode="disconnected", faults=("no answer",))}
    busy = "The computer main is busy: twin_arms waits for a processor 60% of the time."
    html = rendered(arms=lost, overload=busy)
    heading, _, text = html.partition("fs-words")
    assert "left arm: not connected (no answer)" in heading
    assert text.index("The computer main is busy") < text.index("Check the power")
    # The numbers change every second; a screen reader repeats the heading when it changes.
    assert "60%" not in heading
    assert "busy" not in rendered(arms=lost, estop_reason="why", overload=busy).partition("fs-w")[0]


def test_arms_that_start_are_no_fault() -> None:
    html = rendered(arms={"left": arm_state("left", mode="starting")})
    assert "Arms: starting" in html
    assert "fs-ground-quiet" in html


@pytest.mark.parametrize("auto", [True, False])
def test_only_arms_that_wait_for_arming_are_shown_as_such(auto: bool) -> None:
    stopped = rendered(arms=arms_in(mode="estop", auto_arming=auto), estop_reason="why")
    faulty = rendered(arms=arms_in(mode="fault", faults=("x",), auto_arming=auto))
    idle = rendered(arms=arms_in(mode="idle", auto_arming=auto))
    for html in (stopped, faulty):
        assert ("the arms then move immediately" in html) == auto
    for html in (stopped, faulty, idle):
        assert ("flexsheet arms enable" in html) != auto


def test_the_reason_for_no_motion_is_below_the_banner() -> None:
    idle = {"left": arm_state("left", mode="idle", reason="not told <yet>")}
    assert "The left arm reports: not told &lt;yet&gt;." in rendered(arms=idle)
    assert "9 s left" in rendered(solver_note="precomputing the soft body: 9 s left")


def test_names_with_markup_are_shown_as_text() -> None:
    evil = '<img src=x onerror="alert(1)">'
    blocked = arms_in(mode="hold", path_blocked=True, reason=evil)
    for html in (
        rendered(scene=evil, estop_reason=evil),
        rendered(arms=arms_in(mode="fault", faults=(evil,), reason=evil)),
        rendered(arms=blocked, overload=evil, solver_note=evil),
        panels.make_nodes_table(
            {evil: (status_of(evil, notes=(Note(detail=evil),), errors=1, last_error=evil), 0.0)}
        ),
        panels.problem(evil),
        panels.recorder(evil, (evil,)),
    ):
        assert "<img" not in html


def test_texts_of_the_tabs() -> None:
    assert "No fingertip" in panels.finger(None)
    lost = fingertip(np.zeros(3)).model_copy(update={"valid": False, "reason": "no_marker"})
    assert "not tracked: no mark" in panels.finger(lost)
    reported = panels.finger(fingertip(np.array([-0.012, 0.003, -0.0041])))
    assert "12 mm left and 3 mm above the screen" in reported
    assert "4 mm behind" in reported
    resting: dict[str, Any] = {"state": EyeViewState.RESTING, "waited_s": 1.0, "ago_s": None}
    assert "twin_eye" in panels.eye(enabled=True, possible=False, **resting)
    assert "Tick" in panels.eye(enabled=False, possible=True, **resting)
    assert "no recorder" in panels.recorder(None, ())
    assert "Bookmarks: one, &lt;b&gt;." in panels.recorder("waits", ("one", "<b>"))


COLORS = dict(re.findall(r"--fs-([\w-]+): (#[0-9a-f]{6});", PAGE_STYLE))


def contrast(one: str, other: str) -> float:
    """Return WCAG's contrast ratio of two colours, 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_text_has_the_contrast_of_wcag_aa() -> None:
    ground = COLORS["ground"]
    for name in ("text", "quiet", "good", "warn", "bad", "accent"):
        assert contrast(COLORS[name], ground) >= 4.5, name
    for name in ("button", "button-hover"):
        assert contrast(COLORS[name], "#ffffff") >= 4.5, name
    # The ring around the element that has the focus is no text.
    assert contrast(COLORS["focus"], ground) >= 3.0


def test_white_has_contrast_on_every_banner() -> None:
    grounds = re.findall(r"\.fs-ground-(\w+) \{\s*background: (#[0-9a-f]{6})", PAGE_STYLE)
    assert {name for name, _ in grounds} == {"good", "bad", "quiet"}
    assert all(contrast(color, "#ffffff") >= 4.5 for _, color in grounds)
    for color in (STOP_COLOR, RECORDING_COLOR):
        assert contrast("#{:02x}{:02x}{:02x}".format(*color), "#ffffff") >= 4.5
