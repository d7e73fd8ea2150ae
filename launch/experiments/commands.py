"""`flexsheet experiment`, `flexsheet chart` and `flexsheet demo`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress as ProgressBar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from launch.experiments import demo as demo_module
from launch.experiments import image, stroke
from launch.experiments.run import (
    DEMO_FILE,
    Progress,
    new_folder,
    push_procedure,
    run_experiment,
    stroke_procedure,
    tilt_procedure,
)
from launch.plan import load_plan, load_scene

app = typer.Typer(no_args_is_help=True, help="The paper's experiments, through the running graph.")

LaunchFile = Annotated[
    Path, typer.Option("--launch", help="Launch file of the graph to experiment on.")
]
Output = Annotated[
    Path | None, typer.Option("--output", help="Folder for bag and results; default: runs/...")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="node.parameter=value; may be repeated.")
]

words = Console(stderr=True)
data = Console()


@contextmanager
def progress_shown() -> Iterator[Progress]:
    """Shows on stderr what is being done and since when."""
    with ProgressBar(
        SpinnerColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=words,
    ) as bar:
        task = bar.add_task("", total=None)

        def progress(text: str) -> None:
            bar.update(task, description=text)
            if not words.is_terminal:
                words.print(text)

        yield progress


def print_result(result: dict[str, Any], *, as_json: bool, table: Callable[[], Table]) -> None:
    if as_json:
        typer.echo(json.dumps(result, indent=1))
    else:
        data.print(table())
        words.print(f"bag: {result['bag']}")


def made_folder(output: Path | None, name: str) -> Path:
    if output is None:
        return new_folder(name)
    output.mkdir(parents=True, exist_ok=True)
    return output


@app.command("stroke")
def stroke_command(
    seconds: Annotated[float, typer.Option(min=1.0, max=600.0, help="Moving time.")] = 10.0,
    launch_file: LaunchFile = DEMO_FILE,
    settings: Settings = None,
    output: Output = None,
    as_json: AsJson = False,
) -> None:
    """Stroke the cylinder by 60 degrees (section V, Table I)."""
    load_plan(launch_file, settings=settings or ())
    bag = made_folder(output, "stroke") / "stroke.mcap"
    with progress_shown() as progress:
        procedure = stroke_procedure([seconds], progress)
        run_experiment(launch_file, settings or (), bag, procedure, progress)
        progress("reading the bag")
        result = stroke.stroke_result(stroke.read_recording(bag), seconds, bag)
    print_result(result, as_json=as_json, table=lambda: demo_module.table_1([result]))


@app.command("tilt")
def tilt_command(
    launch_file: LaunchFile = DEMO_FILE,
    settings: Settings = None,
    output: Output = None,
    as_json: AsJson = False,
) -> None:
    """Errors of the picture on an inclined sheet (section VI-B, Fig. 11)."""
    load_plan(launch_file, settings=settings or ())
    bag = made_folder(output, "tilt") / "tilt.mcap"
    with progress_shown() as progress:
        procedure = tilt_procedure(image.TILTS_DEG, image.CORRECTIONS, progress)
        run_experiment(launch_file, settings or (), bag, procedure, progress)
        progress("measuring the pictures")
        rows = image.tilt_rows(image.read_pictures(bag), image.TILTS_DEG)
    result = {"rows": rows, "bag": str(bag)}
    print_result(result, as_json=as_json, table=lambda: rows_table("Fig. 11: inclined sheet", rows))


@app.command("push")
def push_command(
    launch_file: LaunchFile = DEMO_FILE,
    settings: Settings = None,
    output: Output = None,
    as_json: AsJson = False,
) -> None:
    """Errors of the picture on a pushed sheet (section VI-C, Fig. 13)."""
    load_plan(launch_file, settings=settings or ())
    bag = made_folder(output, "push") / "push.mcap"
    with progress_shown() as progress:
        procedure = push_procedure(image.DEPTHS_MM, image.CORRECTIONS, progress)
        run_experiment(launch_file, settings or (), bag, procedure, progress)
        progress("measuring the pictures")
        rows = image.push_rows(image.read_pictures(bag), image.DEPTHS_MM)
    result = {"rows": rows, "bag": str(bag)}
    print_result(result, as_json=as_json, table=lambda: rows_table("Fig. 13: pushed sheet", rows))


def rows_table(title: str, rows: list[dict[str, Any]]) -> Table:
    """A table of an image experiment's rows, numbers with two digits."""
    table = Table(title=title)
    for key in rows[0]:
        table.add_column(key, justify="right")
    for row in rows:
        table.add_row(
            *(f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in row.values())
        )
    return table


def demo(
    launch_file: LaunchFile = DEMO_FILE,
    finger_path: Annotated[
        Path | None,
        typer.Option(help="CSV of a recorded finger (t_s, x_mm, y_mm, z_mm) instead of strokes."),
    ] = None,
    output: Output = None,
) -> None:
    """Run the whole system on this machine: stroke, tilt and push the sheet; then pictures."""
    plan = load_plan(launch_file)
    scene = plan.scene_message()
    path = None
    if finger_path is not None and scene is not None:
        from nodes.twin.finger import recorded_path

        path = recorded_path(finger_path, scene)
    folder = made_folder(output, "demo")
    with progress_shown() as progress:
        result = demo_module.run_demo(launch_file, folder, progress, path=path)
    if result.strokes:
        data.print(demo_module.table_1(result.strokes))
    words.print(f"bag: {result.bag}")
    for picture in result.pictures:
        words.print(f"picture: {picture}")


def chart(
    family: Annotated[
        str | None, typer.Argument(help="A method family; all when left out.")
    ] = None,
    scene_file: Annotated[
        Path, typer.Option("--scene", help="Scene file to measure on.")
    ] = DEMO_FILE.parent / "scenes" / "cylinder.yaml",
    output: Annotated[Path | None, typer.Option(help="Folder for pictures and numbers.")] = None,
    as_json: AsJson = False,
) -> None:
    """Chart speed against accuracy of every method of a family, on this machine and this scene."""
    from launch import charts

    scene = load_scene(scene_file)
    names = [family] if family is not None else list(charts.FAMILIES)
    families = [charts.family_named(name) for name in names]
    folder = made_folder(output, "charts")
    results = []
    for each in families:
        with progress_shown() as progress:
            points = charts.measure_family(each, scene, progress=progress)
        result = charts.finite(charts.chart_result(each, scene, points))
        picture, _ = charts.write_chart(result, folder)
        words.print(f"chart: {picture}")
        results.append(result)
        if not as_json:
            data.print(points_table(result))
    if as_json:
        typer.echo(json.dumps(results[0] if family is not None else results, indent=1))


def points_table(result: dict[str, Any]) -> Table:
    """The points of a chart as a table; methods on the front are marked."""
    table = Table(title=f"{result['family']}: error in {result['unit']}, {result['reference']}")
    for name in ("method", "case", "median, µs", "p99, µs", "error", "in range", "front"):
        table.add_column(name)
    for point in result["points"]:
        table.add_row(
            point["method"],
            ", ".join(f"{key} {value}" for key, value in point["params"].items()),
            f"{point['median_s'] * 1e6:.1f}",
            f"{point['p99_s'] * 1e6:.1f}",
            "-" if point["error"] is None else f"{point['error']:.4g}",
            "yes" if point["in_range"] else "no",
            "*" if point["method"] in result["front"] else "",
        )
    return table
