"""The paper's experiments, run on a graph and evaluated from the recorded bags."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from flexsheet.messages.errors import FlexsheetError

Entry = TypeVar("Entry")


class ExperimentError(FlexsheetError, RuntimeError):
    """Raised for an experiment that failed, or a bag without the expected recording."""

    code = "experiment"
    remedy = "Try `launch/demo.yaml` first. A bag must be a recording of the same experiment."


def find_recorded(entries: Mapping[str, Entry], kind: str, label: str) -> Entry:
    """Return a bag's entry with that label.  Raises ExperimentError if it is missing."""
    if label not in entries:
        labels = ", ".join(entries) or "none"
        raise ExperimentError(
            f'the bag does not contain the {kind} "{label}"; it contains: {labels}'
        )
    return entries[label]
