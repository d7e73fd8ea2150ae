"""Test the page and the graph by clicks, drags and keys in a browser."""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
import socket
import tempfile
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import websockets
from playwright.async_api import Page, async_playwright, expect

from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import runs
from flexsheet.launch.running.runs import Run, local_sources
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import Bookmark, EStop, FingerPath, Recording, TwinFinger
from flexsheet.nodes.node import PortCounts
from tests.browser import BROWSER_MARKS, CHROMIUM, DRAWN_WITHOUT_GPU, TWO_FRAMES
from tests.waiting import DEADLINE_S

ROOT = Path(__file__).resolve().parent.parent
OBJECT_PX = (244, 162)
"""Position of the object's middle, behind the sheet, in the page of 860 x 420 pixels."""
UNNAMED = """() => [...document.querySelectorAll(
    "button, input:not([type=hidden]), [role=button], [role=slider]"
)].filter(one => one.checkVisibility() && !one.labels?.length && !one.textContent.trim()
    && !one.ariaLabel).map(one => one.outerHTML).join()"""
"""Script that returns the controls without an accessible name."""

pytestmark = BROWSER_MARKS


@dataclass
class ReceivedMessages:
    """The received messages of the graph by topic, in order."""

    messages: dict[str, list[Any]] = field(default_factory=dict)
    fingers_on_first_object: int = 0
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def take(self, name: str, message: Message, header: Header) -> None:
        self.messages.setdefault(name, []).append(message)
        self.changed.set()

    def last(self, name: str) -> Any:
        return self.messages.get(name, [None])[-1]

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        try:
            async with asyncio.timeout(DEADLINE_S):
                while not condition():
                    self.changed.clear()
                    await self.changed.wait()
        except TimeoutError:
            pytest.fail(f"the graph never said: {what}")


@contextlib.asynccontextmanager
async def hearing(graph: RunningGraph, *names: str) -> AsyncIterator[ReceivedMessages]:
    inbox, subscribers = ReceivedMessages(), []
    for name in names:
        subscriber = Subscriber(
            find_topic(name),
            local_sources(graph.run, graph.plan.sources_to_read(name)),
            lambda message, header, name=name: inbox.take(name, message, header),
            PortCounts(),
        )
        subscriber.start()
        subscribers.append(subscriber)
    try:
        yield inbox
    finally:
        for subscriber in subscribers:
            subscriber.close()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@dataclass
class PageVisit:
    """The results of one visit to the page."""

    inbox: ReceivedMessages
    bag: Path
    exit_codes: dict[str, int]
    restarts: dict[str, int]
    notes: dict[str, str] = field(default_factory=dict)


async def refused(port: int, **headers: str) -> str:
    """Return the response to a WebSocket request with the given headers."""
    try:
        async with websockets.connect(
            f"ws://127.0.0.1:{port}", additional_headers=headers, open_timeout=DEADLINE_S
        ):
            return "welcome"
    except websockets.InvalidStatus as error:
        return str(error.response.status_code)


async def slide(page: Page, label: str, value: str) -> None:
    """Enter a value in the number field of a slider."""
    box = page.get_by_role("textbox", name=label)
    await box.fill(value)
    await box.press("Enter")


async def visit(page: Page, session: PageVisit, port: int) -> None:
    """Use the page as a user does."""
    await page.goto(f"http://127.0.0.1:{port}/")
    await expect(page.get_by_role("button", name="E-STOP")).to_be_visible()
    await expect(page.get_by_role("combobox", name="Scene")).to_have_value("cylinder")
    await expect(page.get_by_role("status")).to_contain_text("Waiting for the arms")
    # viser's notice that there is no graphics card lies over the sheet.
    notice = page.get_by_role("alert").filter(has_text="Software WebGL")
    await notice.get_by_role("button").evaluate("button => button.click()")
    await expect(notice).to_have_count(0)
    session.notes["unnamed"] = await page.evaluate(UNNAMED)
    await begin_recording(page, session.inbox)
    await touch(page, session.inbox)
    await change_the_scene(page, session.inbox)
    await stop_and_release(page, session.inbox)
    await page.get_by_role("tab", name="Graph").click()
    await expect(page.get_by_role("table", name="Nodes")).to_contain_text("twin_finger")
    session.notes["nodes"] = await page.get_by_role("table", name="Nodes").inner_text()
    await end_recording(page, session.inbox)


async def begin_recording(page: Page, inbox: ReceivedMessages) -> None:
    await page.get_by_role("tab", name="Record").click()
    await page.get_by_role("textbox", name="Name").fill("before anything")
    await expect(page.get_by_role("button", name="Add a bookmark")).to_be_visible()
    await page.get_by_role("button", name="Add a bookmark").click()
    await expect(page.get_by_role("alert").last).to_contain_text("start recording")
    await page.get_by_role("button", name="Start recording").click()
    await inbox.until(lambda: inbox.last("recording") == Recording(running=True), "recording")
    await page.get_by_role("textbox", name="Name").fill("first touch")
    await page.get_by_role("button", name="Add a bookmark").click()
    await inbox.until(lambda: inbox.last("bookmark") is not None, "the moment")


