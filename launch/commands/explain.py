"""`flexsheet explain`: print the meaning and the remedy of an error or of a node's note.

A note is a short text in a node's status. It describes a problem of the node.
"""

from __future__ import annotations

import pkgutil
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer

from flexsheet.launch.commands.options import JsonOption, make_app
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_fields,
    print_json,
)
from flexsheet.messages.errors import FlexsheetError

app = make_app()

PACKAGES = ("messages", "nodes", "launch")
MAX_ENTRIES = 3
MIN_WORD_LETTERS = 3
MIN_SHARED_WORDS = 2
"""The minimum number of words that a text must share with an explanation to match it inexactly."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An explanation of one kind of error or note.

    code: error code, or text of a note.
    name: name of the error class, or an empty text.
    phrase: text that all notes of this kind contain, or an empty text.
    """

    code: str
    meaning: str
    remedy: str
    name: str = ""
    phrase: str = ""


@cache
def entries() -> tuple[Entry, ...]:
    """Return the explanations of all errors, notes of nodes, and texts of the console."""
    from flexsheet.messages.notes import (
        FINGERTIP_REMEDIES,
        SELF_CHECK_FINDINGS,
        SELF_CHECK_REMEDIES,
        SHEET_REASON_REMEDIES,
        SHEET_REASON_TEXTS,
        NodeNote,
    )

    for package in PACKAGES:
        root = import_module(f"flexsheet.{package}")
        for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            import_module(module.name)
    errors = {kind.code: kind for kind in _subclasses(FlexsheetError)}
    tables: tuple[tuple[dict[Any, str], dict[Any, str]], ...] = (
        ({}, FINGERTIP_REMEDIES),
        (SHEET_REASON_TEXTS, SHEET_REASON_REMEDIES),
        (SELF_CHECK_FINDINGS, SELF_CHECK_REMEDIES),
    )
    return (
        *(
            Entry(code, _meaning(kind), kind.remedy, name=kind.__name__)
            for code, kind in sorted(errors.items())
        ),
        *(Entry(note.code, note.phrase, note.remedy, phrase=note.phrase) for note in NodeNote),
        *(
            Entry(code, texts.get(code, ""), remedy, phrase=texts.get(code, ""))
            for texts, remedies in tables
            for code, remedy in remedies.items()
        ),
    )


def _subclasses(kind: type[FlexsheetError]) -> Iterator[type[FlexsheetError]]:
    for derived in kind.__subclasses__():
        if derived.__module__.startswith("flexsheet."):
            yield derived
        yield from _subclasses(derived)


def _meaning(kind: type[FlexsheetError]) -> str:
    return " ".join((kind.__doc__ or "").split("\n\n")[0].split())


def find_entries(text: str) -> list[Entry]:
    """Return the explanations of a code, a class name or an error text, with the best match first.

    If the text contains no class name and no phrase, it is compared word by word. An explanation
    matches if it shares at least MIN_SHARED_WORDS words with the text. Rare words have more weight.
    """
    code = text.replace(" ", "_")  # the console shows the codes of fingertips with spaces
    if exact := [one for one in entries() if text in (one.code, one.name) or one.code == code]:
        return exact
    words = _words(text)
    named = [entry for entry in entries() if entry.name and entry.name.lower() in words]
    contained = [entry for entry in entries() if entry.phrase and entry.phrase in text]
    contained.sort(key=lambda entry: -len(entry.phrase))
    if named or contained:
        return named + contained
    known = {entry: _words(f"{entry.code} {entry.meaning} {entry.remedy}") for entry in entries()}
    frequency = Counter(word for one in known.values() for word in one)
    near = {
        entry: sum(1 / frequency[word] for word in shared)
        for entry, one in known.items()
        if len(shared := words & one) >= MIN_SHARED_WORDS
    }
    return sorted(near, key=lambda entry: -near[entry])


def _words(text: str) -> set[str]:
    return {word for word in re.findall(r"\w+", text.lower()) if len(word) >= MIN_WORD_LETTERS}


@app.command(
    epilog=examples(
        "flexsheet explain bag",
        "flexsheet explain saturated --json",
        "flexsheet explain 'topic arm_left: host left rejects the key of this host'",
    )
)
def explain(
    message: Annotated[
        str,
        typer.Argument(help="Text, code or class name of an error, or text of a note of a node."),
    ],
    as_json: JsonOption = False,
) -> None:
    """Print the meaning and the remedy of an error or a note. docs/errors.md lists all errors."""
    found = [
        {"code": one.code, "meaning": one.meaning, "remedy": one.remedy}
        for one in find_entries(message)[:MAX_ENTRIES]
    ]
    if as_json:
        print_json(found)
    for number, entry in enumerate(() if as_json else found):
        if number:
            print()
        print_fields(entry.items())
    if not found:
        raise CommandError(
            f'"{message}": no error or note matches; choose a code in docs/errors.md', FAILED
        )
