"""`flexsheet explain`: print the meaning and the remedy of an error or of a node's note.

A note is a short text in a node's status. It describes a problem of the node.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from flexsheet.launch.commands.options import JsonOption, make_app
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_fields,
    print_json,
    print_table,
    words,
)

app = make_app()

RAISED_IF = re.compile(r"(?:The error raised|Raised) (?:if|after) ")
"""The beginning of an error class's docstring, which does not concern users."""

LAYERS = ("messages", "nodes", "launch")


@dataclass(frozen=True, slots=True)
class Entry:
    """An explanation of one kind of error or note.

    code: code of an error or note.
    name: name of the error class, or an empty text.
    phrase: text that all errors or notes of this kind contain, or an empty text.
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
        FINGERTIP_REASON_TEXTS,
        FINGERTIP_REMEDIES,
        SELF_CHECK_FINDINGS,
        SELF_CHECK_REMEDIES,
        SHEET_REASON_REMEDIES,
        SHEET_REASON_TEXTS,
    )

    tables: tuple[tuple[dict[Any, str], dict[Any, str]], ...] = (
        (SHEET_REASON_TEXTS, SHEET_REASON_REMEDIES),
        (SELF_CHECK_FINDINGS, SELF_CHECK_REMEDIES),
    )
    return (
        *_error_entries(),
        *(
            Entry(code, FINGERTIP_REASON_TEXTS[code], remedy)
            for code, remedy in FINGERTIP_REMEDIES.items()
        ),
        *(
            Entry(code, texts[code], remedy, phrase=texts[code])
            for texts, remedies in tables
            for code, remedy in remedies.items()
        ),
    )


def _error_entries() -> list[Entry]:
    """Return the explanations of all error classes, sorted by code.

    The classes are read from the source files, because importing all modules takes seconds.
    """
    root = Path(__file__).resolve().parents[2]
    found = []
    for path in (path for layer in LAYERS for path in (root / layer).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "    remedy = " not in source:
            continue
        for statement in ast.parse(source).body:
            if not isinstance(statement, ast.ClassDef):
                continue
            values = {
                one.targets[0].id: one.value
                for one in statement.body
                if isinstance(one, ast.Assign) and isinstance(one.targets[0], ast.Name)
            }
            if not {"code", "remedy"} <= values.keys():
                continue
            texts = {
                key: str(ast.literal_eval(values[key]))
                for key in ("code", "remedy", "phrase")
                if key in values
            }
            described = (ast.get_docstring(statement) or "").split("\n\n")[0]
            meaning = state_problem(" ".join(described.split()))
            found.append(Entry(meaning=meaning, name=statement.name, **texts))
    return sorted(found, key=lambda entry: entry.code)


def state_problem(described: str) -> str:
    """Return the problem that the docstring of an error class describes, as a sentence.

    For example, "Raised if a bag cannot be read." becomes "A bag cannot be read.".
    """
    problem = RAISED_IF.sub("", described)
    return problem[:1].upper() + problem[1:]


def find_entries(text: str) -> list[Entry]:
    """Return the explanations of an error or a note.

    text: code of the error or note, name of the error class, or a text that a program has printed.
        A printed text matches if it contains the name of an error class, or the characteristic
        phrase of an error or a note.

    If a matching phrase is part of another matching phrase, only the longer phrase is used.
    Explanations with longer phrases are listed first.
    """
    code = text.replace(" ", "_")  # the console shows the codes of fingertips with spaces
    if exact := [one for one in entries() if text in (one.code, one.name) or one.code == code]:
        return exact
    words = set(re.findall(r"\w+", text))
    named = [entry for entry in entries() if entry.name in words]
    contained = [entry for entry in entries() if entry.phrase and _contains(text, entry.phrase)]
    specific = [
        entry
        for entry in contained
        if not any(
            entry.phrase != other.phrase and entry.phrase in other.phrase for other in contained
        )
    ]
    specific.sort(key=lambda entry: -len(entry.phrase))
    return named + [entry for entry in specific if entry not in named]


def _contains(text: str, phrase: str) -> bool:
    """Return whether a text contains a phrase as whole words."""
    return re.search(rf"(?<!\w){re.escape(phrase)}(?!\w)", text) is not None


def _suggestion(text: str) -> str:
    near = get_close_matches(text, [one.code for one in entries()], n=1)
    return f'did you mean "{near[0]}"? ' if near else ""


@app.command(
    epilog=examples(
        "flexsheet explain",
        "flexsheet explain bag",
        "flexsheet explain saturated --json",
        "flexsheet explain 'host left rejects the key of this host; check its launch file'",
    )
)
def explain(
    message: Annotated[
        str | None,
        typer.Argument(
            help="Code or class name of an error, or text of a note of a node; without it, all "
            "codes are listed."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the meaning and the remedy of an error or a note, or list all codes."""
    found = entries() if message is None else find_entries(message)
    if not found:
        raise CommandError(
            f'"{message}": no error or note matches; {_suggestion(str(message))}'
            "`flexsheet explain` lists all codes, and `flexsheet logs NODE` prints a node's errors",
            FAILED,
        )
    rows = [{"code": one.code, "meaning": one.meaning, "remedy": one.remedy} for one in found]
    if as_json:
        print_json(rows)
    elif message is None:
        print_table(("code", "meaning"), [(one.code, _first_sentence(one)) for one in found])
        words.print("to print the remedy: flexsheet explain CODE")
    else:
        for number, row in enumerate(rows):
            if number:
                print()
            print_fields(row.items())


def _first_sentence(entry: Entry) -> str:
    first, *more = entry.meaning.split(". ", 1)
    return f"{first}." if more else first
