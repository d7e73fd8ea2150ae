"""Write the report of a bag as an HTML page, and return the numbers in the report."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flexsheet.launch.bags.report.findings import find_problems
from flexsheet.launch.bags.report.numbers import compute_numbers
from flexsheet.launch.bags.report.page import MARK, render_page
from flexsheet.launch.bags.report.session import Progress, Session, read_session
from flexsheet.messages.bag import BagError
from flexsheet.messages.files import DISK_ERRORS, make_write_error


def default_output(bag: Path) -> Path:
    """Return the default path of the report: the path of the bag with the suffix .html."""
    return bag.with_suffix(".html")


def report(bag: Path, output: Path | None, progress: Progress) -> dict[str, Any]:
    """Read a bag, write its report as an HTML page, and return the numbers in the report.

    output: path of the page, or None if no page is to be written.

    Raises BagError if the bag cannot be read or the page cannot be written. Raises BagError also if
    `output` exists and is not a report.
    """
    if output is not None:
        _check(output)
    session = read_session(bag, progress)
    if output is not None:
        page, draft = render_page(session), _draft_path(output)
        try:
            draft.write_text(page, encoding="utf-8")
            draft.replace(output.resolve())
        except OSError as error:
            raise _unwritable(output, error) from error
        finally:
            draft.unlink(missing_ok=True)
    return make_result(session)


def make_result(session: Session) -> dict[str, Any]:
    """Return the numbers and the problems of a recorded session, for `bag report --json`."""
    numbers = compute_numbers(session)
    return {"findings": [asdict(one) for one in find_problems(numbers)], **numbers}


def _draft_path(output: Path) -> Path:
    """Return a temporary path for the page, so that readers never see an incomplete page."""
    path = output.resolve()
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def _check(output: Path) -> None:
    """Raise BagError if the page cannot be written or would replace a file that is not a report.

    The check is made before the bag is read, because reading can take long.
    """
    draft = _draft_path(output)
    try:
        draft.touch()
        draft.unlink()
        if not output.exists():
            return
        with output.open(encoding="utf-8", errors="replace") as file:
            head = file.read(200)
    except OSError as error:
        raise _unwritable(output, error) from error
    if MARK not in head:
        raise BagError(
            f"{output}: the file is not a report, so it is not overwritten; give another "
            "file with -o"
        )


def _unwritable(output: Path, error: OSError) -> BagError:
    if error.errno in DISK_ERRORS:
        return BagError(str(make_write_error(output, error)))
    return BagError(
        f"{output}: cannot be written: {error.strerror or error}; give a file in a writable "
        "folder with -o"
    )
