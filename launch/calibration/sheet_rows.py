"""Read measured pushes of a sheet from a CSV file, or simulate them."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.sheet_fit import MeasuredPush
from flexsheet.launch.calibration.simulated_sheet import twin_push
from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.messages.scene import Scene, SheetSpec

NEEDED = ("depth_mm", "force_n")
STRETCH = ("edge_distance_mm", "stretch_ratio")
OPTIONAL = ("x_mm", "y_mm", "edge_force_n", "finger_radius_mm")
COLUMNS = (*STRETCH, *NEEDED, *OPTIONAL)

MAX_PROBLEMS = 20
"""Further problems are counted, not listed."""

MAX_LENGTH_RATIO = {"edge_distance_mm": 2.0, "depth_mm": 0.6, "finger_radius_mm": 0.2}
"""Maximum plausible lengths over the sheet's width; larger ones are probably in another unit."""


def read_rows(
    path: Path, sheet: SheetSpec, finger_radius_m: float
) -> tuple[list[MeasuredPush], list[int]]:
    """Return pushes and their line numbers; BadInputError names file, line and column.

    The first line names the columns: `depth_mm`, `force_n`, one of `edge_distance_mm` and
    `stretch_ratio` (over the scene's width), and, if measured, `x_mm`, `y_mm` (from the sheet's
    centre), `edge_force_n` and `finger_radius_mm`.  Empty lines and lines that begin with # are
    skipped.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadInputError(
            [Problem(str(path), (), f"cannot be read: {reason}", "check the path")]
        ) from error
    except UnicodeDecodeError as error:
        raise BadInputError(
            [Problem(str(path), (), f"is not UTF-8 text: {error}", "save it as CSV in UTF-8")]
        ) from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise BadInputError(
            [Problem(str(path), (), "is empty", f"its first line names {', '.join(COLUMNS)}")]
        )
    first, header = lines[0]
    names = [name.strip() for name in next(csv.reader([header]))]
    _check_header(f"{path}:{first}", names)
    problems: list[Problem] = []
    pushes: list[MeasuredPush] = []
    numbers: list[int] = []
    for number, line in lines[1:]:
        cells = next(csv.reader([line]))
        found: list[Problem] = []
        values = _values(f"{path}:{number}", names, cells, sheet, found)
        if found:
            problems += found
        else:
            pushes.append(_push(values, sheet, finger_radius_m))
            numbers.append(number)
    if problems:
        shown = problems[:MAX_PROBLEMS]
        if len(problems) > MAX_PROBLEMS:
            shown.append(Problem(str(path), (), f"and {len(problems) - MAX_PROBLEMS} more"))
        raise BadInputError(shown)
    if not pushes:
        raise BadInputError([Problem(str(path), (), "has no rows", "add one line for each push")])
    return pushes, numbers


def _check_header(where: str, names: list[str]) -> None:
    problems = [
        Problem(where, (name,), "unknown column", did_you_mean(name, COLUMNS))
        for name in names
        if name not in COLUMNS
    ]
    problems += [
        Problem(where, (name,), "column is given twice", "remove one")
        for name in dict.fromkeys(names)
        if names.count(name) > 1
    ]
    problems += [
        Problem(where, (name,), "column is missing", "add it")
        for name in NEEDED
        if name not in names
    ]
    if sum(name in names for name in STRETCH) != 1:
        problems.append(
            Problem(where, (), f"needs one of the columns {' and '.join(STRETCH)}", "give one")
        )
    if problems:
        raise BadInputError(problems)


def _values(
    where: str, names: list[str], cells: list[str], sheet: SheetSpec, problems: list[Problem]
) -> dict[str, float]:
    """Return the row's numbers; append what is wrong with them to `problems`."""
    if len(cells) != len(names):
        problems.append(
            Problem(
                where,
                (),
                f"{len(cells)} values for {len(names)} columns",
                "give one value for each column",
            )
        )
        return {}
    values: dict[str, float] = {}
    for name, cell in zip(names, cells, strict=True):
        text = cell.strip()
        if not text and name in OPTIONAL:
            continue
        try:
            value = float(text)
        except ValueError:
            problems.append(Problem(where, (name,), f'"{text}" is not a number', "write as 12.5"))
            continue
        signed = name in ("x_mm", "y_mm", "force_n", "edge_force_n")
        if not math.isfinite(value) or (value <= 0.0 and not signed):
            problems.append(Problem(where, (name,), f"{text} is not positive and finite"))
        elif 1e-3 * value > MAX_LENGTH_RATIO.get(name, math.inf) * sheet.width_m:
            problems.append(
                Problem(where, (name,), f"{text} mm is too large for a sheet of "
                        f"{1e3 * sheet.width_m:g} mm", "lengths are in mm")
            )  # fmt: skip
        elif name == "stretch_ratio" and not 0.8 < value < 3.0:
            problems.append(
                Problem(where, (name,), f"{text} is not near 1", "distance over slack width, 1.05")
            )
        else:
            values[name] = value
    sides = (("x_mm", 0.5 * MAX_LENGTH_RATIO["edge_distance_mm"] * sheet.width_m),
             ("y_mm", 0.5 * sheet.height_m))  # fmt: skip
    for name, half in sides:
        if abs(1e-3 * values.get(name, 0.0)) >= half:
            problems.append(Problem(where, (name,), f"{values[name]:g} is not on the sheet"))
    return values


