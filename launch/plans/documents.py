"""Read YAML files, and report their errors with file, line, key, value and remedy.

A file is read with its line numbers and validated against a pydantic model. All errors of a file
are reported together as `Problem` objects.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, get_args, get_origin

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

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.units import find_unit

M = TypeVar("M", bound=BaseModel)
MAX_TEXT_LENGTH = 1 << 18
MAX_DEPTH = 50
MAX_VALUES = 5000
"""The maximum number of values in a YAML file.

The parser needs about one second to read them. The largest shipped file contains 300 values.
"""

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
"""The scalar types of the YAML parser, which preserve formatting, and their Python types."""

YAML_REMEDY = "correct this line; indent with spaces, not tabs, and quote texts with `: ` or ` #`"

MAPPING_ERROR_TYPES = ("model_type", "model_attributes_type", "dict_type", "mapping_type")
"""The types of pydantic errors for values that should be mappings."""

NUMBER_ERROR_TYPES = ("float_parsing", "float_type", "int_parsing", "int_type")
"""The types of pydantic errors for values that should be numbers."""

Key = tuple[str | int, ...]
"""The path of a value in a document, such as ("nodes", "planner", "parameters", "max_age_s")."""


@dataclass(frozen=True, slots=True)
class Problem:
    """An error in an input file.

    where: location, such as "file:line".
    key: path of the value.
    what: description of the error.
    remedy: what the user should do.
    """

    where: str
    key: Key
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        key = ".".join(str(part) for part in self.key)
        parts = [self.where, *([key] if key else []), self.what]
        return ": ".join(parts) + (f"; {self.remedy}" if self.remedy else "")


class BadInputError(FlexsheetError, ValueError):
    """Raised if an input cannot be used.

    The attribute `problems` lists all errors.
    """

    exit_code = 2

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = tuple(problems)

    @classmethod
    def single(cls, where: str, key: Key, what: str, remedy: str = "") -> Self:
        """Make an error that contains one problem."""
        return cls([Problem(where, key, what, remedy)])


@dataclass(slots=True)
class Document:
    """The values of a YAML file, the line of each key, and the origin of each overridden value."""

    path: Path
    values: dict[str, Any]
    text: str
    lines: dict[Key, int]
    overrides: dict[Key, str] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    extended: dict[Key, Path] = field(default_factory=dict)
    """The source file of each key that the method `extend` has inherited from another file."""

    def where(self, key: Key) -> str:
        """Return the location of `key` for error texts.

        The location is "file:line", or the command-line option that overrides the value. If the key
        has no line, the line of the nearest parent key is used.
        """
        for length in range(len(key), 0, -1):
            part = key[:length]
            if part in self.overrides:
                return self.overrides[part]
            if part in self.lines:
                return f"{self.extended.get(part, self.path)}:{self.lines[part]}"
        return str(self.path)

    def folder(self, key: Key) -> Path:
        """Return the folder relative to which a path in the value of `key` is given.

        This is the folder of the file that contains `key`. If a command-line option overrides the
        value, the current folder is returned.
        """
        if key in self.overrides:
            return Path.cwd()
        known = (key[:length] for length in range(len(key), 0, -1) if key[:length] in self.lines)
        return self.extended.get(next(known, ()), self.path).parent

    def find(self, key: Key) -> Any:
        """Return the value at `key`; return None if the key or one of its parents is missing."""
        value: Any = self.values
        for part in key:
            value = value.get(part) if isinstance(value, dict) else None
        return value

    def extend(self, base: Document, levels: int) -> None:
        """Inherit the values of the document `base` that this document does not contain.

        Mappings are merged down to the depth `levels`. At greater depths, a mapping of this
        document completely replaces the mapping of `base`.
        """
        own = self.lines
        self.lines = {**base.lines, **own}
        self.extended = {
            key: base.extended.get(key, base.path) for key in base.lines if key not in own
        }
        self.values = _merge(base.values, self.values, levels)
        self.text = f"# {base.path}\n{base.text}\n# {self.path}\n{self.text}"

    def problem(self, key: Key, what: str, remedy: str = "") -> Problem:
        """Return the description of an error in this file, with the location of the key.

        what: description of the error.
        remedy: what the user should do.
        """
        return Problem(self.where(key), key, what, remedy)

    def report(self, key: Key, what: str, remedy: str = "") -> None:
        """Store a problem at `key` for `raise_problems`, which raises all stored problems."""
        self.problems.append(self.problem(key, what, remedy))

    def error(self, key: Key, what: str, remedy: str = "") -> BadInputError:
        """Return an error that contains one problem at `key` of this document."""
        return BadInputError([self.problem(key, what, remedy)])

    def raise_problems(self) -> None:
        """Raise BadInputError if `report` has stored problems."""
        if self.problems:
            raise BadInputError(self.problems)

    def set(self, key: Key, value: Any, origin: str) -> None:
        """Override the value at `key`, and create missing parent mappings.

        origin: command-line option that sets the value; error texts use it as the location.
        """
        target: dict[Any, Any] = self.values
        for part in key[:-1]:
            if target.get(part) is None:
                target[part] = {}
            if not isinstance(target[part], dict):
                raise BadInputError.single(
                    origin,
                    key,
                    f'"{part}" is not a mapping, so it contains no keys',
                    "correct the path of the key",
                )
            target = target[part]
        target[key[-1]] = value
        self.overrides[key] = origin


def _merge(base: Any, own: Any, levels: int) -> Any:
    if levels == 0 or not (isinstance(base, dict) and isinstance(own, dict)):
        return own
    common = {name: _merge(base[name], own[name], levels - 1) for name in own if name in base}
    return {**base, **own, **common}


def parse_value(text: str) -> Any:
    """Parse a YAML value: "3" becomes a number, "[1, 2]" a list and "yes" a string.

    Raises YAMLError if the text is invalid.
    """
    return plain(_parse_tree(text))


@lru_cache(maxsize=32)
def _parse_tree(text: str) -> Any:
    """Parse text into a YAML tree that includes comments.

    Raises YAMLError if the text is invalid.

    Callers must not change the tree, because all calls with the same text return the same tree.
    """
    try:
        _check_size(text)
        return YAML(typ="rt", pure=True).load(text)
    except YAMLError:
        raise
    except RecursionError as error:
        raise YAMLError("values are nested too deeply") from error
    # For invalid dates, numbers and tags the parser raises errors of various types.
    except Exception as error:
        raise YAMLError(f"a value cannot be read: {error}"[:500]) from error


def _check_size(text: str) -> None:
    """Raise YAMLError if a text is so large or deeply nested that parsing takes too long.

    The parsing time grows at least quadratically with the nesting depth. The function therefore
    counts tokens before the text is parsed. It skips the count if the punctuation marks are too few
    to exceed the limits.
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
            raise YAMLError(f"the file has more than {MAX_VALUES} values")


