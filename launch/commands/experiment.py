"""`flexsheet experiment`: run the experiments of Furukawa et al. 2007 on a graph."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.output import (
    examples,
    print_columns,
    print_json,
    print_table,
    progress_words,
    shown,
    words,
)
from flexsheet.messages.units import format_percent

if TYPE_CHECKING:
    from flexsheet.launch.experiments.image import Series
    from flexsheet.messages.types import FingerPath

app = options.make_app("Run the experiments of Furukawa et al. 2007, and further ones, on a graph.")

StrokeOption = Annotated[
    float,
    typer.Option(
        "--seconds", metavar="SECONDS", min=1.0, max=600.0, help="Duration of each stroke, s."
    ),
]


def make_result_folder(output: Path | None, name: str) -> Path:
    """Create a folder for results, and return its path.

    output: path of the folder. If it is None, the folder is created in runs/, and its name contains
        `name`.
    """
    from flexsheet.launch.experiments.run import new_folder

    if output is None:
        return new_folder(name)
    output.mkdir(parents=True, exist_ok=True)
    return output


@app.command(
    epilog=examples(
        "flexsheet experiment stroke --seconds 30",
        "flexsheet experiment stroke --set planner.prediction_horizon_s=0 --json",
    )
)
def stroke(
    *,
    seconds: StrokeOption = 10.0,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    switches: Annotated[
        int,
        typer.Option(
            min=0,
            max=1000,
            help="Number of switches of the projected image between white and black after the "
            "stroke, for the latency of the projector. The bag then contains the images of the "
            "camera.",
        ),
    ] = 0,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate a finger that strokes a cylinder over 60 degrees, and measure the sheet's errors.

    Furukawa et al. 2007 describe this experiment in section V and Table I.
    """
    given = options.with_scene(settings, scene)
    from flexsheet.launch.experiments import stroke as experiment
    from flexsheet.launch.experiments.run import (
        chain_procedures,
        make_path_procedure,
        make_switch_procedure,
        run_experiment,
    )
    from flexsheet.messages.scene import require_cylinder

    bag = make_result_folder(output, "stroke") / "stroke.mcap"
    with progress_words() as progress:
        procedure = make_path_procedure(partial(experiment.stroke_path, seconds=seconds), progress)
        if switches:
            procedure = chain_procedures(procedure, make_switch_procedure(switches, progress))
            given = [*given, "recorder.include=[stereo]"]
        run_experiment(
            launch_file,
            given,
            bag,
            procedure,
            progress,
            apparatus=apparatus,
            check_scene=require_cylinder,
        )
        result = experiment.evaluate_stroke(bag, seconds)
    if as_json:
        print_json(result)
    else:
        print_strokes([result])
        words.print(f"bag: {bag}")


