"""Read the rows of CSV files with measurements, and report mistakes with line and column."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from flexsheet.launch.plans.documents import BadInputError, Problem


def read_rows(path: Path, columns: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return each row of a CSV file with its location, FILE:LINE.

    Raises BadInputError if the file cannot be read, or if one of the columns is missing.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="")
            rows = [(f"{path}:{reader.line_num}", row) for row in reader]
            found = tuple(reader.fieldnames or ())
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInputError(
            [Problem(str(path), (), f"cannot be read: {error}", "give a CSV file in UTF-8")]
        ) from error
    missing = [name for name in columns if name not in found]
    if missing:
        raise BadInputError([Problem(str(path), (x,), "missing column", "add it") for x in missing])
    return rows


def parse_finite(where: str, name: str, text: str, problems: list[Problem]) -> float:
    """Return the number in a column; append a problem if it is not a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        what = f'expected a finite number, found "{text}"'
        problems.append(Problem(where, (name,), what, "measure this row again, or remove it"))
    return value
