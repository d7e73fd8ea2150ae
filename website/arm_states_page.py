"""Generate the arm control's states and transitions."""

from __future__ import annotations

from flexsheet.nodes.arm_bridge.state_machine import (
    MODES,
    MOTION_STATES,
    READY_STATES,
    TRANSITIONS,
    Event,
    State,
)


def render() -> str:
    """Return the table of states and the table of transitions."""
    return f"{_render_states()}\n{_render_transitions()}"


def _render_states() -> str:
    lines = ["| state | published mode | ready | may move | meaning |", "|---|---|---|---|---|"]
    for state in State:
        mode = "`idle`, with a fault `fault`" if state is State.TAUT else f"`{MODES[state]}`"
        ready, moves = (
            "yes" if state in group else "no" for group in (READY_STATES, MOTION_STATES)
        )
        lines.append(f"| `{state.name}` | {mode} | {ready} | {moves} | {state.value} |")
    return "\n".join(lines) + "\n"


def _render_transitions() -> str:
    lines = ["| event | when | transitions; all other states ignore it |", "|---|---|---|"]
    for event in Event:
        sources: dict[State, list[str]] = {}
        for state in State:
            target = TRANSITIONS[state, event]
            if target is not None:
                sources.setdefault(target, []).append(f"`{state.name}`")
        moves = [f"{', '.join(names)} → `{target.name}`" for target, names in sources.items()]
        lines.append(f"| `{event.name}` | {event.value} | {'; '.join(moves)} |")
    return "\n".join(lines) + "\n"
