"""`flexsheet calibrate`: a stereo rig measured by pictures of a chessboard, and checked."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from launch.commands.graph import JsonOption
from launch.commands.output import BAD_INPUT, CommandError, print_fields, print_json, words

app = typer.Typer(no_args_is_help=True, help="Calibration from pictures.")

LeftOption = Annotated[str, typer.Option(metavar="GLOB", help="Left pictures, in name order.")]
RightOption = Annotated[str, typer.Option(metavar="GLOB", help="Right pictures, in name order.")]
BoardOption = Annotated[
    str, typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the chessboard, as 9x6.")
]
SquareOption = Annotated[float, typer.Option(help="Side of a square, mm.", min=1e-3)]


@app.command()
def stereo(
    *,
    left: LeftOption,
    right: RightOption,
    board: BoardOption,
    square_mm: SquareOption,
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration file to write.")],
    device: Annotated[str, typer.Option(help="Name of the rig.")] = "stereo",
    as_json: JsonOption = False,
) -> None:
    """Calibrate both cameras and how they stand to each other."""
    from messages.calibration import save_calibration
    from nodes.camera.calibration import CalibrationError, calibrate_stereo

    if not output.parent.is_dir():
        raise CommandError(f"-o {output}: the folder {output.parent} does not exist", BAD_INPUT)
    try:
        with _progress("looking for the board") as progress:
            calibration = calibrate_stereo(
                _pictures("--left", left),
                _pictures("--right", right),
                board=_board(board),
                square_m=square_mm * 1e-3,
                device=device,
                progress=progress,
            )
    except CalibrationError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    save_calibration(calibration, output)
    used = sum(pair.used for pair in calibration.pairs)
    baseline_mm = float((calibration.right_from_left[:3, 3] ** 2).sum() ** 0.5) * 1e3
    result = {
        "calibration": str(output),
        "pairs": used,
        "pairs_left_out": {pair.left: pair.reason for pair in calibration.pairs if not pair.used},
        "reprojection_rms_px": calibration.reprojection_rms_px,
        "baseline_mm": baseline_mm,
        "left_f_px": calibration.left.fx_px,
        "right_f_px": calibration.right.fx_px,
    }
    if as_json:
        print_json(result)
        return
    print_fields(
        [
            ("calibration", output),
            ("pairs used", f"{used} of {len(calibration.pairs)}"),
            ("reprojection", f"{calibration.reprojection_rms_px:.3f} px rms"),
            ("baseline", f"{baseline_mm:.2f} mm"),
            ("focal lengths", f"{calibration.left.fx_px:.1f}, {calibration.right.fx_px:.1f} px"),
        ]
    )
    for pair in calibration.pairs:
        if not pair.used:
            words.print(f"left out: {pair.left}: {pair.reason}", markup=False)


@app.command()
def check(
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file.")],
    left: LeftOption,
    right: RightOption,
    board: BoardOption,
    square_mm: SquareOption,
    as_json: JsonOption = False,
) -> None:
    """Measure a board of known size with a calibration, on pictures that did not make it."""
    from messages.calibration import CalibrationFileError, load_calibration
    from nodes.camera.calibration import CalibrationError, check_stereo

    try:
        with _progress("measuring the board") as progress:
            result = check_stereo(
                load_calibration(calibration),
                _pictures("--left", left),
                _pictures("--right", right),
                board=_board(board),
                square_m=square_mm * 1e-3,
                progress=progress,
            )
    except (CalibrationError, CalibrationFileError) as error:
        raise CommandError(str(error), BAD_INPUT) from error
    if as_json:
        print_json(result)
    else:
        print_fields(
            (name, value if isinstance(value, int) else f"{value:.4f}")
            for name, value in result.items()
        )


def _pictures(option: str, pattern: str) -> list[Path]:
    paths = [Path(name) for name in sorted(glob.glob(pattern))]
    if not paths:
        raise CommandError(f"{option} {pattern}: no file matches; quote the pattern", BAD_INPUT)
    return paths


def _board(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    if not (columns.isdigit() and rows.isdigit() and min(int(columns), int(rows)) >= 3):
        raise CommandError(
            f"--board {text}: give the inner corners along both sides, 3 or more, as 9x6", BAD_INPUT
        )
    return int(columns), int(rows)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """A progress bar on stderr, as the function that the calibration calls."""
    from rich.progress import Progress

    with Progress(console=words, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total, _: bar.update(task, completed=done, total=total)
