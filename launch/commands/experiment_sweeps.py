"""`flexsheet experiment robustness`, `sensitivity` and `follow`: run series of simulations.

The first two commands simulate hardware whose true parameters (the apparatus) differ from the
scene, which contains the parameters that the nodes assume. The command `follow` simulates a finger
on a recorded path.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.experiment import (
    StrokeOption,
    announce_recording,
    app,
    make_result_folder,
    print_followed,
)
from flexsheet.launch.commands.output import (
    examples,
    print_json,
    print_table,
    progress_words,
    shown,
    words,
)


@app.command(
    epilog=examples(
        "flexsheet experiment robustness --seeds 0-9 --output runs/draws",
        "flexsheet experiment robustness --seeds 0-29 --profile paper --calibrated --json",
        "flexsheet experiment robustness --seeds 0-3 --commissioned",
    )
)
def robustness(
    *,
    seeds: Annotated[
        str,
        typer.Option(
            metavar="A-B",
            help="Range of random seeds; each seed sets the errors of one simulated apparatus. "
            "Seeds 0-99 are for development, higher seeds for reports.",
        ),
    ],
    profile: options.ProfileOption = "modern",
    calibrated: options.CalibratedOption = False,
    commissioned: Annotated[
        bool,
        typer.Option(
            "--commissioned",
            help="Calibrate each simulated apparatus first, as `flexsheet commission` does, and "
            "evaluate it in simulated time.",
        ),
    ] = False,
    seconds: StrokeOption = 10.0,
    workers: options.WorkersOption = 1,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure the errors of sheet, fingertip, image and force with randomly inaccurate hardware.

    For each seed, the true parameters of the simulated hardware are sampled within tolerances. A
    separate process runs a graph with one stroke of the finger. The errors of image and force are
    computed with the sheet at rest, without a graph. To continue an interrupted command, repeat it
    with the same --output.
    """
    from flexsheet.launch.experiments import robustness as experiment
    from flexsheet.nodes.twin.tolerance_table import Profile

    selected = experiment.parse_seeds(seeds)
    folder = make_result_folder(output, "robustness")
    with progress_words() as progress:
        result = experiment.run_robustness(
            launch_file,
            options.with_scene(settings, scene),
            folder,
            selected,
            progress,
            profile=Profile(profile),
            calibrated=calibrated,
            seconds=seconds,
            workers=workers,
            commissioned=commissioned,
        )
    if as_json:
        print_json(result)
        return
    rows = [
        [
            row["seed"],
            *(shown(row[metric]) for metric in experiment.METRICS),
            ", ".join(row["out_of_tolerance"]) or "-",
            ", ".join(row["flagged"]) or "-",
        ]
        for row in result["rows"]
    ]
    for statistic in ("median", "p95", "worst"):
        values = [shown(result["summary"][metric][statistic]) for metric in experiment.METRICS]
        rows.append([statistic, *values, "", ""])
    print_table(["seed", *experiment.METRICS, "out of tolerance", "flagged"], rows)
    if "commissioning" in result:
        _print_predictions(result["commissioning"])
    for one in result["failed"]:
        words.print(f"seed {one['seed']} failed: {one['error']}")
    words.print(f"rows: {folder}")


def _print_predictions(found: dict[str, Any]) -> None:
    """Print how often predicted and true errors are within tolerance, as confusion matrices.

    The first row is for whole reports, and each further row is for one metric.
    """
    cases = ("good_and_within", "good_but_exceeded", "doubted_but_within", "doubted_and_exceeded")
    every = {"all": {**found["confusion"], "stated_over_true": {"median": None}}}
    print_table(
        ["report", *(case.replace("_", " ") for case in cases), "stated / true error, median"],
        [
            [name, *(one[case] for case in cases), shown(one["stated_over_true"]["median"])]
            for name, one in (every | found["predictions"]).items()
        ],
    )


