"""Print command results on stdout and messages for the user on stderr, and define exit codes."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

from flexsheet.launch.methods.results import replace_non_finite
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.units import UNITS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

FAILED, BAD_INPUT, NOT_GOOD = 1, 2, 3
"""The exit codes of a failure, of invalid input, and of a completed command with a bad result."""

PROGRESS_LINE_S = 2.0
"""The minimum time (s) between two printed progress lines if stderr is not a terminal."""


class CommandError(FlexsheetError):
    """Raised if a command cannot do what the user requests.

    It ends the command with an error text and an exit code.
    """

    def __init__(self, text: str, exit_code: int = BAD_INPUT) -> None:
        super().__init__(text)
        self.exit_code = exit_code


class Words:
    """A printer of messages for the user on stderr.

    Colours and status lines are used only in terminals. The environment variable NO_COLOR disables
    colours. The module rich is imported with the first message, because its import is slow.
    """

    @cached_property
    def console(self) -> Console:
        from rich.console import Console

        return Console(stderr=True, highlight=False, soft_wrap=True)

    @property
    def is_terminal(self) -> bool:
        """Return whether stderr is a terminal in which printed lines can be replaced."""
        return self.console.is_interactive

    @property
    def in_colour(self) -> bool:
        return self.console.color_system is not None and not self.console.no_color

    def print(self, text: str, *, markup: bool = False, style: str | None = None) -> None:
        self.console.print(text, markup=markup, style=style)

    def status(self, text: str) -> Status:
        """Return a context manager that shows a status line if stderr is a terminal."""
        return self.console.status(text)


words = Words()

EXAMPLES = "[bold]Examples[/]"


def examples(*lines: str) -> str:
    """Format example command lines for the end (epilog) of a command's help."""
    return "\n".join([EXAMPLES, *(line.replace("[", r"\[") for line in lines)])


def examples_in(epilog: str | None) -> list[str]:
    """Return the example command lines in the epilog of a command's help."""
    heading, *lines = (epilog or "").split("\n")
    return [line.replace(r"\[", "[") for line in lines] if heading == EXAMPLES else []


def print_json(data: Any) -> None:
    """Print a JSON document on stdout; NaN and infinity become null."""
    print(json.dumps(replace_non_finite(data), indent=2, allow_nan=False))


def print_json_line(data: Any) -> None:
    """Print a JSON document on one line of stdout and flush it; NaN and infinity become null."""
    print(json.dumps(replace_non_finite(data), allow_nan=False), flush=True)


def print_outcome(data: Any, text: str, *, as_json: bool) -> None:
    """Print data as JSON on stdout, or a text for the user on stderr."""
    if as_json:
        print_json(data)
    else:
        words.print(text)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table on stdout; wrap the text in cells if the table is wider than the terminal."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(columns, *cells, strict=True)]
    in_terminal = sys.stdout.isatty()
    if in_terminal and sum(widths) + 2 * len(widths) - 2 > shutil.get_terminal_size().columns:
        _print_folded(columns, cells)
        return
    for number, row in enumerate((columns, *cells)):
        padded = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        line = "  ".join(padded).rstrip()
        print(f"\x1b[1m{line}\x1b[0m" if in_terminal and number == 0 else line)


def shown(value: float | None, form: str = ".3g") -> str:
    """Format a number; return "-" for None."""
    return "-" if value is None else format(value, form)


def print_columns(
    rows: Iterable[Mapping[str, Any]], columns: Mapping[str, tuple[str, str]]
) -> None:
    """Print a table with selected values of the rows; None is shown as "-".

    columns: for each heading, the key and the format of the values in the column.
    """
    print_table(
        list(columns),
        [[shown(row[key], form) for key, form in columns.values()] for row in rows],
    )


def print_rows(rows: Sequence[Mapping[str, Any]], *, as_json: bool, digits: int = 4) -> None:
    """Print rows with the same keys on stdout, as JSON or as a table.

    In a table, None is shown as "-", and truth values are shown as "yes" or "no".

    digits: number of significant digits in a table.
    """
    if as_json:
        print_json(rows)
    elif rows:
        columns = dict.fromkeys(name for row in rows for name in _flatten(row))
        table = [_flatten(row) for row in rows]
        cells = [[_show(row.get(name), digits) for name in columns] for row in table]
        print_table(list(columns), cells)


