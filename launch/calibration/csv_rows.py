"""Read CSV files with measurements, and report errors with line and column."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.messages.types import Side

SIDES: tuple[Side, Side] = ("left", "right")


def read_rows(path: Path, columns: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return (location, values by column) for each row of a CSV file.

    The location has the form FILE:LINE.

    columns: names of all required columns.

    Raises BadInputError if the file cannot be read, or if a column is missing.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="")
            rows = [(f"{path}:{reader.line_num}", row) for row in reader]
            found = tuple(reader.fieldnames or ())
    except OSError as error:
        raise _unreadable(path, error) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInputError.single(str(path), (), f"{error}", "give a CSV file in UTF-8") from error
    missing = list_missing(str(path), found, columns)
    if missing:
        raise BadInputError(missing)
    return rows


def _unreadable(path: Path, error: OSError) -> BadInputError:
    return BadInputError.single(
        str(path), (), f"cannot be read: {error.strerror}", "check the path"
    )


def read_table(
    path: Path,
    columns: Sequence[str],
    check_header: Callable[[str, Sequence[str]], list[Problem]],
    problems: list[Problem],
) -> list[tuple[int, dict[str, str]]]:
    """Return (line number, values by column) for each row of a CSV file.

    Empty lines and lines that start with # are skipped. If a row has a wrong number of values, the
    row is omitted and a problem is appended to `problems`.

    columns: names of all permitted columns.
    check_header: function that returns further problems of the header. Its arguments are the
        location of the header and the column names in the file.

    Raises BadInputError if the file cannot be read, is empty, or has wrong columns.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise _unreadable(path, error) from error
    except UnicodeDecodeError as error:
        raise BadInputError.single(str(path), (), f"{error}", "give a CSV file in UTF-8") from error
    lines = [
        (number, [cell.strip() for cell in next(csv.reader([line]))])
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        remedy = f"start with a line of columns: {', '.join(columns)}"
        raise BadInputError.single(str(path), (), "is empty", remedy)
    (first, names), *rows = lines
    where = f"{path}:{first}"
    wrong = [
        Problem(where, (name,), "unknown column", did_you_mean(name, columns))
        for name in names
        if name not in columns
    ]
    wrong += [
        Problem(where, (name,), "duplicate column", "remove one")
        for name in dict.fromkeys(names)
        if names.count(name) > 1
    ]
    wrong += check_header(where, names)
    if wrong:
        raise BadInputError(wrong)
    for number, cells in rows:
        if len(cells) != len(names):
            what = f"expected {len(names)} values, found {len(cells)}"
            problems.append(Problem(f"{path}:{number}", (), what, "give one value per column"))
    return [
        (number, dict(zip(names, cells, strict=True)))
        for number, cells in rows
        if len(cells) == len(names)
    ]


def list_missing(where: str, names: Sequence[str], wanted: Sequence[str]) -> list[Problem]:
    """Return a problem for each wanted column that is missing in the header of a file.

    where: location of the header.
    names: column names in the header.
    """
    return [
        Problem(where, (name,), "missing column", "add it") for name in wanted if name not in names
    ]


def parse_side(where: str, name: str, text: str, problems: list[Problem]) -> Side:
    """Convert the text in the column `name` to the side "left" or "right".

    If the text is neither "left" nor "right", append a problem to `problems` and return "left".
    """
    for side in SIDES:
        if text.strip() == side:
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
        value = math.nan
    if not math.isfinite(value):
        what = f'expected a finite number, found "{text}"'
        problems.append(Problem(where, (name,), what, "measure this row again, or remove it"))
    return value
