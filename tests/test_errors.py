"""Test errors that are shown to users, and the remedies of notes."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest

from flexsheet.launch import cli
from flexsheet.launch.commands.output import BAD_INPUT, FAILED, CommandError
from flexsheet.launch.plans.documents import BadInputError, Problem
from flexsheet.messages.bag import BagError
from flexsheet.messages.errors import FlexsheetError, describe_error
from flexsheet.messages.notes import (
    FINGERTIP_REMEDIES,
    NOTE_REMEDIES,
    SELF_CHECK_FINDINGS,
    SELF_CHECK_REMEDIES,
    SHEET_REASON_TEXTS,
    NoteCode,
)
from flexsheet.messages.topics import UnknownTopicError, find_topic
from flexsheet.messages.types import FingertipReason, SheetReason, SuspectedCause

ROOT = Path(__file__).resolve().parent.parent


def kinds_of(kind: type[FlexsheetError]) -> list[type[FlexsheetError]]:
    """Return all imported subclasses of an error class."""
    derived = [one for one in kind.__subclasses__() if one.__module__.startswith("flexsheet.")]
    return derived + [below for one in derived for below in kinds_of(one)]


def test_every_error_class_describes_when_it_is_raised() -> None:
    for layer in ("messages", "nodes", "launch"):
        root = import_module(f"flexsheet.{layer}")
        for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            import_module(module.name)
    kinds = kinds_of(FlexsheetError)
    assert len(kinds) > 40
    for kind in kinds:
        assert kind.__doc__, kind.__name__
        assert kind.remedy == "" or kind.remedy.endswith("."), kind.__name__


def test_a_remedy_follows_the_text_of_an_error() -> None:
    assert describe_error(UnknownTopicError("so")) == "so"
    assert describe_error(BagError("a.mcap: damaged")) == f"a.mcap: damaged. {BagError.remedy}"


def test_every_reason_of_an_invalid_fingertip_has_a_remedy() -> None:
    reasons = set(get_args(FingertipReason)) - {"ok"}
    assert set(FINGERTIP_REMEDIES) == reasons


def test_every_reason_of_a_sheet_at_rest_has_a_text() -> None:
    reasons = set(get_args(SheetReason))
    assert set(SHEET_REASON_TEXTS) == reasons


def test_every_note_except_information_has_a_remedy() -> None:
    assert set(NOTE_REMEDIES) == set(NoteCode) - {NoteCode.INFO}


def test_every_cause_of_a_self_check_has_a_finding_and_a_remedy() -> None:
    causes = set(get_args(SuspectedCause))
    assert set(SELF_CHECK_FINDINGS) == set(SELF_CHECK_REMEDIES) == causes


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
