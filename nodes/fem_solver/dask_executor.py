"""Provide an executor that runs functions on the workers of a `dask.distributed` scheduler.

A worker needs only the same version of this project, because each job contains its input data.
Import this module where it is used, because the import of `distributed` takes half a second.
"""

from __future__ import annotations

import socket
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import distributed

from flexsheet.nodes.fem_solver import precompute_table

untyped: Any = distributed
"""The module `distributed`, declared with the type Any because it has no annotations."""

CONNECT_S = 10.0
"""The timeout for the connection to a scheduler and for its first worker, in seconds."""
TRIES = 3
"""The maximum number of times that a job is repeated because its worker was lost."""


class SchedulerError(precompute_table.WorkersError):
    """Raised if the workers of a dask scheduler cannot be used."""

    remedy = "Check the scheduler's address, and that its workers run the same version."

    def __init__(self, address: str, what: str, remedy: str) -> None:
        super().__init__(
            f'scheduler "{address}": {what}; {remedy}, or set scheduler to null to use the '
            "processors of this computer"
        )


class DaskExecutor(Executor):
    """An executor that runs functions on the workers of a dask scheduler, and can cancel them."""

    def __init__(self, client: distributed.Client) -> None:
        self._client = client
        self._name = f"flexsheet-stop-{uuid.uuid4().hex}"
        self._stop = untyped.Event(self._name, client=client)
        self._executor = untyped.Client.get_executor(client, pure=False, retries=TRIES)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self._executor.submit(_run_stoppable, self._name, fn, args, kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Shut down the executor.

        wait: whether to wait for the pending functions. cancel_futures: whether to cancel pending
        functions and stop running functions. In this case, the method does not wait.
        """
        # Workers of a lost scheduler cannot be notified.
        if cancel_futures and self._client.status == "running":
            self._stop.set()
        self._executor.shutdown(wait=wait and not cancel_futures)


@contextmanager
def connect_workers(address: str, *, connect_s: float = CONNECT_S) -> Iterator[Executor]:
    """Connect to a dask scheduler, and yield an executor on its workers.

    When the context exits, running jobs are stopped. address: address of the scheduler, such as
    tcp://host:8786. connect_s: timeout. Raises SchedulerError if the scheduler does not answer or
    has no worker, or if a worker has another version of this project.
    """
    try:
        # Test the connection first, because closing a client that failed to connect is slow.
        with socket.create_connection(
            untyped.comm.get_address_host_port(address), timeout=connect_s
        ):
            pass
        client = untyped.Client(address, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SchedulerError(
            address, f"no scheduler answers ({error})", "start one with `dask scheduler`"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=connect_s)
        except TimeoutError as error:
            raise SchedulerError(
                address, "it has no worker", f"start some with `dask worker {address}`"
            ) from error
        _require_same_code(client, address)
        executor = DaskExecutor(client)
        try:
            yield executor
        finally:
            executor.shutdown(cancel_futures=True)


def _require_same_code(client: distributed.Client, address: str) -> None:
    """Raise SchedulerError if a worker lacks this project or has another version of it."""
    remedy = "install the same flexsheet version there and restart its workers"
    try:
        found = client.run(precompute_table.code_version)
    except ImportError as error:
        raise SchedulerError(
            address, f"a worker cannot import flexsheet ({error})", remedy
        ) from error
    for worker, version in found.items():
        if version != precompute_table.code_version():
            problem = f"the worker {worker} has another version ({version})"
            raise SchedulerError(address, problem, remedy)


def _run_stoppable(name: str, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    """Run a function in a dask worker. The function can query whether a stop is requested.

    name: name of the dask event that requests the stop.
    """
    stop_event = untyped.Event(name)
    token = precompute_table.stop_requested.set(stop_event.is_set)
    try:
        return fn(*args, **kwargs)
    finally:
        precompute_table.stop_requested.reset(token)
