"""Every sentence of the code that says what is wrong, as it stands in the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from flexsheet.launch.reference.remedies import PARTICULAR

ROOT = Path(__file__).resolve().parents[2]
FLOORS = ("messages", "nodes", "launch")
LOGGED = ("warning", "error", "critical")
TOLD = {"on_problem", "on_refused", "report", "tell"}
"""What is called to say a sentence while a graph runs; a leading underscore or none."""
REASONS = {"reason", "why", "silence"}
"""Names of variables that hold why a node does not do its work."""

UNTROUBLED = ("ok", "not asked")

FILLED_IN = re.compile(r"<[^>]*>")
"""What stands in a message's template for what it fills in."""
_WORD = re.compile(r"[A-Za-z]{2,}")
_FIELD = re.compile(r"\{(\w+)[^}]*\}")
_ANSWERS_WHY = re.compile(
    r"beyond|busy|exit|lacking|note|objection|outside|problem|reason|refus|silence|skewed|too_deep"
    r"|trouble|verdict"
)
"""Names of functions that say in words why something is not as it should be."""
_SAYS_WHY = re.compile(r"\b(?:[Ww]hy|reason|trouble|wrong)\b")
"""First lines of docstrings of such functions."""
_HOLDS_REASONS = re.compile(r"FAIL|FAULT|NOT_|REFUS|TROUBLE")
"""Names of dictionaries of such words."""


@dataclass(frozen=True, slots=True)
class Said:
    """One message of the code: who says it (a class, or how it is said), and its words."""

    file: str
    kind: str
    template: str
    remedy: str = ""


@cache
def messages() -> tuple[Said, ...]:
    """All messages of the three floors, in the order of files and lines."""
    found = (one for file, tree in _trees() for one in _said(file, tree))
    return tuple(one if one.remedy else replace(one, remedy=_particular(one)) for one in found)


def _particular(one: Said) -> str:
    return next((text for words, text in PARTICULAR.items() if words in one.template), "")


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


@cache
def _trees() -> tuple[tuple[str, ast.Module], ...]:
    files = [file for floor in FLOORS for file in sorted((ROOT / floor).rglob("*.py"))]
    return tuple(
        (file.relative_to(ROOT).as_posix(), ast.parse(file.read_text(encoding="utf-8")))
        for file in files
    )


