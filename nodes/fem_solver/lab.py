"""The machines of a lab: the workers of a `dask.distributed` scheduler, as an executor.

A worker needs this project installed in the version that asks it, and nothing else: what is to be
solved travels with each job.  Imported late, as `distributed` takes half a second.
"""

from __future__ import annotations

import socket
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import distributed

from nodes.fem_solver import precompute_table

untyped: Any = distributed
"""What it takes and returns is not said in types."""

CONNECT_S = 10.0
"""A scheduler answers, and has a worker, within this time."""
TRIES = 3
"""A push whose worker is lost is given to others so many times."""


class LabError(precompute_table.WorkersError):
    """The lab's machines are of no use; the text names the parameter, its value and a remedy."""

    def __init__(self, address: str, what: str, remedy: str) -> None:
        super().__init__(
            f'scheduler "{address}": {what}; {remedy}, or set scheduler to null, for the '
            "processors of this machine"
        )


class LabExecutor(Executor):
    """Hands functions to a scheduler's workers, where they can be asked to stop."""

    def __init__(self, client: distributed.Client) -> None:
        self._client = client
        self._name = f"flexsheet-stop-{uuid.uuid4().hex}"
        self._stop = untyped.Event(self._name, client=client)
        self._executor = untyped.Client.get_executor(client, pure=False, retries=TRIES)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self._executor.submit(_until_told, self._name, fn, args, kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As `Executor.shutdown`; cancel_futures: what runs ends soon, too."""
        # a scheduler that is gone has nobody left to tell
        if cancel_futures and self._client.status == "running":
            self._stop.set()
        self._executor.shutdown(wait=wait and not cancel_futures)


@contextmanager
def lab_workers(address: str, *, connect_s: float = CONNECT_S) -> Iterator[Executor]:
    """The workers of the scheduler at an address such as tcp://host:8786; when left, what they are
    at ends.  LabError if it does not answer, has no worker, or one of other code."""
    try:
        # a client that cannot connect is slow to go away again: knock first
        with socket.create_connection(
            untyped.comm.get_address_host_port(address), timeout=connect_s
        ):
            pass
        client = untyped.Client(address, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise LabError(
            address, f"no scheduler answers ({error})", "start one with `dask scheduler`"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=connect_s)
        except TimeoutError as error:
            raise LabError(
                address, "it has no worker", f"start some with `dask worker {address}`"
            ) from error
        _require_same_code(client, address)
        executor = LabExecutor(client)
        try:
            yield executor
        finally:
            executor.shutdown(cancel_futures=True)


def _require_same_code(client: distributed.Client, address: str) -> None:
    """LabError if a worker cannot import this project, or has another version of it."""
    remedy = "install the same flexsheet there and start its workers anew"
    try:
        found = client.run(precompute_table.code_version)
    except ImportError as error:
        raise LabError(address, f"a worker lacks this project ({error})", remedy) from error
    for worker, version in found.items():
        if version != precompute_table.code_version():
            raise LabError(address, f"the worker {worker} has other code ({version})", remedy)


def _until_told(name: str, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    """In a worker: do it, stopping once the event of this name is set."""
    told = untyped.Event(name)
    token = precompute_table.asked_to_stop.set(told.is_set)
    try:
        return fn(*args, **kwargs)
    finally:
        precompute_table.asked_to_stop.reset(token)
