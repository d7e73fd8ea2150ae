"""Capture board images for `flexsheet calibrate stereo`, from devices or the simulator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexsheet.launch.commands.output import BAD_INPUT, CommandError, words
from flexsheet.messages.files import write_file
from flexsheet.nodes.camera.image_pair import encode_png

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import RenderableType

    from flexsheet.launch.calibration.capture import Capture
    from flexsheet.messages.calibration import Board
    from flexsheet.messages.scene import Scene
    from flexsheet.nodes.camera.sources import AnySource

    Views = tuple[NDArray[np.uint8], NDArray[np.uint8]]

POSES_PER_PAIR = 3
"""Simulated poses per requested pair, as not all of them add coverage."""


def device_pictures(source: str, scene: Scene) -> Iterator[Views]:
    """Yield grey image pairs from a camera node's `source`, given in YAML."""
    from pydantic import TypeAdapter, ValidationError
    from ruamel.yaml.error import YAMLError

    from flexsheet.launch.plans.documents import parse_value
    from flexsheet.nodes.camera.sources import AnySource

    try:
        described: Any = TypeAdapter(AnySource).validate_python(parse_value(source))
    except (YAMLError, ValidationError) as error:
        said = str(error).splitlines()[0]
        if isinstance(error, ValidationError):
            mistakes = [(".".join(map(str, one["loc"])), one["msg"]) for one in error.errors()]
            said = "; ".join(f"{where}: {what}" for where, what in mistakes)
        raise CommandError(
            f"--device-source {source}: {said}; describe it as a camera node's source, as "
            "'{kind: opencv, left: 0, right: 1}'",
            BAD_INPUT,
        ) from error
    if described.kind == "twin":
        raise CommandError(
            "--device-source twin: the twin has no board in a graph; use --twin SCENE", BAD_INPUT
        )
    return _read(described, source, scene)


def _read(described: AnySource, source: str, scene: Scene) -> Iterator[Views]:
    from flexsheet.nodes.camera.devices import open_reader
    from flexsheet.nodes.camera.image_pair import DeviceError, check_size

    try:
        with closing(open_reader(described, scene.camera, time.monotonic_ns)) as reader:
            for warning in reader.warnings:
                words.print(f"camera: {warning}", markup=False)
            while (pictures := reader.read()) is not None:
                check_size(pictures, scene.camera, source)
                yield pictures.left, pictures.right
    except DeviceError as error:
        raise CommandError(str(error)) from error


def twin_pictures(scene: Scene, board: Board, *, pairs: int, seed: int) -> Iterator[Views]:
    """Yield simulated image pairs of a board, pose by pose."""
    from flexsheet.nodes.twin.board import BoardError, TwinBoard
    from flexsheet.nodes.twin.rig import make_true_camera

    try:
        shown = TwinBoard(make_true_camera(scene.camera), board, seed=seed)
        for left_from_board in shown.poses(POSES_PER_PAIR * pairs):
            yield shown.pair(left_from_board)
    except BoardError as error:
        raise CommandError(str(error), BAD_INPUT) from error


def take_pairs(pictures: Iterator[Views], capture: Capture, folder: Path) -> int:
    """Write the pairs that `capture` accepts as left01.png, right01.png, ... to a new folder.

    Stops at full coverage, at the end of the images, or at Ctrl-C, and prints missing coverage.
    Returns the number of pairs, at least one.
    """

    if folder.exists():
        raise CommandError(f"--pictures {folder}: exists already; name a new folder", BAD_INPUT)
    taken = 0
    try:
        with _shown(capture) as show:
            for left, right in pictures:
                seen = capture.see(left, right)
                if seen.taken:
                    taken += 1
                    folder.mkdir(parents=True, exist_ok=True)
                    for side, picture in (("left", left), ("right", right)):
                        write_file(folder / f"{side}{taken:02}.png", encode_png(picture))
                show(seen.hint, seen.taken)
                if capture.complete:
                    break
    except KeyboardInterrupt:
        words.print("stopped; going on with what was taken")
    missing = capture.missing()
    if missing:
        listed = ", ".join(f"{one.group} {one.name}".strip() for one in missing)
        words.print(f"not covered: {listed}", markup=False)
    if not taken:
        raise CommandError("no pair was taken: the board was never seen at rest in both pictures")
    words.print(f"{taken} pairs in {folder}", markup=False)
    return taken


@contextmanager
def _shown(capture: Capture) -> Iterator[Any]:
    """Yield a function of (hint, taken) that updates the view, or prints lines if piped."""
    if not words.is_terminal:

        def tell(hint: str, taken: bool) -> None:
            if taken:
                missing = len(capture.missing())
                words.print(f"pair taken; {missing} things not covered yet", markup=False)

        yield tell
        return
    from rich.live import Live

    with Live(coverage_view(capture, "waiting for pictures"), console=words.console) as live:
        yield lambda hint, taken: live.update(coverage_view(capture, hint))


def coverage_view(capture: Capture, hint: str) -> RenderableType:
    """Draw how often each image cell, tilt and distance was seen and is needed."""
    from rich.columns import Columns
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from flexsheet.launch.calibration.capture import COLUMNS, DISTANCES, ROWS, TILTS, Bin

    def count(one: Bin) -> Text:
        have, often = capture.counts[one], capture.needed.get(one, 0)
        style = "green" if have >= often else "yellow" if have else "red"
        return Text(f"{have}/{often}" if often else f"{have}", style=style if often else "dim")

    tables = []
    for side in ("left", "right"):
        cells = Table(title=f"{side} picture", show_header=False)
        for row in range(ROWS):
            cells.add_row(*(count(Bin(f"{side} cell", f"{x},{row}")) for x in range(COLUMNS)))
        tables.append(cells)
    for group, names in (("tilt", TILTS), ("distance", DISTANCES), ("pairs", ("",))):
        table = Table(title=group, show_header=False)
        for name in names:
            table.add_row(name, count(Bin(group, name)))
        tables.append(table)
    return Group(Columns(tables), Text(hint, style="bold"))
