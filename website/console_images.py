"""Make the images of the console in docs/images: `python -m website.console_images`.

A graph with the simulator records a finger that strokes the object and pushes it.  The animation is
drawn from that bag, frame by frame, so it does not depend on the speed of the computer.  The image
of the page shows the console of a running graph.  Chromium is needed.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image
from playwright.async_api import Page, async_playwright, expect

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import run_experiment
from flexsheet.launch.experiments.stroke import object_pose
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.precompute import precompute_graph
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene, require_cylinder
from flexsheet.messages.types import FingerPath, Skin
from flexsheet.messages.wire import encode
from flexsheet.nodes.console.latest_messages import LatestMessages
from flexsheet.nodes.console.scene_view import SceneView
from flexsheet.nodes.models.rigid import apply

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "launch" / "demo.yaml"
IMAGES = ROOT / "docs" / "images"
CHROMIUM = Path("/usr/bin/chromium")
WITHOUT_GPU = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
DEADLINE_MS = 180_000.0

TOPICS = ("scene", "skin", "soft_body", "fingertip", "arm_left", "arm_right")
KNOTS = (
    # time (s), along the axis (m), angle from the front (rad), depth (m)
    (0.0, -0.02, 0.0, 0.012),
    (0.8, -0.02, 0.0, 0.012),
    (2.2, 0.0, 0.55, 0.004),
    (4.2, 0.0, -0.55, 0.004),
    (5.4, 0.02, 0.0, 0.004),
    (6.3, 0.02, 0.0, 0.016),
    (6.9, 0.02, 0.0, 0.016),
    (8.0, -0.02, 0.0, 0.012),
)
"""The points of the finger's path on the cylinder. The last point equals the first point."""

PATH_S = KNOTS[-1][0]
FRAMES_PER_S = 12
WARM_UP_FRAMES = 10
SIZE_PX = (760, 480)
POSITION_M, TARGET_M, FOV_RAD = (0.36, 0.2, 0.86), (0.02, -0.09, 0.0), 0.75
WEBP_QUALITY = 72
PAGE_PX = (1200, 760)


def finger_path(scene: Scene, number: int) -> FingerPath:
    """Make the path of the finger on the cylinder.

    number: number of the repetition.
    """
    radius_m = require_cylinder(scene).radius_m
    knots = np.array(KNOTS)
    distance_m = radius_m - knots[:, 3]
    points = np.column_stack(
        [knots[:, 1], distance_m * np.sin(knots[:, 2]), distance_m * np.cos(knots[:, 2])]
    )
    return FingerPath(
        label=f"stroke and push {number}",
        times_s=knots[:, 0],
        positions_world_m=apply(object_pose(scene), points),
        wander_m=0.0,
        tremor_m=0.0,
        joined_by="spline",
    )


def record(bag: Path) -> None:
    """Record two passes of the finger. The second pass has no approach."""

    async def procedure(driver: Driver, scene: Scene) -> None:
        for number in range(2):
            await driver.follow(finger_path(scene, number))

    run_experiment(DEMO, (), bag, procedure, print)


@asynccontextmanager
async def open_page(url: str, size_px: tuple[int, int]) -> AsyncIterator[Page]:
    async with async_playwright() as play:
        chromium = await play.chromium.launch(
            executable_path=str(CHROMIUM), args=list(WITHOUT_GPU), timeout=DEADLINE_MS
        )
        page = await chromium.new_page(viewport={"width": size_px[0], "height": size_px[1]})
        page.set_default_timeout(DEADLINE_MS)
        await page.goto(url)
        yield page
        await chromium.close()


