"""Write the register map of the Modbus driver into docs/modbus.md, between its marks."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from flexsheet.nodes.arm_bridge.modbus import (
    COMMAND,
    COMMAND_ADDRESS,
    FAULT_BITS,
    STATUS,
    STATUS_ADDRESS,
    Field,
    register_count,
)

BEGIN = "<!-- registers: written by `make pages`; a test compares -->\n"
END = "<!-- end of registers -->\n"
KINDS = {"H": "u16", "I": "u32", "f": "float32"}


def page(text: str) -> str:
    """Return the page with a new register map; ValueError if it lacks the marks."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page needs the marks {BEGIN.strip()} and {END.strip()}")
    return f"{before}{begin}\n{registers()}\n{end}{after}"


def registers() -> str:
    """Both blocks and the fault bits."""
    bits = ["Fault bits:", "", "| bit | meaning |", "|---|---|"]
    bits += [f"| {bit} | {words} |" for bit, words in FAULT_BITS.items()]
    blocks = [
        _block("Command", COMMAND_ADDRESS, COMMAND),
        _block("Status", STATUS_ADDRESS, STATUS),
        "\n".join(bits) + "\n",
    ]
    return "\n".join(blocks)


def _block(title: str, address: int, block: Sequence[Field]) -> str:
    """Return a block's heading and table; address: of its first register."""
    lines = [f"## {title}: {register_count(block)} registers from {address}", ""]
    lines += ["| register | field | type | meaning |", "|---|---|---|---|"]
    for field in block:
        length = field.count * struct.calcsize(f">{field.kind}") // 2
        span = str(address) if length == 1 else f"{address}–{address + length - 1}"
        kind = KINDS[field.kind] + (f" × {field.count}" if field.count > 1 else "")
        lines.append(f"| {span} | `{field.name}` | {kind} | {field.about} |")
        address += length
    return "\n".join(lines) + "\n"
