"""YAML files whose mistakes can be pointed at: file, line, key, value and remedy.

A file is read with its line numbers, checked against a pydantic model, and everything that is
wrong with it is reported at once as `Problem`s.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.scalarbool import ScalarBoolean
from ruamel.yaml.scalarfloat import ScalarFloat
from ruamel.yaml.scalarint import ScalarInt
from ruamel.yaml.scalarstring import ScalarString
from ruamel.yaml.tokens import (
    AliasToken,
    BlockEndToken,
    BlockMappingStartToken,
    BlockSequenceStartToken,
    FlowMappingEndToken,
    FlowMappingStartToken,
    FlowSequenceEndToken,
    FlowSequenceStartToken,
    ScalarToken,
)

from flexsheet.launch.plans.renamed_keys import LAUNCH_KEYS, NODE_PARAMETERS, SCENE_KEYS, VALUES
from flexsheet.messages.scene import Scene

M = TypeVar("M", bound=BaseModel)
MAX_TEXT_LENGTH = 1 << 18
MAX_DEPTH = 50
MAX_VALUES = 5000
"""The largest file of launch/ has 300; the parser takes a second for these."""

OPENING_TOKENS = (
    BlockMappingStartToken,
    BlockSequenceStartToken,
    FlowMappingStartToken,
    FlowSequenceStartToken,
)
CLOSING_TOKENS = (BlockEndToken, FlowMappingEndToken, FlowSequenceEndToken)
VALUE_TOKENS = (ScalarToken, AliasToken)

SCALARS: tuple[tuple[type, type], ...] = (
    (ScalarBoolean, bool),
    (ScalarFloat, float),
    (ScalarInt, int),
    (ScalarString, str),
)
"""The parser's own kinds of values, which remember how they were written."""

MAPPING_WANTED = ("model_type", "model_attributes_type", "dict_type", "mapping_type")
"""Kinds of pydantic's errors whose texts name a class."""

Key = tuple[str | int, ...]
"""Where a value sits in a document: ("nodes", "planner", "parameters", "max_age_s")."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong, where, and what to do about it."""

    where: str
    key: Key
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        key = ".".join(str(part) for part in self.key)
        parts = [self.where, *([key] if key else []), self.what]
        return ": ".join(parts) + (f"; {self.remedy}" if self.remedy else "")


