"""Find the problems in a recorded session, for the first section of the bag report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from flexsheet.launch.experiments.stroke import ARM_EVENTS
from flexsheet.messages.units import format_percent

Gravity = Literal["bad", "doubtful"]

SLOW_RATIO = 0.5
"""The fraction of a topic's minimum rate below which the rate is reported as a problem."""

MAX_UNSEEN_RATIO = 0.05
"""The limit for the fraction of images that give no valid fingertip.

A larger fraction is reported as a problem.
"""

MAX_LIMIT_RATIO = 1.0
"""The maximum ratio of a value to its limit that is not reported as a problem."""

ROUNDING = 1.02
"""The factor by which measured values can exceed their limits because of rounding."""


@dataclass(frozen=True, slots=True)
class SessionFinding:
    """A problem that was found in a recorded session.

    gravity: "bad" for a failure, "doubtful" for a possible problem that the user should check.
    section: id of the section of the page with details.
    """

    gravity: Gravity
    text: str
    section: str


BRIEFLY_BUSY_FRACTION = 0.05
"""The maximum fraction of time for which an overload is reported only as a possible problem.

A longer overload is reported as a failure. An overload during which an arm stopped is also reported
as a failure.
"""

CHECKED = (
    "overload of the computers; "
    "completeness and types of the bag; state of the code; e-stops, faults and modes of the arms; "
    "joint speed, tool speed and edge force against their limits; nodes' errors and restarts; "
    "each topic's rate, silences, losses and refusals; latency, sheet position and the soft body's "
    "range against the scene's tolerances; tracking of the finger and following in contact; "
    "late frames"
)


def find_problems(numbers: dict[str, Any]) -> list[SessionFinding]:
    """Return all problems in a recorded session.

    An overload of the computers is first, because it causes most other problems. Failures are next,
    and possible problems are last.

    numbers: result of `compute_numbers`.
    """
    flow = {name: list(_check_flow(name, topic)) for name, topic in numbers["topics"].items()}
    overload = _check_load(numbers, [name for name, found in flow.items() if found])
    found = [
        *_check_bag(numbers),
        *_check_arms(numbers),
        *_check_nodes(numbers),
        *_check_refused(numbers),
        # An overload affects many topics, so one finding lists all of them.
        *([] if overload else (one for found in flow.values() for one in found)),
        *_check_tolerances(numbers),
        *_check_finger(numbers),
    ]
    return [*overload, *sorted(found, key=lambda one: one.gravity != "bad")]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _check_load(numbers: dict[str, Any], affected: list[str]) -> list[SessionFinding]:
    """Return one problem if any computer was overloaded, otherwise an empty list.

    affected: names of the topics whose messages were lost or delayed.
    """
    hosts = [host for host in numbers["hosts"].values() if host["busy_fraction"]]
    if not hosts:
        return []
    parts = [
        f"In {host['busy_fraction']:.0%} of the time {host['busy_at_worst']} (at worst)."
        for host in hosts
    ]
    stopped = numbers["events"]["counts"].get("arm", 0)
    effects = [f"an arm stopped following {_times(stopped)}"] if stopped else []
    if affected:
        effects.append(f"messages of these topics were lost or delayed: {', '.join(affected)}")
    if effects:
        parts.append(f"Probable consequences: {'; '.join(effects)}.")
    parts.append(f"What to do: {'; '.join(dict.fromkeys(host['busy_remedy'] for host in hosts))}.")
    often = max(host["busy_fraction"] for host in hosts) > BRIEFLY_BUSY_FRACTION
    return [SessionFinding("bad" if stopped or often else "doubtful", " ".join(parts), "bag")]


MAX_TOPICS_LISTED = 10


