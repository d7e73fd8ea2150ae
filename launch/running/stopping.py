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
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from flexsheet.launch.running.runs import list_live_runs
from flexsheet.nodes.stop_socket import ANSWER, MAX_REQUEST_BYTES, REQUEST, SUFFIX, read_peer

CONTINUE_AFTER_S = 0.06
KILL_AFTER_S = 0.15
DEFAULT_REASON = "flexsheet arms stop"
TARGET_TOPIC = "sheet_target"


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

    after_ms: time from the first request to the outcome.
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


@dataclass(slots=True)
class _Receiver:
    run: Path
    path: StopPath
    name: str
    connection: socket.socket
    process: int


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

    request = (REQUEST + reason.encode())[:MAX_REQUEST_BYTES]
    directories = list(runs)
    waiting: list[_Receiver] = []
    for run, file in ((one, file) for one in directories for file in one.glob(f"*{SUFFIX}")):
        name, _, kind = file.stem.rpartition(".")
        connection = _send_request(file, request)
        if connection is None:
            note(run, StopPath(kind), name, StopOutcome.ABSENT)
        else:
            process, _ = read_peer(connection)
            waiting.append(_Receiver(run, StopPath(kind), name, connection, process))
    try:
        for until_s, signalled in ((CONTINUE_AFTER_S, signal.SIGCONT), (KILL_AFTER_S, None)):
            for receiver in _await_answers(waiting, started_s + until_s):
                note(receiver.run, receiver.path, receiver.name, StopOutcome.CONFIRMED)
            for receiver in waiting if signalled else ():
                _send_signal(receiver.process, signalled or 0)
        # If the launcher stores the stop, a suspended bridge need not be killed. It commands no
        # arm, and receives the stop when it resumes.
        latched = {one.run for one in attempts if one.path is StopPath.LAUNCHER and one.worked}
        for receiver in waiting:
            kill = receiver.path is StopPath.NODE and receiver.run not in latched
            if kill and _send_signal(receiver.process, signal.SIGKILL):
                note(receiver.run, StopPath.SIGNAL, receiver.name, StopOutcome.KILLED)
            else:
                note(receiver.run, receiver.path, receiver.name, StopOutcome.SILENT)
    finally:
        for receiver in waiting:
            receiver.connection.close()
    confirmed = {one.run for one in attempts if one.outcome is StopOutcome.CONFIRMED}
    for run in (one for one in directories if one not in confirmed):
        for name in _kill_target_senders(run):
            note(run, StopPath.SIGNAL, name, StopOutcome.KILLED)
    return attempts


def _send_request(file: Path, request: bytes) -> socket.socket | None:
    """Send a request to the socket `file`, and return the connection for the answer.

    Returns None if no process listens.
    """
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    try:
        connection.connect(os.fspath(file))
        connection.send(request)
    except OSError:
        connection.close()
        return None
    return connection


def _await_answers(waiting: list[_Receiver], until_s: float) -> list[_Receiver]:
    """Wait until `until_s` for confirmations of an emergency stop.

    The receivers are launchers and nodes that control an arm. The receivers that confirm the stop
    are removed from `waiting` and returned.

    until_s: time of the monotonic clock, s.
    """
    confirmed = []
    poll = select.poll()
    by_number = {one.connection.fileno(): one for one in waiting}
    for number in by_number:
        poll.register(number, select.POLLIN)
    while by_number and (left_s := until_s - time.monotonic()) > 0:
        for number, _ in poll.poll(left_s * 1e3):
            receiver = by_number.pop(number)
            poll.unregister(number)
            try:
                answer = receiver.connection.recv(len(ANSWER))
            except ConnectionError:
                answer = b""
            if answer == ANSWER:
                confirmed.append(receiver)
                waiting.remove(receiver)
                receiver.connection.close()
    return confirmed


def _kill_target_senders(run: Path) -> list[str]:
    """Kill the nodes that publish sheet targets in a run.

    Returns the names of the killed nodes.
    """
    try:
        nodes = json.loads((run / "plan.json").read_text())["nodes"]
    except (OSError, ValueError, KeyError):
        return []
    senders = {
        os.fsencode(run / f"{node.get('process') or name}.json"): name
        for name, node in nodes.items()
        if any(port["topic"] == TARGET_TOPIC for port in node["outputs"])
    }
    killed = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            named = senders.keys() & set(entry.read_bytes().split(b"\0"))
        except OSError:
            # The process has ended, or belongs to another user.
            continue
        if named and _send_signal(int(entry.parent.name), signal.SIGKILL):
            killed.append(senders[named.pop()])
    return killed


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
