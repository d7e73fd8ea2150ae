"""Send an emergency stop (e-stop) to running graphs, on paths that no other tool can block.

All launchers and arm bridges (nodes that control an arm) on this computer have a socket for e-stops
(`nodes.stop_socket`). The steps are:

1. A request is sent to all sockets simultaneously. A launcher stores the stop and publishes it to
   all hosts. A bridge stops its own arm.
2. Receivers that do not answer get the signal SIGCONT, because they can be suspended.
3. If the launcher of a run has not answered, the bridges of the run that do not answer are killed.
   The watchdogs of their arms then stop the arms.
4. If no receiver of a run has answered, its nodes that send sheet targets are killed. If the
   bridges receive no targets, they stop their arms on all hosts.

This module imports few other modules, so that the stop is sent without delay.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from flexsheet.launch.running.runs import list_live_runs
from flexsheet.nodes.stop_socket import ANSWER, MAX_REQUEST_BYTES, REQUEST, SUFFIX

CONTINUE_AFTER_S = 0.06
KILL_AFTER_S = 0.15
DEFAULT_REASON = "flexsheet arms stop"
TARGET_TOPIC = "sheet_target"
RETRY_S = 0.005
"""The time (s) after which a connection to a receiver with a full backlog is tried again."""

_PEER = struct.Struct("3i")
"""The format of SO_PEERCRED: process, user and group."""


class StopPath(StrEnum):
    """The means of sending an e-stop: a socket, a topic, or a signal that kills a process."""

    LAUNCHER = "launcher"
    NODE = "node"
    TOPIC = "topic"
    SIGNAL = "signal"


class StopOutcome(StrEnum):
    """The outcome of an attempt to stop.

    confirmed: the receiver has engaged the stop.
    silent: the stop was sent, but the receiver has not confirmed it.
    absent: no process listens.
    published: the stop was sent on the topic `estop`, which gives no confirmation.
    refused: the stop was not sent, because another tool uses the endpoint of the topic.
    killed: the process was killed.
    """

    CONFIRMED = "confirmed"
    SILENT = "silent"
    ABSENT = "absent"
    PUBLISHED = "published"
    REFUSED = "refused"
    KILLED = "killed"


@dataclass(frozen=True, slots=True)
class StopAttempt:
    """An attempt to stop the arms of the graph in the run directory `run`.

    after_ms: time from the first request to the answer of this receiver, or to the last attempt.
    """

    run: Path
    path: StopPath
    receiver: str
    outcome: StopOutcome
    after_ms: float

    @property
    def worked(self) -> bool:
        """Return whether the attempt is certain to stop an arm."""
        return self.outcome in (StopOutcome.CONFIRMED, StopOutcome.KILLED)


class _Receiver:
    """A launcher or a node that receives an e-stop on its unix socket.

    If the backlog of the socket is full, the receiver is present, but `connection` is None.
    """

    def __init__(self, file: Path, request: bytes) -> None:
        self.run, self._file, self._request = file.parent, file, request
        self.name, _, kind = file.stem.rpartition(".")
        self.path = StopPath(kind)
        self.connection: socket.socket | None = None

    def connect(self) -> bool:
        """Connect and send the request. Return False if no process listens."""
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            connection.connect(os.fspath(self._file))
            connection.send(self._request)
        except BlockingIOError:
            connection.close()
            return True
        except OSError:
            connection.close()
            return False
        self.connection = connection
        return True

    def read_answer(self) -> bool:
        """Return whether the receiver has confirmed the stop."""
        assert self.connection is not None
        try:
            return self.connection.recv(len(ANSWER)) == ANSWER
        except ConnectionError:
            return False

    def close(self) -> None:
        if self.connection is not None:
            self.connection.close()

    def find_process(self) -> int:
        """Return the id of the receiver's process, or 0 if it is unknown."""
        if self.connection is not None:
            size = _PEER.size
            packed = self.connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
            process: int = _PEER.unpack(packed)[0]
            return process
        if self.path is StopPath.LAUNCHER:
            launcher = self.run.name.partition(".")[0]
            return int(launcher) if launcher.isdigit() else 0
        return next((process for _, process in _find_nodes(self.run, self.name)), 0)


def send_early(arguments: Sequence[str]) -> None:
    """Send the e-stop of `flexsheet arms stop ARGUMENTS` before the slow import of the command.

    If the arguments are invalid, nothing is sent, and the command later reports the error. The
    attempts are stored in `sent_early` for the command.
    """
    options = {"--run": "", "--reason": DEFAULT_REASON}
    rest = [argument for argument in arguments if argument != "--json"]
    while rest:
        name, given, value = rest.pop(0).partition("=")
        if name not in options or not (given or rest):
            return
        options[name] = value if given else rest.pop(0)
    run = options["--run"]
    directories = [Path(run)] if run else [one.directory for one in list_live_runs()]
    sent_early.append(stop_arms(directories, options["--reason"]))