def _check_bag(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    bag = numbers["bag"]
    if not bag["complete"]:
        yield SessionFinding(
            "bad",
            f"The bag is incomplete ({bag['problem']}); only its readable part is evaluated.",
            "bag",
        )
    if lost := int(bag["recording"].get("lost_messages", 0)):
        yield SessionFinding(
            "bad", f"The recorder lost {lost} messages before this bag (disk full).", "bag"
        )
    unreadable = [
        f"{name} cannot be read: {topic['type']} has changed since the recording."
        for name, topic in numbers["topics"].items()
        if topic["readable"] is False
    ]
    for text in unreadable[:MAX_TOPICS_LISTED]:
        yield SessionFinding("doubtful", text, "topics")
    if len(unreadable) > MAX_TOPICS_LISTED:
        text = f"{len(unreadable) - MAX_TOPICS_LISTED} more topics cannot be read."
        yield SessionFinding("doubtful", text, "topics")
    if numbers["git"].get("changed"):
        text = "The code has changes after its commit, so this run cannot be reproduced exactly."
        yield SessionFinding("doubtful", text, "bag")
    for name, host in numbers["hosts"].items():
        if host["missing_devices"]:
            devices = ", ".join(host["missing_devices"])
            text = f"{name}: these devices of its nodes are missing: {devices}."
            yield SessionFinding("bad", text, "bag")


def _check_arms(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    counts, first = numbers["events"]["counts"], numbers["events"]["first"]
    for kind, what in (
        ("estop", "An e-stop was engaged or released"),
        ("fault", "An arm had a fault"),
        ("arm", "An arm stopped operating"),
    ):
        if kind in counts:
            event = next(one for one in first if one["kind"] == kind)
            start = f"first at {event['seconds']:.2f} s: {event['text']}"
            text = f"{what} {_times(counts[kind])}, {start}."
            yield SessionFinding("bad", text, "timeline")
    scene = numbers["scene"] or {}
    for side, arm in numbers["arms"].items():
        ratios = [ratio for ratio in arm["joint_speed_ratio"] if ratio is not None]
        if ratios and max(ratios) > ROUNDING * MAX_LIMIT_RATIO:
            joint = arm["joint_speed_ratio"].index(max(ratios)) + 1
            text = f"{side} arm: joint {joint} reached {max(ratios):.0%} of its maximum speed."
            yield SessionFinding("bad", text, "arms")
        for key, limit, scale, unit, what in (
            ("tool_speed_mm_per_s", "max_tool_speed_m_per_s", 1e3, "mm/s", "tool speed"),
            ("edge_force_n", "max_edge_force_n", 1.0, "N", "edge force"),
        ):
            most = arm[key]
            if most is not None and limit in scene and most > ROUNDING * scale * scene[limit]:
                allowed = scale * scene[limit]
                text = (
                    f"{side} arm: the {what} reached {most:.3g} {unit}; the scene allows "
                    f"{allowed:.3g} {unit}."
                )
                yield SessionFinding("bad", text, "arms")


def _check_nodes(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    for name, node in numbers["nodes"].items():
        if node["errors"]:
            count = "an error" if node["errors"] == 1 else f"{node['errors']} errors"
            yield SessionFinding(
                "bad", f"{name} had {count}; the last: {node['last_error']}.", "nodes"
            )
        if node["starts"] > 1:
            yield SessionFinding("bad", f"{name} was started {node['starts']} times.", "nodes")
        if node["degraded"] and not node["errors"]:
            text = f"{name} was degraded {node['degraded']} times: {node['last_error']}"
            yield SessionFinding("doubtful", f"{text.rstrip(' :')}.", "nodes")


def _check_refused(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    for name, topic in numbers["topics"].items():
        if topic["refused"]:
            text = f"{name}: {topic['refused']} messages were refused by their readers."
            yield SessionFinding("bad", text, "topics")


def _check_flow(name: str, topic: dict[str, Any]) -> Iterator[SessionFinding]:
    """Yield a problem for lost messages and a problem for delayed messages of a topic.

    An overload of a computer can cause both problems.
    """
    expected, rate = topic["expected_hz"], topic["rate_hz"]
    if topic["lost"]:
        text = f"{name}: {topic['lost']} messages were lost between writer and readers."
        yield SessionFinding("doubtful", text, "topics")
    if topic["missing"]:
        text = f"{name}: {topic['missing']} messages never reached the recorder."
        yield SessionFinding("doubtful", text, "topics")
    if expected and rate and topic["messages"] > 10 and rate < SLOW_RATIO * expected[0]:
        text = f"{name} had a rate of {rate:.3g} Hz; at least {expected[0]:.3g} Hz is expected."
        yield SessionFinding("doubtful", text, "topics")
    if topic["silences"]:
        gap_s = topic["longest_silence_s"]
        times = _times(topic["silences"])
        text = f"The topic {name} had no messages {times}, for at most {gap_s:.2f} s."
        yield SessionFinding("doubtful", text, "topics")


def _check_tolerances(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    if numbers["scene"] is None:
        return
    tolerances = numbers["scene"]["tolerances"]
    allowed_ms = 1e3 * tolerances["latency_s"]
    for event in ARM_EVENTS.values():
        p99 = numbers["latency_ms"].get(event, {}).get("p99")
        if p99 is not None and p99 > allowed_ms:
            text = (
                f"The time from exposure to {event} was {p99:.1f} ms (99 %); the scene allows "
                f"{allowed_ms:.3g} ms."
            )
            yield SessionFinding("doubtful", text, "latency")
    contact = numbers["sheet"]["contact"]
    for key, what in (("true_delta_d_mm", "true"), ("delta_d_mm", "measured")):
        errors = contact[key]
        most_mm = 1e3 * tolerances["sheet_position_m"]
        if errors is not None:
            if errors["mean"] > most_mm:
                text = (
                    f"In contact, the mean position error of the sheet relative to the {what} "
                    f"finger was {errors['mean']:.3g} mm; the scene allows {most_mm:.3g} mm."
                )
                yield SessionFinding("doubtful", text, "sheet")
            break
    body = numbers["soft_body"]
    if body["out_of_range"]:
        ratio = body["out_of_range"] / sum(body["methods"].values())
        text = (
            f"In {format_percent(ratio)} of the results, the finger was deeper than the range of "
            "the soft body's method, or past the part that can be touched. Its force and shape are "
            "approximate there; push less deeply if they matter."
        )
        yield SessionFinding("doubtful", text, "nodes")


def _check_finger(numbers: dict[str, Any]) -> Iterator[SessionFinding]:
    reasons = numbers["finger"]["reasons"]
    total = sum(reasons.values())
    missed = {reason: count for reason, count in reasons.items() if reason != "ok"}
    if total and sum(missed.values()) > MAX_UNSEEN_RATIO * total:
        worst = max(missed, key=lambda reason: missed[reason])
        ratio = sum(missed.values()) / total
        percent = format_percent(ratio)
        text = f"{percent} of the images had no valid finger; the main reason is: {worst}."
        yield SessionFinding("doubtful", text, "sheet")
    for path in numbers["sheet"]["followed"]:
        if path["drop_outs"]:
            times = _times(path["drop_outs"])
            text = (
                f'On the path "{path["path"]}" the arms stopped following in contact {times}; '
                f"they followed for {format_percent(path['following_ratio'])} of the contact."
            )
            yield SessionFinding("doubtful", text, "sheet")
    frames = numbers["frames"]
    if frames["late"]:
        text = f"{frames['late']} of {frames['count']} frames were late by more than half a period."
        yield SessionFinding("doubtful", text, "latency")