def _flatten(row: Mapping[str, Any]) -> dict[str, Any]:
    """Replace nested mappings by their values, with names such as "interval_ms p50"."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            flat |= {f"{name} {inner}": each for inner, each in value.items()}
        else:
            flat[name] = value
    return flat


def _show(value: Any, digits: int) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    if isinstance(value, list | tuple):
        return ", ".join(_show(one, digits) for one in value)
    return "-" if value is None else str(value)


def _print_folded(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console(highlight=False).print(table)


def print_fields(rows: Iterable[tuple[str, object]]) -> None:
    """Print names and values on stdout, with one pair per line."""
    pairs = [(name, str(value)) for name, value in rows]
    width = max(len(name) for name, _ in pairs)
    for name, value in pairs:
        print(f"{name:<{width}}  {value}".rstrip())


SHOWN_UNITS = {"m": (1e3, "mm"), "m/N": (1e6, "µm/N"), "rad": (math.degrees(1.0), "°")}
"""The factor by which printed values in an SI unit are multiplied, and the printed unit.

The keys are SI units. Values in other units are not converted.
"""


def print_result(result: Mapping[str, Any], *, as_json: bool) -> None:
    """Print a result on stdout, as JSON or as one line for each of its values.

    If the result is printed as lines, lengths are in mm and angles are in degrees. Missing values
    are then omitted.
    """
    if as_json:
        print_json(result)
    else:
        print_fields(_list_values(replace_non_finite(result)))


def _list_values(
    values: Mapping[str, Any], prefix: str = "", outer_unit: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield a label and a formatted text for each value in nested mappings.

    The suffix of a value's name, such as `_m`, determines the unit. The unit of names without such
    a suffix is `outer_unit`. Values that are None are omitted.
    """
    for name, value in values.items():
        suffix = next((one for one in UNITS if name.endswith(one)), "")
        si_unit = UNITS.get(suffix, outer_unit)
        label = name if si_unit == "1" else name.removesuffix(suffix)
        label = prefix + (label.replace("_", " ") if name.isidentifier() else label)
        if isinstance(value, Mapping):
            yield from _list_values(value, f"{label} ", si_unit)
        elif value is not None:
            factor, unit = SHOWN_UNITS.get(si_unit, (1.0, si_unit.removeprefix("1")))
            yield label, f"{_show(_scale(value, factor), 5)} {unit}".rstrip()


def _scale(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scale(one, factor) for one in value]
    return factor * value if isinstance(value, float) else value


@contextmanager
def progress_words() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a progress message with the elapsed time on stderr.

    If stderr is not a terminal, the function prints one line per message.
    """
    if not words.is_terminal:
        yield words.print
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    # Results on stdout are printed above the progress line, unless stdout is a file or a pipe.
    with Progress(*columns, console=words.console, redirect_stdout=sys.stdout.isatty()) as bar:
        task = bar.add_task("", total=None)
        yield lambda text: bar.update(task, description=text)


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """Show a progress bar on stderr, and yield a function (done, total, text) that updates it.

    The optional text replaces the label in a terminal. If stderr is not a terminal, the progress is
    printed in lines. There is one line for every 5 %, but at most one line in PROGRESS_LINE_S
    seconds.
    """
    if not words.is_terminal:
        printed_s, printed = time.monotonic(), 0.0

        def print_line(done: float, total: float, _: str = "") -> None:
            nonlocal printed_s, printed
            due = time.monotonic() - printed_s >= PROGRESS_LINE_S
            if due and total > 0.0 and done / total - printed >= 0.05:
                printed_s, printed = time.monotonic(), done / total
                words.print(f"{label}: {100.0 * done / total:.0f} %")

        yield print_line
        return
    from rich.progress import Progress

    with Progress(console=words.console, transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total, text=label: bar.update(
            task, completed=done, total=total, description=text
        )


def logs_on_stderr() -> None:
    """Direct the log of a command, which contains warnings and errors, to stderr.

    By default, structlog writes to stdout, which is reserved for results. Call this function before
    any logger is created.
    """
    import logging

    import structlog

    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING),
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.dev.ConsoleRenderer(colors=words.in_colour),
        ],
        # Look up sys.stderr for each line, because a caller may replace it.
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
    )
