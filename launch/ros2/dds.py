"""Publish ROS 2 topics with the middleware Cyclone DDS.

ROS 2 maps the topic `/a` to the DDS topic `rt/a`, and the type `p/msg/T` to `p::msg::dds_::T_`.
`mapping.RosTypes` serializes messages to CDR, and Cyclone DDS only transports the bytes.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import psutil

from flexsheet.launch.ros2.mapping import Ros2Error, RosTopic, load_ros_types

LOOPBACK = "lo"
MAX_DOMAIN = 232
MAX_PARTICIPANTS = 120
"""The maximum number of DDS participants that can find each other if multicast is disabled."""

BLOCKING_S = 0.1
_ARRAY_LIMIT = 65535


def mangle_topic(name: str) -> str:
    """Convert the name of a ROS topic to the name of its DDS topic."""
    return f"rt{name}"


def mangle_type(name: str) -> str:
    """Convert the name of a ROS type to the name of its DDS type."""
    package, _, short = name.split("/")
    return f"{package}::msg::dds_::{short}_"


def make_configuration(interface: str) -> str:
    """Return the XML configuration of Cyclone DDS for one network interface.

    If the interface is the loopback interface, multicast is disabled. Raises Ros2Error if this
    computer has no such interface.
    """
    if interface not in psutil.net_if_addrs():
        names = ", ".join(sorted(psutil.net_if_addrs()))
        raise Ros2Error(
            f"--interface {interface}: this computer has no such network interface; it has {names}"
        )
    loopback = interface == LOOPBACK
    multicast = "false" if loopback else "true"
    peers = '<Peers><Peer Address="127.0.0.1"/></Peers>' if loopback else ""
    return (
        "<CycloneDDS><Domain><General>"
        f"<AllowMulticast>{'false' if loopback else 'spdp'}</AllowMulticast>"
        f'<Interfaces><NetworkInterface name="{interface}" multicast="{multicast}"/>'
        "</Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>{peers}"
        "</Discovery></Domain></CycloneDDS>"
    )


@cache
def make_dds_type(ros_type: str) -> Any:
    """Make a Cyclone DDS type for a ROS type.

    The samples of the type contain CDR bytes in the field `cdr`.
    """
    described = _describe(ros_type)

    def serialize(self: Any, **_: Any) -> bytes:
        cdr: bytes = self.cdr
        return cdr

    described.serialize = serialize
    return described


@cache
def _describe(ros_type: str) -> Any:
    from cyclonedds.idl import make_idl_struct
    from rosbags.interfaces import Nodetype

    def find_type(kind: Any, detail: Any) -> Any:
        from cyclonedds.idl import types

        if kind == Nodetype.NAME:
            return _describe(detail)
        if kind == Nodetype.BASE:
            name = {"octet": "byte"}.get(detail[0], detail[0])
            return {"string": str, "bool": bool}.get(name) or getattr(types, name)
        item, length = find_type(*detail[0]), detail[1]
        if kind == Nodetype.ARRAY:
            return types.array[item, length]
        return types.sequence[item, length] if 0 < length <= _ARRAY_LIMIT else types.sequence[item]

    _, fields = load_ros_types().store.fielddefs[ros_type]
    members = {name: find_type(*described) for name, described in fields}
    return make_idl_struct(re.sub(r"\W", "_", ros_type), mangle_type(ros_type), members)


class RosParticipant:
    """A participant of a DDS domain that publishes ROS topics.

    domain: number of the domain, equal to the ROS_DOMAIN_ID of the other participants.
    interface: name of the network interface.

    Raises Ros2Error if the participant cannot be created.
    """

    def __init__(self, domain: int, interface: str = LOOPBACK) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant

        configuration = make_configuration(interface)
        try:
            self._domain = Domain(domain, configuration)
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise Ros2Error(
                f"DDS domain {domain} on {interface}: {error}; check ROS_DOMAIN_ID and --interface"
            ) from error
        self._writers: dict[str, Any] = {}

    def advertise(self, topic: RosTopic) -> None:
        """Create the DDS writer of a topic, so that other participants discover the topic."""
        from cyclonedds.pub import DataWriter

        if topic.name not in self._writers:
            self._writers[topic.name] = DataWriter(
                self._participant, self._make_topic(topic), qos=_make_qos(topic)
            )

    def has_readers(self, topic: RosTopic) -> bool:
        """Return whether a topic must be published because it has readers or is latched."""
        return topic.latched or bool(self._writers[topic.name].get_matched_subscriptions())

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        """Publish CDR bytes on an advertised topic. Raises Ros2Error if this fails."""
        from cyclonedds.core import DDSException

        kind = make_dds_type(topic.ros_type)
        sample = kind.__new__(kind)
        sample.cdr = cdr
        try:
            self._writers[topic.name].write(sample)
        except DDSException as error:
            raise Ros2Error(
                f"ROS topic {topic.name}: a message cannot be published: {error}"
            ) from error

    def close(self) -> None:
        self._writers.clear()
        del self._participant, self._domain

    def _make_topic(self, topic: RosTopic) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, mangle_topic(topic.name), make_dds_type(topic.ros_type))


def _make_qos(topic: RosTopic) -> Any:
    """Return the DDS quality of service of a ROS topic.

    The communication is reliable. If the topic is latched, readers that connect later also receive
    the last message. A reliable writer is compatible with reliable and with best-effort readers.
    The user data contain the hash of the type, because ROS 2 Iron and later releases print a
    warning if the hash is missing.
    """
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    own_hash = load_ros_types().store.hash_rihs01(topic.ros_type)
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=round(BLOCKING_S * 1e3))),
        Policy.Durability.TransientLocal if topic.latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(1 if topic.latched else 10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={own_hash};".encode()),
    )
