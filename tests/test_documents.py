"""Test that launch files and scenes that are too large, too deeply nested or not text are
rejected.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from ruamel.yaml import YAML

from flexsheet.launch.plans import documents
from flexsheet.launch.plans.documents import MAX_VALUES, BadInputError, read_document, validate
from flexsheet.launch.plans.plan import load_graph

MAX_TOKENS = 20 * MAX_VALUES

HOSTILE = {
    "many keys": (
        "".join(f"k{i}: {i}\n" for i in range(20_000)),
        "the file has more than 5000 values",
    ),
    "keys in one line": ("{" + ", ".join(f"k{i}: 1" for i in range(20_000)) + "}", "values"),
    "many items": ("a:\n" + "- 1\n" * 60_000, "values"),
    "deep brackets": ("a: " + "[" * 5000 + "]" * 5000, "nested"),
    "deep dashes": ("a:\n  " + "- " * 60_000 + "1", "nested"),
    "deep indentation": ("\n".join(" " * i + "a:" for i in range(600)), "nested"),
    "billion laughs": (
        "a0: &a0 [1,1,1,1,1,1,1,1,1,1]\n"
        + "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)),
        "values",
    ),
    "merged again and again": (
        "a0: &a0 {k: 1}\n"
        + "".join(f"a{i}: &a{i} {{<<: *a{i - 1}, k{i}: 1}}\n" for i in range(1, 200)),
        "values",
    ),
    "a value within itself": ("a: &a [*a]\n", ""),
    "a huge text": ("a: " + "x" * 300_000, "characters"),
    "a huge number": ("a: " + "9" * 100_000, "cannot be read"),
    "an odd tag": ("a: !!python/object/apply:os.system [ls]\n", ""),
    "a key that is a list": ("? [1, 2]\n: 3\n", "a key is a list or a mapping"),
    "a list": ("- 1\n", "the file is a list"),
    "a text": ("hello\n", "the file is a text"),
    "nothing": ("", "the file is empty"),
}  # fmt: skip


@pytest.fixture
def tokens(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the YAML tokens that a test has read from a file."""
    counted = [0]
    scan = YAML.scan

    def count(self: Any, stream: Any) -> Iterator[Any]:
        for token in scan(self, stream):
            counted[0] += 1
            yield token

    monkeypatch.setattr(documents.YAML, "scan", count)
    return counted


@pytest.mark.parametrize("name", list(HOSTILE))
def test_a_hostile_file_is_rejected_with_little_work(
    tmp_path: Path, tokens: list[int], name: str
) -> None:
    text, printed = HOSTILE[name]
    file = tmp_path / "graph.yaml"
    file.write_text(text)
    with pytest.raises(BadInputError) as refused:
        load_graph(file)
    assert str(file) in str(refused.value)
    assert printed in str(refused.value)
    assert "Commented" not in str(refused.value)
    assert len(str(refused.value)) < 1000
    assert tokens[0] < MAX_TOKENS


def test_what_is_no_utf_8_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "graph.yaml"
    file.write_bytes(b"nodes: {a: \xff\xfe}\n")
    with pytest.raises(BadInputError, match="the file is not UTF-8 text"):
        read_document(file)


@pytest.mark.parametrize(
    "text", ["nodes: 3\n", "nodes: {a: 3}\n", "nodes: {a: {type: clock, restart: [1]}}\n"]
)
def test_errors_name_no_class(tmp_path: Path, text: str) -> None:
    file = tmp_path / "graph.yaml"
    file.write_text(text)
    with pytest.raises(BadInputError) as refused:
        load_graph(file)
    assert "write a mapping of keys and values" in str(refused.value)
    for word in ("instance", "dictionary", "Spec"):
        assert word not in str(refused.value)


