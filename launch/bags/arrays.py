"""Read the fields of a recorded topic as arrays, for pandas, matplotlib and other libraries."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from flexsheet.messages.bag import BagError, BagReader

MAX_NUMBERS = 100
"""The maximum number of elements per message of a field that is read without being named."""


def read_arrays(bag: Path | str, topic: str, *fields: str) -> dict[str, NDArray[Any]]:
    """Return the fields of a recorded topic as arrays with one row for each of n messages.

    The key "time_s" contains the source times (n,), s, since the start of the bag. The other keys
    are names of fields, such as "position_world_m" (n, 3) or "pose.rpy_rad". A missing value is
    NaN. Fields whose size differs between messages are omitted.

    fields: names of the fields to read; if none are given, all texts and all fields of at most
        `MAX_NUMBERS` numbers are read.

    Raises BagError if the bag cannot be read, or if it does not contain a field with arrays of one
    size.
    """
    reader = BagReader(bag, [topic])
    start_ns = reader.info().start_ns
    times_s: list[float] = []
    columns: dict[str, list[Any]] = {}
    for _, message, header, _ in reader:
        times_s.append(1e-9 * (header.source_ns - start_ns))
        for name, value in _list_values(message, ""):
            if name in fields or (not fields and np.size(value) <= MAX_NUMBERS):
                columns.setdefault(name, []).append(value)
    arrays = {"time_s": np.array(times_s)}
    for name, values in columns.items():
        shapes = {np.shape(value) for value in values if value is not None}
        if len(shapes) == 1 and len(values) == len(times_s):
            missing = np.full(shapes.pop(), np.nan)
            arrays[name] = np.array([missing if value is None else value for value in values])
    if absent := [name for name in fields if name not in arrays]:
        what = f'topic "{topic}" has no field {", ".join(absent)} of constant size'
        raise BagError(f"{bag}: {what}; read_arrays(bag, topic) lists its fields")
    return arrays


def _list_values(message: BaseModel, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of all fields that are numbers, arrays, texts or None."""
    for name in type(message).model_fields:
        value = getattr(message, name)
        if isinstance(value, BaseModel):
            yield from _list_values(value, f"{prefix}{name}.")
        elif value is None or isinstance(value, bool | int | float | str | np.ndarray):
            yield f"{prefix}{name}", value
        elif isinstance(value, tuple) and all(isinstance(one, int | float) for one in value):
            yield f"{prefix}{name}", np.array(value)
