"""From a bag to the report's file and numbers."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from launch.report.findings import findings_of
from launch.report.numbers import numbers_of
from launch.report.page import MARK, page_of
from launch.report.session import Progress, Session, read_session
from messages.bag import BagError


def default_output(bag: Path) -> Path:
    """Beside the bag, named after it."""
    return bag.with_suffix(".html")


def report(bag: Path, output: Path | None, progress: Progress) -> dict[str, Any]:
    """Read the bag, write its page to `output` (None: no page), and return the numbers.

    Raises BagError for a bag of which nothing can be read, and for a file that cannot be written or
    is something else than an earlier report.
    """
    if output is not None:
        _check(output)
    session = read_session(bag, progress)
    if output is not None:
        try:
            output.write_text(page_of(session), encoding="utf-8")
        except OSError as error:
            raise BagError(f"{output}: cannot be written: {error.strerror}") from error
    return result_of(session)


def result_of(session: Session) -> dict[str, Any]:
    """The numbers, with what was found in them."""
    numbers = numbers_of(session)
    return {"findings": [asdict(one) for one in findings_of(numbers)], **numbers}


def _check(output: Path) -> None:
    if not output.exists():
        return
    try:
        with output.open(encoding="utf-8", errors="replace") as file:
            head = file.read(200)
    except OSError as error:
        raise BagError(f"{output}: cannot be written: {error.strerror}") from error
    if MARK not in head:
        raise BagError(
            f"{output}: exists already and is no report, so it is not written over; name another "
            "file with -o"
        )
