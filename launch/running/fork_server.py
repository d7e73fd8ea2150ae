"""Start nodes as forks of one process that has already imported their modules.

The imports of a node take longer than the rest of its start. The fork server is a process with a
single thread, which imports the modules of a graph once and opens no sockets of the graph.

The fork server forks twice. The intermediate process ends immediately, so the kernel makes the
launcher the parent of the node's process (the launcher is a subreaper, prctl(2)). Signals, exit
codes and priorities of this process therefore work as if the launcher had started it itself.

If the fork server ends, does not answer, or has started a thread, the launcher starts nodes
directly.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import IO

from flexsheet.launch.running.child import PARENT_VARIABLE

FLAG = "--fork-server"
NODE_ARGUMENTS = [sys.executable, "-P", "-m", "flexsheet"]
REQUEST_BYTES = 65_536
PID_BYTES = 8
READY = b"ready"
ANSWER_S = 1.0
"""The time (s) in which the fork server must answer a request.

An answer usually takes some milliseconds.
"""

READY_S = 20.0
"""The time (s) in which the fork server must have imported the modules."""

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_ARGUMENTS_START, _ARGUMENTS_END = 45, 46
"""The indices of two fields of /proc/PID/stat, which contain the address range of the arguments.

The field after the program's name has the index 0. See proc(5).
"""


class ForkedProcess:
    """A process that the fork server has started, with an interface like `subprocess.Popen`.

    Pipes are not supported.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def wait(self) -> int:
        """Wait for the end of the process, and return its exit code.

        If a signal ended the process, the exit code is the negative number of the signal.
        """
        if self.returncode is None:
            _, status = os.waitpid(self.pid, 0)
            self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


class ForkServer:
    """The launcher's connection to a fork server. The constructor starts the server.

    node_types: types of the nodes. If a type is defined outside this package, its module is not
        imported, because the module could start threads.
    config_files: configuration files of all processes that can be started.
    lifeline: file descriptor of a pipe that the nodes inherit. When the pipe closes, the nodes end.
    log: file for the server's own output.
    """

    def __init__(
        self,
        node_types: Iterable[str],
        config_files: Iterable[Path],
        *,
        environment: Mapping[str, str],
        lifeline: int,
        log: IO[bytes],
    ) -> None:
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        self._environment = dict(environment)
        self._socket, remote = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # Nodes overwrite these arguments with their own arguments, which need the same space.
        space = " " * max(len(os.fsencode(path)) for path in config_files)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [*NODE_ARGUMENTS, FLAG, str(remote.fileno()), space],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                pass_fds=(remote.fileno(), lifeline),
                env=environment,
            )
        except BaseException:
            self._socket.close()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            remote.close()
        self._socket.send(json.dumps(sorted(node_types)).encode())
        self._ready: asyncio.Task[bool] = asyncio.create_task(self._wait_ready())

    async def is_ready(self) -> bool:
        """Wait until the modules are imported. Return False if the fork server cannot be used."""
        # Several processes wait at once; cancelling one of them must not cancel the task.
        return await asyncio.shield(self._ready) and self._process.poll() is None

    async def _wait_ready(self) -> bool:
        self._socket.setblocking(False)
        try:
            async with asyncio.timeout(READY_S):
                answer = await asyncio.get_running_loop().sock_recv(self._socket, len(READY))
        except (OSError, TimeoutError):
            answer = b""
        if answer != READY:
            self.close()
            return False
        self._socket.settimeout(ANSWER_S)
        return True

    def fork(
        self, config_file: Path, environment: Mapping[str, str], output: int, ready: int
    ) -> ForkedProcess | None:
        """Start a process with nodes, and return it.

        If this is not possible, close the fork server and return None.

        config_file: configuration of the process.
        output: descriptor for standard output and error.
        ready: descriptor for the report that the nodes are ready. The configuration contains the
            number of this descriptor, so the new process uses the same number.
        """
        changed = {
            name: value
            for name, value in environment.items()
            if self._environment.get(name) != value
        }
        request = {"config_file": str(config_file), "variables": changed, "ready_fd": ready}
        try:
            socket.send_fds(self._socket, [json.dumps(request).encode()], [output, ready])
            answer = self._socket.recv(PID_BYTES)
        except OSError:
            # The fork server has ended, but it may have reported a process before.
            self._end()
            answer = b""
            with suppress(OSError):
                answer = self._socket.recv(PID_BYTES, socket.MSG_DONTWAIT)
        if len(answer) < PID_BYTES:
            self.close()
            return None
        return ForkedProcess(int.from_bytes(answer, "little"))

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()

    async def stop(self) -> None:
        """End the fork server, even if it is still importing modules."""
        self._ready.cancel()
        await asyncio.gather(self._ready, return_exceptions=True)
        self.close()

    def close(self) -> None:
        """End the fork server. The processes of the nodes continue to run."""
        self._end()
        self._socket.close()


