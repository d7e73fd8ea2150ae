"""Convert bags to tables: one Parquet file per topic, or a table in memory.

Each row contains one message. The first columns contain the recording time. The next columns
contain the timestamps, clock, writer and sequence number from the message's header. Each message
field becomes one or more columns, which have the name of the field with its unit:

    number, text, timestamp          one column
    vector of 2 or 3                 FIELD.x, FIELD.y, FIELD.z
    vector of up to 6                FIELD.1, FIELD.2 and so on
    rigid transform                  FIELD.x_m, .y_m, .z_m, and the quaternion .qx, .qy, .qz, .qw
    twist                            FIELD.linear_x_m_per_s, ..., FIELD.angular_x_rad_per_s, ...
    other array                      one list; the column's metadata contain the array's shape
    group of fields                  the columns of the group, named GROUP.FIELD
    sequence of groups               list of structures
    choice between several types     text that contains JSON
    image                            omitted, or bytes with FIELD.height and FIELD.width
"""

from __future__ import annotations

import json
import shutil
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, TypeAdapter

from flexsheet.launch.bags.export import (
    ExportError,
    ExportResult,
    TopicsToExport,
    check_free_space,
    select_topics,
    wall_clock_offset_ns,
)
from flexsheet.messages.arrays import ArraySpec
from flexsheet.messages.bag import BagReader
from flexsheet.messages.base import Header, Message
from flexsheet.messages.field_types import get_annotation, is_image, split_annotation
from flexsheet.messages.files import make_write_error
from flexsheet.messages.topics import find_topic
from flexsheet.nodes.models.rigid import quaternion_from_rotation

if TYPE_CHECKING:
    import pyarrow

MAX_VECTOR = 6
ROWS_PER_GROUP = 2000
MAX_GROUP_BYTES = 64 << 20
"""The total size (bytes) of buffered images after which a row group is written to the file."""

TWIST = tuple(
    f"{kind}_{axis}_{unit}"
    for kind, unit in (("linear", "m_per_s"), ("angular", "rad_per_s"))
    for axis in "xyz"
)
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
NUMBERS = {bool: "bool", int: "int64", float: "double"}

