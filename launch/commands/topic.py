"""`flexsheet topic`: list topics, and read or publish them in the running graph."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands.graph import (
    NoGraphError,
    choose_run,
    list_readers,
    receiving,
    run_interruptible,
    running_graph,
)
from flexsheet.launch.commands.options import (
    ChangedRunOption,
    JsonOption,
    RunOption,
    TopicArgument,
    make_app,
)
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_fields,
    print_json,
    print_json_line,
    print_outcome,
    print_rows,
    print_table,
    words,
)

if TYPE_CHECKING:
    from flexsheet.messages.base import Header, Message
    from flexsheet.messages.bus import Handler, Subscriber
    from flexsheet.messages.topics import Topic

app = make_app("List topics, and read or publish them in the running graph.")


CountOption = Annotated[
    int | None,
    typer.Option(
        "-t",
        "--count",
        help="Number of messages after which the command stops; default: it runs until Ctrl-C.",
        min=1,
    ),
]
REPORT_DELAY_S = 3.0
"""The time (s) after which the command reports that no message has arrived."""

PUBLISHING_PERIOD_S = 1.0
"""The time between two messages of `flexsheet topic pub --count`, in seconds."""

SHORT_ARRAY = 36
"""The maximum number of elements of an array that is printed completely."""


@app.command(
    "list",
    epilog=examples("flexsheet topic list", "flexsheet topic list --all --json"),
)
def list_topics(
    list_all: Annotated[
        bool,
        typer.Option(
            "--all", help="List all defined topics, including those that are not in the graph."
        ),
    ] = False,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the topics that have a writer or a reader in the running graph.

    If no graph is running, all defined topics are listed. The expected rate is the range of rates
    that health checks accept, or "on change" if the topic has no such range. `flexsheet topic hz
    TOPIC` measures the rate in the running graph.
    """
    from flexsheet.messages.topics import TOPICS

    topics = list(TOPICS.values())
    if not list_all:
        try:
            plan, _ = running_graph(run)
        except NoGraphError as error:
            words.print(f"{error}; all defined topics follow")
        else:
            topics = [
                one for one in topics if plan.writers.get(one.name) or list_readers(plan, one.name)
            ]
    rows = [_describe(topic) for topic in topics]
    if not as_json:
        for row in rows:
            rate = row["expected_rate_hz"]
            row["expected_rate_hz"] = "on change" if rate is None else "{:g}-{:g}".format(*rate)
            del row["many_writers"], row["max_bytes"]
    print_rows(rows, as_json=as_json)


@app.command(epilog=examples("flexsheet topic info fingertip"))
def info(topic: TopicArgument, run: RunOption = None, as_json: JsonOption = False) -> None:
    """Print the type and fields of a topic, and its writers and readers in the running graph."""
    from flexsheet.messages.field_types import describe_field
    from flexsheet.messages.topics import find_topic

    found = find_topic(topic)
    description = _describe(found)
    description["fields"] = {
        name: describe_field(field) for name, field in found.message.model_fields.items()
    }
    try:
        plan, _ = running_graph(run)
    except NoGraphError:
        pass
    else:
        description["writers"] = [writer.name for writer in plan.writers.get(topic, ())]
        description["readers"] = list_readers(plan, topic)
    if as_json:
        print_json(description)
        return
    fields = description.pop("fields")
    print_fields(
        (name, " ".join(map(str, value)) if isinstance(value, list | tuple) else value)
        for name, value in description.items()
    )
    print()
    print_table(
        ("field", "default", "type and description"),
        (
            (name, field["default"], ": ".join(filter(None, (field["type"], field["description"]))))
            for name, field in fields.items()
        ),
    )