def serve(socket_fd: int) -> str:
    """Import the modules of the nodes, then fork a process for each request of the launcher.

    The function returns only in the forked processes. Its result is the path of the configuration
    of the new process.

    socket_fd: descriptor of the socket to the launcher.
    """
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(os.environ[PARENT_VARIABLE]):
        sys.exit("the launcher has exited")
    with socket.socket(fileno=socket_fd) as control:
        import_module("flexsheet.nodes.runner")
        _import_nodes(json.loads(control.recv(REQUEST_BYTES)))
        if len(os.listdir("/proc/self/task")) > 1:
            sys.exit("a module has started a thread, so this process cannot be forked")
        gc.collect()
        gc.freeze()
        control.send(READY)
        while True:
            data, descriptors, _, _ = socket.recv_fds(control, REQUEST_BYTES, 2)
            if not data:
                sys.exit(0)
            request = json.loads(data)
            if _fork(control, descriptors):
                break
            for descriptor in descriptors:
                os.close(descriptor)
    output, ready = descriptors
    for standard in (1, 2):
        os.dup2(output, standard)
    os.close(output)
    if ready != request["ready_fd"]:
        os.dup2(ready, request["ready_fd"])
        os.close(ready)
    os.environ.update(request["variables"])
    _write_arguments([*NODE_ARGUMENTS, "--node", request["config_file"]])
    config_file: str = request["config_file"]
    return config_file


def _import_nodes(types: Iterable[str]) -> None:
    """Import the modules of the node types that belong to this package."""
    from flexsheet.nodes import NODES, node_class

    for name in types:
        if name not in NODES:
            continue
        try:
            for module in node_class(name).late_modules:
                import_module(module)
        except ImportError as error:
            # The node's process reports this error too, if the node needs the module.
            print(f"{name}: {error}", file=sys.stderr)


def _fork(control: socket.socket, descriptors: Iterable[int]) -> bool:
    """Fork a process, and make the launcher its parent.

    Returns True in the new process, and False in the fork server. If the launcher does not receive
    the id of the new process, the new process ends.

    descriptors: files that the process inherits.
    """
    pid_read, pid_write = os.pipe()
    go_read, go_write = os.pipe()
    if (between := os.fork()) == 0:
        try:
            node = os.fork()
            if node:
                os.write(pid_write, node.to_bytes(PID_BYTES, "little"))
        except OSError:
            os._exit(1)
        if node:
            os._exit(0)
        for descriptor in (pid_read, pid_write, go_write):
            os.close(descriptor)
        os.setsid()
        if not os.read(go_read, 1):
            os._exit(1)
        os.close(go_read)
        return True
    os.close(pid_write)
    os.close(go_read)
    # From here on, the launcher is the parent of the node's process.
    os.waitpid(between, 0)
    control.send(os.read(pid_read, PID_BYTES) or b"\0")
    # If the process has ended, this raises BrokenPipeError, which ends the fork server.
    os.write(go_write, b".")
    os.close(pid_read)
    os.close(go_write)
    return False


def _write_arguments(arguments: list[str]) -> None:
    """Replace the command-line arguments of this process in /proc, by which tools identify nodes.

    The new arguments must have the same total length as the old arguments. An argument that
    consists of spaces is therefore inserted before the last two arguments.

    Raises ValueError if the new arguments are too long.
    """
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    start, end = int(fields[_ARGUMENTS_START]), int(fields[_ARGUMENTS_END])
    *first, flag, path = (os.fsencode(one) + b"\0" for one in arguments)
    left = end - start - len(b"".join([*first, flag, path])) - 1
    if left < 0:
        raise ValueError("the arguments of the fork server are too short for those of the node")
    ctypes.memmove(start, b"".join([*first, b" " * left + b"\0", flag, path]), end - start)


def _prctl(option: int, value: int) -> None:
    if ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl failed")
