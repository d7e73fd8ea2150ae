"""Generate the register map of the Modbus driver, and the packet of the MXT driver."""

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

KINDS = {"H": "u16", "I": "u32", "i": "i32", "f": "float32", "x": "pad"}


def render() -> str:
    """Return the tables of both register blocks and of the fault bits."""
    bits = ["Fault bits:", "", "| bit | meaning |", "|---|---|"]
    bits += [f"| {bit} | {FAULT_TEXTS[fault]} |" for bit, fault in FAULT_BITS.items()]
    blocks = [
        _block("Command", COMMAND_ADDRESS, COMMAND),
        _block("Status", STATUS_ADDRESS, STATUS),
        "\n".join(bits) + "\n",
    ]
    return "\n".join(blocks)


def render_packet() -> str:
    """Return the table of the packet of an MXT controller."""
    lines, at = ["| byte | field | type | meaning |", "|---|---|---|---|"], 0
    for field in PACKET:
        kind = KINDS[field.kind] + (f" × {field.count}" if field.count > 1 else "")
        lines.append(f"| {at} | `{field.name}` | {kind} | {field.about} |")
        at += field.count * struct.calcsize(f"<{field.kind}")
    return "\n".join(lines) + "\n"


def _block(title: str, address: int, block: Sequence[BlockField]) -> str:
    """Return the heading and table of a block; address: its first register."""
    lines = [f"## {title}: {count_registers(block)} registers from {address}", ""]
    lines += ["| register | field | type | meaning |", "|---|---|---|---|"]
    for field in block:
        length = field.count * struct.calcsize(f">{field.kind}") // 2
        span = str(address) if length == 1 else f"{address}–{address + length - 1}"
        kind = KINDS[field.kind] + (f" × {field.count}" if field.count > 1 else "")
        lines.append(f"| {span} | `{field.name}` | {kind} | {field.about} |")
        address += length
    return "\n".join(lines) + "\n"
