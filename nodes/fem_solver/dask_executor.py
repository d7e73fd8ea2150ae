"""Connect to the workers of a `dask.distributed` scheduler, to run functions on other computers.

A worker needs only the same version of this project, because each job contains its input data.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

from flexsheet.nodes.fem_solver import precompute_table

CONNECT_S = 10.0
"""The timeout for the connection to a scheduler and for its first worker, in seconds."""
TRIES = 3
"""The maximum number of times that a job is repeated because its worker was lost."""


class SchedulerError(precompute_table.WorkersError):
    """Raised if the workers of a dask scheduler cannot be used."""

    remedy = "Check the scheduler's address, and that its workers run the same version."


@contextmanager
def connect_workers(address: str, *, connect_s: float = CONNECT_S) -> Iterator[Executor]:
    """Connect to a dask scheduler, and yield an executor on its workers.

    When the context exits, pending jobs are cancelled; running jobs end on their own. address:
    address of the scheduler, such as tcp://host:8786. connect_s: timeout. Raises SchedulerError if
    `distributed` is not installed, if the scheduler does not answer or has no worker, or if a
    worker has another version of this project.
    """
    with _connect(address, connect_s) as client:
        executor = client.get_executor(pure=False, retries=TRIES)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)


def _connect(address: str, connect_s: float) -> Any:
    """Return a client of a scheduler whose workers have the version of this project."""
    import distributed  # an optional dependency that is slow to import

    untyped: Any = distributed
    remedy = f"start `dask scheduler` and `dask worker {address}`, or omit --scheduler"
    try:
        client = untyped.Client(address, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SchedulerError(f'no scheduler answers at "{address}" ({error}); {remedy}') from error
    wanted = precompute_table.code_version()
    try:
        client.wait_for_workers(1, timeout=connect_s)
        found = set(client.run(precompute_table.code_version).values())
    except (OSError, ImportError) as error:
        client.close()
        raise SchedulerError(
            f'the scheduler "{address}" has no worker with flexsheet ({error}); {remedy}'
        ) from error
    if found != {wanted}:
        client.close()
        raise SchedulerError(
            f'the workers of "{address}" have the versions {sorted(found)} of flexsheet, but this '
            f"computer has {wanted}; install the same version there and restart the workers"
        )
    return client
