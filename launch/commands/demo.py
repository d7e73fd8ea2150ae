"""`flexsheet demo`: run a short measurement of the whole simulated system on this computer."""

from __future__ import annotations

from typing import Annotated

import typer

from flexsheet.launch.commands import complete, options
from flexsheet.launch.commands.experiment import (
    make_result_folder,
    print_followed,
    print_strokes,
)
from flexsheet.launch.commands.output import examples, print_json, progress_words, words

app = options.make_app()


@app.command(
    epilog=examples("flexsheet demo", "flexsheet demo --finger-path tap --output runs/tap --json")
)
def demo(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    finger_path: Annotated[
        str | None,
        typer.Option(
            metavar="NAME_OR_FILE",
            help="Finger path to follow instead of the strokes: name of a gesture, or CSV file "
            "(columns t_s,x_mm,y_mm,z_mm).",
            autocompletion=complete.gestures,
        ),
    ] = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate strokes, a tilted sheet and a pushed sheet, and draw charts of the errors."""
    from flexsheet.launch.experiments.demo import run_demo
    from flexsheet.launch.experiments.gestures import finger_path as load_path

    given = options.with_scene(settings, scene)
    path = None if finger_path is None else load_path(launch_file, finger_path, given)
    folder = make_result_folder(output, "demo")
    with progress_words() as progress:
        result = run_demo(launch_file, given, folder, progress, path=path, apparatus=apparatus)
    if as_json:
        print_json(
            {
                "strokes": result.strokes,
                "followed": result.followed,
                "bag": str(result.bag),
                "figures": [str(image) for image in result.images],
            }
        )
        return
    if result.strokes:
        print_strokes(result.strokes)
    if result.followed is not None:
        print_followed([result.followed])
    words.print(f"bag: {result.bag}")
    for image in result.images:
        words.print(f"image: {image}")
