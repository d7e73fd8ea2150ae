"""Test errors that are shown to users: codes, remedies and `flexsheet explain`."""

from __future__ import annotations

import pkgutil
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest

from flexsheet.launch import cli
from flexsheet.launch.commands.explain import (
    Entry,
    entries,
    explain,
    find_entries,
    state_problem,
)
from flexsheet.launch.commands.output import BAD_INPUT, FAILED, CommandError
from flexsheet.launch.plans.documents import BadInputError, Problem
from flexsheet.messages.bag import BagError
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.notes import (
    FINGERTIP_REASON_TEXTS,
    FINGERTIP_REMEDIES,
    SELF_CHECK_FINDINGS,
    SELF_CHECK_REMEDIES,
    SHEET_REASON_REMEDIES,
    SHEET_REASON_TEXTS,
)
from flexsheet.messages.topics import UnknownTopicError, find_topic
from flexsheet.messages.types import FingertipReason, SheetReason, SuspectedCause

ROOT = Path(__file__).resolve().parent.parent


def kinds_of(kind: type[FlexsheetError]) -> list[type[FlexsheetError]]:
    """Return all imported subclasses of an error class."""
    derived = [one for one in kind.__subclasses__() if one.__module__.startswith("flexsheet.")]
    return derived + [below for one in derived for below in kinds_of(one)]


def test_every_kind_of_error_has_its_own_code_and_remedy() -> None:
    codes = Counter(entry.code for entry in entries())
    assert set(codes.values()) == {1}
    for layer in ("messages", "nodes", "launch"):
        root = import_module(f"flexsheet.{layer}")
        for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            import_module(module.name)
    kinds = kinds_of(FlexsheetError)
    explained = {one.name: (one.code, one.remedy, one.phrase) for one in entries() if one.name}
    assert explained == {one.__name__: (one.code, one.remedy, one.phrase) for one in kinds}
    for kind in kinds:
        assert {"code", "remedy"} <= set(vars(kind)), f"{kind.__name__} lacks a code or a remedy"
        assert kind.__doc__


def test_every_reason_of_an_invalid_fingertip_has_a_remedy() -> None:
    reasons = set(get_args(FingertipReason)) - {"ok"}
    assert set(FINGERTIP_REMEDIES) == set(FINGERTIP_REASON_TEXTS) == reasons


def test_every_reason_of_a_sheet_at_rest_has_a_text_and_a_remedy() -> None:
    reasons = set(get_args(SheetReason))
    assert set(SHEET_REASON_TEXTS) == reasons
    assert set(SHEET_REASON_REMEDIES) == reasons - {"ok"}


def test_every_cause_of_a_self_check_has_a_finding_and_a_remedy() -> None:
    causes = set(get_args(SuspectedCause))
    assert set(SELF_CHECK_FINDINGS) == set(SELF_CHECK_REMEDIES) == causes


@pytest.mark.parametrize(
    ("text", "codes"),
    [
        ("bag", "bag"),
        ("BagError", "bag"),
        ("saturated", "saturated"),
        ("marker in one view", "marker_in_one_view"),
        ("The sheet holds its pose: the measured fingertip is too old.", "fingertip_too_old"),
        ("the handler of a message failed: UnreachableError: no joint angles", "unreachable"),
        ('unknown topic "fingr"; did you mean "finger"?', "unknown-topic"),
        ("no graph is running; start one with: flexsheet launch FILE", "no-graph"),
    ],
)
def test_a_code_a_class_or_a_text_is_explained(text: str, codes: str) -> None:
    found = find_entries(text)
    assert [one.code for one in found] == codes.split()
    assert all(one.meaning and one.remedy for one in found)


@pytest.mark.parametrize("text", ["xyzzy plugh", "the mesh of the table is late", "not readying"])
def test_a_text_that_only_shares_words_with_an_explanation_is_not_explained(text: str) -> None:
    assert find_entries(text) == []


def test_without_an_argument_all_codes_are_listed_with_their_meaning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    explain(message=None)
    printed = capsys.readouterr()
    assert "to print the remedy: flexsheet explain CODE" in printed.err
    lines = printed.out.splitlines()[1:]
    assert [line.split()[0] for line in lines] == [entry.code for entry in entries()]
    assert all(len(line.split()) > 2 for line in lines)


def test_meanings_state_the_problem_without_terms_of_the_source_code() -> None:
    assert state_problem("Raised if a bag cannot be read.") == "A bag cannot be read."
    assert not any("aised if" in one.meaning for one in entries())


def test_an_unknown_code_points_to_the_list_and_to_a_similar_code() -> None:
    with pytest.raises(CommandError, match=r'did you mean "unknown-topic".*`flexsheet explain`'):
        explain(message="unknwon-topic")
    with pytest.raises(CommandError, match="matches; `flexsheet explain` lists all codes"):
        explain(message="xyzzy plugh")


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UnknownTopicError("so"), BAD_INPUT),
        (BagError("so"), FAILED),
        (BadInputError([Problem("a.yaml:1", (), "so")]), BAD_INPUT),
        (CommandError("so", BAD_INPUT), BAD_INPUT),
        (ValueError("so"), None),
    ],
)
def test_errors_of_users_end_a_command_with_a_code(error: Exception, code: int | None) -> None:
    assert cli.exit_code(error) == code


def test_the_text_of_an_error_is_not_quoted() -> None:
    with pytest.raises(UnknownTopicError) as raised:
        find_topic("fingr")
    assert str(raised.value).startswith('unknown topic "fingr"')


def test_an_entry_of_an_error_has_the_first_paragraph_of_its_class() -> None:
    assert (
        Entry(
            code="unknown-topic",
            meaning=state_problem(" ".join((UnknownTopicError.__doc__ or "").split())),
            remedy=UnknownTopicError.remedy,
            name="UnknownTopicError",
            phrase="unknown topic",
        )
        in entries()
    )
