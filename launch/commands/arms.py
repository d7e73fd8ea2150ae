"""`flexsheet arms`: whether the arms may move, how they are, and a stop."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from flexsheet.launch.commands.graph import JsonOption, RunOption, run_interruptible, running_graph
from flexsheet.launch.commands.output import (
    BAD_INPUT,
    FAILED,
    CommandError,
    examples,
    print_json,
    print_table,
    words,
)
from flexsheet.nodes import NodeRole

if TYPE_CHECKING:
    from collections.abc import Callable

    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run
    from flexsheet.launch.running.stopping import StopAttempt
    from flexsheet.launch.running.tools import GraphWriter
    from flexsheet.messages.base import Message
    from flexsheet.messages.bus import Subscriber
    from flexsheet.messages.types import ArmState, EStop

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="The arms of the graph that runs: ready, stop, reset.",
)

SIDES = ("left", "right")
TOPICS = ("arm_left", "arm_right")
ANSWER_S = 3.0
FRESH_S, TURN_S = 0.5, 0.02

ReasonOption = Annotated[str, typer.Option("--reason", help="Why, for whoever reads it.")]


@app.command(epilog=examples("flexsheet arms status", "flexsheet arms status --json"))
def status(run: RunOption = None, as_json: JsonOption = False) -> None:
    """How the arms are; exit code 1 when one says nothing."""
    raise typer.Exit(run_interruptible(_say(run, None, lambda arms: len(arms) == 2, as_json)))


@app.command(epilog=examples("flexsheet arms ready"))
def ready(run: RunOption = None, as_json: JsonOption = False) -> None:
    """Let the arms move.  Look first that nobody is near them.

    Exit code 1 when an arm refuses; its reason is shown.
    """
    from flexsheet.messages.types import Arming

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and all(arm.ready for arm in arms.values())

    raise typer.Exit(run_interruptible(_say(run, ("arming", Arming(ready=True)), done, as_json)))


@app.command(
    "stand-down",
    epilog=examples("flexsheet arms stand-down --reason 'end of the session'"),
)
def stand_down(
    reason: ReasonOption = "", run: RunOption = None, as_json: JsonOption = False
) -> None:
    """Bring both arms to rest in order, and let the sheet go slack; `ready` ends it."""
    from flexsheet.messages.types import Arming

    message = Arming(ready=False, reason=reason)

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and not any(arm.ready for arm in arms.values())

    raise typer.Exit(run_interruptible(_say(run, ("arming", message), done, as_json)))


@app.command(epilog=examples("flexsheet arms stop"))
def stop(
    reason: ReasonOption = "flexsheet arms stop", run: RunOption = None, as_json: JsonOption = False
) -> None:
    """E-stop by software: both arms stop and stay; it latches.  Never instead of the red button.

    Without --run every graph of yours on this computer is stopped.

    Exit code 0 when a launcher or a bridge has confirmed it, or both arms show it.
    """
    from flexsheet.launch.running.runs import live_runs
    from flexsheet.launch.running.stopping import sent_early, stop_arms

    if sent_early:
        attempts = sent_early.pop()
    else:
        attempts = stop_arms([run] if run else [one.directory for one in live_runs()], reason)
    raise typer.Exit(run_interruptible(_confirm_stop(run, reason, attempts, as_json)))


async def _confirm_stop(
    run_directory: Path | None, reason: str, attempts: list[StopAttempt], as_json: bool
) -> int:
    """Publish the stop too where no launcher has confirmed it; show how the arms are then."""
    from flexsheet.launch.running.stopping import StopOutcome, StopPath
    from flexsheet.messages.types import EStop

    plan, run = running_graph(run_directory)
    latched = any(one.path is StopPath.LAUNCHER and one.worked for one in attempts)
    async with _Arms(plan, run) as arms:
        if not latched:
            attempts = [*attempts, await arms.publish_stop(EStop(engaged=True, reason=reason))]

        def stopped(states: dict[str, ArmState]) -> bool:
            return len(states) == 2 and all(arm.mode == "estop" for arm in states.values())

        shown = await arms.wait_for(stopped)
    good = shown or any(one.worked for one in attempts)
    _show_stop(arms.states, attempts, good, as_json)
    for text in arms.problems:
        words.print(text, markup=False)
    if not shown:
        silent = [side for side, state in arms.states.items() if state.mode != "estop"]
        silent += [side for side in SIDES if side not in arms.states]
        words.print(f"[red]not confirmed by the arms themselves[/]: {', '.join(silent)}")
    if any(one.outcome is StopOutcome.REFUSED for one in attempts):
        words.print("another tool holds the endpoint of the topic estop")
    return 0 if good else FAILED


@app.command(epilog=examples("flexsheet arms reset --reason 'looked at, all clear'"))
def reset(
    reason: ReasonOption = "flexsheet arms reset",
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Clear an e-stop and latched faults, once the arms are at rest.

    Arms that wait for `arms ready` stay where they are.  Arms with `arming: by_itself`, which are
    simulated, follow at once when there is a target.
    """
    from flexsheet.messages.types import EStop

    message = EStop(engaged=False, reason=reason)

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and not any(arm.faults for arm in arms.values())

    code = run_interruptible(_say(run, ("estop", message), done, as_json))
    if code == 0:
        words.print(_what_moves(running_graph(run)[0]))
    raise typer.Exit(code)