@app.command(
    epilog=examples(
        "flexsheet experiment sensitivity --calibrated",
        "flexsheet experiment sensitivity --parameter sheet.modulus_ratio --json",
    )
)
def sensitivity(
    *,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            metavar="KEY",
            help="Parameter in the table of tolerances; repeat the option; default: all.",
        ),
    ] = None,
    profile: options.ProfileOption = "modern",
    calibrated: options.CalibratedOption = False,
    seconds: StrokeOption = 10.0,
    workers: options.WorkersOption = 1,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure the errors that each hardware parameter causes if only this parameter is inaccurate.

    Each parameter deviates by 1 and 3 standard deviations in both directions. Delays and tremor are
    evaluated by strokes of the finger in simulated time. All other parameters are evaluated with
    the sheet at rest. To continue an interrupted command, repeat it with the same --output.
    """
    from flexsheet.launch.experiments import select_names
    from flexsheet.launch.experiments import sensitivity as experiment
    from flexsheet.nodes.twin.tolerance_table import Profile, load_tolerances

    selected = select_names(options.split_names(parameters), load_tolerances(), "parameter")
    folder = make_result_folder(output, "sensitivity")
    with progress_words() as progress:
        result = experiment.run_sensitivity(
            launch_file,
            options.with_scene(settings, scene),
            folder,
            selected,
            progress,
            profile=Profile(profile),
            calibrated=calibrated,
            seconds=seconds,
            workers=workers,
        )
    if as_json:
        print_json(result)
        return
    metrics = list(result["tolerances"])
    largest = {
        parameter: [
            shown(max((abs(row[one]) for row in rows if row[one] is not None), default=None))
            for one in metrics
        ]
        for parameter in (row["parameter"] for row in result["ranking"])
        if (
            rows := [
                row
                for row in result["rows"]
                if row["parameter"] == parameter and abs(row["sigma"]) == 1.0
            ]
        )
    }
    print_table(
        ["parameter", "worst over tolerance", *(f"{one} at 1 σ" for one in metrics)],
        [
            [one["parameter"], f"{one['share']:.2f}", *largest[one["parameter"]]]
            for one in result["ranking"]
        ],
    )
    for name in ("not_measured", "not_simulated"):
        listed = dict.fromkeys(
            row["parameter"] for row in result["rows"] if row["evaluation"] == name
        )
        if listed:
            words.print(f"{name.replace('_', ' ')}: {', '.join(listed)}")


@app.command(epilog=examples("flexsheet experiment follow --finger-path finger.csv --json"))
def follow(
    *,
    finger_path: Annotated[
        str,
        typer.Option(
            metavar="NAME_OR_FILE",
            help="CSV file with a recorded fingertip path (columns t_s,x_mm,y_mm,z_mm), or the "
            "name of a gesture.",
        ),
    ],
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    simulated_time: Annotated[
        bool,
        typer.Option(
            "--simulated-time",
            help="Run tracking, planning and arms in simulated time instead of in a graph.",
        ),
    ] = False,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure the sheet's error while it follows a recorded finger, and compute a lower bound.

    The bound is the minimum mean error that the arms can reach within their motion limits if the
    whole recording is known in advance.
    """
    from flexsheet.launch.experiments import follow as experiment
    from flexsheet.launch.experiments.finger_paths import finger_path as load_path

    given = options.with_scene(settings, scene)
    path = load_path(launch_file, finger_path, given)
    announce_recording(finger_path, path)
    bag = None if simulated_time else make_result_folder(output, "follow") / "follow.mcap"
    with progress_words() as progress:
        result = experiment.run_follow(launch_file, given, bag, path, progress, apparatus=apparatus)
    if as_json:
        print_json(result)
        return
    print_followed([result])
    bound = result["lower_bound_mm"]
    words.print(
        f"lower bound of the error: mean {shown(bound['mean'])} mm, 95 % {shown(bound['p95'])} mm"
    )
    if bag is not None:
        words.print(f"bag: {bag}")