async def touch(page: Page, inbox: ReceivedMessages) -> None:
    await page.get_by_role("tab", name="Touch").click()
    assert "twin/finger_path" not in inbox.messages
    x, y = OBJECT_PX
    await page.mouse.move(x, y)
    await page.evaluate(TWO_FRAMES)
    await page.mouse.down()
    for step in range(1, 9):
        await page.evaluate(TWO_FRAMES)
        await page.mouse.move(x - 2 * step, y)
    await inbox.until(
        lambda: len(inbox.messages.get("twin/finger_path", [])) > 2, "a dragged finger"
    )
    await page.mouse.up()
    await inbox.until(lambda: height_m(inbox) < -0.002, "a finger at the object")
    await page.keyboard.press("l")
    await inbox.until(lambda: height_m(inbox) > 0.025, "a lifted finger")
    await slide(page, "Across, mm", "30")
    await inbox.until(lambda: across_m(inbox.last("twin/finger")) > 0.029, "a finger that is led")
    assert height_m(inbox) > 0.02, "it is still lifted"
    await push(page, inbox, 8.0)
    assert across_m(inbox.last("twin/finger")) == pytest.approx(0.03, abs=2e-3)


async def push(page: Page, inbox: ReceivedMessages, depth_mm: float) -> None:
    """Push by slider, and wait until the finger has that depth."""
    await slide(page, "Push, mm", f"{depth_mm:g}")
    await inbox.until(
        lambda: abs(1e3 * height_m(inbox) + depth_mm) < 0.5, f"a finger {depth_mm:g} mm deep"
    )


async def change_the_scene(page: Page, inbox: ReceivedMessages) -> None:
    scenes = len(inbox.messages["scene"])
    await slide(page, "Stiffness, kPa", "9")
    await inbox.until(lambda: len(inbox.messages["scene"]) > scenes, "a stiffer object")
    await push(page, inbox, 12.0)
    await page.reload()
    await expect(page.get_by_role("textbox", name="Push, mm")).to_have_value("12")
    await push(page, inbox, 6.0)
    await page.get_by_role("button", name="Lift the finger").click()
    await inbox.until(lambda: height_m(inbox) > 0.025, "a lifted finger")
    await push(page, inbox, 7.0)
    inbox.fingers_on_first_object = len(inbox.messages["twin/finger"])
    tension = page.get_by_role("slider", name="Tension")
    await expect(tension).to_have_attribute("aria-valuemax", "8")
    await page.get_by_role("combobox", name="Scene").click()
    await page.get_by_role("option", name="sphere").click()
    await inbox.until(lambda: inbox.last("scene").name == "sphere", "another scene")


async def stop_and_release(page: Page, inbox: ReceivedMessages) -> None:
    reset = page.get_by_role("button", name="Reset the fault")
    await expect(reset).to_have_attribute("title", re.compile("^Disabled, because no e-stop"))
    await page.get_by_role("button", name="E-STOP").click()
    await inbox.until(lambda: engaged(inbox) == "pressed at the console", "an e-stop")
    await expect(page.get_by_role("status")).to_contain_text("E-STOP is engaged")
    release = page.get_by_role("button", name="Release")
    await expect(release).to_be_enabled()
    await expect(release).to_have_attribute("title", re.compile("The arms must be at rest"))
    await release.press("Enter")
    await inbox.until(lambda: engaged(inbox) is None, "a release")
    # viser heeds no hotkey while a text box has the focus.
    await page.get_by_role("textbox", name="Push, mm").press("Escape")
    await inbox.until(lambda: engaged(inbox) is not None, "an e-stop from within a text box")
    await page.evaluate("() => document.activeElement.blur()")
    await page.keyboard.press("Escape")
    await inbox.until(lambda: engaged(inbox) == "Escape at the console", "an e-stop by its key")


async def end_recording(page: Page, inbox: ReceivedMessages) -> None:
    await page.get_by_role("tab", name="Record").click()
    await page.get_by_role("button", name="Stop recording").click()
    await inbox.until(lambda: inbox.last("recording") == Recording(running=False), "its end")


def height_m(inbox: ReceivedMessages) -> float:
    """Return the height of the fingertip over the side of the first scene's cylinder, m."""
    finger, solid = inbox.last("twin/finger"), inbox.messages["scene"][0].object
    across = finger.position_world_m[1:] - solid.world_from_object.position_m[1:]
    return float(np.linalg.norm(across)) - solid.geometry.radius_m


def across_m(finger: TwinFinger) -> float:
    return float(finger.position_world_m[0])


def engaged(inbox: ReceivedMessages) -> str | None:
    estop = inbox.last("estop")
    return estop.reason if isinstance(estop, EStop) and estop.engaged else None