class Choice(BaseModel):
    """A model with error texts and keys that resemble those of pydantic."""

    model_config = ConfigDict(extra="forbid")

    either: int | str = 0
    method: Literal["a", "b"] | Literal["auto"] | float = "auto"
    by_name: dict[Annotated[str, Field(pattern="^[a-z]+$")], int] = {}
    checked: int = 0

    @field_validator("checked")
    @classmethod
    def _refuse(cls, value: int) -> int:
        raise ValueError(f"Value error, {value} is refused")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("either: [1]", ("either",)),
        ("method: c", ("method",)),
        ("by_name: {'literal[a]': 1}", ("by_name", "literal[a]")),
        ("by_name: {a: b}", ("by_name", "a")),
    ],
)
def test_a_problem_names_a_key_that_the_file_has(
    tmp_path: Path, text: str, key: tuple[str, ...]
) -> None:
    file = tmp_path / "choice.yaml"
    file.write_text(text)
    with pytest.raises(BadInputError) as caught:
        validate(Choice, read_document(file))
    assert {problem.key for problem in caught.value.problems} == {key}
    assert {problem.where for problem in caught.value.problems} == {f"{file}:1"}


class Side(Enum):
    LEFT = "left"
    RIGHT = "right"


class Twin(BaseModel):
    kind: Literal["twin"]


class Live(BaseModel):
    kind: Literal["live"]


class Values(BaseModel):
    """A model with a value for each type of pydantic error."""

    above_pa: float = Field(1.0, gt=0.0)
    least_m: float = Field(1.0, ge=0.5)
    most: int = Field(1, le=3)
    finite_rad: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    whole: int = 0
    choice: Literal["a", "b"] = "a"
    side: Side = Side.LEFT
    name: str = ""
    on: bool = False
    pair: tuple[int, int] = (0, 0)
    source: Annotated[Twin | Live, Field(discriminator="kind")] = Twin(kind="twin")
    some: Annotated[list[int], Field(min_length=2)] = [0, 0]


INVALID = {
    "greater_than": ("above_pa", "-1"),
    "less_than_equal": ("most", "4"),
    "finite_number": ("finite_rad", ".inf"),
    "int_from_float": ("whole", "1.5"),
    "literal_error": ("choice", "c"),
    "enum": ("side", "c"),
    "union_tag_invalid": ("source", "{kind: twn}"),
    "union_tag_not_found": ("source", "{}"),
    "string_type": ("name", "3"),
    "bool_parsing": ("on", "maybe"),
    "tuple_type": ("pair", "3"),
    "too_short": ("some", "[1]"),
}
"""The key and an invalid value for types of pydantic errors."""


@pytest.mark.parametrize("type_", list(INVALID))
def test_an_invalid_value_is_reported_with_the_text_of_pydantic(tmp_path: Path, type_: str) -> None:
    key, value = INVALID[type_]
    file = tmp_path / "values.yaml"
    file.write_text(f"{key}: {value}")
    document = read_document(file)
    with pytest.raises(ValidationError) as library:
        Values.model_validate(document.values)
    (error,) = library.value.errors()
    assert error["type"] == type_
    with pytest.raises(BadInputError) as caught:
        validate(Values, document)
    what = f"{document.values[key]!r} is invalid"
    (problem,) = caught.value.problems
    assert problem == documents.Problem(f"{file}:1", (key,), what, error["msg"])


def test_a_number_with_its_unit_is_reported_with_the_unit_of_the_key(tmp_path: Path) -> None:
    file = tmp_path / "values.yaml"
    file.write_text("least_m: 45 mm")
    with pytest.raises(BadInputError) as caught:
        validate(Values, read_document(file))
    (problem,) = caught.value.problems
    assert problem.key == ("least_m",)
    assert problem.remedy == "write a number in m, without the unit"


def test_the_text_of_a_validator_is_shown_unchanged(tmp_path: Path) -> None:
    file = tmp_path / "choice.yaml"
    file.write_text("checked: 3")
    with pytest.raises(BadInputError) as caught:
        validate(Choice, read_document(file))
    assert caught.value.problems[0].remedy == "Value error, 3 is refused"
