"""Measure the cost of a console viewer for the graph, and the viewer's frame rate.

The demo's graph runs with a console in three cases: without a viewer, with a websocket client that
receives all data without rendering, and with Chromium on this machine. Rates and losses of the
nodes come from their status messages. Frame rates are the rates of update windows that reach the
viewer, and of frames that Chromium renders.

python -m benchmarks.console [--seconds 20] [--set node.parameter=value] [--json]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import viser
import websockets
from playwright.async_api import Page, WebSocket, async_playwright

from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.precompute import precompute_graph
from flexsheet.launch.running.runs import local_endpoints
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages.base import Header
from flexsheet.messages.bus import Subscriber
from flexsheet.messages.topics import find_topic
from flexsheet.messages.types import Status
from flexsheet.nodes.node import PortCounts

DEMO = Path(__file__).resolve().parent.parent / "launch" / "demo.yaml"
CHROMIUM = Path("/usr/bin/chromium")
DRAWN_WITHOUT_GPU = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
WINDOW = {"width": 1200, "height": 800}
SETTLE_S = 5.0
TOPICS = ("fingertip", "sheet_target", "arm_left", "arm_right", "soft_body", "frame")
PICTURE_BYTES = 10_000
"""The minimum size of an update window that contains the sheet, in bytes.

Smaller update windows contain only a table.
"""

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 0.75,
    "near": 0.01,
    "far": 100.0,
    "image_height": WINDOW["height"],
    "image_width": WINDOW["width"],
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}

COUNT_DRAWN = """() => {
    window.drawn = 0;
    const count = () => { window.drawn += 1; requestAnimationFrame(count); };
    requestAnimationFrame(count);
}"""


class Statuses:
    """Latest status of each node."""

    def __init__(self) -> None:
        self.newest: dict[str, Status] = {}

    def take(self, status: Status, header: Header) -> None:
        self.newest[status.node] = status

    def lost(self) -> dict[str, int]:
        """Return the number of skipped or lost messages by topic, except those of the console."""
        found = dict.fromkeys(TOPICS, 0)
        for status in self.newest.values():
            for port in status.inputs if status.node not in ("console", "recorder") else ():
                if port.topic in found:
                    found[port.topic] += port.dropped + port.gaps
        return found

    def written(self) -> dict[str, int]:
        return {
            port.topic: port.messages
            for status in self.newest.values()
            for port in status.outputs
            if port.topic in TOPICS
        }


@dataclass
class ViewerCounts:
    """Counters of the updates and bytes that reached a viewer."""

    pictures: int = 0
    size_bytes: int = 0

    def take(self, window: bytes | str) -> None:
        self.pictures += len(window) > PICTURE_BYTES
        self.size_bytes += len(window)


async def watch(statuses: Statuses, seconds: float) -> dict[str, Any]:
    """Return the rates and losses of the nodes, and the processor time of the console in cores."""
    written, lost = statuses.written(), statuses.lost()
    await asyncio.sleep(seconds)
    return {
        "rate_hz": {
            topic: (count - written.get(topic, 0)) / seconds
            for topic, count in statuses.written().items()
        },
        "skipped_per_s": {
            topic: (count - lost[topic]) / seconds for topic, count in statuses.lost().items()
        },
        "console_cpu": statuses.newest["console"].cpu_ratio,
    }


async def look(url: str, got: ViewerCounts) -> None:
    """Receive all data of the page without rendering."""
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    async with websockets.connect(url, subprotocols=[protocol], max_size=None) as socket:
        await socket.send(msgspec.msgpack.encode(CAMERA))
        async for window in socket:
            got.take(window)


@asynccontextmanager
async def browser(url: str, got: ViewerCounts) -> AsyncIterator[Page]:
    """Open the page in headless Chromium."""
    async with async_playwright() as play:
        chromium = await play.chromium.launch(
            executable_path=str(CHROMIUM), args=list(DRAWN_WITHOUT_GPU)
        )
        page = await chromium.new_page(viewport=WINDOW)  # type: ignore[arg-type]  # it is a ViewportSize

        def connected(socket: WebSocket) -> None:
            socket.on("framereceived", got.take)

        page.on("websocket", connected)
        await page.goto(url, timeout=120_000)
        await page.get_by_role("button", name="E-STOP (Esc)").wait_for(timeout=120_000)
        await page.evaluate(COUNT_DRAWN)
        yield page
        await chromium.close()


async def run(seconds: float, settings: list[str]) -> dict[str, Any]:
    plan = load_graph(DEMO, settings=settings, console=True)
    precompute_graph(plan, lambda text: None)
    place = f"127.0.0.1:{plan.nodes['console'].parameters['page_port']}"
    statuses = Statuses()
    result: dict[str, Any] = {"machine": machine_name()}
    async with RunningGraph(plan) as graph:
        await graph.wait_ready(180)
        endpoints = local_endpoints(graph.run, plan.endpoints_to_read("status"))
        subscriber = Subscriber(find_topic("status"), endpoints, statuses.take, PortCounts())
        subscriber.start()
        await asyncio.sleep(SETTLE_S)
        result["load_before"] = os.getloadavg()[0]
        result["alone"] = await watch(statuses, seconds)

        got = ViewerCounts()
        viewer = asyncio.create_task(look(f"ws://{place}", got))
        await asyncio.sleep(SETTLE_S)
        result["websocket"] = await viewed(statuses, seconds, got)
        viewer.cancel()
        with suppress(asyncio.CancelledError):
            await viewer

        if CHROMIUM.exists():  # noqa: ASYNC240  # once, and nothing waits
            got = ViewerCounts()
            async with browser(f"http://{place}/", got) as page:
                await asyncio.sleep(SETTLE_S)
                before = await page.evaluate("() => window.drawn")
                result["browser"] = await viewed(statuses, seconds, got)
                drawn = await page.evaluate("() => window.drawn") - before
                result["browser"]["drawn_per_s"] = drawn / seconds
        subscriber.close()
    return result


async def viewed(statuses: Statuses, seconds: float, got: ViewerCounts) -> dict[str, Any]:
    """Return the result of `watch` and the rate of the data that reaches the viewer."""
    got.pictures = got.size_bytes = 0
    found = await watch(statuses, seconds)
    found["pictures_per_s"] = got.pictures / seconds
    found["mb_per_s"] = 1e-6 * got.size_bytes / seconds
    return found


def show(result: dict[str, Any]) -> None:
    cases = [name for name in ("alone", "websocket", "browser") if name in result]
    print(f"{result['machine']}; load {result['load_before']:.1f}")
    print(f"{'Hz (skipped a second)':>22}" + "".join(f"{name:>18}" for name in cases))
    for topic in TOPICS:
        cells = (
            f"{result[name]['rate_hz'].get(topic, 0.0):.1f} "
            f"({result[name]['skipped_per_s'].get(topic, 0.0):.1f})"
            for name in cases
        )
        print(f"{topic:>22}" + "".join(f"{cell:>18}" for cell in cells))
    for name in cases:
        one = result[name]
        print(f"{name}: console {100 * one['console_cpu']:.0f} % of a core", end="")
        if "pictures_per_s" in one:
            print(f", {one['pictures_per_s']:.1f} pictures/s, {one['mb_per_s']:.1f} MB/s", end="")
        if "drawn_per_s" in one:
            print(f", {one['drawn_per_s']:.1f} frames drawn/s", end="")
        print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    result = asyncio.run(run(given.seconds, given.settings))
    if given.json:
        print(json.dumps(result, indent=1))
    else:
        show(result)


if __name__ == "__main__":
    main()
