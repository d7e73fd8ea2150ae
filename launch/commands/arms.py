"""`flexsheet arms`: enable, disable, stop and reset the arms of a running graph."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands.graph import (
    NoGraphError,
    choose_run,
    receive_until,
    run_interruptible,
    running_graph,
)
from flexsheet.launch.commands.options import (
    ChangedRunOption,
    JsonOption,
    StoppedRunOption,
    make_app,
)
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_json,
    print_rows,
    words,
)
from flexsheet.nodes import NodeRole

if TYPE_CHECKING:
    from collections.abc import Callable

    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run
    from flexsheet.launch.running.stopping import StopAttempt
    from flexsheet.messages.base import Message
    from flexsheet.messages.types import ArmState, Status

app = make_app("Enable, disable, stop and reset the arms of a running graph.")

SIDES = ("left", "right")
CONFIRMATION_TIMEOUT_S = 3.0

ReasonOption = Annotated[
    str, typer.Option("--reason", help="Reason for the command; it is shown and logged.")
]


@app.command(epilog=examples("flexsheet arms enable"))
def enable(run: ChangedRunOption = None, as_json: JsonOption = False) -> None:
    """Allow the arms to move; first make sure that nobody is near them.

    If an arm refuses, its reason is printed and the exit code is 1.
    """
    from flexsheet.messages.types import Arming

    raise typer.Exit(_command(run, "arming", Arming(ready=True), lambda arm: arm.ready, as_json))


@app.command(epilog=examples("flexsheet arms disable --reason 'end of the session'"))
def disable(
    reason: ReasonOption = "", run: ChangedRunOption = None, as_json: JsonOption = False
) -> None:
    """Stop both arms and slacken the sheet until you run `flexsheet arms enable`."""
    from flexsheet.messages.types import Arming

    message = Arming(ready=False, reason=reason)
    raise typer.Exit(_command(run, "arming", message, lambda arm: not arm.ready, as_json))


@app.command(epilog=examples("flexsheet arms stop"))
def stop(
    reason: ReasonOption = "flexsheet arms stop",
    run: StoppedRunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Engage the software emergency stop (e-stop) of the arms.

    The e-stop remains engaged until you run `flexsheet arms reset`. This command does not replace
    the hard-wired e-stop. Without --run, it stops the arms of all graphs of this user on this
    computer.

    The exit code is 0 if the stop of each graph is confirmed by its launcher or by a node that
    controls an arm. It is also 0 if both arms report the stop.
    """
    from flexsheet.launch.running.runs import list_live_runs
    from flexsheet.launch.running.stopping import sent_early, stop_arms

    if sent_early:
        attempts = sent_early.pop()
    else:
        attempts = stop_arms([run] if run else [one.directory for one in list_live_runs()], reason)
    raise typer.Exit(run_interruptible(_confirm_stops(run, reason, attempts, as_json)))


@dataclass(frozen=True, slots=True)
class _StopResult:
    """The attempts to stop the arms of the run in a directory, and the states of its arms."""

    run: Path
    attempts: list[StopAttempt]
    arms: dict[str, ArmState]

    @property
    def shown(self) -> bool:
        """Return whether both arms report the stop."""
        return len(self.arms) == 2 and all(map(_is_stopped, self.arms.values()))

    @property
    def confirmed(self) -> bool:
        return self.shown or any(one.worked for one in self.attempts)


def _is_stopped(arm: ArmState) -> bool:
    return arm.mode == "estop"


