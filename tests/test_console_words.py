"""What the page tells: tables, banner, latencies, in words and colours that can be read."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from messages.types import PortStatus, Status
from nodes.console import dress, panels
from nodes.console.history import SERIES, WINDOW_S, History
from nodes.console.page import STOP_COLOR
from nodes.console.record_tab import RECORDING_COLOR
from tests.arm_states import arm_state
from tests.colours import luminance
from tests.console_parts import Shelf
from tests.fingertips import fingertip

PAGE_STYLE = (dress.HERE / "page.css").read_text()


def port(topic: str, **changes: Any) -> PortStatus:
    values: dict[str, Any] = {
        "topic": topic,
        "rate_hz": 60.0,
        "age_s": 0.012,
        "messages": 10,
        "dropped": 0,
        "gaps": 0,
        "rejected": 0,
    }
    return PortStatus(**values | changes)


def status(node: str, **changes: Any) -> Status:
    values: dict[str, Any] = {
        "node": node,
        "state": "running",
        "pid": 1,
        "uptime_s": 1.0,
        "cpu_ratio": 0.25,
        "resident_bytes": 1,
        "inputs": (),
        "outputs": (),
        "errors": 0,
        "last_error": "",
        "note": "",
        "plan_hash": "",
        "clock_id": "here",
    }
    return Status(**values | changes)


def test_tables_say_in_words_what_is_wrong() -> None:
    statuses = {
        "camera": (status("camera", outputs=(port("stereo", rate_hz=3.0), port("eye"))), 0.5),
        "planner": (status("planner", inputs=(port("stereo", dropped=7, gaps=2, rejected=1),)), 0),
        "left": (status("left", state="degraded", errors=2, last_error="<b>bang</b>"), 0.0),
        "right": (status("right", outputs=(port("frame", rate_hz=0.0),)), 9.0),
    }
    topics, nodes = panels.topics_table(statuses), panels.nodes_table(statuses)
    assert "1 refused" in topics
    assert ">12<" in topics, "the age, ms"
    assert ">7<" in topics
    assert "frame" not in topics, "what a silent node once wrote is nothing"
    assert "degraded" in nodes
    assert "2 errors: &lt;b&gt;bang" in nodes
    assert "silent for 9 s" in nodes
    assert ">25<" in nodes, "the share of a core, %"
    quiet = {"camera": (status("camera", outputs=(port("stereo", rate_hz=0.0),)), 0.5)}
    assert "silent" in panels.topics_table(quiet)
    slow = {"camera": (status("camera", outputs=(port("stereo", rate_hz=3.0),)), 0.5)}
    assert "slow" in panels.topics_table(slow)


def test_the_banner_shouts_what_matters_most() -> None:
    follow = {"left": arm_state("left", edge_force_n=5.1), "right": arm_state("right")}
    assert "5.1 N" in panels.banner("cylinder", follow, None)
    fault = {"left": arm_state("left", mode="fault", faults=("joint 3",))}
    assert "left arm: at fault (joint 3)" in panels.banner("cylinder", fault, None)
    assert "E-STOP is engaged: why" in panels.banner("cylinder", fault, "why")
    assert "Waiting" in panels.banner("cylinder", {}, None)
    assert panels.problem("") == ""
    assert "&lt;" in panels.problem("<")


def test_under_the_banner_stands_why_nothing_happens() -> None:
    idle = {"left": arm_state("left", mode="idle", reason="not told <yet>")}
    assert "The left arm says: not told &lt;yet&gt;." in panels.banner("cylinder", idle, None)
    busy = panels.banner("cylinder", {}, None, busy="precomputing the soft body: 9 s left")
    assert "9 s left" in busy
    replay = panels.banner("sphere", {}, None, replay="a.mcap")
    assert "REPLAY" in replay
    assert "live" not in replay.partition("fs-words")[2]


def test_words_of_the_tabs() -> None:
    assert "No fingertip" in panels.finger(None)
    lost = fingertip(np.zeros(3)).model_copy(update={"valid": False, "reason": "no_marker"})
    assert "not tracked: no mark" in panels.finger(lost)
    told = panels.finger(fingertip(np.array([-0.012, 0.003, -0.0041])))
    assert "12 mm left and 3 mm above the screen" in told
    assert "4 mm behind" in told
    assert "twin_eye" in panels.eye(wanted=True, possible=False, ago_s=None)
    assert "Tick" in panels.eye(wanted=False, possible=True, ago_s=None)
    assert "Taken 3 s ago" in panels.eye(wanted=True, possible=True, ago_s=3.2)
    assert "no recorder" in panels.recorder(None, ())
    assert "Marked: one, &lt;b&gt;." in panels.recorder("waits", ("one", "<b>"))


def colors_of(scheme: str) -> dict[str, str]:
    """The page's own colours by name, on a page that is "light" or "dark"."""
    blocks = re.findall(r"^html:root(\S*) \{(.*?)^\}", PAGE_STYLE, re.MULTILINE | re.DOTALL)
    found: dict[str, str] = {}
    for where, block in blocks:
        if not where or f'="{scheme}"' in where:
            found |= dict(re.findall(r"--fs-([\w-]+): (#[0-9a-f]{6});", block))
    return found


def contrast(one: str, other: str) -> float:
    """WCAG's ratio of two colours, 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_as_much_as_wcag_aa_asks(scheme: str) -> None:
    colors = colors_of(scheme)
    ground = colors["ground"]
    for name in ("text", "quiet", "good", "warn", "bad", "accent"):
        assert contrast(colors[name], ground) >= 4.5, name
    for name in ("button", "button-hover"):
        assert contrast(colors[name], "#ffffff") >= 4.5, name
    # Lines and the ring around what has the focus are no text.
    for color in (colors["focus"], *(line.color for line in panels.LINES)):
        assert contrast(color, ground) >= 3.0, color


def test_white_stands_out_on_every_banner() -> None:
    grounds = re.findall(r"\.fs-ground-(\w+) \{\s*background: (#[0-9a-f]{6})", PAGE_STYLE)
    assert {name for name, _ in grounds} == {"good", "warn", "bad", "quiet"}
    assert all(contrast(color, "#ffffff") >= 4.5 for _, color in grounds)
    for color in (STOP_COLOR, RECORDING_COLOR):
        assert contrast("#{:02x}{:02x}{:02x}".format(*color), "#ffffff") >= 4.5


def test_latencies_are_from_the_exposure_on() -> None:
    history = History()
    assert np.isnan(history.columns()[1]).all()
    shelf = Shelf(
        fingertip=fingertip(np.zeros(3)),
        arm_left=arm_state("left", target_source_ns=1_000_000, command_sent_ns=9_000_000),
        arm_right=arm_state("right"),
    )
    for second in range(40):
        history.take(float(second), shelf)
    times, *series = history.columns()
    assert (times[0], times[-1]) == (-WINDOW_S, 0.0)
    last = dict(zip(SERIES, (one[-1] for one in series), strict=True))
    assert last["finger found"] == pytest.approx(3.0)
    assert last["arm commanded"] == pytest.approx(8.0)
    assert np.isnan(last["frame drawn"])
    told = history.newest_and_worst()
    assert told["finger found"] == pytest.approx((3.0, 3.0))
    legend = panels.latency_table(told)
    assert ">8<" in legend
    assert "–" in legend, "nothing was drawn"