sent_early: list[list[StopAttempt]] = []
"""The attempts of `send_early`, which the command reports later.

If `send_early` was called, this list contains one list of attempts. Otherwise, it is empty.
"""


def stop_arms(runs: Iterable[Path], reason: str) -> list[StopAttempt]:
    """Engage the e-stop in several runs of graphs, and return the outcome of each attempt.

    The steps are listed at the beginning of this module. The function waits at most KILL_AFTER_S
    for answers before it kills processes.

    runs: directories of the runs.
    """
    started_s = time.monotonic()
    attempts: list[StopAttempt] = []

    def note(run: Path, path: StopPath, receiver: str, outcome: StopOutcome) -> None:
        after_ms = (time.monotonic() - started_s) * 1e3
        attempts.append(StopAttempt(run, path, receiver, outcome, after_ms))

    text = reason.encode().replace(b"\n", b" ")
    request = (REQUEST + text)[: MAX_REQUEST_BYTES - 1] + b"\n"
    directories = list(runs)
    waiting: list[_Receiver] = []
    for file in (file for run in directories for file in run.glob(f"*{SUFFIX}")):
        receiver = _Receiver(file, request)
        if receiver.connect():
            waiting.append(receiver)
        else:
            note(receiver.run, receiver.path, receiver.name, StopOutcome.ABSENT)
    try:
        for until_s, signalled in ((CONTINUE_AFTER_S, signal.SIGCONT), (KILL_AFTER_S, None)):
            for receiver in _await_answers(waiting, started_s + until_s):
                note(receiver.run, receiver.path, receiver.name, StopOutcome.CONFIRMED)
            for receiver in waiting if signalled else ():
                _send_signal(receiver.find_process(), signalled or 0)
        # If the launcher stores the stop, a suspended bridge need not be killed. It commands no
        # arm, and receives the stop when it resumes.
        latched = {one.run for one in attempts if one.path is StopPath.LAUNCHER and one.worked}
        for receiver in waiting:
            kill = receiver.path is StopPath.NODE and receiver.run not in latched
            if kill and _send_signal(receiver.find_process(), signal.SIGKILL):
                note(receiver.run, StopPath.SIGNAL, receiver.name, StopOutcome.KILLED)
            else:
                note(receiver.run, receiver.path, receiver.name, StopOutcome.SILENT)
    finally:
        for receiver in waiting:
            receiver.close()
    confirmed = {one.run for one in attempts if one.outcome is StopOutcome.CONFIRMED}
    for run in (one for one in directories if one not in confirmed):
        for name, process in _find_nodes(run):
            if _send_signal(process, signal.SIGKILL):
                note(run, StopPath.SIGNAL, name, StopOutcome.KILLED)
    return attempts


def _await_answers(waiting: list[_Receiver], until_s: float) -> Iterator[_Receiver]:
    """Yield the receivers that confirm an e-stop until `until_s`, each as soon as it does.

    The receivers are launchers and nodes that control an arm. Those that confirm the stop are
    removed from `waiting`. A full backlog of a receiver is tried again every RETRY_S.

    until_s: time of the monotonic clock, s.
    """
    silent: list[_Receiver] = []
    while (left_s := until_s - time.monotonic()) > 0 and len(waiting) > len(silent):
        poll = select.poll()
        by_number: dict[int, _Receiver] = {}
        for receiver in waiting:
            if receiver.connection is None:
                receiver.connect()
            if receiver.connection is None:
                left_s = min(left_s, RETRY_S)
            elif receiver not in silent:
                by_number[receiver.connection.fileno()] = receiver
                poll.register(receiver.connection, select.POLLIN)
        for number, _ in poll.poll(left_s * 1e3):
            receiver = by_number[number]
            if receiver.read_answer():
                waiting.remove(receiver)
                receiver.close()
                yield receiver
            else:
                silent.append(receiver)


def _find_nodes(run: Path, name: str | None = None) -> list[tuple[str, int]]:
    """Return the names and process ids of nodes of a run.

    name: name of the node. If it is None, the nodes that publish sheet targets are returned.
    """
    try:
        nodes = json.loads((run / "plan.json").read_text())["nodes"]
    except (OSError, ValueError, KeyError):
        return []
    wanted = {
        os.fsencode(run / f"{node.get('process') or one}.json"): one
        for one, node in nodes.items()
        if one == name
        or (name is None and any(port["topic"] == TARGET_TOPIC for port in node["outputs"]))
    }
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            named = wanted.keys() & set(entry.read_bytes().split(b"\0"))
        except OSError:
            # The process has ended, or belongs to another user.
            continue
        if named:
            found.append((wanted[named.pop()], int(entry.parent.name)))
    return found


def _send_signal(process: int, number: int) -> bool:
    """Send a signal to a process, and return whether the signal was sent.

    process: process id; 0 or less if the id is unknown.
    """
    if process <= 0:
        return False
    try:
        os.kill(process, number)
    except (ProcessLookupError, PermissionError):
        return False
    return True
