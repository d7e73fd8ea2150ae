"""Test the page in Chromium without a graph: markup in names, stable layout, frames."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any, get_args

import numpy as np
import pytest
from playwright.async_api import Page as BrowserTab
from playwright.async_api import async_playwright, expect

from flexsheet.messages.notes import Note
from flexsheet.messages.types import FingertipReason
from flexsheet.nodes.console import panels
from flexsheet.nodes.console.access_control import start_server
from flexsheet.nodes.console.banner import GraphState
from flexsheet.nodes.console.controller import Sliders
from flexsheet.nodes.console.graph_facts import GraphFacts
from flexsheet.nodes.console.page import Page
from tests.arm_states import arm_state
from tests.browser import BROWSER_MARKS, CHROMIUM, DRAWN_WITHOUT_GPU, TWO_FRAMES
from tests.console_parts import status_of
from tests.fingertips import fingertip
from tests.scenes import load_cylinder
from tests.waiting import DEADLINE_S

pytestmark = BROWSER_MARKS

MARKUP = '<img src=x onerror="window.ran=1"> **bold** [x](javascript:ran=1)'
TABS = ("Touch", "Graph", "Eye", "Record")


@dataclass
class PageVisit:
    """The results of one visit to the page."""

    title: str = ""
    ran: list[Any] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    options: list[str] = field(default_factory=list)
    slider_boxes: dict[str, Any] = field(default_factory=dict)
    stop_boxes: dict[str, Any] = field(default_factory=dict)
    framed: dict[str, str | None] = field(default_factory=dict)


@asynccontextmanager
async def browser_tab() -> AsyncIterator[BrowserTab]:
    async with async_playwright() as play:
        browser = await play.chromium.launch(
            executable_path=str(CHROMIUM), args=list(DRAWN_WITHOUT_GPU), timeout=1e3 * DEADLINE_S
        )
        tab = await browser.new_page(viewport={"width": 1000, "height": 700})
        tab.set_default_timeout(1e3 * DEADLINE_S)
        expect.set_options(timeout=1e3 * DEADLINE_S)
        yield tab
        await browser.close()


async def show_names_with_markup(page: Page, tab: BrowserTab, found: PageVisit) -> None:
    """Put HTML markup into every name and text that the page shows."""
    scene = load_cylinder().model_copy(update={"name": MARKUP})
    faulty = {"left": arm_state("left", mode="fault", faults=(MARKUP,), reason=MARKUP)}
    page.touch.show_scene(MARKUP, scene, (MARKUP, "other"), Sliders.from_scene(scene))
    page.show_problem(MARKUP)
    page.record.show_state(panels.recorder(MARKUP, (MARKUP,)), recording=True)
    broken = status_of(MARKUP, notes=(Note(detail=MARKUP),), errors=1, last_error=MARKUP)
    page.nodes.content = panels.make_nodes_table({MARKUP: (broken, 0.0)})
    # Shown last: what it says is there only once all else is.
    page.show_state(GraphState(MARKUP, faulty, overload=MARKUP, solver_note=MARKUP))
    await expect(tab.get_by_role("status")).to_contain_text(MARKUP)
    found.texts["banner"] = await tab.locator(".fs-state").inner_text()
    found.texts["problem"] = await tab.locator(".fs-problem").inner_text()
    for name in TABS:
        await tab.get_by_role("tab", name=name).click()
        await tab.evaluate(TWO_FRAMES)
        found.texts[name] = await tab.locator("#root").inner_text()
        found.ran.append(await tab.evaluate("() => window.ran"))
        if name == "Touch":
            await tab.get_by_role("combobox", name="Scene").click()
            found.options.append(await tab.get_by_role("option").first.inner_text())
            await tab.keyboard.press("Tab")
    found.ran.append(await tab.evaluate("() => window.ran"))
    page.show_problem("")
    await expect(tab.locator(".fs-problem")).to_have_count(0)


async def measure_layout(page: Page, tab: BrowserTab, found: PageVisit) -> None:
    """Record the positions of a slider and the e-stop while texts change."""
    await tab.get_by_role("tab", name="Touch").click()
    slider = tab.get_by_role("textbox", name="Stiffness, kPa")
    stop = tab.get_by_role("button", name="E-STOP")
    here = fingertip(np.array([-0.112, 0.103, -0.041]))
    tips = {"none": None, "ok": here} | {
        reason: here.model_copy(update={"valid": False, "reason": reason})
        for reason in get_args(FingertipReason)
        if reason != "ok"
    }
    for name, tip in tips.items():
        page.touch.show_finger(panels.finger(tip))
        expected = "tracked" if tip is not None else "No fingertip"
        await expect(tab.locator(".fs-finger")).to_contain_text(expected)
        await tab.evaluate(TWO_FRAMES)
        found.slider_boxes[name] = await slider.bounding_box()
    follow = {side: arm_state(side, edge_force_n=5.0) for side in ("left", "right")}
    reason = "flanges 149 mm apart, at least 150 mm; " * 4
    blocked = {"left": arm_state("left", mode="hold", path_blocked=True, reason=reason)}
    states = {
        "waiting": GraphState("cylinder"),
        "ready": GraphState("cylinder", follow),
        "fault": GraphState("cylinder", blocked),
        "estop": GraphState("cylinder", follow, estop_reason="pressed at the console " * 4),
    }
    for name, state in states.items():
        page.show_state(state)
        await expect(tab.locator(f"[data-state={name}]")).to_be_visible()
        await tab.evaluate(TWO_FRAMES)
        found.stop_boxes[name] = await stop.bounding_box()


class FramingPage(BaseHTTPRequestHandler):
    """A page of another site that shows the console in a frame."""

    def __init__(self, inner: str, *arguments: Any) -> None:
        self._inner = inner
        super().__init__(*arguments)

    def do_GET(self) -> None:
        tag = self.path.strip("/")
        source = "data" if tag == "object" else "src"
        body = f'<!doctype html><{tag} {source}="{self._inner}" width=400 height=300></{tag}>'
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, *_: Any) -> None:
        """Suppress the log of the server."""


async def open_in_frames(url: str, tab: BrowserTab, found: PageVisit) -> None:
    """Open the console in frames of another site's page, and record the responses."""
    site = ThreadingHTTPServer(("127.0.0.1", 0), partial(FramingPage, url))
    Thread(target=site.serve_forever, daemon=True).start()
    try:
        for tag in ("iframe", "object", "embed"):
            async with tab.expect_response(url) as answer:
                await tab.goto(f"http://localhost:{site.server_port}/{tag}")
            found.framed[tag] = (await answer.value).headers.get("x-frame-options")
    finally:
        await asyncio.to_thread(site.shutdown)
        site.server_close()