def _push(values: dict[str, float], sheet: SheetSpec, finger_radius_m: float) -> MeasuredPush:
    distance = values.get("edge_distance_mm")
    return MeasuredPush(
        edge_distance_m=(
            1e-3 * distance if distance is not None else values["stretch_ratio"] * sheet.width_m
        ),
        depth_m=1e-3 * values["depth_mm"],
        force_n=values["force_n"],
        finger_radius_m=1e-3 * values.get("finger_radius_mm", 1e3 * finger_radius_m),
        position_m=(1e-3 * values.get("x_mm", 0.0), 1e-3 * values.get("y_mm", 0.0)),
        edge_force_n=values.get("edge_force_n"),
    )


TWIN_DEPTHS_M = (0.002, 0.004, 0.007, 0.012, 0.020, 0.030, 0.040, 0.050)
TWIN_STRETCHES = 4
TWIN_XS, TWIN_YS = (0.0, 0.13, 0.25), (0.0, 0.19, 0.36)
"""Positions: x over the width, y over the height."""


def simulate_rows(
    scene: Scene,
    *,
    places: bool,
    noise_n: float,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[MeasuredPush]:
    """Simulate pushes over the scene's stretches and depths, with the noise of a force gauge.

    places: push at positions over the whole sheet, not only at its centre.
    """
    rng = np.random.default_rng(seed)
    pushes: list[MeasuredPush] = []
    asked = list(_simulated_cases(scene, places))
    for done, (stretch, depth, place) in enumerate(asked, start=1):
        force, pull = twin_push(scene.sheet, stretch, depth, place, scene.finger.radius_m)
        pushes.append(
            MeasuredPush(
                edge_distance_m=stretch * scene.sheet.width_m,
                depth_m=depth,
                force_n=force + float(rng.normal(0.0, noise_n)),
                finger_radius_m=scene.finger.radius_m,
                position_m=place,
                edge_force_n=pull + float(rng.normal(0.0, 10.0 * noise_n)),
            )
        )
        progress(done, len(asked))
    return pushes


def _simulated_cases(
    scene: Scene, places: bool
) -> Iterator[tuple[float, float, tuple[float, float]]]:
    sheet = scene.sheet
    stretches = np.linspace(
        max(sheet.min_stretch_ratio, 1.005), sheet.max_stretch_ratio, TWIN_STRETCHES
    )
    xs, ys = (TWIN_XS, TWIN_YS) if places else ((0.0,), (0.0,))
    for stretch in stretches:
        for x in xs:
            for y in ys:
                for depth in TWIN_DEPTHS_M:
                    if depth <= scene.working_range.push_depth_m + 1e-9:
                        yield float(stretch), depth, (x * sheet.width_m, y * sheet.height_m)
