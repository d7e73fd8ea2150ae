"""`flexsheet view`: serve the running graph to the viewers Foxglove and Lichtblick."""

from __future__ import annotations

import asyncio
import os
from typing import Annotated

import typer

from flexsheet.launch.commands.graph import run_interruptible, running_graph
from flexsheet.launch.commands.options import DurationOption, JsonOption, RunOption, make_app
from flexsheet.launch.commands.output import CommandError, examples, print_json_line, words
from flexsheet.launch.plans.shipped import LAUNCH_FILES

app = make_app()

LAYOUT = LAUNCH_FILES / "viewing" / "foxglove-layout.json"
"""The layout for Foxglove and Lichtblick."""

NICENESS = 10
"""The niceness of the server, which gives the nodes of the graph a higher priority."""


@app.command(
    epilog=examples("flexsheet view", "flexsheet view --port 9100 --rate 15 --image-rate 5")
)
def view(
    *,
    port: Annotated[
        int, typer.Option(help="TCP port of the server; 0: any free port.", min=0, max=65535)
    ] = 8765,
    rate: Annotated[
        float,
        typer.Option(metavar="HZ", help="Maximum rate of numeric values per channel, Hz.", min=0.1),
    ] = 30.0,
    image_rate: Annotated[
        float, typer.Option(metavar="HZ", help="Maximum rate of images and meshes, Hz.", min=0.1)
    ] = 10.0,
    run: RunOption = None,
    duration: DurationOption = None,
    as_json: JsonOption = False,
) -> None:
    """Serve the running graph to the viewers Foxglove and Lichtblick, until Ctrl-C.

    In the viewer, open a connection of the type "Foxglove WebSocket" with the printed address, and
    import the printed layout file. The server is read-only and accepts only connections from this
    computer. To use a viewer on another computer, first run this command there:
    ssh -L 8765:127.0.0.1:8765 THIS_COMPUTER
    """
    from flexsheet.launch.viewing.live_server import ADDRESS, LiveServer

    plan, found = running_graph(run)
    os.nice(NICENESS)

    async def serve() -> int:
        try:
            server = LiveServer(
                plan,
                found,
                port=port,
                rate_hz=rate,
                image_rate_hz=image_rate,
                on_problem=words.print,
            )
        except (OSError, RuntimeError) as error:
            raise CommandError(
                f"--port {port}: the server cannot listen there: {error}; choose another port"
            ) from error
        try:
            address = f"ws://{ADDRESS}:{server.port}"
            if as_json:
                names = [channel.name for channel in server.channels]
                print_json_line({"address": address, "layout": str(LAYOUT), "channels": names})
            words.print(f"connect Foxglove or Lichtblick to {address}")
            words.print(f"layout: {LAYOUT}")
            async with asyncio.timeout(duration):
                await server.serve()
        except TimeoutError:
            return 0
        finally:
            server.close()
        return 0

    raise typer.Exit(run_interruptible(serve()))
