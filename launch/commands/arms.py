"""`flexsheet arms`: whether the arms may move, how they are, and a stop."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from launch.commands.graph import JsonOption, RunOption, run_interruptible, running_graph
from launch.commands.output import (
    BAD_INPUT,
    FAILED,
    CommandError,
    examples,
    print_json,
    print_table,
    words,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from launch.plans.planned import Plan
    from launch.running.runs import Run
    from launch.running.tools import ToolsWriter
    from messages.base import Message
    from messages.types import ArmState

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="The arms of the graph that runs: ready, stop, reset.",
)

TOPICS = ("arm_left", "arm_right")
ANSWER_S = 3.0
FRESH_S, TURN_S = 0.5, 0.02
ATTEMPTS = 4
"""To say a stop while another tool speaks there; each waits up to a second."""

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
    from messages.types import Arming

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
    from messages.types import Arming

    message = Arming(ready=False, reason=reason)

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and not any(arm.ready for arm in arms.values())

    raise typer.Exit(run_interruptible(_say(run, ("arming", message), done, as_json)))


@app.command(epilog=examples("flexsheet arms stop"))
def stop(
    reason: ReasonOption = "flexsheet arms stop", run: RunOption = None, as_json: JsonOption = False
) -> None:
    """E-stop by software: both arms stop and stay; it latches.  Never instead of the red button."""
    from messages.types import EStop

    message = EStop(engaged=True, reason=reason)

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and all(arm.mode == "estop" for arm in arms.values())

    raise typer.Exit(run_interruptible(_say(run, ("estop", message), done, as_json)))


@app.command(epilog=examples("flexsheet arms reset --reason 'looked at, all clear'"))
def reset(
    reason: ReasonOption = "flexsheet arms reset",
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Clear an e-stop and latched faults, once the arms are at rest; it moves nothing."""
    from messages.types import EStop

    message = EStop(engaged=False, reason=reason)

    def done(arms: dict[str, ArmState]) -> bool:
        return len(arms) == 2 and not any(arm.faults for arm in arms.values())

    code = run_interruptible(_say(run, ("estop", message), done, as_json))
    if code == 0:
        words.print("reset; the arms move again only after: flexsheet arms ready")
    raise typer.Exit(code)


async def _say(
    run_directory: Path | None,
    word: tuple[str, Message] | None,
    done: Callable[[dict[str, ArmState]], bool],
    as_json: bool,
) -> int:
    """Say a word to both arms and wait until it holds; show how they are then.

    It is said once only: a person means now, not when the network is back.
    """
    from launch.running.tools import READER_RECONNECT_S, host_of, subscriber_to
    from messages.types import EStop

    plan, run = running_graph(run_directory)
    _refuse_reset_from_elsewhere(plan, host_of(run), word)
    loop = asyncio.get_running_loop()
    arms: dict[str, ArmState] = {}
    came_s: dict[str, float] = {}
    said: list[str] = []

    def take(state: Any, _: Any) -> None:
        arms[state.side], came_s[state.side] = state, loop.time()

    def holds() -> bool:
        fresh = {side: arm for side, arm in arms.items() if loop.time() - came_s[side] < FRESH_S}
        return done(fresh)

    subscribers = [
        subscriber_to(topic, plan, run, take, on_problem=said.append) for topic in TOPICS
    ]
    writer = None
    try:
        for subscriber in subscribers:
            subscriber.start()
        if word is not None:
            stop = isinstance(word[1], EStop) and word[1].engaged
            writer = await _writer(plan, run, word[0], insist=stop)
            # A stop waits for nobody: it is latched, and readers get it as they come.  The last
            # of them may be a launcher, which is to remember it.
            if stop:
                writer.publish(*word)
            await asyncio.sleep(READER_RECONNECT_S)
            if not stop:
                writer.publish(*word)
        for _ in range(round(ANSWER_S / TURN_S)):
            await asyncio.sleep(TURN_S)
            if holds():
                break
        good = holds()
    finally:
        if writer is not None:
            writer.close()
        for subscriber in subscribers:
            subscriber.close()
    _show(arms, as_json)
    for text in said:
        words.print(text, markup=False)
    if not good:
        words.print("[red]not so[/]: see the reasons; each bridge's log says what it refused")
    return 0 if good else FAILED


async def _writer(plan: Plan, run: Run, topic: str, *, insist: bool) -> ToolsWriter:
    """A tool's publisher of a topic; insist: wait for a tool that speaks there now to end."""
    from launch.running.tools import ToolsWriter
    from messages.bus import BusError

    for _ in range(ATTEMPTS if insist else 0):
        try:
            return ToolsWriter(plan, run, [topic])
        except BusError:
            await asyncio.sleep(TURN_S)
    return ToolsWriter(plan, run, [topic])


def _refuse_reset_from_elsewhere(plan: Plan, host: str, word: tuple[str, Message] | None) -> None:
    from launch.plans.planned import tools_on
    from messages.types import EStop

    if word is None or not isinstance(word[1], EStop) or word[1].engaged:
        return
    if tools_on(host) not in plan.may_reset_estop():
        raise CommandError(
            f'host "{host}" may not reset an e-stop; do it on {", ".join(plan.estop_resetters)}, '
            f"or let it: hosts.{host}.may_reset_estop in {plan.launch_file}",
            BAD_INPUT,
        )


def _show(arms: dict[str, ArmState], as_json: bool) -> None:
    rows: list[dict[str, Any]] = [
        {
            "side": side,
            "mode": arms[side].mode if side in arms else "silent",
            "ready": side in arms and arms[side].ready,
            "reason": arms[side].reason if side in arms else "nothing came from its bridge",
            "faults": list(arms[side].faults) if side in arms else [],
        }
        for side in ("left", "right")
    ]
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