def _said(file: str, tree: ast.Module) -> Iterator[Said]:
    own = {name for _, name in classes()}
    constants = _constants(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield from _raised(file, node, own)
            yield from _mentioned(file, node, constants)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if any("validator" in ast.unparse(one) for one in node.decorator_list):
                yield from (Said(file, "Value", text) for text in _refused(node))
            if _says_why(node, file):
                yield from (Said(file, "Reason", text) for text in _returned(node, constants))
        elif isinstance(node, ast.Assign):
            target = _name(node.targets[0])
            if file.startswith("nodes/"):
                for name, value in _assigned(node):
                    if name.lstrip("_") in REASONS:
                        yield from (Said(file, "Reason", text) for text in _words(value, constants))
            if target.lstrip("_") == "note" and file.startswith("nodes/"):
                yield from (Said(file, "Note", text) for text in _words(node.value, constants))
            elif target.isupper() and file.startswith("nodes/planner/"):
                yield from (Said(file, "Reason", text) for text in _words(node.value, constants))
    for name, values in _dictionaries(tree):
        if _HOLDS_REASONS.search(name):
            texts = [template(value) for value in values]
            yield from (Said(file, "Reason", text) for text in texts if text and _is_said(text))
        elif file.startswith("launch/health/"):
            yield from _findings(file, values)


def _assigned(node: ast.Assign) -> Iterator[tuple[str, ast.expr]]:
    """Return the names that an assignment sets, each with its value."""
    match node.targets[0], node.value:
        case ast.Tuple(elts=targets), ast.Tuple(elts=values):
            yield from zip(map(_name, targets), values, strict=False)
        case target, value:
            yield _name(target), value


def _raised(file: str, call: ast.Call, own: set[str]) -> Iterator[Said]:
    """What is raised, or found by a check; own: names of the project's exceptions."""
    name, words = _name(call.func), [template(argument) for argument in call.args]
    if name in own and words:
        text = next((word for word in words if word and " " in word), None)
        if text:
            yield Said(file, name, text)
    elif name == "Problem" and len(words) > 2 and words[2]:
        yield Said(file, "BadInputError", words[2], _at(words, 3))
    elif name == "problem" and len(words) > 1 and words[1]:
        yield Said(file, "BadInputError", words[1], _at(words, 2))
    elif (
        name == "Finding"
        and file.startswith("launch/health/")
        and len(words) > 2
        and words[1] != "ok"
        and words[2]
    ):
        yield Said(file, "Finding", f"{words[0]}: {words[2]}", _at(words, 3))
    elif name == "HostFinding" and _at(words, 2) not in UNTROUBLED and _is_said(_at(words, 3)):
        yield Said(file, "Finding", _at(words, 3), _at(words, 4))


def _mentioned(file: str, call: ast.Call, constants: dict[str, str]) -> Iterator[Said]:
    """What is said while a graph runs."""
    name = _name(call.func)
    if name in LOGGED and "log" in ast.unparse(call.func) and call.args:
        text = template(call.args[0])
        if text:
            yield Said(file, "Log", text)
    elif name.lstrip("_") in TOLD:
        for argument in call.args:
            yield from (Said(file, "Warning", text) for text in _words(argument, constants))
    elif name == "append" and (kind := _kind_of_list(call.func)) and call.args:
        yield from (Said(file, kind, text) for text in _words(call.args[0], constants))


def _kind_of_list(append: ast.expr) -> str:
    """What `LIST.append` gathers, by the list's name: notes or warnings; empty: something else."""
    name = _name(append.value) if isinstance(append, ast.Attribute) else ""
    return {"notes": "Note", "warnings": "Warning"}.get(name.lstrip("_"), "")


def _constants(tree: ast.Module) -> dict[str, str]:
    """The module's strings by name."""
    named = {
        _name(node.targets[0]): template(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
    }
    return {name: text for name, text in named.items() if text}


def _words(node: ast.AST, constants: dict[str, str]) -> Iterator[str]:
    """What an expression may say: of each branch, and of each part that is joined, the sentence."""
    match node:
        case ast.IfExp(body=body, orelse=other):
            parts = [body, other]
        case ast.BoolOp(values=values) | ast.Tuple(elts=values) | ast.List(elts=values):
            parts = values
        case ast.Call(func=ast.Attribute(attr="join"), args=[ast.Call(args=[_, joined])]):
            parts = [joined]
        case ast.Name(id=name):
            parts = []
            if _is_said(constants.get(name, "")):
                yield constants[name]
        case _:
            parts, text = [], template(node)
            if text and _is_said(text):
                yield text
    for part in parts:
        yield from _words(part, constants)


def _is_said(text: str) -> bool:
    """Whether a string is words of its own, and not only a frame around what it fills in."""
    return len(_WORD.findall(FILLED_IN.sub(" ", text))) > 1


def _says_why(function: ast.FunctionDef | ast.AsyncFunctionDef, file: str) -> bool:
    """Whether a function answers in words why something is not as it should be."""
    returns = "" if function.returns is None else ast.unparse(function.returns)
    if "str" not in returns.split(" | "):
        return False
    about = (ast.get_docstring(function) or "").split("\n")[0]
    named = _ANSWERS_WHY.search(function.name) or _SAYS_WHY.search(about)
    return bool(named) or file.startswith("nodes/arm_bridge/")


def _returned(
    function: ast.FunctionDef | ast.AsyncFunctionDef, constants: dict[str, str]
) -> Iterator[str]:
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            yield from (text for text in _words(node.value, constants) if "</" not in text)


def _dictionaries(tree: ast.Module) -> Iterator[tuple[str, list[ast.expr]]]:
    """The module's constants that are dictionaries: name and values."""
    for node in tree.body:
        match node:
            case ast.Assign(targets=[target], value=ast.Dict(values=values)):
                name = _name(target)
            case ast.AnnAssign(target=target, value=ast.Dict(values=values)):
                name = _name(target)
            case _:
                continue
        if name.isupper():
            yield name, values


def _findings(file: str, values: list[ast.expr]) -> Iterator[Said]:
    """Of a dictionary of findings, whose values end with what was found and what to do."""
    for value in values:
        if isinstance(value, ast.Tuple) and len(value.elts) > 1:
            what, remedy = (template(element) for element in value.elts[-2:])
            if what and remedy and _is_said(what):
                yield Said(file, "Finding", _FIELD.sub(r"<\1>", what), _FIELD.sub(r"<\1>", remedy))


def _refused(validator: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[str]:
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