Get = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table.

    get: function that reads the value of the column from a message.
    about: metadata of the column.
    """

    name: str
    type: Any
    get: Get
    about: Mapping[str, str]


def _arrow() -> Any:
    if find_spec("pyarrow") is None:
        raise ExportError("tables need the package pyarrow; run: pip install 'flexsheet[parquet]'")
    import pyarrow

    return pyarrow


@cache
def list_columns(kind: type[Message], *, images: bool) -> tuple[Column, ...]:
    """Return the table columns for the fields of a message type.

    images: whether image fields get columns.
    """
    return tuple(_columns_of_group(kind, "", lambda message: message, images))


def _columns_of_group(
    kind: type[BaseModel], prefix: str, get: Get, images: bool
) -> Iterator[Column]:
    for name, info in kind.model_fields.items():
        annotation = get_annotation(info)

        def get_field(row: Any, name: str = name) -> Any:
            group = get(row)
            return None if group is None else getattr(group, name)

        about = {} if info.description is None else {"description": info.description}
        yield from _columns_of_value(annotation, prefix + name, get_field, about, images)


def _columns_of_value(
    annotation: Any, name: str, get: Get, about: dict[str, str], images: bool
) -> Iterator[Column]:
    inner, spec = split_annotation(annotation)
    if spec is not None:
        yield from _columns_of_array(spec, name, get, about, images)
        return
    origin, arguments = get_origin(inner), get_args(inner)
    if origin in (Union, types.UnionType):
        rest = [argument for argument in arguments if argument is not type(None)]
        if len(rest) == 1:
            yield from _columns_of_value(rest[0], name, get, about, images)
            return
    if isinstance(inner, type) and issubclass(inner, BaseModel):
        yield from _columns_of_group(inner, f"{name}.", get, images)
        return
    if origin is tuple and arguments[-1] is not Ellipsis and _is_vector(arguments):
        for i, part in enumerate(_name_parts(name, len(arguments))):
            yield Column(part, _find_type(arguments[0]), _at(get, i), about)
        return
    if origin is tuple and split_annotation(arguments[0])[1] is not None:
        if images:  # a tuple of one image or none
            first = _applied(get, lambda values: values[0] if values else None)
            yield from _columns_of_value(arguments[0], name, first, about, images)
        return
    yield Column(name, _find_type(inner), _applied(get, _make_conversion(inner)), about)


def _columns_of_array(
    spec: ArraySpec, name: str, get: Get, about: dict[str, str], images: bool
) -> Iterator[Column]:
    arrow = _arrow()
    element = arrow.from_numpy_dtype(np.dtype(spec.dtype))
    if is_image(spec):
        if images:
            yield Column(name, arrow.binary(), _applied(get, lambda image: image.tobytes()), about)
            size = _applied(get, lambda image: image.shape)
            for axis, part in enumerate(("height", "width")):
                yield Column(f"{name}.{part}", arrow.int64(), _at(size, axis), {})
    elif spec.shape == (4, 4):
        yield from (
            Column(f"{name}.{part}", element, _at(_applied(get, split_pose), i), about)
            for i, part in enumerate(POSE)
        )
    elif len(spec.shape) == 1 and isinstance(spec.shape[0], int) and spec.shape[0] <= MAX_VECTOR:
        for i, part in enumerate(_name_parts(name, spec.shape[0])):
            yield Column(part, element, _at(get, i), about)
    else:
        shape = {"shape": spec.describe_shape()}
        yield Column(name, arrow.list_(element), _applied(get, np.ravel), about | shape)


def split_pose(matrix: np.ndarray) -> list[float]:
    """Return the position (m) and the quaternion of a rigid transform (4, 4).

    The result is a list of seven numbers: x, y, z, qx, qy, qz, qw.
    """
    w, *xyz = quaternion_from_rotation(matrix[:3, :3]).tolist()
    return [*matrix[:3, 3].tolist(), *xyz, w]


def _name_parts(name: str, length: int) -> list[str]:
    if name.rpartition(".")[2].startswith("twist_"):
        return [f"{name}.{part}" for part in TWIST]
    parts = "xyz"[:length] if length <= 3 else map(str, range(1, length + 1))
    return [f"{name}.{part}" for part in parts]


def _is_vector(arguments: tuple[Any, ...]) -> bool:
    kinds = {split_annotation(one)[0] for one in arguments}
    return len(kinds) == 1 and kinds <= NUMBERS.keys() and len(arguments) <= MAX_VECTOR


def _find_type(annotation: Any) -> Any:
    """Return the Arrow type of a column whose values have the given type annotation."""
    arrow = _arrow()
    inner, spec = split_annotation(annotation)
    if spec is not None:
        return arrow.list_(arrow.from_numpy_dtype(np.dtype(spec.dtype)))
    if inner in NUMBERS:
        return arrow.type_for_alias(NUMBERS[inner])
    if isinstance(inner, type) and issubclass(inner, BaseModel):
        columns = list(_columns_of_group(inner, "", lambda group: group, False))
        return arrow.struct([(one.name, one.type) for one in columns])
    if get_origin(inner) is tuple and get_args(inner)[-1] is Ellipsis:
        return arrow.list_(_find_type(get_args(inner)[0]))
    return arrow.string()


def _make_conversion(annotation: Any) -> Get:
    """Return a function that converts values with the given type annotation to Arrow values."""
    inner, spec = split_annotation(annotation)
    if spec is not None:
        return np.ravel
    if inner in NUMBERS:
        return lambda value: value
    if isinstance(inner, type) and issubclass(inner, BaseModel):
        columns = list(_columns_of_group(inner, "", lambda group: group, False))
        return lambda group: {one.name: one.get(group) for one in columns}
    if get_origin(inner) is tuple and get_args(inner)[-1] is Ellipsis:
        item = _make_conversion(get_args(inner)[0])
        return lambda values: [item(one) for one in values]
    is_text = get_origin(inner) is Literal or (isinstance(inner, type) and issubclass(inner, str))
    if is_text:
        return lambda value: value.value if isinstance(value, Enum) else value
    adapter = TypeAdapter(inner)
    return lambda value: json.dumps(adapter.dump_python(value, mode="json"))


def _applied(get: Get, function: Callable[[Any], Any]) -> Get:
    """Return a getter that applies `function` to each value that `get` returns.

    If `get` returns None, the new getter also returns None.
    """

    def apply(row: Any) -> Any:
        value = get(row)
        return None if value is None else function(value)

    return apply


def _at(get: Get, index: int) -> Get:
    return _applied(get, lambda values: values[index])


class TableBuilder:
    """A builder of an Arrow table from the messages of one topic."""

    def __init__(self, topic: str, selection: TopicsToExport, *, images: bool) -> None:
        arrow = _arrow()
        self._selection, self._topic = selection, topic
        self._columns = list_columns(find_topic(topic).message, images=images)
        self._first = {
            "time_s": arrow.float64(),
            "log_time_ns": arrow.int64(),
            "source_ns": arrow.int64(),
            "publish_ns": arrow.int64(),
            "clock_id": arrow.string(),
            "writer": arrow.string(),
            "sequence_number": arrow.int64(),
        }
        offset_ns = wall_clock_offset_ns(selection.reader)
        metadata = {"topic": topic, "bag": selection.reader.path.name}
        if offset_ns is not None:
            metadata["wall_clock_offset_ns"] = str(offset_ns)
        self.schema = arrow.schema(
            [
                *(arrow.field(name, kind) for name, kind in self._first.items()),
                *(arrow.field(one.name, one.type, metadata=one.about) for one in self._columns),
            ],
            metadata=metadata,
        )
        self._rows: list[list[Any]] = []
        self._bytes = 0

    @property
    def is_full(self) -> bool:
        """Return whether enough rows are buffered to write them as a row group."""
        return len(self._rows) >= ROWS_PER_GROUP or self._bytes >= MAX_GROUP_BYTES

    def add(self, message: Message, header: Header, log_ns: int) -> None:
        """Add a row for a message.

        The column `time_s` contains the source timestamp of the message, in seconds since the start
        of the bag.

        log_ns: time when the message was recorded, ns.
        """
        # The delay between publication and recording is negligible.
        same_clock = header.clock_id == self._selection.clock_id
        source_ns = header.source_ns + (0 if same_clock else log_ns - header.publish_ns)
        row = [
            (source_ns - self._selection.start_ns) * 1e-9,
            log_ns,
            header.source_ns,
            header.publish_ns,
            header.clock_id,
            header.writer,
            header.sequence,
            *(one.get(message) for one in self._columns),
        ]
        self._bytes += sum(len(value) for value in row if isinstance(value, bytes))
        self._rows.append(row)

    def drain(self) -> pyarrow.Table:
        """Return the buffered rows as a table, and clear the buffer.

        Raises ExportError if a value does not fit the type of its column.
        """
        arrow = _arrow()
        columns = zip(*self._rows, strict=True) if self._rows else ((),) * len(self.schema)
        try:
            arrays = [
                arrow.array(list(values), type=kind)
                for values, kind in zip(columns, self.schema.types, strict=True)
            ]
        except (OverflowError, arrow.ArrowInvalid) as error:
            path = self._selection.reader.path
            raise ExportError(f'{path}: topic "{self._topic}": {error}') from error
        self._rows, self._bytes = [], 0
        return arrow.table(arrays, schema=self.schema)


def read_table(bag: Path | str, topic: str, *, images: bool = False) -> pyarrow.Table:
    """Read a topic of a bag into an Arrow table.

    `to_pandas` converts the table to a pandas data frame.

    images: whether the table contains images.

    Raises ExportError if the table cannot be made, and BagError if the bag cannot be read.
    """
    selection = select_topics(Path(bag), None, [topic])
    if not selection.readable:
        raise ExportError(
            f'{bag}: topic "{topic}" was recorded with an incompatible message type; read it with '
            "the version that recorded the bag"
        )
    builder = TableBuilder(topic, selection, images=images)
    for _, message, header, log_ns in BagReader(bag, [topic]):
        builder.add(message, header, log_ns)
    return builder.drain()


def write_parquet(
    bag: Path,
    output: Path,
    *,
    topics: Iterable[str] | None = None,
    images: bool = False,
    progress: Callable[[float, float], None] = lambda done_s, whole_s: None,
) -> ExportResult:
    """Write one Parquet file for each topic of a bag into a new folder.

    A slash in the name of a topic becomes a dot in the name of the file.

    topics: names of the topics, or None for all topics.
    images: whether the tables contain images.
    progress: function that is called with the duration converted so far and the total duration (s).

    Raises ExportError if the export fails, and BagError if the bag cannot be read.
    """
    _arrow()
    from pyarrow.parquet import ParquetWriter

    selection = select_topics(bag, output, topics)
    result = ExportResult(output, unreadable=selection.unreadable)
    draft = output.with_name(f"{output.name}.part")
    builders = {
        topic: TableBuilder(topic, selection, images=images) for topic in selection.readable
    }
    writers: dict[str, Any] = {}
    try:
        shutil.rmtree(draft, ignore_errors=True)
        check_free_space(output)
        draft.mkdir()
        try:
            for topic, builder in builders.items():
                file = draft / f"{topic.replace('/', '.')}.parquet"
                writers[topic] = ParquetWriter(file, builder.schema, compression="zstd")
            for number, (topic, message, header, log_ns) in enumerate(
                BagReader(bag, selection.readable)
            ):
                builders[topic].add(message, header, log_ns)
                result.messages[topic] = result.messages.get(topic, 0) + 1
                if builders[topic].is_full:
                    check_free_space(output)
                    writers[topic].write_table(builders[topic].drain())
                if number % 200 == 0:
                    progress((log_ns - selection.start_ns) * 1e-9, selection.duration_s)
            for topic, builder in builders.items():
                writers[topic].write_table(builder.drain())
        finally:
            for writer in writers.values():
                writer.close()
        draft.rename(output)
    except OSError as error:
        raise ExportError(str(make_write_error(output, error))) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return result
