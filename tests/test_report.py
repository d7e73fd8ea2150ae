"""Test `bag report`: correct contents, also for incomplete sessions."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flexsheet.launch.bags.report import (
    MARK,
    make_result,
    read_session,
    render_page,
    report,
)
from flexsheet.launch.experiments.stroke import read_recording, stroke_errors, summary
from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.types import (
    ArmState,
    HostStatus,
    PortStatus,
    Status,
    TwinFinger,
)
from tests import sessions
from tests.arm_states import arm_state
from tests.commands import Command
from tests.fingertips import fingertip

LONELY = ("scene", "fingertip", "sheet_target", "arm_left", "arm_right", "soft_body", "status",
          "twin/finger", "stereo", "twin/eye", "frame", "bookmark", "estop")  # fmt: skip
SHORT = ("scene", "fingertip", "arm_left", "status", "stereo")
"""Topics that a bag lacks in `make test`."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sessions.write_session(tmp_path_factory.mktemp("bags") / "a.mcap")


@pytest.fixture(scope="module")
def numbers(bag: Path) -> dict[str, Any]:
    return make_result(read_session(bag))


@pytest.fixture(scope="module")
def page(bag: Path) -> str:
    session = read_session(bag)
    return render_page(session, make_result(session))


def count_events(numbers: dict[str, Any]) -> dict[str, int]:
    kinds = [one["kind"] for one in numbers["events"]]
    return {kind: kinds.count(kind) for kind in kinds}


def list_problems(numbers: dict[str, Any]) -> list[str]:
    return [one["text"] for one in numbers["findings"]]


def true_finger(position: np.ndarray[Any, Any]) -> TwinFinger:
    return TwinFinger(path_label="", path_done=False, path_time_s=0.0, position_world_m=position,
                      velocity_world_m_per_s=np.zeros(3))  # fmt: skip


# The numbers.


def test_the_errors_are_those_of_the_experiment(bag: Path, numbers: dict[str, Any]) -> None:
    """The simulated error of the sheet is constant, so the stroke has the mean of the session."""
    contact, errors = (
        numbers["sheet"]["contact"],
        stroke_errors(read_recording(bag), sessions.STROKE_S),
    )
    for key, values, scale in (
        ("delta_d_mm", errors.delta_d_m, 1e3),
        ("delta_theta_deg", errors.delta_theta_rad, np.degrees(1.0)),
        ("true_delta_d_mm", errors.true_delta_d_m, 1e3),
        ("true_delta_theta_deg", errors.true_delta_theta_rad, np.degrees(1.0)),
    ):
        assert contact[key] == pytest.approx(summary(values, scale), abs=1e-6), key
    # The offset along the normal, and the arc that the turn is, at right angles.
    radius_m = sessions.SCENE.object.geometry.radius_m  # type: ignore[union-attr]
    expected_mm = 1e3 * np.hypot(sessions.OFF_M, radius_m * sessions.TURNED_RAD)
    assert contact["true_delta_d_mm"]["mean"] == pytest.approx(expected_mm, rel=0.01)
    assert contact["true_delta_theta_deg"]["mean"] == pytest.approx(np.degrees(sessions.TURNED_RAD))