@app.command(
    epilog=examples(
        "flexsheet topic echo fingertip",
        "flexsheet topic echo sheet_target --once --field stretch_ratio --json",
    )
)
def echo(
    *,
    topic: TopicArgument,
    once: Annotated[bool, typer.Option("-1", "--once", help="Print one message and exit.")] = False,
    count: CountOption = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Maximum time to wait for a message before the command fails, s.",
        ),
    ] = None,
    field: Annotated[
        str | None,
        typer.Option(
            metavar="FIELD", help="Field to print instead of the message, such as left.fx_px."
        ),
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the messages of a topic as they arrive; long arrays are summarized.

    With --json, each message is a JSON document on its own line.
    """
    from dataclasses import asdict

    from flexsheet.messages.topics import find_topic

    def show(message: Message, header: Header) -> None:
        value = to_plain(_get_field(message, field, topic))
        if as_json:
            print_json_line({"header": asdict(header), "message": value})
            return
        seconds = f"{header.source_ns * 1e-9:.6f}"
        print(f"--- {header.writer} #{header.sequence}, source {seconds} s")
        print("\n".join(_format_lines(value)), flush=True)

    limit = 1 if once else count
    raise typer.Exit(run_interruptible(_read(find_topic(topic), run, show, limit, timeout)))


@app.command(epilog=examples("flexsheet topic hz stereo", "flexsheet topic hz frame --json"))
def hz(
    topic: TopicArgument,
    duration: Annotated[
        float,
        typer.Option(metavar="SECONDS", help="Duration of the measurement, s.", min=0.1),
    ] = 5.0,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the rate, bandwidth and age of the messages of each writer of a topic.

    The rate follows from timestamps and sequence numbers. The age is the time from the source
    timestamp, such as the exposure of an image, until the message arrives at this command. It is
    not measured for a writer on another computer, because the clock of that computer can differ.
    """
    from flexsheet.messages.clock import SystemClock
    from flexsheet.messages.topics import find_topic

    found, clock = find_topic(topic), SystemClock()
    arrivals: list[Arrival] = []

    def receive(frames: Any, header: Header) -> None:
        size_bytes = sum(memoryview(frame).nbytes for frame in frames)
        arrivals.append(Arrival(header, size_bytes, clock.now_ns()))

    async def listen() -> int:
        with receiving([make_listener(found, run, receive, raw=True)]):
            await asyncio.sleep(duration)
        return 0

    run_interruptible(listen())
    if not arrivals:
        raise make_silence_error(topic, duration)
    print_rows(measure_rates(arrivals, clock.id), as_json=as_json)


@app.command(
    epilog=examples(
        "flexsheet topic pub display '{correction: two_pass, stereo: mono}'",
        "flexsheet topic pub estop @stop.yaml --count 3",
    )
)
def pub(
    *,
    topic: TopicArgument,
    message: Annotated[
        str, typer.Argument(help="Message in YAML or JSON, or @FILE to read it from a file.")
    ],
    count: Annotated[
        int,
        typer.Option("-t", "--count", help="Number of times to send it, once a second.", min=1),
    ] = 1,
    run: ChangedRunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Publish a message to the running graph.

    The topic must allow several writers, or the launch file must list it under `external_topics`.
    Subscribers that connect later receive a message of a latched topic only while this command
    runs.
    """
    from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter, find_tool_writer
    from flexsheet.messages.topics import find_topic

    found, graph = find_topic(topic), running_graph(choose_run(run))
    find_tool_writer(*graph, found.name)  # before errors in the message's fields
    built, sent = _parse_message(found, message), 0

    async def publish() -> int:
        nonlocal sent
        with closing(GraphWriter(*graph, [found.name])) as writer:
            await asyncio.sleep(READER_RECONNECT_S)
            while sent < count:
                if sent:
                    await asyncio.sleep(PUBLISHING_PERIOD_S)
                writer.publish(found.name, built)
                sent += 1
            # Wait for readers that are still connecting, because the latched message is lost with
            # the publisher's socket.
            await asyncio.sleep(READER_RECONNECT_S / 2)
        return 0

    run_interruptible(publish())
    print_outcome({"topic": topic, "sent": sent}, f'sent {sent} on "{topic}"', as_json=as_json)
    if not as_json:
        words.print("if a node refuses the message, `flexsheet status` shows why", style="dim")


def make_silence_error(topic: str, duration_s: float) -> CommandError:
    return CommandError(
        f'no message on "{topic}" within {duration_s:g} s; check that its writer is running: '
        "flexsheet topic echo status",
        FAILED,
    )


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that has arrived during a measurement.

    received_ns: time of arrival on the clock of this computer.
    """

    header: Header
    size_bytes: int
    received_ns: int


def measure_rates(arrivals: Sequence[Arrival], own_clock: str) -> list[dict[str, Any]]:
    """Return one row per writer with rate, lost messages, bandwidth, and statistics (ms) of times.

    The times are the interval between publications, and the age of the data at arrival. A writer
    that restarts has a new row, because its sequence numbers restart.

    own_clock: id of the clock of this computer.
    """
    import numpy as np

    groups: dict[tuple[str, int], list[Arrival]] = {}
    for one in arrivals:
        groups.setdefault((one.header.writer, one.header.epoch), []).append(one)
    rows = []
    for own in groups.values():
        sequences = np.array([one.header.sequence for one in own])
        stamps_s = np.array([one.header.publish_ns for one in own]) * 1e-9
        span_s = float(stamps_s[-1] - stamps_s[0])
        received_s = (own[-1].received_ns - own[0].received_ns) * 1e-9
        sent = int(sequences[-1] - sequences[0])
        sizes = [one.size_bytes for one in own]
        intervals_ms = np.diff(stamps_s)[np.diff(sequences) == 1] * 1e3
        ages_ms = [
            1e-6 * (one.received_ns - one.header.source_ns)
            for one in own
            if one.header.clock_id == own_clock
        ]
        rows.append(
            {
                "writer": own[0].header.writer,
                "rate_hz": sent / span_s if span_s > 0 else None,
                "received": len(own),
                "lost": int(sent + 1 - len(own)),
                "bytes_per_s": sum(sizes[1:]) / received_s if received_s > 0 else None,
                "mean_bytes": sum(sizes) / len(sizes),
                "interval_ms": _summarize(intervals_ms.tolist()),
                "age_ms": _summarize(ages_ms),
            }
        )
    return rows


def _summarize(values: list[float]) -> dict[str, float] | None:
    import numpy as np

    if not values:
        return None
    return {
        "p50": float(np.quantile(values, 0.5)),
        "p99": float(np.quantile(values, 0.99)),
        "max": float(np.max(values)),
    }


def to_plain(value: Any) -> Any:
    """Convert a message or field to JSON types; long arrays are replaced by a summary."""
    import numpy as np
    from pydantic import BaseModel

    if isinstance(value, BaseModel):
        return {name: to_plain(getattr(value, name)) for name in type(value).model_fields}
    if isinstance(value, np.ndarray):
        if value.size <= SHORT_ARRAY:
            return value.tolist()
        return {
            "dtype": str(value.dtype),
            "shape": list(value.shape),
            "min": value.min().item(),
            "max": value.max().item(),
        }
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return value


def _format_lines(value: Any, indent: str = "") -> list[str]:
    if not isinstance(value, dict):
        return [f"{indent}{_format_value(value)}"]
    lines = []
    for name, item in value.items():
        if isinstance(item, dict):
            lines += [f"{indent}{name}:", *_format_lines(item, indent + "  ")]
        else:
            lines.append(f"{indent}{name}: {_format_value(item)}")
    return lines


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{', '.join(_format_value(item) for item in value)}]"
    return str(value)


def _describe(topic: Topic) -> dict[str, Any]:
    return {
        "topic": topic.name,
        "message": topic.message.__name__,
        "delivery": str(topic.delivery),
        "expected_rate_hz": topic.rate_hz,
        "recorded": topic.logged,
        "many_writers": topic.many_writers,
        "max_bytes": topic.max_bytes,
        "about": topic.about,
    }


def _get_field(message: Message, path: str | None, topic: str) -> Any:
    value: Any = message
    for name in path.split(".") if path else ():
        fields = getattr(type(value), "model_fields", {})
        if name not in fields:
            from flexsheet.launch.plans.documents import did_you_mean

            raise CommandError(
                f'--field {path}: topic "{topic}" does not contain the field "{name}"; '
                f"{did_you_mean(name, list(fields))}"
            )
        value = getattr(value, name)
    return value


async def _read(
    topic: Topic, run: Path | None, show: Any, limit: int | None, timeout_s: float | None
) -> int:
    arrived: asyncio.Queue[tuple[Any, Any]] = asyncio.Queue()
    subscriber = make_listener(
        topic, run, lambda message, header: arrived.put_nowait((message, header))
    )
    why = "check its writer: flexsheet topic echo status"
    if topic.rate_hz is None:
        why = "this topic is published only when its value changes"
    text = f'no message on "{topic.name}" yet ({why}); press Ctrl-C to stop'
    waiting = asyncio.get_running_loop().call_later(REPORT_DELAY_S, words.print, text)
    with receiving([subscriber]):
        try:
            shown = 0
            while limit is None or shown < limit:
                async with asyncio.timeout(timeout_s):
                    message, header = await arrived.get()
                waiting.cancel()
                show(message, header)
                shown += 1
        except TimeoutError:
            raise make_silence_error(topic.name, timeout_s or 0.0) from None
        finally:
            waiting.cancel()
    return 0


def make_listener(
    topic: Topic, run_directory: Path | None, handler: Handler, *, raw: bool = False
) -> Subscriber:
    """Create a subscriber to a topic of the running graph.

    raw: whether to pass encoded messages to the handler.

    Raises CommandError if no node publishes the topic.
    """
    from flexsheet.launch.running.tools import make_subscriber

    plan, run = running_graph(run_directory)
    if not plan.writers.get(topic.name):
        raise CommandError(
            f'topic "{topic.name}" has no writer in the running graph {run.directory}; '
            "add a node that publishes it to the launch file",
            FAILED,
        )
    return make_subscriber(topic.name, plan, run, handler, on_problem=words.print, raw=raw)


def _parse_message(topic: Topic, text: str) -> Message:
    from ruamel.yaml.error import YAMLError

    from flexsheet.launch.plans.documents import Document, parse_json, parse_value, validate

    source = "MESSAGE"
    if text.startswith("@"):
        source = text[1:]
        try:
            text = Path(source).read_text()
        except OSError as error:
            raise CommandError(
                f"{source}: cannot be read: {error.strerror}; check the path"
            ) from error
    try:
        try:
            value = parse_json(text)
        except ValueError:  # JSON is valid YAML, so the YAML error describes faults in both
            value = parse_value(text)
    except YAMLError as error:
        raise CommandError(f"{source}: not valid YAML or JSON: {error}") from error
    if not isinstance(value, dict):
        raise CommandError(
            f"{source}: expected a mapping with the fields of {topic.message.__name__}"
        )
    origin = f"{source} ({topic.message.__name__})"
    message = validate(topic.message, Document(Path(origin), value, text, {}))
    if problem := message.find_problem():
        raise CommandError(f"{origin}: {problem}")
    return message