@pytest.fixture(scope="module")
def session() -> Any:
    """Visit the page once for all tests, because a browser starts slowly."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(runs.ROOT_VARIABLE, str(folder / "runs"))
        yield asyncio.run(run_session(folder))
    shutil.rmtree(folder)


async def run_session(folder: Path) -> PageVisit:
    file = folder / "graph.yaml"
    scenes = folder / "scenes"
    scenes.mkdir()
    for name in ("cylinder", "sphere"):
        shutil.copy(ROOT / "launch" / "scenes" / f"{name}.yaml", scenes)
    (scenes / "broken.yaml").write_text("object: {}\n")
    file.write_text(
        "scene: scenes/cylinder.yaml\n"
        "nodes:\n"
        "  twin_finger: {type: twin_finger, nice: 10}\n"
        "  recorder:\n    type: recorder\n"
        f"    parameters: {{bag: {folder}/bags/a.mcap, start_paused: true}}\n"
    )
    (folder / "bags").mkdir()
    port = free_port()
    plan = load_graph(file, console=True, settings=[f"console.page_port={port}"])
    names = ("scene", "twin/finger_path", "twin/finger", "estop", "recording", "bookmark")
    async with async_playwright() as play:
        async with RunningGraph(plan) as graph:
            await graph.wait_ready(DEADLINE_S)
            async with hearing(graph, *names) as inbox:
                session = PageVisit(inbox, folder / "bags" / "a.mcap", {}, {})
                session.notes["foreign"] = await refused(port, Origin="http://evil.example")
                browser = await play.chromium.launch(
                    executable_path=str(CHROMIUM),
                    args=list(DRAWN_WITHOUT_GPU),
                    timeout=1e3 * DEADLINE_S,
                )
                page = await browser.new_page(viewport={"width": 860, "height": 420})
                page.set_default_timeout(1e3 * DEADLINE_S)
                expect.set_options(timeout=1e3 * DEADLINE_S)
                await visit(page, session, port)
            session.restarts = dict(graph.restarts)
            session.notes["log"] = scenes_left_out(graph.run)
        await expect(page.get_by_text("There is no connection to the console")).to_be_visible()
        await browser.close()
    session.exit_codes = graph.exit_codes
    return session


def scenes_left_out(run: Run) -> str:
    return (run.logs / "launch.log").read_text()


def test_nothing_crashed_and_all_ended_well(session: PageVisit) -> None:
    assert set(session.exit_codes.values()) == {0}
    assert not any(session.restarts.values())
    assert "error" not in session.notes["nodes"], session.notes["nodes"]


def test_every_control_has_a_name(session: PageVisit) -> None:
    assert session.notes["unnamed"] == ""


def test_a_page_of_another_site_gets_no_socket(session: PageVisit) -> None:
    assert session.notes["foreign"] == "403"


def test_a_scene_that_is_no_scene_is_left_out_with_the_reason(session: PageVisit) -> None:
    assert "scene broken.yaml is skipped" in session.notes["log"]


def test_the_bag_holds_what_was_done_to_the_page(session: PageVisit) -> None:
    entries = list(BagReader(session.bag))
    by_topic: dict[str, list[Any]] = {}
    for topic, message, header, _ in entries:
        # The launcher keeps an e-stop, and says it again for those who come late.
        if topic != "estop" or header.writer == "console":
            by_topic.setdefault(topic, []).append(message)
    assert [one.label for one in by_topic["bookmark"] if isinstance(one, Bookmark)] == [
        "first touch"
    ]
    stops = [(one.engaged, one.reason) for one in by_topic["estop"]]
    assert stops == [
        (True, "pressed at the console"),
        (False, "reset at the console"),
        (True, "pressed at the console"),
        (True, "Escape at the console"),
    ]
    scenes = by_topic["scene"]
    assert scenes[0].object.material.young_modulus_pa == pytest.approx(4000.0)
    assert scenes[1].object.material.young_modulus_pa == pytest.approx(9000.0)
    assert scenes[-1].name == "sphere"


def test_the_finger_was_led_over_the_object_and_no_faster_than_it_may(session: PageVisit) -> None:
    paths = [
        one for one in session.inbox.messages["twin/finger_path"] if isinstance(one, FingerPath)
    ]
    ways = np.array([path.positions_world_m[0] for path in paths])
    steps = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    assert steps.max() < 0.15 * 0.2 + 0.01
    inbox = session.inbox
    recorded = inbox.messages["twin/finger"][: inbox.fingers_on_first_object]
    fingers = [one for one in recorded if isinstance(one, TwinFinger)]
    solid = session.inbox.messages["scene"][0].object
    places = np.array([finger.position_world_m for finger in fingers if finger.path_label])
    away = np.linalg.norm((places - solid.world_from_object.position_m)[:, 1:], axis=1)
    # Between the points of its path the twin's finger takes the chord.
    assert 0.0115 < solid.geometry.radius_m - away.min() < 0.0135
