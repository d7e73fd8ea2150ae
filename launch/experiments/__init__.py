"""Run experiments on a graph, and evaluate the recorded bags.

Some experiments repeat experiments of Furukawa et al. 2007. This module defines the exceptions that
experiments raise.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TypeVar

from flexsheet.launch.plans.documents import BadInputError, did_you_mean
from flexsheet.messages.errors import FlexsheetError

Entry = TypeVar("Entry")


class ExperimentError(FlexsheetError, RuntimeError):
    """Raised if an experiment fails or a bag does not contain the data of the experiment."""


class OverloadedError(ExperimentError):
    """Raised if an experiment waits too long because the computer has too few free processors."""

    remedy = (
        "End other programs until the row `load` of `flexsheet doctor` is ok, and start the "
        "experiment again. Its nodes may wait for a processor in at most a quarter of the time, "
        "and need two free cores."
    )


class ExperimentInterruptedError(ExperimentError):
    """Raised after a signal has interrupted an experiment and its nodes have been stopped."""

    remedy = "Start the experiment again; a sweep continues with the trials that are missing."


class ArmsNotReadyError(ExperimentError):
    """Raised if the arms do not follow the sheet target in time."""

    remedy = "The notes of the arm bridges name the limit or the node that holds the arms."


def select_names(names: Sequence[str], known: Collection[str], kind: str) -> list[str]:
    """Return the given names without duplicates; if none are given, return all known names.

    kind: noun for the names in the error text. Raises BadInputError if a name is unknown.
    """
    for name in names:
        if name not in known:
            raise BadInputError.single(name, (), f"unknown {kind}", did_you_mean(name, list(known)))
    return list(dict.fromkeys(names or known))


def find_recorded(entries: Mapping[str, Entry], kind: str, label: str) -> Entry:
    """Return the entry of a bag that has the given label.

    entries: entries of the bag, by label. kind: noun for an entry in the error text.

    Raises ExperimentError if there is no such entry.
    """
    if label not in entries:
        labels = ", ".join(entries) or "none"
        raise ExperimentError(
            f'the bag does not contain the {kind} "{label}"; it contains: {labels}'
        )
    return entries[label]
