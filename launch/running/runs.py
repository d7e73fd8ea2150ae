"""Runs of graphs on this machine: their directories, which are alive, and what dead ones left.

A run is named after its launcher's process: pid, start time, and a count.  So anybody can tell
whether the launcher still lives, and a process tagged with a dead launcher's run is an orphan.
Imports are light: `flexsheet arms stop` finds the runs before it loads anything else.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import socket
import stat
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file

if TYPE_CHECKING:
    import psutil

    from flexsheet.messages.bus import Source

RUN_VARIABLE = "FLEXSHEET_RUN"
"""Environment variable that tags every process of a run."""

ROOT_VARIABLE = "FLEXSHEET_RUNS"
"""Environment variable that moves the directory of runs."""

FINISHED_RUNS_KEPT = 10
ORPHAN_GRACE_S = 3.5

HOST_FILE = "host"
_LAUNCHER_FILE = "launcher.json"
_BEGUN_PREFIX = ".begun-"
_count = itertools.count(1)


class RunDirectoryError(FlexsheetError, RuntimeError):
    """The directory of runs cannot be used."""

    code = "run-directory"
    remedy = "Set `FLEXSHEET_RUNS` to a folder of your own."


@dataclass(frozen=True, slots=True)
class Run:
    """A run and its directory: sockets, configurations, plan and logs."""

    id: str
    directory: Path

    @property
    def logs(self) -> Path:
        return self.directory / "logs"

    @property
    def plan_file(self) -> Path:
        return self.directory / "plan.json"

    @property
    def host(self) -> str | None:
        """The host whose nodes it has; None: all hosts of its plan."""
        try:
            return (self.directory / HOST_FILE).read_text()
        except FileNotFoundError:
            return None

    def is_alive(self) -> bool:
        """Whether its launcher still runs it."""
        return (self.directory / _LAUNCHER_FILE).exists() and launcher_is_alive(self.id)

    def end(self) -> None:
        """Remove what is of no use after the run; logs and plan stay for whoever asks why."""
        for entry in self.directory.iterdir():
            if stat.S_ISSOCK(entry.lstat().st_mode) or entry.name == _LAUNCHER_FILE:
                entry.unlink(missing_ok=True)


def ring_file(run: Run, host: str) -> Path:
    """What processes of `host` in a run read their keys from."""
    return run.directory / f"keys-{host}.json"


def local_endpoints(run: Run, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Endpoints of a plan with the run's directory filled in."""
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY

    return tuple(one.replace(RUN_DIRECTORY, str(run.directory)) for one in endpoints)


def local_sources(run: Run, sources: Iterable[Source]) -> tuple[Source, ...]:
    """Sources of a plan with the run's directory filled in."""
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY

    return tuple(
        replace(one, endpoint=one.endpoint.replace(RUN_DIRECTORY, str(run.directory)))
        for one in sources
    )


def root() -> Path:
    """The directory of this user's runs; short, since a socket's path has 107 bytes at most."""
    return Path(os.environ.get(ROOT_VARIABLE) or f"/tmp/flexsheet-{os.getuid()}")


def create_run() -> Run:
    """Make the directory of a new run of this process, closed to others."""
    directory = root()
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = directory.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise RunDirectoryError(
            f"{directory} belongs to somebody else; set {ROOT_VARIABLE} to a directory of your own"
        )
    directory.chmod(0o700)
    run_id = f"{os.getpid()}.{_start_ticks(os.getpid())}.{next(_count)}"
    run = Run(run_id, directory / run_id)
    # Under its name it is complete, so that no sweep of another launcher takes it for a dead run.
    begun = Run(run_id, directory / f"{_BEGUN_PREFIX}{run_id}")
    begun.directory.mkdir(mode=0o700)
    begun.logs.mkdir()
    marker = {"pid": os.getpid(), "pid_namespace": _pid_namespace()}
    write_file(begun.directory / _LAUNCHER_FILE, json.dumps(marker))
    begun.directory.rename(run.directory)
    return run


def all_runs() -> list[Run]:
    """All runs that have a directory, newest first."""
    if not root().is_dir():
        return []
    runs = [
        Run(entry.name, entry)
        for entry in root().iterdir()
        if entry.is_dir() and not entry.name.startswith(_BEGUN_PREFIX)
    ]
    return sorted(runs, key=lambda run: run.directory.stat().st_ctime_ns, reverse=True)


def live_runs() -> list[Run]:
    """Runs whose launcher lives, newest first."""
    return [run for run in all_runs() if run.is_alive()]


def launcher_is_alive(run_id: str) -> bool:
    """Whether the process that named the run is still there (and no other with its number)."""
    pid, _, rest = run_id.partition(".")
    start, _, _ = rest.partition(".")
    return pid.isdigit() and str(_start_ticks(int(pid))) == start


def orphans() -> list[psutil.Process]:
    """Processes of this user that are tagged with the run of a launcher that is gone."""
    import psutil

    found = []
    for process in psutil.process_iter():
        try:
            if process.uids().real != os.getuid() or process.pid == os.getpid():
                continue
            run_id = process.environ().get(RUN_VARIABLE)
            # In another namespace (a container's) the launcher's pid means another process.
            same_namespace = _pid_namespace(process.pid) == _pid_namespace()
            if run_id and same_namespace and not launcher_is_alive(run_id):
                found.append(process)
        except (psutil.Error, OSError):
            # One that may not be looked into, or has ended meanwhile: not ours to sweep.
            continue
    return found


def sweep() -> list[int]:
    """End orphans and tidy up the directories of dead runs; returns the pids that were ended."""
    import psutil

    found = orphans()
    _signal(found, signal.SIGTERM)
    _, alive = psutil.wait_procs(found, timeout=ORPHAN_GRACE_S)
    _signal(alive, signal.SIGKILL)
    psutil.wait_procs(alive, timeout=ORPHAN_GRACE_S)
    dead = [run for run in all_runs() if not run.is_alive() and _is_of_our_namespace(run)]
    for i, run in enumerate(dead):
        if i < FINISHED_RUNS_KEPT:
            run.end()
        else:
            shutil.rmtree(run.directory, ignore_errors=True)
    for begun in root().glob(f"{_BEGUN_PREFIX}*"):
        if not launcher_is_alive(begun.name.removeprefix(_BEGUN_PREFIX)):
            shutil.rmtree(begun, ignore_errors=True)
    return [process.pid for process in found]


def is_free(address: str, port: int) -> bool:
    """Whether a TCP port can be listened on."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


def _signal(processes: Iterable[psutil.Process], number: int) -> None:
    import psutil

    for process in processes:
        try:
            process.send_signal(number)
        except psutil.NoSuchProcess:
            continue


def _is_of_our_namespace(run: Run) -> bool:
    """Whether its launcher's pid means anything to us: a container may share the directory."""
    try:
        marker = json.loads((run.directory / _LAUNCHER_FILE).read_text())
    except FileNotFoundError:
        return True
    except ValueError:
        return False
    return bool(marker.get("pid_namespace") == _pid_namespace())


def _pid_namespace(pid: int | str = "self") -> int:
    return os.stat(f"/proc/{pid}/ns/pid").st_ino


def _start_ticks(pid: int) -> int | None:
    """Start time of a process in clock ticks since boot; None when it is gone or a zombie."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text[text.rindex(")") + 2 :].split()
    return None if fields[0] in "ZX" else int(fields[19])