async def visit() -> PageVisit:
    found = PageVisit()
    server = start_server(0, "flexsheet")
    facts = GraphFacts(others_may_reset=(MARKUP,), simulates_finger=True)
    page = Page(server, lambda *_: None, facts)
    url = f"http://127.0.0.1:{server.get_port()}/"
    try:
        async with browser_tab() as tab:
            await tab.goto(url)
            await expect(tab.get_by_role("button", name="E-STOP")).to_be_visible()
            found.title = await tab.title()
            await show_names_with_markup(page, tab, found)
            await measure_layout(page, tab, found)
            await open_in_frames(url, tab, found)
    finally:
        await asyncio.to_thread(server.stop)
    return found


@pytest.fixture(scope="module")
def found() -> PageVisit:
    return asyncio.run(visit())


def test_the_browser_shows_the_title_of_the_console(found: PageVisit) -> None:
    assert found.title == "flexsheet console"


def test_markup_in_names_is_shown_as_text_and_not_run(found: PageVisit) -> None:
    assert found.ran == [None] * (len(TABS) + 1)
    assert found.options == [MARKUP]
    assert found.texts["banner"].count(MARKUP) >= 4
    assert MARKUP in found.texts["problem"]
    assert found.texts["Graph"].count(MARKUP) >= 3
    assert found.texts["Record"].count(MARKUP) >= 2
    assert f"Reset the fault: on {MARKUP}" in found.texts["Touch"]


def test_nothing_moves_while_texts_change(found: PageVisit) -> None:
    """Earlier, a shorter text about the finger moved the sliders while a user dragged one."""
    assert len(found.slider_boxes) > 3
    assert len({str(box) for box in found.slider_boxes.values()}) == 1, found.slider_boxes
    assert len(found.stop_boxes) == 4
    assert len({str(box) for box in found.stop_boxes.values()}) == 1, found.stop_boxes


def test_the_console_is_not_shown_in_a_frame(found: PageVisit) -> None:
    assert found.framed == {"iframe": "DENY", "object": "DENY", "embed": "DENY"}
