"""Read CSV files with measurements, and report errors with line and column."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.messages.types import Side

SIDES: tuple[Side, Side] = ("left", "right")

MAX_PROBLEMS = 20
"""The maximum number of problems in a file that are listed. Further problems are only counted."""


@dataclass(frozen=True, slots=True)
class Table:
    """The cells of a CSV file.

    where: location of the header, as FILE:LINE.
    columns: names of the columns.
    rows: line number and cells by column of each row.
    problems: rows with a wrong number of cells, which `rows` omits. Further problems of the rows
        are to be appended.
    """

    path: Path
    where: str
    columns: list[str]
    rows: list[tuple[int, dict[str, str]]]
    problems: list[Problem]

    def check(self) -> None:
        """Raise BadInputError if there are problems."""
        shown = self.problems[:MAX_PROBLEMS]
        if len(shown) < len(self.problems):
            more = len(self.problems) - len(shown)
            shown.append(Problem(str(self.path), (), f"and {more} more"))
        if shown:
            raise BadInputError(shown)


def read_table(
    path: Path, required: Sequence[str], *, permitted: Sequence[str] | None = None
) -> Table:
    """Read a CSV file. Empty lines and lines that start with # are skipped.

    required: names of all columns that must be present.
    permitted: names of all permitted columns; None: all names are permitted.

    Raises BadInputError if the file cannot be read, is empty, or has wrong columns.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        lines = [
            (number, [cell.strip() for cell in next(csv.reader([line]))])
            for number, line in enumerate(text.splitlines(), start=1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
    except OSError as error:
        raise BadInputError.single(
            str(path), (), f"cannot be read: {error.strerror}", "check the path and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise BadInputError.single(
            str(path), (), f"is not a text file: {error}", "save it as CSV with UTF-8 text"
        ) from error
    except csv.Error as error:
        raise BadInputError.single(
            str(path), (), f"is not a CSV file: {error}", "separate the values of a row by commas"
        ) from error
    if not lines:
        remedy = f"start with a line of columns: {', '.join(permitted or required)}"
        raise BadInputError.single(str(path), (), "is empty", remedy)
    (first, columns), *rows = lines
    where = f"{path}:{first}"
    problems = [
        Problem(where, (name,), "unknown column", did_you_mean(name, permitted))
        for name in columns
        if permitted is not None and name not in permitted
    ]
    problems += [
        Problem(where, (name,), "duplicate column", "remove one")
        for name in dict.fromkeys(columns)
        if columns.count(name) > 1
    ]
    problems += list_missing(where, columns, required)
    if problems:
        raise BadInputError(problems)
    return Table(
        path=path,
        where=where,
        columns=columns,
        rows=[
            (number, dict(zip(columns, cells, strict=True)))
            for number, cells in rows
            if len(cells) == len(columns)
        ],
        problems=[
            Problem(
                f"{path}:{number}",
                (),
                f"expected {len(columns)} values, found {len(cells)}",
                "give one value per column",
            )
            for number, cells in rows
            if len(cells) != len(columns)
        ],
    )


def list_missing(where: str, columns: Sequence[str], wanted: Sequence[str]) -> list[Problem]:
    """Return a problem for each wanted column that is missing in the header of a file.

    where: location of the header.
    columns: names of the columns in the header.
    """
    return [
        Problem(where, (name,), "missing column", "add it")
        for name in wanted
        if name not in columns
    ]


def parse_side(where: str, name: str, text: str, problems: list[Problem]) -> Side:
    """Convert the text in the column `name` to the side "left" or "right".

    If the text is neither "left" nor "right", append a problem to `problems` and return "left".
    """
    for side in SIDES:
        if text == side:
            return side
    what = f'expected left or right, found "{text}"'
    problems.append(Problem(where, (name,), what, "write left or right"))
    return SIDES[0]


def parse_finite(where: str, name: str, text: str, problems: list[Problem]) -> float:
    """Convert the text in the column `name` to a number.

    If the text is not a finite number, append a problem to `problems` and return NaN.
    """
    try:
        value = float(text)
    except ValueError:
        what, remedy = f'expected a number, found "{text}"', "write a number, such as 12.5"
    else:
        if math.isfinite(value):
            return value
        what = f'expected a finite number, found "{text}"'
        remedy = "measure this row again, or remove it"
    problems.append(Problem(where, (name,), what, remedy))
    return math.nan
