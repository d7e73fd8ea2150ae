"""`flexsheet files`: list the data files of the package, such as launch files and scenes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import JsonOption, make_app
from flexsheet.launch.commands.output import examples, print_rows
from flexsheet.launch.plans.shipped import LAUNCH_FILES

app = make_app()


class FileKind(StrEnum):
    """The kinds of data files in the package."""

    LAUNCH = "launch"
    SCENE = "scene"
    CALIBRATION = "calibration"
    LAYOUT = "layout"
    SYSTEMD = "systemd"
    DOCKER = "docker"


PATTERNS = {
    FileKind.LAUNCH: "*.yaml",
    FileKind.SCENE: "scenes/*",
    FileKind.CALIBRATION: "calibrations/*",
    FileKind.LAYOUT: "viewing/*.json",
    FileKind.SYSTEMD: "systemd/*",
    FileKind.DOCKER: "../docker/[!.]*",
}
"""The file pattern (glob) of each kind of file, relative to the folder of the launch files."""


@app.command(epilog=examples("flexsheet files", "flexsheet files docker --json"))
def files(
    kind: Annotated[FileKind | None, typer.Argument(help="Kind of files; default: all.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List launch files, scenes, calibrations, layouts, systemd units and Compose files.

    KIND is launch, scene, calibration, layout, systemd or docker. To change a file, copy it first.
    """
    kinds = list(FileKind) if kind is None else [kind]
    rows = [{"kind": str(one), "path": str(path)} for one in kinds for path in list_files(one)]
    print_rows(rows, as_json=as_json)


def list_files(kind: FileKind) -> list[Path]:
    """Return the sorted paths of the package's data files of one kind."""
    found = LAUNCH_FILES.glob(PATTERNS[kind])
    return sorted(path.resolve() for path in found if path.is_file())