def parse_json(text: str) -> Any:
    """Parse a JSON value of any size.

    A size limit is unnecessary, because JSON has no aliases that expand to more values. Raises
    ValueError if the text is not valid JSON, or if it contains NaN, infinity or duplicate keys.
    """

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not valid JSON")

    def mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a mapping contains the same key twice; remove one of the two")
        return found

    try:
        return json.loads(text, parse_constant=refuse, object_pairs_hook=mapping)
    except RecursionError as error:
        raise ValueError("values are nested too deeply") from error


def read_document(path: Path) -> Document:
    """Read a YAML file that contains one mapping.

    Raises BadInputError if the file is invalid.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadInputError.single(
            str(path), (), f"the file cannot be read: {reason}", "check the path"
        ) from error
    except UnicodeDecodeError as error:
        raise BadInputError.single(
            str(path), (), f"the file is not UTF-8 text: {error}; save the file as UTF-8"
        ) from error
    if len(text) > MAX_TEXT_LENGTH:
        what = f"the file has {len(text)} characters; at most {MAX_TEXT_LENGTH} are allowed"
        raise BadInputError.single(str(path), (), what, "shorten the file")
    try:
        tree = _parse_tree(text)
        values = plain(tree)
    except DuplicateKeyError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        what = (error.problem or "duplicate key").split("\n")[0]
        raise BadInputError.single(
            f"{path}:{line}", (), what, "remove or rename one of the two"
        ) from error
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        what = f"the file is not valid YAML: {error.problem}"
        raise BadInputError.single(where, (), what, YAML_REMEDY) from error
    except YAMLError as error:
        raise BadInputError.single(str(path), (), f"the file is not valid YAML: {error}") from error
    if not isinstance(tree, CommentedMap):
        kind = _name_type(values)
        raise BadInputError.single(
            str(path), (), f"the file is {kind}", "write a mapping of keys and values"
        )
    return Document(path, values, text, dict(_lines(tree, ())))


def plain(tree: Any) -> Any:
    """Convert a YAML tree to Python's built-in types, and omit comments and quoting.

    Raises YAMLError if a key is a list or a mapping, or if aliases expand to more than MAX_VALUES
    values.
    """
    left = MAX_VALUES

    def convert(value: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise YAMLError(
                f"the file has more than {MAX_VALUES} values, including repetitions by aliases (*)"
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
        raise YAMLError("a key is a list or a mapping; write text or a number")

    try:
        return convert(tree)
    except RecursionError as error:
        raise YAMLError("a value contains itself or is nested too deeply") from error


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


def _name_type(value: Any) -> str:
    """Return the name of a value's YAML type for error texts, such as "a list"."""
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
    """Return a text that suggests the known name that is most similar to `name`.

    If no name is similar, the text lists all known names. If exactly one known name is `name` with
    a suffix, such as a unit, this name is suggested.
    """
    longer = [one for one in known if one.startswith(f"{name}_")]
    near = longer if len(longer) == 1 else get_close_matches(str(name), known, n=1)
    if near:
        return f'did you mean "{near[0]}"?'
    return f"choose one of: {', '.join(known)}" if known else "none is defined"


