"""Plot fields of recorded topics against time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from flexsheet.launch.plans.documents import BadInputError, did_you_mean
from flexsheet.messages.bag import BagReader
from flexsheet.messages.topics import UnknownTopicError, find_topic
from flexsheet.nodes.arrays import Floats

MAX_COMPONENTS = 16
"""The maximum number of lines in one chart.

Fields with more numbers, such as images, are rejected.
"""

CHART_SIZE_IN = (8.0, 2.4)
"""The width and the height of the chart of one field, in inches."""


@dataclass(frozen=True, slots=True)
class FieldSeries:
    """The values of a message field as a function of time.

    name: topic and field, as "TOPIC.FIELD".
    times_s: n source times (s) since the start of the bag.
    values: values of the field at these times, (n, components).
    """

    name: str
    times_s: Floats
    values: Floats

    def to_json(self) -> dict[str, Any]:
        """Return the series as a dictionary of values that JSON can represent."""
        return {
            "field": self.name,
            "times_s": self.times_s.tolist(),
            "values": self.values.tolist(),
        }


def read_fields(
    bag: Path, names: Sequence[str], progress: Callable[[float, float], None]
) -> list[FieldSeries]:
    """Read numeric message fields from a bag.

    names: names of the fields, as "TOPIC.FIELD" or "TOPIC.FIELD.FIELD".
    progress: function that is called with the duration read so far and the total duration (s).

    Raises BadInputError if the bag does not contain a topic or field, or if a field is not numeric.
    """
    paths = {name: _parse(name) for name in names}
    reader = BagReader(bag)
    recorded = sorted(reader.topics)
    for name, (topic, path) in paths.items():
        if topic not in recorded:
            raise _error(bag, f'{name}: topic "{topic}" is not in the bag', topic, recorded)
        if not path:
            what = f"{topic}: name a field of this topic"
            fields = list_plottable_fields(bag, topic)
            raise BadInputError.single(str(bag), (), what, f"choose from: {', '.join(fields)}")
    summary = reader.info()
    rows: dict[str, list[tuple[float, Floats]]] = {name: [] for name in names}
    topics = {topic for topic, _ in paths.values()}
    for topic, message, header, log_ns in BagReader(bag, sorted(topics)):
        progress(1e-9 * (log_ns - summary.start_ns), summary.duration_s)
        for name, (wanted, path) in paths.items():
            if wanted == topic and (value := _get_number(bag, name, message, path)) is not None:
                rows[name].append((1e-9 * (header.source_ns - summary.start_ns), value))
    return [_make_series(bag, name, found) for name, found in rows.items()]


def list_plottable_fields(bag: Path, topic: str) -> list[str]:
    """Return the fields of a recorded topic that can be plotted, as "TOPIC.FIELD".

    A field can be plotted if it is numeric in the first message of the topic. If this message does
    not contain an optional field, the field is not listed.
    """
    for _, message, _, _ in BagReader(bag, [topic]):
        return [f"{topic}.{name}" for name in _list_numeric(message)]
    return []


def _list_numeric(message: BaseModel) -> Iterator[str]:
    for name in type(message).model_fields:
        value = getattr(message, name)
        if isinstance(value, BaseModel):
            yield from (f"{name}.{inner}" for inner in _list_numeric(value))
        elif isinstance(value, (bool, int, float, tuple, np.ndarray)):
            numbers = _convert_numbers(value)
            if numbers is not None and 0 < numbers.size <= MAX_COMPONENTS:
                yield name


def _convert_numbers(value: Any) -> Floats | None:
    """Return a value as numbers (n,), or None if it is not numeric."""
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        return None


def _parse(name: str) -> tuple[str, list[str]]:
    """Split "TOPIC.FIELD.FIELD" into the topic and the list of nested field names.

    The list is empty if the name is a topic only.

    Raises BadInputError if the topic or its field does not exist.
    """
    topic, _, path = name.partition(".")
    try:
        fields: Any = find_topic(topic).message.model_fields
    except UnknownTopicError as error:
        raise BadInputError.single(name, (), str(error)) from error
    if not path:
        return topic, []
    first, *inner = path.split(".")
    if first not in fields:
        what = f'topic "{topic}" does not contain the field "{first}"'
        raise BadInputError.single(name, (), what, did_you_mean(first, list(fields)))
    return topic, [first, *inner]


def _get_number(bag: Path, name: str, message: BaseModel, path: Sequence[str]) -> Floats | None:
    """Return the numbers (components,) of a message field, or None if the field is null.

    path: names of the nested fields that lead to the value.

    Raises BadInputError if the field does not exist or is not numeric.
    """
    value: Any = message
    for place, part in enumerate(path):
        if isinstance(value, np.ndarray | tuple):
            return _get_component(bag, name, value, path[place:])
        fields = type(value).model_fields if isinstance(value, BaseModel) else {}
        if value is None:
            return None
        if part not in fields:
            raise _error(bag, f'{name}: unknown field "{part}"', part, list(fields))
        value = getattr(value, part)
    if value is None:
        return None
    if isinstance(value, BaseModel):
        inner = list(type(value).model_fields)
        raise _error(bag, f"{name}: this is a group of fields; append one of them", "", inner)
    numbers = _convert_numbers(value)
    if numbers is None:
        raise BadInputError.single(
            str(bag), (), f"{name}: the field is not a number", "choose another field"
        )
    if numbers.size > MAX_COMPONENTS:
        what = f"{name}: the field has {numbers.size} numbers, more than {MAX_COMPONENTS}"
        raise BadInputError.single(str(bag), (), what, "choose another field")
    return numbers


def _get_component(bag: Path, name: str, value: Any, path: Sequence[str]) -> Floats:
    """Return one component of a vector, named x, y or z, or by its number from 1."""
    numbers = _convert_numbers(value)
    size = 0 if numbers is None else numbers.size
    known = ["x", "y", "z"][:size] if size <= len("xyz") else [str(1 + i) for i in range(size)]
    (part, *rest) = path
    if numbers is None or rest or part not in known:
        raise _error(bag, f'{name}: unknown component "{part}"', part, known)
    return numbers[[known.index(part)]]


def _make_series(bag: Path, name: str, rows: list[tuple[float, Floats]]) -> FieldSeries:
    if not rows:
        raise BadInputError.single(
            str(bag), (), f"{name}: the bag contains no value of this field", "choose another field"
        )
    width = max(values.size for _, values in rows)
    table = np.full((len(rows), width), np.nan)
    for row, (_, values) in zip(table, rows, strict=True):
        row[: values.size] = values
    return FieldSeries(name, np.array([time_s for time_s, _ in rows]), table)


def _error(bag: Path, what: str, name: str, known: list[str]) -> BadInputError:
    return BadInputError.single(str(bag), (), what, did_you_mean(name, known))


def draw_fields(series: Sequence[FieldSeries], image: Path, *, title: str) -> None:
    """Draw one chart for each series, with a common time axis, into an image file.

    Raises BadInputError if the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(CHART_SIZE_IN[0], CHART_SIZE_IN[1] * len(series)), layout="constrained"
    )
    FigureCanvasAgg(figure)
    charts = figure.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0]
    for axes, one in zip(charts, series, strict=True):
        components = one.values.shape[1]
        labels = "xyz" if components == 3 else [str(number) for number in range(components)]
        for label, values in zip(labels, one.values.T, strict=True):
            axes.plot(one.times_s, values, linewidth=1.0, label=label)
        axes.set_ylabel(one.name)
        axes.grid(alpha=0.3)
        if components > 1:
            axes.legend(loc="upper right", ncols=min(components, 6), fontsize="small")
    charts[0].set_title(title)
    charts[-1].set_xlabel("time from the start of the bag, s")
    try:
        figure.savefig(image)
    except (OSError, ValueError) as error:
        raise BadInputError.single(
            str(image), (), f"the image cannot be written: {error}", "name a .svg or .png file"
        ) from error
