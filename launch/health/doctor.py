"""Check the computer on which flexsheet runs, and state a remedy for each problem."""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from flexsheet.launch.health.opengl import OPENGL_REMEDY, find_opengl_problem
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.cpu import CpuWatch
from flexsheet.launch.running.priority import min_node_nice
from flexsheet.launch.running.runs import find_orphans, is_free, list_live_runs, root
from flexsheet.messages.busy import MAX_LOAD_RATIO, describe_busy_remedy, describe_pressure

DEMO = Path(__file__).parent.parent / "demo.yaml"
CLOCK_SOURCES = Path("/sys/devices/system/clocksource/clocksource0")
FAST_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter", "xen")
MIN_FREE_DISK_BYTES = 2 << 30
MIN_CORES = 2
PROBE_S = 1.0
"""The duration (s) of the measurement of the processor load."""

PROBE_PERIOD_S, PROBE_RUN_S = 1.0 / 140.0, 0.001
"""The cycle period (s) of an arm control node, and the node's processor time (s) per cycle."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check of this computer.

    what: text that describes the result.
    remedy: text that states what the user can do; empty if the check passed.
    """

    check: str
    state: Literal["ok", "warning", "failed"]
    what: str
    remedy: str = ""


def check_all() -> Iterator[Finding]:
    """Run all checks of this computer, and yield each result."""
    checks: tuple[Callable[[], Finding], ...] = (
        check_load,
        check_python,
        check_libraries,
        check_opencv,
        check_cameras,
        check_opengl,
        check_cores,
        check_disk,
        check_clock,
        check_sockets,
        check_leftovers,
        check_demo,
    )
    for check in checks:
        yield check()


def check_load() -> Finding:
    """Check whether a process with the load of an arm control node gets a processor in time.

    For the duration PROBE_S, the function uses a processor for PROBE_RUN_S in each PROBE_PERIOD_S.
    It measures how long it waits for the processor.
    """
    watch, own = CpuWatch(), {"this check": os.getpid()}
    watch.update(own, measure_programs=True)
    end_s = time.monotonic() + PROBE_S
    while (now_s := time.monotonic()) < end_s:
        while time.monotonic() < now_s + PROBE_RUN_S:
            pass
        time.sleep(PROBE_PERIOD_S - PROBE_RUN_S)
    pressure = watch.update(own, measure_programs=True)
    if pressure is None:
        load_ratio = os.getloadavg()[0] / (os.cpu_count() or 1)
        text = f"load {load_ratio:.1f} per core"
        busy = load_ratio > MAX_LOAD_RATIO
    else:
        text, busy = describe_pressure(pressure), pressure.busy
    if busy:
        what = f"this computer is busy: {text}"
        remedy = describe_busy_remedy(nice_denied=min_node_nice() >= 0)
        return Finding("load", "warning", what, remedy)
    return Finding("load", "ok", text)


def check_python() -> Finding:
    """Report the Python version.

    The version is not checked: if it were too old, this module could not be imported.
    """
    return Finding("python", "ok", f"{sys.version.split()[0]} at {sys.executable}")


def check_libraries() -> Finding:
    """Check that all libraries that flexsheet requires are installed."""
    try:
        requirements = requires("flexsheet") or []
    except PackageNotFoundError:
        return Finding(
            "libraries", "warning", "the package flexsheet is not installed", "run: make setup"
        )
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
        return Finding("libraries", "failed", what, "run: make setup")
    return Finding("libraries", "ok", f"all {len(names)} are installed")


def check_opencv() -> Finding:
    """Check that OpenCV can be imported, and list its video backends."""
    try:
        import cv2
    except ImportError as error:
        return Finding("opencv", "failed", str(error), "run: make setup")
    registry = cv2.videoio_registry
    names = dict.fromkeys(registry.getBackendName(one) for one in registry.getBackends())
    return Finding("opencv", "ok", f"{cv2.__version__}, cameras and files by {', '.join(names)}")


def check_cameras() -> Finding:
    """List the cameras that V4L2, Aravis and RealSense find."""
    from flexsheet.nodes.camera.captures import list_devices

    found = list_devices()
    return Finding("cameras", "ok", "; ".join(found) or "none found by v4l2, aravis or realsense")


def check_opengl() -> Finding:
    """Check that an OpenGL context can be created without a display."""
    problem = find_opengl_problem()
    if problem is None:
        return Finding("opengl", "ok", "a headless context can be created (EGL)")
    return Finding("opengl", "failed", problem, OPENGL_REMEDY)


def check_cores() -> Finding:
    """Check that this computer has enough processor cores."""
    cores = len(os.sched_getaffinity(0))
    if cores < MIN_CORES:
        what = f"this computer has only {cores} processor core"
        return Finding("cores", "warning", what, f"use a computer with at least {MIN_CORES} cores")
    return Finding("cores", "ok", str(cores))


def check_disk() -> Finding:
    """Check that the disk of the working folder has enough free space."""
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 2**30:.1f} GiB free at {Path.cwd()}"
    if free < MIN_FREE_DISK_BYTES:
        return Finding(
            "disk", "warning", text, "free some disk space: recording images needs 37 MB/s"
        )
    return Finding("disk", "ok", text)


def check_clock() -> Finding:
    """Check the source and the resolution of the clock that provides the timestamps of messages."""
    try:
        source = (CLOCK_SOURCES / "current_clocksource").read_text().strip()
    except OSError:
        source = "unknown"
    resolution_ns = time.get_clock_info("monotonic").resolution * 1e9
    text = f"{source}, resolution {resolution_ns:g} ns"
    if source not in (*FAST_CLOCKS, "unknown"):
        return Finding(
            "clock",
            "warning",
            text,
            "this source is slow; dmesg shows why the kernel does not use tsc",
        )
    return Finding("clock", "ok", text)


def check_sockets() -> Finding:
    """Check that the folder for the files and sockets of running graphs can be used."""
    directory = root()
    if not directory.exists():
        return Finding("sockets", "ok", f"{directory} will be created")
    status = directory.lstat()
    if status.st_uid != os.getuid() or not os.access(directory, os.W_OK | os.X_OK):
        return Finding(
            "sockets",
            "failed",
            f"{directory} belongs to another user or is not writable",
            "set FLEXSHEET_RUNS to another folder",
        )
    count = len(list_live_runs())
    running = "1 graph is running" if count == 1 else f"{count} graphs are running"
    return Finding("sockets", "ok", f"{directory}, {running}")


def check_leftovers() -> Finding:
    """Check that no node processes are left over from launchers that have ended."""
    found = find_orphans()
    if found:
        pids = ", ".join(str(process.pid) for process in found)
        return Finding(
            "leftovers",
            "warning",
            f"{len(found)} processes are left over from ended launchers: {pids}",
            "run: flexsheet doctor --sweep",
        )
    return Finding("leftovers", "ok", "none")


def check_demo() -> Finding:
    """Check that the launch file of the demo is valid and that its ports are free."""
    try:
        plan = load_graph(DEMO)
    except BadInputError as error:
        return Finding("demo", "failed", str(error))
    used = [port for _, port in plan.listening_nodes(None) if not is_free("127.0.0.1", port)]
    if used:
        what = f"ports in use: {', '.join(map(str, used))}"
        return Finding(
            "demo", "warning", what, "end the running graph, or choose other ports with --set"
        )
    return Finding("demo", "ok", f"{len(plan.nodes)} nodes, plan {plan.hash}, ports free")
