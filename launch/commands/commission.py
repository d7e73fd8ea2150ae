"""`flexsheet commission`: calibrate and verify all devices of a laboratory in sequence."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.output import (
    FAILED,
    NOT_GOOD,
    CommandError,
    examples,
    print_json,
    print_table,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.calibration.commission import Commissioning, StepName

app = typer.Typer(add_completion=False)


@app.command(
    epilog=examples(
        "flexsheet commission --apparatus seed:3 --output lab",
        "flexsheet commission --launch launch/lab.yaml --output lab --data camera=board-images",
        "flexsheet commission --launch launch/lab.yaml --output lab --step marker "
        "--data marker=touches.csv",
    )
)
def commission(
    *,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="FOLDER",
            help="Folder for state and results; if it exists, the commissioning continues.",
        ),
    ],
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    apparatus: options.ApparatusOption = None,
    data: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STEP=PATH",
            help="Captured data of a step; repeat the option for several steps.",
        ),
    ] = None,
    finger_radius_mm: Annotated[
        float | None,
        typer.Option(metavar="MM", min=1.0, help="Measured radius of the fingertip, mm."),
    ] = None,
    sheet_kg_per_m2: Annotated[
        float | None,
        typer.Option(
            metavar="DENSITY",
            min=0.0,
            help="Measured mass per area of the sheet, kg/m²; it determines the sag.",
        ),
    ] = None,
    board: Annotated[
        str,
        typer.Option(
            metavar="COLUMNSxROWS",
            help="Number of inner corners of the board for the camera, such as 9x6.",
        ),
    ] = "9x6",
    square_mm: Annotated[
        float,
        typer.Option(
            metavar="MM", min=1e-3, help="Side length of a square of the camera's board, mm."
        ),
    ] = 25.0,
    flange_board: Annotated[
        str,
        typer.Option(
            metavar="COLUMNSxROWS",
            help="Number of inner corners of the board on the flanges, such as 7x5.",
        ),
    ] = "7x5",
    flange_square_mm: Annotated[
        float,
        typer.Option(
            metavar="MM", min=1e-3, help="Side length of a square of the flanges' board, mm."
        ),
    ] = 15.0,
    repeated: Annotated[
        list[str] | None,
        typer.Option(
            "--step",
            metavar="STEP",
            help="Step to run again, with all later steps; repeat the option for several steps.",
        ),
    ] = None,
    skipped: Annotated[
        list[str] | None,
        typer.Option(
            "--skip",
            metavar="STEP=REASON",
            help="Step to skip, and the reason; repeat the option for several steps.",
        ),
    ] = None,
    duration: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=2.0,
            help="Duration of the finger's stroke in the verification, s.",
        ),
    ] = 10.0,
    seed: options.SeedOption = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate all devices of a laboratory in sequence, and verify the result.

    The steps are camera, arms, edges, sheet, projector, marker, eyes, delays and verification.
    Finished steps are not repeated. With --apparatus, all devices are simulated, and the steps take
    a few minutes. Otherwise, if the data of a step are missing, the command explains how to capture
    them and stops with exit code 1. The exit code is 3 if the laboratory has not been verified, or
    if the verification has found a problem.
    """
    from flexsheet.launch.calibration.commission import MissingDataError, StepName, is_good
    from flexsheet.launch.calibration.commission_steps import open_laboratory
    from flexsheet.launch.commands.calibrate import FOUR_BITS, parse_board

    given = {name: Path(path) for name, path in _parse_pairs("--data", data).items()}
    skips = _parse_pairs("--skip", skipped)
    repeats = [_parse_step("--step", name) for name in repeated or ()]
    measured = (finger_radius_mm, sheet_kg_per_m2)
    if apparatus is not None and (given or any(one is not None for one in measured)):
        raise CommandError(
            "--data, --finger-radius-mm and --sheet-kg-per-m2 are for real devices; remove them or "
            "--apparatus"
        )
    lab, devices = open_laboratory(
        output,
        launch_file,
        scene,
        apparatus,
        data=given,
        finger_radius_m=None if finger_radius_mm is None else 1e-3 * finger_radius_mm,
        sheet_kg_per_m2=sheet_kg_per_m2,
        board=parse_board(board, square_mm, None, FOUR_BITS),
        flange_board=parse_board(flange_board, flange_square_mm, None, FOUR_BITS),
        seconds=duration,
        seed=seed,
    )
    missing: MissingDataError | None = None
    try:
        for name in StepName:
            if name in skips:
                lab.skip(name, skips[name])
            elif name in repeats or name not in lab.state.steps:
                words.print(f"step {name}")
                lab.run(name, devices.steps[name])
    except MissingDataError as error:
        missing = error
    _print_result(lab, missing, as_json)
    if missing is not None:
        raise typer.Exit(FAILED)
    if not is_good(lab.state):
        raise typer.Exit(NOT_GOOD)


def _parse_step(option: str, text: str) -> StepName:
    from flexsheet.launch.calibration.commission import STEPS, StepName

    if text not in STEPS:
        raise CommandError(f"{option} {text}: expected one of {', '.join(STEPS)}")
    return StepName(text)


def _parse_pairs(option: str, given: list[str] | None) -> dict[StepName, str]:
    """Parse the values STEP=TEXT of a command-line option, and return the text of each step.

    Raises CommandError if a step is unknown or a text is empty.
    """
    pairs = {}
    for one in given or ():
        name, _, text = one.partition("=")
        if not text.strip():
            raise CommandError(f"{option} {one}: expected STEP=TEXT with a non-empty text")
        pairs[_parse_step(option, name)] = text.strip()
    return pairs


def _print_result(lab: Commissioning, missing: Any, as_json: bool) -> None:
    from flexsheet.launch.calibration.commission import format_verdict, summarize

    result = summarize(lab)
    if as_json:
        print_json({**result, "next": None if missing is None else str(missing)})
        return
    print_table(
        ["step", "time", "residual", "limit", ""],
        [
            [one["name"], f"{one['seconds']:.0f} s", "-", "-", f"skipped: {one['skipped_because']}"]
            if one["residual"] is None
            else [
                one["name"],
                f"{one['seconds']:.0f} s",
                f"{one['residual']:.3g} {one['unit']}",
                f"{one['limit']:g} {one['unit']}",
                one["advice"]
                or ", ".join(f"{each['quantity']} was not measured" for each in one["missing"]),
            ]
            for one in result["steps"]
        ],
    )
    words.print(f"launch file: {result['launch_file']}")
    if missing is not None:
        words.print(str(missing))
    for line in format_verdict(lab.state):
        words.print(line)
