"""Read measured pushes of a finger into the sheet from a CSV file, or simulate them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.csv_rows import parse_finite, read_table
from flexsheet.launch.calibration.sheet_fit import MeasuredPush
from flexsheet.launch.calibration.simulated_sheet import SimulatedSheet
from flexsheet.launch.plans.documents import BadInputError, Problem
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.scene import Scene, SheetSpec

REQUIRED = ("depth_mm", "force_n")
STRETCH = ("edge_distance_mm", "stretch_ratio")
OPTIONAL = ("x_mm", "y_mm", "edge_force_n", "finger_radius_mm", "unloading")
COLUMNS = (*STRETCH, *REQUIRED, *OPTIONAL)
SIGNED = ("x_mm", "y_mm", "force_n", "edge_force_n")

MAX_LENGTH_RATIO = {"edge_distance_mm": 2.0, "depth_mm": 0.6, "finger_radius_mm": 0.2}
"""The maximum plausible ratio of a length to the sheet's width, by column of the CSV file.

A larger length is probably in another unit.
"""


def read_rows(
    path: Path, sheet: SheetSpec, finger_radius_m: float
) -> tuple[list[MeasuredPush], list[int]]:
    """Read measured pushes from a CSV file, and return them with their line numbers.

    The first line contains the names of the columns. The columns `depth_mm` and `force_n` are
    required. One of the columns `edge_distance_mm` and `stretch_ratio` (edge distance divided by
    the scene's sheet width) is also required. The columns `x_mm` and `y_mm` (relative to the
    sheet's centre), `edge_force_n`, `finger_radius_mm` and `unloading` (1 if the finger was deeper
    before, else 0) are optional. Empty lines and lines that start with # are skipped.

    finger_radius_m: radius that is used if the file has no column `finger_radius_mm`.

    Raises BadInputError if the file is invalid.
    """
    table = read_table(path, REQUIRED, permitted=COLUMNS)
    if sum(name in table.columns for name in STRETCH) != 1:
        what = f"expected one of the columns {' and '.join(STRETCH)}"
        raise BadInputError.single(table.where, (), what, "use exactly one")
    pushes: list[MeasuredPush] = []
    numbers: list[int] = []
    for number, cells in table.rows:
        found: list[Problem] = []
        values = _parse_row(f"{path}:{number}", cells, sheet, found)
        if found:
            table.problems.extend(found)
        else:
            pushes.append(_make_push(values, sheet, finger_radius_m))
            numbers.append(number)
    table.check()
    if not pushes:
        raise BadInputError.single(str(path), (), "does not contain rows", "add one line per push")
    return pushes, numbers


def _parse_row(
    where: str, cells: Mapping[str, str], sheet: SheetSpec, problems: list[Problem]
) -> dict[str, float]:
    """Convert the values in a row of the CSV file to numbers by column.

    Append a problem to `problems` for each wrong value.
    """
    values: dict[str, float] = {}
    for name, text in cells.items():
        if not text and name in OPTIONAL:
            continue
        value = parse_finite(where, name, text, problems)
        if math.isnan(value):
            continue
        what = _find_problem(name, value, sheet)
        if what is None:
            values[name] = value
        else:
            problems.append(Problem(where, (name,), *what))
    sides = (("x_mm", 0.5 * MAX_LENGTH_RATIO["edge_distance_mm"] * sheet.width_m),
             ("y_mm", 0.5 * sheet.height_m))  # fmt: skip
    for name, half in sides:
        if abs(1e-3 * values.get(name, 0.0)) >= half:
            problems.append(Problem(where, (name,), f"{values[name]:g} mm is outside the sheet"))
    return values


def _find_problem(name: str, value: float, sheet: SheetSpec) -> tuple[str, str] | None:
    """Return what is wrong with a value in the column `name`, and the remedy, or None."""
    if name == "unloading":
        correct = value in (0.0, 1.0)
        what, remedy = "expected 0 or 1", "write 1 for unloading, or 0 for loading"
    elif name in SIGNED:
        return None
    elif value <= 0.0:
        correct, what, remedy = False, "expected a positive number", "write the magnitude"
    elif name == "stretch_ratio":
        correct = 0.8 < value < 3.0
        what, remedy = "expected a ratio near 1", "write a ratio, such as 1.05"
    else:
        correct = 1e-3 * value <= MAX_LENGTH_RATIO[name] * sheet.width_m
        what = f"expected mm, on a sheet of {1e3 * sheet.width_m:g} mm"
        remedy = "give lengths in mm"
    return None if correct else (f"{what}, found {value:g}", remedy)


def _make_push(values: dict[str, float], sheet: SheetSpec, finger_radius_m: float) -> MeasuredPush:
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
        unloading=bool(values["unloading"]) if "unloading" in values else None,
    )


SIMULATED_DEPTHS_M = (0.002, 0.004, 0.007, 0.012, 0.020, 0.030, 0.040, 0.050)
SIMULATED_STRETCHES = 4


def simulate_rows(
    scene: Scene,
    *,
    noise_n: float,
    seed: int,
    apparatus: Apparatus | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[MeasuredPush]:
    """Simulate measured pushes of a finger into the sheet at all stretches and depths of a scene.

    There is one push at each depth. If the rubber has hysteresis, there are two pushes at each
    depth, one for loading and one for unloading.

    noise_n: standard deviation of the noise of the contact force, N. The noise of the edge force is
        ten times as large.
    apparatus: true parameters of the arms and the sheet. If None, the scene's parameters are used.
    progress: function that is called after each stretch. Its arguments are the number of
        finished stretches and the number of all stretches.
    """
    rng = np.random.default_rng(seed)
    sheet = SimulatedSheet(scene, apparatus or nominal_apparatus(scene))
    radius_m = scene.finger.radius_m
    pushes: list[MeasuredPush] = []
    stretches = np.linspace(
        max(scene.sheet.min_stretch_ratio, 1.005),
        scene.sheet.max_stretch_ratio,
        SIMULATED_STRETCHES,
    )
    most_m = scene.working_range.push_depth_m + 1e-9
    depths_m = [depth_m for depth_m in SIMULATED_DEPTHS_M if depth_m <= most_m]
    for done, stretch in enumerate(stretches.tolist(), start=1):
        distance_m = stretch * scene.sheet.width_m
        pushed = sheet.push(distance_m, depths_m, (0.0, 0.0), radius_m)
        for depth_m, (forces_n, edge_force_n) in zip(depths_m, pushed, strict=True):
            hysteresis = forces_n[0] != forces_n[1]
            for force_n, unloading in zip(forces_n, (False, True), strict=True):
                if unloading and not hysteresis:
                    continue
                pushes.append(
                    MeasuredPush(
                        edge_distance_m=distance_m,
                        depth_m=depth_m,
                        force_n=force_n + float(rng.normal(0.0, noise_n)),
                        finger_radius_m=radius_m,
                        edge_force_n=edge_force_n + float(rng.normal(0.0, 10.0 * noise_n)),
                        unloading=unloading if hysteresis else None,
                    )
                )
        progress(done, len(stretches))
    return pushes
