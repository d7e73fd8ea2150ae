"""Find the texts that nodes write into their notes, by reading the source files."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from flexsheet.messages.notes import NodeNote

NOTE_NAME = re.compile(
    r"_?notes?|\w+_note|\w+_NOTE|_note_\w+|refusal|reason|_silence|select_eyes|_find_interlock|"
    r"_find_stop|choose_stretch|load_force_model|CLOSED|STALE_REASONS|FAULT_TEXTS"
)
"""The names of variables, attributes, arguments and functions that contain or return notes."""

NO_NOTES = frozenset({"access_control.py", "controller.py"})
"""The files in which `reason` is a field of another message."""

VALUE = "0"
"""The text that stands for a value that a node inserts into a note."""


def find_note_texts(path: Path) -> list[str]:
    """Return the texts that a source file writes into notes.

    The phrase of each named `NodeNote` is inserted, and `VALUE` stands for all other values.
    """
    if path.name in NO_NOTES:
        return []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    results = {one.name: one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)}
    found = {
        text
        for expression in _find_notes(tree)
        for text in _render_texts(expression, results)
        if re.search(r"[a-z]{3}", text)
    }
    return sorted(found)


def _find_notes(tree: ast.Module) -> Iterator[ast.expr]:
    """Yield the expressions that are stored in notes, and those of the local names they use."""
    functions = [
        one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    for scope in (tree, *functions):
        stored = list(_list_stored(scope))
        wanted = [value for name, value in stored if NOTE_NAME.fullmatch(name)]
        if isinstance(scope, ast.FunctionDef) and NOTE_NAME.fullmatch(scope.name):
            wanted += _list_results(scope)
        used: set[str] = set()
        while wanted:
            expression = wanted.pop()
            yield expression
            names = set(_list_names(expression)) - used
            used |= names
            wanted += [value for name, value in stored if name in names]


def _list_results(function: ast.FunctionDef) -> list[ast.expr]:
    returns = (one for one in ast.walk(function) if isinstance(one, ast.Return))
    return [one.value for one in returns if one.value is not None]


def _list_names(expression: ast.AST) -> Iterator[str]:
    """Yield the names of the texts that an expression joins."""
    if isinstance(expression, ast.Name):
        yield expression.id
    elif isinstance(expression, ast.Call) and _get_name(expression.func) not in ("join", "filter"):
        return
    elif not isinstance(expression, ast.JoinedStr | ast.Compare | ast.Subscript):
        for child in ast.iter_child_nodes(expression):
            yield from _list_names(child)


def _get_name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)


def _list_stored(scope: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield the name and the value of each assignment, addition to a list and named argument."""
    for one in ast.walk(scope):
        match one:
            case ast.Assign():
                for target in one.targets:
                    yield from _pair(target, one.value)
            case ast.AugAssign() | ast.AnnAssign(value=ast.expr()):
                assert one.value is not None
                yield from _pair(one.target, one.value)
            case ast.keyword(arg=str()):
                assert one.arg is not None
                yield one.arg, one.value
            case ast.Call(func=ast.Attribute(attr="append"), args=[added]):
                yield from _pair(one.func.value, added)


def _pair(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for each, part in zip(target.elts, value.elts, strict=True):
            yield from _pair(each, part)
    elif isinstance(target, ast.Name):
        yield target.id, value
    elif isinstance(target, ast.Attribute):
        yield target.attr, value


def _render_texts(expression: ast.AST, functions: dict[str, ast.FunctionDef]) -> Iterator[str]:
    """Yield the strings in an expression, except strings inside other strings."""
    match expression:
        case ast.Constant(value=str()):
            yield str(expression.value)
        case ast.JoinedStr() | ast.BinOp(op=ast.Add()):
            yield _render(expression, functions)
        case ast.Compare() | ast.Subscript():
            return
        case ast.Dict():
            for value in expression.values:
                yield from _render_texts(value, functions)
        case _:
            for child in ast.iter_child_nodes(expression):
                yield from _render_texts(child, functions)


def _render(part: ast.expr, functions: dict[str, ast.FunctionDef]) -> str:
    """Return the text of an expression in which `VALUE` replaces unknown values."""
    match part:
        case ast.Constant(value=str()):
            return str(part.value)
        case ast.JoinedStr():
            return "".join(_render(one, functions) for one in part.values)
        case ast.BinOp(op=ast.Add()):
            return _render(part.left, functions) + _render(part.right, functions)
        case ast.FormattedValue():
            return _render(part.value, functions)
        case ast.Attribute(value=ast.Attribute(attr=member), attr="phrase"):
            return NodeNote[member].phrase
        case ast.Attribute(attr="phrase"):
            # A variable of this type can name any note, so that each text with it has an entry.
            return NodeNote.COMPUTER_BUSY.phrase
        case ast.Call(func=ast.Attribute(attr=name)) if name in functions:
            texts = (_render(one, functions) for one in _list_results(functions[name]))
            return max(texts, key=len, default=VALUE)
    return VALUE
