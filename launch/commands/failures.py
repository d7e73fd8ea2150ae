"""Which errors are the user's to put right: told in a sentence, without a trace."""

from __future__ import annotations

import sys

from flexsheet.launch.bags.export import ExportError
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.running.runs import RunDirectoryError
from flexsheet.launch.running.supervisor import NodeFailedError
from flexsheet.messages.bag import BagError
from flexsheet.messages.bus import BusError
from flexsheet.messages.files import DISK_ERRORS, FileWriteError
from flexsheet.messages.security import SecurityError

BAD_INPUTS: tuple[type[Exception], ...] = (BadInputError,)
FAILURES: tuple[type[Exception], ...] = (
    BusError,
    SecurityError,
    RunDirectoryError,
    BagError,
    ExperimentError,
    ExportError,
    NodeFailedError,
    FileWriteError,
)
LATE = {
    "flexsheet.messages.scene": "UnfitGeometryError",
    "flexsheet.nodes.fem_solver.mesh.solid": "UnfitMeshError",
    "flexsheet.nodes.fem_solver.newton": "NewtonNotConvergedError",
    "flexsheet.nodes.fem_solver.precompute_table": "WorkersError",
    "flexsheet.nodes.models.sheet.membrane": "NoEquilibriumError",
}
"""Failures of modules that take long to import; who has not imported one has not had its error."""


def is_failure(error: Exception) -> bool:
    """Has something failed that the user can put right?"""
    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
        return True
    late = (getattr(sys.modules[name], kind) for name, kind in LATE.items() if name in sys.modules)
    return isinstance(error, (*FAILURES, *late))
