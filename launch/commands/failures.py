"""Which errors are the user's to put right: told in a sentence, without a trace."""

from __future__ import annotations

from launch.documents import BadInputError
from launch.experiments import ExperimentError
from launch.export import ExportError
from launch.runs import RunDirectoryError
from launch.supervisor import NodeFailedError
from messages.bag import BagError
from messages.bus import BusError
from messages.security import SecurityError

BAD_INPUTS: tuple[type[Exception], ...] = (BadInputError,)
FAILURES: tuple[type[Exception], ...] = (
    BusError,
    SecurityError,
    RunDirectoryError,
    BagError,
    ExperimentError,
    ExportError,
    NodeFailedError,
)
