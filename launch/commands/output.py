"""How commands speak: data on stdout, words on stderr, exit codes that mean something."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

words = Console(stderr=True, highlight=False, soft_wrap=True)

FAILED, BAD_INPUT, OTHER_THAN_LIVE = 1, 2, 3


class CommandError(Exception):
    """Ends a command with a sentence and an exit code."""

    def __init__(self, text: str, code: int = FAILED) -> None:
        super().__init__(text)
        self.code = code


def print_json(data: Any) -> None:
    """One JSON document on stdout."""
    print(json.dumps(data, indent=2))


def print_json_line(data: Any) -> None:
    """One JSON document on one line of stdout, at once."""
    print(json.dumps(data), flush=True)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table on stdout; as wide as it needs to be where stdout is no terminal."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*(str(cell) for cell in row))
    console = Console(highlight=False)
    if not sys.stdout.isatty():
        console = Console(highlight=False, width=200)
    console.print(table)


def print_fields(rows: Iterable[tuple[str, object]]) -> None:
    """Names and values on stdout, one pair a line."""
    pairs = [(name, str(value)) for name, value in rows]
    width = max(len(name) for name, _ in pairs)
    for name, value in pairs:
        print(f"{name:<{width}}  {value}")


@contextmanager
def progress_words() -> Iterator[Callable[[str], None]]:
    """Shows on stderr what is being done and since when; a line each where it is no terminal."""
    if not words.is_terminal:
        yield lambda text: words.print(text, markup=False)
        return
    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=words) as bar:
        task = bar.add_task("", total=None)
        yield lambda text: bar.update(task, description=text)