class BadInputError(ValueError):
    """Input that cannot be used; `problems` holds all that was found."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = tuple(problems)


@dataclass(slots=True)
class Document:
    """A YAML file as plain values, with the line of every key, and what was set over it."""

    path: Path
    values: dict[str, Any]
    text: str
    lines: dict[Key, int]
    overrides: dict[Key, str] = field(default_factory=dict)

    def where(self, key: Key) -> str:
        """The file and line of `key` (or of the nearest thing around it), or the override."""
        for length in range(len(key), 0, -1):
            part = key[:length]
            if part in self.overrides:
                return self.overrides[part]
            if part in self.lines:
                return f"{self.path}:{self.lines[part]}"
        return str(self.path)

    def problem(self, key: Key, what: str, remedy: str = "") -> Problem:
        return Problem(self.where(key), key, what, remedy)

    def set(self, key: Key, value: Any, origin: str) -> None:
        """Put `value` at `key`, making the mappings on the way; `origin` names it in errors."""
        target: dict[Any, Any] = self.values
        for part in key[:-1]:
            if target.get(part) is None:
                target[part] = {}
            if not isinstance(target[part], dict):
                raise BadInputError([Problem(origin, key, f'"{part}" holds no further keys')])
            target = target[part]
        target[key[-1]] = value
        self.overrides[key] = origin


def parse_value(text: str) -> Any:
    """A value as YAML reads it: "3" is a number, "[1, 2]" a list, "yes" a string.

    Raises YAMLError.
    """
    return plain(_tree(text))


def _tree(text: str) -> Any:
    """The YAML tree of a text, with its comments; raises YAMLError and nothing else."""
    try:
        _check_size(text)
        return YAML(typ="rt", pure=True).load(text)
    except YAMLError:
        raise
    except RecursionError as error:
        raise YAMLError("values within values within values, too deep") from error
    # Days and numbers that are none, and odd tags, make the parser raise what it likes.
    except Exception as error:
        raise YAMLError(f"holds a value that cannot be read: {error}"[:500]) from error


def _check_size(text: str) -> None:
    """Refuse a text whose parsing would take long; raises YAMLError.

    The parser's time grows with the square of the depth and more, so tokens are counted first, and
    that only where the punctuation does not rule too many of them out.
    """
    lines = text.splitlines()
    columns = max((len(line) - len(line.lstrip(" -?\t")) for line in lines), default=0)
    brackets = sum(map(text.count, "[{"))
    separators = sum(map(text.count, ":,-?"))
    if columns + brackets <= MAX_DEPTH and separators < MAX_VALUES:
        return
    depth = values = 0
    for token in YAML(typ="rt", pure=True).scan(text):
        depth += isinstance(token, OPENING_TOKENS)
        depth -= isinstance(token, CLOSING_TOKENS)
        values += isinstance(token, VALUE_TOKENS)
        if depth > MAX_DEPTH:
            raise YAMLError(f"more than {MAX_DEPTH} lists or mappings are nested")
        if values > 2 * MAX_VALUES:
            raise YAMLError(f"more than {MAX_VALUES} values")


def parse_json(text: str) -> Any:
    """A value as JSON has it, of any size: it knows no aliases, which could stand for more than is
    there.  ValueError for what is no JSON; for NaN, infinity and a key that is said twice, too.
    """

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    def mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a key is said twice")
        return found

    try:
        return json.loads(text, parse_constant=refuse, object_pairs_hook=mapping)
    except RecursionError as error:
        raise ValueError("values within values within values, too deep") from error


def read_document(path: Path) -> Document:
    """Read a YAML file that holds one mapping; raises BadInputError."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadInputError(
            [Problem(str(path), (), f"cannot be read: {reason}", "check the path")]
        ) from error
    except UnicodeDecodeError as error:
        raise BadInputError([Problem(str(path), (), f"is not UTF-8 text: {error}")]) from error
    if len(text) > MAX_TEXT_LENGTH:
        what = f"has {len(text)} characters, at most {MAX_TEXT_LENGTH} are read"
        raise BadInputError([Problem(str(path), (), what)])
    try:
        tree = _tree(text)
        values = plain(tree)
    except DuplicateKeyError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        what = (error.problem or "duplicate key").split("\n")[0]
        raise BadInputError(
            [Problem(f"{path}:{line}", (), what, "remove or rename one of the two")]
        ) from error
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise BadInputError([Problem(where, (), f"not YAML: {error.problem}")]) from error
    except YAMLError as error:
        raise BadInputError([Problem(str(path), (), f"not YAML: {error}")]) from error
    if not isinstance(tree, CommentedMap):
        kind = _kind_name(values)
        raise BadInputError([Problem(str(path), (), f"is {kind}", "it must hold keys and values")])
    return Document(path, values, text, dict(_lines(tree, ())))


