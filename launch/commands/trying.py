"""`flexsheet try`: simulate the display on this computer, and operate it in a web browser."""

from __future__ import annotations

import asyncio
import os
import webbrowser
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.launching import describe_run, page_url, run_graph
from flexsheet.launch.commands.output import examples, print_json_line, progress_words, words
from flexsheet.nodes.signals import keyboard_interrupts

if TYPE_CHECKING:
    from flexsheet.launch.running.runs import Run

app = options.make_app()


@app.command(
    epilog=examples(
        "flexsheet try", "flexsheet try --scene organ", "flexsheet try --port 9000 --no-browser"
    )
)
def try_it(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    port: Annotated[
        int, typer.Option(help="TCP port of the console page.", min=1, max=65535)
    ] = 8080,
    browser: Annotated[bool, typer.Option(help="Open the console page in the browser.")] = True,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    duration: options.DurationOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate the display, and touch a virtual object with the mouse in a web browser.

    The command starts the demo graph with a console, prints the address of the console page, and
    runs until Ctrl-C. To open the page on another computer, first run this command there: ssh -L
    8080:127.0.0.1:8080 THIS_COMPUTER
    """
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.launch.running.precompute import precompute_graph

    page = [f"console.page_port={port}"]
    plan = load_graph(
        launch_file,
        settings=[*page, *options.with_scene(settings, scene)],
        console=True,
        apparatus=apparatus,
    )
    with keyboard_interrupts(), progress_words() as progress:
        precompute_graph(plan, progress)
    url = page_url(plan.nodes["console"])

    def ready(run: Run) -> None:
        if as_json:
            print_json_line({"page": url, **describe_run(plan, run, None)})
        words.print(f"[bold]open {url}[/] and drag on the sheet", markup=True)
        if browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(url)

    raise typer.Exit(asyncio.run(run_graph(plan, None, duration, when_ready=ready)))