async def _confirm_stops(
    run_directory: Path | None, reason: str, attempts: list[StopAttempt], as_json: bool
) -> int:
    """Print the results of the stop attempts and the states of the arms; return the exit code."""
    from flexsheet.launch.running.runs import list_live_runs
    from flexsheet.launch.running.stopping import StopOutcome

    ready = [one.directory for one in list_live_runs() if one.plan_file.is_file()]
    if run_directory is None and not list_live_runs():
        raise NoGraphError(
            "no graph is running on this computer, so no arm can be stopped by it; use the "
            "hard-wired e-stop of an arm that moves"
        )
    # If the graph is still starting, `running_graph` raises the error.
    chosen = [run_directory] if run_directory is not None or not ready else ready
    results = await asyncio.gather(
        *(
            _confirm_stop(
                directory,
                reason,
                [one for one in attempts if len(chosen) == 1 or one.run == directory],
            )
            for directory in chosen
        )
    )

    def name_run(result: _StopResult) -> dict[str, Any]:
        return {} if len(results) == 1 else {"run": str(result.run)}

    paths = [
        {
            **name_run(result),
            "path": one.path.value,
            "receiver": one.receiver,
            "outcome": one.outcome.value,
            "after_ms": round(one.after_ms, 1),
        }
        for result in results
        for one in result.attempts
    ]
    arms = [
        {**name_run(result), **row} for result in results for row in describe_arms(result.arms, {})
    ]
    if as_json:
        stopped = all(result.confirmed for result in results)
        print_json({"stopped": stopped, "paths": paths, "arms": arms})
    else:
        print_rows(paths, as_json=False)
        print()
        print_rows(arms, as_json=False)
    for result in results:
        where = "" if len(results) == 1 else f" of {result.run}"
        if not result.shown:
            silent = [side for side, state in result.arms.items() if state.mode != "estop"]
            silent += [side for side in SIDES if side not in result.arms]
            words.print(
                f"[red]not confirmed by the arms{where}[/]: {', '.join(silent)}", markup=True
            )
        if any(one.outcome is StopOutcome.REFUSED for one in result.attempts):
            words.print(
                f"the stop was not published on the topic estop{where}, because another tool is "
                "writing it"
            )
    return 0 if all(one.confirmed for one in results) else FAILED


async def _confirm_stop(
    run_directory: Path | None, reason: str, attempts: list[StopAttempt]
) -> _StopResult:
    """Wait until both arms of a graph report the stop, and return the result.

    If the graph's launcher has not confirmed a stop, an e-stop is published on the topic `estop`.
    """
    from pydantic import ValidationError

    from flexsheet.launch.running.stopping import StopAttempt, StopOutcome, StopPath
    from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter
    from flexsheet.messages.bus import BusError
    from flexsheet.messages.types import EStop

    try:
        plan, run = running_graph(run_directory)
    except ValidationError:
        assert run_directory is not None
        words.print(
            f"another version of flexsheet runs {run_directory}; check its arms with that version"
        )
        return _StopResult(run_directory, attempts, {})
    arms = _Arms(plan, run)
    with ExitStack() as stack:
        if not any(one.path is StopPath.LAUNCHER and one.worked for one in attempts):
            begun_s, outcome = time.monotonic(), StopOutcome.PUBLISHED
            try:
                writer = stack.enter_context(closing(GraphWriter(plan, run, ["estop"])))
                writer.publish("estop", EStop(engaged=True, reason=reason))
            except BusError:
                outcome = StopOutcome.REFUSED
            after_ms = 1e3 * (time.monotonic() - begun_s)
            attempt = StopAttempt(run.directory, StopPath.TOPIC, "estop", outcome, after_ms)
            attempts = [*attempts, attempt]
            if outcome is StopOutcome.PUBLISHED:
                # The topic is latched: launchers and nodes that connect now also receive the stop.
                await asyncio.sleep(READER_RECONNECT_S)
        await arms.wait_for(_is_stopped)
    return _StopResult(run.directory, attempts, arms.states)