def validate(model: type[M], document: Document, *, at: Key = ()) -> M:
    """Validate the values below the key `at` against a pydantic model, and return the model object.

    Raises BadInputError if values are invalid. The error lists all problems.
    """
    values: Any = document.values
    for part in at:
        values = values[part]
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = [_make_problem(item, model, document, at) for item in error.errors()]
        raise BadInputError(list(dict.fromkeys(problems))) from None


def _make_problem(error: Any, model: type[BaseModel], document: Document, at: Key) -> Problem:
    location: Key = tuple(error["loc"])
    name = location[-1] if location else ""
    if error["type"] == "missing":
        key = _find_key(document, (*at, *location[:-1]))
        return document.problem(key, f'"{name}" is missing', f'add "{name}"')
    key = _find_key(document, (*at, *location))
    if error["type"] == "extra_forbidden":
        known = _list_keys(model, location[:-1])
        return document.problem(key, f'unknown key "{name}"', did_you_mean(name, known))
    if error["type"] in MAPPING_ERROR_TYPES:
        return document.problem(
            key, f"the value is {_name_type(error['input'])}", "write a mapping of keys and values"
        )
    name = next((part for part in reversed(key) if isinstance(part, str)), "")
    return document.problem(key, *describe_value_error(error, name))


def describe_value_error(error: Any, name: str) -> tuple[str, str]:
    """Describe a pydantic error of the value `name`, and return the text and the remedy."""
    text = repr(error["input"])
    what = f"{text if len(text) <= 60 else f'{text[:57]}...'} is invalid"
    unit = find_unit(name)
    if error["type"] in NUMBER_ERROR_TYPES and unit not in ("", "1"):
        return what, f"write a number in {unit}, without the unit"
    raised = error.get("ctx", {}).get("error")
    return what, str(raised) if isinstance(raised, Exception) else error["msg"]


def _find_key(document: Document, location: Key) -> Key:
    """Return the parts of an error location from pydantic that are keys of the document.

    The location of an error in a union also contains the name of the chosen member.
    """
    key: list[str | int] = []
    values: Any = document.values
    for part in location:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            continue
        key.append(part)
    return tuple(key)


def _list_keys(model: type[BaseModel], location: Key) -> list[str]:
    """Return the keys that a model allows at the location of a pydantic error."""
    models = [model]
    for part in location:
        found = [one.model_fields[str(part)] for one in models if part in one.model_fields]
        inner = [one for field_info in found for one in _list_models(field_info.annotation)]
        models = inner or [one for one in models if _has_tag(one, part)] or models
    return sorted({name for one in models for name in one.model_fields})


def _list_models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models in an annotation, such as the members of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [one for inner in get_args(annotation) for one in _list_models(inner)]


def _has_tag(model: type[BaseModel], tag: str | int) -> bool:
    fields = model.model_fields.values()
    return any(
        get_origin(one.annotation) is Literal and tag in get_args(one.annotation) for one in fields
    )


@contextmanager
def edit_yaml(source: Path, copy: Path) -> Iterator[Any]:
    """Yield the tree of a YAML file, so that the caller can change it.

    When the context ends, the changed tree is written to `copy`. Comments and layout are preserved.
    """
    yaml = YAML(typ="rt", pure=True)
    yaml.width = 4096
    yaml.preserve_quotes = True
    yaml.indent(sequence=4, offset=2)
    tree = yaml.load(source.read_text(encoding="utf-8"))
    yield tree
    text = StringIO()
    yaml.dump(tree, text)
    write_file(copy, text.getvalue())
