"""Generate the reference of topics and message types, and of the topics of ROS 2."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flexsheet.launch.ros2.mapping import OWN_PREFIX, list_ros_topics
from flexsheet.messages.base import Header
from flexsheet.messages.field_types import describe_bounds, describe_field_type
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS, Topic


def render_topics() -> str:
    """Return the table of topics."""
    rows = [
        (
            f"`{topic.name}`",
            f"[{topic.message.__name__}](#{topic.message.__name__.lower()})",
            topic.delivery.value,
            _rate(topic),
            "many" if topic.many_writers else "one",
            "yes" if topic.logged else "no",
            f"{topic.max_bytes >> 20} MiB",
            topic.about,
        )
        for topic in TOPICS.values()
    ]
    heads = ("topic", "type", "delivery", "expected rate", "writers", "recorded", "at most", "what")
    return format_table(heads, rows)


def _rate(topic: Topic) -> str:
    if topic.rate_hz is None:
        return "on change"
    return f"{topic.rate_hz[0]:g}-{topic.rate_hz[1]:g} Hz"


def render_header() -> str:
    """Return the table of the header's fields, with descriptions from its docstring."""
    described: dict[str, str] = {}
    for line in inspect.cleandoc(Header.__doc__ or "").splitlines():
        name, colon, text = line.partition(": ")
        if colon and name in Header.__slots__:
            described[name] = text
        elif described and line.strip():
            described[next(reversed(described))] += " " + line.strip()
    types = inspect.get_annotations(Header, eval_str=True)
    rows = [
        (f"`{name}`", types[name].__name__, described.get(name, "")) for name in Header.__slots__
    ]
    return format_table(("field", "type", "what"), rows)


def render_types() -> str:
    """Return a section for each type of a topic, then for each part of these types."""
    types = list(dict.fromkeys(topic.message for topic in TOPICS.values()))
    parts = list(dict.fromkeys(part for kind in types for part in nested_models(kind)))
    sections = [type_section(kind) for kind in types]
    sections.append("## Parts\n\nGroups of fields within the types above.\n")
    return "\n".join([*sections, *(type_section(kind) for kind in parts)])


def render_scene() -> str:
    """Return a section for the type of scene files, then for each of its parts."""
    kinds: list[type[BaseModel]] = [Scene, *nested_models(Scene)]
    return "\n".join(type_section(kind) for kind in dict.fromkeys(kinds))


def type_section(kind: type[BaseModel]) -> str:
    """Return a section with a type's name, docstring and fields."""
    rows = [
        (f"`{name}`", describe_field_type(field), _field_notes(field))
        for name, field in kind.model_fields.items()
    ]
    text = inspect.cleandoc(kind.__doc__ or "")
    return f"### {kind.__name__}\n\n{text}\n\n{format_table(('field', 'type', 'notes'), rows)}"


def _field_notes(field: FieldInfo) -> str:
    """Return bounds, default and description of a field."""
    notes = describe_bounds(field)
    if field.default_factory is not None:
        notes.append("empty by default")
    elif not field.is_required():
        notes.append(f"default {field.default!r}")
    if field.description:
        notes.append(field.description)
    return "; ".join(notes)


def nested_models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield all models within a type, outer ones first, without the type itself."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for field in annotation.model_fields.values():
            for inner in _models_in(field.annotation):
                yield inner
                yield from nested_models(inner)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def format_table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    lines = [heads, tuple("---" for _ in heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"


def render_ros2_topics() -> str:
    """Return the table of ROS topics by topic and field."""
    rows = []
    for topic in TOPICS.values():
        for ros_topic, view in list_ros_topics(topic):
            if view is not None:
                rows.append((f"`{topic.name}`", view.fields, f"`{ros_topic.name}`", view.ros_type))
    rows.append(("each", "JSON, without images", f"`{OWN_PREFIX}TOPIC`", "std_msgs/msg/String"))
    return format_table(("topic", "fields", "ROS topic", "ROS type"), rows)