@app.command(epilog=examples("flexsheet arms reset --reason 'inspected, all clear'"))
def reset(
    reason: ReasonOption = "flexsheet arms reset",
    run: ChangedRunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Reset the e-stop and the stored faults of arms that are at rest.

    If an arm has the setting `arming: manual`, it then stays at rest until you run `flexsheet arms
    enable`. Simulated arms that have `arming: auto` move as soon as they receive a target.
    """
    from flexsheet.launch.plans.plan_model import tools_on
    from flexsheet.launch.running.tools import tools_host
    from flexsheet.messages.types import EStop

    run = choose_run(run)
    plan, found = running_graph(run)
    host = tools_host(found)
    if tools_on(host) not in plan.may_reset_estop():
        raise CommandError(
            f'host "{host}" is not allowed to reset an e-stop; reset it on '
            f"{', '.join(plan.estop_resetters)}, "
            f"or set hosts.{host}.may_reset_estop in {plan.launch_file}"
        )

    message = EStop(engaged=False, reason=reason)
    code = _command(run, "estop", message, lambda arm: not arm.faults, as_json)
    if code == 0:
        words.print(_describe_reset(plan))
    raise typer.Exit(code)


def _describe_reset(plan: ResolvedGraph) -> str:
    """Describe for each arm under which condition it moves after a reset of the e-stop."""
    from flexsheet.launch.plans.plan_model import ArmingMode

    arming = {
        str(node.arm_side): node.arming
        for node in plan.nodes.values()
        if node.role is NodeRole.ARM_BRIDGE
    }
    waiting = [side for side, mode in arming.items() if mode is not ArmingMode.AUTO]
    free = [side for side in arming if side not in waiting]
    sentences = ["reset"]
    if waiting:
        sentences.append(f"{' and '.join(waiting)}: moves only after flexsheet arms enable")
    if free:
        sentences.append(
            f"{' and '.join(free)}: moves as soon as it receives a target (arming: auto)"
        )
    return "; ".join(sentences)


class _Arms:
    """The newest states of the arms of a graph, and the notes of their nodes, by side."""

    def __init__(self, plan: ResolvedGraph, run: Run) -> None:
        self._plan, self._run = plan, run
        self.states: dict[str, ArmState] = {}
        self.notes: dict[str, str] = {}

    def add_state(self, state: ArmState) -> None:
        self.states[state.side] = state

    def add_status(self, status: Status) -> None:
        node = self._plan.nodes.get(status.node)
        if node is not None and node.arm_side is not None:
            self.notes[node.arm_side] = status.last_error or status.note_text

    async def wait_for(self, done: Callable[[ArmState], bool]) -> bool:
        """Receive states until `done` returns True for both arms; return False on a timeout."""
        handlers: dict[str, Callable[[Any], None]] = {
            "arm_left": self.add_state,
            "arm_right": self.add_state,
            "status": self.add_status,
        }

        def both_done() -> bool:
            return len(self.states) == 2 and all(map(done, self.states.values()))

        timeout_s = CONFIRMATION_TIMEOUT_S
        return await receive_until(self._plan, self._run, handlers, both_done, timeout_s)


def _command(
    run_directory: Path | None,
    topic: str,
    message: Message,
    done: Callable[[ArmState], bool],
    as_json: bool,
) -> int:
    """Publish a command to both arms, wait for its effect, and print the states of the arms.

    Returns the exit code.

    done: function that receives the state of an arm, and returns True when the command has had its
        effect.

    Raises SeveralGraphsError if `run_directory` is None and several graphs are running.
    """
    from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter

    plan, run = running_graph(choose_run(run_directory))

    async def work() -> int:
        arms = _Arms(plan, run)
        with closing(GraphWriter(plan, run, [topic])) as writer:
            await asyncio.sleep(READER_RECONNECT_S)
            writer.publish(topic, message)
            confirmed = await arms.wait_for(done)
        print_rows(describe_arms(arms.states, arms.notes), as_json=as_json)
        if not confirmed:
            words.print(
                "[red]not confirmed[/]: see the reasons above, and `flexsheet status`", markup=True
            )
            if any(map(_is_stopped, arms.states.values())):
                words.print("an e-stop is engaged; to release it: flexsheet arms reset")
        return 0 if confirmed else FAILED

    return run_interruptible(work())


def describe_arms(arms: dict[str, ArmState], notes: dict[str, str]) -> list[dict[str, Any]]:
    """Return one table row for each arm.

    notes: note of each arm's bridge, by side, which is the reason of an arm without a state.
    """
    return [
        {
            "side": side,
            "mode": arms[side].mode if side in arms else "silent",
            "ready": side in arms and arms[side].ready,
            "reason": arms[side].reason
            if side in arms
            else notes.get(side) or "no message from the bridge",
            "faults": list(arms[side].faults) if side in arms else [],
        }
        for side in SIDES
    ]
