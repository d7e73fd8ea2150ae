"""Define all topics: their names, message types, delivery, rates and access.

Nodes, recorder, health checks, command line and documentation use this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum

from flexsheet.messages import apparatus, scene, types
from flexsheet.messages.base import Message
from flexsheet.messages.errors import FlexsheetError


class Delivery(StrEnum):
    """The rule by which messages are delivered to a slow or late subscriber.

    latest: only the newest message is delivered. Older messages are dropped and counted.
    every: all messages are delivered in order through a bounded queue. An overflow is counted as an
        error.
    latched: all messages are delivered as with `every`. A late subscriber first receives the last
        message that was sent.
    """

    LATEST = "latest"
    EVERY = "every"
    LATCHED = "latched"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: a named stream of messages of one type.

    rate_hz: expected minimum and maximum rate, for health checks; None if no rate is expected.
    logged: whether the topic is recorded by default.
    many_writers: whether any number of nodes may publish the topic; if false, only one node may
        publish it.
    max_bytes: maximum size of a message, checked when it is sent and when it is received.
    open_to_tools: whether command-line tools may publish the topic; only used if `many_writers` is
        true.
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
    Topic("scene", scene.Scene, _LATCHED, None, True,
          "objects, devices, working range and tolerances",
          max_bytes=16 << 20),
    Topic("stereo", types.StereoPair, _LATEST, (30, 130), False, "images of the finger",
          max_bytes=16 << 20),
    Topic("fingertip", types.Fingertip, _LATEST, (30, 130), True, "position of the fingertip"),
    Topic("sheet_target", types.SheetTarget, _LATEST, (30, 150), True, "target pose of the sheet"),
    Topic("arm_left", types.ArmState, _LATEST, (40, 150), True, "state of the left arm"),
    Topic("arm_right", types.ArmState, _LATEST, (40, 150), True, "state of the right arm"),
    Topic("arm_latency", types.ArmLatency, _EVERY, None, True, "measured latency of each arm",
          many_writers=True, open_to_tools=False),
    Topic("skin", types.Skin, _LATCHED, None, True, "skin of the soft body at rest",
          max_bytes=16 << 20),
    Topic("soft_body", types.SoftBody, _LATEST, (20, 1000), True,
          "response of the skin to the finger",
          max_bytes=16 << 20),
    Topic("force", types.Force, _LATEST, None, True, "measured force of the finger on the sheet",
          many_writers=True),
    Topic("display", types.Display, _LATCHED, None, True, "settings of the renderer",
          many_writers=True),
    Topic("frame", types.Frame, _LATEST, (1, 130), True, "images for the projector",
          max_bytes=64 << 20),
    Topic("eye", types.Eye, _LATEST, None, True, "position of the user's eyes", many_writers=True),
    Topic("estop", types.EStop, _LATCHED, None, True, "emergency stop, latched", many_writers=True),
    Topic("recording", types.Recording, _LATCHED, None, True, "start and stop of a recording",
          many_writers=True),
    Topic("parameter", types.ParameterChange, _EVERY, None, True,
          "changes of parameters of running nodes", many_writers=True),
    Topic("bookmark", types.Bookmark, _EVERY, None, True, "marked times in a bag",
          many_writers=True),
    Topic("arming", types.Arming, _EVERY, None, True,
          "commands to arm or stop the arms", many_writers=True),
    Topic("status", types.Status, _EVERY, (0.5, 3), True, "state of each node", many_writers=True),
    Topic("clock_ping", types.ClockPing, _EVERY, (1, 100), True,
          "exchange between the hosts' clock nodes",
          many_writers=True, open_to_tools=False),
    Topic("clocks", types.Clocks, _LATCHED, None, True, "measured offsets of other hosts' clocks",
          many_writers=True, open_to_tools=False),
    Topic("host", types.HostStatus, _EVERY, (0.5, 2), True, "state of each computer",
          many_writers=True, open_to_tools=False),
    Topic("twin/finger_path", types.FingerPath, _LATCHED, None, True,
          "path of the simulated finger",
          many_writers=True, max_bytes=16 << 20),
    Topic("twin/stereo", types.StereoPair, _LATEST, (30, 130), False,
          "images of the simulated camera",
          max_bytes=16 << 20),
    Topic("twin/finger", types.TwinFinger, _EVERY, (30, 1000), True,
          "true position of the fingertip"),
    Topic("twin/arms", types.TwinArms, _EVERY, (50, 1000), True, "true poses of the arms"),
    Topic("twin/arms_left", types.TwinArms, _EVERY, (50, 1000), True,
          "true poses of the arms, from the left arm's computer"),
    Topic("twin/arms_right", types.TwinArms, _EVERY, (50, 1000), True,
          "true poses of the arms, from the right arm's computer"),
    Topic("twin/apparatus", apparatus.Apparatus, _LATCHED, None, True,
          "true parameters of the simulated apparatus; only the simulator and experiments read it"),
    Topic("twin/eye", types.TwinEye, _EVERY, None, True, "image as the user's eye would see it",
          max_bytes=64 << 20),
)  # fmt: skip

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ROWS}


class UnknownTopicError(FlexsheetError, KeyError):
    """Raised if a topic name is unknown. The text suggests a similar name."""

    exit_code = 2


def find_topic(name: str) -> Topic:
    """Return the topic with the given name.

    Raises UnknownTopicError, which suggests the most similar name, if there is no such topic.
    """
    try:
        return TOPICS[name]
    except KeyError:
        near = get_close_matches(name, TOPICS, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; topics: {', '.join(TOPICS)}"
        raise UnknownTopicError(f'unknown topic "{name}"{hint}') from None
