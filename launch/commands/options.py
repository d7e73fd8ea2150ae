"""Declare the command-line arguments and options that several commands share.

In the help, a placeholder such as FILE represents the value of an option.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import typer

from flexsheet.launch.commands.output import CommandError
from flexsheet.launch.plans.shipped import LAUNCH_FILES, SCENES, find_file

DEMO, CYLINDER = Path("demo"), Path("cylinder")
"""The names of the default launch file and of the default scene of the commands."""


def make_app(text: str | None = None) -> typer.Typer:
    """Create the typer app of a single command, or of a command group with a help text.

    text: help of the group. It is None for a single command.
    """
    return typer.Typer(add_completion=False, no_args_is_help=text is not None, help=text)


def find_launch_file(given: Path | None) -> Path | None:
    """Return the path of a launch file, or None if `given` is None.

    given: path, or name of a launch file in the package.
    """
    return None if given is None else find_file(given, LAUNCH_FILES)


def find_scene(given: Path | None) -> Path | None:
    """Return the path of a scene file, or None if `given` is None.

    given: path, or name of a scene in the package.
    """
    return None if given is None else find_file(given, SCENES)


LAUNCH_FILE: dict[str, Any] = {
    "metavar": "LAUNCH_FILE",
    "callback": find_launch_file,
}
SCENE: dict[str, Any] = {
    "metavar": "SCENE",
    "callback": find_scene,
}
"""The settings that all arguments and options for a scene have in common.

LAUNCH_FILE contains the corresponding settings for a launch file.
"""

_LAUNCH_HELP = "Path of a launch file, or name of one in the package, such as demo."
_SCENE_HELP = "Path of a scene file, or name of one in the package, such as cylinder."
LaunchArgument = Annotated[Path, typer.Argument(help=_LAUNCH_HELP, **LAUNCH_FILE)]
LaunchOption = Annotated[Path, typer.Option("--launch", help=_LAUNCH_HELP, **LAUNCH_FILE)]
SceneArgument = Annotated[Path, typer.Argument(help=_SCENE_HELP, **SCENE)]
SceneOption = Annotated[Path, typer.Option("--scene", help=_SCENE_HELP, **SCENE)]
OtherSceneOption = Annotated[
    Path | None,
    typer.Option(
        "--scene", help="Scene to use instead of the scene that the launch file names.", **SCENE
    ),
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NODE.PARAM=VALUE",
        help="Value that replaces a parameter of a node; repeat the option for several parameters.",
    ),
]
ApparatusOption = Annotated[
    str | None,
    typer.Option(
        "--apparatus",
        metavar="FILE|seed:N",
        help="File with the true parameters of the simulated hardware, or a random sample such as "
        "seed:7. seed:7,paper simulates older equipment. seed:7,calibrated contains only the "
        "errors that remain after calibrations. Default: the parameters of the scene.",
    ),
]
TwinApparatusOption = Annotated[
    str | None,
    typer.Option(
        "--apparatus",
        metavar="FILE|seed:N",
        help="With --twin: file with the true parameters of the simulated hardware, or a random "
        "sample such as seed:7. By default, the hardware has the parameters of the scene, but "
        "`calibrate arms` and `calibrate projector` add random deviations (see --seed).",
    ),
]


def _run_option(default: str) -> Any:
    """Return the option --run, which selects a running graph by its run directory.

    default: text for the help that states which graph is used if the option is not given.
    """
    return typer.Option(
        "--run",
        metavar="FOLDER",
        help=f"Run directory of the graph; {default}.",
    )


RunOption = Annotated[Path | None, _run_option("default: the newest running graph")]
ChangedRunOption = Annotated[Path | None, _run_option("required if several graphs are running")]
StoppedRunOption = Annotated[Path | None, _run_option("default: all graphs of this user")]
"""The option --run of a command that stops the arms of all graphs.

RunOption is that of a command that reads a graph, ChangedRunOption that of one that changes it.
"""
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
DurationOption = Annotated[
    float | None,
    typer.Option(
        "--duration",
        metavar="SECONDS",
        min=0.0,
        help="Time after which the command stops, s; default: until Ctrl-C.",
    ),
]
TopicArgument = Annotated[
    str,
    typer.Argument(help="Name of the topic, such as twin/finger."),
]
TopicsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="TOPIC",
        help="Topic to include; repeat the option for several topics; default: all topics.",
    ),
]
BagArgument = Annotated[Path, typer.Argument(help="Bag file.")]
ResultFolderOption = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        metavar="FOLDER",
        help="Folder for the recording and the results; default: a new folder in runs/.",
    ),
]
WorkersOption = Annotated[
    int,
    typer.Option(
        "--workers",
        min=1,
        max=64,
        help="Number of trials that run at the same time on this computer.",
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a dask.distributed scheduler whose workers compute the table, such as "
        "tcp://host:8786; default: compute on this computer.",
    ),
]
ProfileOption = Annotated[
    Literal["modern", "paper"],
    typer.Option(
        "--profile",
        help="Simulated equipment: modern has a camera of 60 Hz, paper has one of 30 Hz.",
    ),
]
CalibratedOption = Annotated[
    bool,
    typer.Option(
        "--calibrated", help="Sample only the errors that remain after the devices' calibration."
    ),
]
SeedOption = Annotated[
    int,
    typer.Option(
        "--seed",
        help="Random seed of the simulated measurements, such as poses and noise. The errors of "
        "the simulated hardware have another seed, which --apparatus seed:N sets.",
    ),
]


def output_file(text: str, metavar: str = "FILE", **settings: Any) -> Any:
    """Return the declaration of the option -o/--output.

    text: help of the option.
    metavar: placeholder of the value in the help.
    """
    return typer.Option("-o", "--output", metavar=metavar, help=text, **settings)


def result_file(text: str, metavar: str = "FILE") -> Any:
    """Return the declaration of the option -o/--output for a file in an existing folder."""
    return output_file(text, metavar, callback=check_folder)


def check_folder(file: Path | None) -> Path | None:
    """Check that the parent folder of an output file exists, and return the file's path.

    Raises CommandError if the folder does not exist.
    """
    if file is not None and not file.resolve().parent.is_dir():
        raise CommandError(f"{file}: the folder {file.parent} does not exist; create it")
    return file


def with_scene(settings: list[str] | None, scene: Path | None) -> list[str]:
    """Return the values of the option --set.

    If the option --scene is given, the setting of the scene precedes these values.
    """
    return [*([] if scene is None else [f"scene={scene}"]), *(settings or ())]


_VALUE_NAMES = {"str": "TEXT", "int": "N", "float": "NUMBER", "Path": "FILE", "list[str]": "TEXT"}


def name_values(command: Any) -> None:
    """Set the placeholders that the help shows for the values of a command's options.

    Options that have no value (flags) get no placeholder.
    """
    help_option = command.get_help_option(SimpleNamespace(help_option_names=["-h", "--help"]))
    for parameter in (*command.params, help_option):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
        elif parameter.metavar is None and parameter.param_type_name == "argument":
            parameter.metavar = parameter.name.upper()
        elif parameter.metavar is None:
            choices = parameter.type_descriptor.choices
            parameter.metavar = (
                "|".join(str(getattr(one, "value", one)) for one in choices)
                if choices
                else _VALUE_NAMES[parameter.bare_type()]
            )
    for inner in getattr(command, "commands", {}).values():
        name_values(inner)
