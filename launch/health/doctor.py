"""Check the computer on which flexsheet runs, and state a remedy for each problem."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from flexsheet.launch.health.opengl import OPENGL_REMEDY, find_opengl_problem
from flexsheet.launch.running.runs import find_orphans, list_live_runs, root
from flexsheet.messages.busy import BUSY_REMEDY, MAX_LOAD_RATIO

MIN_FREE_DISK_BYTES = 2 << 30

State = Literal["ok", "warning", "failed", "not asked"]


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check of a host.

    host: name of the host in the launch file; empty: this computer, without a launch file.
    what: text that describes the result.
    remedy: text that states what the user can do; empty if the check passed.
    """

    host: str
    check: str
    state: State
    what: str
    remedy: str = ""


def check_computer() -> Iterator[Finding]:
    """Run all checks of this computer, and yield each result."""
    yield check_load()
    yield check_libraries()
    yield check_cameras()
    yield check_opengl()
    yield check_disk(Path.cwd())
    yield check_runs_folder()
    yield check_leftovers()


def check_load() -> Finding:
    """Check whether more processes want to run than this computer has cores."""
    load_ratio = os.getloadavg()[0] / (os.cpu_count() or 1)
    text = f"{load_ratio:.1f} runnable processes per core"
    if load_ratio > MAX_LOAD_RATIO:
        return Finding("", "load", "warning", f"this computer is busy: {text}", BUSY_REMEDY)
    return Finding("", "load", "ok", text)


def check_libraries(host: str = "") -> Finding:
    """Check that all libraries that flexsheet requires are installed."""
    try:
        requirements = requires("flexsheet") or []
    except PackageNotFoundError:
        what = "the package flexsheet is not installed"
        return Finding(host, "libraries", "warning", what, "run: make setup")
    missing = []
    names = [
        match[0]
        for line in requirements
        if "extra ==" not in line and (match := re.match(r"[A-Za-z0-9._-]+", line))
    ]
    for name in names:
        try:
            version(name)
        except PackageNotFoundError:
            missing.append(name)
    if missing:
        what = f"these required libraries are not installed: {', '.join(missing)}"
        return Finding(host, "libraries", "failed", what, "run: make setup")
    return Finding(host, "libraries", "ok", f"all {len(names)} are installed")


def check_cameras() -> Finding:
    """List the cameras that V4L2, Aravis and RealSense find."""
    from flexsheet.nodes.camera.captures import list_devices

    what = "; ".join(list_devices()) or "none found by v4l2, aravis or realsense"
    return Finding("", "cameras", "ok", what)


def check_opengl(host: str = "") -> Finding:
    """Check that an OpenGL context can be created without a display."""
    problem = find_opengl_problem()
    if problem is None:
        return Finding(host, "opengl", "ok", "a headless context can be created (EGL)")
    return Finding(host, "opengl", "failed", problem, OPENGL_REMEDY)


def check_disk(folder: Path, host: str = "") -> Finding:
    """Check that the disk of a folder has enough free space for recordings."""
    free_bytes = shutil.disk_usage(folder if folder.is_dir() else Path.cwd()).free
    return check_free_disk(free_bytes, host)


def check_free_disk(free_bytes: int, host: str) -> Finding:
    what = f"{free_bytes / 2**30:.1f} GiB free"
    if free_bytes < MIN_FREE_DISK_BYTES:
        remedy = "free some disk space for bags: recording images needs 37 MB/s"
        return Finding(host, "disk", "warning", what, remedy)
    return Finding(host, "disk", "ok", what)


def check_runs_folder() -> Finding:
    """Check that the folder for the files and sockets of running graphs can be used."""
    directory = root()
    if not directory.exists():
        return Finding("", "runs", "ok", f"{directory} will be created")
    status = directory.lstat()
    if status.st_uid != os.getuid() or not os.access(directory, os.W_OK | os.X_OK):
        what = f"{directory} belongs to another user or is not writable"
        return Finding("", "runs", "failed", what, "set FLEXSHEET_RUNS to another folder")
    return Finding("", "runs", "ok", f"{directory}, running graphs: {len(list_live_runs())}")


def check_leftovers() -> Finding:
    """Check that no node processes are left over from launchers that have ended."""
    found = find_orphans()
    if found:
        pids = ", ".join(str(process.pid) for process in found)
        what = f"{len(found)} processes are left over from ended launchers: {pids}"
        return Finding("", "leftovers", "warning", what, "run: flexsheet doctor --sweep")
    return Finding("", "leftovers", "ok", "none")
