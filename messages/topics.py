"""The one table of topics.

Ports, recorder, health checks, command line and docs are derived from it, by name.  To add a topic
is to add a line.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum

from flexsheet.messages import apparatus, scene, types
from flexsheet.messages.base import Message
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.migrations import RENAMED_TOPICS


class Delivery(StrEnum):
    """What a slow or late subscriber gets.

    latest: the newest only; older ones are dropped and counted.
    every: all, in order, through a bounded queue; an overflow is counted and is an error.
    latched: as `every`, and a late subscriber first gets the last one sent.
    """

    LATEST = "latest"
    EVERY = "every"
    LATCHED = "latched"


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table.

    rate_hz: what is expected, for health checks; None for topics sent on change.
    logged: recorded unless the launch file says otherwise.
    many_writers: any number of nodes may publish it; else exactly one.
    max_bytes: larger messages are refused at both ends.
    open_to_tools: where many may write, so may command-line tools.
    """

    name: str
    message: type[Message]
    delivery: Delivery
    rate_hz: tuple[float, float] | None
    logged: bool
    about: str
    many_writers: bool = False
    max_bytes: int = 1 << 20
    open_to_tools: bool = True


_LATEST, _EVERY, _LATCHED = Delivery.LATEST, Delivery.EVERY, Delivery.LATCHED

_ROWS = (
    Topic("scene", scene.Scene, _LATCHED, None, True, "what is shown, where, how well",
          max_bytes=16 << 20),
    Topic("stereo", types.StereoPair, _LATEST, (30, 130), False, "pictures of the finger",
          max_bytes=16 << 20),
    Topic("fingertip", types.Fingertip, _LATEST, (30, 130), True, "where the fingertip is"),
    Topic("sheet_target", types.SheetTarget, _LATEST, (30, 150), True, "where the sheet shall be"),
    Topic("arm_left", types.ArmState, _LATEST, (40, 150), True, "the left arm"),
    Topic("arm_right", types.ArmState, _LATEST, (40, 150), True, "the right arm"),
    Topic("skin", types.Skin, _LATCHED, None, True, "the soft body's skin at rest",
          max_bytes=16 << 20),
    Topic("soft_body", types.SoftBody, _LATEST, (20, 1000), True, "the skin's answer to the finger",
          max_bytes=16 << 20),
    Topic("display", types.Display, _LATCHED, None, True, "what the renderer shall show",
          many_writers=True),
    Topic("frame", types.Frame, _LATEST, (1, 130), True, "what the projector was given",
          max_bytes=64 << 20),
    Topic("eye", types.Eye, _LATEST, None, True, "where the user's eyes are", many_writers=True),
    Topic("estop", types.EStop, _LATCHED, None, True, "stop, latched", many_writers=True),
    Topic("recording", types.Recording, _LATCHED, None, True, "start and stop of a recording",
          many_writers=True),
    Topic("bookmark", types.Bookmark, _EVERY, None, True, "positions in a bag to find again",
          many_writers=True),
    Topic("arming", types.Arming, _EVERY, None, True, "the arms may move", many_writers=True),
    Topic("status", types.Status, _EVERY, (0.5, 3), True, "how each node is", many_writers=True),
    Topic("clock_ping", types.ClockPing, _EVERY, (1, 100), True, "among the hosts' clock nodes",
          many_writers=True, open_to_tools=False),
    Topic("clocks", types.Clocks, _LATCHED, None, True, "what each host knows of other clocks",
          many_writers=True, open_to_tools=False),
    Topic("host", types.HostStatus, _EVERY, (0.5, 2), True, "how each computer is",
          many_writers=True, open_to_tools=False),
    Topic("twin/finger_path", types.FingerPath, _LATCHED, None, True, "what the twin's finger does",
          many_writers=True, max_bytes=16 << 20),
    Topic("twin/stereo", types.StereoPair, _LATEST, (30, 130), False, "the twin camera's pixels",
          max_bytes=16 << 20),
    Topic("twin/finger", types.TwinFinger, _EVERY, (30, 1000), True, "the true fingertip"),
    Topic("twin/arms", types.TwinArms, _EVERY, (50, 1000), True, "the true arms"),
    Topic("twin/arms_left", types.TwinArms, _EVERY, (50, 1000), True,
          "the same, by the left arm's computer"),
    Topic("twin/arms_right", types.TwinArms, _EVERY, (50, 1000), True,
          "the same, by the right arm's computer"),
    Topic("twin/apparatus", apparatus.Apparatus, _LATCHED, None, True,
          "what is true in the simulator; only the simulator and experiments read it"),
    Topic("twin/eye", types.TwinEye, _EVERY, None, True, "what the user's eye sees",
          max_bytes=64 << 20),
)  # fmt: skip

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ROWS}


class UnknownTopicError(FlexsheetError, KeyError):
    """A name that is not in the table; the message suggests one that is."""

    code = "unknown-topic"
    remedy = "`flexsheet topic list` prints all names."


def topic_named(name: str) -> Topic:
    """The topic of that name; raises UnknownTopicError with the nearest name."""
    try:
        return TOPICS[name]
    except KeyError:
        if name in RENAMED_TOPICS:
            raise UnknownTopicError(
                f'unknown topic "{name}"; it is now "{RENAMED_TOPICS[name]}"'
            ) from None
        near = get_close_matches(name, TOPICS, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; there are: {', '.join(TOPICS)}"
        raise UnknownTopicError(f'unknown topic "{name}"{hint}') from None
