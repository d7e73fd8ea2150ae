"""Run the trials of a sweep as separate processes, and continue an interrupted sweep.

A trial is a process that prints its result, a row, as JSON. A sweep's folder has `sweep.json` with
its settings and one JSON file per trial. Trials whose row exists are not run again.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.files import write_file
from flexsheet.nodes.cache import EtaEstimator

Progress = Callable[[str], None]
Row = dict[str, Any]

SETTINGS_FILE = "sweep.json"
TRIAL_MODULE = "flexsheet.launch.experiments.trial"
POLL_S = 0.2
END_S = 20.0
"""The time (s) in which the process of a stopped trial must end the nodes that it started."""

MAX_ERROR_CHARACTERS = 600

_stop_requested: ContextVar[Callable[[], bool]] = ContextVar(
    "_stop_requested", default=lambda: False
)
"""A function that returns whether the trial of this thread must end."""


class TrialError(ExperimentError):
    """Raised if the process of a trial has ended without a result.

    It is raised in the parent process.
    """

    remedy = "Run the same experiment alone; the text names what failed."


def describe_graph(
    plan: ResolvedGraph, launch_file: Path, settings: Sequence[str]
) -> dict[str, Any]:
    """Return the properties of a sweep's graph that must not change when the sweep is continued."""
    return {
        "launch_file": str(launch_file.resolve()),
        "settings": list(settings),
        "scene": None if plan.scene is None else plan.scene["name"],
        "graph": plan.hash,
    }


def open_sweep(folder: Path, settings: Mapping[str, Any]) -> None:
    """Create the folder of a sweep, or check that an existing sweep has the same settings.

    Raises ExperimentError if a setting differs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / SETTINGS_FILE
    wanted = json.loads(json.dumps(settings))
    if not file.exists():
        write_file(file, json.dumps(wanted, indent=1) + "\n")
        return
    found = _read_json(file)
    for key in sorted({*wanted, *found}):
        if found.get(key) != wanted.get(key):
            raise ExperimentError(
                f"{file}: {key} is {found.get(key)!r}, but this sweep has {wanted.get(key)!r}; "
                "give another --output, or the same options to continue"
            )


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ExperimentError(f"{file}: cannot be read: {error}; delete the file") from error
    if not isinstance(content, dict):
        raise ExperimentError(f"{file}: contains no JSON object; delete the file")
    return content


def read_rows(folder: Path, names: Mapping[str, Any]) -> dict[str, Row]:
    """Return the result rows of successful trials; the keys are the names of the trials."""
    files = {name: folder / f"{name}.json" for name in names}
    rows = {name: _read_json(file) for name, file in files.items() if file.exists()}
    return {name: row for name, row in rows.items() if "error" not in row}


def run_sweep(
    folder: Path,
    settings: Mapping[str, Any],
    trials: Mapping[str, Mapping[str, Any]],
    progress: Progress,
    *,
    workers: int = 1,
) -> dict[str, Row]:
    """Run all trials that have no result row yet, and return the rows of all trials.

    The keys are the names of the trials, in the order of `trials`. A failed trial has a row with
    the key `error`, and does not stop other trials.

    trials: descriptions of the trials for the module `trial`, with trial names as keys.
    workers: number of simultaneous trials.
    """
    open_sweep(folder, settings)
    done = read_rows(folder, trials)
    missing = [name for name in trials if name not in done]
    rows: dict[str, Row] = dict(done)
    eta = EtaEstimator()

    def report() -> None:
        if missing:
            left = eta.text(len(rows) - len(done), len(missing), time.monotonic())
            progress(f"{len(rows)} of {len(trials)} trials: {left}")

    if done:
        progress(f"{len(done)} of {len(trials)} trials are finished in {folder}")
    report()
    with _interruptible(), _executor(workers) as executor:
        waiting: dict[Future[Row], str] = {
            executor.submit(execute_trial, dict(trials[name])): name for name in missing
        }
        for future in as_completed(waiting):
            name = waiting[future]
            try:
                row = future.result()
            except TrialError as error:
                row = {"error": str(error)}
                progress(f"{name} failed: {error}")
            write_file(folder / f"{name}.json", json.dumps(row, indent=1) + "\n")
            rows[name] = row
            report()
    return {name: rows[name] for name in trials}


@contextmanager
def _interruptible() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _executor(workers: int) -> Iterator[Executor]:
    """Yield an executor for trials; if the context ends with an error, stop the running trials."""
    stop = threading.Event()
    threads = ThreadPoolExecutor(workers, initializer=lambda: _stop_requested.set(stop.is_set))
    try:
        yield threads
    except BaseException:
        stop.set()
        raise
    finally:
        threads.shutdown(wait=True, cancel_futures=True)


def execute_trial(trial: Mapping[str, Any]) -> Row:
    """Run one trial in a separate process, and return its result row.

    Raises TrialError if the process fails, or if a stop was requested.
    """
    must_stop = _stop_requested.get()
    process = subprocess.Popen(
        [sys.executable, "-m", TRIAL_MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl-C must reach only the sweep, which then ends its trials in order.
        start_new_session=True,
    )
    given: str | None = json.dumps(trial)
    while True:
        try:
            output, errors = process.communicate(given, timeout=POLL_S)
            break
        except subprocess.TimeoutExpired:
            given = None
            if must_stop():
                _end(process)
                raise TrialError("the trial was interrupted; start the sweep again") from None
    if process.returncode != 0:
        last_line = errors.strip().rpartition("\n")[2][-MAX_ERROR_CHARACTERS:]
        raise TrialError(
            last_line or f"the trial ended with status {process.returncode} and no error message"
        )
    try:
        row = json.loads(output.splitlines()[-1])
    except (IndexError, ValueError) as error:
        raise TrialError(
            f"the last line that the trial printed is not a JSON result: {error}"
        ) from error
    return dict(row)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=END_S)
    # End the whole process group. Its child processes would continue and keep the pipes open.
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def raise_if_all_failed(rows: Mapping[str, Row], folder: Path) -> None:
    """Raise ExperimentError if no trial has a result."""
    errors = [row["error"] for row in rows.values() if "error" in row]
    if errors and len(errors) == len(rows):
        raise ExperimentError(
            f"all {len(rows)} trials failed; see {folder}; the last: {errors[-1]}"
        )
