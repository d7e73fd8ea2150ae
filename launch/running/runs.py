"""Manage the runs of graphs on this computer, with their directories and orphaned processes.

A run is one execution of a graph by a launcher. The name of a run consists of the launcher's
process id and start time, and a count. The name therefore shows whether the launcher is alive. A
process of a run whose launcher has exited is an orphan. This module imports few other modules,
because the emergency command `flexsheet arms stop` uses it and must start fast.
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
"""The environment variable that contains the run's name in every process of the run."""

ROOT_VARIABLE = "FLEXSHEET_RUNS"
"""The environment variable that replaces the default folder of all runs."""

MAX_FINISHED_RUNS = 10
ORPHAN_GRACE_S = 3.5

HOST_FILE = "host"
_LAUNCHER_FILE = "launcher.json"
_INCOMPLETE_PREFIX = ".begun-"
_count = itertools.count(1)


class RunDirectoryError(FlexsheetError, RuntimeError):
    """Raised if the folder of all runs cannot be used."""

    remedy = "Set `FLEXSHEET_RUNS` to a folder that belongs to you."


@dataclass(frozen=True, slots=True)
class Run:
    """An execution of a graph, with a directory for sockets, configurations, plan and logs."""

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
        """Return the host whose nodes the launcher started; None for the nodes of all hosts."""
        try:
            return (self.directory / HOST_FILE).read_text()
        except FileNotFoundError:
            return None

    @property
    def launch_file(self) -> str | None:
        """Return the launch file of the graph, or None if the plan is not written yet."""
        try:
            return str(json.loads(self.plan_file.read_text())["launch_file"])
        except FileNotFoundError:
            return None

    def is_alive(self) -> bool:
        """Return whether the run's launcher is alive and has not finished the run."""
        return (self.directory / _LAUNCHER_FILE).exists() and launcher_is_alive(self.id)

    def end(self) -> None:
        """Remove the sockets and the launcher's marker file. The plan and the logs remain."""
        for entry in self.directory.iterdir():
            if stat.S_ISSOCK(entry.lstat().st_mode) or entry.name == _LAUNCHER_FILE:
                entry.unlink(missing_ok=True)


def ring_file(run: Run, host: str) -> Path:
    """Return the key ring file of a host's processes."""
    return run.directory / f"keys-{host}.json"


def local_endpoints(run: Run, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Replace the placeholder of the run's directory in endpoints by the path of the directory."""
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY

    return tuple(one.replace(RUN_DIRECTORY, str(run.directory)) for one in endpoints)


def local_sources(run: Run, sources: Iterable[Source]) -> tuple[Source, ...]:
    """Insert the path of the run's directory into the endpoints of sources.

    The path replaces the placeholder RUN_DIRECTORY.
    """
    from flexsheet.launch.plans.plan_model import RUN_DIRECTORY

    return tuple(
        replace(one, endpoint=one.endpoint.replace(RUN_DIRECTORY, str(run.directory)))
        for one in sources
    )


def root() -> Path:
    """Return the folder of this user's runs.

    Its path is short, because the length of socket paths is limited.
    """
    return Path(os.environ.get(ROOT_VARIABLE) or f"/tmp/flexsheet-{os.getuid()}")


def create_run() -> Run:
    """Create the private directory of a new run.

    Raises RunDirectoryError if the folder of all runs cannot be used.
    """
    directory = root()
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = directory.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise RunDirectoryError(
            f"{directory} is not a folder, or belongs to another user; set {ROOT_VARIABLE} to a "
            "folder of this user"
        )
    directory.chmod(0o700)
    run_id = f"{os.getpid()}.{_start_ticks(os.getpid())}.{next(_count)}"
    run = Run(run_id, directory / run_id)
    # The directory gets its final name last, so that no other launcher removes it as a dead run.
    incomplete = Run(run_id, directory / f"{_INCOMPLETE_PREFIX}{run_id}")
    incomplete.directory.mkdir(mode=0o700)
    incomplete.logs.mkdir()
    marker = {"pid": os.getpid(), "pid_namespace": _pid_namespace()}
    write_file(incomplete.directory / _LAUNCHER_FILE, json.dumps(marker))
    incomplete.directory.rename(run.directory)
    return run


def list_runs() -> list[Run]:
    """Return all stored runs, newest first."""
    if not root().is_dir():
        return []
    runs = [
        Run(entry.name, entry)
        for entry in root().iterdir()
        if entry.is_dir() and not entry.name.startswith(_INCOMPLETE_PREFIX)
    ]
    return sorted(runs, key=lambda run: run.directory.stat().st_ctime_ns, reverse=True)


def list_live_runs() -> list[Run]:
    """Return the runs with a live launcher, newest first."""
    return [run for run in list_runs() if run.is_alive()]


def launcher_is_alive(run_id: str) -> bool:
    """Return whether the launcher of a run is alive.

    The process is identified by the process id and the start time in `run_id`.
    """
    pid, _, rest = run_id.partition(".")
    start, _, _ = rest.partition(".")
    return pid.isdigit() and str(_start_ticks(int(pid))) == start


def find_orphans() -> list[psutil.Process]:
    """Return this user's processes whose launchers have exited."""
    import psutil

    found = []
    for process in psutil.process_iter():
        try:
            if process.uids().real != os.getuid() or process.pid == os.getpid():
                continue
            run_id = process.environ().get(RUN_VARIABLE)
            # In the PID namespace of a container, the same pid denotes a different process.
            same_namespace = _pid_namespace(process.pid) == _pid_namespace()
            if run_id and same_namespace and not launcher_is_alive(run_id):
                found.append(process)
        except (psutil.Error, OSError):
            # The process has ended or may not be read; it is not an orphan of this user.
            continue
    return found


def sweep() -> list[int]:
    """End orphaned processes, and clean up the directories of ended runs.

    Return the ids of the processes that were ended.
    """
    import psutil

    found = find_orphans()
    _signal(found, signal.SIGTERM)
    _, alive = psutil.wait_procs(found, timeout=ORPHAN_GRACE_S)
    _signal(alive, signal.SIGKILL)
    psutil.wait_procs(alive, timeout=ORPHAN_GRACE_S)
    dead = [run for run in list_runs() if not run.is_alive() and _is_of_our_namespace(run)]
    for i, run in enumerate(dead):
        if i < MAX_FINISHED_RUNS:
            run.end()
        else:
            shutil.rmtree(run.directory, ignore_errors=True)
    for incomplete in root().glob(f"{_INCOMPLETE_PREFIX}*"):
        if not launcher_is_alive(incomplete.name.removeprefix(_INCOMPLETE_PREFIX)):
            shutil.rmtree(incomplete, ignore_errors=True)
    return [process.pid for process in found]


def is_free(address: str, port: int) -> bool:
    """Return whether a process can listen on a TCP port of an address."""
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
    """Return whether the run's launcher is in the same PID namespace as this process.

    A launcher in a container has its own namespace.
    """
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
    """Return the start time of a process in clock ticks since boot, or None if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text[text.rindex(")") + 2 :].split()
    return None if fields[0] in "ZX" else int(fields[19])