async def animate(bag: Path, output: Path) -> None:
    """Draw the last pass of the finger in a bag as an animated WebP."""
    *_, start_ns = (time_ns for *_, time_ns in BagReader(bag, topics=["twin/finger_path"]))
    entries = iter(BagReader(bag, topics=TOPICS))
    messages = LatestMessages(lambda topic, error: print(topic.name, error))

    def read_until(end_ns: float) -> None:
        for topic, message, header, time_ns in entries:
            messages.put(topic, encode(message, header))
            if time_ns >= end_ns:
                break

    read_until(start_ns)
    scene, skin = messages.latest("scene", Scene), messages.latest("skin", Skin)
    assert scene is not None
    assert skin is not None
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    joined: asyncio.Future[viser.ClientHandle] = asyncio.get_running_loop().create_future()
    loop = asyncio.get_running_loop()

    @server.on_client_connect
    def _join(client: viser.ClientHandle) -> None:
        loop.call_soon_threadsafe(joined.set_result, client)

    view = SceneView(server, lambda *_: None)
    view.set_scene(scene[0])
    view.set_skin(skin[0])
    url = f"http://127.0.0.1:{server.get_port()}/"
    frames = []
    async with open_page(url, SIZE_PX):
        client = await joined
        client.camera.position, client.camera.look_at = POSITION_M, TARGET_M
        client.camera.up_direction, client.camera.fov = (0.0, 1.0, 0.0), FOV_RAD
        times_s = np.arange(0.0, PATH_S, 1.0 / FRAMES_PER_S)
        # The page loads meshes and fonts while it draws the first frames.
        for seconds in (*np.zeros(WARM_UP_FRAMES), *times_s):
            read_until(start_ns + 1e9 * seconds)
            view.draw(scene[0], messages)
            drawn = await asyncio.to_thread(
                client.get_render, SIZE_PX[1], SIZE_PX[0], transport_format="png"
            )
            frames.append(on_white(drawn))
        del frames[:WARM_UP_FRAMES]
    server.stop()
    frames[0].save(
        output,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / FRAMES_PER_S),
        loop=0,
        quality=WEBP_QUALITY,
        method=6,
    )


def on_white(drawn: NDArray[np.uint8]) -> Image.Image:
    """Return an image (h, w, 4) with its transparent parts in white."""
    image = Image.fromarray(drawn)
    white = Image.new("RGBA", image.size, "white")
    return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")


async def photograph() -> None:
    """Save an image of the page of a running graph."""
    # The page needs most of the processor time of a computer without a graphics card.
    plan = load_graph(DEMO, settings=["fem_solver.method=linear"], console=True)
    precompute_graph(plan, print)
    url = f"http://127.0.0.1:{plan.nodes['console'].parameters['page_port']}/"
    expect.set_options(timeout=DEADLINE_MS)
    async with RunningGraph(plan, without=("renderer",)) as graph:
        await graph.wait_ready(DEADLINE_MS / 1e3)
        async with open_page(url, PAGE_PX) as page:
            await dismiss_notice(page)
            push = page.get_by_role("textbox", name="Push, mm")
            await push.fill("12")
            await push.press("Enter")
            await expect(page.get_by_role("status")).to_contain_text("following")
            await expect(page.get_by_text("pushes 1")).to_be_visible()
            await page.screenshot(path=IMAGES / "console.png")


async def dismiss_notice(page: Page) -> None:
    """Close the notice of the 3D view that there is no graphics card."""
    notice = page.get_by_role("alert").filter(has_text="Software WebGL")
    await notice.get_by_role("button").evaluate("button => button.click()")
    await expect(notice).to_have_count(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--bag",
        type=Path,
        help="bag of the finger's path, which is recorded if the file does not exist",
    )
    parser.add_argument("--animation", action="store_true", help="make the animation only")
    parser.add_argument("--page", action="store_true", help="make the image of the page only")
    given = parser.parse_args()
    if not given.page:
        with tempfile.TemporaryDirectory(prefix="flexsheet-") as folder:
            bag = given.bag or Path(folder) / "touch.mcap"
            if not bag.exists():
                record(bag)
            asyncio.run(animate(bag, IMAGES / "console.webp"))
    if not given.animation:
        asyncio.run(photograph())


if __name__ == "__main__":
    main()
