"""Writes docs/errors.md: every message that says what is wrong, read from the code that says it.

python -m flexsheet.launch.reference.errors > docs/errors.md
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import get_args

from flexsheet.launch.reference.remedies import (
    AREAS,
    FINGERTIP,
    PARTICULAR,
    REMEDIES,
    SHEET_TARGET,
    Area,
)
from flexsheet.launch.reference.sentences import FILLED_IN, Said, classes, messages

SHORTEST_MATCH = 8
"""Letters below which the part of a message that somebody gives would fit anything."""
SHORTEST_TEMPLATE = 7
"""Letters of a message's fixed words below which it would fit anything."""

_LEFT_OUT = re.compile(r"\s*(?:\.\.\.|…)\s*")

INTRODUCTION = """\
# Errors

<!-- Written by `python -m flexsheet.launch.reference.errors > docs/errors.md`; a test compares. -->

What each message means and what to do.  `flexsheet explain 'THE MESSAGE'` finds the place for you.
A `<word>` stands for what the message fills in.  Exit codes: 0 done, 1 failed, 2 the input is
wrong, 3 a replay differs from what was live, or `tune` found no method good enough.

A node's messages reach you by `flexsheet launch` (its log), by the `note` of its status
(`flexsheet topic echo status`) and in the console.
"""


def reference() -> str:
    """The whole page."""
    said = messages()
    sections = [INTRODUCTION]
    sections += ["\n".join(f"- [{area.title}](#{anchor(area.title)})" for area in AREAS) + "\n"]
    for area in AREAS:
        mine = [one for one in said if area_of(one.file) is area]
        kinds = sorted({one.kind for one in mine}, key=lambda kind: (kind not in REMEDIES, kind))
        sections.append(f"## {area.title}\n\n{area.about}\n")
        if area.title == "Fingertip":
            sections.append(_table("`reason`", "what to do", FINGERTIP.items()))
        if area.title == "Planner":
            sections.append(_table("`reason`", "what to do", SHEET_TARGET.items()))
        sections += [_section(kind, area, mine) for kind in kinds]
    return "\n".join(sections)


def _section(kind: str, area: Area, said: list[Said]) -> str:
    """Heading, meaning, remedy and messages of one kind within an area."""
    lines = [f"### {kind}", ""]
    if kind in REMEDIES:
        lines += [f"{meaning(kind, area)}  **What to do:** {REMEDIES[kind]}".strip(), ""]
    rows = dict.fromkeys(
        f"- {_code(one.template)}" + (f": {one.remedy}" if one.remedy else "")
        for one in said
        if one.kind == kind and _letters(one.template) >= SHORTEST_TEMPLATE
    )
    return "\n".join([*lines, *rows]) + "\n"


def _table(first: str, second: str, rows: Iterable[tuple[str, str]]) -> str:
    cells = [f"| `{name}` | {text} |" for name, text in rows]
    return "\n".join([f"| {first} | {second} |", "| --- | --- |", *cells]) + "\n"


def _code(template: str) -> str:
    return f"`{template}`" if "`" not in template else f"`` {template} ``"


def anchor(heading: str) -> str:
    """The anchor that GitHub and mkdocs give a heading."""
    return re.sub(r"[^a-z0-9 _-]", "", heading.lower()).replace(" ", "-")


def area_of(file: str) -> Area:
    """The area that a file's messages belong to: that of the longest path that fits."""
    fitting = [(path, area) for area in AREAS for path in area.paths if file.startswith(path)]
    return max(fitting, key=lambda pair: len(pair[0]))[1]


def explain(message: str) -> list[Said]:
    """The messages of the code that `message` may be, the best one first: those that it holds, then
    those that hold it, where it has `SHORTEST_MATCH` letters or more; `...` stands for anything."""
    found: list[tuple[int, Said]] = []
    parts = _LEFT_OUT.split(message.strip().lower())
    part = re.compile(".*?".join(map(re.escape, parts)))
    long_enough = sum(map(len, parts)) >= SHORTEST_MATCH
    for one in messages():
        pattern = ".+?".join(re.escape(part) for part in FILLED_IN.split(one.template))
        letters = _letters(one.template)
        if letters >= SHORTEST_TEMPLATE and re.search(pattern, message, re.DOTALL):
            found.append((letters, one))
        elif long_enough and part.search(one.template.lower()):
            found.append((-letters, one))
    return [one for _, one in sorted(found, key=lambda pair: -pair[0])]


def _letters(template: str) -> int:
    """How many letters of a message are always the same."""
    return sum(len(part.strip()) for part in FILLED_IN.split(template))


def explained(message: str) -> list[dict[str, str]]:
    """What there is to say of a message, of a kind of error, or of a fingertip's reason: the best
    first."""
    if message in FINGERTIP:
        return [{"message": message, "what to do": FINGERTIP[message], "page": _page("Fingertip")}]
    if message in SHEET_TARGET:
        return [{"message": message, "what to do": SHEET_TARGET[message], "page": _page("Planner")}]
    if message in REMEDIES:
        return [_of_kind(message)]
    found: dict[tuple[str, str], dict[str, str]] = {}
    for one in explain(message):
        known = found.setdefault((one.template, one.kind), _told(one))
        if one.file not in known["said in"].split(", "):
            known["said in"] += f", {one.file}"
    return list(found.values())


def _told(one: Said) -> dict[str, str]:
    told = {
        "message": one.template,
        "kind": one.kind,
        "means": meaning(one.kind, area_of(one.file)),
        "what to do": one.remedy or REMEDIES.get(one.kind, ""),
        "page": _page(area_of(one.file).title),
        "said in": one.file,
    }
    return {name: text for name, text in told.items() if text}


def _of_kind(kind: str) -> dict[str, str]:
    """What there is to say of all messages of a kind."""
    files = list(dict.fromkeys(one.file for one in messages() if one.kind == kind))
    area = area_of(files[0])
    told = {
        "kind": kind,
        "means": meaning(kind, area),
        "what to do": REMEDIES[kind],
        "page": _page(area.title),
        "said in": ", ".join(files),
    }
    return {name: text for name, text in told.items() if text}


def _page(title: str) -> str:
    return f"docs/errors.md#{anchor(title)}"


def meaning(kind: str, area: Area) -> str:
    """What the class says of itself; of two of one name, that of the area."""
    named = {file: text for (file, name), text in classes().items() if name == kind}
    near = [text for file, text in named.items() if area_of(file) is area]
    return (near or list(named.values()) or [""])[0]


def undocumented() -> list[str]:
    """Classes without a remedy, remedies without a class, reasons without a meaning."""
    from flexsheet.messages.types import FingertipReason

    raised = {one.kind for one in messages()} | {
        "BadInputError",
        "Finding",
        "Log",
        "Note",
        "Reason",
        "Value",
        "Warning",
    }
    reasons = set(get_args(FingertipReason)) - {"ok"}
    unsaid = {words for words in PARTICULAR if not any(words in one.template for one in messages())}
    return sorted({*(raised ^ set(REMEDIES)), *(reasons ^ set(FINGERTIP)), *unsaid})


if __name__ == "__main__":
    print(reference(), end="")