def test_latencies_forces_and_fingertips(numbers: dict[str, Any]) -> None:
    assert numbers["latency_ms"]["fingertip"]["p50"] == pytest.approx(8.0)
    assert numbers["latency_ms"]["left arm command"]["p99"] == pytest.approx(5.0)
    assert numbers["latency_ms"]["frame drawn"]["p50"] == pytest.approx(28.0)
    assert numbers["max_edge_force_n"] == {"left": 25.0, "right": 5.0}
    assert numbers["fingertip_mm"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert numbers["fingertips"] == {"ok": numbers["topics"]["fingertip"]["messages"]}
    assert numbers["nodes"]["planner"]["notes"] == {"info": "strokes"}


def test_a_wrong_fingertip_is_an_error_against_the_truth(tmp_path: Path) -> None:
    bag = tmp_path / "a.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        for number in range(3):
            position = np.array([0.01 * number, 0.0, 0.0])
            desk.write("twin/finger", true_finger(position), 0.02 * number)
        for at_s, x_m in ((0.015, 0.005), (0.025, 0.01)):
            desk.write("fingertip", fingertip(np.array([x_m, 0.003, 0.0])), at_s, age_s=0.005)
    found = make_result(read_session(bag))["fingertip_mm"]
    assert found["mean"] == pytest.approx(3.0)


def test_topics_know_what_is_missing(numbers: dict[str, Any]) -> None:
    topic = numbers["topics"]["fingertip"]
    assert topic["missing"] == 39
    assert topic["silences"] == 1
    assert topic["longest_silence_s"] == pytest.approx(0.8, abs=0.03)
    assert (topic["dropped"], topic["gaps"], topic["refused"]) == (5, 2, 1)
    assert numbers["topics"]["sheet_target"]["missing"] == 0
    assert not any("lost before" in text for text in list_problems(numbers))


def test_a_busy_computer_is_a_problem(tmp_path: Path) -> None:
    bag = tmp_path / "busy.mcap"
    quiet = HostStatus(
        host="main", run="1", plan_hash="", code="", python="3.11", uptime_s=1.0, load_ratio=1.2,
        disk_free_bytes=0, memory_free_bytes=0, nodes=(), missing_devices=(),
    )  # fmt: skip
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        desk.write("host", quiet, 0.5, writer="launch")
        desk.write("host", quiet.model_copy(update={"load_ratio": 8.14}), 1.5, writer="launch")
    numbers = make_result(read_session(bag))
    assert numbers["busy_fraction"] == {"main": 0.5}
    assert list_problems(numbers)[0].startswith("The computer main was busy in 50% of the time; ")


def test_an_arm_that_starts_is_no_event_and_no_fault(tmp_path: Path) -> None:
    bag = tmp_path / "start.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        for number, mode in enumerate(("starting", "idle", "follow")):
            desk.write("arm_left", arm_state("left", mode=mode), 0.1 * number)
    assert make_result(read_session(bag))["events"] == []


@pytest.mark.parametrize(
    ("stop_s", "again", "kind"),
    [
        (2.5, None, "end"),
        # The bridge runs on, ends much later, or reports a moving arm again: the arm had a fault.
        (None, None, "fault"),
        (9.0, None, "fault"),
        (2.5, arm_state("left", mode="follow"), "fault"),
    ],
)
def test_a_controller_that_ends_before_its_bridge_is_no_fault(
    tmp_path: Path, stop_s: float | None, again: ArmState | None, kind: str
) -> None:
    bag = tmp_path / "end.mcap"
    lost = arm_state("left", mode="disconnected", reason="no answer", faults=("no answer",))
    running = Status(node="bridge", state="running", pid=1, uptime_s=1.0, cpu_ratio=0.0,
                     resident_bytes=1, inputs=(), outputs=(), errors=0, last_error="",
                     plan_hash="")  # fmt: skip
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        for tenth in range(20):
            following = arm_state("left", mode="follow")
            desk.write("arm_left", following, 0.1 * tenth, writer="bridge")
        desk.write("status", running, 1.0, writer="bridge")
        desk.write("arm_left", lost, 2.0, writer="bridge")
        if again is not None:
            desk.write("arm_left", again, 2.2, writer="bridge")
        if stop_s is not None:
            stopping = running.model_copy(update={"state": "stopping"})
            desk.write("status", stopping, stop_s, writer="bridge")
    numbers = make_result(read_session(bag))
    counts = {"end": 2} if kind == "end" else {"arm": 1, "fault": 1}
    assert count_events(numbers) == counts
    found = [text for text in list_problems(numbers) if text.startswith("An arm had a fault")]
    assert bool(found) == (kind == "fault")


def test_problems_are_listed_with_the_worst_first(numbers: dict[str, Any]) -> None:
    printed = " ".join(list_problems(numbers))
    for part in (
        "An e-stop was engaged or reset (number: 1), first at 2.10 s: e-stop engaged by console: "
        "a person.",
        "left arm: joint 3 is hot",
        "left arm: the edge force reached 25 N; the scene allows 20 N.",
        "planner had 3 errors; the last: on_fingertip: bang.",
        "fingertip: 1 messages were refused",
        "fingertip: no message for up to 0.80 s",
        "15 pushes were deeper than the range",
    ):
        assert part in printed, part
    gravities = [one["gravity"] for one in numbers["findings"]]
    assert gravities == sorted(gravities)


def test_the_numbers_are_json(numbers: dict[str, Any]) -> None:
    assert json.loads(json.dumps(numbers, allow_nan=False)) == json.loads(json.dumps(numbers))


# The page.


class Reader(HTMLParser):
    """Parser of the tested parts of a page: tags, images, loaded resources."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[dict[str, str | None]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.images.append(dict(attrs))
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_self_contained_and_has_a_figure(page: str) -> None:
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    (image,) = reader.images
    assert len(image["alt"] or "") > 10
    kind, data = (image["src"] or "").split(",")
    assert kind == "data:image/png;base64"
    drawn = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None
    assert drawn.std() > 5.0
    assert not re.search(r"<script|<link|@import|href=", page)


def test_texts_from_the_bag_are_escaped(page: str) -> None:
    assert "<b>first touch</b>" not in page
    assert "&lt;b&gt;first touch&lt;/b&gt;" in page


# Bags that lack something.


@pytest.mark.parametrize(
    "leave_out",
    [
        *(
            pytest.param((name,), marks=() if name in SHORT else pytest.mark.long)
            for name in LONELY
        ),
        LONELY,
    ],
    ids=lambda names: "+".join(names)[:20],
)
def test_a_bag_may_lack_any_topic(
    tmp_path: Path, leave_out: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The figure is drawn once, elsewhere.
    path = sessions.write_session(tmp_path / "a.mcap", leave_out=leave_out)
    session = read_session(path)
    monkeypatch.setattr("flexsheet.launch.bags.report.draw_figure", lambda session: b"")
    result = make_result(session)
    assert "<h2>Numbers</h2>" in render_page(session, result)
    json.dumps(result, allow_nan=False)


def test_an_empty_bag_has_no_problem(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    BagWriter(path).close()
    session = read_session(path)
    assert "No problem was found" in render_page(session, make_result(session))


def test_a_cut_bag_is_read_as_far_as_it_goes(bag: Path, tmp_path: Path) -> None:
    data = bag.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) - 400])
    found = make_result(read_session(cut))
    assert list_problems(found)[0].startswith("The bag is incomplete (truncated after")
    assert found["messages"] > 100


# The command.


def test_the_command_writes_beside_the_bag_and_over_reports_only(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flexsheet: Command
) -> None:
    copy = tmp_path / "b.mcap"
    copy.write_bytes(bag.read_bytes())
    monkeypatch.setattr("flexsheet.launch.bags.report.draw_figure", lambda session: b"")
    for _ in range(2):
        result = report(copy, copy.with_suffix(".html"), lambda done, whole: None)
    assert MARK in copy.with_suffix(".html").read_text()
    written = json.loads(copy.with_suffix(".report.json").read_text())
    assert written == json.loads(json.dumps(result))
    letter = tmp_path / "letter.html"
    letter.write_text("dear")
    with pytest.raises(BagError, match="is not a report, so it is not overwritten"):
        report(copy, letter, lambda done, whole: None)
    assert letter.read_text() == "dear"
    printed = flexsheet("bag", "report", copy, "--json")
    assert printed.code == 0
    assert printed.json()["messages"] > 100


@pytest.mark.parametrize(("uptime_s", "gaps"), [(100.0, 3), (1.0, 8)])
def test_what_was_lost_before_the_bag_began_is_not_of_the_bag(
    tmp_path: Path, uptime_s: float, gaps: int
) -> None:
    bag = tmp_path / "a.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        for number, count in enumerate((5, 8)):
            port = PortStatus(topic="twin/finger", rate_hz=50.0, age_s=0.01, messages=90, dropped=0,
                              gaps=count, rejected=0)  # fmt: skip
            status = Status(node="eye", state="running", pid=1, uptime_s=uptime_s + number,
                            cpu_ratio=0.0, resident_bytes=1, inputs=(port,), outputs=(), errors=0,
                            last_error="", plan_hash="")  # fmt: skip
            desk.write("status", status, float(number))
    numbers = make_result(read_session(bag))
    assert numbers["topics"]["twin/finger"]["gaps"] == gaps
    assert f"twin/finger: {gaps} messages were lost before their readers." in list_problems(numbers)
