"""Which errors are the user's to put right: told in a sentence, without a trace."""

from __future__ import annotations

import sys

from launch.bags.export import ExportError
from launch.experiments import ExperimentError
from launch.plans.documents import BadInputError
from launch.running.runs import RunDirectoryError
from launch.running.supervisor import NodeFailedError
from messages.bag import BagError
from messages.bus import BusError
from messages.files import DISK_ERRORS, FileWriteError
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
    FileWriteError,
)
LATE = {
    "messages.scene": "UnfitGeometryError",
    "nodes.fem_solver.mesh.solid": "UnfitMeshError",
    "nodes.fem_solver.newton": "NewtonNotConvergedError",
    "nodes.fem_solver.precompute_table": "WorkersError",
    "nodes.models.sheet.membrane": "NoEquilibriumError",
}
"""Failures of modules that take long to import; who has not imported one has not had its error."""


def is_failure(error: Exception) -> bool:
    """Has something failed that the user can put right?"""
    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
        return True
    late = (getattr(sys.modules[name], kind) for name, kind in LATE.items() if name in sys.modules)
    return isinstance(error, (*FAILURES, *late))
