"""Define the errors of experiments, which run a graph and evaluate the recorded bag.

Some of them repeat experiments of Furukawa et al. 2007.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TypeVar

from flexsheet.launch.plans.documents import did_you_mean
from flexsheet.messages.errors import FlexsheetError

Entry = TypeVar("Entry")


class ExperimentError(FlexsheetError, RuntimeError):
    """Raised if an experiment failed, or a bag does not contain the data of the experiment."""

    code = "experiment"
    remedy = "Try `launch/demo.yaml` first. A bag must be a recording of the same experiment."


class ExperimentInterruptedError(ExperimentError):
    """Raised if SIGINT or SIGTERM ended an experiment; its nodes are stopped."""

    code = "experiment-interrupted"
    remedy = "Start the experiment again; a sweep continues with the trials that are missing."


def select_names(names: Sequence[str], known: Collection[str], kind: str) -> list[str]:
    """Check names and remove duplicates; without names, return all known names.

    kind: noun for the names in the error text. Raises ExperimentError for an unknown name.
    """
    for name in names:
        if name not in known:
            raise ExperimentError(f'unknown {kind} "{name}"; {did_you_mean(name, list(known))}')
    return list(dict.fromkeys(names or known))


def find_recorded(entries: Mapping[str, Entry], kind: str, label: str) -> Entry:
    """Return the entry of a bag with a label. Raises ExperimentError if it is missing.

    kind: noun for the entry in the error text.
    """
    if label not in entries:
        labels = ", ".join(entries) or "none"
        raise ExperimentError(
            f'the bag does not contain the {kind} "{label}"; it contains: {labels}'
        )
    return entries[label]