@app.command(epilog=examples("flexsheet experiment tilt --json"))
def tilt(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure image errors on a tilted sheet (Furukawa et al. 2007, section VI-B, Fig. 11)."""
    from flexsheet.launch.experiments.image import TILT

    given = options.with_scene(settings, scene)
    folder = make_result_folder(output, "tilt")
    _measure_images(TILT, folder / "tilt.mcap", launch_file, given, apparatus, as_json=as_json)


@app.command(epilog=examples("flexsheet experiment push --json"))
def push(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure image errors on a pushed sheet (Furukawa et al. 2007, section VI-C, Fig. 13).

    As in the paper, the arms hold the edges of the sheet still while the finger pushes. With
    `--set planner.compliance_mode=force_curve`, the arms move the sheet away from the finger.
    """
    from flexsheet.launch.experiments.image import PUSH
    from flexsheet.launch.experiments.run import make_settings

    given = make_settings(launch_file, "planner", "compliance_mode=stiffness")
    given += options.with_scene(settings, scene)
    folder = make_result_folder(output, "push")
    _measure_images(PUSH, folder / "push.mcap", launch_file, given, apparatus, as_json=as_json)


@app.command(epilog=examples("flexsheet experiment compliance --output runs/soft"))
def compliance(
    *,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    apparatus: options.ApparatusOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Compare the force on the finger with the force of the virtual object at several push depths.

    If no table of the soft body is in the cache, the coarse table is computed first, which takes
    about a minute.
    """
    from flexsheet.launch.experiments import compliance as experiment
    from flexsheet.launch.experiments.run import run_experiment

    folder = make_result_folder(output, "compliance")
    bag = folder / "compliance.mcap"
    with progress_words() as progress:
        run_experiment(
            launch_file,
            options.with_scene(settings, scene),
            bag,
            experiment.make_compliance_procedure(progress),
            progress,
            apparatus=apparatus,
        )
        result = experiment.compliance_result(bag, progress)
    if as_json:
        print_json(result)
        return
    columns = {
        "position": ("at", ""),
        "depth, mm": ("depth_mm", ".2f"),
        "reference, N": ("reference_n", ".2f"),
        "wanted, N": ("wanted_n", ".2f"),
        "felt, N": ("felt_n", ".2f"),
        "error, %": ("error_percent", ".2f"),
        "model's, %": ("model_error_percent", ".2f"),
        "model": ("method", ""),
        "offset, mm": ("normal_offset_mm", ".2f"),
    }
    print_columns(result["rows"], columns)
    words.print(f"errors are relative to {result['reference']}")
    for place in result["against_reference"]:
        words.print(
            f"{place['at']}: median {place['median_percent']:.1f} %, max "
            f"{place['worst_percent']:.1f} %; the soft body alone max "
            f"{place['model_worst_percent']:.1f} %"
        )
    moving = result["moving"]
    words.print(
        f"force error in motion at {moving['speed_mm_per_s']:g} mm/s: "
        f"{moving['rms_percent']:.0f} % rms, {moving['worst_percent']:.0f} % max; people notice "
        f"{result['noticed_percent'][0]:.0f} to {result['noticed_percent'][1]:.0f} %"
    )
    words.print(f"bag: {bag}")


def _measure_images(
    series: Series,
    bag: Path,
    launch_file: Path,
    settings: list[str],
    apparatus: str | None,
    *,
    as_json: bool,
) -> None:
    """Run an image experiment in a graph, record it in a bag, and print the image errors."""
    from flexsheet.launch.experiments import image
    from flexsheet.launch.experiments.run import make_image_procedure, run_experiment
    from flexsheet.messages.scene import require_cylinder

    with progress_words() as progress:
        procedure = make_image_procedure(series, series.values, image.CORRECTIONS, progress)
        run_experiment(
            launch_file,
            settings,
            bag,
            procedure,
            progress,
            apparatus=apparatus,
            needed=["twin/eye"],
            check_scene=require_cylinder,
        )
        rows = image.make_rows(image.read_images(bag), series)
    if as_json:
        summary = image.summarize_methods(rows)
        print_json({"rows": rows, "by_method": summary, "bag": str(bag)})
        return
    cells = [
        [f"{cell:.2f}" if isinstance(cell, float) else cell for cell in row.values()]
        for row in rows
    ]
    print_table(list(rows[0]), cells)
    words.print(f"bag: {bag}")


def print_followed(results: list[dict[str, Any]]) -> None:
    """Print the errors of the sheet while it followed the finger, with one line per fingertip path.

    Δd and Δθ are the distance and the angle between the true sheet and the true finger during
    contact.
    """
    columns = ["path", "in contact", "followed", "drop-outs", "true Δd, mm: mean", "95 %", "max"]
    columns += ["true Δθ, °: mean", "95 %", "max"]
    rows = []
    for result in results:
        ratio = result["following_ratio"]
        row = [result["path"], format_percent(result["contact_ratio"])]
        row += ["-" if ratio is None else format_percent(ratio), str(result["drop_outs"])]
        for key in ("true_delta_d_mm", "true_delta_theta_deg"):
            errors = result["contact"][key] or dict.fromkeys(("mean", "p95", "max"))
            row += [shown(errors[name], ".3f") for name in ("mean", "p95", "max")]
        rows.append(row)
    print_table(columns, rows)


def announce_recording(finger_path: str, path: FingerPath) -> None:
    """State how a path from a CSV file is placed in the scene; state nothing for a gesture.

    finger_path: value of the option --finger-path.
    """
    from flexsheet.launch.experiments.finger_paths import GESTURES

    if finger_path not in GESTURES:
        words.print(
            f"the recorded motion of {finger_path} is centred in front of the object, follows its "
            f"surface, and takes {path.times_s[-1]:.1f} s; `flexsheet topic pub twin/finger_path` "
            "follows given positions instead"
        )


def print_strokes(results: list[dict[str, Any]]) -> None:
    """Print mean and standard deviation of the errors in finger strokes, and the paper's values.

    The paper is Furukawa et al. 2007, Table I.
    """
    from flexsheet.launch.experiments.stroke import PAPER_TABLE_1

    columns = ["moving time"]
    for name, unit in (("Δd", "mm"), ("Δθ", "°")):
        columns += [f"{name} paper, {unit}", f"{name} measured, {unit}", f"true {name}, {unit}"]
    rows = []
    for result in results:
        row = [f"{result['seconds']:g} s"]
        for key in ("delta_d_mm", "delta_theta_deg"):
            paper = PAPER_TABLE_1.get(result["seconds"], {}).get(key)
            row.append("-" if paper is None else f"{paper[0]:.3f} ± {paper[1]:.3f}")
            for measured in (result[key], result[f"true_{key}"]):
                row.append(f"{measured['mean']:.3f} ± {measured['std']:.3f}")
        rows.append(row)
    print_table(columns, rows)


@app.command(
    epilog=examples(
        "flexsheet experiment stability",
        "flexsheet experiment stability --scene cylinder --json",
    )
)
def stability(
    *,
    scene_file: options.SceneOption = options.CYLINDER,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate whether a hand in contact with the sheet starts to oscillate.

    The stiffness of the object, the impedance of the hand, the delay and its jitter are varied. The
    simulations run with and without the planner's limits on the rendered stiffness. The command
    compares the simulated critical gain with the predicted critical gain.
    """
    import json

    from flexsheet.launch.experiments import stability as experiment
    from flexsheet.launch.health.compliance import compute_front_curve
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.nodes.planner.sheet_force import make_force_model

    scene = load_scene(scene_file)
    folder = make_result_folder(output, "stability")
    with progress_words() as progress:
        curve = compute_front_curve(scene, None, progress)
        model, drawn = make_force_model(scene.sheet), experiment.StabilitySettings()
        result = experiment.stability_result(scene, model, curve, drawn, progress)
    file = folder / "stability.json"
    file.write_text(json.dumps(result, indent=1) + "\n")
    if as_json:
        lists = ("rows", "without_bounds", "boundary")
        summary = {key: value for key, value in result.items() if key not in lists}
        print_json({**summary, "file": str(file)})
        return
    rows = [*result["rows"], *result["without_bounds"]]
    cells = []
    for kind, jitter_ms in dict.fromkeys((row["kind"], row["jitter_ms"]) for row in rows):
        chosen = [row for row in rows if (row["kind"], row["jitter_ms"]) == (kind, jitter_ms)]
        unstable = [row for row in chosen if not row["stable"]]
        margin = min(row["margin"] for row in chosen)
        cells.append([kind, f"{jitter_ms:.0f}", len(chosen), len(unstable), f"{margin:.2f}"])
    columns = ["control loop", "jitter, ms", "cases", "not stable", "smallest gain margin"]
    print_table(columns, cells)
    error, median = result["boundary_error_percent"], result["boundary_median_percent"]
    if error is not None:
        words.print(
            f"error of the predicted critical gain: {median:.0f} % median, "
            f"{error:.0f} % at the 95 % quantile, in {len(result['boundary'])} simulated cases"
        )
    words.print(f"all cases: {file}")


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

    selected = select_names(parameters or [], load_tolerances(), "parameter")
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
    at_sigma = [row for row in result["rows"] if abs(row["sigma"]) == 1.0]
    table = []
    for one in result["ranking"]:
        own = [row for row in at_sigma if row["parameter"] == one["parameter"]]
        errors = [[abs(row[key]) for row in own if row[key] is not None] for key in metrics]
        largest = [shown(max(values, default=None)) for values in errors]
        table.append([one["parameter"], f"{one['share']:.2f}", *largest])
    columns = ["parameter", "worst over tolerance", *(f"{key} at 1 σ" for key in metrics)]
    print_table(columns, table)
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
