"""Generate the tables of the arms: states, Modbus registers, and the packet of MXT."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from flexsheet.nodes.arm_bridge.link import FAULT_TEXTS, BlockField
from flexsheet.nodes.arm_bridge.modbus import (
    COMMAND,
    COMMAND_ADDRESS,
    FAULT_BITS,
    STATUS,
    STATUS_ADDRESS,
    count_registers,
)
from flexsheet.nodes.arm_bridge.mxt import PACKET
from flexsheet.nodes.arm_bridge.state_machine import (
    MODES,
    MOTION_STATES,
    READY_STATES,
    TRANSITIONS,
    Event,
    State,
)
from website.messages_page import format_table

KINDS = {"H": "u16", "I": "u32", "i": "i32", "f": "float32", "x": "pad"}


def render_states() -> str:
    """Return the table of states of an arm bridge, and the table of transitions."""
    states = []
    for state in State:
        mode = "`idle`, with a fault `fault`" if state is State.TAUT else f"`{MODES[state]}`"
        ready, moves = (
            "yes" if state in group else "no" for group in (READY_STATES, MOTION_STATES)
        )
        states.append((f"`{state.name}`", mode, ready, moves, state.value))
    transitions = []
    for event in Event:
        sources: dict[State, list[str]] = {}
        for state in State:
            target = TRANSITIONS[state, event]
            if target is not None:
                sources.setdefault(target, []).append(f"`{state.name}`")
        moved = [f"{', '.join(names)} → `{target.name}`" for target, names in sources.items()]
        transitions.append((f"`{event.name}`", event.value, "; ".join(moved)))
    return "\n".join(
        [
            format_table(("state", "published mode", "ready", "may move", "meaning"), states),
            format_table(("event", "when", "transitions; all other states ignore it"), transitions),
        ]
    )


def render_registers() -> str:
    """Return the tables of both register blocks and of the fault bits."""
    bits = [(str(bit), FAULT_TEXTS[fault]) for bit, fault in FAULT_BITS.items()]
    return "\n".join(
        [
            _block("Command", COMMAND_ADDRESS, COMMAND),
            _block("Status", STATUS_ADDRESS, STATUS),
            "Fault bits:\n",
            format_table(("bit", "meaning"), bits),
        ]
    )


def render_packet() -> str:
    """Return the table of the packet of an MXT controller."""
    rows, at = [], 0
    for field in PACKET:
        rows.append((str(at), f"`{field.name}`", _describe_kind(field), field.about))
        at += field.count * struct.calcsize(f"<{field.kind}")
    return format_table(("byte", "field", "type", "meaning"), rows)


def _describe_kind(field: BlockField) -> str:
    return KINDS[field.kind] + (f" × {field.count}" if field.count > 1 else "")


def _block(title: str, address: int, block: Sequence[BlockField]) -> str:
    """Return the heading and the table of a block.

    address: first register of the block.
    """
    head, rows = f"## {title}: {count_registers(block)} registers from {address}\n", []
    for field in block:
        length = field.count * struct.calcsize(f">{field.kind}") // 2
        span = str(address) if length == 1 else f"{address}–{address + length - 1}"
        rows.append((span, f"`{field.name}`", _describe_kind(field), field.about))
        address += length
    return f"{head}\n{format_table(('register', 'field', 'type', 'meaning'), rows)}"
