"""Start a process that runs one or more nodes, read its log and its heartbeats, and reap it.

The launcher needs no threads. Its event loop waits for process file descriptors (pidfds), which
report the exit of a process, and for pipes with the logs and heartbeats of processes.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping

from flexsheet.launch.running.runs import Run
from flexsheet.messages.files import write_file
from flexsheet.nodes.runner import ProcessConfig

LIVENESS_PERIOD_S = 0.5
STACK_DUMP_S = 0.5
"""The time (s) for which a hanging node can log its call stacks before SIGKILL ends it."""

LOG_READ_BYTES = 65_536

Report = Callable[[str, str], None]
"""A function that is called with (node, line) for each log line.

For log lines of the launcher, `node` is "launch".
"""


class Child:
    """A process of the operating system that runs one or more nodes. It has its own session.

    lifeline: file descriptor of a pipe that the process inherits. When the pipe closes, the process
        ends.
    """

    def __init__(
        self,
        config: ProcessConfig,
        run: Run,
        environment: Mapping[str, str],
        lifeline: int,
        report: Report,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._name, self._report = config.name, report
        self.ready: asyncio.Future[None] = self._loop.create_future()
        self.exited: asyncio.Future[int] = self._loop.create_future()
        self._partial = b""
        self._beats = 0
        self._reports = True
        self._logs = {
            name: (run.logs / f"{name}.log").open("ab", buffering=0)
            for name in {config.name, *(node.name for node in config.nodes)}
        }
        self._output, output_write = os.pipe()
        self._heartbeats, heartbeats_write = os.pipe()
        config_file = run.directory / f"{config.name}.json"
        # During the start of Python, SIGINT would raise KeyboardInterrupt. The first statement of
        # the process unblocks the signal.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with_pipe = config.model_copy(update={"ready_fd": heartbeats_write})
            write_file(config_file, with_pipe.model_dump_json())
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "flexsheet", "--node", str(config_file)],
                stdin=subprocess.DEVNULL,
                stdout=output_write,
                stderr=output_write,
                start_new_session=True,
                pass_fds=(heartbeats_write, lifeline),
                env=environment,
            )
        except BaseException:
            os.close(self._output)
            os.close(self._heartbeats)
            self._close_logs()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            os.close(output_write)
            os.close(heartbeats_write)
        self._pidfd = os.pidfd_open(self._process.pid)
        for fd, read in (
            (self._output, self._read_output),
            (self._heartbeats, self._read_heartbeat),
            (self._pidfd, self._reap),
        ):
            os.set_blocking(fd, False)
            self._loop.add_reader(fd, read)

    @property
    def pid(self) -> int:
        return self._process.pid

    def signal(self, number: int) -> None:
        """Send a signal to the process and to the other processes of its group.

        If the process has exited, nothing is sent. Worker processes have their own groups, and end
        when this process ends.
        """
        if not self.exited.done():
            # The process is not reaped yet, so its id cannot belong to another process.
            os.killpg(self.pid, number)

    def kill_now(self) -> None:
        """Kill and reap the process without the event loop, because the loop may be closing."""
        self.signal(signal.SIGKILL)
        if not self.exited.done():
            self._process.wait()
            self._reap()

    async def wait_until_silent(self, seconds: float) -> None:
        """Wait until the process has sent no heartbeat for `seconds`.

        The launcher checks for heartbeats periodically, and adds up the periods without a
        heartbeat. It does not compare clock times, because a suspended launcher receives no
        heartbeats either.
        """
        beats, silence_s = self._beats, 0.0
        while silence_s < seconds:
            await asyncio.sleep(LIVENESS_PERIOD_S)
            silence_s = silence_s + LIVENESS_PERIOD_S if self._beats == beats else 0.0
            beats = self._beats

    def end_hanging(self) -> None:
        """Make a hanging process write its call stacks to the log, then kill the process."""
        self._reports = False
        self.signal(signal.SIGABRT)
        self._loop.call_later(STACK_DUMP_S, self.signal, signal.SIGKILL)

    def _read_heartbeat(self) -> None:
        beats = os.read(self._heartbeats, 4096)
        self._beats += len(beats)
        if beats and not self.ready.done():
            self.ready.set_result(None)
        if not beats:
            self._loop.remove_reader(self._heartbeats)

    def _read_output(self) -> bool:
        """Copy new output to the log and report its lines. Return False if there is no output."""
        try:
            piece = os.read(self._output, LOG_READ_BYTES)
        except BlockingIOError:
            return False
        if not piece:
            self._loop.remove_reader(self._output)
            return False
        *lines, self._partial = (self._partial + piece).split(b"\n")
        for line in lines:
            self._handle_line(line)
        return True

    def _handle_line(self, line: bytes) -> None:
        """Report an output line, and write it to the log of its node.

        If the line belongs to no node, it is written to the log of the process.
        """
        node = self._find_node(line)
        self._logs[node].write(line + b"\n")
        if self._reports:
            self._report(node, line.decode(errors="replace"))

    def _find_node(self, line: bytes) -> str:
        if len(self._logs) == 1 or not line.startswith(b"{"):
            return self._name
        try:
            node = json.loads(line).get("node")
        except ValueError:
            return self._name
        return node if node in self._logs else self._name

    def _close_logs(self) -> None:
        for log in self._logs.values():
            log.close()

    def _reap(self) -> None:
        """Handle the exit of the process.

        The child processes of this process are killed, its last output is read, and its pipes are
        closed.
        """
        if self.exited.done():
            return
        if self._process.returncode is None:
            # Until the process is reaped, no other process gets the id of its process group.
            os.killpg(self.pid, signal.SIGKILL)
        code = self._process.wait()
        while self._read_output():
            pass
        if self._partial:
            self._handle_line(self._partial)
        for fd in (self._pidfd, self._output, self._heartbeats):
            self._loop.remove_reader(fd)
            os.close(fd)
        self._close_logs()
        self.exited.set_result(code)
