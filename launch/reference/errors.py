"""Writes docs/errors.md: every message that says what is wrong, read from the code that says it.

python -m launch.reference.errors > docs/errors.md
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import get_args

from launch.reference.remedies import AREAS, FINGERTIP, REMEDIES, Area

ROOT = Path(__file__).resolve().parents[2]
FLOORS = ("messages", "nodes", "launch")
LOGGED = ("warning", "error", "critical")
SHORTEST_MATCH = 8
"""Letters of a message's fixed words below which it would fit anything."""

_FILLED_IN = re.compile(r"<[^>]*>")

INTRODUCTION = """\
# Errors

<!-- Written by `python -m launch.reference.errors > docs/errors.md`; a test compares. -->

What each message means and what to do.  `flexsheet explain 'THE MESSAGE'` finds the place for you.
A `<word>` stands for what the message fills in.  Exit codes: 0 done, 1 failed, 2 the input is
wrong, 3 a replay differs from what was live, or `tune` found no method good enough.

A node's messages reach you by `flexsheet launch` (its log), by the `note` of its status
(`flexsheet topic echo status`) and in the console.
"""


@dataclass(frozen=True, slots=True)
class Said:
    """One message of the code: who says it (a class, or how it is said), and its words."""

    file: str
    kind: str
    template: str
    remedy: str = ""


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
        sections += [_section(kind, area, mine) for kind in kinds]
    return "\n".join(sections)


