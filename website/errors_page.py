"""Generate the tables of errors from the error classes and the catalogue of notes."""

from __future__ import annotations

from collections.abc import Iterable

from flexsheet.launch.commands.explain import entries
from flexsheet.messages.notes import FINGERTIP_REMEDIES, SELF_CHECK_FINDINGS, SELF_CHECK_REMEDIES


def render() -> str:
    """Return the tables of errors, notes, reasons and causes."""
    errors = [entry for entry in entries() if entry.name]
    notes = [entry for entry in entries() if entry.phrase]
    return "\n".join(
        [
            "## Errors of commands and nodes\n",
            _table("code", ((entry.code, entry.meaning, entry.remedy) for entry in errors)),
            "## Notes of nodes\n",
            _table("code", ((entry.code, f"`{entry.phrase}`", entry.remedy) for entry in notes)),
            "## Reasons of an invalid fingertip\n",
            _table("`reason`", FINGERTIP_REMEDIES.items()),
            "## Causes that self-checks suspect\n",
            _table(
                "`cause`",
                (
                    (cause, finding, SELF_CHECK_REMEDIES[cause])
                    for cause, finding in SELF_CHECK_FINDINGS.items()
                ),
            ),
        ]
    )


def _table(first: str, rows: Iterable[tuple[str, ...]]) -> str:
    cells = [(f"`{code}`", *rest) for code, *rest in rows]
    titles = (first, "meaning", "what to do") if len(cells[0]) == 3 else (first, "what to do")
    lines = [titles, ("---",) * len(titles), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
