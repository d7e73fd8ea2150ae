"""Test `bag report`: correct contents, also for incomplete sessions."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from flexsheet.launch.bags.report.album import MAX_BOOKMARK_SHOTS, Album
from flexsheet.launch.bags.report.charts import find_intervals, mark_isolated
from flexsheet.launch.bags.report.findings import find_problems
from flexsheet.launch.bags.report.numbers import compute_numbers, describe_methods
from flexsheet.launch.bags.report.page import COLOURS, MARK, SECTIONS, render_page
from flexsheet.launch.bags.report.series import Events, Grid, Maxima, RunningMoments, Spread, States
from flexsheet.launch.bags.report.session import PortTotals, read_session
from flexsheet.launch.bags.report.strokes import SheetErrors
from flexsheet.launch.bags.report.write import make_result, report
from flexsheet.launch.experiments.stroke import read_recording, stroke_errors, summary
from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.methods import Methods
from flexsheet.messages.types import (
    ArmState,
    HostStatus,
    PortStatus,
    Status,
    TwinFinger,
)
from tests import sessions
from tests.arm_states import arm_state
from tests.colours import luminance
from tests.commands import Command

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
    return render_page(read_session(bag))


# What is kept.


@given(st.lists(st.floats(2e-5, 50.0), min_size=1, max_size=200), st.floats(0.01, 1.0))
def test_a_histogram_has_quantiles_to_a_cell(durations: list[float], fraction: float) -> None:
    spread = Spread(Grid(0, 1.0, 2))
    for duration in durations:
        spread.add(1, duration)
    found = spread.quantile_s(fraction)
    exact = float(np.quantile(durations, fraction, method="inverted_cdf"))
    assert found == pytest.approx(exact, rel=0.024)
    assert np.isnan(spread.quantiles_s(fraction)[0])
    assert spread.longest_s == max(durations)


def test_nothing_has_no_quantile_and_no_summary() -> None:
    grid = Grid(0, 1.0, 3)
    assert Spread(grid).quantile_s(0.5) is None
    assert Maxima(grid).overall() is None
    assert RunningMoments().summary(1.0) is None


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50))
def test_moments_are_numpys(values: list[float]) -> None:
    moments = RunningMoments()
    for one in values:
        moments.add(np.abs([one]))
    found, wanted = moments.summary(2.0), summary(np.abs(values), 2.0)
    assert found is not None
    for key in ("mean", "max"):
        assert found[key] == pytest.approx(wanted[key])
    assert found["std"] == pytest.approx(wanted["std"], abs=1e-3)


def test_what_is_kept_does_not_grow_with_what_came() -> None:
    album, events = Album(4, [(50.0, "x")]), Events(limit=5)
    image = np.zeros((2, 2), np.uint8)
    for i in range(100):
        album.add(float(i), str(i), (("left", image),))
        events.add(float(i), "gap", "")
    events.add(3.0, "estop", "late, but of another kind")
    shots = album.shots()
    assert [shot.seconds for shot in shots if shot.marked] == [50.0]
    assert 3 <= len(shots) <= 6
    spread = np.diff([shot.seconds for shot in shots if not shot.marked])
    assert spread.max() <= 2 * spread.min(), "all over the session"
    assert album.count == 100
    assert len(events.stored) == 6
    assert events.counts == {"gap": 100, "estop": 1}


def test_of_many_moments_the_first_are_shown_and_the_rest_counted() -> None:
    album = Album(4, [(float(i), str(i)) for i in range(500)])
    for i in range(500):
        album.add(float(i), "", (("left", np.zeros((2, 2), np.uint8)),))
    assert len(album.shots()) == MAX_BOOKMARK_SHOTS
    assert album.left_out == 500 - MAX_BOOKMARK_SHOTS
    assert album.count == 500


def test_states_last_until_another_and_gaps_stay_white() -> None:
    grid = Grid(0, 10.0, 10)
    states = States(grid, ("wait", "contact"))
    reported = ((0, "wait"), (1, "wait"), (2, "contact"), (7, "contact"))
    changed = [states.add(second, second * 10**9, state) for second, state in reported]
    assert changed == [False, False, True, False]
    assert list(find_intervals(states, grid)) == [
        ("wait", 0.0, 2.0),
        ("contact", 2.0, 3.0),
        ("contact", 7.0, 8.0),
    ]
    assert list(find_intervals(states, grid, lasting=True)) == [
        ("wait", 0.0, 2.0),
        ("contact", 2.0, 10.0),
    ]
    # What nobody confirmed is not counted beyond half a second.
    assert states.seconds == {"wait": 1.0, "contact": 0.5}


@pytest.mark.parametrize(("label", "stroke_s"), [("anything", 2.0), ("stroke 2 s", None)])
def test_a_stroke_is_recognized_by_its_duration_not_by_its_label(
    label: str, stroke_s: float | None
) -> None:
    errors = SheetErrors(Grid(0, 1.0, 1))
    finger = TwinFinger(
        path_label=label,
        path_done=False,
        path_time_s=0.5,
        path_stroke_s=stroke_s,
        position_world_m=np.zeros(3),
        velocity_world_m_per_s=np.zeros(3),
    )
    errors.add(finger, 1_000_000_000)
    assert [run.stroke_s for run in errors.runs] == [stroke_s]


# What is told.


def test_the_strokes_errors_are_those_of_the_experiment(bag: Path, numbers: dict[str, Any]) -> None:
    (stroke,) = numbers["sheet"]["strokes"]
    errors = stroke_errors(read_recording(bag), sessions.STROKE_S)
    for key, values, scale in (
        ("delta_d_mm", errors.delta_d_m, 1e3),
        ("delta_theta_deg", errors.delta_theta_rad, np.degrees(1.0)),
        ("true_delta_d_mm", errors.true_delta_d_m, 1e3),
        ("true_delta_theta_deg", errors.true_delta_theta_rad, np.degrees(1.0)),
    ):
        assert stroke[key] == pytest.approx(summary(values, scale), abs=1e-6), key
    # The offset along the normal, and the arc that the turn is, at right angles.
    radius_m = sessions.SCENE.object.geometry.radius_m  # type: ignore[union-attr]
    expected_mm = 1e3 * np.hypot(sessions.OFF_M, radius_m * sessions.TURNED_RAD)
    assert stroke["true_delta_d_mm"]["mean"] == pytest.approx(expected_mm, rel=0.01)
    turned = np.degrees(sessions.TURNED_RAD)
    assert numbers["sheet"]["contact"]["true_delta_theta_deg"]["mean"] == pytest.approx(turned)


def test_latencies_speeds_and_forces(numbers: dict[str, Any]) -> None:
    assert numbers["latency_ms"]["fingertip"]["p50"] == pytest.approx(8.0, rel=0.03)
    assert numbers["latency_ms"]["left arm command"]["p99"] == pytest.approx(5.0, rel=0.03)
    assert numbers["latency_ms"]["frame drawn"]["p50"] == pytest.approx(28.0, rel=0.03)
    right = numbers["arms"]["right"]
    assert right["joint_speed_ratio"][1] == pytest.approx(3.3 / np.radians(90.0), rel=1e-6)
    assert numbers["arms"]["left"]["edge_force_n"] == 25.0
    assert numbers["arms"]["left"]["modes_s"]["fault"] == pytest.approx(0.98, abs=0.03)


def test_a_nodes_methods_are_those_of_its_parameters_else_of_its_scene() -> None:
    chosen = Methods.model_validate(
        {"correction": "one_plane", "soft_body": {"method": "linear", "skin_spacing_m": 0.006}}
    )
    tuned = sessions.SCENE.model_copy(update={"methods": chosen})
    eye = {"correction": "auto", "sheet_shape": "auto", "rate_hz": 60.0}
    assert describe_methods(eye, tuned) == "sheet_shape default, correction one_plane"
    assert describe_methods(eye, None) == "sheet_shape default, correction default"
    assert describe_methods({"method": "auto"}, tuned) == "linear"
    assert describe_methods({"side": "left"}, tuned) is None


def test_topics_know_what_is_missing(numbers: dict[str, Any]) -> None:
    topic = numbers["topics"]["fingertip"]
    assert topic["missing"] == 39
    assert topic["silences"] == 1
    assert topic["longest_silence_s"] == pytest.approx(0.8, abs=0.03)
    assert (topic["skipped"], topic["lost"], topic["refused"]) == (7, 0, 1)
    assert numbers["topics"]["sheet_target"]["missing"] == 0


def test_a_busy_computer_is_the_first_finding(tmp_path: Path) -> None:
    bag = tmp_path / "busy.mcap"
    arm = arm_state("left", mode="follow")
    lost = arm_state("left", mode="disconnected", reason="no answer", faults=("no answer",))
    quiet = HostStatus(
        host="main", run="1", plan_hash="", code="", python="3.11", uptime_s=1.0, load_ratio=1.2,
        disk_free_bytes=0, memory_free_bytes=0, nodes=(), missing_devices=(),
    )  # fmt: skip
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        desk.write("arm_left", arm, 0.0)
        desk.write("host", quiet, 0.5, writer="launch")
        desk.write("arm_left", lost, 1.0)
        desk.write("host", quiet.model_copy(update={"load_ratio": 8.14}), 1.5, writer="launch")
        desk.write("arm_left", arm, 2.0)
    numbers = compute_numbers(read_session(bag))
    assert numbers["hosts"]["main"]["busy_fraction"] == 0.5
    first = find_problems(numbers)[0]
    assert first.gravity == "bad"
    assert first.text.startswith(
        "In 50% of the time the computer main is busy: 8.1 runnable processes per core "
        "(at worst). Probable consequences: an arm "
        "stopped following once; messages of these topics were lost or delayed: arm_left. "
        "What to do: "
    )


def test_an_overload_is_one_finding_for_all_topics(numbers: dict[str, Any]) -> None:
    def section(hosts: dict[str, Any]) -> list[str]:
        found = find_problems(numbers | {"hosts": hosts})
        return [one.text for one in found if one.section == "topics"]

    busy = {"busy_fraction": 0.5, "busy_at_worst": "main is busy", "busy_remedy": "close programs",
            "missing_devices": []}  # fmt: skip
    assert len(section({})) > 2
    assert section({"main": busy}) == [
        "fingertip: 1 messages were refused by their readers.",
    ]
    first = find_problems(numbers | {"hosts": {"main": busy, "left": busy}})[0].text
    assert first.count("In 50% of the time main is busy (at worst).") == 2
    assert first.count("close programs") == 1
    assert first.count("fingertip") == 1


def test_an_arm_that_starts_is_no_event_and_no_fault(tmp_path: Path) -> None:
    bag = tmp_path / "start.mcap"
    with BagWriter(bag, {"recording": {"clock_id": "clock"}}) as writer:
        desk = sessions.MessageWriter(writer, ())
        for number, mode in enumerate(("starting", "idle", "follow")):
            desk.write("arm_left", arm_state("left", mode=mode), 0.1 * number)
    numbers = compute_numbers(read_session(bag))
    assert numbers["events"]["counts"] == {}


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
    numbers = compute_numbers(read_session(bag))
    counts = {"end": 2} if kind == "end" else {"arm": 1, "fault": 1}
    assert numbers["events"]["counts"] == counts
    found = [one.text for one in find_problems(numbers) if one.section == "timeline"]
    assert any(text.startswith("An arm had a fault") for text in found) == (kind == "fault")
    assert bool(found) == (kind == "fault")


def test_errors_are_listed_with_the_worst_first(numbers: dict[str, Any]) -> None:
    found = find_problems(numbers)
    printed = " ".join(one.text for one in found)
    for part in (
        "has changes after its commit",
        "An e-stop was engaged or released once, first at 2.10 s: e-stop engaged by console: "
        "a person.",
        "left arm: joint 3 is hot",
        "right arm: joint 2 reached 210% of its maximum speed.",
        "left arm: the edge force reached 25 N; the scene allows 20 N.",
        "planner had 3 errors; the last: on_fingertip: bang.",
        "fingertip: 1 messages were refused",
        "The topic fingertip had no messages once",
        "In 10.0 % of the results, the finger was deeper than the range",
    ):
        assert part in printed, part
    gravities = [one.gravity for one in found]
    assert gravities == sorted(gravities)
    assert {one.section for one in found} <= SECTIONS.keys()


def test_the_numbers_are_json(numbers: dict[str, Any]) -> None:
    assert json.loads(json.dumps(numbers, allow_nan=False)) == json.loads(json.dumps(numbers))


# The page.


class Reader(HTMLParser):
    """Parser of the tested parts of a page: tags, headings, images, loaded resources."""

    def __init__(self) -> None:
        super().__init__()
        self.headings: list[int] = []
        self.images: list[dict[str, str | None]] = []
        self.fetched: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "img":
            self.images.append(given)
        self.fetched += [
            value
            for name, value in attrs
            if name in ("src", "href") and value and not value.startswith(("data:", "#"))
        ]
        if tag == "a":
            self.links.append((given.get("href") or "").removeprefix("#"))
        if given.get("id"):
            self.ids.append(str(given["id"]))
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_self_contained_and_accessible(page: str) -> None:
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert not reader.fetched, "nothing is fetched"
    assert "@import" not in page
    assert "<script" not in page
    assert '<html lang="en">' in page
    assert reader.headings[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(reader.headings))
    assert reader.images
    assert all(len(image.get("alt") or "") > 10 for image in reader.images)
    assert len(reader.ids) == len(set(reader.ids))
    assert set(reader.links) <= set(reader.ids)


def test_texts_from_the_bag_are_escaped(page: str) -> None:
    assert "<b>first touch</b>" not in page
    assert "&lt;b&gt;first touch&lt;/b&gt;" in page


def test_images_are_those_of_the_session(page: str) -> None:
    images = re.findall(r'alt="([^"]*)" src="data:image/jpeg;base64,([^"]*)"', page)
    left = [(text, data) for text, data in images if "left camera" in text]
    levels = []
    for _, data in left:
        buffer = np.frombuffer(base64.b64decode(data), np.uint8)
        levels.append(round(float(cv2.imdecode(buffer, cv2.IMREAD_GRAYSCALE).mean()), -1))
    assert levels == [0, 10, 20]
    assert sum("expected by the eye" in text for text, _ in images) == 3
    assert sum("projector" in text for text, _ in images) == 3
    # The first shot after the moment at 1.5 s is the one of 2.2 s.
    assert re.search(r"2\.21 s\.[^<]*<strong>Bookmark: &lt;b&gt;first touch", page)


def test_the_page_states_how_many_images_it_omits(
    bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexsheet.launch.bags.report.page.draw_charts", lambda session: {})
    monkeypatch.setattr("flexsheet.launch.bags.report.session.STEREO_SHOTS", 1)
    session = read_session(bag)
    shown = len(session.stereo.shots())
    assert shown < session.stereo.count
    assert f"<p>{shown} of {session.stereo.count} are shown" in render_page(session)


@pytest.mark.parametrize("scheme", COLOURS)
def test_text_has_the_contrast_of_wcag_aa(scheme: str) -> None:
    colours = COLOURS[scheme]
    for ground in ("ground", "panel"):
        for ink in ("text", "quiet", "link", "bad", "doubtful", "good"):
            low, high = sorted(luminance(colours[name]) for name in (ground, ink))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (ground, ink)


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
    # The charts are drawn once, elsewhere: here only from what they are drawn.
    path = sessions.write_session(tmp_path / "a.mcap", leave_out=leave_out)
    session = read_session(path)
    monkeypatch.setattr("flexsheet.launch.bags.report.page.draw_charts", lambda session: {})
    text = render_page(session)
    assert all(f'id="{key}"' in text for key in SECTIONS)
    json.dumps(make_result(session), allow_nan=False)


def test_an_empty_bag_is_reported_as_that(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    BagWriter(path).close()
    text = render_page(read_session(path))
    assert "No arm was recorded." in text
    assert "No problem was found" in text


def test_a_cut_bag_is_read_as_far_as_it_goes(bag: Path, tmp_path: Path) -> None:
    data = bag.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) - 400])
    found = make_result(read_session(cut))
    assert found["findings"][0]["text"].startswith("The bag is incomplete (truncated after")
    assert found["bag"]["messages"] > 100


# The command.


def test_where_no_page_can_be_written_the_bag_is_not_read(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "flexsheet.launch.bags.report.write.read_session", lambda *_: pytest.fail("it was read")
    )
    with pytest.raises(BagError, match="give a file in a writable folder with -o"):
        report(bag, tmp_path / "none" / "a.html", lambda done, whole: None)
    folder = tmp_path / "a.html"
    folder.mkdir()
    with pytest.raises(BagError, match="give a file in a writable folder with -o"):
        report(bag, folder, lambda done, whole: None)
    assert [*tmp_path.iterdir()] == [folder]


def test_the_command_writes_beside_the_bag_and_over_reports_only(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flexsheet: Command
) -> None:
    copy = tmp_path / "b.mcap"
    copy.write_bytes(bag.read_bytes())
    monkeypatch.setattr("flexsheet.launch.bags.report.page.draw_charts", lambda session: {})
    for _ in range(2):
        report(copy, copy.with_suffix(".html"), lambda done, whole: None)
    assert MARK in copy.with_suffix(".html").read_text()
    letter = tmp_path / "letter.html"
    letter.write_text("dear")
    with pytest.raises(BagError, match="is not a report, so it is not overwritten"):
        report(copy, letter, lambda done, whole: None)
    printed = flexsheet("bag", "report", copy, "--json")
    assert printed.code == 0
    assert printed.json()["bag"]["messages"] > 100


def test_what_was_lost_before_the_bag_began_is_not_of_the_bag() -> None:
    def counted(gaps: int) -> PortStatus:
        return PortStatus(
            topic="twin/finger", rate_hz=50.0, age_s=0.01, messages=90, dropped=0, gaps=gaps,
            rejected=0,
        )  # fmt: skip

    for started_earlier, lost in ((True, 3), (False, 8)):
        port = PortTotals(Spread(Grid(0, 1.0, 1)))
        for gaps in (5, 8):
            port.add("planner", 1, counted(gaps), started_earlier=started_earlier)
        assert port.totals() == (0, lost, 0)


def test_a_gap_of_a_topic_with_the_delivery_latest_is_not_a_loss() -> None:
    for topic, totals in (("fingertip", (3, 0, 1)), ("twin/finger", (1, 2, 1))):
        port = PortTotals(Spread(Grid(0, 1.0, 1)))
        status = PortStatus(
            topic=topic, rate_hz=50.0, age_s=0.01, messages=90, dropped=1, gaps=2, rejected=1
        )
        port.add("planner", 1, status, started_earlier=False)
        assert port.totals() == totals


def test_a_single_value_is_a_point_of_the_chart() -> None:
    """A bag with one frame had an empty latency chart."""
    nan = np.nan
    axes: Any = Figure().subplots()
    seconds = np.arange(6.0)
    axes.plot(seconds, [nan, 3.0, nan, nan, nan, 4.0], "-")
    axes.plot(seconds, [nan, 1.0, 2.0, nan, nan, nan], "-")
    axes.plot(seconds[:1], [1.0], "v")
    axes.axhline(2.0)
    mark_isolated(axes)
    assert [line.get_marker() for line in axes.lines] == [".", "None", "v", "None"]
    assert axes.lines[0].get_markevery() == [1, 5]
