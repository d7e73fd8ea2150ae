"""`flexsheet demo`: run a short measurement of the whole simulated system on this computer."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from flexsheet.launch.commands import options
from flexsheet.launch.commands.experiment import make_result_folder, print_strokes
from flexsheet.launch.commands.output import (
    examples,
    print_columns,
    print_json,
    progress_words,
    words,
)
from flexsheet.messages.errors import FlexsheetError

if TYPE_CHECKING:
    from flexsheet.launch.experiments.demo import DemoResult

app = options.make_app()


@app.command(epilog=examples("flexsheet demo", "flexsheet demo --output runs/demo --json"))
def demo(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate finger strokes, a tilted sheet and a pushed sheet, and draw charts of the errors.

    The result of each experiment is printed and saved when the experiment is finished.
    """
    from flexsheet.launch.experiments.demo import DemoResult, run_demo

    given = options.with_scene(settings, scene)
    folder = make_result_folder(output, "demo")
    bag, results = folder / "demo.mcap", DemoResult()

    def report(new: DemoResult) -> None:
        results.strokes += new.strokes
        results.images += new.images
        figures = [one for one in new.figures if one not in results.figures]
        results.figures += figures
        if not as_json:
            _print_result(replace(new, figures=figures))

    try:
        with progress_words() as progress:
            run_demo(launch_file, given, bag, progress, report, apparatus=apparatus)
    except FlexsheetError:
        if as_json and bag.exists():
            _print_results(results, bag)
        raise
    if as_json:
        _print_results(results, bag)
        return
    words.print(f"files to look at, in {folder}:")
    # The image at the eye shows the purpose of the system, so it comes first.
    for figure in reversed(results.figures):
        words.print(f"  {figure.path.name}: {figure.shows}")
    words.print(f"  {bag.name}: recording of all topics")
    words.print(f"all figures and faults of the recording: flexsheet bag report {bag}")


def _print_result(result: DemoResult) -> None:
    if result.strokes:
        print_strokes(result.strokes)
    if result.images:
        print_columns(
            result.images,
            {
                "sheet": ("sheet", ""),
                "image correction": ("correction", ""),
                "mean error of sizes, mm": ("mean_mm", ".2f"),
                "largest, mm": ("max_mm", ".2f"),
            },
        )
    sys.stdout.flush()
    for figure in result.figures:
        words.print(f"image: {figure.path}")


def _print_results(result: DemoResult, bag: Path) -> None:
    print_json(
        {
            "strokes": result.strokes,
            "images": result.images,
            "bag": str(bag),
            "figures": [str(figure.path) for figure in result.figures],
        }
    )