def _what_moves(plan: ResolvedGraph) -> str:
    """What the arms of a plan do after a reset, by their bridges' `arming`."""
    arming = {
        str(node.arm_side): node.parameters.get("arming")
        for node in plan.nodes.values()
        if node.role is NodeRole.ARM_BRIDGE
    }
    waiting = [side for side, how in arming.items() if how != "by_itself"]
    free = [side for side in arming if side not in waiting]
    sentences = ["reset"]
    if waiting:
        sentences.append(f"{' and '.join(waiting)}: moves again only after flexsheet arms ready")
    if free:
        sentences.append(
            f"{' and '.join(free)}: moves by itself as soon as there is a target "
            "(arming: by_itself)"
        )
    return "; ".join(sentences)


class _Arms:
    """The arms of a running graph, as their bridges publish them; use as an async context."""

    def __init__(self, plan: ResolvedGraph, run: Run) -> None:
        self._plan, self._run = plan, run
        self._loop = asyncio.get_running_loop()
        self._came_s: dict[str, float] = {}
        self._subscribers: list[Subscriber] = []
        self._writer: GraphWriter | None = None
        self.states: dict[str, ArmState] = {}
        self.problems: list[str] = []

    async def __aenter__(self) -> Self:
        from flexsheet.launch.running.tools import make_subscriber

        for topic in TOPICS:
            self._subscribers.append(
                make_subscriber(
                    topic, self._plan, self._run, self._take, on_problem=self.problems.append
                )
            )
            self._subscribers[-1].start()
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
        for subscriber in self._subscribers:
            subscriber.close()

    def _take(self, state: Any, _: Any) -> None:
        self.states[state.side], self._came_s[state.side] = state, self._loop.time()

    async def publish(self, topic: str, message: Message) -> None:
        """Send it once readers have connected, and once only: a person means now."""
        from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter

        self._writer = GraphWriter(self._plan, self._run, [topic])
        await asyncio.sleep(READER_RECONNECT_S)
        self._writer.publish(topic, message)

    async def publish_stop(self, estop: EStop) -> StopAttempt:
        """Send it at once: it is latched, and readers get it as they connect."""
        from flexsheet.launch.running.stopping import StopAttempt, StopOutcome, StopPath
        from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter
        from flexsheet.messages.bus import BusError

        begun_s, outcome = self._loop.time(), StopOutcome.PUBLISHED
        try:
            self._writer = GraphWriter(self._plan, self._run, ["estop"])
            self._writer.publish("estop", estop)
            # The last reader may be a launcher, which is to keep it.
            await asyncio.sleep(READER_RECONNECT_S)
        except BusError:
            outcome = StopOutcome.REFUSED
        return StopAttempt(StopPath.TOPIC, "estop", outcome, 1e3 * (self._loop.time() - begun_s))

    async def wait_for(self, done: Callable[[dict[str, ArmState]], bool]) -> bool:
        """Whether `done` holds of fresh states within `ANSWER_S`."""
        for _ in range(round(ANSWER_S / TURN_S)):
            now_s = self._loop.time()
            if done(
                {s: arm for s, arm in self.states.items() if now_s - self._came_s[s] < FRESH_S}
            ):
                return True
            await asyncio.sleep(TURN_S)
        return False


async def _say(
    run_directory: Path | None,
    word: tuple[str, Message] | None,
    done: Callable[[dict[str, ArmState]], bool],
    as_json: bool,
) -> int:
    """Say a word to both arms and wait until it holds; show how they are then."""
    from flexsheet.launch.running.tools import tools_host

    plan, run = running_graph(run_directory)
    _refuse_reset_from_elsewhere(plan, tools_host(run), word)
    async with _Arms(plan, run) as arms:
        if word is not None:
            await arms.publish(*word)
        good = await arms.wait_for(done)
    _show(arms.states, as_json)
    for text in arms.problems:
        words.print(text, markup=False)
    if not good:
        words.print("[red]not so[/]: see the reasons; each bridge's log says what it refused")
    return 0 if good else FAILED


def _refuse_reset_from_elsewhere(
    plan: ResolvedGraph, host: str, word: tuple[str, Message] | None
) -> None:
    from flexsheet.launch.plans.plan_model import tools_on
    from flexsheet.messages.types import EStop

    if word is None or not isinstance(word[1], EStop) or word[1].engaged:
        return
    if tools_on(host) not in plan.may_reset_estop():
        raise CommandError(
            f'host "{host}" may not reset an e-stop; do it on {", ".join(plan.estop_resetters)}, '
            f"or let it: hosts.{host}.may_reset_estop in {plan.launch_file}",
            BAD_INPUT,
        )


def _rows(arms: dict[str, ArmState]) -> list[dict[str, Any]]:
    return [
        {
            "side": side,
            "mode": arms[side].mode if side in arms else "silent",
            "ready": side in arms and arms[side].ready,
            "reason": arms[side].reason if side in arms else "nothing came from its bridge",
            "faults": list(arms[side].faults) if side in arms else [],
        }
        for side in SIDES
    ]


def _show_stop(
    arms: dict[str, ArmState], attempts: list[StopAttempt], stopped: bool, as_json: bool
) -> None:
    paths = [
        {
            "path": one.path.value,
            "receiver": one.receiver,
            "outcome": one.outcome.value,
            "after_ms": round(one.after_ms, 1),
        }
        for one in attempts
    ]
    if as_json:
        print_json({"stopped": stopped, "paths": paths, "arms": _rows(arms)})
        return
    print_table(("path", "to", "outcome", "after ms"), [tuple(path.values()) for path in paths])
    print()
    _show(arms, as_json=False)


def _show(arms: dict[str, ArmState], as_json: bool) -> None:
    rows = _rows(arms)
    if as_json:
        print_json(rows)
        return
    print_table(
        ("arm", "mode", "ready", "reason", "faults"),
        [
            (
                row["side"],
                row["mode"],
                "yes" if row["ready"] else "NO",
                row["reason"],
                "; ".join(row["faults"]),
            )
            for row in rows
        ],
    )