def plain(tree: Any) -> Any:
    """A YAML tree without its comments and quoting, as Python's own types.

    Raises YAMLError for keys that are more than a word or a number, and where aliases stand for
    more values than anybody writes.
    """
    left = MAX_VALUES

    def convert(value: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise YAMLError(
                f"more than {MAX_VALUES} values, those that aliases (*) repeat included"
            )
        if isinstance(value, Mapping):
            return {key(name): convert(item) for name, item in value.items()}
        if isinstance(value, list):
            return [convert(item) for item in value]
        for kind, own in SCALARS:
            if isinstance(value, kind):
                return own(value)
        return value

    def key(name: Any) -> Any:
        if name is None or isinstance(name, str | int | float):
            return convert(name)
        raise YAMLError("a key is a list or a mapping, not a word or a number")

    try:
        return convert(tree)
    except RecursionError as error:
        raise YAMLError("a value holds itself, or is nested too deeply") from error


def _lines(tree: Any, key: Key) -> Iterator[tuple[Key, int]]:
    if isinstance(tree, CommentedMap):
        for name, item in tree.items():
            inner = (*key, name)
            position = tree.lc.data.get(name) if tree.lc.data else None
            if position is not None:
                yield inner, position[0] + 1
            yield from _lines(item, inner)
    elif isinstance(tree, CommentedSeq):
        for i, item in enumerate(tree):
            position = tree.lc.data.get(i) if tree.lc.data else None
            if position is not None:
                yield (*key, i), position[0] + 1
            yield from _lines(item, (*key, i))


def _kind_name(value: Any) -> str:
    """What YAML calls a value of this kind."""
    match value:
        case None:
            return "empty"
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case str():
            return "a text"
        case bool():
            return "true or false"
        case int() | float():
            return "a number"
        case _:
            return "a date"


def did_you_mean(name: object, known: Sequence[str]) -> str:
    """Return the remedy for an unknown name: its new name, the nearest one, or all there are."""
    near = get_close_matches(str(name), known, n=1)
    if near:
        return f'did you mean "{near[0]}"?'
    return f"there are: {', '.join(known)}" if known else "there are none"


def validate(model: type[M], document: Document, *, at: Key = ()) -> M:
    """The values at `at` as a `model`; raises BadInputError with a problem per mistake."""
    values: Any = document.values
    for part in at:
        values = values[part]
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [_problem_of(item, model, document, at) for item in error.errors()]
        raise BadInputError(list(dict.fromkeys(problems))) from None


def _problem_of(error: Any, model: type[BaseModel], document: Document, at: Key) -> Problem:
    location: Key = tuple(error["loc"])
    if error["type"] in ("extra_forbidden", "missing"):
        name = location[-1]
        inside, holder = _walk(model, location[:-1])
        if error["type"] == "missing":
            return document.problem((*at, *inside), f'"{name}" is missing', f'add "{name}"')
        known = sorted(holder.model_fields) if _is_model(holder) else []
        key = (*at, *inside, name)
        renamed = _renamed_keys(model, document, key).get(str(name))
        remedy = f'it is now "{renamed}"' if renamed else did_you_mean(name, known)
        return document.problem(key, f'unknown key "{name}"', remedy)
    # Pydantic names the option of a union of literals, which is no key of the file.
    path = [part for part in _walk(model, location)[0] if not str(part).startswith("literal[")]
    key = (*at, *path)
    if error["type"] in MAPPING_WANTED:
        return document.problem(
            key, f"is {_kind_name(error['input'])}", "it must hold keys and values"
        )
    renamed = VALUES.get(str(key[-1]) if key else "", {}).get(str(error["input"]))
    if renamed is not None:
        what = f"{_shown(error['input'])} does not fit"
        return document.problem(key, what, f'it is now "{renamed}"')
    message = error["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    return document.problem(key, f"{_shown(error['input'])} does not fit", message)


def _renamed_keys(model: type[BaseModel], document: Document, key: Key) -> Mapping[str, str]:
    """Return old to new names of the keys beside `key`."""
    if key[0] == "nodes" and key[2:3] == ("parameters",):
        node_type = document.values["nodes"][key[1]].get("type")
        return NODE_PARAMETERS.get(node_type, {})
    return SCENE_KEYS if issubclass(model, Scene) else LAUNCH_KEYS


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _walk(model: Any, location: Key) -> tuple[Key, Any]:
    """The key in the file that pydantic's `location` stands for, and the type that sits there.

    Inside a union of models pydantic's location also names the member that the tag chose.
    """
    key: list[str | int] = []
    for part in location:
        members = [one for one in get_args(model) if _is_model(one)] if _is_union(model) else []
        chosen = next((one for one in members if _has_tag(one, part)), None)
        if chosen is not None:
            model = chosen
            continue
        key.append(part)
        model = _inner_type(members[0] if len(members) == 1 else model, part)
    if _is_union(model):
        members = [one for one in get_args(model) if _is_model(one)]
        model = members[0] if len(members) == 1 else None
    return tuple(key), model


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, UnionType)


def _has_tag(model: type[BaseModel], tag: str | int) -> bool:
    fields = model.model_fields.values()
    return any(
        get_origin(one.annotation) is Literal and tag in get_args(one.annotation) for one in fields
    )


def _inner_type(annotation: Any, part: str | int) -> Any:
    if _is_model(annotation):
        field_info = annotation.model_fields.get(part)
        annotation = field_info.annotation if field_info is not None else None
    else:
        arguments = get_args(annotation)
        annotation = arguments[-1] if arguments else None
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    return annotation