def _section(kind: str, area: Area, said: list[Said]) -> str:
    """Heading, meaning, remedy and messages of one kind within an area."""
    lines = [f"### {kind}", ""]
    if kind in REMEDIES:
        lines += [f"{meaning(kind, area)}  **What to do:** {REMEDIES[kind]}", ""]
    rows = dict.fromkeys(
        f"- {_code(one.template)}" + (f": {one.remedy}" if one.remedy else "")
        for one in said
        if one.kind == kind and _letters(one.template) >= SHORTEST_MATCH
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
    those that hold it, where it has `SHORTEST_MATCH` letters or more."""
    found: list[tuple[int, Said]] = []
    part = message.strip().lower()
    for one in messages():
        pattern = ".+?".join(re.escape(part) for part in _FILLED_IN.split(one.template))
        letters = _letters(one.template)
        if letters >= SHORTEST_MATCH and re.search(pattern, message, re.DOTALL):
            found.append((letters, one))
        elif len(part) >= SHORTEST_MATCH and part in one.template.lower():
            found.append((-letters, one))
    return [one for _, one in sorted(found, key=lambda pair: -pair[0])]


def _letters(template: str) -> int:
    """How many letters of a message are always the same."""
    return sum(len(part.strip()) for part in _FILLED_IN.split(template))


def explained(message: str) -> list[dict[str, str]]:
    """What there is to say of a message, of a kind of error, or of a fingertip's reason: the best
    first."""
    if message in FINGERTIP:
        return [{"message": message, "what to do": FINGERTIP[message], "page": _page("Fingertip")}]
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


@cache
def messages() -> tuple[Said, ...]:
    """All messages of the three floors, in the order of files and lines."""
    return tuple(one for file, tree in _trees() for one in _said(file, tree))


@cache
def classes() -> dict[tuple[str, str], str]:
    """First paragraphs of the docstrings of the project's exceptions, by file and name."""
    known = {"Exception", "Interrupted"}
    return {
        (file, node.name): (ast.get_docstring(node) or "").split("\n\n")[0].replace("\n", " ")
        for file, tree in _trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any(_name(base).endswith("Error") or _name(base) in known for base in node.bases)
    }


def meaning(kind: str, area: Area) -> str:
    """What the class says of itself; of two of one name, that of the area."""
    named = {file: text for (file, name), text in classes().items() if name == kind}
    near = [text for file, text in named.items() if area_of(file) is area]
    return (near or list(named.values()) or [""])[0]


@cache
def _trees() -> tuple[tuple[str, ast.Module], ...]:
    files = [file for floor in FLOORS for file in sorted((ROOT / floor).rglob("*.py"))]
    return tuple(
        (file.relative_to(ROOT).as_posix(), ast.parse(file.read_text(encoding="utf-8")))
        for file in files
    )


def _said(file: str, tree: ast.Module) -> Iterator[Said]:
    own = {name for _, name in classes()}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name, words = _name(node.func), [template(argument) for argument in node.args]
            if name in own and words:
                text = next((word for word in words if word and " " in word), None)
                if text:
                    yield Said(file, name, text)
            elif name == "Problem" and len(words) > 2 and words[2]:
                yield Said(file, "BadInputError", words[2], _at(words, 3))
            elif name == "problem" and len(words) > 1 and words[1]:
                yield Said(file, "BadInputError", words[1], _at(words, 2))
            elif name == "Finding" and len(words) > 2 and words[1] != "ok" and words[2]:
                yield Said(file, "Finding", f"{words[0]}: {words[2]}", _at(words, 3))
            elif name in LOGGED and "log" in ast.unparse(node.func) and words and words[0]:
                yield Said(file, "Log", words[0])
        elif isinstance(node, ast.FunctionDef):
            if any("validator" in ast.unparse(one) for one in node.decorator_list):
                yield from (Said(file, "Value", text) for text in _refused(node))
            if not file.startswith("nodes/arm_bridge/"):
                continue
            if node.returns is not None and ast.unparse(node.returns) in ("str | None", "str"):
                yield from (Said(file, "Reason", text) for text in _returned(node))
        elif isinstance(node, ast.Assign) and file.startswith("nodes/planner/"):
            text = template(node.value) if _name(node.targets[0]).isupper() else None
            if text and " " in text:
                yield Said(file, "Reason", text)


def _returned(function: ast.FunctionDef) -> Iterator[str]:
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            text = template(node.value)
            if text and " " in text:
                yield text


def _refused(validator: ast.FunctionDef) -> Iterator[str]:
    for node in ast.walk(validator):
        if isinstance(node, ast.Call) and _name(node.func) == "ValueError" and node.args:
            text = template(node.args[0])
            if text:
                yield text


def _at(words: list[str | None], index: int) -> str:
    return (words[index] or "") if index < len(words) else ""


def _name(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def template(node: ast.AST) -> str | None:
    """A string of the code with `<name>` where it is filled in; None for what is no string."""
    if isinstance(node, ast.Constant):
        return node.value.replace("\n", " ") if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return "".join(template(part) or "" for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return f"<{_filled_in(node.value)}>"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = template(node.left), template(node.right)
        return None if left is None else left + (right if right is not None else "<more>")
    return None


def _filled_in(node: ast.AST) -> str:
    """A word for what a message fills in: the name, or what is called upon."""
    match node:
        case ast.Call(func=ast.Attribute(attr="join"), args=[inner, *_]):
            return _filled_in(inner)
        case ast.Call(args=[inner, *_]):
            return _filled_in(inner)
        case ast.BinOp(left=ast.Constant(), right=inner) | ast.BinOp(left=inner):
            return _filled_in(inner)
        case ast.GeneratorExp(elt=inner) | ast.Subscript(value=inner):
            return _filled_in(inner)
    return _name(node).lstrip("_") or "more"


def undocumented() -> list[str]:
    """Classes without a remedy, remedies without a class, reasons without a meaning."""
    from messages.types import FingertipReason

    raised = {one.kind for one in messages()} | {
        "BadInputError",
        "Finding",
        "Log",
        "Reason",
        "Value",
    }
    reasons = set(get_args(FingertipReason)) - {"ok"}
    return sorted({*(raised ^ set(REMEDIES)), *(reasons ^ set(FINGERTIP))})


if __name__ == "__main__":
    print(reference(), end="")
