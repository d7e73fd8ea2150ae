"""Test the measured waiting time for a processor, and the reports of a busy computer."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from flexsheet.launch.running.cpu import MAX_WAIT_RATIO, WINDOW_S, CpuMeter, CpuWatch
from flexsheet.messages.busy import describe_busy, describe_busy_remedy, is_busy
from flexsheet.messages.types import CpuPressure, HostStatus, ProgramCpu

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class ProcFiles:
    """A folder with the counters of processes in the kernel's format, and a clock."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.now_s = folder, 100.0
        self.watch = CpuWatch(folder, lambda: self.now_s)
        self._waited_s: dict[int, float] = {}
        self._used_s: dict[int, float] = {}
        (folder / "pressure").mkdir()

    def let(self, name: str, pid: int, *, wait_s: float = 0.0, run_s: float = 0.0) -> None:
        """Add waiting time and processor time to the counters of a process."""
        self._waited_s[pid] = self._waited_s.get(pid, 0.0) + wait_s
        self._used_s[pid] = self._used_s.get(pid, 0.0) + run_s
        folder = self.folder / str(pid)
        thread = folder / "task" / str(pid)
        thread.mkdir(parents=True, exist_ok=True)
        run_ns, wait_ns = round(1e9 * self._used_s[pid]), round(1e9 * self._waited_s[pid])
        (folder / "schedstat").write_text(f"{run_ns} {wait_ns} 7\n")
        ticks = round(self._used_s[pid] * TICKS_PER_S)
        stat = f"{pid} ({name}) S {'0 ' * 10}{ticks} 0 0 0 20 0 1 0 5\n"
        (folder / "stat").write_text(stat)
        (thread / "stat").write_text(stat)


@pytest.fixture
def kernel(tmp_path: Path) -> ProcFiles:
    return ProcFiles(tmp_path)


ARMS = {"left": 11, "right": 12}


def run(kernel: ProcFiles, seconds: int, *, left_s: float, right_s: float) -> CpuPressure | None:
    """Let the nodes of both arms wait for a part of each second."""
    found = None
    for _ in range(seconds):
        kernel.let("python", 11, wait_s=left_s, run_s=0.3)
        kernel.let("python", 12, wait_s=right_s, run_s=0.2)
        kernel.let("Web Content (1)", 20, run_s=1.5)
        kernel.now_s += 1.0
        found = kernel.watch.update(ARMS)
    return found


def test_the_first_sample_reports_nothing(kernel: ProcFiles) -> None:
    assert run(kernel, 1, left_s=0.9, right_s=0.9) is None


def test_a_quiet_computer_is_not_busy(kernel: ProcFiles) -> None:
    found = run(kernel, 10, left_s=0.02, right_s=0.05)
    assert found is not None
    assert found.wait_ratio == pytest.approx(0.05)
    assert (found.busy, found.node, found.programs) == (False, "right", ())


def test_a_busy_computer_names_who_waits_and_who_runs(kernel: ProcFiles) -> None:
    found = run(kernel, 10, left_s=0.6, right_s=0.3)
    assert found is not None
    assert found.wait_ratio == pytest.approx(0.6)
    assert (found.busy, found.node) == (True, "left")
    assert [one.name for one in found.programs] == ["Web Content (1)", "left", "right"]
    assert [one.cores for one in found.programs] == pytest.approx([1.5, 0.3, 0.2])


def test_a_wait_that_began_before_the_window_is_at_most_all_of_the_window(
    kernel: ProcFiles,
) -> None:
    """The kernel adds a wait of 8 s to the counter at the end of the wait."""
    run(kernel, 10, left_s=0.0, right_s=0.0)
    found = run(kernel, 1, left_s=8.0, right_s=0.0)
    assert found is not None
    assert (found.node, found.wait_ratio) == ("left", 1.0)


def test_what_is_long_past_does_not_count(kernel: ProcFiles) -> None:
    run(kernel, 10, left_s=0.9, right_s=0.9)
    found = run(kernel, int(WINDOW_S) + 1, left_s=0.0, right_s=0.0)
    assert found is not None
    assert found.wait_ratio < MAX_WAIT_RATIO
    assert not found.busy


def test_a_restarted_process_starts_from_zero(kernel: ProcFiles) -> None:
    run(kernel, 5, left_s=0.01, right_s=0.01)
    kernel.now_s += 1.0
    found = kernel.watch.update({"left": 11, "right": 99})
    assert found is not None
    assert found.node == "left"
    assert kernel.watch.update({"right": 99}) is None


def test_a_process_that_has_just_started_does_not_count_as_starved(kernel: ProcFiles) -> None:
    kernel.watch = CpuWatch(kernel.folder, lambda: kernel.now_s, min_s=1.5)
    assert run(kernel, 2, left_s=0.95, right_s=0.0) is None
    found = run(kernel, 1, left_s=0.95, right_s=0.0)
    assert found is not None
    assert (found.node, found.wait_ratio) == ("left", pytest.approx(0.95))


def test_the_processor_time_of_threads_is_measured(kernel: ProcFiles) -> None:
    meter = CpuMeter(kernel.folder, lambda: kernel.now_s)
    measured = []
    for pids in ([11, 12], [11, 12], [11, 12, 13, 99]):
        for pid, run_s in ((11, 0.5), (12, 1.0), (13, 3.0)):
            kernel.let("python", pid, run_s=run_s)
        kernel.now_s += 2.0
        measured.append(meter.measure_cores({pid: [pid] for pid in pids}))
    # Thread 13 was not measured before, and process 99 does not exist.
    assert measured == pytest.approx([0.0, 0.75, 0.75])


def test_the_kernel_of_this_computer_has_the_counters() -> None:
    watch = CpuWatch()
    assert watch.can_measure
    assert watch.update({"test": os.getpid()}) is None
    found = watch.update({"test": os.getpid()})
    assert found is not None
    assert found.wait_ratio >= 0.0


def host(**values: Any) -> HostStatus:
    return HostStatus(
        host="main", run="1", plan_hash="", code="", python="3.11", uptime_s=1.0,
        disk_free_bytes=0, memory_free_bytes=0, nodes=(), missing_devices=(),
        **{"load_ratio": 0.5} | values,
    )  # fmt: skip


def test_a_busy_computer_is_described_by_node_and_programs() -> None:
    programs = (ProgramCpu(name="chromium", cores=1.34), ProgramCpu(name="renderer", cores=0.4))
    cpu = CpuPressure(busy=True, wait_ratio=0.61, node="twin_arms", programs=programs)
    assert is_busy(host(cpu=cpu))
    assert describe_busy(host(cpu=cpu)) == (
        "the computer main is busy: twin_arms waits for a processor 61% of the time; "
        "cores in use: chromium 1.3, renderer 0.4"
    )


def test_only_nodes_without_their_priority_are_advised_to_get_it() -> None:
    assert "end other programs" in describe_busy_remedy(nice_denied=False)
    assert "priority" not in describe_busy_remedy(nice_denied=False)
    assert "CAP_SYS_NICE" in describe_busy_remedy(nice_denied=True)


def test_where_waiting_is_not_measured_the_load_decides() -> None:
    assert not is_busy(host(load_ratio=1.4))
    assert describe_busy(host(load_ratio=1.4)) == ""
    assert describe_busy(host(load_ratio=8.14)) == (
        "the computer main is busy: 8.1 runnable processes per core"
    )


def test_a_load_of_low_priority_programs_makes_no_computer_busy() -> None:
    cpu = CpuPressure(busy=False, wait_ratio=0.1, node="planner")
    assert not is_busy(host(load_ratio=8.0, cpu=cpu))
